"""Write fields, tables, constants and indices into the source of a kernel.

`KernelWriter` keeps the lines of each loop, the arguments of the kernel, and the values that were
already written. Each value is computed in the outermost loop in which it is constant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Set
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.graph import FACTORS, Node, count_used_axes, make_key, traverse
from lidarspec.frames.layout import Layout, Leaf
from lidarspec.points.conventions import returned_range
from lidarspec.points.lookup_tables import CHEAP, find_window, raw_values, tabulate_values
from lidarspec.spec.bits import whole_bytes

_SIGNS = {
    np.add: "+",
    np.subtract: "-",
    np.multiply: "*",
    np.true_divide: "/",
    np.equal: "==",
    np.not_equal: "!=",
}
_SIGNS |= {np.less: "<", np.less_equal: "<=", np.greater: ">", np.greater_equal: ">="}

#: The text of NumPy's functions in a kernel. NumPy itself computes all other functions.
TEMPLATES: dict[Any, str] = {
    **{function: f"({{}} {sign} {{}})" for function, sign in _SIGNS.items()},
    **{
        function: f"({{}} * {FACTORS[function]!r})"
        for function in (np.deg2rad, np.radians, np.rad2deg, np.degrees)
    },
    **{
        function: f"np.{function.__name__}({{}})"
        for function in (np.floor, np.ceil, np.trunc, np.rint, np.sqrt, np.exp2)
    },
    **{
        function: f"math.{function.__name__}({{}})"
        for function in (np.sin, np.cos, np.tan, np.exp, np.isfinite, np.isnan)
    },
    **{
        np.arctan: "math.atan({})",
        np.arctan2: "math.atan2({}, {})",
        np.hypot: "math.hypot({}, {})",
    },
    **{
        np.mod: "modulo({}, {})",
        np.nan_to_num: "replace_nan({})",
        np.minimum: "minimum({}, {})",
        np.maximum: "maximum({}, {})",
    },
    returned_range: "mark_no_return({})",
    **{np.negative: "(-{})", np.positive: "{}", np.absolute: "abs({})"},
}

#: An expression with more operations than this is looked up in a table.
MAX_COMPUTED_OPERATIONS = 8


def is_cheap(node: Node) -> bool:
    """Return whether an expression of one field has only a few simple operations."""
    nodes = list(islice(traverse(node), MAX_COMPUTED_OPERATIONS + 1))
    return len(nodes) <= MAX_COMPUTED_OPERATIONS and all(
        this.kind != "call" or this.function in CHEAP for this in nodes
    )


def write_integer(leaf: Leaf, byte: Any) -> str | None:
    """Return the raw value of an integer field as an expression of the bytes of the field.

    Returns None for floating-point fields, integers of more than 48 bits, and arrays in bit blocks.

    Args:
        byte: a function that returns the expression of the byte at an offset.
    """
    if len(leaf.shape) > len(leaf.strides) or (leaf.wire is not None and leaf.wire.kind == "f"):
        return None
    order: Literal["little", "big"] = (
        "big" if leaf.wire is not None and leaf.wire.byteorder == ">" else "little"
    )
    if leaf.wire is None:
        element = leaf.elements[0]
    else:
        element = whole_bytes(leaf.wire.itemsize, order, signed=leaf.wire.kind == "i")
    if element.width > 48:
        return None
    parts = []
    for part in element.segments:
        bits = byte(leaf.offset + part.byte)
        if part.mask != 255:
            bits = f"({bits} & {part.mask})"
        bits = f"({bits} >> {part.low})" if part.low else bits
        parts.append(f"({bits} << {part.target})" if part.target else bits)
    total = f"({' | '.join(parts)})"
    sign = 1 << (element.width - 1)
    if element.signed:
        return f"(({total} ^ {sign}) - {sign})"
    return total


@dataclass(frozen=True)
class LinearTable:
    """A table with values that are a linear function of the raw value.

    Attributes:
        slope, start: the coefficients; the value is ``slope * raw + start``.
        low, high: the lowest and the highest raw value of the linear part; None without a limit.
        other: the value for all other raw values, nan or inf.
        exact: whether the arithmetic has to be float64.
    """

    slope: float
    start: float
    low: int | None
    high: int | None
    other: float
    exact: bool

    def text(self, raw: str) -> str:
        """Return the text of the value, given the text of the raw value."""
        if self.exact:
            expression = f"np.float32({raw} * {self.slope!r} + {self.start!r})"
        elif self.slope == 1 and self.start == 0:
            expression = f"np.float32(np.int32({raw}))"
        else:
            expression = f"(np.float32(np.int32({raw})) * np.float32({self.slope!r})" + (
                f" + np.float32({self.start!r}))" if self.start else ")"
            )
        tests = [
            f"{raw} {sign} {limit}"
            for sign, limit in ((">=", self.low), ("<=", self.high))
            if limit is not None
        ]
        if tests:
            return (
                f"({expression} if {' and '.join(tests)} else"
                f" np.float32({'nan' if np.isnan(self.other) else 'inf'}))"
            )
        return expression


def find_line(leaf: Leaf, values: NDArray[Any], *, exact: bool) -> LinearTable | None:
    """Return the linear function with the values of a table; None if it is not linear.

    Args:
        values: the values of the table.
        exact: whether the function has to return exactly the float32 values of the table.
    """
    field_window = find_window(leaf)
    assert field_window is not None
    raw = raw_values(leaf, field_window).astype(np.int64)
    good = np.isfinite(values)
    if not good.any():
        return None
    low = int(raw[good].min())
    high = int(raw[good].max())
    others = values[~good]
    if ((raw[~good] >= low) & (raw[~good] <= high)).any() or high == low:
        return None
    if len(others) and not (np.isnan(others).all() or (others == np.inf).all()):
        return None
    first = float(values[raw == low][0])
    last = float(values[raw == high][0])
    slope = (last - first) / (high - low)
    start = first - slope * low
    start = 0.0 if abs(start) < 1e-9 * abs(slope) else float(f"{start:.12g}")
    slope = float(f"{slope:.12g}")
    wanted = values[good].astype(np.float32)
    some = raw[good]
    limits = (low if (raw < low).any() else None, high if (raw > high).any() else None)
    other = float(others[0]) if len(others) else 0.0
    with np.errstate(all="ignore"):
        short = some.astype(np.float32) * np.float32(slope) + np.float32(start)
        apart = np.abs(short.astype(np.float64) - wanted)
        if (apart <= (0 if exact else np.spacing(np.abs(wanted)))).all():
            return LinearTable(slope, start, *limits, other, exact=False)
        long = (some * slope + start).astype(np.float32)
        if (
            np.abs(long.astype(np.float64) - wanted) <= (0 if exact else np.spacing(np.abs(wanted)))
        ).all():
            return LinearTable(slope, start, *limits, other, exact=True)
    return None


@dataclass(frozen=True)
class KernelValue:
    """The text of an expression in a kernel, and the loop in which its value varies.

    The level is 0 for a constant, 1 for the loop over packets, and more for inner loops.
    """

    text: str
    level: int


@dataclass
class KernelArguments:
    """The arguments of a kernel in addition to the bytes of the frames.

    Attributes:
        arrays: arrays that do not depend on data.
        numbers: lengths and offsets that differ from layout to layout.
        nodes: the nodes whose values NumPy computes before the kernel is called.
    """

    arrays: list[NDArray[Any]] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    nodes: list[Node] = field(default_factory=list)


def find_run(leaf: Leaf) -> tuple[str, int, int, int] | None:
    """Return which bytes contain an unsigned field.

    Returns:
        The byte order, the first byte, the number of bytes and the lowest bit; None if the field is
        not an unsigned integer in at most four consecutive bytes.
    """
    if len(leaf.shape) > len(leaf.strides):
        return None
    if leaf.wire is not None:
        is_whole = leaf.wire.kind == "u" and leaf.size <= 4
        if is_whole:
            return (">" if leaf.wire.byteorder == ">" else "<", leaf.offset, leaf.size, 0)
        return None
    if len(leaf.elements) != 1 or leaf.elements[0].signed:
        run = None
    else:
        run = leaf.elements[0].run
    if run is None or run[2] > 4:
        return None
    return (run[0], leaf.offset + run[1], run[2], run[3])


def find_word(leaf: Leaf, layout: Layout) -> tuple[int, int, int] | None:
    """Return the aligned 4-byte little-endian word that contains a field.

    Returns:
        The offset of the word, and the shift and mask of the field in it; None without such a word.
    """
    run = find_run(leaf)
    if run is None or (run[0] == ">" and run[2] > 1) or not leaf.strides or leaf.strides[-1] % 4:
        return None
    beside = [
        other
        for other in layout.leaves.values()
        if (other.info.axes, other.shape) == (leaf.info.axes, leaf.shape)
    ]
    _, first, count, lowest = run
    start = first - (first - min(other.offset for other in beside)) % 4
    last = (
        start
        + sum(
            (length - 1) * stride for length, stride in zip(leaf.shape, leaf.strides, strict=True)
        )
        + 4
    )
    if first + count <= start + 4 and last <= layout.size:
        return (start, 8 * (first - start) + lowest, (1 << leaf.info.bits) - 1)
    return None


class KernelWriter:
    """Writes the source lines of a kernel that compute values.

    Args:
        shape: the shape of the points of a packet.
        tables: the lookup tables by a key that describes their contents; new tables are added.
        varying: the arrays whose lengths differ from frame to frame.
    """

    def __init__(
        self,
        layout: Layout,
        shape: tuple[int, ...],
        tables: dict[Any, NDArray[Any]],
        varying: Set[str],
    ) -> None:
        self.layout = layout
        self.shape = shape
        self.width = math.prod(shape)
        self.varying = varying
        self.inner = 1 + count_used_axes(shape)
        self.wanted = KernelArguments()
        self.lines: list[list[str]] = [[] for _ in range(self.inner + 1)]
        self.angles: list[KernelValue] = []
        self.both: set[Node] = set()
        self._tables = tables
        self._known: dict[Any, Any] = {}
        self._made = 0

    def format_number(self, value: int) -> str:
        """Return the text of a length or offset: a number, or an argument if it varies."""
        if not self.varying or value in (0, 1):
            return str(value)
        self.wanted.numbers.append(value)
        return f"n{len(self.wanted.numbers) - 1}"

    def get_or_make(self, name: Any, make: Callable[[], Any]) -> Any:
        """Return the value that is stored under a key; make it on first use."""
        if name not in self._known:
            self._known[name] = make()
        return self._known[name]

    def let(self, level: int, text: str) -> KernelValue:
        """Assign a text to a new variable in a loop, and return the variable."""
        self._made += 1
        self.lines[level].append(f"v{self._made} = {text}")
        return KernelValue(f"v{self._made}", level)

    def index_text(self, shape: tuple[int, ...]) -> str:
        """Return the text of the current element's index in an array of this shape."""
        return self.format_index(
            shape,
            tuple(self.format_number(math.prod(shape[axis + 1 :])) for axis in range(len(shape))),
        )

    def format_index(self, shape: tuple[int, ...], strides: tuple[str, ...]) -> str:
        """Return the text of the current element's index in an array with these strides."""
        parts = [
            f"i{axis}" if stride == "1" else f"i{axis} * {stride}"
            for axis, (length, stride) in enumerate(zip(shape, strides, strict=True))
            if length > 1
        ]
        return " + ".join(parts) or "0"

    def add_array(self, values: NDArray[Any]) -> str:
        """Add a constant array to the arguments, flattened, and return its name."""
        flat = np.ascontiguousarray(values).reshape(-1)
        return str(
            self.get_or_make(("array", id(values)), lambda: (self._add_array(flat), values))[0]
        )

    def _add_array(self, flat: NDArray[Any]) -> str:
        self.wanted.arrays.append(flat)
        return f"c{len(self.wanted.arrays) - 1}"

    def write_constant(self, value: Any, depth: int, kind: str = "float64") -> KernelValue:
        """Return the text of a constant number, or of an element of a constant array."""
        array = np.asarray(value)
        if array.size == 1:
            number = (
                array.reshape(()).astype(np.float64 if array.dtype.kind != "b" else np.bool_).item()
            )
            return KernelValue(f"np.float32({number!r})" if kind == "float32" else repr(number), 0)
        shape = (1,) * (depth - array.ndim) + array.shape[max(array.ndim - depth, 0) :]
        name = self.add_array(
            self.get_or_make(("cast", id(value), kind), lambda: (array.astype(kind), value))[0]
        )
        element: KernelValue = self.get_or_make(
            ("element", name, shape),
            lambda: self.let(1 + count_used_axes(shape), f"at({name}, {self.index_text(shape)})"),
        )
        return element

    def add_argument(self, node: Node) -> KernelValue:
        """Add an argument with the values of a node, and return the text that reads it."""
        if node not in self.wanted.nodes:
            self.wanted.nodes.append(node)
        name = self.wanted.nodes.index(node)
        found = self.get_or_make(
            ("given", node),
            lambda: self.let(
                1 + count_used_axes(node.shape),
                f"at(g{name}, p * s{name} + {self.index_text(node.shape)})",
            ),
        )
        if node.sample.array.dtype.kind != "b":
            return found  # type: ignore[no-any-return]
        flag: KernelValue = self.get_or_make(
            ("given flag", node), lambda: self.let(found.level, f"{found.text} != 0")
        )
        return flag

    def write_raw(self, leaf: Leaf) -> KernelValue | None:
        """Return the text of a field's raw value; None if only NumPy can read the field."""
        if leaf.info.path not in self._known:
            self._known[leaf.info.path] = self._write_float(leaf) or self._write_integer(leaf)
        return self._known[leaf.info.path]  # type: ignore[no-any-return]

    def _write_integer(self, leaf: Leaf) -> KernelValue | None:
        word = None if self.varying else find_word(leaf, self.layout)
        if word is not None:
            place, shift, mask = word
            four = self._read(leaf, place, "four_at").text
            kind = "int32" if mask >> 31 == 0 else "int64"
            return self.let(
                1 + count_used_axes(leaf.shape),
                f"np.{kind}({four}{f' >> np.uint32({shift})' if shift else ''} &"
                f" np.uint32({mask}))",
            )
        text = write_integer(leaf, lambda offset: self.write_byte(leaf, offset).text)
        if text is None:
            return None
        return self.let(1 + count_used_axes(leaf.shape), text)

    def _write_float(self, leaf: Leaf) -> KernelValue | None:
        if leaf.wire is None or leaf.wire.kind != "f" or leaf.wire.itemsize < 4:
            return None
        order = "big" if leaf.wire.byteorder == ">" else "little"
        return self._read(leaf, leaf.offset, f"float{leaf.wire.itemsize}_{order}")

    def write_byte(self, leaf: Leaf, offset: int) -> KernelValue:
        """Return the text that reads a byte at an offset in an array element or a frame."""
        return self._read(leaf, offset, "byte_at")

    def _read(self, leaf: Leaf, offset: int, reader: str) -> KernelValue:
        """Return the text that reads a value at an offset in an array element or a frame.

        Args:
            reader: the name of the function in `arithmetic`.
        """
        shape = leaf.shape[: len(leaf.strides)]
        level = 1 + count_used_axes(leaf.shape[: len(leaf.strides)])
        steps = self.get_or_make(
            ("element", shape, leaf.strides),
            lambda: self.let(level, f"base + {self.format_index(shape, self._strides(leaf))}"),
        )
        if self._has_fixed_offset(leaf):
            place = str(offset)
        else:
            place = self.format_number(offset)
        return self.get_or_make(  # type: ignore[no-any-return]
            (reader, shape, leaf.strides, offset),
            lambda: self.let(level, f"{reader}(rows, {steps.text} + {place})"),
        )

    def _strides(self, leaf: Leaf) -> tuple[str, ...]:
        """Return the strides of a field's arrays, each as a number or an argument."""
        strides = [self.format_number(stride) for stride in leaf.strides]
        if leaf.strides and len(leaf.info.axes) == max(
            len(other.info.axes) for other in self.layout.leaves.values()
        ):
            strides[-1] = str(leaf.strides[-1])
        return tuple(strides)

    def _has_fixed_offset(self, leaf: Leaf) -> bool:
        """Return whether a field has the same offset in all frames."""
        leaves = self.layout.leaves.values()
        found = [
            (other.offset, other.strides)
            for other in leaves
            if any(axis in self.varying for axis in other.info.axes)
        ]
        first, strides = min(found, default=(self.layout.size, ()))
        inside = bool(strides) and leaf.strides == strides and leaf.offset - first < strides[-1]
        return leaf.offset <= first or inside

    def look_up(self, node: Node, source: Node, kind: Any, factor: float) -> KernelValue | None:
        """Return the text of a lookup that replaces an expression of one field.

        Returns None if the field is not in one or two bytes.

        Args:
            source: the field.
            kind: the dtype of the table.
            factor: a number by which the values are multiplied.
        """
        leaf = self.layout.leaves.get(source.path)
        field_window = find_window(leaf) if leaf is not None else None
        if leaf is None or field_window is None:
            return None
        table = self._make_table(node, leaf, kind, factor)
        return self.let(self.inner, f"at({self.add_array(table)}, {self._write_code(leaf)})")

    def _make_table(self, node: Node, leaf: Leaf, kind: Any, factor: float) -> NDArray[Any]:
        field_window = find_window(leaf)
        assert field_window is not None
        name = (
            "kernel",
            np.dtype(kind).name,
            factor,
            field_window.offset - leaf.offset,
            field_window.size,
            leaf.size,
            leaf.info,
            make_key(node),
        )
        if name not in self._tables:
            self._tables[name] = np.ascontiguousarray(
                np.asarray(tabulate_values(node, leaf)) * factor, kind
            )
        return self._tables[name]

    def _write_code(self, leaf: Leaf) -> str:
        field_window = find_window(leaf)
        assert field_window is not None
        first = self.write_byte(leaf, field_window.offset).text
        if field_window.size == 1:
            return first
        return f"({first} | {self.write_byte(leaf, field_window.offset + 1).text} << 8)"

    def look_up_trig(self, node: Node, leaf: Leaf) -> KernelValue:
        """Return the text of a lookup of a cosine or sine."""
        # The table has cosine and sine side by side, so that both are loaded together.
        name = ("kernel", "both", leaf.info, leaf.size, make_key(node.args[0]))
        if name not in self._tables:
            angles = np.asarray(tabulate_values(node.args[0], leaf))
            self._tables[name] = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(
                np.float32
            )
        table = self.add_array(self._tables[name])
        index = self.get_or_make(
            ("spot", name), lambda: self.let(self.inner, f"{self._write_code(leaf)} << 1")
        )
        return self.let(
            self.inner, f"at({table}, {index.text}{' + 1' if node.function is np.sin else ''})"
        )
