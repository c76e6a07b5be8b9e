"""Split an input into pieces: valid frames, damaged frames, and the bytes between them.

The decoder finds the valid frames, and `iter_pieces` yields each frame as soon as it is found.
`explain_piece` searches the bytes between valid frames for damaged frames.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from lidarspec.errors import LidarSpecError, UnknownFrame, WireError
from lidarspec.explaining.damage_search import find_changes
from lidarspec.explaining.explanation import Explanation, explain
from lidarspec.explaining.formatting import ExplainedRow
from lidarspec.frames.layout import Layout
from lidarspec.frames.parse import find_frame_layout, identify
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.framing.frame_engine import get_codec
from lidarspec.spec import Sensor
from lidarspec.spec.sensor import with_frames
from lidarspec.transports.protocol import Chunk

#: The minimum number of constant bytes at the start of a frame type to search for its damaged
#: frames.
MIN_SYNC_BYTES = 2
#: The maximum number of bytes outside frames that are kept. If there are more, they are yielded as
#: a piece.
MAX_HELD_BYTES = 1 << 16
#: The frame type of a piece that is the whole input, and may be one damaged frame of unknown type.
NEAREST = "?"


@dataclass(frozen=True)
class InputPiece:
    """A frame of the input, or bytes that are not in a frame.

    Attributes:
        offset: offset of the first byte in the input.
        frame: the frame type; "" for bytes that are not in a frame; `NEAREST` for a short input
            that is probably one damaged frame.
        is_datagram: for bytes that are not in a frame, whether they are from a datagram.
    """

    offset: int
    data: bytes
    frame: str
    is_datagram: bool = False

    @property
    def is_valid(self) -> bool:
        """Whether the piece is a valid frame."""
        return self.frame not in ("", NEAREST)

    @property
    def end(self) -> int:
        """The offset after the last byte."""
        return self.offset + len(self.data)

    def part(self, start: int, end: int, frame: str = "") -> InputPiece:
        """Return the bytes from `start` to `end` of this piece as a new piece of type `frame`."""
        return InputPiece(self.offset + start, self.data[start:end], frame)


def iter_pieces(
    sensor: Sensor, chunks: Iterable[Chunk], *, datagrams: bool, frame: str | None = None
) -> Iterator[InputPiece]:
    """Yield the frames of the input and the bytes between them, in order.

    If a short input contains no valid frame, the whole input is one piece of the type `NEAREST`.

    Args:
        datagrams: whether each chunk is a datagram, instead of a piece of a stream.
        frame: the frame type that is selected if several types match the same bytes.

    Raises:
        UnknownFrame: if the sensor has no such frame type.
    """
    if frame is not None and frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    chunks = iter(chunks)
    head = list[Chunk]()
    longest = _find_max_length(sensor)
    while (
        sum(len(chunk.data) for chunk in head) <= longest
        and (chunk := next(chunks, None)) is not None
    ):
        head.append(chunk)
    whole = b"".join(chunk.data for chunk in head)
    if len(whole) > longest:
        yield from _split_input(
            sensor if frame is None else _prefer_frame(sensor, frame),
            itertools.chain(head, chunks),
            datagrams=datagrams,
        )
        return
    try:
        yield InputPiece(0, whole, identify(sensor, whole, frame=frame))
    except LidarSpecError:
        frames = list(
            _split_input(
                sensor if frame is None else _prefer_frame(sensor, frame), head, datagrams=datagrams
            )
        )
        yield from (
            frames if any(piece.frame for piece in frames) else [InputPiece(0, whole, NEAREST)]
        )


def _prefer_frame(sensor: Sensor, frame: str) -> Sensor:
    """Return the sensor, changed so that a frame type is preferred."""
    first = replace(sensor.frames[frame], direction="in", after=None)
    return with_frames(
        sensor,
        {frame: first, **{name: other for name, other in sensor.frames.items() if name != frame}},
    )


def _split_input(
    sensor: Sensor, chunks: Iterable[Chunk], *, datagrams: bool
) -> Iterator[InputPiece]:
    decoder = sensor.decoder(stream=not datagrams)
    held = bytearray()
    start = 0
    for chunk in itertools.chain(chunks, [None]):
        if chunk is None or chunk.gap:
            frames = decoder.finish()
        else:
            frames = []
        if chunk is not None:
            held += chunk.data
            frames += decoder.feed(chunk.data)
        if decoder.joins:  # a joined message has no contiguous bytes in the input
            yield from (InputPiece(item.offset, item.data, item.frame) for item in frames)
            continue
        end = start
        for item in frames:
            if item.offset > end:
                yield InputPiece(end, bytes(held[end - start : item.offset - start]), "", datagrams)
            yield InputPiece(item.offset, item.data, item.frame)
            end = item.offset + len(item.data)
        left = len(held) - (end - start) - decoder.stats.pending
        if left and (datagrams or chunk is None or left > MAX_HELD_BYTES):
            yield InputPiece(end, bytes(held[end - start : end - start + left]), "", datagrams)
            end += left
        del held[: end - start]
        start = end


def explain_piece(
    sensor: Sensor, piece: InputPiece, frame: str | None = None
) -> Iterator[tuple[InputPiece, Explanation]]:
    """Yield a piece, or the pieces into which it is split, each with its explanation.

    Bytes that are not in a frame are split into damaged frames and the bytes between these frames.

    Args:
        frame: the frame type by which a `NEAREST` piece (a short input that is probably one damaged
            frame) is explained; by default the type that fits best.

    Raises:
        WireError: if the bytes of a `NEAREST` piece do not begin like a frame.
    """
    if piece.frame:
        yield piece, explain(piece.data, sensor, piece.frame if piece.is_valid else frame)
        return
    end = 0
    for part in _iter_damaged(sensor, piece):
        if part.offset > piece.offset + end:
            yield _explain_skipped(sensor, piece.part(end, part.offset - piece.offset))
        yield part, explain(part.data, sensor, part.frame)
        end = part.end - piece.offset
    if end < len(piece.data):
        yield _explain_skipped(sensor, piece.part(end, len(piece.data)))


def _explain_skipped(sensor: Sensor, piece: InputPiece) -> tuple[InputPiece, Explanation]:
    is_filler = not piece.data.translate(None, bytes(sensor.fillers))
    remark = "filler" if is_filler else "outside frames"
    return piece, Explanation(
        sensor.id,
        "",
        piece.data,
        (ExplainedRow(0, piece.data, "", (), (remark,), matches_spec=is_filler),),
    )


def _iter_damaged(sensor: Sensor, piece: InputPiece) -> Iterator[InputPiece]:
    """Yield the damaged frames in the bytes of a piece, in order."""
    data = piece.data
    end = 0
    starts = find_likely_starts(sensor, data)
    if piece.is_datagram:
        starts = [start for start in starts if start == 0]
    for start in [*starts, len(data)]:
        if start > end and (name := _find_headless_type(sensor, data[end:start])):
            yield piece.part(end, start, name)
            end = start
        if end <= start < len(data) and (name := _find_nearest_type(sensor, data[start:])):
            if piece.is_datagram:
                end = len(data)
            else:
                end = _find_end(sensor, data, start, name, [*starts, len(data)])
            yield piece.part(start, end, name)


def find_likely_starts(sensor: Sensor, data: bytes) -> list[int]:
    """Return the offsets at which a frame may begin, in ascending order."""
    starts: set[int] = set()
    for frame in sensor.incoming.values():
        prefix = get_codec(frame).prefix
        size = next(
            (index for index in range(len(prefix) + 1) if prefix.get(index, (0, 0))[0] != 0xFF), 0
        )
        if size >= MIN_SYNC_BYTES:
            magic = bytes(prefix[index][1] for index in range(size))
            starts |= {
                match.start() for match in re.finditer(re.escape(magic) + b"(?=.)", data, re.DOTALL)
            }
    return sorted(starts)


def _find_nearest_type(sensor: Sensor, data: bytes) -> str:
    """Return the frame type that the bytes fit best; "" if they begin like no frame."""
    try:
        return identify(sensor, data[: _find_max_length(sensor)])
    except WireError as fault:
        return fault.frame


def _find_headless_type(sensor: Sensor, data: bytes) -> str:
    """Return the type of a frame that is damaged at its start; "" if unknown."""
    return next((name for name, frame in sensor.incoming.items() if find_changes(frame, data)), "")


def _find_end(sensor: Sensor, data: bytes, start: int, name: str, ends: list[int]) -> int:
    """Return the offset at which a damaged frame ends.

    Args:
        ends: the offsets at which another frame may begin, and the end of the data.
    """
    following = [end for end in ends if end > start]
    size = frame_coder(sensor.frames[name]).find_size(data[start:])
    if size is not None:
        return start + size
    layout = find_frame_layout(sensor, name, data[start : start + sensor.frames[name].max_length])
    if not isinstance(layout, Layout):
        return following[0]
    whole = start + layout.size
    if len(data) < whole:
        cut_off = len(data)
    else:
        cut_off = min(following[0], whole)
    return next((end for end in (whole, whole - 1, whole + 1) if end in following), cut_off)


def _find_max_length(sensor: Sensor) -> int:
    return max((frame.max_length for frame in sensor.frames.values()), default=0)
