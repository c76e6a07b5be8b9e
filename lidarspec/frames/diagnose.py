"""Find the first fault in the bytes of one frame.

The first fault is the one that is found first if the frame is read byte by byte.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Condition, Layout, set_bits
from lidarspec.frames.layout_tree import (
    HeaderWalk,
    InvalidCaseError,
    InvalidLengthError,
    UnknownPartError,
    UnknownSelectorError,
)
from lidarspec.frames.measured_size import TextSize
from lidarspec.frames.wire_fields import ExaminedFrame, WireField
from lidarspec.spec.tree import format_hex, format_values

#: The kinds of faults.
CONSTANT = "constant"
VALUE = "value"
LENGTH = "length"
COUNT = "count"
CHECKSUM = "checksum"
CONDITION = "condition"
CASE = "case"
CUT_OFF = "cut off"
TRAILING = "trailing bytes"


@dataclass(frozen=True)
class Fault:
    """A fault of a frame.

    Attributes:
        kind: one of the constants of this module.
        path: the path of the field, with indices.
        offset: the offset of the first byte of the field in the frame.
        expected, got: the expected and the actual value, as a text or number.
        end: the offset up to which the frame has to be read to find the fault.
        needed: the size of a field that is cut off, in bytes; 0 for all other faults.
        is_bounded: whether the field is in a part, and is cut off at the end of the sequence of
            parts, before the end of the frame.
    """

    kind: str
    path: str
    offset: int
    expected: Any
    got: Any
    end: int
    needed: int = 0
    is_bounded: bool = False

    def reason(self, offset: int) -> str:
        """Return a description of the fault.

        Args:
            offset: the offset to print.
        """
        if self.kind == CUT_OFF:
            return self._describe_shortage()
        if self.kind == TRAILING:
            more = self.got - self.expected
            return f"the frame ends at byte {self.expected}, but {more} more bytes follow"
        if self.kind == CONDITION:
            return f"{self.path}: the condition is false"
        if self.kind == CASE:
            return f"{self.path}: the fields before it select an invalid case (construct's Error)"
        if self.kind == LENGTH and self.got is None:
            return f"{self.path}: expected {self.expected}"
        if self.kind == COUNT:
            return f"{self.path}: invalid count or length {self.got}"
        return f"{self.path} at byte {offset}: {self.kind} {self.got}, expected {self.expected}"

    def _describe_shortage(self) -> str:
        if self.expected is None:
            total = ""
        else:
            total = f" of {self.expected}"
        where = f"the frame ends at byte {self.end}{total}"
        if self.is_bounded:
            where = f"the sequence of parts ends at byte {self.end}"
        if not self.needed:
            return f"{where}: {self.path or 'the first field'} is cut off"
        plural = "s" if self.needed != 1 else ""
        left = self.end - self.offset
        return f"{where}: {self.path} requires {self.needed} byte{plural}, but has {left}"


def find_fault(examined: ExaminedFrame) -> Fault | None:
    """Return the first fault of a frame; None if it is valid."""
    faults = [*_iter_faults(examined)]
    layout = examined.layout
    if layout is not None and layout.size < len(examined.data):
        size = len(examined.data)
        faults.append(Fault(TRAILING, "", layout.size, layout.size, size, size))
    return min(faults, key=lambda fault: fault.end, default=None)


def find_shortage(examined: ExaminedFrame) -> Fault | None:
    """Return the fault that prevents parsing of a frame; None if it can be parsed."""
    cut_off = next((each for each in examined.fields() if each.raw is None), None)
    if examined.layout is None or cut_off is not None:
        return _find_end_fault(examined, cut_off)
    return None


def _iter_faults(examined: ExaminedFrame) -> Iterator[Fault]:
    cut_off: WireField | None = None
    for each in examined.fields():
        if each.raw is None:
            cut_off = cut_off or each
            continue
        fault = _find_value_fault(each)
        if fault is not None:
            yield fault
    yield from _iter_layout_faults(examined)
    for checksum in examined.checksums():
        if not checksum.is_right:
            digits = (sum(leaf.info.bits for leaf in checksum.checksum.leaves) + 3) // 4
            expected = f"0x{checksum.computed:0{digits}x}"
            got = f"0x{checksum.stored:0{digits}x}"
            yield Fault(CHECKSUM, checksum.path, checksum.offset, expected, got, checksum.end)
    part = _find_open_part(examined)
    if part is not None:
        yield from _iter_faults(part)
    if cut_off is not None or examined.layout is None:
        yield _find_end_fault(examined, cut_off)


def _find_value_fault(each: WireField) -> Fault | None:
    info = each.info
    if info.const is not None and each.raw != info.const:
        expected = format_hex(info.const)
        got = format_hex(each.raw)
        return Fault(CONSTANT, each.path, each.first_byte, expected, got, each.end)
    if info.allowed is not None and each.raw not in info.allowed:
        expected = format_values(info.allowed)
        return Fault(VALUE, each.path, each.first_byte, expected, int(each.raw), each.end)
    return None


def _iter_layout_faults(examined: ExaminedFrame) -> Iterator[Fault]:
    """Yield the faults of lengths and conditions in a complete frame and its parts."""
    layout = examined.layout
    if layout is None or layout.size > len(examined.data):
        return
    row = np.frombuffer(examined.data[: layout.size], np.uint8).reshape(1, -1)
    yield from _iter_length_faults(examined, layout, row)
    yield from _iter_condition_faults(examined, layout, row)
    for axis in layout.regions:
        for part in examined.list_parts_of(axis):
            yield from _iter_layout_faults(part)
        broken = examined.find_broken_part(axis)
        if broken is not None:
            yield _describe_misfit(broken)


def _describe_misfit(part: ExaminedFrame) -> Fault:
    """Return the fault of an invalid part: it is truncated or has a wrong size."""
    shortage = find_shortage(part)
    if shortage is not None:
        return shortage
    end = part.start + len(part.data)
    expected = "parts whose sizes add up to the size of the sequence"
    return Fault(LENGTH, part.prefix, part.start, expected, None, end)


def _iter_length_faults(
    examined: ExaminedFrame, layout: Layout, row: NDArray[np.uint8]
) -> Iterator[Fault]:
    """Yield the faults of fields that declare a wrong size of a part."""
    if not layout.held:
        return
    right = row.copy()
    set_bits(right, layout.held)
    for leaf in layout.leaves.values():
        if not leaf.info.is_enforced:
            continue
        is_wrong = (leaf.load(row) != leaf.load(right))[0]
        if not is_wrong.any():
            continue
        indices = np.argwhere(is_wrong)[0].tolist()
        index = (0, *indices)
        path = f"{examined.prefix}.{_insert_indices(leaf.info.path, leaf.info.axes, indices)}"
        # A length field is usually in a header struct, and measures the struct around the header.
        around = ".".join(leaf.info.path.split(".")[:-2])
        end = examined.start + layout.places.get(around, (0, layout.size))[1]
        offset = examined.start + leaf.byte_span[0]
        offset += sum(step * stride for step, stride in zip(indices, leaf.strides, strict=False))
        expected = leaf.load(right)[index].item()
        got = leaf.load(row)[index].item()
        yield Fault(LENGTH, path.strip("."), offset, expected, got, end)


def _iter_condition_faults(
    examined: ExaminedFrame, layout: Layout, row: NDArray[np.uint8]
) -> Iterator[Fault]:
    for condition in layout.conditions:
        is_of_field = condition.formula is None
        if is_of_field and condition.fields[0].allowed is not None:
            continue  # `_find_value_fault` checks the allowed values of a field
        if layout.meet_condition(condition, row)[0]:
            continue
        leaves = [layout.leaves[info.path] for info in condition.fields]
        end = examined.start + max((leaf.byte_span[1] for leaf in leaves), default=0)
        path = f"{examined.prefix}.{_find_false_condition(condition, layout, row)}".strip(".")
        adapter = condition.fields[0].adapter if is_of_field else None
        if adapter is not None:
            start, stop = leaves[0].byte_span
            got = row[0, start:stop].tobytes().hex(" ")
            yield Fault(VALUE, path, examined.start + start, adapter.form, got, end)
            continue
        yield Fault(CONDITION, path, end, "a condition that is true", "false", end)


def _find_false_condition(condition: Condition, layout: Layout, row: NDArray[np.uint8]) -> str:
    """Return the path of a condition, with the indices of the first false element."""
    raw = {info.path: layout.leaves[info.path].load(row) for info in condition.fields}
    holds = condition.values(raw)
    if holds.ndim == 1:
        return condition.path
    axes = max((info.axes for info in condition.fields), key=len)
    return _insert_indices(condition.path, axes, np.argwhere(~holds[0])[0].tolist())


def _insert_indices(path: str, axes: Sequence[str], indices: Sequence[int]) -> str:
    """Return a path with the indices of an element of its arrays."""
    for axis, index in reversed(list(zip(axes, indices, strict=False))):
        if path.startswith(f"{axis}.") or path == axis:
            path = f"{axis}[{index}]{path[len(axis) :]}"
    return path


def _find_end_fault(examined: ExaminedFrame, cut_off: WireField | None) -> Fault:
    """Return the fault of a truncated frame, or of a header that has no layout."""
    part = _find_open_part(examined)
    if part is not None and part.failure is not None:
        return _find_end_fault(part, cut_off)
    failure = examined.failure
    if isinstance(failure, UnknownSelectorError) and isinstance(failure.leaf, TextSize):
        end = examined.start + len(examined.data)
        path = failure.leaf.info.path.removesuffix(".size")
        path = f"{examined.prefix}.{path}".strip(".")
        return Fault(CUT_OFF, path, end, None, end, end, is_bounded=examined.is_bounded)
    if failure is None or isinstance(failure, UnknownSelectorError):
        return _describe_shortage(examined, cut_off)
    if isinstance(failure, InvalidLengthError | UnknownPartError):
        return _describe_refusal(examined, failure)
    raise failure


def _find_open_part(examined: ExaminedFrame) -> ExaminedFrame | None:
    """Return the part whose end is missing; None if all parts are complete."""
    if isinstance(examined.known, HeaderWalk):
        for axis, region in examined.known.open_regions.items():
            if axis not in examined.known.regions and region.start <= len(examined.data):
                return examined.find_broken_part(axis)
    return None


def _describe_shortage(examined: ExaminedFrame, cut_off: WireField | None) -> Fault:
    end = examined.start + len(examined.data)
    size = None
    if examined.layout is not None and not examined.prefix:
        size = examined.layout.size
    is_bounded = examined.is_bounded
    if cut_off is None:
        return Fault(CUT_OFF, examined.prefix, end, size, end, end, is_bounded=is_bounded)
    needed = cut_off.end - cut_off.start
    return Fault(CUT_OFF, cut_off.block, cut_off.start, size, end, end, needed, is_bounded)


def _describe_refusal(
    examined: ExaminedFrame, failure: InvalidLengthError | UnknownPartError
) -> Fault:
    """Return the fault because of which a header has no layout."""
    end = examined.start + len(examined.data)
    path = f"{examined.prefix}.{failure}".strip(".") or "frame"
    if isinstance(failure, UnknownPartError):
        return Fault(LENGTH, path, end, "only parts of declared kinds", None, end)
    if isinstance(failure, InvalidCaseError):
        return Fault(CASE, path, end, "a valid case", None, end)
    length = next((each for each in examined.fields() if each.path == path), None)
    if length is not None and length.info.is_enforced:
        return Fault(LENGTH, path, length.first_byte, failure.number, length.raw, end)
    if failure.number is not None:
        return Fault(COUNT, path, end, f"at most {examined.limit}", failure.number, end)
    return Fault(LENGTH, path, end, f"a frame of 1 to {examined.limit} bytes", None, end)
