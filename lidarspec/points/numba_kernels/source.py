"""Write the source of a kernel that computes points from the bytes of frames.

A kernel is a nested loop over packets, blocks and points. Each value is computed in the outermost
loop in which it is constant. If a kernel cannot compute an expression, NumPy computes the values
before the kernel is called.

Sines and cosines that differ from point to point are computed in a second, flat loop, so that the
compiler can vectorize it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.graph import (
    FACTORS,
    Node,
    count_used_axes,
    get_only_field,
    has_value_per_point,
    is_nan_where,
    traverse,
)
from lidarspec.frames.layout import Leaf
from lidarspec.points.conventions import returned_range
from lidarspec.points.lookup_tables import (
    find_window,
    is_always_finite,
    list_possible_values,
    tabulate_values,
)
from lidarspec.points.numba_kernels.writer import (
    TEMPLATES,
    KernelArguments,
    KernelValue,
    KernelWriter,
    find_line,
    is_cheap,
)
from lidarspec.points.plan import Plan
from lidarspec.spec.vocabulary import TableLookup, stack_arrays

#: The number of points in scratch arrays, so that the arrays fit in the fastest cache.
SCRATCH_POINTS = 2048
#: A table of angles is float32 if no angle is larger than this, in half turns.
MAX_SINGLE_HALF_TURNS = 0.125
#: The largest number of bits of a distance for which float32 can represent all values.
MAX_DISTANCE_BITS = 21


class Beam(NamedTuple):
    """A coordinate of points along beams: ``distance * direction + start``.

    Attributes:
        distance: the raw distance; nan without a return.
        direction: the lookup in the table of directions.
        start: the lookup in the table of starting points.
        step: the distance of a raw value of 1, metres.
    """

    distance: Node
    direction: Node
    start: Node
    step: float


def find_beam(node: Node, leaves: Mapping[str, Leaf]) -> Beam | None:
    """Return an expression as a `Beam`; None if this is not possible."""
    if node.function is not np.add or not all(isinstance(arg, Node) for arg in node.args):
        return None
    product, start = node.args
    if (
        product.function is not np.multiply
        or start.kind != "rows"
        or not all(isinstance(arg, Node) for arg in product.args)
    ):
        return None
    distance, direction = product.args
    field = distance
    while is_nan_where(field) or field.function is returned_range:
        field = field.args[-1]
    if field.kind == "field" and direction.kind == "rows":
        leaf = leaves.get(field.path)
    else:
        leaf = None
    if (
        leaf is None
        or leaf.info.kind != "int"
        or leaf.info.bits > MAX_DISTANCE_BITS
        or leaf.info.offset
    ):
        return None
    return Beam(distance, direction, start, leaf.info.scale)


@dataclass(frozen=True, eq=False)
class DeferredFloat:
    """A product or sum in float32 that is computed in the flat loop over points.

    Attributes:
        sign: the operator, "*", "+" or "-".
    """

    sign: str
    parts: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class Trig:
    """The cosine or sine of an angle, computed in the flat loop over points.

    Attributes:
        angle: the index of the angle in `KernelWriter.angles`.
    """

    name: str
    angle: int


class Expressions(KernelWriter):
    """Writes traced expressions into the loops of a kernel."""

    def write_double(self, value: Any, depth: int = 0) -> KernelValue:
        """Return the code of an expression in float64, or of a condition."""
        if not isinstance(value, Node):
            return self.write_constant(value, depth)
        return self.get_or_make(("double", value), lambda: self._write_double(value))  # type: ignore[no-any-return]

    def _write_double(self, node: Node) -> KernelValue:
        if node.kind == "field":
            return self._write_physical(node)
        if node.kind == "call" and not self.uses_only_other_frames(node):
            source = get_only_field(node)
            if (
                source is not None
                and has_value_per_point(source, self.width)
                and not is_cheap(node)
            ):
                text = self.look_up(node, source, np.float64, 1.0)
                if text is not None:
                    if node.sample.array.dtype.kind == "b":
                        return self.let(text.level, f"{text.text} != 0")
                    return text
            return self._write_call(node)
        if node.kind == "rows" and not self.uses_only_other_frames(node.args[0]):
            return self._look_up_row(node, "float64")
        return self.add_argument(node)

    def _look_up_row(self, node: Node, kind: str, table: NDArray[Any] | None = None) -> KernelValue:
        """Return the code that reads an element of a table row.

        Args:
            kind: the dtype of the table in the kernel.
            table: a table to use in place of the table of the node.
        """
        index = node.args[0]
        table = node.args[1] if table is None else table
        row = self.write_double(index)
        start = self.get_or_make(
            ("row", index, table.shape),
            lambda: self.let(
                row.level,
                f"row_at({row.text}, {self.format_number(len(table))}) * {self.format_number(table.shape[1])}",
            ),
        )
        place = self.index_text(
            tuple(
                length if own == 1 else 1
                for own, length in zip(index.shape, node.shape, strict=True)
            )
        )
        name = self.add_array(
            self.get_or_make(
                ("cast", id(table), kind), lambda: (table.astype(kind, copy=False), table)
            )[0]
        )
        return self.let(1 + count_used_axes(node.shape), f"at({name}, {start.text} + {place})")

    def uses_only_other_frames(self, node: Node) -> bool:
        """Return whether an expression depends only on frames of other types."""
        # NumPy computes such an expression, usually once for all packets.
        return self.get_or_make(("shared", node), lambda: self._uses_only_other_frames(node))  # type: ignore[no-any-return]

    def _uses_only_other_frames(self, node: Node) -> bool:
        if node.kind in ("state", "on"):
            return node.kind == "state" or self.uses_only_other_frames(node.args[0])
        return node.kind == "call" and all(
            self.uses_only_other_frames(arg) for arg in node.args if isinstance(arg, Node)
        )

    def _write_call(self, node: Node) -> KernelValue:
        depth = max(len(arg.shape) for arg in node.args if isinstance(arg, Node))
        if any(
            np.ndim(arg) > depth + 1 or (np.ndim(arg) == depth + 1 and len(arg) != 1)
            for arg in node.args
            if not isinstance(arg, Node)
        ):
            return self.add_argument(node)
        if node.function is stack_arrays and len(node.shape) == depth + 1:
            parts = [self.write_double(arg, depth) for arg in node.args]
            chain = "".join(
                f"{part.text} if i{depth} == {at} else " for at, part in enumerate(parts[:-1])
            )
            if len(parts) > 1:
                return self.let(2 + depth, f"{chain}{parts[-1].text}")
            return parts[0]
        if len(node.shape) != depth:
            return self.add_argument(node)
        if isinstance(node.function, TableLookup) and len(node.function.entries):
            index = self.write_double(node.args[0])
            table = self.add_array(node.function.entries)
            return self.let(index.level, f"look_up({table}, {index.text})")
        if node.function is np.where and len(node.args) == 3:
            return self._write_where(*(self.write_double(arg, depth) for arg in node.args))
        template = self._find_template(node)
        if template is None:
            return self.add_argument(node)
        args = [self.write_double(arg, depth) for arg in node.args]
        return self.let(
            max(arg.level for arg in args), template.format(*(arg.text for arg in args))
        )

    def _find_template(self, node: Node) -> str | None:
        kinds = [
            arg.sample.array.dtype.kind if isinstance(arg, Node) else np.asarray(arg).dtype.kind
            for arg in node.args
        ]
        if all(kind == "b" for kind in kinds):
            logical: dict[Any, str] = {
                np.bitwise_and: "({} & {})",
                np.bitwise_or: "({} | {})",
                np.invert: "(not {})",
            }
            logical |= {
                np.logical_and: "({} & {})",
                np.logical_or: "({} | {})",
                np.logical_not: "(not {})",
            }
            return logical.get(node.function)
        template = TEMPLATES.get(node.function)
        if template is not None and template.count("{}") == len(node.args):
            return template
        return None

    def _write_where(
        self, condition: KernelValue, first: KernelValue, second: KernelValue
    ) -> KernelValue:
        level = max(condition.level, first.level, second.level)
        return self.let(level, f"{first.text} if {condition.text} else {second.text}")

    def _write_physical(self, node: Node) -> KernelValue:
        leaf = self.layout.leaves.get(node.path)
        raw = self.write_raw(leaf) if leaf is not None else None
        if raw is None or leaf is None:
            return self.add_argument(node)
        info = leaf.info
        return self.let(
            raw.level,
            (
                f"{raw.text} * {float(info.scale)!r} + {float(info.offset)!r}"
                if info.scaled
                else f"np.float64({raw.text})"
            ),
        )

    def write_single(self, value: Any, *, exact: bool = False, is_column: bool = False) -> Any:
        """Return the float32 code of an expression: a `KernelValue` or `DeferredFloat`.

        Args:
            exact: whether to compute the value in float64, and round only the result to float32.
            is_column: whether the expression is a whole column, such as a coordinate, and not a
                part of an expression. Unless `exact` is set, a sum that is a whole column is added
                in float32. Any other sum is added in float64, and then rounded.
        """
        if not isinstance(value, Node):
            return self.write_constant(value, len(self.shape), "float32")
        return self.get_or_make(
            ("single", value, exact),
            lambda: self._write_single(value, exact=exact, is_column=is_column),
        )

    def _write_single(self, node: Node, *, exact: bool, is_column: bool) -> Any:
        value = self._write_field(node, exact=exact)
        if value is not None:
            return value
        value = None if exact else self._write_distance(node)
        if value is not None:
            return value
        if has_value_per_point(node, self.width) and node.kind == "call" and not exact:
            beam = find_beam(node, self.layout.leaves) if is_column else None
            along = self._write_along_beam(beam) if beam is not None else None
            if along is not None:
                return along
            if node.function is np.multiply or (
                is_column and node.function in (np.add, np.subtract)
            ):
                sign = {np.multiply: "*", np.add: "+", np.subtract: "-"}[node.function]
                return self.combine(sign, *(self.write_single(arg) for arg in node.args))
            if node.function in (np.cos, np.sin) and has_value_per_point(node.args[0], self.width):
                return Trig(node.function.__name__, self.add_angle(node.args[0]))
        if node.kind == "rows" and not self.uses_only_other_frames(node.args[0]) and not exact:
            return self._look_up_row(node, "float32")
        made = self.write_double(node)
        return self.let(
            made.level, f"np.float32({made.text if not exact else f'replace_nan({made.text})'})"
        )

    def _write_along_beam(self, beam: Beam) -> KernelValue | None:
        """Return the code that computes a coordinate of points on a beam, rounded once."""
        # For more precision, the direction is split into two float32 numbers.
        sent = self._write_distance(beam.distance, raw=True)
        table = beam.direction.args[1]
        if (
            sent is None
            or self.uses_only_other_frames(beam.direction.args[0])
            or self.uses_only_other_frames(beam.start.args[0])
        ):
            return None
        high, low, _ = self.get_or_make(
            ("halves", id(table), beam.step), lambda: (*_split_halves(table * beam.step), table)
        )
        first, second = (self._look_up_row(beam.direction, "float32", half) for half in (high, low))
        return self.let(
            self.inner,
            f"multiply_add({sent.text}, {first.text}, multiply_add({sent.text}, {second.text},"
            f" {self._look_up_row(beam.start, 'float32').text}))",
        )

    def _write_distance(self, node: Node, *, raw: bool = False) -> KernelValue | None:
        """Return the code of a distance in float32; nan for points without a return.

        Args:
            raw: True for the raw value, False for metres.
        """
        if not has_value_per_point(node, self.width):
            return None
        if node.kind == "field":
            leaf = self.layout.leaves.get(node.path)
            is_short = (
                leaf is not None
                and leaf.info.kind == "int"
                and leaf.info.bits < 32
                and not leaf.info.offset
            )
            if leaf is not None and is_short:
                sent = self.write_raw(leaf)
            else:
                sent = None
            if leaf is not None and leaf.info.scaled and not raw:
                scale = f" * np.float32({float(leaf.info.scale)!r})"
            else:
                scale = ""
            if sent is None:
                return None
            return self.let(self.inner, f"np.float32(np.int32({sent.text})){scale}")
        if node.kind != "call" or not isinstance(node.args[-1], Node):
            return None
        if node.function is not returned_range and not is_nan_where(node):
            return None
        made = self.get_or_make(
            ("marked", node.args[-1], raw), lambda: self._write_distance(node.args[-1], raw=raw)
        )
        if made is None or node.function is returned_range:
            if made is None:
                return None
            return self.let(
                self.inner, f"{made.text} if np.float32(0) < {made.text} else np.float32(nan)"
            )
        flag = self.write_double(node.args[0], len(node.shape))
        return self.let(self.inner, f"np.float32(nan) if {flag.text} else {made.text}")

    def combine(self, sign: str, first: Any, second: Any) -> Any:
        """Return the code of a product or sum."""
        if isinstance(first, KernelValue) and isinstance(second, KernelValue):
            return self.let(max(first.level, second.level), f"{first.text} {sign} {second.text}")
        return DeferredFloat(sign, (first, second))

    def _write_field(self, node: Node, *, exact: bool) -> KernelValue | None:
        """Return the code of an expression of one field, a linear function or a lookup."""
        source = get_only_field(node)
        if source is not None and has_value_per_point(source, self.width):
            leaf = self.layout.leaves.get(source.path)
        else:
            leaf = None
        if leaf is None or source is None or find_window(leaf) is None:
            return None
        values = tabulate_values(node, leaf)
        assert values is not None
        straight = find_line(leaf, values, exact=exact)
        raw = self.write_raw(leaf) if straight is not None else None
        if straight is not None and raw is not None:
            return self.let(self.inner, straight.text(raw.text))
        if node.function in (np.cos, np.sin) and node.args[0] in self.both:
            return self.look_up_trig(node, leaf)
        return self.look_up(node, source, np.float32, 1.0)

    def add_angle(self, node: Node) -> int:
        """Return the index of an angle in `angles`; add the angle on first use."""

        def make() -> int:
            self.angles.append(self.write_angle(node, 1 / np.pi, len(node.shape)))
            return len(self.angles) - 1

        return int(self.get_or_make(("angle", node), make))

    def write_angle(self, value: Any, factor: float, depth: int) -> KernelValue:
        """Return the code of an angle in half turns, in float64.

        Args:
            factor: a number by which the angle is multiplied to get half turns.
        """
        if not isinstance(value, Node):
            return self.write_constant(np.asarray(value) * factor, depth)
        if (
            not has_value_per_point(value, self.width)
            or value.kind != "call"
            or self.uses_only_other_frames(value)
        ):
            return self._write_scaled(value, factor)
        source = get_only_field(value)
        if source is not None and not is_cheap(value):
            found = self._write_small_angle(value, source, factor)
            if found is not None:
                return found
            return self._write_scaled(value, factor)
        return self._write_angle(value, factor)

    def _write_angle(self, node: Node, factor: float) -> KernelValue:
        function = node.function
        args = node.args
        depth = max(len(arg.shape) for arg in args if isinstance(arg, Node))
        if function in FACTORS:
            return self.write_angle(args[0], factor * FACTORS[function], depth)
        if function in (np.add, np.subtract):
            first, second = (self.write_angle(arg, factor, depth) for arg in args)
            return self.let(
                max(first.level, second.level),
                f"{first.text} {'+' if function is np.add else '-'} {second.text}",
            )
        if function is np.multiply and any(not isinstance(arg, Node) for arg in args):
            constant, other = args if not isinstance(args[0], Node) else args[::-1]
            if np.size(constant) == 1:
                return self.write_angle(
                    other, factor * float(np.asarray(constant).reshape(())), depth
                )
            row = self.write_constant(np.asarray(constant) * factor, depth)
            made = self.write_double(other)
            return self.let(max(row.level, made.level), f"{made.text} * {row.text}")
        if function is np.where and len(args) == 3:
            return self._write_where(
                self.write_double(args[0], depth),
                *(self.write_angle(arg, factor, depth) for arg in args[1:]),
            )
        return self._write_scaled(node, factor)

    def _write_scaled(self, node: Node, factor: float) -> KernelValue:
        made = self.write_double(node)
        return self.let(made.level, f"{made.text} * {factor!r}")

    def _write_small_angle(self, node: Node, source: Node, factor: float) -> KernelValue | None:
        """Return the code that looks up an angle of one field; None if there is no table."""
        values = list_possible_values(node, self.layout.leaves)
        if values is None:
            return None
        with np.errstate(all="ignore"):
            short = bool(
                np.nanmax(np.abs(values[~np.isinf(values)] * factor), initial=0)
                <= MAX_SINGLE_HALF_TURNS
            )
        return self.look_up(node, source, np.float32 if short else np.float64, factor)


def _split_halves(values: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Split numbers into two float32 arrays with a more precise sum than one float32."""
    high = values.astype(np.float32)
    return high, (values - high).astype(np.float32)


HEAD = """\
import math

import numpy as np

from lidarspec.points.numba_kernels.arithmetic import (
    BYTES, DOUBLES, INTEGER, INTEGER_COLUMN, SINGLE_COLUMN, INTEGERS, SINGLES, WORDS,
    INTEGER_COLUMNS, assume_no_alias, at, byte_at, compile_kernel, cos_sin, float4_big, float4_little, float8_big, float8_little, four_at, look_up, mark_no_return,
    maximum, minimum, modulo, multiply_add, narrow_angle, put, replace_nan, row_at, word_at,
)

nan, inf = np.nan, np.inf


"""

_TYPES = {"float32": "SINGLES", "float64": "DOUBLES", "int64": "INTEGERS"}


@dataclass(frozen=True, eq=False)
class KernelText:
    """The text of a kernel, its arguments and its results.

    Attributes:
        source: the source of a module with the function `kernel`.
        wanted: the arguments of the kernel that depend on the plan.
        columns: the dtypes of the columns that it fills, by name.
    """

    source: str
    wanted: KernelArguments
    columns: Mapping[str, np.dtype[Any]]


class KernelAssembly:
    """Writes the lines of a kernel that store columns."""

    def __init__(self, writer: Expressions) -> None:
        self.writer = writer
        self.flat: list[str] = []
        self._kept: dict[str, str] = {}
        self.scratch: list[str] = []

    def store_column(self, name: str, value: Any) -> None:
        """Add the line that stores a column."""
        if isinstance(value, KernelValue):
            self.writer.lines[-1].append(f"put(out_{name}, o, {value.text})")
        else:
            self.flat.append(f"put(out_{name}, o, {self.text(value)})")

    def store_coordinates(self, values: Mapping[str, Any]) -> None:
        """Add the lines that store x, y and z; if one of them is nan, all become nan."""
        if all(isinstance(value, KernelValue) for value in values.values()):
            lines = self.writer.lines[-1]
            texts = {name: value.text for name, value in values.items()}
        else:
            lines = self.flat
            texts = {name: self.text(value) for name, value in values.items()}
        lines += [f"{name} = {text}" for name, text in texts.items()]
        lines.append(
            f"bad = np.float32({' + '.join(f'{name} * np.float32(0)' for name in values)})"
        )
        lines += [f"put(out_{name}, o, {name} + bad)" for name in values]

    def text(self, value: Any) -> str:
        """Return the text of an expression in the flat loop over points."""
        if isinstance(value, DeferredFloat):
            return f"({f' {value.sign} '.join(map(self.text, value.parts))})"
        if isinstance(value, Trig):
            return f"{value.name}{value.angle}"
        if value.level == 0:
            return str(value.text)
        return self._store(value, "float32")

    def _store(self, value: KernelValue, kind: str) -> str:
        """Add a scratch array for a value; return the text that reads it."""
        if value.text not in self._kept:
            name = self._kept[value.text] = f"h{len(self.scratch)}"
            self.scratch.append(f"{name} = np.empty(held, np.{kind})")
            self.writer.lines[-1].append(f"put({name}, k, {value.text})")
        return f"at({self._kept[value.text]}, k)"

    def list_trig_lines(self) -> list[str]:
        """Return the lines of the flat loop over points that compute cosines and sines."""
        return [
            f"cos{index}, sin{index} = cos_sin({self._store(made, 'float64')})"
            for index, made in enumerate(self.writer.angles)
        ]


def write_kernel(plan: Plan, names: tuple[str, ...], varying: Set[str]) -> KernelText:
    """Return the text of a kernel that computes some columns of a plan.

    Args:
        varying: the arrays whose lengths are arguments of the kernel; empty for a kernel of one
            layout.
    """
    expressions = {name: plan.expressions[name] for name in names}
    writer = Expressions(plan.layout, plan.shape, plan.tables, varying)
    assembly = KernelAssembly(writer)
    writer.both = _find_cos_sin_angles(expressions.values())
    made = {name: _make_value(writer, plan, name, value) for name, value in expressions.items()}
    columns = {
        name: plan.extra[name].dtype if name in plan.raw_fields else np.dtype(np.float32)
        for name in made
    }
    if plan.exact:
        directions = []
    else:
        directions = [*plan.directions, *(plan.parts[name] for name in ("ox", "oy", "oz"))]
    places = {}
    if not all(is_always_finite(value, plan.layout.leaves) for value in directions):
        # a nan in one coordinate makes all of them nan
        places = {name: value for name, value in made.items() if name in "xyz"}
    if places:
        assembly.store_coordinates(places)
    for name, value in made.items():
        if name not in places:
            assembly.store_column(name, value)
    trig_lines = assembly.list_trig_lines()
    return KernelText(
        HEAD + _write_function(writer, assembly, trig_lines, columns), writer.wanted, columns
    )


def _find_cos_sin_angles(expressions: Iterable[Any]) -> set[Node]:
    """Return each angle whose cosine and sine both occur in the expressions."""
    nodes = list(traverse(*expressions))
    cosines, sines = (
        {node.args[0] for node in nodes if node.function is function}
        for function in (np.cos, np.sin)
    )
    return {node for node in cosines & sines if isinstance(node, Node)}


def _make_value(writer: Expressions, plan: Plan, name: str, value: Any) -> Any:
    exact = plan.is_exact(name)
    if name in plan.raw_fields:
        raw = writer.write_raw(plan.raw_fields[name])
    else:
        raw = None
    if name in plan.raw_fields:
        made = raw or writer.write_double(value, len(writer.shape))
        return writer.let(made.level, f"np.{plan.extra[name].dtype}({made.text})")
    if name == "azimuth" or (exact and name != "intensity"):
        made = writer.write_double(value, len(writer.shape))
        return writer.let(
            made.level, f"{'narrow_angle' if name == 'azimuth' else 'np.float32'}({made.text})"
        )
    return writer.write_single(value, exact=name == "intensity", is_column=True)


def _write_function(
    writer: KernelWriter,
    assembly: KernelAssembly,
    trig_lines: list[str],
    columns: Mapping[str, np.dtype[Any]],
) -> str:
    """Return the source of the kernel's function, with its signature and its loops."""
    width = writer.format_number(writer.width)
    if trig_lines:
        held = writer.format_number(max(SCRATCH_POINTS // writer.width, 1))
    else:
        held = "count"
    loops = _write_loops(writer, width)
    wanted = writer.wanted
    parameters = [
        ("rows", "BYTES"),
        ("stride", "INTEGER"),
        ("first", "INTEGER"),
        ("count", "INTEGER"),
        ("numbers", "INTEGERS"),
    ]
    parameters += [
        (f"c{index}", _TYPES[array.dtype.name]) for index, array in enumerate(wanted.arrays)
    ]
    for index in range(len(wanted.nodes)):
        parameters += [(f"g{index}", "DOUBLES"), (f"s{index}", "INTEGER")]
    parameters += [
        (f"out_{name}", "SINGLE_COLUMN" if dtype.kind == "f" else f"INTEGER_COLUMNS['{dtype}']")
        for name, dtype in columns.items()
    ]
    arguments = ", ".join(name for name, _ in parameters)
    types = ", ".join(kind for _, kind in parameters)
    body = ["assume_no_alias()"] + [
        f"n{index} = at(numbers, {index})" for index in range(len(wanted.numbers))
    ]
    body += [f"step = {held}", f"held = step * {width}", *assembly.scratch, *writer.lines[0]]
    body += [
        "for begin in range(first, first + count, step):",
        "    end = min(begin + step, first + count)",
        "    start = begin * " + width,
    ]
    body += [
        "    for p in range(begin, end):",
        "        base = p * stride",
        *(f"        {text}" for text in loops),
    ]
    if trig_lines:
        body += [f"    for k in range((end - begin) * {width}):", "        o = start + k"]
        body += [f"        {text}" for text in (*trig_lines, *assembly.flat)]
    head = f'@compile_kernel(STORED, ({types},), error_model="numpy")\ndef kernel({arguments}):\n'
    return head + "".join(f"    {text}\n" for text in body)


def _write_loops(writer: KernelWriter, width: str) -> list[str]:
    """Return the lines inside the loop over packets."""
    lines = [*writer.lines[1]]
    depth = 0
    for level in range(2, writer.inner + 1):
        length = writer.shape[level - 2]
        if length > 1:
            lines.append(
                f"{'    ' * depth}for i{level - 2} in range({writer.format_number(length)}):"
            )
            depth += 1
        if level == writer.inner:
            lines += [f"{'    ' * depth}{text}" for text in _write_indices(writer, width)]
        lines += [f"{'    ' * depth}{text}" for text in writer.lines[level]]
    if writer.inner == 1:
        lines = [*_write_indices(writer, width), *lines]
    return lines


def _write_indices(writer: KernelWriter, width: str) -> list[str]:
    """Return the lines that compute a point's index in scratch arrays and columns."""
    return [f"k = (p - begin) * {width} + {writer.index_text(writer.shape)}", "o = start + k"]
