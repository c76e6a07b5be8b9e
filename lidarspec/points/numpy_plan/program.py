"""Run a program of NumPy calls on registers, for one chunk of packets at a time.

A register is an array of one kind for a chunk: float32 ("single"), float64 ("double"), indices,
flags or integers. Each step of a program computes one register. Registers that are not needed at
the same time share memory, so that a chunk fits in the cache.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D
from lidarspec.points.plan import ColumnMaker, Values

#: The number of points of a chunk, so that its scratch arrays fit in the cache.
CHUNK_POINTS = 1 << 16

_CODES = {
    "single": "f4",
    "double": "f8",
    "index": "intp",
    "flag": "?",
    **{f"{sign}{size}": f"{sign}{size}" for sign in "iu" for size in (1, 2, 4)},
}
#: The dtype of each kind of register.
TYPES: dict[str, np.dtype[Any]] = {kind: np.dtype(code) for kind, code in _CODES.items()}


_NOTHING = np.empty(0)


@dataclass
class ProgramRun:
    """One execution: the frames, the values of nodes, and the current chunk.

    Attributes:
        rows: the frames, (n, size).
        values: a function that returns the value of a node for the batch, (n or 1, ...).
        views: the array of each register for the current chunk.
    """

    rows: Bytes2D
    values: Values
    views: list[NDArray[Any]] = field(default_factory=list)
    start: int = 0
    stop: int = 0

    def take_chunk(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return the rows of the current chunk; an array with a single row is returned whole."""
        if len(array) > 1:
            return array[self.start : self.stop]
        return array


@dataclass(frozen=True, eq=False)
class ProgramStep:
    """A call that fills one register.

    Attributes:
        text: a description of the call.
        run: the function to call, with the `ProgramRun` and the array of the register.
        output: the register that the function fills.
        reads: the registers that the function reads.
    """

    text: str
    run: Callable[[ProgramRun, NDArray[Any]], Any]
    output: int
    reads: tuple[int, ...] = ()


@dataclass(frozen=True)
class RegisterRead:
    """A register as an argument of a step."""

    register: int

    def __call__(self, run: ProgramRun) -> NDArray[Any]:
        return run.views[self.register]


class Program(ColumnMaker):
    """The calls that compute flat columns of points.

    Args:
        width: the number of points of a packet.
        safe: a function that returns whether the three coordinates of each point are either all
            finite or all nan. Its argument is a function that returns the value of a node.

    Attributes:
        chunk: the number of packets of a chunk.
        kinds: the kind of each register.
        outputs: the register of each column.
    """

    def __init__(self, width: int, safe: Callable[[Values], bool]) -> None:
        self.width = width
        self._safe = safe
        self.chunk = max(CHUNK_POINTS // max(width, 1), 1)
        self.steps: list[ProgramStep] = []
        self.kinds: list[str] = []
        self.outputs: dict[str, int] = {}
        self._tiles: dict[int, NDArray[Any]] = {}

    def add_register(self, kind: str) -> int:
        """Add a register, and return its number."""
        self.kinds.append(kind)
        return len(self.kinds) - 1

    def add_step(
        self,
        text: str,
        kind: str,
        run: Callable[[ProgramRun, NDArray[Any]], Any],
        *reads: Callable[[ProgramRun], Any],
    ) -> int:
        """Add a step, and return the register for its result."""
        output = self.add_register(kind)
        registers = tuple(read.register for read in reads if isinstance(read, RegisterRead))
        self.steps.append(ProgramStep(text, run, output, registers))
        return output

    def add_call(
        self, text: str, kind: str, function: Any, *reads: Callable[[ProgramRun], Any]
    ) -> int:
        """Add a call of a function that accepts `out`; return the register for the result."""
        return self.add_step(
            text, kind, lambda run, out: function(*(read(run) for read in reads), out=out), *reads
        )

    def add_tile(self, row: NDArray[Any], kind: str) -> int:
        """Add a register with the same values in every packet, and return its number."""
        register = self.add_register(kind)
        self._tiles[register] = np.tile(row.reshape(-1), self.chunk)
        return register

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        return {
            name: np.empty(number * self.width, TYPES[self.kinds[register]])
            for name, register in self.outputs.items()
        }

    def run(self, rows: Bytes2D, values: Values, columns: Mapping[str, NDArray[Any]]) -> None:
        points = min(len(rows), self.chunk) * self.width
        kinds = dict(zip(self._slots, self.kinds, strict=True))
        slots = {slot: np.empty(points, TYPES[kind]) for slot, kind in kinds.items() if slot >= 0}
        registers = [
            slots.get(slot, self._tiles.get(register, _NOTHING))
            for register, slot in enumerate(self._slots)
        ]
        execution = ProgramRun(rows, values)
        with np.errstate(all="ignore"):
            for start in range(0, len(rows), self.chunk):
                execution.start = start
                execution.stop = min(start + self.chunk, len(rows))
                self._run_chunk(execution, registers, columns)
        coordinates = [columns[name] for name in "xyz" if name in columns]
        if coordinates and not self._safe(values):
            bad = np.isnan(coordinates).any(axis=0)
            for coordinate in coordinates:
                coordinate[bad] = np.nan

    def _run_chunk(
        self, run: ProgramRun, registers: list[NDArray[Any]], columns: Mapping[str, NDArray[Any]]
    ) -> None:
        chunk = slice(run.start * self.width, run.stop * self.width)
        run.views = [array[: chunk.stop - chunk.start] for array in registers]
        for name, register in self.outputs.items():
            if register not in self._tiles:
                run.views[register] = columns[name][chunk]
        for step in self.steps:
            step.run(run, run.views[step.output])
        for name, register in self.outputs.items():
            target = columns[name][chunk]
            if run.views[register].base is not target.base:
                np.copyto(target, run.views[register])

    @cached_property
    def _slots(self) -> list[int]:
        """The slot of each register; computed once, after all steps were added."""
        uses = [(step.output, *step.reads) for step in self.steps]
        return assign_slots(uses, self.kinds, {*self.outputs.values(), *self._tiles})


def assign_slots(
    uses: Sequence[Collection[int]], kinds: Sequence[str], own: Collection[int]
) -> list[int]:
    """Return a slot for each register; -1 for a register without a slot.

    Args:
        uses: for each step, in order, the registers that it fills or reads.
        kinds: the kind of each register.
        own: registers that have their own memory.
    """
    # Registers of one kind that are not needed at the same time share a slot.
    last = {register: index for index, used in enumerate(uses) for register in used}
    slots = [-1] * len(kinds)
    free = dict[str, list[int]]()
    count = 0
    for index, used in enumerate(uses):
        shared = set(used) - set(own)
        for register in shared:
            if slots[register] >= 0:
                continue
            waiting = free.setdefault(kinds[register], [])
            if not waiting:
                waiting.append(count)
                count += 1
            slots[register] = waiting.pop()
        for register in shared:
            if last[register] == index:
                free[kinds[register]].append(slots[register])
    return slots
