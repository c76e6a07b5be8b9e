"""Tables of fields by the one or two bytes that hold them: their windows.

A table has the result of an expression of one field for every value of these bytes.

An expression of one such field is a table of at most 65,536 entries by the raw value of its window,
made by evaluating the expression for every value: byte order, bits, scale, "0 is no return", sines
and cosines then cost nothing while decoding, and need no rule each. Both compilers of points use
these tables, and the plan asks them whether an expression can be anything but a number.

Windows of frames with a wire form are those of their structs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.graph import Expression, Node, is_nan_where, only_field
from lidarspec.frames.layout import Layout, Leaf
from lidarspec.points.conventions import returned_range

#: what costs hardly more than looking its result up; with these, whatever is made of numbers stays
#: a number.
CHEAP: set[Any] = {
    np.add,
    np.subtract,
    np.multiply,
    np.negative,
    np.positive,
    np.absolute,
    np.deg2rad,
    np.radians,
    np.minimum,
    np.maximum,
}
CHEAP |= {np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal, np.where}
#: bits of whole numbers whose multiples by a step, in float32, are told apart.
SHORT = 21
#: dividing by one of these numbers, or the rest of it, is a number too.
_DIVISIONS = {np.true_divide, np.mod}


@dataclass(frozen=True)
class Window:
    """The bytes of a field in its element, little-endian.

    They are `size` bytes from `offset` of the frame on. Tables are indexed by one or two bytes.
    """

    offset: int
    size: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type it is loaded as."""
        return np.dtype(f"<u{self.size}")


def window(leaf: Leaf) -> Window | None:
    """Return the window of a field.

    Returns None if it takes more than two bytes, or if it is an array inside a bit block.
    """
    if leaf.wire is not None:
        if leaf.wire.itemsize <= 2 and leaf.wire.kind in "iu":
            return Window(leaf.offset, leaf.wire.itemsize)
        return None
    if len(leaf.shape) > len(leaf.strides):
        return None
    start, stop = leaf.held
    if stop - start <= 2:
        return Window(start, stop - start)
    return None


def raw_values(leaf: Leaf, seen: Window) -> NDArray[Any]:
    """The raw values of a field for every value of its window: (256,) or (65536,)."""
    codes = np.arange(1 << (8 * seen.size)).astype(seen.dtype)
    frames = np.zeros((len(codes), leaf.size), np.uint8)
    start = seen.offset - leaf.offset
    frames[:, start : start + seen.size] = codes.view(np.uint8).reshape(len(codes), seen.size)
    single = Leaf(leaf.info, 0, (), (), leaf.size, leaf.wire, leaf.elements)
    return single.load(frames)


def shift_of(leaf: Leaf, seen: Window) -> tuple[int, int] | None:
    """Return the right shift and mask that give the raw value from a window.

    Returns None if these do not suffice.
    """
    raw = raw_values(leaf, seen).astype(np.int64)
    ones = np.flatnonzero(raw[1 << np.arange(8 * seen.size)] == 1)
    if not len(ones):
        return None
    shift = int(ones[0])
    mask = int(raw[-1])
    if np.array_equal(np.arange(len(raw)) >> shift & mask, raw):
        return (shift, mask)
    return None


def run_of(leaf: Leaf) -> tuple[str, int, int, int] | None:
    """Return the place of a field of unsigned contiguous bits in up to four bytes.

    The place is byte order, first byte, number of bytes and lowest bit. Returns None for other
    fields.
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


def word_of(leaf: Leaf, layout: Layout) -> tuple[int, int, int] | None:
    """Return the 4-byte little-endian word of its element that holds a field.

    It is given as offset, shift and mask. Returns None if there is no such word.
    """
    run = run_of(leaf)
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


def every_value(node: Node, leaf: Leaf) -> NDArray[Any] | None:
    """Return an expression of one field for every value of its window.

    The shape is (256,) or (65536,). Returns None if the field has no window.
    """
    seen = window(leaf)
    if seen is None:
        return None
    raw = raw_values(leaf, seen)
    return Expression(node, (leaf.info,)).values({leaf.info.path: raw}).reshape(raw.shape)


def possible(node: Node, leaves: Mapping[str, Leaf]) -> NDArray[Any] | None:
    """Return all values that an expression can have, (256,) or (65536,).

    Returns None if it is not an expression of one field with a window.
    """
    source = only_field(node)
    if source is not None:
        leaf = leaves.get(source.path)
    else:
        leaf = None
    if leaf is not None:
        return every_value(node, leaf)
    return None


def is_number(value: Any, leaves: Any) -> bool:
    """Return whether an expression is finite if its fields are.

    The layout has to have the fields, and the operations have to be safe.
    """
    if not isinstance(value, Node):
        return bool(np.isfinite(value).all())
    if value.kind == "field":
        return value.path in leaves
    if value.kind != "call":
        return False
    found = possible(value, leaves)
    if found is not None:
        return bool(np.isfinite(found).all())
    if value.function in _DIVISIONS:
        divisor = value.args[1]
        return (
            not isinstance(divisor, Node)
            and bool(np.all(divisor))
            and is_number(value.args[0], leaves)
        )
    return (value.function in CHEAP or value.function in (np.sin, np.cos)) and all(
        is_number(arg, leaves) for arg in value.args
    )


class Beam(NamedTuple):
    """A coordinate of points along beams.

    It is a measured distance times a row of a table, plus a row of another table for the start.

    Attributes:
        distance: as the sensor sent it, in such steps of metres; or nan.
        direction, start: the rows.
    """

    distance: Node
    direction: Node
    start: Node
    step: float


def beam_of(node: Node, leaves: Mapping[str, Leaf]) -> Beam | None:
    """Return the beam of a sum.

    Returns None for other sums, and if float32 does not resolve the steps of the distance.
    """
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
    if leaf is None or leaf.info.kind != "int" or leaf.info.bits > SHORT or leaf.info.offset:
        return None
    return Beam(distance, direction, start, leaf.info.scale)
