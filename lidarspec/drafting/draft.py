"""Analyse unknown frames, and describe them in a `Draft`.

`make_draft` finds the structure of the frames at the beginning of a stream, and then splits all
bytes into frames.
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
    FrameStructure,
    LengthField,
    RisingField,
    find_rising_fields,
    find_structure,
    find_usual_bytes,
    split_frames,
)
from lidarspec.drafting.samples import ChecksumMatch, ChecksumPlace
from lidarspec.errors import WireError

#: The maximum number of frames to use in the search for a checksum.
MAX_CHECKSUM_FRAMES = 256
#: The maximum number of sync bytes.
MAX_SYNC_BYTES = 4
#: The maximum number of sync bytes if there are fewer than `MIN_FRAMES_FOR_LONG_SYNC` frames,
#: because further constant bytes may be coincidence.
MAX_SYNC_BYTES_OF_FEW_FRAMES = 2
#: From this number of frames on, constant bytes are probably not coincidence.
MIN_FRAMES_FOR_LONG_SYNC = 12
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
#: From this number of frames on, most bits of a real checksum have changed.
MIN_FRAMES_FOR_CHANGE = 16


@dataclass(frozen=True)
class RepeatedBlocks:
    """Repeated blocks of a frame.

    Attributes:
        start: offset of the first block, in bytes.
        size: size of a block, in bytes.
        flag: the constant first bytes of each block; b"" if there are none.
        rising_fields: the fields with rising values in a block.
    """

    start: int
    size: int
    count: int
    flag: bytes
    rising_fields: tuple[RisingField, ...] = ()

    @property
    def end(self) -> int:
        """The offset after the last block."""
        return self.start + self.count * self.size


@dataclass(frozen=True)
class Draft:
    """The properties that were found in unknown frames.

    Attributes:
        sync: the first bytes of every frame.
        size: the size of the frames, in bytes; None if it varies.
        length: the length field; None if all frames have one size.
        frames: (offset, bytes) of each frame that has all known properties.
        bytes_in: number of input bytes.
        rising_fields: the fields with rising values, except those in the blocks.
        blocks: repeated blocks of a frame; None if a frame has no blocks.
        checksum: the checksum; None if none was found.
        others: further checksums that match the frames.
        common_bytes: if a length field counts bytes, the number of bytes that every frame has at
            its start, so that these bytes are searched for fields; otherwise 0.
    """

    datagrams: bool
    sync: bytes
    size: int | None
    length: LengthField | None
    frames: tuple[tuple[int, bytes], ...]
    bytes_in: int
    rising_fields: tuple[RisingField, ...] = ()
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

        If all frames have the same length, this is the frame length.
        """
        if self.size is not None:
            return self.size
        if self.length is None:
            return 0
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
    draft = Draft(
        datagrams=datagrams,
        sync=_find_sync(structure, parts, datagrams=datagrams),
        size=structure.period,
        length=structure.length,
        frames=(),
        bytes_in=sum(map(len, chunks)),
    )
    draft = replace(draft, frames=tuple(_iter_frames(draft, parts)))
    draft = _find_count_field(draft, parts[0])
    draft = _find_common_bytes(draft, parts)
    draft = replace(draft, rising_fields=tuple(find_rising_fields(draft.rows)))
    checksums = _find_checksums(draft)
    if checksums:
        draft = replace(draft, checksum=checksums[0], others=tuple(checksums[1:]))
    return _find_blocks(replace(draft, frames=tuple(_iter_frames(draft, parts))))


def _find_sync(structure: FrameStructure, parts: Sequence[bytes], *, datagrams: bool) -> bytes:
    """Return the bytes with which every frame begins."""
    if structure.period is None:
        return structure.sync
    if datagrams:
        frames = [part for part in parts if len(part) == structure.period]
        return _find_constant_start(frames) or structure.sync
    stream = parts[0]
    if len(stream) % structure.period == 0:
        # The stream probably consists of whole frames.
        sync = _find_constant_start(split_frames(stream, structure.period))
        if sync:
            return sync
    start = max(stream.find(structure.sync), 0)  # 0 if no frame has all of them
    frames = split_frames(stream, structure.period, start)
    return _find_constant_start(frames) or structure.sync


def _find_constant_start(frames: Sequence[bytes]) -> bytes:
    """Return the constant bytes at the start of frames of the same length."""
    rows = np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), -1)
    usual = find_usual_bytes(rows[:, :MAX_SYNC_BYTES])
    min_share = MIN_CONSTANT_SHARE if len(rows) >= FEW_FRAMES else 1
    is_constant = (rows[:, : len(usual)] == usual).mean(axis=0) >= min_share
    if is_constant.all():
        length = len(is_constant)
    else:
        length = int(np.argmin(is_constant))  # the offset of the first byte that varies
    if len(rows) < MIN_FRAMES_FOR_LONG_SYNC:
        length = min(length, MAX_SYNC_BYTES_OF_FEW_FRAMES)
    sync = usual[:length].tobytes()
    if any(sync):
        return sync
    return b""


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


def _find_count_field(draft: Draft, stream: bytes) -> Draft:
    """Return the draft with a field that counts elements, if such a field is found.

    The stream may end in an incomplete frame. If all frames before it have the same value in a
    byte, but the incomplete frame has another value, this byte is probably the number of elements.
    """
    if draft.size is None or draft.datagrams or not draft.frames:
        return draft
    last_start, last_whole = draft.frames[-1]
    incomplete = stream[last_start + len(last_whole) :]
    for offset in range(len(draft.sync), MAX_COUNT_OFFSET):
        is_prefix_constant = len({frame[: offset + 1] for _, frame in draft.frames}) == 1
        if (
            not is_prefix_constant
            or len(incomplete) <= offset
            or incomplete[:offset] != last_whole[:offset]
            or incomplete[offset] == last_whole[offset]
        ):
            continue
        lengths = [
            LengthField(
                offset=offset,
                size=1,
                order="little",
                unit=unit,
                rest=draft.size - unit * last_whole[offset],
            )
            for unit in range(MIN_ELEMENT_BYTES, MAX_ELEMENT_BYTES + 1)
        ]
        fitting = [
            length
            for length in lengths
            # the elements follow the field
            if length.rest > offset
            # the frame has bytes after the end of the stream
            and length.read(incomplete) > len(incomplete)
        ]
        if fitting:
            # the largest elements
            length = min(fitting, key=lambda length: length.rest)
            return replace(draft, size=None, length=length)
    return draft


def _find_common_bytes(draft: Draft, parts: Sequence[bytes]) -> Draft:
    """Return the draft with `common_bytes`, without frames shorter than this number."""
    if draft.length is None or not draft.frames:
        return draft
    if draft.length.unit > 1:
        return draft  # the field counts elements, not bytes
    lengths = sorted(len(frame) for _, frame in draft.frames)
    short_length = lengths[int(len(lengths) * (1 - MIN_CONSTANT_SHARE))]
    # A checksum at the end of a short frame is not among the common bytes.
    common_bytes = min(HEAD_SEARCH_BYTES, short_length - MAX_CHECKSUM_BYTES)
    draft = replace(draft, common_bytes=common_bytes)
    return replace(draft, frames=tuple(_iter_frames(draft, parts)))


def _find_checksums(draft: Draft) -> list[ChecksumMatch]:
    """Return the checksums that match and that a struct can declare."""
    frames = [frame for _, frame in draft.frames]
    step = max(1, len(frames) // MAX_CHECKSUM_FRAMES)
    shortest = min(map(len, frames), default=0)
    searched = frames[::step][:MAX_CHECKSUM_FRAMES]
    return [
        match
        for match in search(searched)
        if not any(_overlaps(match.place, field, shortest) for field in draft.rising_fields)
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
    """Return whether a checksum and a field overlap in a frame of this length."""
    start = place.start(length)
    return start < field.end and field.offset < start + place.size


def _is_declarable(draft: Draft, match: ChecksumMatch) -> bool:
    """Return whether a struct can declare the checksum."""
    if match.is_in_nibbles:
        return False
    place = match.place
    span = match.span
    if place.offset == -place.size:
        return True  # no byte follows the checksum, so the covered bytes are one range
    covers_bytes_before = span.part == "before" and span.tail == 0
    if draft.size is None:
        is_in_head = 0 <= place.offset <= draft.head_size - place.size
        return is_in_head and (span.covers_all or covers_bytes_before)
    return span.covers_all or covers_bytes_before or span.part == "behind"


def _find_blocks(draft: Draft) -> Draft:
    """Return the draft with its repeated blocks, if there are any."""
    if not draft.frames:
        return draft
    blocks = None
    if draft.size is not None:
        blocks = _choose_blocks(draft.rows, draft.rising_fields)
    shortest = min(len(frame) for _, frame in draft.frames)
    rising_fields = []
    for field in draft.rising_fields:
        if field.offset < len(draft.sync):
            continue
        if blocks is not None and blocks.start < field.end and field.offset < blocks.end:
            continue
        if draft.checksum is not None and _overlaps(draft.checksum.place, field, shortest):
            continue
        rising_fields.append(field)
    return replace(draft, rising_fields=tuple(rising_fields), blocks=blocks)


def _choose_blocks(
    rows: NDArray[np.uint8], rising_fields: Sequence[RisingField]
) -> RepeatedBlocks | None:
    """Return the blocks of frames with their rising fields; None if no blocks are found.

    Args:
        rows: the frames, (n, length).
    """
    blocks = _find_flagged_blocks(rows) or _find_blocks_of_fields(rising_fields, rows.shape[1])
    if blocks is None:
        return None
    block_rows = rows[:, blocks.start : blocks.end].reshape(-1, blocks.size)
    block_fields = tuple(
        field for field in find_rising_fields(block_rows) if field.offset >= len(blocks.flag)
    )
    begins_with_field = any(field.offset == 0 for field in block_fields)
    # Without a flag, blocks were assumed because of similar rising fields in the frame. If they
    # are blocks, the values rise from block to block too.
    if not blocks.flag and not begins_with_field:
        return None
    return replace(blocks, rising_fields=block_fields)


def _find_flagged_blocks(rows: NDArray[np.uint8]) -> RepeatedBlocks | None:
    """Return blocks that begin with the same two bytes and fill much of the frame."""
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


def _are_similar(first: RisingField, second: RisingField) -> bool:
    """Return whether two fields have the same type and the same kind of values."""
    return (first.size, first.order, first.kind, first.circle) == (
        second.size,
        second.order,
        second.kind,
        second.circle,
    )


def _find_blocks_of_fields(fields: Sequence[RisingField], length: int) -> RepeatedBlocks | None:
    """Return blocks at equal distances that each begin with a similar rising field."""
    found_blocks = []
    for field in fields:
        offsets = [
            other.offset
            for other in fields
            if other.offset >= field.offset and _are_similar(other, field)
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
