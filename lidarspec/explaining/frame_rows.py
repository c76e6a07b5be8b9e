"""One frame as rows of values: every byte is in exactly one row, also of a truncated frame."""

from __future__ import annotations

import contextlib
import functools
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

from lidarspec.errors import WireError
from lidarspec.explaining.formatting import ExplainedRow, FieldValue
from lidarspec.frames.compilability import NotCompilableError
from lidarspec.frames.layout_tree import frame_layouts
from lidarspec.frames.plain import plain_fields
from lidarspec.frames.schema import make_schema, without_indices
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.frames.wire_fields import PlacedSeal, WireField, examine
from lidarspec.frames.wire_table import bit_text, format_hex
from lidarspec.spec import Frame
from lidarspec.spec.tree import UNNAMED, FieldInfo, format_values, to_exact

#: Maximum number of decimals to distinguish steps, and of decimals to add to show a step in full.
MAX_DIGITS = 12
MAX_SPARE_DIGITS = 2


class FrameRows:
    """The rows of one frame, as far as its bytes go.

    Args:
        fault: the fault of the frame, which is reported at its row.

    Attributes:
        after: the byte after the frame.
    """

    def __init__(self, frame: Frame, data: bytes, fault: WireError | None = None) -> None:
        self._data = data
        self._schema = make_schema(frame.tree)
        self._fault = fault
        self._has_form = frame.wire is not None
        self._axes = self._array_axes()
        decoded = frame_coder(frame).decode(data)
        #: Offset in the frame of each byte of its struct.
        self._offsets = decoded.offsets
        self._verdicts: dict[str, tuple[str, bool]] = {}
        fields = self._read_fields(frame, decoded.struct)
        self._is_cut_off = fields is None or any(each.raw is None for each in fields)
        self._fields = [self._place_on_wire(each) for each in fields or () if each.raw is not None]
        blocks = [each.block for each in self._fields if each.bits is not None]
        self._blocks = {without_indices(path)[0] for path in blocks}
        self._first = self._offsets[0]
        self._end = max((each.end for each in self._fields), default=self._first)
        self._is_whole_text = self._has_form and not self._is_cut_off and decoded.problem is None
        self.after = len(data) if self._is_whole_text else self._end

    def _array_axes(self) -> list[str]:
        """Return the axes of all arrays, those of byte strings left out."""
        axes: list[str] = []
        for info in self._schema.all_fields.values():
            axes += info.axes[:-1] if info.kind == "bytes" else info.axes
        return axes

    def _read_fields(self, frame: Frame, struct: bytes) -> list[WireField] | None:
        """Return the fields of the frame, the last one maybe cut off; None if it has no end."""
        if isinstance(frame_layouts(frame), NotCompilableError):
            return plain_fields(frame, struct)
        examined = examine(frame.tree, struct, frame.room)
        with contextlib.suppress(Exception):  # a plugin's checksum; `fault` has the exception
            self._verdicts = {seal.path: _verdict(seal) for seal in examined.seals()}
        fields = list(examined.fields())
        if examined.layout is None and all(each.raw is not None for each in fields):
            cut_off = WireField("", "", FieldInfo(""), len(struct), len(struct), None, None)
            fields.append(cut_off)
        return fields

    def _place_on_wire(self, each: WireField) -> WireField:
        """Return a field with its place on the wire."""
        if not self._has_form:
            return each
        return replace(
            each, start=self._offsets[each.start], end=self._offsets[each.end], bits=None
        )

    def rows(self) -> Iterator[ExplainedRow]:
        """Return a row for each field or bit block, and for the marks of a wire form.

        The fields of an array element are one row if it holds no further array.
        """
        if self._first:
            yield ExplainedRow(0, self._data[: self._first], "(start)", (), (), right=True)
        for path, group in itertools.groupby(self._fields, lambda each: self._row_path(each.block)):
            yield self._row(path, list(group))
        if self._is_whole_text and self._end < len(self._data):
            yield ExplainedRow(self._end, self._data[self._end :], "(end)", (), (), right=True)

    def values(self) -> dict[str, FieldValue]:
        """Return every value by its path."""
        return {value.path: value for row in self.rows() for value in row.values}

    def rest(self, fault: WireError | None) -> Iterator[ExplainedRow]:
        """Return the bytes in no field: those of one that is cut off, or after the frame."""
        left = self._data[self.after :]
        if self._is_cut_off and fault is not None:
            yield ExplainedRow(self.after, left, fault.path, (), (fault.reason,), right=False)
        elif fault is not None and self._has_form and not left:
            yield ExplainedRow(self.after, left, "(end)", (), (fault.reason,), right=False)
        elif left:
            yield ExplainedRow(
                self.after, left, "", (), ("after the end of the frame",), right=False
            )

    def _row_path(self, path: str) -> str:
        """Return the innermost array element that contains a field, or the field itself."""
        head, bracket, _ = path.rpartition("]")
        array = without_indices(head + bracket)[0]
        in_blocks = tuple(f"{block}." for block in self._blocks)
        further = any(
            axis.startswith(f"{array}.") and not axis.startswith(in_blocks) for axis in self._axes
        )
        if not bracket or further:
            return path
        return head + bracket

    def _row(self, path: str, group: Sequence[WireField]) -> ExplainedRow:
        start = group[0].start
        end = group[-1].end
        values: list[FieldValue] = []
        remarks: list[str] = []
        right = True
        for each in group:
            info = self._info(each)
            values.append(_value(each, info))
            wrong = self._remark(each, info)
            if wrong:
                remarks.append(wrong)
                right = False
            if each.path in self._verdicts:
                text, is_right = self._verdicts[each.path]
                remarks.append(text)
                right = right and is_right
        return ExplainedRow(
            start, self._data[start:end], path, tuple(values), tuple(remarks), right
        )

    def _info(self, each: WireField) -> FieldInfo:
        docs = "constant" if each.path.endswith(UNNAMED) else ""
        unknown = replace(each.info, path=without_indices(each.path)[0], docs=docs)
        info: FieldInfo = self._schema.all_fields.get(without_indices(each.path)[0], unknown)
        return info

    def _remark(self, each: WireField, info: FieldInfo) -> str:
        """Return the fault of a value; "" if there is none."""
        if info.const is not None and each.raw != info.const:
            shown = format_hex(each.raw, info.bits)
            return f"wrong: {shown}, expected {format_hex(info.const, info.bits)}"
        if info.allowed is not None and each.raw not in info.allowed:
            return f"wrong: {each.raw}, expected {format_values(info.allowed)}"
        if info.held and self._fault is not None and self._fault.path == each.path:
            return f"wrong: {each.raw}, expected {self._fault.expected}"
        return ""


def _value(each: WireField, info: FieldInfo) -> FieldValue:
    size = each.end - each.start
    is_number = isinstance(each.raw, int | float)
    return FieldValue(
        each.path,
        each.raw,
        float(info.physical(each.raw)) if is_number else None,
        info.unit,
        None if info.kind == "float" else _digits(info.scale, info.offset),
        info.labels.get(each.raw, "") if isinstance(each.raw, int) else "",
        "" if each.bits is None else bit_text(each.bits),
        info.docs,
        each.start,
        b"\xff" * size if each.bits is None else each.bits.masks(size),
    )


@functools.lru_cache
def _digits(scale: float, offset: float) -> int:
    """Return the decimals that distinguish all values of a field.

    A few more are added if they show each step in full.
    """
    steps = (to_exact(scale), to_exact(offset))
    apart = next(
        (digits for digits in range(MAX_DIGITS) if abs(steps[0]) * 10**digits >= 1), MAX_DIGITS
    )
    return next(
        (
            digits
            for digits in range(apart, apart + MAX_SPARE_DIGITS + 1)
            if all(step * 10**digits % 1 == 0 for step in steps)
        ),
        apart,
    )


def _verdict(seal: PlacedSeal) -> tuple[str, bool]:
    """Return the text of a checksum, and whether it is right."""
    algorithm = seal.seal.algorithm
    count = sum(end - start for start, end in seal.seal.spans)
    plural = "s" if count != 1 else ""
    stored = format_hex(seal.stored, algorithm.width)
    computed = format_hex(seal.computed, algorithm.width)
    if seal.stored == seal.computed:
        verdict = "ok"
    elif seal.is_right:
        verdict = "means not filled"
    else:
        verdict = f"wrong, expected {computed}"
    how = f"({algorithm.describe()} over {count} byte{plural})"
    return f"{stored} {verdict} {how}", seal.is_right
