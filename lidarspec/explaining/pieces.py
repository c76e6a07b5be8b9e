"""An input in pieces: its frames, what lies between them, and of this what was a frame before it
was damaged.

The decoder alone says what is a frame, and pieces come as soon as it does. Bytes that it passed
over are cut where a frame seems to begin: after as many bytes as the frame has, one more or fewer,
or where the next one begins before that.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from lidarspec.errors import LidarSpecError, UnknownFrame, WireError
from lidarspec.explaining.damage import changes
from lidarspec.explaining.explanation import Explanation, explain
from lidarspec.explaining.wording import Row
from lidarspec.frames.layout import Layout
from lidarspec.frames.parse import identify, layout_of
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.framing.frame_engine import codec
from lidarspec.spec import Sensor
from lidarspec.spec.sensor import with_frames
from lidarspec.transports.protocol import Chunk

#: constant bytes that look like the beginning of a frame in the midst of others.
SYNC = 2
#: bytes without a frame that are waited for, before they are given out.
HELD = 1 << 16
#: stands for the frame type of a whole input that is short enough to be one damaged frame.
NEAREST = "?"


@dataclass(frozen=True)
class Piece:
    """A frame in the input, or with `frame` "" bytes that are in none: of a stream, or one whole
    datagram.
    """

    offset: int
    data: bytes
    frame: str
    datagram: bool = False

    @property
    def is_valid(self) -> bool:
        """Whether it is a frame, and not what may have been one."""
        return self.frame not in ("", NEAREST)

    @property
    def end(self) -> int:
        """The offset of what follows it."""
        return self.offset + len(self.data)

    def part(self, start: int, end: int, frame: str = "") -> Piece:
        """A stretch of it, as a piece of the input."""
        return Piece(self.offset + start, self.data[start:end], frame)


def pieces(
    sensor: Sensor, chunks: Iterable[Chunk], *, datagrams: bool, frame: str | None = None
) -> Iterator[Piece]:
    """The frames of the input and the bytes between them, in order, as they are found; a datagram
    that is no frame is a piece of its own.

    An input that is no longer than a frame and holds none is one piece, of the type `NEAREST`.

    Args:
        frame: look for frames of this type, also where another one has the same bytes or has to
            come before; other types are pieces too.

    Raises:
        UnknownFrame: for a type that the sensor does not have.
    """
    if frame is not None and frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    chunks = iter(chunks)
    head = list[Chunk]()
    longest = _longest(sensor)
    while (
        sum(len(chunk.data) for chunk in head) <= longest
        and (chunk := next(chunks, None)) is not None
    ):
        head.append(chunk)
    whole = b"".join(chunk.data for chunk in head)
    if len(whole) > longest:
        yield from _cut(
            sensor if frame is None else _preferring(sensor, frame),
            itertools.chain(head, chunks),
            datagrams=datagrams,
        )
        return
    try:
        yield Piece(0, whole, identify(sensor, whole, frame=frame))
    except LidarSpecError:
        found = list(
            _cut(sensor if frame is None else _preferring(sensor, frame), head, datagrams=datagrams)
        )
        yield from found if any(piece.frame for piece in found) else [Piece(0, whole, NEAREST)]


def _preferring(sensor: Sensor, frame: str) -> Sensor:
    """The sensor with one type as an incoming one that comes before all others, and after none."""
    first = replace(sensor.frames[frame], direction="in", after=None)
    return with_frames(
        sensor,
        {frame: first, **{name: other for name, other in sensor.frames.items() if name != frame}},
    )


def _cut(sensor: Sensor, chunks: Iterable[Chunk], *, datagrams: bool) -> Iterator[Piece]:
    decoder = sensor.decoder(stream=not datagrams)
    held = bytearray()
    start = 0
    for chunk in itertools.chain(chunks, [None]):
        if chunk is None or chunk.gap:
            found = decoder.finish()
        else:
            found = []
        if chunk is not None:
            held += chunk.data
            found += decoder.feed(chunk.data)
        if decoder.joins:  # a message stands in no one place of the input
            yield from (Piece(item.offset, item.data, item.frame) for item in found)
            continue
        end = start
        for item in found:
            if item.offset > end:
                yield Piece(end, bytes(held[end - start : item.offset - start]), "", datagrams)
            yield Piece(item.offset, item.data, item.frame)
            end = item.offset + len(item.data)
        left = len(held) - (end - start) - decoder.stats.pending
        if left and (datagrams or chunk is None or left > HELD):
            yield Piece(end, bytes(held[end - start : end - start + left]), "", datagrams)
            end += left
        del held[: end - start]
        start = end


def explained(
    sensor: Sensor, piece: Piece, frame: str | None = None
) -> Iterator[tuple[Piece, Explanation]]:
    """A piece, and what is in it; one without a frame is cut into what were frames before they were
    damaged, and the rest.

    Args:
        frame: what `NEAREST` stands for; the type that comes nearest where left out.

    Raises:
        WireError: where bytes that are `NEAREST` do not even begin like a frame.
    """
    if piece.frame:
        yield piece, explain(piece.data, sensor, piece.frame if piece.is_valid else frame)
        return
    end = 0
    for part in _damaged(sensor, piece):
        if part.offset > piece.offset + end:
            yield _skipped(sensor, piece.part(end, part.offset - piece.offset))
        yield part, explain(part.data, sensor, part.frame)
        end = part.end - piece.offset
    if end < len(piece.data):
        yield _skipped(sensor, piece.part(end, len(piece.data)))


def _skipped(sensor: Sensor, piece: Piece) -> tuple[Piece, Explanation]:
    is_filler = not piece.data.translate(None, bytes(sensor.fillers))
    remark = "filler" if is_filler else "in no frame"
    return piece, Explanation(
        sensor.id, "", piece.data, (Row(0, piece.data, "", (), (remark,), right=is_filler),)
    )


def _damaged(sensor: Sensor, piece: Piece) -> Iterator[Piece]:
    """The frames that some bytes were before they were damaged, in order."""
    data = piece.data
    end = 0
    starts = [start for start in likely_starts(sensor, data) if not piece.datagram or start == 0]
    for start in [*starts, len(data)]:
        if start > end and (name := _headless(sensor, data[end:start])):
            yield piece.part(end, start, name)
            end = start
        if end <= start < len(data) and (name := _nearest(sensor, data[start:])):
            if piece.datagram:
                end = len(data)
            else:
                end = _end(sensor, data, start, name, [*starts, len(data)])
            yield piece.part(start, end, name)


def likely_starts(sensor: Sensor, data: bytes) -> list[int]:
    """Where bytes begin like an incoming frame: with two constant bytes or more, and any other; in
    ascending order.
    """
    starts: set[int] = set()
    for frame in sensor.incoming.values():
        prefix = codec(frame).prefix
        size = next(
            (spot for spot in range(len(prefix) + 1) if prefix.get(spot, (0, 0))[0] != 0xFF), 0
        )
        if size >= SYNC:
            magic = bytes(prefix[spot][1] for spot in range(size))
            starts |= {
                found.start() for found in re.finditer(re.escape(magic) + b"(?=.)", data, re.DOTALL)
            }
    return sorted(starts)


def _nearest(sensor: Sensor, data: bytes) -> str:
    """The type of frame that bytes begin like; "" for none."""
    try:
        return identify(sensor, data[: _longest(sensor)])
    except WireError as fault:
        return fault.frame


def _headless(sensor: Sensor, data: bytes) -> str:
    """The type that bytes were a frame of which do not begin like one; "" where no single change
    makes them one.
    """
    return next((name for name, frame in sensor.incoming.items() if changes(frame, data)), "")


def _end(sensor: Sensor, data: bytes, start: int, name: str, ends: list[int]) -> int:
    """Where a damaged frame ends: by its length or next to that, where something else begins, or
    else where the first thing does.
    """
    following = [end for end in ends if end > start]
    size = frame_coder(sensor.frames[name]).find_size(data[start:])
    if size is not None:
        return start + size
    layout = layout_of(sensor, name, data[start : start + sensor.frames[name].max_length])
    if not isinstance(layout, Layout):
        return following[0]
    whole = start + layout.size
    if len(data) < whole:
        cut_off = len(data)
    else:
        cut_off = min(following[0], whole)
    return next((end for end in (whole, whole - 1, whole + 1) if end in following), cut_off)


def _longest(sensor: Sensor) -> int:
    return max((frame.max_length for frame in sensor.frames.values()), default=0)
