"""A traced expression as a list of NumPy calls on a chunk of packets, with scratch arrays that are used again and again.

What depends on one field of two bytes or less is a table by its raw value, or its bits as they stand; sums, sines and cosines
are matrix products where they can be (`sums`). The rest is ordinary NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D, Layout, Leaf
from lidarspec.frames.tracing import Node
from lidarspec.plans.expressions import is_full, key, last_axis, only_field
from lidarspec.plans.registers import TYPES, Read, Run, Step, Values, deep, shared
from lidarspec.plans.scratch import borrowed, given_back
from lidarspec.plans.sums import Sums
from lidarspec.plans.windows import Blocks, Window, every_value, shift_of, window

#: points of a chunk, so that its scratch arrays stay in the cache.
CHUNK = 1 << 17
_NOTHING = np.empty(0)


class Program:
    """The calls that make some flat float32 or float64 columns out of frames of one layout.

    Args:
        layout: of the frames.
        shape: of the points of a packet.
        tables: those known already, by what they are of; added to.
    """

    def __init__(self, layout: Layout, shape: tuple[int, ...], tables: dict[Any, NDArray[Any]]) -> None:
        self.layout, self.shape, self.width = layout, shape, math.prod(shape)
        self.chunk = max(CHUNK // max(self.width, 1), 1)
        self._most = self.chunk + self.chunk // 4  # packets at a time, so that no few are left over
        self.steps: list[Step] = []
        self.kinds: list[str] = []
        self.outputs: dict[str, int] = {}
        self.low: list[Node] = []
        self._tables, self._known = tables, dict[Any, int]()
        self._blocks: list[Blocks] = []
        self._shifts: dict[tuple[str, Window], tuple[int, int] | None] = {}
        self._sums = Sums(self)
        self._tiles: dict[int, NDArray[Any]] = {}

    def want(self, name: str, value: Any, kind: str) -> None:
        """Make a column of this name; `kind` is "single" or "double"."""
        self.outputs[name] = self.single(value) if kind == "single" else self.double(value)

    def single(self, value: Any) -> int:
        """The register of an expression in float32; only products and tables are computed in that precision."""
        if not is_full(value, self.width):
            return self._spread(value, "single")
        return self.once(("single", value), lambda: self._single(value))

    def _single(self, node: Node) -> int:
        found = self.field(node, "single")
        if found is not None:
            return found
        if node.kind == "call" and node.function is np.multiply:
            first, second = (self._factor(arg) for arg in node.args)
            return self.call("multiply", "single", np.multiply, first, second)
        if node.kind == "call" and node.function in (np.cos, np.sin):
            return self._sums.direction(node)
        if node.kind == "call" and node.function is np.add and any(not isinstance(arg, Node) for arg in node.args):
            first, second = (self._factor(arg) for arg in node.args)
            return self.call("add", "single", np.add, first, second)
        return self._cast(self.double(node))

    def double(self, value: Any) -> int:
        """The register of an expression in float64."""
        if not is_full(value, self.width):
            return self._spread(value, "double")
        return self.once(("double", value), lambda: self._double(value))

    def _double(self, node: Node) -> int:
        kind = "flag" if node.sample.array.dtype.kind == "b" else "double"
        found = self.field(node, kind)
        if found is None and node.kind == "call":
            found = self._sums.sum(node)
        if found is None and node.kind == "call":
            found = self._plain(node, kind)
        return found if found is not None else self._spread(node, kind)

    def field(self, node: Node, kind: str, factor: float = 1.0) -> int | None:
        """An expression of one field, times a number: loaded as it is, or looked up by its window; None where it is neither."""
        source = only_field(node)
        leaf = self.layout.leaves.get(source.path) if source is not None and is_full(source, self.width) else None
        if leaf is None or source is None:
            return None
        seen = window(leaf)
        if seen is None:
            return None
        shift = self._shift(leaf, seen)
        if node is source and factor == 1 and not leaf.info.scaled:
            if shift is not None:
                return self._shifted(leaf, seen, *shift, kind)
            if leaf.wire is not None:
                return self._load(leaf, seen, leaf.wire, kind)
        index = self.once(("index", seen), lambda: self._load(leaf, seen, seen.dtype, "index"))
        if shift is not None and seen.size > 1:  # a smaller table stays nearer
            whole = Read(index)
            index = self.once(("index", seen, shift), lambda: self._cut(leaf, seen, *shift, whole))
        table = self._table(node, leaf, seen, kind, factor)
        text = f"{node.path or source.path}: table of {len(table)} by {(len(table) - 1).bit_length()} bits"
        read = Read(index)
        return self.step(text, kind, lambda run, out: table.take(read(run), out=out, mode="wrap"), read)

    def _shift(self, leaf: Leaf, seen: Window) -> tuple[int, int] | None:
        """How a field that shares its window with others is cut out of it; see `shift_of`."""
        if leaf.wire is not None:
            return None
        if (leaf.info.path, seen) not in self._shifts:
            self._shifts[leaf.info.path, seen] = shift_of(leaf, seen)
        return self._shifts[leaf.info.path, seen]

    def _table(self, node: Node, leaf: Leaf, seen: Window, kind: str, factor: float) -> NDArray[Any]:
        shift = self._shift(leaf, seen)
        name = (kind, seen.offset - leaf.offset, seen.size, leaf.size, shift, factor, key(node))
        if name not in self._tables:
            values = np.asarray(every_value(node, leaf))
            if shift is not None and seen.size > 1:
                values = values[np.arange(shift[1] + 1) << shift[0]]
            self._tables[name] = np.ascontiguousarray(values if factor == 1 else values * factor, TYPES[kind])
        return self._tables[name]

    def _load(self, leaf: Leaf, seen: Window, dtype: np.dtype[Any], kind: str) -> int:
        """A register with a window of every element as it stands."""
        blocks = self._of(leaf, seen)
        place, width = self._blocks.index(blocks), self.width

        def run(execution: Run, out: NDArray[Any]) -> None:
            column = execution.prepared[place].column(seen, execution.start, execution.stop, width)
            np.copyto(out, column if column.dtype == dtype else column.view(dtype), casting="unsafe")

        return self.step(f"{leaf.info.path}: {dtype} at byte {seen.offset}", kind, run)

    def _shifted(self, leaf: Leaf, seen: Window, shift: int, mask: int, kind: str) -> int:
        """A register with some bits of a window of every element."""
        words = f"u{seen.size}"
        word = Read(self.once((words, seen), lambda: self._load(leaf, seen, seen.dtype, words)))
        read = Read(self._cut(leaf, seen, shift, mask, word))
        return self.step(f"{leaf.info.path} as it stands", kind, lambda run, out: np.copyto(out, read(run), casting="unsafe"), read)

    def _cut(self, leaf: Leaf, seen: Window, shift: int, mask: int, word: Read) -> int:
        """A register of the same kind with some bits of the words of another."""
        is_masked = mask < (1 << 8 * seen.size) - 1 >> shift

        def run(execution: Run, out: NDArray[Any]) -> None:
            np.right_shift(word(execution), shift, out=out)
            if is_masked:
                np.bitwise_and(out, mask, out=out)

        return self.step(f"{leaf.info.path}: {mask.bit_length()} bits from bit {shift} on", self.kinds[word.register], run, word)

    def _of(self, leaf: Leaf, seen: Window) -> Blocks:
        for blocks in self._blocks:
            if blocks.shape == leaf.shape and blocks.holds(seen):
                return blocks
        alike = [other for other in self.layout.leaves.values() if other.shape == leaf.shape and other.strides == leaf.strides]
        self._blocks.append(Blocks(alike, self.layout.size))
        return self._blocks[-1]

    def repeated(self, text: str, kind: str, make: Callable[[Run], NDArray[Any]]) -> int:
        """Numbers of packets or blocks, made for the batch at its first chunk, for each point of theirs."""
        place = -1 - len(self.steps)

        def run(execution: Run, out: NDArray[Any]) -> None:
            if place not in execution.prepared:
                execution.prepared[place] = np.asarray(make(execution), TYPES[kind]).reshape(len(execution.rows), -1)
            numbers = execution.prepared[place][execution.start : execution.stop].reshape(-1, 1)
            out.reshape(len(numbers), -1)[...] = numbers

        return self.step(text, kind, run)

    def _plain(self, node: Node, kind: str) -> int:
        """Any other function of arrays, as NumPy evaluates it."""
        depth = max(len(arg.shape) for arg in node.args if isinstance(arg, Node))
        reads = [self._argument(arg, depth) for arg in node.args]
        used = [Read(self.double(arg)) for arg in node.args if is_full(arg, self.width)]
        function, shape = node.function, node.shape

        def run(execution: Run, out: NDArray[Any]) -> None:
            found = function(*(read(execution) for read in reads))
            out.reshape(-1, *shape)[...] = found

        return self.step(f"{getattr(function, '__name__', 'function')} as it stands", kind, run, *used)

    def _argument(self, value: Any, depth: int) -> Callable[[Run], Any]:
        if not isinstance(value, Node):
            return lambda run: value
        if is_full(value, self.width):
            read, shape = Read(self.double(value)), (*value.shape, *(1,) * (depth - len(value.shape)))
            return lambda run: read(run).reshape(-1, *shape)
        self.low.append(value)
        return lambda run: deep(run.part(run.values(value)), depth)

    def _factor(self, value: Any) -> Callable[[Run], Any]:
        """A factor of a float32 product: a register, a number, or a row repeated for the whole chunk."""
        if is_full(value, self.width):
            return Read(self.single(value))
        if not isinstance(value, Node) and np.size(value) == 1:
            number = np.float32(np.asarray(value).reshape(()))
            return lambda run: number
        return Read(self.once(("row", id(value)), lambda: self._spread(value, "single")))

    def _spread(self, value: Any, kind: str) -> int:
        """What is not full, for every point."""
        if not isinstance(value, Node):
            row = np.broadcast_to(np.asarray(value, TYPES[kind]), self.shape).reshape(-1)
            tile = np.tile(row, self._most)
            found = self.step("the same in every packet", kind, lambda run, out: None)
            self._tiles[found] = tile
            return found
        self.low.append(value)
        level = last_axis(value.shape)
        if value.width == math.prod(self.shape[:level]):
            return self.repeated("computed plainly before", kind, lambda run: run.values(value))
        shape, depth = self.shape, len(self.shape)

        def run(execution: Run, out: NDArray[Any]) -> None:
            out.reshape(-1, *shape)[...] = deep(execution.part(execution.values(value)), depth)

        return self.step("computed plainly before", kind, run)

    def _cast(self, register: int) -> int:
        read = Read(register)
        return self.step("as float32", "single", lambda run, out: np.copyto(out, read(run), casting="same_kind"), read)

    def call(self, text: str, kind: str, function: Any, *reads: Callable[[Run], Any]) -> int:
        return self.step(text, kind, lambda run, out: function(*(read(run) for read in reads), out=out), *reads)

    def step(self, text: str, kind: str, run: Callable[[Run, NDArray[Any]], Any], *reads: Callable[[Run], Any]) -> int:
        output = self.register(kind)
        self.steps.append(Step(text, run, output, tuple(read.register for read in reads if isinstance(read, Read))))
        return output

    def register(self, kind: str) -> int:
        self.kinds.append(kind)
        return len(self.kinds) - 1

    def once(self, name: Any, make: Callable[[], int]) -> int:
        if name not in self._known:
            self._known[name] = make()
        return self._known[name]

    def columns(self, number: int) -> dict[str, NDArray[Any]]:
        """The columns of so many frames, to be filled."""
        return {name: np.empty(number * self.width, TYPES[self.kinds[register]]) for name, register in self.outputs.items()}

    def run(self, rows: Bytes2D, values: Values, found: Mapping[str, NDArray[Any]]) -> None:
        """Fill the columns of all frames.

        Args:
            rows: the frames, at one distance from each other.
            values: the plain result of a node for these frames, shape (n or 1, ...).
            found: flat, contiguous and as long as `columns` makes them.
        """
        number = len(rows)
        if any(blocks.is_flat for blocks in self._blocks):
            rows = np.ascontiguousarray(rows)
        step = -(-number // max(-(-number // self._most), 1))
        room = min(self._most, 1 << step.bit_length())  # the same for scans that are nearly as long
        memory, execution = borrowed(), Run(rows, values)
        made = memory.arrays(self._slots, room, self._wanted)
        execution.prepared = {place: blocks.loading(rows, made[place]) for place, blocks in enumerate(self._blocks)}
        registers = [made[slot + len(self._blocks)] if slot >= 0 else self._tiles.get(at, _NOTHING) for at, slot in enumerate(self._slots)]
        with np.errstate(all="ignore"):
            for start in range(0, number, step or 1):
                self._chunk(execution, registers, found, start, min(start + step, number))
        given_back(memory)

    @cached_property
    def _slots(self) -> list[int]:
        """Which registers share memory; asked for when no column is added any more."""
        return shared(self.steps, self.kinds, {*self.outputs.values(), *self._tiles})

    @cached_property
    def _wanted(self) -> list[tuple[int, np.dtype[Any]]]:
        """The arrays that a chunk needs, of so many elements a packet: for the blocks, then for the slots."""
        kinds = dict(sorted((slot, kind) for slot, kind in zip(self._slots, self.kinds, strict=True) if slot >= 0))
        return [(blocks.room, np.dtype(np.uint8)) for blocks in self._blocks] + [(self.width, TYPES[kind]) for kind in kinds.values()]

    def _chunk(self, run: Run, registers: list[NDArray[Any]], found: Mapping[str, NDArray[Any]], start: int, stop: int) -> None:
        count = (stop - start) * self.width
        run.start, run.stop = start, stop
        run.views = [array[:count] for array in registers]
        for name, register in self.outputs.items():
            if register not in self._tiles:
                run.views[register] = found[name][start * self.width : stop * self.width]
        for step in self.steps:
            step.run(run, run.views[step.output])
        for name, register in self.outputs.items():
            target = found[name][start * self.width : stop * self.width]
            if run.views[register].base is not target.base:
                np.copyto(target, run.views[register])
