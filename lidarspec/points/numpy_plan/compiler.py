"""Compile the expressions of a plan to the steps of a program.

Each step is one NumPy call for a chunk of packets. An expression of a field of at most two bytes
becomes a lookup in a table. An expression with one value for each packet or block is evaluated once
for the whole batch.

A column that need not be exact may be computed in float32, and its sums in another order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.graph import (
    Node,
    Term,
    count_used_axes,
    get_only_field,
    has_value_per_point,
    make_key,
    split_sum,
)
from lidarspec.frames.arrays import add_axes
from lidarspec.frames.layout import Leaf, view_elements
from lidarspec.points.lookup_tables import CHEAP, FieldWindow, find_window, tabulate_values
from lidarspec.points.numpy_plan.program import TYPES, Program, ProgramRun, RegisterRead
from lidarspec.points.plan import Plan
from lidarspec.spec.vocabulary import row_numbers

TURN_RAD = 2 * np.pi

#: Functions that are faster than a lookup in a table of 65,536 float64 numbers.
_FASTER_THAN_TABLE = {function for function in CHEAP if isinstance(function, np.ufunc)}


class Compiler:
    """Compiles expressions by appending steps to a program.

    Attributes:
        program: the program, with an output for each column that was added.
        low: the nodes with one value for each packet or block, which the reference evaluator
            computes and the program reads.
    """

    def __init__(self, plan: Plan, tables: dict[Any, NDArray[Any]]) -> None:
        self.program = Program(plan.width, plan.has_finite_directions)
        self.low = list[Node]()
        self._layout = plan.layout
        self._shape = plan.shape
        self._width = plan.width
        self._tables = tables
        self._registers: dict[Any, int] = {}
        self._is_exact = False

    def add_column(self, name: str, value: Any, kind: str, *, exact: bool) -> None:
        """Add an output column.

        Args:
            kind: the type of the column, "single" (float32) or "double" (float64).
            exact: whether to compute in float64 in the written order.
        """
        self._is_exact = exact
        if kind == "single":
            self.program.outputs[name] = self._compile_single(value)
        else:
            self.program.outputs[name] = self._compile_double(value)

    def add_integers(self, name: str, leaf: Leaf) -> None:
        """Add an output column with the raw integers of a field."""
        assert leaf.info.dtype is not None
        kind = f"{leaf.info.dtype.kind}{leaf.info.dtype.itemsize}"
        self.program.outputs[name] = self._load_raw(leaf, kind)

    def _make_once(self, name: Any, make: Callable[[], int]) -> int:
        """Return the register that is stored under a key; make it on first use."""
        if name not in self._registers:
            self._registers[name] = make()
        return self._registers[name]

    def _compile_single(self, value: Any) -> int:
        """Compile an expression to float32."""
        # Only products and tables are computed in float32; other results are converted.
        if not has_value_per_point(value, self._width):
            return self._broadcast(value, "single")
        return self._make_once(
            ("single", self._is_exact, value), lambda: self._compile_full_single(value)
        )

    def _compile_full_single(self, node: Node) -> int:
        register = self._compile_lookup(node, "single")
        if register is None and not self._is_exact:
            register = self._compile_product(node)
        if register is not None:
            return register
        read = RegisterRead(self._compile_double(node))
        return self.program.add_step(
            "as float32",
            "single",
            lambda run, out: np.copyto(out, read(run), casting="same_kind"),
            read,
        )

    def _compile_product(self, node: Node) -> int | None:
        """Compile a product, an offset, a cosine or a sine to float32, or return None."""
        if node.kind != "call":
            return None
        name = node.function.__name__
        if node.function in (np.cos, np.sin):
            return self._compile_direction(node.function, node.args[0])
        is_offset = node.function is np.add and any(not isinstance(arg, Node) for arg in node.args)
        if node.function is np.multiply or is_offset:
            first, second = (self._compile_factor(arg) for arg in node.args)
            return self.program.add_call(name, "single", node.function, first, second)
        return None

    def _compile_factor(self, value: Any) -> Callable[[ProgramRun], Any]:
        """Compile a factor of a float32 product; return a function that reads it."""
        if not isinstance(value, Node) and np.size(value) == 1:
            return _make_constant(np.float32(np.asarray(value).reshape(())))
        if has_value_per_point(value, self._width):
            return RegisterRead(self._compile_single(value))
        return RegisterRead(
            self._make_once(("factor", id(value)), lambda: self._broadcast(value, "single"))
        )

    def _compile_direction(self, function: np.ufunc, value: Node) -> int:
        """Compile the cosine or sine of an angle to float32."""
        parts = split_sum(value, self._width)
        is_fixed = all(part.low is None or part.row.size == 1 for part in parts)
        if is_fixed and all(part.full is None for part in parts):
            return self._compile_turned(function, parts)
        angle = self._make_once(("angle", value), lambda: self._compile_full_angle(value))
        return self.program.add_call(function.__name__, "single", function, RegisterRead(angle))

    def _compile_turned(self, function: np.ufunc, parts: list[Term]) -> int:
        """Compile the cosine or sine of a sum of angles."""
        # By the angle addition theorem, no cosine or sine has to be computed for each point.
        self.low += [part.low for part in parts if part.low is not None]
        depth = len(self._shape)
        fixed = sum(part.row for part in parts if part.low is None)
        fixed_cos = np.cos(fixed).astype(np.float32)
        fixed_sin = np.sin(fixed).astype(np.float32)
        moving = [(part.low, part.row) for part in parts if part.low is not None]

        def run(execution: ProgramRun, out: NDArray[Any]) -> None:
            target = out.reshape(-1, *self._shape)
            angle = sum(
                row * add_axes(execution.take_chunk(execution.values(low)), depth)
                for low, row in moving
            )
            near = (angle - np.rint(angle / TURN_RAD) * TURN_RAD).astype(np.float32)
            if function is np.cos:
                np.multiply(np.cos(near), fixed_cos, out=target)
                np.subtract(target, np.sin(near) * fixed_sin, out=target)
            else:
                np.multiply(np.sin(near), fixed_cos, out=target)
                np.add(target, np.cos(near) * fixed_sin, out=target)

        return self.program.add_step(f"{function.__name__} by addition", "single", run)

    def _compile_full_angle(self, value: Node) -> int:
        """Compile an angle to float32, wrapped to -pi to pi."""
        angle = RegisterRead(self._compile_double(value))
        scratch = RegisterRead(self.program.add_register("double"))

        def run(execution: ProgramRun, out: NDArray[Any]) -> None:
            radians = angle(execution)
            turns = scratch(execution)
            np.multiply(radians, 1 / TURN_RAD, out=turns)
            np.rint(turns, out=turns)
            np.multiply(turns, TURN_RAD, out=turns)
            np.subtract(radians, turns, out=out, casting="same_kind")

        return self.program.add_step("wrap the angle to [-pi, pi]", "single", run, angle, scratch)

    def _compile_double(self, value: Any) -> int:
        """Compile an expression to float64, or a condition to flags."""
        if not has_value_per_point(value, self._width):
            return self._broadcast(value, "double")
        return self._make_once(
            ("double", self._is_exact, value), lambda: self._compile_full_double(value)
        )

    def _compile_full_double(self, node: Node) -> int:
        if node.sample.array.dtype.kind == "b":
            kind = "flag"
        else:
            kind = "double"
        register = self._compile_lookup(node, kind)
        if register is None and node.kind == "call" and not self._is_exact:
            register = self._compile_sum(node)
        if register is None and node.kind == "call":
            register = self._compile_call(node, kind)
        if register is None:
            register = self._broadcast(node, kind)
        return register

    def _compile_lookup(self, node: Node, kind: str) -> int | None:
        """Compile a lookup of table rows, or an expression of one field, or return None."""
        if node.kind == "rows":
            return self._look_up_rows(node, kind)
        return self._compile_field(node, kind)

    def _compile_field(self, node: Node, kind: str) -> int | None:
        """Load a field or look it up in a table; return None if neither is possible."""
        source = get_only_field(node)
        if source is None or not has_value_per_point(source, self._width):
            return None
        leaf = self._layout.leaves.get(source.path)
        if leaf is None:
            return None
        field_window = find_window(leaf)
        is_long = field_window is None or (self._is_exact and field_window.size > 1)
        if node is source and (is_long or not leaf.info.scaled):
            return self._load_whole(leaf, kind)
        if field_window is None or (is_long and node.function in _FASTER_THAN_TABLE):
            return None
        index = RegisterRead(
            self._make_once(
                ("index", field_window, leaf.strides),
                lambda: self._load(leaf, field_window.dtype, field_window.offset, "index"),
            )
        )
        table = self._make_table(node, leaf, field_window, kind)
        return self.program.add_step(
            f"{node.path or source.path}: table of {len(table)} values",
            kind,
            lambda run, out: table.take(index(run), out=out, mode="wrap"),
            index,
        )

    def _make_table(
        self, node: Node, leaf: Leaf, field_window: FieldWindow, kind: str
    ) -> NDArray[Any]:
        """Return the value of an expression for each value of `field_window`."""
        name = (
            kind,
            field_window.offset - leaf.offset,
            field_window.size,
            leaf.size,
            leaf.info,
            make_key(node),
        )
        if name not in self._tables:
            values = tabulate_values(node, leaf)
            self._tables[name] = np.ascontiguousarray(values, TYPES[kind])
        return self._tables[name]

    def _load_whole(self, leaf: Leaf, kind: str) -> int | None:
        """Load a field and convert it to its unit; return None if this requires float64."""
        info = leaf.info
        assert info.dtype is not None
        if kind == "single" and (info.dtype.itemsize > 4 or (info.scaled and self._is_exact)):
            return None
        if kind == "single" and info.offset:
            return None

        register = self._load_raw(leaf, kind)
        if not info.scaled:
            return register
        raw = RegisterRead(register)

        def scale(execution: ProgramRun, out: NDArray[Any]) -> None:
            np.multiply(raw(execution), out.dtype.type(info.scale), out=out)
            if info.offset:
                np.add(out, out.dtype.type(info.offset), out=out)

        return self.program.add_step(f"{info.path} in its unit", kind, scale, raw)

    def _load_raw(self, leaf: Leaf, kind: str) -> int:
        """Load the raw values of a field."""
        if leaf.wire is not None:
            return self._load(leaf, leaf.wire, leaf.offset, kind)

        def run(execution: ProgramRun, out: NDArray[Any]) -> None:
            rows = execution.take_chunk(execution.rows)
            np.copyto(out.reshape(-1, *leaf.shape), leaf.load(rows), casting="unsafe")

        return self.program.add_step(f"{leaf.info.path}: bits", kind, run)

    def _load(self, leaf: Leaf, dtype: np.dtype[Any], offset: int, kind: str) -> int:
        """Load the bytes at an offset in every element of a field."""
        shape = leaf.shape[: len(leaf.strides)]

        def run(execution: ProgramRun, out: NDArray[Any]) -> None:
            rows = execution.take_chunk(execution.rows)
            column = view_elements(rows, dtype, offset, shape, leaf.strides)
            np.copyto(out.reshape(column.shape), column, casting="unsafe")

        return self.program.add_step(f"{leaf.info.path}: {dtype} at byte {offset}", kind, run)

    def _look_up_rows(self, node: Node, kind: str) -> int | None:
        """Compile a lookup of rows of a table.

        Returns None unless each row of the table has one value for each of the points that use the
        row, which are the points with the same index.
        """
        index, table = node.args
        inner = table.shape[1]
        inner_shape = self._shape[count_used_axes(index.shape) :]
        if has_value_per_point(index, self._width) or inner != int(np.prod(inner_shape)):
            return None
        self.low.append(index)
        rows = table.astype(TYPES[kind])

        def run(execution: ProgramRun, out: NDArray[Any]) -> None:
            numbers = row_numbers(execution.take_chunk(execution.values(index)), len(rows))
            packets = len(out) // self._width
            each = np.broadcast_to(numbers, (packets, *index.shape)).reshape(-1)
            rows.take(each, axis=0, out=out.reshape(-1, inner), mode="clip")

        return self.program.add_step(f"rows of a table of {len(table) - 1} x {inner}", kind, run)

    def _compile_sum(self, node: Node) -> int | None:
        """Compile a sum; terms with one value for each packet or block are added first."""
        parts = split_sum(node, self._width)
        low = [part for part in parts if part.full is None]
        full = [part for part in parts if part.full is not None]
        if not low or any(part.row.ndim for part in full):
            return None
        register = self._compile_low_sum(low)
        for part in full:
            register = self._add_term(register, part)
        return register

    def _compile_low_sum(self, parts: list[Term]) -> int:
        self.low += [part.low for part in parts if part.low is not None]
        shape = self._shape
        depth = len(shape)
        parts = sorted(parts, key=lambda part: part.row.size)  # small arrays are added first

        def product(execution: ProgramRun, part: Term) -> NDArray[Any]:
            if part.low is None:
                return part.row
            numbers = add_axes(execution.take_chunk(execution.values(part.low)), depth)
            return np.asarray(part.row * numbers)

        def run(execution: ProgramRun, out: NDArray[Any]) -> None:
            *others, last = [product(execution, part) for part in parts]
            np.add(sum(others), last, out=out.reshape(-1, *shape))

        return self.program.add_step(f"sum of {len(parts)} products", "double", run)

    def _add_term(self, sum_: int, part: Term) -> int:
        """Add a term to a sum. The term has a value for each point."""
        assert part.full is not None
        before = RegisterRead(sum_)
        full = RegisterRead(self._compile_double(part.full))
        factor = float(part.row)

        def run(execution: ProgramRun, out: NDArray[Any]) -> None:
            np.multiply(full(execution), factor, out=out)
            np.add(before(execution), out, out=out)

        return self.program.add_step(
            f"add a value multiplied by {factor:.6g}", "double", run, before, full
        )

    def _compile_call(self, node: Node, kind: str) -> int:
        """Compile a call that has no method of its own; NumPy evaluates it unchanged."""
        depth = max(len(arg.shape) for arg in node.args if isinstance(arg, Node))
        reads = [self._make_argument(arg, depth) for arg in node.args]
        used = [
            RegisterRead(self._compile_double(arg))
            for arg in node.args
            if has_value_per_point(arg, self._width)
        ]
        function = node.function
        is_direct = isinstance(function, np.ufunc)

        def run(execution: ProgramRun, out: NDArray[Any]) -> None:
            target = out.reshape(-1, *node.shape)
            if is_direct:
                function(*(read(execution) for read in reads), out=target)
            else:
                target[...] = function(*(read(execution) for read in reads))

        name = getattr(function, "__name__", "function")
        return self.program.add_step(f"copy {name}", kind, run, *used)

    def _make_argument(self, value: Any, depth: int) -> Callable[[ProgramRun], Any]:
        if not isinstance(value, Node):
            return _make_constant(value)
        if has_value_per_point(value, self._width):
            read = RegisterRead(self._compile_double(value))
            shape = (*value.shape, *(1,) * (depth - len(value.shape)))
            return lambda run: read(run).reshape(-1, *shape)
        self.low.append(value)
        return lambda run: add_axes(run.take_chunk(run.values(value)), depth)

    def _broadcast(self, value: Any, kind: str) -> int:
        """Broadcast a constant, or a value for each packet or block, to all points."""
        shape = self._shape
        if not isinstance(value, Node):
            return self.program.add_tile(
                np.broadcast_to(np.asarray(value, TYPES[kind]), shape), kind
            )
        self.low.append(value)
        depth = len(shape)

        def run(execution: ProgramRun, out: NDArray[Any]) -> None:
            out.reshape(-1, *shape)[...] = add_axes(
                execution.take_chunk(execution.values(value)), depth
            )

        return self.program.add_step("already computed per packet", kind, run)


def _make_constant(value: Any) -> Callable[[ProgramRun], Any]:
    return lambda run: value
