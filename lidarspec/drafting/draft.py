"""Create the Python distribution of a new sensor.

`make_draft_files` drafts the sensor from a capture of unknown frames. `make_example_files` writes
an example sensor with all features.

`draft` analyses unknown frames and returns a `Draft`. It searches the beginning of a stream for a
structure, and then applies this structure to all bytes. Constant bytes at the start are the sync
bytes. Fields that rise steadily are excluded as checksums: an XOR often fits there by coincidence.
`make_template_values` writes a first spec from the `Draft`. Each field has a comment with its
evidence, and fields without evidence are named ``unknown_N``.

The files are made from templates in the package. A template line that ends in ``#if serial`` or
``#if udp`` is used only for sensors with that link.
"""

from __future__ import annotations

import itertools
import json
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import distribution
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.drafting.checksum_search import search
from lidarspec.drafting.periods import (
    CIRCLES,
    FEW,
    FRONT,
    STEADY,
    LengthField,
    RisingField,
    find_rising_fields,
    find_runs,
    find_structure,
    share_between,
    usual_bytes,
)
from lidarspec.drafting.samples import ChecksumMatch, ChecksumPlace, values
from lidarspec.errors import UsageError, WireError, system_errors
from lidarspec.spec.checksums import ByteOrder

#: Number of frames that are searched for a checksum.
MAX_CHECKSUM_FRAMES = 256
#: Longest sync, in bytes.
MAX_SYNC_BYTES = 4
#: Longest sync with few frames: more constant bytes may be coincidence.
MAX_SHORT_SYNC_BYTES = 2
#: Number of frames from which `MAX_SYNC_BYTES` applies.
MANY = 12
#: Smallest number of blocks in a frame.
MIN_BLOCKS = 3
#: Smallest share of a frame that its blocks fill.
MIN_BLOCKS_SHARE = 0.5
#: A count has to be before this offset.
HEADER = 8
#: Largest and smallest size of a counted element, in bytes.
MAX_ELEMENT_BYTES = 16
MIN_ELEMENT_BYTES = 2
#: Widest checksum, in bytes.
MAX_CHECKSUM_BYTES = 4
Link = Literal["serial", "udp"]
#: Names that the modules of the templates use otherwise.
RESERVED_NAMES = {"ACK", "COMMAND", "DATA", "RATE", "SAMPLES", "TURNS"}
#: Number of frames of a capture that are written as vectors.
VECTORS = 3
_ID = re.compile(r"([a-z0-9]+)-([a-z0-9]+(?:-[a-z0-9]+)*)")
#: Longest line of the written files, in characters.
LINE = 100
_CONDITION = re.compile(r"^(.*?) *#if (\w+)\n", re.MULTILINE)
#: Number of bytes of a constant that a comment shows.
MAX_SHOWN_BYTES = 8
#: Smallest number of adjacent constant bytes that become a field.
MIN_CONSTANT_RUN = 2
#: Longest range of unknown bytes that is searched for constant bytes. In longer ranges, which are
#: mostly measurements, bytes may be constant because the scene does not change.
MAX_CONSTANT_SEARCH_BYTES = 64
#: A checksum with a lower `ChecksumMatch.doubt` may be coincidence.
WEAK = 12
#: Number of frames after which most bits of a checksum have changed.
MIN_FRAMES_FOR_CHANGE = 16
#: Number of alternatives that a comment lists.
MAX_ALTERNATIVES = 3
#: With at most this many bits of constants and checksum, noise may pass as a frame. The draft then
#: requires two consecutive frames.
FEW_BITS = 24


@dataclass(frozen=True)
class RepeatedBlocks:
    """Repeated blocks of a frame.

    Attributes:
        start: offset of the first block.
        size: size of a block, in bytes.
        count: number of blocks.
        flag: constant first bytes of each block; may be empty.
        candidates: rising fields in the blocks.
    """

    start: int
    size: int
    count: int
    flag: bytes
    candidates: tuple[RisingField, ...] = ()

    @property
    def end(self) -> int:
        """The offset after the last block."""
        return self.start + self.count * self.size


@dataclass(frozen=True)
class Draft:
    """The known properties of the frames in some bytes.

    Attributes:
        datagrams: whether each frame is a datagram.
        sync: the first bytes of every frame.
        size: the length of the frames; None if it varies.
        length: the length field, if the length varies.
        frames: (offset, bytes) of the frames with all known properties, in order.
        bytes_in: the number of input bytes.
        candidates: rising fields outside the blocks.
        blocks: repeated blocks of a frame; None if there are none.
        seal: the checksum; None if none was found.
        others: other checksums that fit.
        front: number of first bytes that nearly all frames have, if the length field counts bytes.
            These are searched for fields.
    """

    datagrams: bool
    sync: bytes
    size: int | None
    length: LengthField | None
    frames: tuple[tuple[int, bytes], ...]
    bytes_in: int
    candidates: tuple[RisingField, ...] = ()
    blocks: RepeatedBlocks | None = None
    seal: ChecksumMatch | None = None
    others: tuple[ChecksumMatch, ...] = ()
    front: int = 0

    @property
    def share(self) -> float:
        """The share of the bytes that are in frames."""
        return sum(len(frame) for _, frame in self.frames) / self.bytes_in

    @property
    def tail(self) -> int:
        """The size of a checksum at the end of frames of varying length, else 0."""
        if self.size is None and self.seal is not None and self.seal.place.offset < 0:
            return -self.seal.place.offset
        return 0

    @property
    def head(self) -> int:
        """The number of first bytes that every frame has: the size if it does not vary."""
        if self.size is not None or self.length is None:
            return self.size or 0
        return max(self.length.rest - self.tail, self.length.end, self.front)

    @property
    def rows(self) -> NDArray[np.uint8]:
        """The first bytes of all frames, shape (n, head)."""
        return np.frombuffer(
            b"".join(frame[: self.head] for _, frame in self.frames), np.uint8
        ).reshape(-1, self.head)


def draft(chunks: Sequence[bytes], *, datagrams: bool) -> Draft:
    """Analyse the frames in unknown bytes.

    Args:
        chunks: datagrams, or pieces of a stream.
        datagrams: whether the chunks are datagrams.

    Raises:
        WireError: if no frames of one kind are found.
    """
    structure = find_structure(chunks, datagrams=datagrams)
    if structure is None:
        raise WireError(
            "no repeated frame structure found in these bytes", data=b"".join(chunks[:1])[:16]
        )
    parts = chunks if datagrams else [b"".join(chunks)]
    size = sum(map(len, chunks))
    if datagrams or structure.period is None or size % structure.period == 0:
        start = 0
    else:
        start = max(parts[0].find(structure.sync), 0)
    first = Draft(datagrams, b"", structure.period, structure.length, (), size)
    first = (
        _find_sync(first, parts, start)
        or _find_sync(first, parts, max(parts[0].find(structure.sync), 0))
        or replace(first, sync=structure.sync)
    )
    result = _find_count(replace(first, frames=tuple(_iter_frames(first, parts))), parts[-1])
    result = _find_front(result, parts)
    result = replace(result, candidates=tuple(find_rising_fields(result.rows)))
    seals = _seals(result)
    result = replace(result, seal=seals[0] if seals else None, others=tuple(seals[1:]))
    return _add_details(replace(result, frames=tuple(_iter_frames(result, parts))))


def _find_sync(first: Draft, parts: Sequence[bytes], start: int) -> Draft | None:
    """Return the draft with the sync bytes of frames of one length; None if there are none.

    Args:
        start: offset of the first frame in a stream.
    """
    if first.datagrams:
        frames = [part for part in parts if len(part) == first.size]
    elif first.size is not None:
        frames = [
            parts[0][offset : offset + first.size]
            for offset in range(start, len(parts[0]) - first.size + 1, first.size)
        ]
    else:
        return None
    rows = np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), -1)
    usual = usual_bytes(rows[:, :MAX_SYNC_BYTES])
    steady = (rows[:, : len(usual)] == usual).mean(axis=0) >= (STEADY if len(rows) >= FEW else 1)
    if not steady.all():
        length = int(np.argmin(steady))
    else:
        length = len(steady)
    sync = usual[: length if len(rows) >= MANY else min(length, MAX_SHORT_SYNC_BYTES)].tobytes()
    if any(sync):
        return replace(first, sync=sync)
    return None


def _iter_frames(draft: Draft, parts: Sequence[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield offset and bytes of the frames that fit, in order.

    After a sync that begins no valid frame, the search continues at the next byte.
    """
    base = 0
    for part in parts:
        offset = part.find(draft.sync)
        while 0 <= offset < len(part):
            size = _frame_size(draft, part, offset)
            if size:
                yield base + offset, part[offset : offset + size]
            if draft.datagrams:
                break
            offset = part.find(draft.sync, offset + (size or 1))
        base += len(part)


def _frame_size(draft: Draft, part: bytes, at: int) -> int:
    """Return the length of the frame at an offset; 0 if no valid frame begins there."""
    size = draft.size
    if size is None and draft.length is not None:
        if at + draft.length.end <= len(part):
            size = draft.length.read(part[at : at + draft.length.end])
        else:
            size = 0
    if (
        not size
        or at + size > len(part)
        or (draft.datagrams and (at or size != len(part)))
        or size < draft.head + draft.tail
    ):
        return 0
    if draft.seal is None or _has_valid_checksum(draft.seal, part[at : at + size]):
        return size
    return 0


def _has_valid_checksum(seal: ChecksumMatch, frame: bytes) -> bool:
    start = seal.place.start(len(frame))
    stored = int.from_bytes(frame[start : start + seal.place.size], seal.order)
    covered = b"".join(frame[a:b] for a, b in seal.span.ranges(seal.place, len(frame)))
    return seal.algorithm(covered) == stored


def _find_count(draft: Draft, data: bytes) -> Draft:
    """Return the draft with a length field if an incomplete last frame has another count.

    If all whole frames have one length, only the incomplete frame after them can show that a
    constant byte is a count. Otherwise the draft is returned unchanged.
    """
    if draft.size is None or draft.datagrams or not draft.frames:
        return draft
    offset, last = draft.frames[-1]
    rest = data[offset + len(last) :]
    for place in range(len(draft.sync), HEADER):
        same = len({frame[: place + 1] for _, frame in draft.frames}) == 1
        if (
            not same
            or len(rest) <= place
            or rest[:place] != last[:place]
            or rest[place] == last[place]
        ):
            continue
        lengths = [
            LengthField(place, 1, "little", unit, draft.size - unit * last[place])
            for unit in range(MIN_ELEMENT_BYTES, MAX_ELEMENT_BYTES + 1)
        ]
        fitting = [
            length for length in lengths if length.rest > place and length.read(rest) > len(rest)
        ]
        if fitting:
            return replace(draft, size=None, length=min(fitting, key=lambda length: length.rest))
    return draft


def _find_front(draft: Draft, parts: Sequence[bytes]) -> Draft:
    """Return the draft with `front` if the length field counts bytes.

    Frames that are shorter than `front` are then dropped, since they are probably of another type.
    """
    if draft.length is None or draft.length.unit > 1 or not draft.frames:
        return draft
    lengths = sorted(len(frame) for _, frame in draft.frames)
    draft = replace(
        draft, front=min(FRONT, lengths[int(len(lengths) * (1 - STEADY))] - MAX_CHECKSUM_BYTES)
    )
    return replace(draft, frames=tuple(_iter_frames(draft, parts)))


def _seals(draft: Draft) -> list[ChecksumMatch]:
    """Return the matching checksums, except at rising or nearly constant bytes."""
    frames = [frame for _, frame in draft.frames]
    step = max(1, len(frames) // MAX_CHECKSUM_FRAMES)
    shortest = min(map(len, frames), default=0)
    some = frames[::step][:MAX_CHECKSUM_FRAMES]
    free = (
        match
        for match in search(some)
        if not any(_overlaps(match.place, one, shortest) for one in draft.candidates)
    )
    return [match for match in free if _is_declarable(draft, match) and _changes(match, some)]


def _changes(match: ChecksumMatch, frames: Sequence[bytes]) -> bool:
    """Return whether most bits of a checksum change; True if there are few frames."""
    starts = [match.place.start(len(frame)) for frame in frames]
    stored = [
        int.from_bytes(frame[start : start + match.place.size])
        for frame, start in zip(frames, starts, strict=True)
    ]
    changing = np.bitwise_or.reduce([value ^ stored[0] for value in stored])
    return (
        len(frames) < MIN_FRAMES_FOR_CHANGE or 2 * int(changing).bit_count() > 8 * match.place.size
    )


def _overlaps(place: ChecksumPlace, one: RisingField, length: int) -> bool:
    start = place.start(length)
    return start < one.end and one.offset < start + place.size


def _is_declarable(draft: Draft, match: ChecksumMatch) -> bool:
    """Return whether a struct can declare the checksum.

    It must not be in the part of varying length or split into nibbles, and has to cover one range.
    """
    if any("nibbles" in remark for remark in match.remarks):
        return False
    place, span = match.place, match.span
    whole = (span.part, span.head, span.tail) == ("all", 0, 0) or (span.part, span.tail) == (
        "before",
        0,
    )
    at_end = place.offset == -place.size
    if draft.size is None and not at_end:
        return 0 <= place.offset <= draft.head - place.size and whole
    return whole or at_end or span.part == "behind"


def _add_details(draft: Draft) -> Draft:
    """Return the draft with rising fields and blocks, except for fields at the checksum."""
    if not draft.frames:
        return draft
    rows = draft.rows
    rising = draft.candidates
    if draft.size is not None:
        blocks = _find_flagged_blocks(rows) or _find_blocks_of_fields(rising, rows.shape[1])
    else:
        blocks = None
    if blocks is not None:
        inside = rows[:, blocks.start : blocks.end].reshape(-1, blocks.size)
        within = tuple(one for one in find_rising_fields(inside) if one.offset >= len(blocks.flag))
        if blocks.flag or any(one.offset == 0 for one in within):
            blocks = replace(blocks, candidates=within)
        else:
            blocks = None
    if blocks is not None:
        rising = tuple(one for one in rising if one.end <= blocks.start or one.offset >= blocks.end)
    shortest = min(len(frame) for _, frame in draft.frames)
    free = tuple(
        one
        for one in rising
        if draft.seal is None or not _overlaps(draft.seal.place, one, shortest)
    )
    return replace(
        draft, candidates=tuple(one for one in free if one.offset >= len(draft.sync)), blocks=blocks
    )


def _find_flagged_blocks(rows: NDArray[np.uint8]) -> RepeatedBlocks | None:
    """Return blocks that begin with the same two bytes and fill much of the frame."""
    first, steady = rows[0], (rows == rows[0]).mean(axis=0) >= STEADY
    pairs: dict[tuple[int, int], list[int]] = {}
    for offset in np.flatnonzero(steady[:-1] & steady[1:]).tolist():
        pairs.setdefault((int(first[offset]), int(first[offset + 1])), []).append(offset)
    blocks_found = []
    for pair, offsets in pairs.items():
        steps = np.diff(offsets)
        if (
            pair in ((0, 0), (255, 255))
            or len(offsets) < MIN_BLOCKS
            or (steps != steps[0]).any()
            or steps[0] <= 2
        ):
            continue
        size = int(steps[0])
        count = min(len(offsets), (rows.shape[1] - offsets[0]) // size)
        if count >= MIN_BLOCKS and count * size >= MIN_BLOCKS_SHARE * rows.shape[1]:
            blocks_found.append(RepeatedBlocks(offsets[0], size, count, bytes(pair)))
    return max(blocks_found, key=lambda blocks: blocks.count * blocks.size, default=None)


def _find_blocks_of_fields(fields: Sequence[RisingField], length: int) -> RepeatedBlocks | None:
    """Return the largest blocks that each begin with a rising field of one kind."""
    rows = []
    for one in fields:
        like = [(one.size, one.order, one.kind, one.circle)]
        same = [
            other.offset
            for other in fields
            if (other.size, other.order, other.kind, other.circle) in like
            and other.offset >= one.offset
        ]
        for step in {offset - one.offset for offset in same[1:]}:
            count = next(
                number for number in itertools.count(1) if one.offset + number * step not in same
            )
            count -= one.offset + count * step > length
            if count >= MIN_BLOCKS:
                rows.append(RepeatedBlocks(one.offset, step, count, b""))
    return max(rows, key=lambda blocks: blocks.count * blocks.size, default=None)


@dataclass(frozen=True)
class DraftField:
    """A field of the drafted struct.

    Attributes:
        start: its offset.
        size: its size in bytes.
        name: its name.
        code: the construct expression after the name.
        why: the evidence, one comment each.
    """

    start: int
    size: int
    name: str
    code: str
    why: tuple[str, ...] = ()

    def lines(self, indent: str) -> Iterator[str]:
        """Yield the lines of code of the field."""
        for line in self.why:
            yield from textwrap.wrap(
                line, LINE, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}#   "
            )
        gap = f"\n{indent}" if "\n" in self.code else " "
        yield f'{indent}"{self.name}"{gap}/ {self.code},'


def make_template_values(draft: Draft, *, origin: str, link: str) -> dict[str, str]:
    """Return the values for the template of a module: imports, struct, functions and arguments.

    Args:
        origin: a description of the capture.
        link: the code of the data link.
    """
    fields = list(_fields(draft))
    seal = _seal_text(draft, fields)
    angles = _angles(draft)
    lines = [line for field in fields for line in field.lines(" " * (8 if seal else 4))]
    body = "\n".join(lines)
    if seal:
        struct = f"Checksummed(\n    Struct(\n{body}\n    ),\n{seal[0]})"
    else:
        struct = f"Struct(\n{body}\n)"
    below = [f"f.{path} < 360" for path in angles if "." not in path]
    if len(below) == 1:
        plausible = below[0]
    else:
        plausible = " & ".join(f"({one})" for one in below)
    check = (
        'def plausible(f: Fields) -> Any:\n    """Angles below 360 degrees."""\n'
        f"    return {plausible}\n\n\n"
    )
    is_weak = not draft.datagrams and not below and _strength(draft) <= FEW_BITS
    counting = (
        one for one in draft.candidates if one.kind == "counter" and one.offset < draft.head
    )
    # The most regular counter comes first.
    counters = sorted(counting, key=lambda one: (-one.right / one.total, -one.size))
    text = {
        "frames_told": (
            f"{len(draft.frames)} frame{'s' * (len(draft.frames) != 1)},"
            f" {draft.share:.1%} of its {draft.bytes_in} bytes"
        ),
        "origin": origin,
        "checksum_class": f"\n{seal[1]}\n\n\n" if seal and seal[1] else "",
        "sealed": ""
        if seal
        else "# No checksum was found: XORs, sums and CRCs of 8, 16 and 32 bits were tried.\n",
        "struct": struct,
        "plausible": check if below else "",
        "azimuth": f"np.deg2rad(f.{angles[0]})" if angles else "np.zeros(1)",
        "distance": f"0 * f.{angles[0]}" if angles else "np.zeros(1)",
        "arguments": "".join(f"    {line}\n" for line in _arguments(angles, counters)),
        "frame_arguments": ", ".join(
            [
                f"max_length={_longest(draft)}",
                *["plausible=plausible"] * bool(below),
                *["confirm=2"] * is_weak,
            ]
        ),
        "link_code": link,
    }
    return {**text, **_imports(text)}


def _fields(draft: Draft) -> Iterator[DraftField]:
    """Yield the fields of a frame in their order."""
    rows = draft.rows
    known_fields = _known_fields(draft)
    cuts = sorted(
        {
            0,
            draft.head,
            *_span_cuts(draft),
            *(
                edge
                for known_field in known_fields
                for edge in (known_field.start, known_field.start + known_field.size)
            ),
        }
    )
    offset = 0
    for field in [*known_fields, DraftField(draft.head, 0, "", "")]:
        yield from _gap(rows, offset, field.start, cuts)
        if field.name:
            yield field
        offset = field.start + field.size
    if draft.size is None and draft.length is not None:
        yield from _varying(draft)


def _known_fields(draft: Draft) -> list[DraftField]:
    """Return the fields with evidence, without overlaps, by offset."""
    fields = list(_header(draft))
    if (length := draft.length) is not None:
        sizes = sorted({len(frame) for _, frame in draft.frames})
        of_one = f"complete frames of {sizes[0]} bytes, and a part of another"
        why = (
            f"length of the frame, {length}: "
            f"{of_one if len(sizes) == 1 else f'frames of {sizes[0]} to {sizes[-1]} bytes'}"
        )
        fields.append(
            DraftField(
                length.place,
                length.size,
                _counter_name(draft),
                _integer(length.size, length.order),
                (why,),
            )
        )
    if draft.seal is not None and not draft.tail:
        fields.append(_check(draft, draft.seal, draft.seal.place.start(draft.head)))
    if draft.blocks is not None:
        fields.append(_block_field(draft, draft.blocks))
    fields += [_rising(draft, one) for one in draft.candidates]
    chosen: list[DraftField] = []
    for field in fields:
        if all(
            field.start + field.size <= other.start or other.start + other.size <= field.start
            for other in chosen
        ):
            chosen.append(field)
    return sorted(chosen, key=lambda field: field.start)


def _header(draft: Draft) -> Iterator[DraftField]:
    """Yield the sync bytes as fields, split at the borders of the checksum's span.

    Sync bytes that belong to the first block are left out.
    """
    if draft.blocks is None:
        end = len(draft.sync)
    else:
        end = min(len(draft.sync), draft.blocks.start)
    edges = [0, *(cut for cut in _span_cuts(draft) if 0 < cut < end), end]
    for a, b in itertools.pairwise(edges):
        if b > a:
            why = (f"{len(draft.frames)} frames begin with it",) if a == 0 else ()
            yield DraftField(
                a, b - a, f"header_{a}" if a else "header", f"Const({_bytes(draft.sync[a:b])})", why
            )


def _gap(
    rows: NDArray[np.uint8], start: int, end: int, cuts: Sequence[int]
) -> Iterator[DraftField]:
    """Yield fields for the bytes between two known fields.

    The gap is split at `cuts`, the borders of the checksum's span, and at the borders of constant
    bytes.
    """
    edges = {start, end, *(cut for cut in cuts if start < cut < end)}
    if len(rows) >= FEW and end - start <= MAX_CONSTANT_SEARCH_BYTES:
        edges |= _constant_edges(rows, start, end)
    for a, b in itertools.pairwise(sorted(edges)):
        yield DraftField(a, b - a, f"unknown_{a}", f"Bytes({b - a})", _constant(rows[:, a:b]))


def _constant_edges(rows: NDArray[np.uint8], start: int, end: int) -> set[int]:
    """Return the start and end offsets of runs of constant bytes."""
    steady = (rows[:, start:end] == rows[0, start:end]).all(axis=0)
    return {
        start + edge
        for run in find_runs(steady)
        if run[1] - run[0] >= MIN_CONSTANT_RUN
        for edge in run
    }


def _constant(columns: NDArray[np.uint8]) -> tuple[str, ...]:
    """Return a comment with the value of constant bytes; nothing for other bytes."""
    if not columns.size or not (columns == columns[0]).all():
        return ()
    is_long = columns.shape[1] > MAX_SHOWN_BYTES
    if is_long and (columns[0] == columns[0, 0]).all():
        value = f"{columns[0, 0]:02x}"
    else:
        value = columns[0, :MAX_SHOWN_BYTES].tobytes().hex(" ") + (" ..." if is_long else "")
    return (f"always {value} in {len(columns)} frames",)


def _rising(draft: Draft, one: RisingField, what: str = "frame") -> DraftField:
    """Return the field for a counter, an angle or another rising field.

    Args:
        what: "frame" or "block": the part that contains the field.
    """
    code = _integer(one.size, one.order)
    why: tuple[str, ...] = (one.why(what),)
    if one.kind == "angle":
        code = f'Scaled({code}, {CIRCLES[one.circle][0]:g}, "deg")'
    if what == "frame":
        for other in draft.candidates:
            same = (
                other.circle == one.circle
                and other.kind == one.kind != "counter"
                and other.offset < one.offset
            )
            first, last = (
                values(draft.rows, each.offset, each.size, each.order) for each in (other, one)
            )
            if same and share_between(first, last, one.circle) > 1 - 1 / FEW:
                why = (
                    *why,
                    (
                        f"lies between this frame's {other.name} and the next one's:"
                        " the angle of the last sample?"
                    ),
                )
                break
    return DraftField(one.offset, one.size, one.name, code, why)


def _block_field(draft: Draft, blocks: RepeatedBlocks) -> DraftField:
    rows = draft.rows[:, blocks.start : blocks.end].reshape(-1, blocks.size)
    fields, at = (
        [DraftField(0, len(blocks.flag), "flag", f"Const({_bytes(blocks.flag)})")]
        if blocks.flag
        else [],
        len(blocks.flag),
    )
    for one in [
        *(_rising(draft, each, "block") for each in blocks.candidates),
        DraftField(blocks.size, 0, "", ""),
    ]:
        fields += _gap(rows, at, one.start, ())
        fields += [one] if one.name else []
        at = one.start + one.size
    indent = " " * (16 if draft.seal else 12)
    body = "\n".join(line for field in fields for line in field.lines(indent))
    code = (
        f"Array(\n{indent[8:]}    {blocks.count},\n"
        f"{indent[8:]}    Struct(\n{body}\n{indent[8:]}    ),\n{indent[8:]})"
    )
    why = (
        f"{blocks.count} blocks of {blocks.size} bytes that begin with"
        f" {blocks.flag.hex(' ') or 'the same field'}"
    )
    return DraftField(blocks.start, blocks.end - blocks.start, "blocks", code, (why,))


def _varying(draft: Draft) -> Iterator[DraftField]:
    """Yield the part of varying length, and the checksum after it."""
    assert draft.length is not None
    rest, name = draft.head + draft.tail - draft.length.rest, _counter_name(draft)
    if draft.length.unit > 1 and rest == 0:
        yield DraftField(
            draft.head,
            0,
            "samples",
            f'Array(this.{name}, Struct("unknown_0" / Bytes({draft.length.unit})))',
        )
    else:
        if draft.length.unit == 1:
            number = f"this.{name}"
        else:
            number = f"{draft.length.unit} * this.{name}"
        lengths = {len(frame) for _, frame in draft.frames}
        step = int(np.gcd.reduce([length - min(lengths) for length in lengths]))
        why = (
            (f"their lengths differ by multiples of {step}: samples of {step} bytes?",)
            if step > 1
            else ()
        )
        yield DraftField(
            draft.head,
            0,
            f"unknown_{draft.head}",
            f"Bytes({number} - {rest})" if rest else f"Bytes({number})",
            why,
        )
    if draft.tail and draft.seal is not None:
        yield _check(draft, draft.seal, -draft.tail)


def _counter_name(draft: Draft) -> str:
    if draft.length is not None and draft.length.unit > 1:
        return "count"
    return "length"


def _check(draft: Draft, seal: ChecksumMatch, start: int) -> DraftField:
    if seal.doubt < WEAK:
        chance = "may be chance: compare with more frames"
    else:
        chance = f"1 in {seal.odds} by chance"
    why = (
        f"correct in {seal.right} of {seal.total} frames, {chance}",
        *(one for one in seal.remarks if "constant" not in one),
    )
    size = min(len(frame) for _, frame in draft.frames)
    for other in draft.others[:MAX_ALTERNATIVES]:
        why = (
            *why,
            (
                f"or {other.paste.splitlines()[0]} at byte {other.place.start(size)}"
                f" over {other.span.describe(other.place, size)}"
            ),
        )
    return DraftField(start, seal.place.size, "check", _integer(seal.place.size, seal.order), why)


def _seal_text(draft: Draft, fields: Sequence[DraftField]) -> tuple[str, str] | None:
    """Return the arguments of `Checksummed` after its struct, and the class of the checksum.

    The class is "" for an algorithm that lidarspec has. None if there is no checksum.
    """
    if draft.seal is None:
        return None
    own = draft.seal.paste.startswith("class ")
    if own:
        algorithm = "Check()"
    else:
        algorithm = draft.seal.paste.splitlines()[0]
    over = ""
    shortest = min(len(frame) for _, frame in draft.frames)
    ranges = draft.seal.span.ranges(draft.seal.place, shortest)
    if sum(b - a for a, b in ranges) < shortest - draft.seal.place.size:
        (first, last), place = (ranges[0][0], ranges[-1][1]), draft.seal.place.start(shortest)
        inside = [
            field.name
            for field in fields
            if first <= (field.start if field.start >= 0 else place) < last
            and field.name != "check"
        ]
        over = f"    over={tuple(inside)!r},\n".replace("'", '"')
    typed = draft.seal.paste.replace("(self, data):", "(self, data: Any) -> int:").replace(
        "(self):", "(self) -> str:"
    )
    return f'    field="check",\n    algorithm={algorithm},\n{over}', typed if own else ""


def _span_cuts(draft: Draft) -> list[int]:
    """Return the borders of the checksum's span in the head."""
    if draft.seal is None or not draft.frames:
        return []
    shortest = min(len(frame) for _, frame in draft.frames)
    edges = {edge for span in draft.seal.span.ranges(draft.seal.place, shortest) for edge in span}
    return sorted(edge for edge in edges if edge < draft.head)


def _angles(draft: Draft) -> list[str]:
    """Return the paths of the angles, those of blocks first."""
    if draft.blocks:
        inside = [f"blocks.{one.name}" for one in draft.blocks.candidates if one.kind == "angle"]
    else:
        inside = []
    return inside + [one.name for one in draft.candidates if one.kind == "angle"]


def _strength(draft: Draft) -> int:
    """Return the number of bits of constants and checksum in a frame."""
    if draft.blocks:
        flags = len(draft.blocks.flag) * draft.blocks.count
    else:
        flags = 0
    return 8 * (len(draft.sync) + flags + (draft.seal.place.size if draft.seal else 0))


def _arguments(angles: Sequence[str], counters: Sequence[RisingField]) -> Iterator[str]:
    yield (
        f'scan=OnWrap("{angles[0]}"),{_or(angles[1:])}'
        if angles
        else "scan=Every(0.1),  # seconds: no angle found that marks a revolution"
    )
    if counters:
        one = counters[0]
        if one.wraps:
            limits = f", first={one.first}, last={one.circle - 1}"
        else:
            limits = ""
        yield (
            f'sequence=Sequence("{one.name}"{limits}),'
            f"  # a jump is a loss{_or([other.name for other in counters[1:]], '')}"
        )


def _or(names: Sequence[str], begin: str = "  #") -> str:
    """Return the alternatives as the end of a comment."""
    if names:
        return f"{begin or ';'} or {', '.join(names[:MAX_ALTERNATIVES])}"
    return ""


def _longest(draft: Draft) -> str:
    if draft.size is not None or draft.length is None:
        return str(draft.size)
    longest = max(len(frame) for _, frame in draft.frames)
    return str(
        draft.length.rest + 255 * draft.length.unit if draft.length.size == 1 else 2 * longest
    )


def _imports(text: dict[str, str]) -> dict[str, str]:
    """Return the template values with the imports that the text needs."""
    code = "\n".join(text.values())
    construct = sorted(
        set(re.findall(r"\b(Array|Bytes|Const|Int\d+u[lb]|this(?=\.))\b", code)) | {"Struct"}
    )
    names = re.findall(
        r"\b(Check(?:sum|summed)|Crc|Every|Fold15|OnWrap|Scaled|Sequence|Serial|Sum|Udp|WordXor|Xor)\b",
        code,
    )
    own = {"Fields", "Frame", "Polar", "Sensor", "hookimpl", *names}
    return {
        "construct_names": ", ".join(sorted(construct, key=_case)),
        "own_import": _import("lidarspec.spec", sorted(own, key=_case)),
        "typing": "from typing import Any\n" if "Any" in code else "",
    }


def _import(module: str, names: list[str]) -> str:
    """Return an import statement, on one line if it fits."""
    line = f"from {module} import {', '.join(names)}"
    if len(line) <= LINE:
        return line
    return f"from {module} import (\n" + "".join(f"    {name},\n" for name in names) + ")"


def _case(name: str) -> tuple[bool, str, int]:
    """Sort key: names in upper case first, and numbers by value."""
    number = re.search(r"\d+", name)
    return (
        name[0].islower(),
        name[: number.start()] if number else name,
        int(number[0]) if number else 0,
    )


def _integer(size: int, order: ByteOrder) -> str:
    if size > 1:
        return f"Int{8 * size}u{order[0]}"
    return "Int8ul"


def _bytes(data: bytes) -> str:
    return 'b"' + "".join(f"\\x{byte:02x}" for byte in data) + '"'


@dataclass(frozen=True)
class DistributionNames:
    """The names in the distribution of a sensor.

    Args:
        id: the id of the sensor.
        distribution: the name of the distribution; by default "lidarspec-" and the id.
        vendor, model: display names; by default derived from the id.

    Raises:
        UsageError: for an invalid id or distribution name, and for a vendor or model that a Python
            string cannot contain without escapes.
    """

    id: str
    distribution: str = ""
    vendor: str = ""
    model: str = ""

    def __post_init__(self) -> None:
        if not _ID.fullmatch(self.id):
            raise UsageError(
                f"{self.id!r} is not a valid id: expected vendor-model in lower case, such as"
                " acme-x1"
            )
        vendor, _, model = self.id.partition("-")
        defaults = {
            "distribution": f"lidarspec-{self.id}",
            "vendor": vendor.capitalize(),
            "model": model.upper(),
        }
        for name, default in defaults.items():
            object.__setattr__(self, name, getattr(self, name) or default)
        if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", self.distribution):
            raise UsageError(
                f"{self.distribution!r} is not a valid name of a distribution: expected lower case"
                " with hyphens, such as lidarspec-acme"
            )
        if unfit := re.search(r'["\\\n]', self.vendor + self.model):
            raise UsageError(f"vendor and model must not contain {unfit[0]!r}")

    @property
    def constant(self) -> str:
        """The name of the variable for the sensor in its module."""
        name = self.id.partition("-")[2].upper().replace("-", "_")
        if name.isidentifier() and name not in RESERVED_NAMES:
            return name
        return f"SENSOR_{name}"

    @property
    def module(self) -> str:
        """The import name of the distribution."""
        return self.distribution.replace("-", "_")

    def values(self) -> dict[str, str]:
        """Return the values for the templates."""
        return {
            name: getattr(self, name)
            for name in ("id", "constant", "distribution", "module", "vendor", "model")
        }


def make_example_files(names: DistributionNames, link: Link) -> dict[str, str]:
    """Return the files of a distribution with an example sensor: path -> text."""
    values = {**names.values(), "speed_remark": ", if code is 3" if link == "serial" else ""}
    return _files(
        names,
        link,
        values,
        fill_template("vectors.json", values, link),
        ("README.md", "module.py", "test_module.py"),
    )


def make_draft_files(
    names: DistributionNames, link: Link, draft: Draft, *, origin: str, port: int | None
) -> dict[str, str]:
    """Return the files of a distribution with a sensor drafted from a capture: path -> text.

    Args:
        origin: a description of the capture.
        port: the UDP port that the datagrams were sent to; None if unknown.
    """
    serial = "Serial(115_200)},  # baud rate: a capture does not contain it"
    if port:
        udp = f"Udp({port})}},  # destination of the captured datagrams"
    else:
        udp = "Udp(2368)},  # port: this capture does not contain it"
    values = {
        **names.values(),
        **make_template_values(draft, origin=origin, link=serial if link == "serial" else udp),
    }
    frames = [
        {
            "sensor": names.id,
            "frame": "data",
            "hex": data.hex(" "),
            "values": {},
            "source": f"{origin}, at byte {offset}",
        }
        for offset, data in draft.frames[:VECTORS]
    ]
    return _files(
        names,
        link,
        values,
        json.dumps(frames, indent=2) + "\n",
        ("README_draft.md", "draft.py", "test_draft.py"),
    )


def _files(
    names: DistributionNames,
    link: Link,
    values: Mapping[str, str],
    vectors: str,
    templates: tuple[str, str, str],
) -> dict[str, str]:
    """Return the files of a distribution: path -> text.

    Args:
        vectors: the text of the file of vectors.
        templates: the names of the templates of README, module and tests.
    """
    readme, module, tests = (fill_template(template, values, link) for template in templates)
    return {
        "pyproject.toml": fill_template("pyproject.toml", values, link),
        "README.md": readme,
        "LICENSE": distribution("lidarspec").read_text("licenses/LICENSE") or "",
        f"{names.module}/__init__.py": module,
        f"{names.module}/py.typed": "",
        f"{names.module}/vectors.json": vectors,
        f"tests/test_{names.id.replace('-', '_')}.py": tests,
    }


def fill_template(template: str, values: Mapping[str, str], link: Link) -> str:
    """Return the text of a template with values inserted."""
    text = (files("lidarspec") / "templates" / f"{template}.in").read_text(encoding="utf-8")
    chosen = _CONDITION.sub(lambda line: f"{line[1]}\n" if line[2] == link else "", text)
    return Template(chosen).substitute(values)


#: The section of pyproject.toml that lists the sensors.
_LISTED = '[project.entry-points."lidarspec.sensors"]\n'


def add_to_distribution(
    folder: Path, names: DistributionNames, texts: Mapping[str, str]
) -> dict[str, str]:
    """Return the new and changed files that add a sensor to an existing distribution.

    Args:
        folder: the folder of the distribution.
        texts: the files of a distribution with only this sensor.

    Raises:
        UsageError: if the folder has another distribution, or already has such a sensor.
        SourceError: if its files cannot be read.
    """
    listed = f"{names.module}/vectors.json"
    with system_errors(folder):
        project, readme = (
            (folder / name).read_text(encoding="utf-8") for name in ("pyproject.toml", "README.md")
        )
        if (folder / listed).exists():
            vectors = (folder / listed).read_text(encoding="utf-8")
        else:
            vectors = "[]"
    if f'name = "{names.distribution}"\n' not in project or _LISTED not in project:
        raise UsageError(
            f"{folder / 'pyproject.toml'} does not belong to {names.distribution},"
            " or has no entry points lidarspec.sensors"
        )
    part = names.id.partition("-")[2].replace("-", "_")
    part = part if part.isidentifier() else f"model_{part}"
    test = f"tests/test_{names.id.replace('-', '_')}.py"
    new = {f"{names.module}/{part}.py": texts[f"{names.module}/__init__.py"], test: texts[test]}
    for name in new:
        if (folder / name).exists():
            raise UsageError(f"{folder / name} exists already: nothing was written")
    entry = f'{names.id} = "{names.module}.{part}:{names.constant}"\n'
    own, before = (
        texts[listed].strip().removeprefix("["),
        vectors.rstrip().removesuffix("]").rstrip(),
    )
    return {
        **new,
        "pyproject.toml": project.replace(_LISTED, _LISTED + entry),
        listed: f"{before}{'' if before == '[' else ','}{own}\n",
        "README.md": (
            f"{readme.rstrip()}\n\n"
            f"The {names.vendor} {names.model}, `{names.id}`,"
            f" stands in `{names.module}/{part}.py`.\n"
        ),
    }


def write_files(folder: Path, texts: Mapping[str, str]) -> None:
    """Write files into a folder.

    Raises:
        SourceError: if a file cannot be written.
    """
    with system_errors(folder):
        for name, text in texts.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
