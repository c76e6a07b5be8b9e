"""One frame as rows of values: every byte is in exactly one row, even if the frame is truncated."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

from lidarspec.errors import WireError
from lidarspec.explaining.formatting import ExplainedRow, FieldValue
from lidarspec.frames.compilability import NotCompilableError
from lidarspec.frames.layout_tree import frame_layouts
from lidarspec.frames.number_format import find_number_format
from lidarspec.frames.plain import list_plain_fields
from lidarspec.frames.schema import make_schema, without_indices
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.frames.wire_fields import ExaminedChecksum, WireField, examine
from lidarspec.frames.wire_table import format_bits, format_hex
from lidarspec.spec import Frame
from lidarspec.spec.tree import UNNAMED, FieldInfo, format_values


class FrameRows:
    """The rows of one frame, which may be truncated.

    Args:
        fault: the fault of the frame; None if the frame is valid.

    Attributes:
        after: the offset after the frame.
    """

    def __init__(self, frame: Frame, data: bytes, fault: WireError | None = None) -> None:
        self._data = data
        self._schema = make_schema(frame.tree)
        self._fault = fault
        self._has_form = frame.wire is not None
        self._axes = self._find_array_axes()
        decoded = frame_coder(frame).decode(data)
        #: The offset in the frame of each byte of its struct.
        self._offsets = decoded.offsets
        self._verdicts: dict[str, tuple[str, bool]] = {}
        fields = self._read_fields(frame, decoded.struct)
        self._is_cut_off = fields is None or any(field.raw is None for field in fields)
        self._fields = [
            self._convert_offsets(field) for field in fields or () if field.raw is not None
        ]
        blocks = [field.block for field in self._fields if field.bits is not None]
        self._blocks = {without_indices(path)[0] for path in blocks}
        self._first = self._offsets[0]
        self._end = max((field.end for field in self._fields), default=self._first)
        self._is_whole_text = self._has_form and not self._is_cut_off and decoded.problem is None
        self.after = len(data) if self._is_whole_text else self._end

    def _find_array_axes(self) -> list[str]:
        """Return the paths of all arrays, except byte strings."""
        axes: list[str] = []
        for info in self._schema.all_fields.values():
            axes += info.axes[:-1] if info.kind == "bytes" else info.axes
        return axes

    def _read_fields(self, frame: Frame, struct: bytes) -> list[WireField] | None:
        """Return the fields of the frame; the last field may be truncated."""
        if isinstance(frame_layouts(frame), NotCompilableError):
            return list_plain_fields(frame, struct)
        examined = examine(frame.tree, struct, frame.max_struct_bytes)
        with contextlib.suppress(Exception):  # a plugin's checksum; `fault` has the exception
            self._verdicts = {
                checksum.path: _describe_checksum(checksum) for checksum in examined.checksums()
            }
        fields = list(examined.fields())
        if examined.layout is None and all(field.raw is not None for field in fields):
            cut_off = WireField("", "", FieldInfo(""), len(struct), len(struct), None, None)
            fields.append(cut_off)
        return fields

    def _convert_offsets(self, field: WireField) -> WireField:
        """Return a field with its offsets on the wire instead of in the struct."""
        if not self._has_form:
            return field
        return replace(
            field, start=self._offsets[field.start], end=self._offsets[field.end], bits=None
        )

    def iter_rows(self) -> Iterator[ExplainedRow]:
        """Yield a row for each field, bit block or array element."""
        if self._first:
            yield ExplainedRow(0, self._data[: self._first], "(start)", (), (), matches_spec=True)
        rows = itertools.groupby(self._fields, lambda field: self._find_row_path(field.block))
        for path, group in rows:
            yield self._make_row(path, list(group))
        if self._is_whole_text and self._end < len(self._data):
            yield ExplainedRow(
                self._end, self._data[self._end :], "(end)", (), (), matches_spec=True
            )

    def values(self) -> dict[str, FieldValue]:
        """Return all values by path."""
        return {value.path: value for row in self.iter_rows() for value in row.values}

    def iter_rest(self, fault: WireError | None) -> Iterator[ExplainedRow]:
        """Yield a row with the bytes after the last field, if there are any."""
        left = self._data[self.after :]
        if self._is_cut_off and fault is not None:
            yield ExplainedRow(
                self.after, left, fault.path, (), (fault.reason,), matches_spec=False
            )
        elif fault is not None and self._has_form and not left:
            yield ExplainedRow(self.after, left, "(end)", (), (fault.reason,), matches_spec=False)
        elif left:
            yield ExplainedRow(
                self.after, left, "", (), ("after the end of the frame",), matches_spec=False
            )

    def _find_row_path(self, path: str) -> str:
        """Return the path of the row that shows a field."""
        head, bracket, _ = path.rpartition("]")
        array = without_indices(head + bracket)[0]
        in_blocks = tuple(f"{block}." for block in self._blocks)
        further = any(
            axis.startswith(f"{array}.") and not axis.startswith(in_blocks) for axis in self._axes
        )
        if not bracket or further:
            return path
        return head + bracket

    def _make_row(self, path: str, group: Sequence[WireField]) -> ExplainedRow:
        start = group[0].start
        end = group[-1].end
        values: list[FieldValue] = []
        remarks: list[str] = []
        matches_spec = True
        for field in group:
            info = self._find_info(field)
            values.append(_make_value(field, info))
            wrong = self._find_fault(field, info)
            if wrong:
                remarks.append(wrong)
                matches_spec = False
            if field.path in self._verdicts:
                text, is_right = self._verdicts[field.path]
                remarks.append(text)
                matches_spec = matches_spec and is_right
        return ExplainedRow(
            start, self._data[start:end], path, tuple(values), tuple(remarks), matches_spec
        )

    def _find_info(self, field: WireField) -> FieldInfo:
        docs = "constant" if field.path.endswith(UNNAMED) else ""
        unknown = replace(field.info, path=without_indices(field.path)[0], docs=docs)
        info: FieldInfo = self._schema.all_fields.get(without_indices(field.path)[0], unknown)
        return info

    def _find_fault(self, field: WireField, info: FieldInfo) -> str:
        """Return a text that describes the fault of a field's value; "" if it is valid."""
        if info.const is not None and field.raw != info.const:
            shown = format_hex(field.raw, info.bits)
            return f"wrong: {shown}, expected {format_hex(info.const, info.bits)}"
        if info.allowed is not None and field.raw not in info.allowed:
            return f"wrong: {field.raw}, expected {format_values(info.allowed)}"
        if info.is_enforced and self._fault is not None and self._fault.path == field.path:
            return f"wrong: {field.raw}, expected {self._fault.expected}"
        return ""


def _make_value(field: WireField, info: FieldInfo) -> FieldValue:
    size = field.end - field.start
    is_number = isinstance(field.raw, int | float)
    return FieldValue(
        field.path,
        field.raw,
        float(info.physical(field.raw)) if is_number else None,
        info.unit,
        find_number_format(info),
        info.labels.get(field.raw, "") if isinstance(field.raw, int) else "",
        "" if field.bits is None else format_bits(field.bits),
        info.docs,
        field.start,
        b"\xff" * size if field.bits is None else field.bits.masks(size),
        bool(info.labels) and field.raw not in info.labels,
    )


def _describe_checksum(checksum: ExaminedChecksum) -> tuple[str, bool]:
    """Return a text about a stored checksum, and whether the checksum is valid."""
    algorithm = checksum.checksum.algorithm
    count = sum(end - start for start, end in checksum.checksum.spans)
    plural = "s" if count != 1 else ""
    stored = format_hex(checksum.stored, algorithm.width)
    computed = format_hex(checksum.computed, algorithm.width)
    if checksum.stored == checksum.computed:
        verdict = "ok"
    elif checksum.is_right:
        verdict = "means no checksum"
    else:
        verdict = f"wrong, expected {computed}"
    how = f"({algorithm.describe()} over {count} byte{plural})"
    return f"{stored} {verdict} {how}", checksum.is_right
