"""A traced expression as a list of NumPy calls on a chunk of packets, with scratch arrays that are used again and again.

What depends on one field of two bytes or less is a table by its raw value, or its bits as they stand; sums, sines and cosines
are matrix products where they can be (`sums`). The rest is ordinary NumPy.

Sums and angles as steps of a program: what is low as one matrix product, angles reduced to half a turn before they become float32.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.graph import Node, Term, chosen, is_full, key, last_axis, only_field, split_level, terms
from lidarspec.points.numpy_plan.products import TURN, Angles, Product, Rotation, Turns, multiplied, reduced
from lidarspec.points.numpy_plan.registers import TYPES, Number, Read, Run, Step, Values, borrowed, deep, given_back, shared
from lidarspec.points.numpy_plan.windows import Blocks, Window, every_value, possible, shift_of, window
from lidarspec.wire.layout import Bytes2D, Layout, Leaf

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


class Sums:
    """The sums and angles of a program; each method adds steps to it and gives the register of their result."""

    def __init__(self, program: Program) -> None:
        self._program = program
        self._around: dict[Node, Angles | None] = {}
        self._rotations: dict[Node, Rotation | None] = {}

    def direction(self, node: Node) -> int:
        """A cosine or sine; where all points of a packet or block have the same or nearly so, it is computed once for them."""
        value, function = node.args[0], node.function
        angles = self._angles(value)
        if angles is not None and angles.all_alike:
            name = f"{function.__name__} of each block"
            return self._program.repeated(name, "single", lambda run: function(_shared_by(angles, run)))
        rotation = self._rotation(value)
        if rotation is not None:
            return self._turned(function, rotation, self._program.once(("wide", value), lambda: self._wide(rotation)))
        angle = self._program.once(("angle", value), lambda: self._angle(value))
        return self._program.call(function.__name__, "single", function, Read(angle))

    def _rotation(self, value: Node) -> Rotation | None:
        if value not in self._rotations:
            angles = self._angles(value)
            self._rotations[value] = None if angles is None else Rotation.of(angles)
        return self._rotations[value]

    def _wide(self, rotation: Rotation) -> int:
        """The angles of those packets or blocks whose points are too far apart for one rotation, within half a turn."""

        def run(execution: Run, out: NDArray[Any]) -> None:
            if rotation not in execution.prepared:
                execution.prepared[rotation] = rotation.turns(execution)
            turns: Turns = execution.prepared[rotation]
            turns.move(execution.start, execution.stop)
            if turns.some_wide:
                out.reshape(-1, rotation.inner)[turns.wide] = turns.angles()

        return self._program.step("angles of what is wide", "single", run)

    def _turned(self, function: Any, rotation: Rotation, wide: int) -> int:
        """Cosines or sines of angles that are turned a little from the one in their middle: a matrix product of series."""
        read, which = Read(wide), 0 if function is np.cos else 1

        def run(execution: Run, out: NDArray[Any]) -> None:
            turns: Turns = execution.prepared[rotation]
            rows = out.reshape(-1, rotation.inner)
            if not turns.all_wide:
                multiplied(turns.left[which], rotation.rows[which], rows)
            if turns.some_wide:
                rows[turns.wide] = function(read(execution).reshape(-1, rotation.inner)[turns.wide])

        return self._program.step(f"{function.__name__} by {len(rotation.rows[0])} products", "single", run, read)

    def _angle(self, value: Node) -> int:
        """An angle in float32, reduced to half a turn either way before it loses precision."""
        near = self._near(value)
        if near is not None:
            return near
        angle, turns = self._program.double(value), self._program.register("double")
        read = Read(angle)

        def run(execution: Run, out: NDArray[Any]) -> None:
            radians, whole = read(execution), execution.views[turns]
            np.multiply(radians, 1 / TURN, out=whole)
            np.rint(whole, out=whole)
            np.multiply(whole, TURN, out=whole)
            np.subtract(radians, whole, out=whole)
            np.copyto(out, whole, casting="same_kind")

        return self._program.step("reduce to half a turn", "single", run, read, Read(turns))

    def _near(self, value: Node) -> int | None:
        """The same for angles that lie around one of their packet or block: most of them need no reduction; None for others."""
        angles = self._angles(value)
        if angles is None:
            return None
        read = Read(self._added(angles.around.rows, place := -1 - len(self._program.steps), angles.left, self._parts(value)[1]))

        def run(execution: Run, out: NDArray[Any]) -> None:
            radians, (numbers, far) = read(execution), execution.prepared[place]
            spots = np.flatnonzero(far[_rows(execution, numbers)])
            if len(spots):
                rows = radians.reshape(-1, angles.around.inner)
                rows[spots] = reduced(rows[spots])
            np.copyto(out, radians, casting="same_kind")

        return self._program.step("reduce what is far from half a turn", "single", run, read)

    def _angles(self, value: Node) -> Angles | None:
        """Angles that lie around one of their packet or block; None where they do not, or nobody knows."""
        if value not in self._around:
            flat, full = self._parts(value)
            product, ranges = self._product(flat, full), [self._range(part) for part in full]
            more = float(sum(low for low, _ in ranges)), float(sum(high for _, high in ranges))
            found = self._around[value] = None if product is None else Angles.of(product, more)
            self._program.low += [] if found is None else found.nodes
        return self._around[value]

    def sum(self, node: Node) -> int | None:
        """A sum: one matrix product for what is low, and what is full added to it."""
        flat, full = self._parts(node)
        product = self._product(flat, full)
        if product is None:
            return None
        self._program.low += product.nodes
        return self._added(product.rows, -1 - len(self._program.steps), lambda run: (product.left(run),), full)

    def _parts(self, node: Node) -> tuple[list[Term], list[Term]]:
        parts = terms(node, self._program.width)
        return [part for part in parts if part.full is None], [part for part in parts if part.full is not None]

    def _product(self, flat: list[Term], full: list[Term]) -> Product | None:
        """What is low in a sum; None where its axes cross, or there is nothing."""
        level = split_level(flat, len(self._program.shape))
        return None if level is None or not flat or any(part.row.ndim for part in full) else Product.of(flat, self._program.shape, level)

    def _added(self, rows: NDArray[Any], place: int, left: Callable[[Run], tuple[Any, ...]], full: list[Term]) -> int:
        """A matrix product of numbers, made for the batch at its first chunk, and rows; what is full is added to it."""
        inner = rows.shape[1]

        def run(execution: Run, out: NDArray[Any]) -> None:
            if place not in execution.prepared:
                execution.prepared[place] = left(execution)
            numbers = execution.prepared[place][0]
            multiplied(numbers[:, _rows(execution, numbers)].T, rows, out.reshape(-1, inner))

        found = self._program.step(f"sum of {len(rows)} products", "double", run)
        for part in full:
            found = self._plus(found, part)
        return found

    def _plus(self, sum_: int, part: Term) -> int:
        """A sum and what is full."""
        assert part.full is not None
        factor, options = float(part.row), chosen(part.full, self._program.width)
        if options is None:
            return self._program.call("add", "double", np.add, Read(sum_), Read(self._scaled(part.full, factor)))
        condition, *values = options
        first, second = (Read(self._scaled(value, factor)) if isinstance(value, Node) else Number(value * factor) for value in values)
        self._program.low.append(condition)
        shape, depth = self._program.shape, len(self._program.shape)

        def run(execution: Run, out: NDArray[Any]) -> None:
            flags = execution.part(execution.values(condition)).astype(np.bool_)
            if flags.all() or not flags.any():
                np.add(sum_read(execution), (first if flags.any() else second)(execution), out=out)
                return
            either = (np.asarray(read(execution)) for read in (first, second))
            added = np.where(deep(flags, depth), *(array.reshape(-1, *shape) if array.ndim else array for array in either))
            np.add(sum_read(execution), added.reshape(-1), out=out)

        sum_read = Read(sum_)
        return self._program.step("add one of two", "double", run, sum_read, first, second)

    def _scaled(self, node: Node, factor: float) -> int:
        """What is full times a number, in float64; the number is part of the table where there is one."""
        found = self._program.field(node, "double", factor)
        if found is not None:
            return found
        read = Read(self._program.double(node))
        if factor == 1:
            return read.register
        return self._program.step(f"times {factor:.6g}", "double", lambda run, out: np.multiply(read(run), factor, out=out), read)

    def _range(self, part: Term) -> tuple[float, float]:
        """The least and the most of what is full in a sum; infinite where it is not known."""
        assert part.full is not None
        options = chosen(part.full, self._program.width)
        values = np.concatenate([self._every(value) for value in ((part.full,) if options is None else options[1:])])
        found = np.outer(values, part.row.reshape(-1))
        return float(found.min()), float(found.max())

    def _every(self, value: Any) -> NDArray[Any]:
        """All values that an expression of one field can have."""
        if not isinstance(value, Node):
            return np.array([value])
        values = possible(value, self._program.layout.leaves)
        return np.array([np.inf]) if values is None else values


def _rows(run: Run, numbers: NDArray[Any]) -> slice:
    """The columns of a left side that belong to the chunk: one for each packet, or several."""
    each = numbers.shape[1] // len(run.rows)
    return slice(run.start * each, run.stop * each)


def _shared_by(angles: Angles, run: Run) -> NDArray[np.float32]:
    """The angle that all points of each packet or block have."""
    if angles not in run.prepared:
        run.prepared[angles] = angles.left(run)[0][0].astype(np.float32)
    found: NDArray[np.float32] = run.prepared[angles]
    return found
