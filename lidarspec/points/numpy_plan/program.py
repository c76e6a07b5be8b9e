"""A program: NumPy calls on registers, for one chunk of packets at a time.

It computes flat columns from frames of one layout.

The machine knows nothing of fields or expressions: `numpy_plan.compiler` appends the steps. A step
makes one register out of others, of the frames' blocks, or of values of packets that are known.
Registers are float32 ("single"), float64 ("double"), indices, flags or words of the wire. Those of
columns are the columns' own memory; the others come from scratch memory that is used again for
every chunk.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D
from lidarspec.points.numpy_plan.blocks import Blocks
from lidarspec.points.numpy_plan.registers import TYPES, borrowed, given_back, slots_of
from lidarspec.points.plan import Maker, Values

#: points of a chunk, so that its scratch arrays stay in the cache.
CHUNK = 1 << 17
_NOTHING = np.empty(0)


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
        if len(array) > 1:
            return array[self.start : self.stop]
        return array


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


class Program(Maker):
    """The calls that make some flat float32 or float64 columns.

    Args:
        width: points of a packet.
        safe: whether a nan marks all coordinates of a point alike, for some values of the packets;
            else they are made to.

    Attributes:
        chunk: packets of a chunk.
        most: packets at a time at most, so that no few are left over.
        steps: in their order.
        kinds: of the registers.
        outputs: the register of each column.
        blocks: what is loaded from the frames.
    """

    def __init__(self, width: int, safe: Callable[[Values], bool]) -> None:
        self.width = width
        self._safe = safe
        self.chunk = max(CHUNK // max(width, 1), 1)
        self.most = self.chunk + self.chunk // 4
        self.steps: list[Step] = []
        self.kinds: list[str] = []
        self.outputs: dict[str, int] = {}
        self.blocks: list[Blocks] = []
        self._tiles: dict[int, NDArray[Any]] = {}

    def register(self, kind: str) -> int:
        """A new register."""
        self.kinds.append(kind)
        return len(self.kinds) - 1

    def step(
        self,
        text: str,
        kind: str,
        run: Callable[[Run, NDArray[Any]], Any],
        *reads: Callable[[Run], Any],
    ) -> int:
        """A new register, made by a call that reads or uses others."""
        output = self.register(kind)
        self.steps.append(
            Step(
                text, run, output, tuple(read.register for read in reads if isinstance(read, Read))
            )
        )
        return output

    def call(self, text: str, kind: str, function: Any, *reads: Callable[[Run], Any]) -> int:
        """A new register, made by a function of others that takes `out`."""
        return self.step(
            text, kind, lambda run, out: function(*(read(run) for read in reads), out=out), *reads
        )

    def repeated(self, text: str, kind: str, make: Callable[[Run], NDArray[Any]]) -> int:
        """Return a new register that repeats numbers of packets or blocks.

        Each point has the number of its packet or block. The numbers are made once for the batch,
        at its first chunk.
        """
        place = object()

        def run(execution: Run, out: NDArray[Any]) -> None:
            if place not in execution.prepared:
                execution.prepared[place] = np.asarray(make(execution), TYPES[kind]).reshape(
                    len(execution.rows), -1
                )
            numbers = execution.prepared[place][execution.start : execution.stop].reshape(-1, 1)
            out.reshape(len(numbers), -1)[...] = numbers

        return self.step(text, kind, run)

    def tiled(self, row: NDArray[Any], kind: str) -> int:
        """A new register with the same row in every packet."""
        register = self.step("the same in every packet", kind, lambda run, out: None)
        self._tiles[register] = np.tile(row, self.most)
        return register

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        return {
            name: np.empty(number * self.width, TYPES[self.kinds[register]])
            for name, register in self.outputs.items()
        }

    def run(self, rows: Bytes2D, values: Values, columns: Mapping[str, NDArray[Any]]) -> None:
        number = len(rows)
        if not number:
            return
        if any(blocks.is_flat for blocks in self.blocks):
            rows = np.ascontiguousarray(rows)
        step = -(-number // max(-(-number // self.most), 1))
        room = min(self.most, 1 << step.bit_length())  # the same for scans that are nearly as long
        memory = borrowed()
        execution = Run(rows, values)
        made = memory.arrays(self._slots, room, self._wanted)
        execution.prepared = {
            blocks: blocks.loading(rows, space)
            for blocks, space in zip(self.blocks, made, strict=False)
        }
        registers = [
            made[slot + len(self.blocks)] if slot >= 0 else self._tiles.get(at, _NOTHING)
            for at, slot in enumerate(self._slots)
        ]
        with np.errstate(all="ignore"):
            for start in range(0, number, step):
                self._chunk(execution, registers, columns, start, min(start + step, number))
        given_back(memory)
        places = [columns[name] for name in "xyz" if name in columns]
        if places and not self._safe(values):
            bad = np.isnan(places).any(axis=0)
            for place in places:
                place[bad] = np.nan

    @cached_property
    def _slots(self) -> list[int]:
        """Which registers share memory; asked for when no column is added any more."""
        return slots_of(
            [(step.output, *step.reads) for step in self.steps],
            self.kinds,
            {*self.outputs.values(), *self._tiles},
        )

    @cached_property
    def _wanted(self) -> list[tuple[int, np.dtype[Any]]]:
        """The arrays that a chunk needs: elements for each packet, and dtype.

        Those of the blocks come first, then those of the slots.
        """
        kinds = dict(
            sorted(
                (slot, kind)
                for slot, kind in zip(self._slots, self.kinds, strict=True)
                if slot >= 0
            )
        )
        return [(blocks.room, np.dtype(np.uint8)) for blocks in self.blocks] + [
            (self.width, TYPES[kind]) for kind in kinds.values()
        ]

    def _chunk(
        self,
        run: Run,
        registers: list[NDArray[Any]],
        columns: Mapping[str, NDArray[Any]],
        start: int,
        stop: int,
    ) -> None:
        count = (stop - start) * self.width
        run.start = start
        run.stop = stop
        run.views = [array[:count] for array in registers]
        for name, register in self.outputs.items():
            if register not in self._tiles:
                run.views[register] = columns[name][start * self.width : stop * self.width]
        for step in self.steps:
            step.run(run, run.views[step.output])
        for name, register in self.outputs.items():
            target = columns[name][start * self.width : stop * self.width]
            if run.views[register].base is not target.base:
                np.copyto(target, run.views[register])
