"""Tabulate expressions of one field for all values of its bytes.

An expression of a field of one or two bytes has at most 65,536 values. A lookup in a table of these
values replaces all computations with byte order, bits, scale, sines and cosines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.graph import Expression, Node, get_only_field
from lidarspec.frames.layout import Leaf

#: Functions that are hardly slower than a lookup. For finite numbers their results are finite,
#: unless they overflow.
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
#: Functions with a finite result if the divisor is a constant other than 0.
_DIVISIONS = {np.true_divide, np.mod}


@dataclass(frozen=True)
class FieldWindow:
    """The one or two bytes that contain a field, read as a little-endian integer.

    Attributes:
        offset: the offset of the bytes in the frame. If the field is in arrays, the offset of the
            bytes of the first element.
        size: the number of bytes, 1 or 2.
    """

    offset: int
    size: int

    @property
    def dtype(self) -> np.dtype[Any]:
        """The dtype of the bytes, read as an integer."""
        return np.dtype(f"<u{self.size}")


def find_window(leaf: Leaf) -> FieldWindow | None:
    """Return the one or two bytes that contain a field; None if there are more."""
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
    """Return the raw value of a field for all values of its bytes, (256,) or (65536,)."""
    codes = np.arange(1 << (8 * field_window.size)).astype(field_window.dtype)
    frames = np.zeros((len(codes), leaf.size), np.uint8)
    start = field_window.offset - leaf.offset
    frames[:, start : start + field_window.size] = codes.view(np.uint8).reshape(
        len(codes), field_window.size
    )
    single = Leaf(leaf.info, 0, (), (), leaf.size, leaf.wire, leaf.elements)
    return single.load(frames)


def tabulate_values(node: Node, leaf: Leaf) -> NDArray[Any] | None:
    """Evaluate an expression of one field for every value of the bytes of the field.

    Returns:
        (256,) or (65536,); None if the field is not in one or two bytes.
    """
    field_window = find_window(leaf)
    if field_window is None:
        return None
    raw = raw_values(leaf, field_window)
    return Expression(node, (leaf.info,)).values({leaf.info.path: raw}).reshape(raw.shape)


def list_possible_values(node: Node, leaves: Mapping[str, Leaf]) -> NDArray[Any] | None:
    """Return all possible values of an expression, (256,) or (65536,).

    Returns None unless the expression depends on exactly one field, in one or two bytes.
    """
    source = get_only_field(node)
    if source is not None:
        leaf = leaves.get(source.path)
    else:
        leaf = None
    if leaf is not None:
        return tabulate_values(node, leaf)
    return None


def is_always_finite(value: Any, leaves: Any) -> bool:
    """Return whether an expression is certainly finite if its fields are finite.

    Args:
        value: a node, or an array that does not depend on data.
        leaves: the fields of the layout, by path.
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
            and is_always_finite(value.args[0], leaves)
        )
    return (value.function in CHEAP or value.function in (np.sin, np.cos)) and all(
        is_always_finite(arg, leaves) for arg in value.args
    )
