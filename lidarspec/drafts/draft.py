"""What unknown frames can be told to consist of, as far as their bytes say it: the facts that a first spec is written from.

The structure of a stream is looked for in its beginning and then held against all of it. Constant bytes in front are the sync; what
rises steadily is no checksum, which rules out most of the places where an XOR fits as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarspec.detection.structure import STEADY, Length, structure
from lidarspec.drafts.candidates import FEW, FRONT, Candidate, candidates
from lidarspec.errors import WireError
from lidarspec.searching.checksums import search
from lidarspec.searching.samples import Match, Place

#: frames that a checksum is looked for with, longest sync, and the same where there are few frames: more may be chance.
SOUGHT, SYNC, SHORT_SYNC, MANY = 256, 4, 2, 12
#: fewest blocks, and the share of a frame that they fill.
BLOCKS, FILLED = 3, 0.5
#: bytes behind which no count is looked for, and longest and shortest element of what is counted.
HEADER, LARGEST, SMALLEST = 8, 16, 2
#: widest checksum, in bytes.
LONGEST_SEAL = 4


@dataclass(frozen=True)
class Blocks:
    """Parts of a frame that begin alike: `count` of `size` bytes from `start` on, each beginning with `flag`."""

    start: int
    size: int
    count: int
    flag: bytes
    candidates: tuple[Candidate, ...] = ()

    @property
    def end(self) -> int:
        """The first byte behind them."""
        return self.start + self.count * self.size


@dataclass(frozen=True)
class Draft:
    """What is known of the frames in some bytes.

    Attributes:
        datagrams: whether each frame is a datagram.
        sync: bytes that every frame begins with.
        size: their length; None where it varies.
        length: how they say it then.
        frames: (offset, bytes) of those that fit it all, in order.
        bytes_in: the number of bytes that were looked at.
        candidates: fields that rise, outside the blocks.
        blocks: parts of the frame that begin alike.
        seal: the checksum, None where none was found.
        front: bytes that nearly all frames have at least, where a length counts bytes: as many are looked into.
    """

    datagrams: bool
    sync: bytes
    size: int | None
    length: Length | None
    frames: tuple[tuple[int, bytes], ...]
    bytes_in: int
    candidates: tuple[Candidate, ...] = ()
    blocks: Blocks | None = None
    seal: Match | None = None
    front: int = 0

    @property
    def share(self) -> float:
        """The share of the bytes that are in frames."""
        return sum(len(frame) for _, frame in self.frames) / self.bytes_in

    @property
    def tail(self) -> int:
        """Bytes of a checksum that stands at the end of frames of several lengths."""
        return -self.seal.place.offset if self.size is None and self.seal is not None and self.seal.place.offset < 0 else 0

    @property
    def head(self) -> int:
        """Bytes in front that every frame has: all of them where there is one length."""
        if self.size is not None or self.length is None:
            return self.size or 0
        return max(self.length.rest - self.tail, self.length.end, self.front)

    @property
    def rows(self) -> NDArray[np.uint8]:
        """The heads of all frames, shape (n, head)."""
        return np.frombuffer(b"".join(frame[: self.head] for _, frame in self.frames), np.uint8).reshape(-1, self.head)


def draft(chunks: Sequence[bytes], *, datagrams: bool) -> Draft:
    """What can be told of the frames in unknown bytes.

    Args:
        chunks: datagrams, or pieces of a stream.

    Raises:
        WireError: where no frames of one kind can be seen.
    """
    found = structure(chunks, datagrams=datagrams, seal=False)
    if found is None:
        raise WireError("no frames of one kind can be seen in these bytes", data=b"".join(chunks[:1])[:16])
    parts = chunks if datagrams else [b"".join(chunks)]
    size = sum(map(len, chunks))
    start = 0 if datagrams or found.period is None or size % found.period == 0 else max(parts[0].find(found.sync), 0)
    first = Draft(datagrams, b"", found.period, found.length, (), size)
    first = _begun(first, parts, start) or _begun(first, parts, max(parts[0].find(found.sync), 0)) or replace(first, sync=found.sync)
    known = _counted(replace(first, frames=tuple(_walk(first, parts))), parts[-1])
    known = _fronted(known, parts)
    known = replace(known, candidates=tuple(candidates(known.rows)))
    known = replace(known, seal=_seal(known))
    return _detailed(replace(known, frames=tuple(_walk(known, parts))))


def _begun(first: Draft, parts: Sequence[bytes], start: int) -> Draft | None:
    """The sync bytes of frames that are cut at equal distances, or have their length in them; None where they begin differently."""
    if first.datagrams:
        frames = [part for part in parts if len(part) == first.size]
    elif first.size is not None:
        frames = [parts[0][at : at + first.size] for at in range(start, len(parts[0]) - first.size + 1, first.size)]
    else:
        return None
    rows = np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), -1)
    usual = np.array([np.bincount(column, minlength=256).argmax() for column in rows[:, :SYNC].T], np.uint8)
    steady = (rows[:, : len(usual)] == usual).mean(axis=0) >= (STEADY if len(rows) >= FEW else 1)
    length = int(np.argmin(steady)) if not steady.all() else len(steady)
    sync = usual[: length if len(rows) >= MANY else min(length, SHORT_SYNC)].tobytes()
    return replace(first, sync=sync) if any(sync) else None


def _walk(known: Draft, parts: Sequence[bytes]) -> Iterator[tuple[int, bytes]]:
    """The frames that fit, leftmost first, with their places in the whole input; behind one that does not fit, one byte further."""
    base = 0
    for part in parts:
        at = part.find(known.sync)
        while 0 <= at < len(part):
            size = _fits(known, part, at)
            if size:
                yield base + at, part[at : at + size]
            if known.datagrams:
                break
            at = part.find(known.sync, at + (size or 1))
        base += len(part)


def _fits(known: Draft, part: bytes, at: int) -> int:
    """The length of the frame that begins here, 0 where none does."""
    size = known.size
    if size is None and known.length is not None:
        size = known.length.of(part[at : at + known.length.end]) if at + known.length.end <= len(part) else 0
    if not size or at + size > len(part) or (known.datagrams and (at or size != len(part))) or size < known.head + known.tail:
        return 0
    return size if known.seal is None or _sealed(known.seal, part[at : at + size]) else 0


def _sealed(seal: Match, frame: bytes) -> bool:
    start = seal.place.start(len(frame))
    there = int.from_bytes(frame[start : start + seal.place.size], seal.order)
    covered = b"".join(frame[a:b] for a, b in seal.span.ranges(seal.place, len(frame)))
    return seal.algorithm(covered) == there


def _counted(known: Draft, data: bytes) -> Draft:
    """Frames of one length, unless what is left of one behind them says another number, where theirs tells their length."""
    if known.size is None or known.datagrams or not known.frames:
        return known
    at, last = known.frames[-1]
    rest = data[at + len(last) :]
    for place in range(len(known.sync), HEADER):
        same = len({frame[: place + 1] for _, frame in known.frames}) == 1
        if not same or len(rest) <= place or rest[:place] != last[:place] or rest[place] == last[place]:
            continue
        told = [Length(place, 1, "little", unit, known.size - unit * last[place]) for unit in range(SMALLEST, LARGEST + 1)]
        fitting = [length for length in told if length.rest > place and length.of(rest) > len(rest)]
        if fitting:
            return replace(known, size=None, length=min(fitting, key=lambda length: length.rest))
    return known


def _fronted(known: Draft, parts: Sequence[bytes]) -> Draft:
    """Where the length counts bytes, with a head of the fields in front of what varies: short frames are of another kind then."""
    if known.length is None or known.length.unit > 1 or not known.frames:
        return known
    lengths = sorted(len(frame) for _, frame in known.frames)
    known = replace(known, front=min(FRONT, lengths[int(len(lengths) * (1 - STEADY))] - LONGEST_SEAL))
    return replace(known, frames=tuple(_walk(known, parts)))


def _seal(known: Draft) -> Match | None:
    """The checksum that fits, the first of those that do not stand where something rises."""
    frames = [frame for _, frame in known.frames]
    step = max(1, len(frames) // SOUGHT)
    shortest = min(map(len, frames), default=0)
    for match in search(frames[::step][:SOUGHT]):
        if not any(_overlaps(match.place, one, shortest) for one in known.candidates) and _can_stand(known, match):
            return match
    return None


def _overlaps(place: Place, one: Candidate, length: int) -> bool:
    start = place.start(length)
    return start < one.end and one.offset < start + place.size


def _can_stand(known: Draft, match: Match) -> bool:
    """Whether a struct can have it: not inside of what varies in number, in one range, and not split over nibbles."""
    if any("nibbles" in remark for remark in match.remarks):
        return False
    place, span = match.place, match.span
    whole = (span.part, span.head, span.tail) == ("all", 0, 0) or (span.part, span.tail) == ("before", 0)
    at_end = place.offset == -place.size
    if known.size is None and not at_end:
        return 0 <= place.offset <= known.head - place.size and whole
    return whole or at_end or span.part == "behind"


def _detailed(known: Draft) -> Draft:
    """With the fields that rise and the blocks that begin alike; what belongs to the checksum is neither."""
    if not known.frames:
        return known
    rows = known.rows
    blocks = _blocks(rows) if known.size is not None else None
    found = known.candidates
    if blocks is not None:
        inside = rows[:, blocks.start : blocks.end].reshape(-1, blocks.size)
        within = tuple(one for one in candidates(inside) if one.offset >= len(blocks.flag))
        blocks = replace(blocks, candidates=within)
        found = tuple(one for one in found if one.end <= blocks.start or one.offset >= blocks.end)
    shortest = min(len(frame) for _, frame in known.frames)
    free = tuple(one for one in found if known.seal is None or not _overlaps(known.seal.place, one, shortest))
    return replace(known, candidates=tuple(one for one in free if one.offset >= len(known.sync)), blocks=blocks)


def _blocks(rows: NDArray[np.uint8]) -> Blocks | None:
    """The parts of a frame that begin with the same two constant bytes at equal distances, if they fill much of it."""
    first, steady = rows[0], (rows == rows[0]).mean(axis=0) >= STEADY
    pairs: dict[tuple[int, int], list[int]] = {}
    for spot in np.flatnonzero(steady[:-1] & steady[1:]).tolist():
        pairs.setdefault((int(first[spot]), int(first[spot + 1])), []).append(spot)
    found = []
    for pair, spots in pairs.items():
        steps = np.diff(spots)
        if pair in ((0, 0), (255, 255)) or len(spots) < BLOCKS or (steps != steps[0]).any() or steps[0] <= 2:
            continue
        size = int(steps[0])
        count = min(len(spots), (rows.shape[1] - spots[0]) // size)
        if count >= BLOCKS and count * size >= FILLED * rows.shape[1]:
            found.append(Blocks(spots[0], size, count, bytes(pair)))
    return max(found, key=lambda blocks: blocks.count * blocks.size, default=None)
