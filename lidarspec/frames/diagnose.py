"""Find what is wrong with the bytes of one frame: the first fault in the order of the wire.

A wrong constant or value counts at its place, a wrong length or checksum at the end of the struct
that it belongs to. Bytes that are missing or left over come last.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.frames.layout import Condition, Layout
from lidarspec.frames.layout_tree import TooLong, Unknown, Unlike, Walk
from lidarspec.frames.wire_fields import Examined, WireField
from lidarspec.spec.tree import FieldInfo, evaluated, listed

#: kinds of faults.
CONSTANT = "constant"
VALUE = "value"
LENGTH = "length"
COUNT = "count"
CHECKSUM = "checksum"
CONDITION = "condition"
CUT_OFF = "cut off"
TRAILING = "trailing bytes"


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong with a frame.

    Attributes:
        kind: one of the constants of this module.
        path: of the field, with indices.
        offset: its first byte in the frame.
        expected, got: texts or numbers.
        end: the byte up to which the frame was right; faults are ordered by it.
        needed: of a field that is cut off, its bytes.
    """

    kind: str
    path: str
    offset: int
    expected: Any
    got: Any
    end: int
    needed: int = 0

    def reason(self, offset: int) -> str:
        """Return the fault in a sentence; `offset` is the place of the field that is shown."""
        if self.kind == CUT_OFF:
            return self._shortage()
        if self.kind == TRAILING:
            return f"{self.got - self.expected} more bytes after the frame's {self.expected}"
        if self.kind == CONDITION:
            return f"{self.path}: the check does not hold"
        if self.kind == LENGTH and self.got is None:
            return f"{self.path}: the header leads to a frame that is not {self.expected}"
        if self.kind == COUNT:
            return f"{self.path}: invalid count or length {self.got}"
        return f"{self.path} at byte {offset}: {self.kind} {self.got}, expected {self.expected}"

    def _shortage(self) -> str:
        total = "" if self.expected is None else f" of {self.expected}"
        where = f"frame ends at byte {self.end}{total}"
        if not self.needed:
            return f"{where}: {self.path or 'the first field'} is cut off"
        plural = "s" if self.needed != 1 else ""
        left = self.end - self.offset
        return f"{where}: {self.path} needs {self.needed} byte{plural}, {left} left"


def find_fault(examined: Examined) -> Fault | None:
    """Return the first fault of a frame; None if it is sound.

    Raises:
        SpecError: if an expression of the struct fails.
    """
    faults = [*_faults(examined)]
    if faults:
        return min(faults, key=lambda fault: fault.end)
    return None


def find_shortage(examined: Examined) -> Fault | None:
    """Return why the values of a frame cannot be read at all; None if they can."""
    cut_off = next((each for each in examined.fields() if each.raw is None), None)
    if examined.layout is None or cut_off is not None:
        return _ending(examined, cut_off)
    return None


def _faults(examined: Examined) -> Iterator[Fault]:
    cut_off: WireField | None = None
    for each in examined.fields():
        if each.raw is None:
            cut_off = each
            break
        fault = _fault_of_field(each)
        if fault is not None:
            yield fault
    yield from _wrong_lengths(examined)
    for seal in examined.seals():
        if not seal.is_right:
            digits = (sum(leaf.info.bits for leaf in seal.seal.leaves) + 3) // 4
            expected = f"0x{seal.computed:0{digits}x}"
            got = f"0x{seal.stored:0{digits}x}"
            yield Fault(CHECKSUM, seal.path, seal.offset, expected, got, seal.end)
    yield from _broken_conditions(examined)
    yield from _broken_parts(examined)
    if cut_off is not None or examined.layout is None:
        yield _ending(examined, cut_off)
    elif examined.layout.size < len(examined.data):
        size = examined.layout.size
        yield Fault(TRAILING, "", size, size, len(examined.data), len(examined.data))


def _fault_of_field(each: WireField) -> Fault | None:
    info = each.info
    if info.const is not None and each.raw != info.const:
        constant = _shown(info.const)
        got = _shown(each.raw)
        return Fault(CONSTANT, each.path, each.first_byte, constant, got, each.end)
    if info.allowed is not None and each.raw not in info.allowed:
        allowed = listed(info.allowed)
        return Fault(VALUE, each.path, each.first_byte, allowed, int(each.raw), each.end)
    return None


def _shown(value: object) -> str:
    if isinstance(value, bytes):
        return value.hex(" ")
    return f"0x{value:x}" if isinstance(value, int) else repr(value)


def _ending(examined: Examined, cut_off: WireField | None) -> Fault:
    """Return why a frame has no end: its bytes end, or its header leads to none."""
    failure = examined.failure
    part = _open_part(examined)
    if part is not None and part.failure is not None:
        return _ending(part, cut_off)
    end = examined.start + len(examined.data)
    if failure is None or isinstance(failure, Unknown):
        size = None if examined.layout is None else examined.layout.size
        if cut_off is None:
            return Fault(CUT_OFF, examined.prefix, end, size, end, end)
        needed = cut_off.end - cut_off.start
        return Fault(CUT_OFF, cut_off.block, cut_off.start, size, end, end, needed)
    if isinstance(failure, TooLong | Unlike):
        path = f"{examined.prefix}.{failure}".strip(".") or "frame"
        held = next((each for each in examined.fields() if each.path == path), None)
        if held is not None and held.info.held and isinstance(failure, TooLong):
            offset = held.first_byte
            return Fault(LENGTH, path, offset, failure.number, held.raw, end)
        if isinstance(failure, TooLong) and failure.number is not None:
            return Fault(COUNT, path, end, f"at most {examined.limit}", failure.number, end)
        if isinstance(failure, Unlike):
            expected = "made of known parts"
        else:
            expected = f"1 to {examined.limit} bytes long"
        return Fault(LENGTH, path, end, expected, None, end)
    error = PluginError.of(failure, "struct")
    raise SpecError(f"an expression of the struct failed: {error.reason}") from failure


def _open_part(examined: Examined) -> Examined | None:
    """Return the last of the parts that have no end; None if there are none."""
    if isinstance(examined.known, Walk):
        for axis in examined.known.open_regions:
            if axis not in examined.known.regions:
                return examined.broken_part(axis)
    return None


def _broken_parts(examined: Examined) -> Iterator[Fault]:
    """Return the faults of parts that do not fill the bytes that they have."""
    if examined.layout is None:
        return
    for axis in examined.layout.regions:
        part = examined.broken_part(axis)
        if part is None:
            continue
        fault = find_fault(part)
        end = part.start + len(part.data)
        yield fault or Fault(LENGTH, part.prefix, part.start, "a part that fits", None, end)


def _wrong_lengths(examined: Examined) -> Iterator[Fault]:
    """Return the fields that say how long a part is, and are wrong."""
    layout = examined.layout
    if layout is None or not layout.held:
        return
    for each in examined.fields():
        if each.info.held and each.info.rebuilt is not None and each.raw is not None:
            expected = evaluated(each.info.rebuilt, _reader(examined, layout))
            if each.raw != expected:
                # Usually the part is measured in the struct around that of its length.
                around = ".".join(each.info.path.split(".")[:-2])
                end = examined.start + layout.places.get(around, (0, layout.size))[1]
                yield Fault(LENGTH, each.path, each.first_byte, expected, each.raw, end)


def _reader(examined: Examined, layout: Layout) -> Any:
    """Return what formulas read fields with."""

    def read(path: str) -> tuple[FieldInfo, int] | str | None:
        if path in layout.leaves:
            leaf = layout.leaves[path]
            return leaf.info, leaf.scalar(examined.data)
        for region in layout.regions.values():
            if path == region.node.total.path:
                assert region.size is not None
                return region.node.total, region.size
        return None

    return read


def _broken_conditions(examined: Examined) -> Iterator[Fault]:
    layout = examined.layout
    if layout is None or layout.size > len(examined.data):
        return
    row = np.frombuffer(examined.data[: layout.size], np.uint8).reshape(1, -1)
    for condition in layout.conditions:
        is_value = condition.formula is None  # reported with its field
        if not is_value and not layout.meets_condition(condition, row)[0]:
            leaves = [layout.leaves[info.path] for info in condition.fields]
            end = examined.start + max((leaf.held[1] for leaf in leaves), default=0)
            below = _first_failure(condition, layout, row)
            path = f"{examined.prefix}.{below}".strip(".")
            yield Fault(CONDITION, path, end, "a condition that holds", "one that does not", end)
    for axis in layout.regions:
        for part in examined.parts_of(axis):
            yield from _broken_conditions(part)
            yield from _wrong_lengths(part)


def _first_failure(condition: Condition, layout: Layout, row: NDArray[np.uint8]) -> str:
    """Return the path of a condition that does not hold, with the indices of the first element."""
    raw = {info.path: layout.leaves[info.path].load(row) for info in condition.fields}
    holds = condition.values(raw)
    if holds.ndim == 1:
        return condition.path
    indices = np.argwhere(~holds[0])[0].tolist()
    axes = max((info.axes for info in condition.fields), key=len)
    path = condition.path
    for axis, index in reversed(list(zip(axes, indices, strict=False))):
        if path.startswith(f"{axis}.") or path == axis:
            path = f"{axis}[{index}]{path[len(axis) :]}"
    return path
