"""The registers of a program: what a chunk computes, and which of them can share memory, so that all of it stays in the cache."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D
from lidarspec.frames.tracing import Node

TYPES: dict[str, np.dtype[Any]] = {
    "single": np.dtype(np.float32),
    "double": np.dtype(np.float64),
    "index": np.dtype(np.intp),
    "flag": np.dtype(np.bool_),
    "u1": np.dtype("u1"),
    "u2": np.dtype("u2"),
}

Values = Callable[[Node], NDArray[Any]]


@dataclass
class Run:
    """One execution: the frames, the low values, and the chunk under way."""

    rows: Bytes2D
    values: Values
    views: list[NDArray[Any]] = field(default_factory=list)
    start: int = 0
    stop: int = 0
    prepared: dict[Any, Any] = field(default_factory=dict)

    def part(self, array: NDArray[Any]) -> NDArray[Any]:
        """The chunk's packets of values that each packet has, or that all share."""
        return array[self.start : self.stop] if len(array) > 1 else array


@dataclass(frozen=True, eq=False)
class Step:
    """One call: `run(execution, output)`, and the registers that it reads or uses besides."""

    text: str
    run: Callable[[Run, NDArray[Any]], None]
    output: int
    reads: tuple[int, ...] = ()


@dataclass(frozen=True)
class Read:
    """A register as an argument of a step."""

    register: int

    def __call__(self, run: Run) -> NDArray[Any]:
        return run.views[self.register]


@dataclass(frozen=True)
class Number:
    """A number as an argument of a step."""

    value: float

    def __call__(self, run: Run) -> float:
        return self.value


def deep(array: NDArray[Any], depth: int) -> NDArray[Any]:
    """Values of packets with as many axes as the points have."""
    return array.reshape(*array.shape, *(1,) * (1 + depth - array.ndim))


def shared(steps: Sequence[Step], kinds: Sequence[str], own: Collection[int]) -> list[int]:
    """A slot for each register, so that registers of one kind that are never needed at the same time have the same one.

    Args:
        steps: in their order.
        kinds: of the registers.
        own: registers that have memory of their own.
    """
    last = {register: place for place, step in enumerate(steps) for register in (step.output, *step.reads)}
    slots, free, count = [-1] * len(kinds), dict[str, list[int]](), 0
    for place, step in enumerate(steps):
        for register in {step.output, *step.reads} - set(own):
            if slots[register] < 0:
                waiting = free.setdefault(kinds[register], [])
                if not waiting:
                    waiting.append(count)
                    count += 1
                slots[register] = waiting.pop()
        for register in {step.output, *step.reads} - set(own):
            if last[register] == place:
                free[kinds[register]].append(slots[register])
    return slots
