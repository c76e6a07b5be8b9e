"""Analyse unknown frames, and describe them in a `Draft`.

`make_draft` finds the structure of the frames at the beginning of a stream, and then splits all
bytes into frames. Constant bytes at the start of frames are the sync bytes. A field with steadily
rising values is not accepted as a checksum, because an XOR often matches such a field by
coincidence.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarspec.drafting.checksum_search import search
from lidarspec.drafting.periods import (
    FEW_FRAMES,
    HEAD_SEARCH_BYTES,
    MIN_CONSTANT_SHARE,
    LengthField,
    RisingField,
    find_rising_fields,
    find_structure,
    find_usual_bytes,
)
from lidarspec.drafting.samples import ChecksumMatch, ChecksumPlace
from lidarspec.errors import WireError

#: The maximum number of frames to use in the search for a checksum.
MAX_CHECKSUM_FRAMES = 256
#: The maximum number of sync bytes.
MAX_SYNC_BYTES = 4
#: The maximum number of sync bytes if there are fewer than `MANY_FRAMES` frames, because further
#: constant bytes may be coincidence.
MAX_SHORT_SYNC_BYTES = 2
#: From this number of frames on, constant bytes are probably not coincidence.
MANY_FRAMES = 12
#: The smallest number of blocks in a frame.
MIN_BLOCKS = 3
#: The smallest share of a frame that its blocks fill.
MIN_BLOCKS_SHARE = 0.5
#: A field with the number of elements must begin before this offset.
MAX_COUNT_OFFSET = 8
#: The smallest and the largest size of a counted element, in bytes.
MIN_ELEMENT_BYTES = 2
MAX_ELEMENT_BYTES = 16
#: The width of the widest checksum, in bytes.
MAX_CHECKSUM_BYTES = 4
#: In at least this number of frames, most bits of a checksum change.
MIN_FRAMES_FOR_CHANGE = 16


@dataclass(frozen=True)
class RepeatedBlocks:
    """Repeated blocks of a frame.

    Attributes:
        start: offset of the first block, in bytes.
        size: size of a block, in bytes.
        count: number of blocks.
        flag: the constant first bytes of each block; b"" if there are none.
        candidates: the fields with rising values in a block.
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
        size: the length of the frames, in bytes; None if it varies.
        length: the length field; None if all frames have one length.
        frames: the offset and the bytes of each frame that has all known properties, in order.
        bytes_in: number of input bytes.
        candidates: the fields with rising values outside the blocks.
        blocks: repeated blocks of a frame; None if a frame has no blocks.
        checksum: the checksum; None if none was found.
        others: other checksums that match.
        common_bytes: if the length field counts bytes, the number of bytes at the start of nearly
            all frames in which fields are searched; otherwise 0.
    """

    datagrams: bool
    sync: bytes
    size: int | None
    length: LengthField | None
    frames: tuple[tuple[int, bytes], ...]
    bytes_in: int
    candidates: tuple[RisingField, ...] = ()
    blocks: RepeatedBlocks | None = None
    checksum: ChecksumMatch | None = None
    others: tuple[ChecksumMatch, ...] = ()
    common_bytes: int = 0

    @property
    def share(self) -> float:
        """The share of the input bytes that are in frames, from 0 to 1."""
        return sum(len(frame) for _, frame in self.frames) / self.bytes_in

    @property
    def tail_size(self) -> int:
        """The size of a checksum at the end of frames of varying length; otherwise 0."""
        if self.size is None and self.checksum is not None and self.checksum.place.offset < 0:
            return -self.checksum.place.offset
        return 0

    @property
    def head_size(self) -> int:
        """The number of bytes before the part of varying length.

        It is the length of the frame if all frames have the same length.
        """
        if self.size is not None or self.length is None:
            return self.size or 0
        return max(self.length.rest - self.tail_size, self.length.end, self.common_bytes)

    @property
    def rows(self) -> NDArray[np.uint8]:
        """The first bytes of all frames, shape (n, head_size)."""
        return np.frombuffer(
            b"".join(frame[: self.head_size] for _, frame in self.frames), np.uint8
        ).reshape(-1, self.head_size)


def make_draft(chunks: Sequence[bytes], *, datagrams: bool) -> Draft:
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
            "these bytes have no repeated frame structure", data=b"".join(chunks[:1])[:16]
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
    result = _find_common_bytes(result, parts)
    result = replace(result, candidates=tuple(find_rising_fields(result.rows)))
    checksums = _find_checksums(result)
    if checksums:
        result = replace(result, checksum=checksums[0], others=tuple(checksums[1:]))
    return _find_blocks(replace(result, frames=tuple(_iter_frames(result, parts))))


def _find_sync(first: Draft, parts: Sequence[bytes], start: int) -> Draft | None:
    """Return the draft with its sync bytes; None if none are found.

    Sync bytes are searched only if all frames have the same length.

    Args:
        first: the draft without sync bytes.
        parts: the datagrams, or the whole stream.
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
    usual = find_usual_bytes(rows[:, :MAX_SYNC_BYTES])
    min_share = MIN_CONSTANT_SHARE if len(rows) >= FEW_FRAMES else 1
    is_constant = (rows[:, : len(usual)] == usual).mean(axis=0) >= min_share
    if is_constant.all():
        length = len(is_constant)
    else:
        length = int(np.argmin(is_constant))
    if len(rows) < MANY_FRAMES:
        length = min(length, MAX_SHORT_SYNC_BYTES)
    sync = usual[:length].tobytes()
    if any(sync):
        return replace(first, sync=sync)
    return None


def _iter_frames(draft: Draft, parts: Sequence[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield (offset, bytes) of each frame that has the properties in the draft, in order."""
    base = 0
    for part in parts:
        offset = part.find(draft.sync)
        while 0 <= offset < len(part):
            size = _measure_frame(draft, part, offset)
            if size:
                yield base + offset, part[offset : offset + size]
            if draft.datagrams:
                break
            offset = part.find(draft.sync, offset + (size or 1))
        base += len(part)


def _measure_frame(draft: Draft, part: bytes, offset: int) -> int:
    """Return the length of the frame at an offset; 0 if no valid frame begins there."""
    size = draft.size
    if size is None and draft.length is not None:
        if offset + draft.length.end <= len(part):
            size = draft.length.read(part[offset : offset + draft.length.end])
        else:
            size = 0
    if (
        not size
        or offset + size > len(part)
        or (draft.datagrams and (offset or size != len(part)))
        or size < draft.head_size + draft.tail_size
    ):
        return 0
    frame = part[offset : offset + size]
    if draft.checksum is None or _has_valid_checksum(draft.checksum, frame):
        return size
    return 0


def _has_valid_checksum(checksum: ChecksumMatch, frame: bytes) -> bool:
    start = checksum.place.start(len(frame))
    stored = int.from_bytes(frame[start : start + checksum.place.size], checksum.order)
    ranges = checksum.span.ranges(checksum.place, len(frame))
    covered = b"".join(frame[first:last] for first, last in ranges)
    return checksum.algorithm(covered) == stored


def _find_count(draft: Draft, data: bytes) -> Draft:
    """Search for a length field with the help of an incomplete frame at the end.

    A byte that is equal in all other frames, but not in the incomplete frame, is probably a number
    of elements. The result is the draft with this length field, or the unchanged draft.

    Args:
        draft: the draft.
        data: the last datagram, or the whole stream.
    """
    if draft.size is None or draft.datagrams or not draft.frames:
        return draft
    offset, last = draft.frames[-1]
    rest = data[offset + len(last) :]
    for offset in range(len(draft.sync), MAX_COUNT_OFFSET):
        is_constant = len({frame[: offset + 1] for _, frame in draft.frames}) == 1
        if (
            not is_constant
            or len(rest) <= offset
            or rest[:offset] != last[:offset]
            or rest[offset] == last[offset]
        ):
            continue
        lengths = [
            LengthField(offset, 1, "little", unit, draft.size - unit * last[offset])
            for unit in range(MIN_ELEMENT_BYTES, MAX_ELEMENT_BYTES + 1)
        ]
        # The last frame is incomplete, so its length must be more than the rest of the data.
        fitting = [
            length for length in lengths if length.rest > offset and length.read(rest) > len(rest)
        ]
        if fitting:
            return replace(draft, size=None, length=min(fitting, key=lambda length: length.rest))
    return draft


def _find_common_bytes(draft: Draft, parts: Sequence[bytes]) -> Draft:
    """Return the draft with `common_bytes`, and without frames that are shorter than that.

    Shorter frames are probably of another type.
    """
    if draft.length is None or draft.length.unit > 1 or not draft.frames:
        return draft
    lengths = sorted(len(frame) for _, frame in draft.frames)
    short_length = lengths[int(len(lengths) * (1 - MIN_CONSTANT_SHARE))]
    draft = replace(draft, common_bytes=min(HEAD_SEARCH_BYTES, short_length - MAX_CHECKSUM_BYTES))
    return replace(draft, frames=tuple(_iter_frames(draft, parts)))


def _find_checksums(draft: Draft) -> list[ChecksumMatch]:
    """Return the matching checksums, except at rising or nearly constant bytes."""
    frames = [frame for _, frame in draft.frames]
    step = max(1, len(frames) // MAX_CHECKSUM_FRAMES)
    shortest = min(map(len, frames), default=0)
    searched = frames[::step][:MAX_CHECKSUM_FRAMES]
    return [
        match
        for match in search(searched)
        if not any(_overlaps(match.place, field, shortest) for field in draft.candidates)
        and _is_declarable(draft, match)
        and _varies_enough(match, searched)
    ]


def _varies_enough(match: ChecksumMatch, frames: Sequence[bytes]) -> bool:
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


def _overlaps(place: ChecksumPlace, field: RisingField, length: int) -> bool:
    """Return whether a checksum and a field overlap in a frame of some length."""
    start = place.start(length)
    return start < field.end and field.offset < start + place.size


def _is_declarable(draft: Draft, match: ChecksumMatch) -> bool:
    """Return whether a struct can declare the checksum.

    The checksum must cover one range. It must not be in the part of varying length, or stored in
    nibbles.
    """
    if match.is_in_nibbles:
        return False
    place, span = match.place, match.span
    whole = (span.part, span.head, span.tail) == ("all", 0, 0) or (span.part, span.tail) == (
        "before",
        0,
    )
    at_end = place.offset == -place.size
    if draft.size is None and not at_end:
        return 0 <= place.offset <= draft.head_size - place.size and whole
    return whole or at_end or span.part == "behind"


def _find_blocks(draft: Draft) -> Draft:
    """Return the draft with blocks.

    Rising fields in the blocks, or in the checksum, are removed from the draft's candidates.
    """
    if not draft.frames:
        return draft
    rows = draft.rows
    rising = draft.candidates
    if draft.size is not None:
        blocks = _find_flagged_blocks(rows) or _find_blocks_of_fields(rising, rows.shape[1])
    else:
        blocks = None
    if blocks is not None:
        block_rows = rows[:, blocks.start : blocks.end].reshape(-1, blocks.size)
        block_fields = tuple(
            field for field in find_rising_fields(block_rows) if field.offset >= len(blocks.flag)
        )
        if blocks.flag or any(field.offset == 0 for field in block_fields):
            blocks = replace(blocks, candidates=block_fields)
        else:
            blocks = None
    if blocks is not None:
        rising = tuple(
            field for field in rising if field.end <= blocks.start or field.offset >= blocks.end
        )
    shortest = min(len(frame) for _, frame in draft.frames)
    if draft.checksum is not None:
        place = draft.checksum.place
        rising = tuple(field for field in rising if not _overlaps(place, field, shortest))
    rising = tuple(field for field in rising if field.offset >= len(draft.sync))
    return replace(draft, candidates=rising, blocks=blocks)


def _find_flagged_blocks(rows: NDArray[np.uint8]) -> RepeatedBlocks | None:
    """Return blocks that begin with the same two bytes and fill much of the frame.

    Returns None if no blocks are found.
    """
    first = rows[0]
    is_constant = (rows == rows[0]).mean(axis=0) >= MIN_CONSTANT_SHARE
    pairs: dict[tuple[int, int], list[int]] = {}
    for offset in np.flatnonzero(is_constant[:-1] & is_constant[1:]).tolist():
        pairs.setdefault((int(first[offset]), int(first[offset + 1])), []).append(offset)
    found_blocks = []
    for pair, offsets in pairs.items():
        steps = np.diff(offsets)
        if (
            pair in ((0, 0), (255, 255))  # frequent in unused fields
            or len(offsets) < MIN_BLOCKS
            or (steps != steps[0]).any()
            or steps[0] <= 2
        ):
            continue
        size = int(steps[0])
        count = min(len(offsets), (rows.shape[1] - offsets[0]) // size)
        if count >= MIN_BLOCKS and count * size >= MIN_BLOCKS_SHARE * rows.shape[1]:
            found_blocks.append(RepeatedBlocks(offsets[0], size, count, bytes(pair)))
    return max(found_blocks, key=lambda blocks: blocks.count * blocks.size, default=None)


def _find_blocks_of_fields(fields: Sequence[RisingField], length: int) -> RepeatedBlocks | None:
    """Return blocks at equal distances, each of which begins with a similar rising field.

    If there are several such groups of blocks, the one with the most bytes is returned. Returns
    None if there is none.
    """
    found_blocks = []
    for field in fields:
        kind = (field.size, field.order, field.kind, field.circle)
        offsets = [
            other.offset
            for other in fields
            if (other.size, other.order, other.kind, other.circle) == kind
            and other.offset >= field.offset
        ]
        for step in {offset - field.offset for offset in offsets[1:]}:
            count = next(
                count for count in itertools.count(1) if field.offset + count * step not in offsets
            )
            if field.offset + count * step > length:
                count -= 1  # the last block is incomplete
            if count >= MIN_BLOCKS:
                found_blocks.append(RepeatedBlocks(field.offset, step, count, b""))
    return max(found_blocks, key=lambda blocks: blocks.count * blocks.size, default=None)
