"""From a plan's expressions to the steps of a program.

What depends on one field of two bytes or less is a table by its raw value, or its bits as they
stand (`points.windows`). Sums, and the sines and cosines of angles that are near each other, are
matrix products where they can be (`products`); only what is left is computed in full, angles
reduced to half a turn before they become float32. Everything else is ordinary NumPy, and what is
not full is known before.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.graph import (
    Node,
    Term,
    chosen,
    is_full,
    is_nan_where,
    key,
    last_axis,
    only_field,
)
from lidarspec.frames.arrays import deep
from lidarspec.frames.layout import Leaf
from lidarspec.points.conventions import returned_range
from lidarspec.points.numpy_plan import products
from lidarspec.points.numpy_plan.blocks import Blocks
from lidarspec.points.numpy_plan.program import Program, Read, Run
from lidarspec.points.numpy_plan.registers import TYPES
from lidarspec.points.plan import Plan
from lidarspec.points.windows import (
    CHEAP,
    Window,
    beam_of,
    every_value,
    run_of,
    shift_of,
    window,
    word_of,
)
from lidarspec.spec.tree import FieldInfo
from lidarspec.spec.vocabulary import row_numbers

_Made = TypeVar("_Made")

#: how often a table is repeated at most, so that rows that follow one another round its end follow
#: one another in it.
TURNS = 8

#: metres up to which a few roundings of float32 leave coordinates within 0.01 mm.
FINE = 64

#: what is computed faster than looked up in a table of 65,536 float64 numbers.
_QUICK = {function for function in CHEAP if isinstance(function, np.ufunc)}


class Compiler:
    """Appends the steps of expressions to a program; each method gives the register of its result.

    Attributes:
        program: with the columns that were wanted.
        low: the nodes whose plain results it needs.
    """

    def __init__(self, plan: Plan, tables: dict[Any, NDArray[Any]]) -> None:
        self.program = Program(plan.width, plan.safe)
        self.low = list[Node]()
        self._layout = plan.layout
        self._shape = plan.shape
        self._width = plan.width
        self._tables = tables
        self._known: dict[Any, Any] = {}
        self._exact = False
        self._shared = set[int]()

    def want(self, name: str, value: Any, kind: str, *, exact: bool = False) -> None:
        """Make a column of this name.

        Args:
            kind: "single" or "double".
            exact: computed in float64, each operation as it is written; else products may be
                float32, and sums in another order.
        """
        self._exact = exact
        if kind == "single":
            self.program.outputs[name] = self._single(value)
        else:
            self.program.outputs[name] = self._double(value)

    def want_sent(self, name: str, leaf: Leaf) -> None:
        """Make a column of whole numbers of a field, as they were sent."""
        assert leaf.info.dtype is not None
        kind = f"{leaf.info.dtype.kind}{leaf.info.dtype.itemsize}"
        if leaf.wire is None or self._is_shared(leaf):
            register = self._cut_out(leaf, kind)
        else:
            register = None
        if register is None and leaf.wire is not None:
            register = self._load(leaf, Window(leaf.offset, leaf.size), leaf.wire, kind)
        if register is None:
            register = self.program.step(
                f"{leaf.info.path} as it was sent",
                kind,
                lambda run, out: np.copyto(
                    out.reshape(-1, *leaf.shape), leaf.load(run.rows[run.start : run.stop])
                ),
            )
        self.program.outputs[name] = register

    def share(self, leaves: Iterable[Leaf]) -> None:
        """Load words once that several of these fields stand in, each to be cut out of its word."""
        words = Counter(
            word[0] for leaf in leaves if (word := word_of(leaf, self._layout)) is not None
        )
        self._shared = {word for word, count in words.items() if count > 1}

    def _is_shared(self, leaf: Leaf) -> bool:
        word = word_of(leaf, self._layout)
        return word is not None and word[0] in self._shared

    def _once(self, name: Any, make: Callable[[], _Made]) -> _Made:
        """What was made under this name: a register, or what says how to make one."""
        if name not in self._known:
            self._known[name] = make()
        return self._known[name]  # type: ignore[no-any-return]

    def _single(self, value: Any) -> int:
        """An expression in float32; only products and tables are computed in that precision."""
        if not is_full(value, self._width):
            return self._spread(value, "single")
        return self._once(("single", self._exact, value), lambda: self._full_single(value))

    def _full_single(self, node: Node) -> int:
        if node.kind == "rows":
            register = self._gathered(node, "single")
        else:
            register = self._of_field(node, "single")
        if register is None:
            register = self._marked(node, "single")
        if register is None and not self._exact:
            register = self._product(node)
        if register is not None:
            return register
        read = Read(self._double(node))
        return self.program.step(
            "as float32",
            "single",
            lambda run, out: np.copyto(out, read(run), casting="same_kind"),
            read,
        )

    def _product(self, node: Node) -> int | None:
        """A product or a direction in float32; None where it is none."""
        if node.kind == "call" and node.function in (np.cos, np.sin):
            return self._direction(node)
        is_offset = node.function is np.add and any(not isinstance(arg, Node) for arg in node.args)
        if node.kind == "call" and (node.function is np.multiply or is_offset):
            first, second = (self._factor(arg) for arg in node.args)
            return self.program.call(node.function.__name__, "single", node.function, first, second)
        if node.kind == "call" and node.function is np.add:
            return self._along_beams(node)
        return None

    def _along_beams(self, node: Node) -> int | None:
        """Return distances along beams: a sum of a product with rows and the start.

        Returns None for other sums.

        Points up to `FINE` metres away are float32 throughout. Rows that reach farther are computed
        again in float64.
        """
        beam = beam_of(node, self._layout.leaves)
        if beam is not None:
            parts = [self._gathered(rows, "single") for rows in (beam.direction, beam.start)]
        else:
            parts = [None]
        if beam is None or None in parts:
            return None
        distance, direction, start, step = beam
        measured, toward, begin = (
            Read(self._single(distance)),
            *(Read(part) for part in parts if part is not None),
        )
        inner = direction.args[1].shape[1]
        place = ("far", distance)

        def far(run: Run) -> tuple[int, NDArray[np.intp], NDArray[np.float64]]:
            """Return the start of the chunk, its rows with far points, and their distances.

            The distances are the raw values.
            """
            if run.prepared.get(place, (-1,))[0] != run.start:
                rows = measured(run).reshape(-1, inner)
                if np.fmax.reduce(rows, axis=None) > FINE:
                    which = np.flatnonzero(np.fmax.reduce(rows, axis=1) > FINE)
                else:
                    which = _NOWHERE
                distances = np.multiply(rows[which], 1 / step, dtype=np.float64)
                np.multiply(np.rint(distances, out=distances), step, out=distances)
                run.prepared[place] = run.start, which, distances
            found: tuple[int, NDArray[np.intp], NDArray[np.float64]] = run.prepared[place]
            return found

        def row(rows: Node, run: Run, which: NDArray[np.intp]) -> NDArray[np.float64]:
            index, table = rows.args
            numbers = run.prepared["rows", index, len(table) - 1][0]
            chosen: NDArray[np.float64] = table.take(
                numbers[_rows(run, numbers[None])][which], axis=0
            )
            return chosen

        def run(execution: Run, out: NDArray[Any]) -> None:
            np.multiply(measured(execution), toward(execution), out=out)
            np.add(out, begin(execution), out=out)
            _, which, distances = far(execution)
            if len(which):
                exact = row(direction, execution, which)
                exact *= distances
                exact += row(start, execution, which)
                out.reshape(-1, inner)[which] = exact

        return self.program.step(
            "along beams, float64 where they are long", "single", run, measured, toward, begin
        )

    def _double(self, value: Any) -> int:
        """An expression in float64, or a condition."""
        if not is_full(value, self._width):
            return self._spread(value, "double")
        return self._once(("double", self._exact, value), lambda: self._full_double(value))

    def _full_double(self, node: Node) -> int:
        if node.sample.array.dtype.kind == "b":
            kind = "flag"
        else:
            kind = "double"
        if node.kind == "rows":
            register = self._gathered(node, kind)
        else:
            register = self._of_field(node, kind)
        if register is None and node.kind == "call":
            register = self._marked(node, kind)
            if register is None and not self._exact:
                register = self._sum(node)
            if register is None:
                register = self._plain(node, kind)
        if register is not None:
            return register
        return self._spread(node, kind)

    def _marked(self, node: Node, kind: str) -> int | None:
        """Return a value, or nan if a condition says so or there is no return.

        No branch is used. Returns None for other expressions.
        """
        if node.kind != "call" or not is_full(value := node.args[-1], self._width):
            return None
        if node.function is returned_range:
            return self._returned(value, kind, None)
        condition = node.args[0]
        if (
            not is_nan_where(node)
            or not isinstance(condition, Node)
            or condition.sample.array.dtype.kind != "b"
        ):
            return None
        if value.function is returned_range and not is_full(condition, self._width):
            return self._returned(value.args[0], kind, condition)
        mark = self._mark(condition, kind)
        read = self._read(value, kind)
        is_each = is_full(condition, self._width)

        def run(execution: Run, out: NDArray[Any]) -> None:
            target = out.reshape(-1, *self._shape)
            marks = mark(execution)
            np.multiply(
                read(execution).reshape(target.shape),
                marks.reshape(target.shape) if is_each else marks,
                out=target,
            )

        return self.program.step("marked", kind, run, mark, read)

    def _mark(self, condition: Node, kind: str) -> Callable[[Run], Any]:
        """1, or nan where a condition holds: for each point, or what packets and blocks have."""
        depth = len(self._shape)
        marks = np.array([1, np.nan], TYPES[kind])
        if not is_full(condition, self._width):
            self.low.append(condition)
            return lambda run: marks[deep(run.part(run.values(condition)), depth).astype(np.intp)]

        def marked(execution: Run, out: NDArray[Any]) -> None:
            np.logical_not(flags(execution), out=out)
            np.divide(out, out, out=out)
            np.absolute(out, out=out)  # a nan without a sign, as np.nan is

        flags = Read(self._double(condition))
        return Read(
            self._once(
                ("mark", kind, condition),
                lambda: self.program.step("1, or nan", kind, marked, flags),
            )
        )

    def _returned(self, value: Node, kind: str, lost: Node | None) -> int:
        """Return ranges, nan without a return or for `lost` packets or blocks.

        A value divided by itself is 1 or nan.
        """
        read = self._read(value, kind)
        shape = self._shape
        depth = len(self._shape)
        self.low += [] if lost is None else [lost]
        leaf = self._layout.leaves.get(value.path)
        is_positive = (
            leaf is not None
            and leaf.info.dtype is not None
            and leaf.info.dtype.kind == "u"
            and min(leaf.info.scale, leaf.info.offset) >= 0
        )

        def run(execution: Run, out: NDArray[Any]) -> None:
            if is_positive:
                measured = read(execution)
            else:
                measured = np.maximum(read(execution), 0, out=out)
            np.divide(measured, measured, out=out)
            np.multiply(out, read(execution), out=out)
            if lost is not None:
                flags = execution.part(execution.values(lost))
            else:
                flags = _NONE
            if flags.any():
                np.copyto(out.reshape(-1, *shape), np.nan, where=deep(flags, depth))

        return self.program.step("what came back", kind, run, read)

    def _read(self, value: Node, kind: str) -> Read:
        """An expression as an argument, in float32 or float64."""
        return Read(self._single(value) if kind == "single" else self._double(value))

    def _of_field(self, node: Node, kind: str, factor: float = 1.0) -> int | None:
        """Return an expression of one field, times a number.

        It is loaded directly, or looked up by its window. Returns None if neither is possible.
        """
        source = only_field(node)
        if source is not None and is_full(source, self._width):
            leaf = self._layout.leaves.get(source.path)
        else:
            leaf = None
        seen = window(leaf) if leaf is not None else None
        if (
            leaf is not None
            and node is source
            and factor == 1
            and leaf.wire is not None
            and (seen is None or (self._exact and seen.size > 1))
        ):
            return self._whole(leaf, leaf.wire, kind)
        if leaf is not None and node is source and factor == 1 and seen is None:
            return self._cut_out(leaf, kind)
        if (
            leaf is None
            or source is None
            or seen is None
            or (self._exact and seen.size > 1 and node.function in _QUICK)
        ):
            return None
        shift = self._shift(leaf, seen)
        if node is source and factor == 1 and not leaf.info.scaled:
            if self._is_shared(leaf) and (register := self._cut_out(leaf, kind)) is not None:
                return register
            if shift == (0, (1 << 8 * seen.size) - 1):
                return self._load(leaf, seen, seen.dtype, kind)
            if shift is not None:
                return self._shifted(leaf, seen, *shift, kind)
            if leaf.wire is not None:
                return self._load(leaf, seen, leaf.wire, kind)
        index = self._once(("index", seen), lambda: self._load(leaf, seen, seen.dtype, "index"))
        if shift is not None and seen.size > 1:  # a smaller table stays nearer
            whole = Read(index)
            index = self._once(("index", seen, shift), lambda: self._cut(leaf, seen, *shift, whole))
        table = self._table(node, leaf, seen, kind, factor)
        text = (
            f"{node.path or source.path}: table of {len(table)} by {(len(table) - 1).bit_length()}"
            " bits"
        )
        read = Read(index)
        return self.program.step(
            text, kind, lambda run, out: table.take(read(run), out=out, mode="wrap"), read
        )

    def _whole(self, leaf: Leaf, wire: np.dtype[Any], kind: str) -> int | None:
        """A field of whole bytes, loaded; None where it has to be float64 first."""
        if kind == "single" and (wire.itemsize > 4 or not self._is_short(leaf)):
            return None
        return self._load(leaf, Window(leaf.offset, wire.itemsize), wire, kind)

    def _is_short(self, leaf: Leaf) -> bool:
        """Whether the raw number of a field may be brought to its unit in float32."""
        return not leaf.info.scaled or not (self._exact or leaf.info.offset)

    def _cut_out(self, leaf: Leaf, kind: str) -> int | None:
        """Return a field of contiguous bits, extracted from four bytes.

        Returns None if the bits are not contiguous, or if float64 is required first.
        """
        if kind == "single" and not self._is_short(leaf):
            return None
        word = word_of(leaf, self._layout)
        if word is not None and word[0] in self._shared:
            return self._shifted(leaf, Window(word[0], 4), *word[1:], kind)
        run = run_of(leaf)
        if run is None:
            return None
        order, first, count, lowest = run
        last = (
            self._layout.size
            - sum(
                (length - 1) * stride
                for length, stride in zip(leaf.shape, leaf.strides, strict=True)
            )
            - 4
        )
        blocks = self._blocks(leaf, Window(first, count))
        for start in (first, first + count - 4):
            if 0 <= start <= last and blocks.holds(Window(start, 4)):
                shift = lowest + 8 * (first - start if order == "<" else start + 4 - first - count)
                mask = (1 << leaf.info.bits) - 1
                return self._shifted(
                    leaf, Window(start, 4), shift, mask, kind, np.dtype(f"{order}u4")
                )
        return None

    def _shift(self, leaf: Leaf, seen: Window) -> tuple[int, int] | None:
        """Return the shift and mask that extract a field from a shared window.

        Returns None if a table is required.
        """
        if leaf.wire is not None:
            return None
        return self._once(("shift", leaf.info.path, seen), lambda: shift_of(leaf, seen))

    def _table(
        self, node: Node, leaf: Leaf, seen: Window, kind: str, factor: float
    ) -> NDArray[Any]:
        shift = self._shift(leaf, seen)
        name = (
            kind,
            seen.offset - leaf.offset,
            seen.size,
            leaf.size,
            shift,
            factor,
            leaf.info,
            key(node),
        )
        if name not in self._tables:
            values = np.asarray(every_value(node, leaf))
            if shift is not None and seen.size > 1:
                values = values[np.arange(shift[1] + 1) << shift[0]]
            self._tables[name] = np.ascontiguousarray(
                values if factor == 1 else values * factor, TYPES[kind]
            )
        return self._tables[name]

    def _load(self, leaf: Leaf, seen: Window, dtype: np.dtype[Any], kind: str) -> int:
        """A window of every element as it stands, in its unit where that is float64."""
        blocks = self._blocks(leaf, seen)
        width = self._width
        info = leaf.info
        is_scaled = kind in ("single", "double") and info.scaled

        def run(execution: Run, out: NDArray[Any]) -> None:
            column = execution.prepared[blocks].column(seen, execution.start, execution.stop, width)
            np.copyto(
                out.reshape(column.shape),
                column if column.dtype == dtype else column.view(dtype),
                casting="unsafe",
            )
            if is_scaled:
                _scale(out, info)

        return self.program.step(f"{leaf.info.path}: {dtype} at byte {seen.offset}", kind, run)

    def _shifted(
        self,
        leaf: Leaf,
        seen: Window,
        shift: int,
        mask: int,
        kind: str,
        dtype: np.dtype[Any] | None = None,
    ) -> int:
        """Return some bits of a window of every element, in the unit of the field.

        Args:
            dtype: the dtype of the window's word, if it is not little-endian.
        """
        words = f"u{seen.size}"
        dtype = dtype or seen.dtype
        word = Read(self._once((dtype, seen), lambda: self._load(leaf, seen, dtype, words)))
        is_whole = (
            kind in TYPES
            and TYPES[kind].kind in "iu"
            and mask == (1 << 8 * TYPES[kind].itemsize) - 1
        )  # which leaves off the rest
        read = Read(
            self._cut(
                leaf, seen, shift, (1 << 8 * seen.size) - 1 >> shift if is_whole else mask, word
            )
        )
        quick = np.dtype(
            f"i{seen.size}" if mask >> 8 * seen.size - 1 == 0 else words
        )  # signed ones become floats several at a time

        def run(execution: Run, out: NDArray[Any]) -> None:
            np.copyto(out, read(execution).view(quick), casting="unsafe")
            if leaf.info.scaled:
                _scale(out, leaf.info)

        return self.program.step(f"{leaf.info.path} as it stands", kind, run, read)

    def _cut(self, leaf: Leaf, seen: Window, shift: int, mask: int, word: Read) -> int:
        """Some bits of words, as words."""
        is_masked = mask < (1 << 8 * seen.size) - 1 >> shift
        if not is_masked and not shift:
            return word.register

        def run(execution: Run, out: NDArray[Any]) -> None:
            if shift:
                bits = np.right_shift(word(execution), shift, out=out)
            else:
                bits = word(execution)
            if is_masked:
                np.bitwise_and(bits, mask, out=out)

        text = f"{leaf.info.path}: {mask.bit_length()} bits from bit {shift} on"
        return self.program.step(text, self.program.kinds[word.register], run, word)

    def _blocks(self, leaf: Leaf, seen: Window) -> Blocks:
        """The blocks that a window of a field is loaded from."""
        for blocks in self.program.blocks:
            if blocks.shape == leaf.shape and blocks.holds(seen):
                return blocks
        beside = [
            other
            for other in self._layout.leaves.values()
            if (other.info.axes, other.shape) == (leaf.info.axes, leaf.shape)
        ]
        self.program.blocks.append(Blocks(beside or [leaf], self._layout.size))
        return self.program.blocks[-1]

    def _plain(self, node: Node, kind: str) -> int:
        """Any other function of arrays, as NumPy evaluates it."""
        depth = max(len(arg.shape) for arg in node.args if isinstance(arg, Node))
        reads = [self._argument(arg, depth) for arg in node.args]
        used = [Read(self._double(arg)) for arg in node.args if is_full(arg, self._width)]
        function = node.function
        shape = node.shape

        def run(execution: Run, out: NDArray[Any]) -> None:
            target = out.reshape(-1, *shape)
            if is_direct:
                function(*(read(execution) for read in reads), out=target)
            else:
                target[...] = function(*(read(execution) for read in reads))

        is_direct = isinstance(function, np.ufunc)
        return self.program.step(
            f"{getattr(function, '__name__', 'function')} as it stands", kind, run, *used
        )

    def _argument(self, value: Any, depth: int) -> Callable[[Run], Any]:
        if not isinstance(value, Node):
            return _always(value)
        if is_full(value, self._width):
            read = Read(self._double(value))
            shape = (*value.shape, *(1,) * (depth - len(value.shape)))
            return lambda run: read(run).reshape(-1, *shape)
        self.low.append(value)
        return lambda run: deep(run.part(run.values(value)), depth)

    def _factor(self, value: Any) -> Callable[[Run], Any]:
        """Return a factor of a float32 product.

        It is a register, a number, or a row repeated for the whole chunk.
        """
        if is_full(value, self._width):
            return Read(self._single(value))
        if not isinstance(value, Node) and np.size(value) == 1:
            return _always(np.float32(np.asarray(value).reshape(())))
        return Read(self._once(("row", id(value)), lambda: self._spread(value, "single")))

    def _spread(self, value: Any, kind: str) -> int:
        """What is not full, for every point."""
        if not isinstance(value, Node):
            return self.program.tiled(
                np.broadcast_to(np.asarray(value, TYPES[kind]), self._shape).reshape(-1), kind
            )
        self.low.append(value)
        if value.width == math.prod(self._shape[: last_axis(value.shape)]):
            return self.program.repeated(
                "computed plainly before", kind, lambda run: run.values(value)
            )
        shape = self._shape
        depth = len(self._shape)

        def run(execution: Run, out: NDArray[Any]) -> None:
            out.reshape(-1, *shape)[...] = deep(execution.part(execution.values(value)), depth)

        return self.program.step("computed plainly before", kind, run)

    def _gathered(self, node: Node, kind: str) -> int | None:
        """Rows of a table, each as long as the innermost arrays; None where they are not."""
        index, table = node.args
        inner = table.shape[1]
        if is_full(index, self._width) or inner != math.prod(self._shape[last_axis(index.shape) :]):
            return None
        self.low.append(index)
        number = len(table) - 1
        if number:
            times = 1 + -(-self.program.most * index.width // number)
        else:
            times = 1
        times = times if times <= TURNS else 1
        rows = self._once(
            ("rows", id(table), kind),
            lambda: np.concatenate([np.tile(table[:-1], (times, 1)), table[-1:]]).astype(
                TYPES[kind]
            ),
        )
        register = len(self.program.kinds)
        place = ("rows", index, number)

        def run(execution: Run, out: NDArray[Any]) -> None:
            if place not in execution.prepared:
                execution.prepared[place] = _numbers(execution, index, number)
            every, breaks = execution.prepared[place]
            each = _rows(execution, every[None])
            numbers = every[each]
            first = int(every[each.start])
            last = first + len(numbers)
            if (
                first < number and last < len(rows) and not breaks[each.start : each.stop - 1].any()
            ):  # they are looked at where they are
                execution.views[register] = rows[first:last].reshape(-1)
            else:
                rows[(times - 1) * number :].take(
                    numbers, axis=0, out=out.reshape(-1, inner), mode="clip"
                )

        return self.program.step(f"rows of a table of {number} x {inner}", kind, run)

    def _direction(self, node: Node) -> int:
        """Return a cosine or sine.

        If all points of a packet or block have nearly the same angle, it is computed once for them.
        """
        value = node.args[0]
        function = node.function
        angles = self._angles(value)
        if angles is not None and angles.all_alike:
            name = f"{function.__name__} of each block"
            return self.program.repeated(
                name, "single", lambda run: function(_shared_by(angles, run))
            )
        rotation = self._rotation(value)
        if rotation is not None:
            return self._turned(
                function, rotation, self._once(("wide", value), lambda: self._wide(rotation))
            )
        angle = self._once(("angle", value), lambda: self._angle(value))
        return self.program.call(function.__name__, "single", function, Read(angle))

    def _rotation(self, value: Node) -> products.Rotation | None:
        angles = self._angles(value)
        if angles is None:
            return None
        return self._once(("rotation", value), lambda: products.Rotation.of(angles))

    def _wide(self, rotation: products.Rotation) -> int:
        """Return the angles of points that are too far apart for one rotation.

        They belong to whole packets or blocks, and are reduced to within half a turn.
        """

        def run(execution: Run, out: NDArray[Any]) -> None:
            if rotation not in execution.prepared:
                execution.prepared[rotation] = rotation.turns(execution)
            turns: products.Turns = execution.prepared[rotation]
            turns.move(execution.start, execution.stop)
            if turns.some_wide:
                out.reshape(-1, rotation.inner)[turns.wide] = turns.angles()

        return self.program.step("angles of what is wide", "single", run)

    def _turned(self, function: Any, rotation: products.Rotation, wide: int) -> int:
        """Return cosines or sines of angles close to the one in their middle.

        They are a matrix product of series.
        """
        read = Read(wide)
        which = 0 if function is np.cos else 1

        def run(execution: Run, out: NDArray[Any]) -> None:
            turns: products.Turns = execution.prepared[rotation]
            rows = out.reshape(-1, rotation.inner)
            if not turns.all_wide:
                turns.multiply(which, rows)
            if turns.some_wide:
                rows[turns.wide] = function(read(execution).reshape(-1, rotation.inner)[turns.wide])

        return self.program.step(
            f"{function.__name__} by {len(rotation.rows[0])} products", "single", run, read
        )

    def _angle(self, value: Node) -> int:
        """An angle in float32, reduced to half a turn either way before it loses precision."""
        angles = self._angles(value)
        if angles is not None:
            return self._near(value, angles)
        angle = self._double(value)
        turns = self.program.register("double")
        read = Read(angle)

        def run(execution: Run, out: NDArray[Any]) -> None:
            radians = read(execution)
            whole = execution.views[turns]
            np.multiply(radians, 1 / products.TURN, out=whole)
            np.rint(whole, out=whole)
            np.multiply(whole, products.TURN, out=whole)
            np.subtract(radians, whole, out=whole)
            np.copyto(out, whole, casting="same_kind")

        return self.program.step("reduce to half a turn", "single", run, read, Read(turns))

    def _near(self, value: Node, angles: products.Angles) -> int:
        """Return angles that vary around one angle, reduced together.

        Most of them need no reduction of their own.
        """
        read = Read(
            self._added(
                angles.around.rows, angles.left, angles, products.split(value, self._width)[1]
            )
        )

        def run(execution: Run, out: NDArray[Any]) -> None:
            radians, (numbers, far) = read(execution), execution.prepared[angles]
            places = np.flatnonzero(far[_rows(execution, numbers)])
            if len(places):
                rows = radians.reshape(-1, angles.around.inner)
                rows[places] = products.reduced(rows[places])
            np.copyto(out, radians, casting="same_kind")

        return self.program.step("reduce what is far from half a turn", "single", run, read)

    def _angles(self, value: Node) -> products.Angles | None:
        """Return angles that vary around one angle of their packet or block.

        Returns None if they do not, or if this is not known.
        """
        angles = self._once(
            ("angles", value), lambda: products.angles_of(value, self._shape, self._layout.leaves)
        )
        self.low += [] if angles is None else angles.nodes
        return angles

    def _sum(self, node: Node) -> int | None:
        """A sum: one matrix product for what is low, and what is full added to it."""
        product = products.product_of(node, self._shape)
        if product is None:
            return None
        self.low += product.nodes
        return self._added(
            product.rows,
            lambda run: (product.left(run),),
            product,
            products.split(node, self._width)[1],
        )

    def _added(
        self,
        rows: NDArray[Any],
        left: Callable[[Run], tuple[Any, ...]],
        place: Any,
        full: list[Term],
    ) -> int:
        """A matrix product of numbers and rows; what is full is added to it.

        Args:
            left: makes the numbers, for the batch at its first chunk.
            place: where they are kept for the other chunks.
        """
        inner = rows.shape[-1]

        def run(execution: Run, out: NDArray[Any]) -> None:
            if place not in execution.prepared:
                execution.prepared[place] = left(execution)
            numbers = execution.prepared[place][0]
            products.multiplied(
                numbers[:, _rows(execution, numbers)].T, rows, out.reshape(-1, inner)
            )

        register = self.program.step(f"sum of {len(rows)} products", "double", run)
        for part in full:
            register = self._plus(register, part)
        return register

    def _plus(self, sum_: int, part: Term) -> int:
        """A sum and what is full."""
        assert part.full is not None
        factor = float(part.row)
        options = chosen(part.full, self._width)
        if options is None:
            return self.program.call(
                "add", "double", np.add, Read(sum_), Read(self._scaled(part.full, factor))
            )
        condition, *values = options
        first, second = (
            (
                Read(self._scaled(value, factor))
                if isinstance(value, Node)
                else _always(value * factor)
            )
            for value in values
        )
        self.low.append(condition)
        shape = self._shape
        depth = len(self._shape)
        before = Read(sum_)

        def run(execution: Run, out: NDArray[Any]) -> None:
            flags = execution.part(execution.values(condition)).astype(np.bool_)
            if flags.all() or not flags.any():
                np.add(before(execution), (first if flags.any() else second)(execution), out=out)
                return
            either = (np.asarray(read(execution)) for read in (first, second))
            added = np.where(
                deep(flags, depth),
                *(array.reshape(-1, *shape) if array.ndim else array for array in either),
            )
            np.add(before(execution), added.reshape(-1), out=out)

        return self.program.step("add one of two", "double", run, before, first, second)

    def _scaled(self, node: Node, factor: float) -> int:
        """Return an expression with a value for each point, times a number, in float64.

        If the expression has a table, the number is part of it.
        """
        register = self._of_field(node, "double", factor)
        if register is not None:
            return register
        read = Read(self._double(node))
        if factor == 1:
            return read.register
        return self.program.step(
            f"times {factor:.6g}",
            "double",
            lambda run, out: np.multiply(read(run), factor, out=out),
            read,
        )


_NONE = np.zeros(0, np.bool_)
_NOWHERE = np.zeros(0, np.intp)


def _scale(out: NDArray[Any], info: FieldInfo) -> None:
    """Bring raw numbers to their unit, in place."""
    np.multiply(out, out.dtype.type(info.scale), out=out)
    if info.offset:
        np.add(out, out.dtype.type(info.offset), out=out)


def _always(value: Any) -> Callable[[Run], Any]:
    return lambda run: value


def _rows(run: Run, numbers: NDArray[Any]) -> slice:
    """The columns of a left side that belong to the chunk: one for each packet, or several."""
    each = numbers.shape[1] // len(run.rows)
    return slice(run.start * each, run.stop * each)


def _numbers(run: Run, index: Node, rows: int) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the table rows of all packets or blocks, (k,), and where they jump.

    A jump is a row that another than the next one follows.

    After the last one comes the first; the row of nan behind them is nobody's next.
    """
    numbers = np.broadcast_to(
        row_numbers(run.values(index), rows + 1), (len(run.rows), *index.shape)
    ).reshape(-1)
    step = numbers[1:] - numbers[:-1]
    return numbers, (step != 1) & (step != 1 - rows) | (numbers[1:] == rows)


def _shared_by(angles: products.Angles, run: Run) -> NDArray[np.float32]:
    """The angle that all points of each packet or block have."""
    name = ("alike", angles)
    if name not in run.prepared:
        run.prepared[name] = angles.left(run)[0][0].astype(np.float32)
    shared: NDArray[np.float32] = run.prepared[name]
    return shared
