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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.graph import Expression, Node, get_only_field
from lidarspec.frames.layout import Leaf

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
#: dividing by one of these numbers, or the rest of it, is a number too.
_DIVISIONS = {np.true_divide, np.mod}


@dataclass(frozen=True)
class FieldWindow:
    """The bytes of a field in its element, little-endian.

    They are `size` bytes from `offset` of the frame on. Tables are indexed by one or two bytes.
    """

    offset: int
    size: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """The type it is loaded as."""
        return np.dtype(f"<u{self.size}")


def find_window(leaf: Leaf) -> FieldWindow | None:
    """Return the window of a field.

    Returns None if it takes more than two bytes, or if it is an array inside a bit block.
    """
    if leaf.wire is not None:
        if leaf.wire.itemsize <= 2 and leaf.wire.kind in "iu":
            return FieldWindow(leaf.offset, leaf.wire.itemsize)
        return None
    if len(leaf.shape) > len(leaf.strides):
        return None
    start, stop = leaf.byte_span
    if stop - start <= 2:
        return FieldWindow(start, stop - start)
    return None


def raw_values(leaf: Leaf, field_window: FieldWindow) -> NDArray[Any]:
    """Return the raw values of a field for every value of its window: (256,) or (65536,)."""
    codes = np.arange(1 << (8 * field_window.size)).astype(field_window.dtype)
    frames = np.zeros((len(codes), leaf.size), np.uint8)
    start = field_window.offset - leaf.offset
    frames[:, start : start + field_window.size] = codes.view(np.uint8).reshape(
        len(codes), field_window.size
    )
    single = Leaf(leaf.info, 0, (), (), leaf.size, leaf.wire, leaf.elements)
    return single.load(frames)


def every_value(node: Node, leaf: Leaf) -> NDArray[Any] | None:
    """Return an expression of one field for every value of its window.

    The shape is (256,) or (65536,). Returns None if the field has no window.
    """
    field_window = find_window(leaf)
    if field_window is None:
        return None
    raw = raw_values(leaf, field_window)
    return Expression(node, (leaf.info,)).values({leaf.info.path: raw}).reshape(raw.shape)


def list_possible_values(node: Node, leaves: Mapping[str, Leaf]) -> NDArray[Any] | None:
    """Return all values that an expression can have, (256,) or (65536,).

    Returns None if it is not an expression of one field with a window.
    """
    source = get_only_field(node)
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
    values = list_possible_values(value, leaves)
    if values is not None:
        return bool(np.isfinite(values).all())
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
