"""Write the source of a sensor from a `Draft`.

`make_template_values` returns the values for the template of a module. Each field has a comment
with its evidence, and fields without evidence are named ``unknown_N``.
"""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarspec.drafting.checksum_search import format_class, needs_class
from lidarspec.drafting.draft import Draft, RepeatedBlocks
from lidarspec.drafting.periods import (
    FEW_FRAMES,
    FULL_CIRCLES,
    RisingField,
    find_runs,
    measure_share_between,
)
from lidarspec.drafting.samples import ChecksumMatch, read_values
from lidarspec.spec.checksums import ByteOrder

#: The maximum number of characters in a line of the written files.
MAX_LINE_CHARS = 100
#: The maximum number of bytes of a constant to show in a comment.
MAX_SHOWN_BYTES = 8
#: The minimum number of adjacent constant bytes to declare as a field.
MIN_CONSTANT_RUN = 2
#: The maximum length of a range of unknown bytes that is searched for constant bytes. Longer ranges
#: are mostly measurements, which may be constant because the scene does not change.
MAX_CONSTANT_SEARCH_BYTES = 64
#: A checksum with fewer bits of evidence may be coincidence.
WEAK_EVIDENCE_BITS = 12
#: The maximum number of alternatives to list in a comment.
MAX_ALTERNATIVES = 3
#: If constants and checksum have at most this number of bits, random bytes may look like a frame.
#: The draft then requires two consecutive frames.
WEAK_FRAME_BITS = 24
#: A field is probably the end of an interval if it is between the start of this interval and the
#: next start in at least this share of frames.
MIN_BETWEEN_SHARE = 0.875


@dataclass(frozen=True)
class DraftField:
    """A field of the drafted struct.

    Attributes:
        start: offset in the frame or block, in bytes.
        size: size in bytes.
        name: the name of the field; "" for the end of the frame or block.
        code: the construct expression that follows the name.
        evidence: the comments before the field.
    """

    start: int
    size: int
    name: str
    code: str
    evidence: tuple[str, ...] = ()

    def iter_lines(self, indent: str) -> Iterator[str]:
        """Yield the comments and the code of the field."""
        for comment in self.evidence:
            yield from textwrap.wrap(
                comment,
                MAX_LINE_CHARS,
                initial_indent=f"{indent}# ",
                subsequent_indent=f"{indent}#   ",
            )
        separator = f"\n{indent}" if "\n" in self.code else " "
        yield f'{indent}"{self.name}"{separator}/ {self.code},'


def make_template_values(draft: Draft, *, origin: str, link_code: str) -> dict[str, str]:
    """Return the values for the template of a module, as {name: text}.

    Args:
        origin: a description of the capture.
        link_code: the Python expression of the data link.
    """
    fields = list(_iter_fields(draft))
    angles = _find_angles(draft)
    indent = " " * (4 if draft.checksum is None else 8)
    body = "\n".join(line for field in fields for line in field.iter_lines(indent))
    checksum_class = ""
    if draft.checksum is None:
        struct = f"Struct(\n{body}\n)"
        no_checksum_remark = (
            "# No checksum was found: XORs, sums and CRCs of 8, 16 and 32 bits were tried.\n"
        )
    else:
        arguments = _format_checksum_arguments(draft, draft.checksum, fields)
        struct = f"Checksummed(\n    Struct(\n{body}\n    ),\n{arguments})"
        no_checksum_remark = ""
        if needs_class(draft.checksum.algorithm):
            source = format_class(draft.checksum.algorithm, is_typed=True)
            checksum_class = f"\n{source}\n\n\n"
    angle_checks = [f"f.{path} < 360" for path in angles if "." not in path]
    if len(angle_checks) == 1:
        condition = angle_checks[0]
    else:
        condition = " & ".join(f"({check})" for check in angle_checks)
    plausible = (
        'def plausible(f: Fields) -> Any:\n    """Angles below 360 degrees."""\n'
        f"    return {condition}\n\n\n"
    )
    frame_arguments = [f"max_length={_format_max_length(draft)}"]
    if angle_checks:
        frame_arguments.append("plausible=plausible")
    elif not draft.datagrams and _count_fixed_bits(draft) <= WEAK_FRAME_BITS:
        frame_arguments.append("confirm=2")
    counters = [
        field
        for field in draft.rising_fields
        if field.kind == "counter" and field.offset < draft.head_size
    ]
    # The most regular counter is used; the others are alternatives.
    counters.sort(key=lambda field: (-field.right / field.total, -field.size))
    sensor_arguments = _iter_sensor_arguments(angles, counters)
    text = {
        "frame_summary": (
            f"{len(draft.frames)} frame{'s' * (len(draft.frames) != 1)}, which contain"
            f" {draft.share:.1%} of the {draft.bytes_in} bytes"
        ),
        "origin": origin,
        "checksum_class": checksum_class,
        "no_checksum_remark": no_checksum_remark,
        "struct": struct,
        "plausible": plausible if angle_checks else "",
        "azimuth": f"np.deg2rad(f.{angles[0]})" if angles else "np.zeros(1)",
        "distance": f"0 * f.{angles[0]}" if angles else "np.zeros(1)",
        "arguments": "".join(f"    {line}\n" for line in sensor_arguments),
        "frame_arguments": ", ".join(frame_arguments),
        "link_code": link_code,
    }
    return {**text, **_make_imports(text)}


def _iter_fields(draft: Draft) -> Iterator[DraftField]:
    """Yield all fields of a frame in order."""
    rows = draft.rows
    known_fields = _find_known_fields(draft)
    cuts = sorted(
        {
            0,
            draft.head_size,
            *_find_span_edges(draft),
            *(
                edge
                for known_field in known_fields
                for edge in (known_field.start, known_field.start + known_field.size)
            ),
        }
    )
    offset = 0
    for field in [*known_fields, DraftField(draft.head_size, 0, "", "")]:
        yield from _iter_unknown_fields(rows, offset, field.start, cuts)
        if field.name:
            yield field
        offset = field.start + field.size
    if draft.size is None and draft.length is not None:
        yield from _iter_varying_fields(draft)


def _find_known_fields(draft: Draft) -> list[DraftField]:
    """Return the fields with evidence, in wire order and without overlaps."""
    fields = list(_iter_sync_fields(draft))
    if (length := draft.length) is not None:
        sizes = sorted({len(frame) for _, frame in draft.frames})
        if len(sizes) == 1:
            seen = f"complete frames of {sizes[0]} bytes, and one incomplete frame"
        else:
            seen = f"frames of {sizes[0]} to {sizes[-1]} bytes"
        fields.append(
            DraftField(
                length.offset,
                length.size,
                _make_length_field_name(draft),
                _format_integer(length.size, length.order),
                (f"length of the frame, {length}: {seen}",),
            )
        )
    if draft.checksum is not None and not draft.tail_size:
        start = draft.checksum.place.start(draft.head_size)
        fields.append(_make_checksum_field(draft, draft.checksum, start))
    if draft.blocks is not None:
        fields.append(_make_block_field(draft, draft.blocks))
    fields += [_make_rising_field(draft, field) for field in draft.rising_fields]
    chosen: list[DraftField] = []
    for field in fields:
        if all(
            field.start + field.size <= other.start or other.start + other.size <= field.start
            for other in chosen
        ):
            chosen.append(field)
    return sorted(chosen, key=lambda field: field.start)


def _iter_sync_fields(draft: Draft) -> Iterator[DraftField]:
    """Yield the sync bytes as fields."""
    if draft.blocks is None:
        end = len(draft.sync)
    else:
        end = min(len(draft.sync), draft.blocks.start)
    edges = [0, *(cut for cut in _find_span_edges(draft) if 0 < cut < end), end]
    for first, last in itertools.pairwise(edges):
        if last <= first:
            continue
        code = f"Const({_format_bytes(draft.sync[first:last])})"
        if first == 0:
            evidence = (f"{len(draft.frames)} frames begin with these bytes",)
            yield DraftField(first, last - first, "header", code, evidence)
        else:
            yield DraftField(first, last - first, f"header_{first}", code)


def _iter_unknown_fields(
    rows: NDArray[np.uint8], start: int, end: int, cuts: Sequence[int]
) -> Iterator[DraftField]:
    """Yield fields for the unknown bytes between two known fields.

    Args:
        rows: the frames or blocks, (n, size).
        cuts: offsets at which fields must be split.
    """
    edges = {start, end, *(cut for cut in cuts if start < cut < end)}
    if len(rows) >= FEW_FRAMES and end - start <= MAX_CONSTANT_SEARCH_BYTES:
        edges |= _find_constant_edges(rows, start, end)
    for first, last in itertools.pairwise(sorted(edges)):
        size = last - first
        evidence = _describe_constant(rows[:, first:last])
        yield DraftField(first, size, f"unknown_{first}", f"Bytes({size})", evidence)


def _find_constant_edges(rows: NDArray[np.uint8], start: int, end: int) -> set[int]:
    """Return the start and end offsets of runs of constant bytes."""
    is_constant = (rows[:, start:end] == rows[0, start:end]).all(axis=0)
    return {
        start + edge
        for run in find_runs(is_constant)
        if run[1] - run[0] >= MIN_CONSTANT_RUN
        for edge in run
    }


def _describe_constant(columns: NDArray[np.uint8]) -> tuple[str, ...]:
    """Return a comment line with the value of some bytes, or no line if they vary."""
    if not columns.size or not (columns == columns[0]).all():
        return ()
    is_long = columns.shape[1] > MAX_SHOWN_BYTES
    if is_long and (columns[0] == columns[0, 0]).all():
        value = f"{columns[0, 0]:02x}"
    else:
        value = columns[0, :MAX_SHOWN_BYTES].tobytes().hex(" ") + (" ..." if is_long else "")
    return (f"always {value} in {len(columns)} frames",)


def _make_rising_field(draft: Draft, rising: RisingField, container: str = "frame") -> DraftField:
    """Return the field for a counter, an angle or another rising field.

    Args:
        container: "frame" or "block", which contains the field.
    """
    code = _format_integer(rising.size, rising.order)
    evidence = [rising.describe_evidence(container)]
    if rising.kind == "angle":
        code = f'Scaled({code}, {FULL_CIRCLES[rising.circle][0]:g}, "deg")'
    if container == "frame":
        start_field = _find_start_field(draft, rising)
        if start_field is not None:
            evidence.append(
                f"the value is between {start_field.name} of this frame and {start_field.name} of"
                " the next frame; it may be the angle of the last sample"
            )
    return DraftField(rising.offset, rising.size, rising.name, code, tuple(evidence))


def _find_start_field(draft: Draft, end_field: RisingField) -> RisingField | None:
    """Return the field with the start of a range; None if there is none.

    Args:
        end_field: a field that may have the end of this range, for example an end angle.
    """
    if end_field.kind == "counter":
        return None
    for field in draft.rising_fields:
        is_same_kind = field.circle == end_field.circle and field.kind == end_field.kind
        if not is_same_kind or field.offset >= end_field.offset:
            continue
        starts = read_values(draft.rows, field.offset, field.size, field.order)
        ends = read_values(draft.rows, end_field.offset, end_field.size, end_field.order)
        if measure_share_between(starts, ends, end_field.circle) > MIN_BETWEEN_SHARE:
            return field
    return None


def _make_block_field(draft: Draft, blocks: RepeatedBlocks) -> DraftField:
    """Return the field with all blocks, as an array of structs."""
    rows = draft.rows[:, blocks.start : blocks.end].reshape(-1, blocks.size)
    fields = []
    if blocks.flag:
        code = f"Const({_format_bytes(blocks.flag)})"
        fields.append(DraftField(0, len(blocks.flag), "flag", code))
    offset = len(blocks.flag)
    for field in [
        *(_make_rising_field(draft, rising, "block") for rising in blocks.rising_fields),
        DraftField(blocks.size, 0, "", ""),
    ]:
        fields += _iter_unknown_fields(rows, offset, field.start, ())
        if field.name:
            fields.append(field)
        offset = field.start + field.size
    indent = " " * (12 if draft.checksum is None else 16)
    outer_indent = indent[8:]
    body = "\n".join(line for field in fields for line in field.iter_lines(indent))
    code = (
        f"Array(\n{outer_indent}    {blocks.count},\n"
        f"{outer_indent}    Struct(\n{body}\n{outer_indent}    ),\n{outer_indent})"
    )
    evidence = (
        f"{blocks.count} blocks of {blocks.size} bytes that begin with"
        f" {blocks.flag.hex(' ') or 'the same field'}"
    )
    return DraftField(blocks.start, blocks.end - blocks.start, "blocks", code, (evidence,))


def _iter_varying_fields(draft: Draft) -> Iterator[DraftField]:
    """Yield the field of varying length, and then the checksum after it."""
    assert draft.length is not None
    rest = draft.head_size + draft.tail_size - draft.length.rest
    name = _make_length_field_name(draft)
    if draft.length.unit > 1 and rest == 0:
        code = f'Array(this.{name}, Struct("unknown_0" / Bytes({draft.length.unit})))'
        yield DraftField(draft.head_size, 0, "samples", code)
    else:
        if draft.length.unit == 1:
            size = f"this.{name}"
        else:
            size = f"{draft.length.unit} * this.{name}"
        if rest:
            size = f"{size} - {rest}"
        lengths = {len(frame) for _, frame in draft.frames}
        step = int(np.gcd.reduce([length - min(lengths) for length in lengths]))
        evidence: tuple[str, ...] = ()
        if step > 1:
            evidence = (
                f"the lengths of frames differ by multiples of {step}, so the field may consist of"
                f" samples of {step} bytes",
            )
        yield DraftField(
            draft.head_size, 0, f"unknown_{draft.head_size}", f"Bytes({size})", evidence
        )
    if draft.tail_size and draft.checksum is not None:
        yield _make_checksum_field(draft, draft.checksum, -draft.tail_size)


def _make_length_field_name(draft: Draft) -> str:
    if draft.length is not None and draft.length.unit > 1:
        return "count"
    return "length"


def _make_checksum_field(draft: Draft, checksum: ChecksumMatch, start: int) -> DraftField:
    if checksum.evidence_bits < WEAK_EVIDENCE_BITS:
        chance = "may be a coincidence: check with more frames"
    else:
        chance = f"probability of a coincidence: 1 in {checksum.odds}"
    evidence = [
        f"correct in {checksum.right} of {checksum.total} frames, {chance}",
        *checksum.notes,
    ]
    length = min(len(frame) for _, frame in draft.frames)
    for other in draft.others[:MAX_ALTERNATIVES]:
        evidence.append(
            f"also possible: {other.source.splitlines()[0]} at byte {other.place.start(length)},"
            f" computed over {other.span.describe(other.place, length)}"
        )
    size = checksum.place.size
    code = _format_integer(size, checksum.order)
    return DraftField(start, size, "check", code, tuple(evidence))


def _format_checksum_arguments(
    draft: Draft, checksum: ChecksumMatch, fields: Sequence[DraftField]
) -> str:
    """Return the arguments of `Checksummed` that follow the struct."""
    if needs_class(checksum.algorithm):
        algorithm = "Check()"
    else:
        algorithm = checksum.source
    text = f'    field="check",\n    algorithm={algorithm},\n'
    shortest = min(len(frame) for _, frame in draft.frames)
    ranges = checksum.span.ranges(checksum.place, shortest)
    if sum(last - first for first, last in ranges) == shortest - checksum.place.size:
        return text  # it covers all other bytes, the default
    first = ranges[0][0]
    last = ranges[-1][1]
    checksum_start = checksum.place.start(shortest)
    covered_names = [
        field.name
        for field in fields
        if first <= (field.start if field.start >= 0 else checksum_start) < last
        and field.name != "check"
    ]
    over = f"{tuple(covered_names)!r}".replace("'", '"')
    return f"{text}    over={over},\n"


def _find_span_edges(draft: Draft) -> list[int]:
    """Return the offsets at which bytes covered by the checksum begin or end."""
    if draft.checksum is None or not draft.frames:
        return []
    shortest = min(len(frame) for _, frame in draft.frames)
    ranges = draft.checksum.span.ranges(draft.checksum.place, shortest)
    edges = {edge for covered in ranges for edge in covered}
    return sorted(edge for edge in edges if edge < draft.head_size)


def _find_angles(draft: Draft) -> list[str]:
    """Return the paths of all angle fields; fields in blocks of points come first."""
    paths = []
    if draft.blocks:
        paths = [
            f"blocks.{field.name}" for field in draft.blocks.rising_fields if field.kind == "angle"
        ]
    return paths + [field.name for field in draft.rising_fields if field.kind == "angle"]


def _count_fixed_bits(draft: Draft) -> int:
    """Return how many bits of a frame are constant or belong to the checksum."""
    size = len(draft.sync)
    if draft.blocks:
        size += len(draft.blocks.flag) * draft.blocks.count
    if draft.checksum:
        size += draft.checksum.place.size
    return 8 * size


def _iter_sensor_arguments(angles: Sequence[str], counters: Sequence[RisingField]) -> Iterator[str]:
    """Yield the lines with the arguments `scan` and `sequence` of the sensor."""
    if angles:
        yield f'scan=OnWrap("{angles[0]}"),{_format_alternatives("  #", angles[1:])}'
    else:
        yield "scan=Every(0.1),  # seconds; no angle was found, so revolutions are unknown"
    if counters:
        counter = counters[0]
        limits = ""
        if counter.wraps:
            limits = f", first={counter.first}, last={counter.circle - 1}"
        alternatives = _format_alternatives(";", [other.name for other in counters[1:]])
        yield (
            f'sequence=PacketCounter("{counter.name}"{limits}),'
            f"  # a jump means lost packets{alternatives}"
        )


def _format_alternatives(begin: str, names: Sequence[str]) -> str:
    """Return alternative names as the end of a comment; "" if there are none."""
    if names:
        return f"{begin} or {', '.join(names[:MAX_ALTERNATIVES])}"
    return ""


def _format_max_length(draft: Draft) -> str:
    """Return the value of `max_length`, in bytes."""
    if draft.size is not None or draft.length is None:
        return str(draft.size)
    if draft.length.size == 1:
        return str(draft.length.rest + 255 * draft.length.unit)
    return str(2 * max(len(frame) for _, frame in draft.frames))


def _make_imports(text: dict[str, str]) -> dict[str, str]:
    """Return the template values with the imports that their code requires."""
    code = "\n".join(text.values())
    construct = sorted(
        set(re.findall(r"\b(Array|Bytes|Const|Int\d+u[lb]|this(?=\.))\b", code)) | {"Struct"}
    )
    names = re.findall(
        r"\b(Check(?:sum|summed)|Crc|Every|Fletcher|Fold15|OnWrap|PacketCounter|Scaled|Serial|Sum|Udp|WordXor"
        r"|Xor)\b",
        code,
    )
    own = {"Fields", "Frame", "Polar", "Sensor", "hookimpl", *names}
    return {
        "construct_names": ", ".join(sorted(construct, key=_make_import_key)),
        "own_import": _format_import("lidarspec.spec", sorted(own, key=_make_import_key)),
        "typing": "from typing import Any\n" if "Any" in code else "",
    }


def _format_import(module: str, names: list[str]) -> str:
    """Return an import statement, on one line if it is short enough."""
    line = f"from {module} import {', '.join(names)}"
    if len(line) <= MAX_LINE_CHARS:
        return line
    return f"from {module} import (\n" + "".join(f"    {name},\n" for name in names) + ")"


def _make_import_key(name: str) -> tuple[bool, str, int]:
    """Return the sort key of a name: upper case first, and numbers by value."""
    number = re.search(r"\d+", name)
    return (
        name[0].islower(),
        name[: number.start()] if number else name,
        int(number[0]) if number else 0,
    )


def _format_integer(size: int, order: ByteOrder) -> str:
    if size > 1:
        return f"Int{8 * size}u{order[0]}"
    return "Int8ul"


def _format_bytes(data: bytes) -> str:
    return 'b"' + "".join(f"\\x{byte:02x}" for byte in data) + '"'
