"""What the generated kernels know of single fields and functions: bytes to integers, straight lines in tables, NumPy's names."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Leaf
from lidarspec.frames.tracing import Node
from lidarspec.plans.windows import possible, raw_values, window

#: how a kernel writes NumPy's functions of numbers; what is not here is computed by NumPy itself.
TEMPLATES: dict[Any, str] = {
    np.add: "({} + {})",
    np.subtract: "({} - {})",
    np.multiply: "({} * {})",
    np.true_divide: "({} / {})",
    np.negative: "(-{})",
    np.positive: "{}",
    np.absolute: "abs({})",
    np.deg2rad: f"({{}} * {np.pi / 180!r})",
    np.radians: f"({{}} * {np.pi / 180!r})",
    np.rad2deg: f"({{}} * {180 / np.pi!r})",
    np.degrees: f"({{}} * {180 / np.pi!r})",
    np.minimum: "smaller({}, {})",
    np.maximum: "larger({}, {})",
    np.less: "({} < {})",
    np.less_equal: "({} <= {})",
    np.greater: "({} > {})",
    np.greater_equal: "({} >= {})",
    np.equal: "({} == {})",
    np.not_equal: "({} != {})",
    np.floor: "np.floor({})",
    np.ceil: "np.ceil({})",
    np.trunc: "np.trunc({})",
    np.rint: "np.rint({})",
    np.mod: "modulo({}, {})",
    np.sqrt: "np.sqrt({})",
    np.sin: "math.sin({})",
    np.cos: "math.cos({})",
    np.tan: "math.tan({})",
    np.arctan: "math.atan({})",
    np.arctan2: "math.atan2({}, {})",
    np.exp: "math.exp({})",
    np.exp2: "np.exp2({})",
    np.isfinite: "math.isfinite({})",
    np.isnan: "math.isnan({})",
    np.nan_to_num: "number({})",
}

#: what costs hardly more than looking its result up; with these, whatever is made of numbers stays a number.
CHEAP: set[Any] = {np.add, np.subtract, np.multiply, np.negative, np.positive, np.absolute, np.deg2rad, np.radians, np.minimum, np.maximum}
CHEAP |= {np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal, np.where}
FEW = 8
#: dividing by one of these numbers, or the rest of it, is a number too.
_DIVISIONS = {np.true_divide, np.mod}


def is_cheap(node: Node) -> bool:
    """Whether an expression of one field is a few simple operations."""
    number, waiting = 0, [node]
    while waiting and number <= FEW:
        this = waiting.pop()
        number += 1
        if this.kind == "call" and this.function not in CHEAP:
            return False
        waiting += [arg for arg in this.args if isinstance(arg, Node)]
    return number <= FEW


def is_number(value: Any, leaves: Any) -> bool:
    """Whether an expression is finite whatever the bytes are: made of integer fields that the layout has, by safe operations."""
    if not isinstance(value, Node):
        return bool(np.isfinite(value).all())
    if value.kind == "field":
        return value.path in leaves and leaves[value.path].info.kind != "float"
    if value.kind != "call":
        return False
    found = possible(value, leaves)
    if found is not None:
        return bool(np.isfinite(found).all())
    if value.function in _DIVISIONS:
        divisor = value.args[1]
        return not isinstance(divisor, Node) and bool(np.all(divisor)) and is_number(value.args[0], leaves)
    return (value.function in CHEAP or value.function in (np.sin, np.cos)) and all(is_number(arg, leaves) for arg in value.args)


def integer(leaf: Leaf, byte: Any) -> str | None:
    """The raw value of a field as an expression of its bytes, `byte(offset)` each; None where it has no simple one."""
    if leaf.wire is not None:
        size, kind = leaf.wire.itemsize, leaf.wire.kind
        if kind not in "iu" or size > 4:
            return None
        order = range(size) if leaf.wire.byteorder != ">" else reversed(range(size))
        total = " | ".join(
            f"{byte(leaf.offset + at)} << {8 * power}" if power else byte(leaf.offset + at) for power, at in enumerate(order)
        )
        return f"np.int64(np.int{8 * size}({total}))" if kind == "i" else f"({total})"
    if len(leaf.shape) > len(leaf.strides) or leaf.elements[0].width > 48:
        return None
    element = leaf.elements[0]
    parts = []
    for part in element.segments:
        bits = byte(leaf.offset + part.byte)
        bits = bits if part.mask == 0xFF else f"({bits} & {part.mask})"
        bits = f"({bits} >> {part.low})" if part.low else bits
        parts.append(f"({bits} << {part.target})" if part.target else bits)
    total, sign = f"({' | '.join(parts)})", 1 << (element.width - 1)
    return f"(({total} ^ {sign}) - {sign})" if element.signed else total


@dataclass(frozen=True)
class Line:
    """A table that is a straight line of the raw value from `low` to `high`, and `other` for all values besides.

    Attributes:
        exact: whether the arithmetic has to be that of float64.
    """

    slope: float
    start: float
    low: int | None
    high: int | None
    other: float
    exact: bool

    def text(self, raw: str) -> str:
        """The value as an expression of the raw one."""
        if self.exact:
            found = f"np.float32({raw} * {self.slope!r} + {self.start!r})"
        elif self.slope == 1 and self.start == 0:
            found = f"np.float32(np.int32({raw}))"
        else:
            found = f"(np.float32(np.int32({raw})) * np.float32({self.slope!r})" + (
                f" + np.float32({self.start!r}))" if self.start else ")"
            )
        tests = [f"{raw} {sign} {limit}" for sign, limit in ((">=", self.low), ("<=", self.high)) if limit is not None]
        return f"({found} if {' and '.join(tests)} else np.float32({'nan' if np.isnan(self.other) else 'inf'}))" if tests else found


def line(leaf: Leaf, values: NDArray[Any], *, exact: bool) -> Line | None:
    """The line that a table by a field's window is, in float32: equal where `exact`, else within a unit in the last place."""
    seen = window(leaf)
    assert seen is not None
    raw = raw_values(leaf, seen).astype(np.int64)
    good = np.isfinite(values)
    if not good.any():
        return None
    low, high = int(raw[good].min()), int(raw[good].max())
    others = values[~good]
    if ((raw[~good] >= low) & (raw[~good] <= high)).any() or high == low:
        return None
    if len(others) and not (np.isnan(others).all() or (others == np.inf).all()):
        return None
    first, last = float(values[raw == low][0]), float(values[raw == high][0])
    slope = (last - first) / (high - low)
    start = first - slope * low
    slope, start = float(f"{slope:.12g}"), 0.0 if abs(start) < 1e-9 * abs(slope) else float(f"{start:.12g}")
    wanted, some = values[good].astype(np.float32), raw[good]
    limits = (low if (raw < low).any() else None, high if (raw > high).any() else None)
    other = float(others[0]) if len(others) else 0.0
    with np.errstate(all="ignore"):
        short = some.astype(np.float32) * np.float32(slope) + np.float32(start)
        apart = np.abs(short.astype(np.float64) - wanted)
        if (apart <= (0 if exact else np.spacing(np.abs(wanted)))).all():
            return Line(slope, start, *limits, other, exact=False)
        long = (some * slope + start).astype(np.float32)
        if (np.abs(long.astype(np.float64) - wanted) <= (0 if exact else np.spacing(np.abs(wanted)))).all():
            return Line(slope, start, *limits, other, exact=True)
    return None
