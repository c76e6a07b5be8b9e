"""`Decoder`: finds frames as input arrives, and counts all other bytes.

On a byte stream, bytes at the end of the input may be an incomplete frame. They are searched again
with the next input. On a datagram link, each datagram is one frame. The frames and counters do not
depend on the division of the input. Fillers are bytes that a sensor sends between frames
(`Sensor.fillers`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, UsageError, refuse_text
from lidarspec.frames.arrays import broadcast_value, keep_freed_memory, repeat
from lidarspec.frames.layout import Sums
from lidarspec.framing.candidates import Bytes1D, Framing, PieceResult, SearchState
from lidarspec.framing.datagram_assembly import FragmentAssembler, JoinedMessages
from lidarspec.framing.datagrams import classify_datagrams
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.regular_rows import find_regular_frames
from lidarspec.framing.results import Counters, Found, Frames, Numbers, to_array
from lidarspec.framing.search import find_frames
from lidarspec.spec.description import Frame
from lidarspec.spec.links import Udp
from lidarspec.spec.sensor import SensorDescription

__all__ = ["BACKENDS", "Decoder", "select_backend", "decode_all", "is_stream"]

#: Limits of the size of a piece of a stream: the maximum if most bytes of the piece belong to
#: frames, the maximum for all other pieces, and the minimum.
MAX_REGULAR_PIECE_BYTES = 24 << 16
MAX_PIECE_BYTES = 6 << 16
MIN_PIECE_BYTES = 1 << 12

#: Limits of the datagrams that are decoded together: the number of datagrams of a list, the number
#: of rows of an array, and the approximate total size of both.
MAX_LIST_DATAGRAMS = 1 << 14
MAX_ARRAY_DATAGRAMS = 1 << 17
MAX_BATCH_BYTES = 1 << 23

Data = bytes | bytearray | memoryview | NDArray[np.uint8]

BACKENDS = ("auto", "numpy", "jit")
#: The environment variable with the default back end.
BACKEND = "LIDARSPEC_BACKEND"


class DecoderObserver(Protocol):
    """Receives the input and the frames of a decoder."""

    def observe_input(
        self, decoder: Decoder, buffer: NDArray[np.uint8], starts: Numbers, sizes: NDArray[np.intp]
    ) -> None:
        """Receive a piece of a stream, or datagrams, that a decoder is about to decode.

        `decoder.stats` does not count the input yet. The decoder does not change the buffer later,
        so the observer may keep it.
        """

    def observe_frames(self, frames: Frames) -> None:
        """Receive frames, in stream order."""


class Decoder:
    """Finds the frames of one sensor in its input.

    Args:
        sensor: the sensor; only its incoming frames are searched for.
        stream: True for a byte stream, False if the argument of each `feed` is one datagram.
        backend: the back end that computes the points of packets: "auto", "numpy" or "jit".
        sums: a function that computes checksums; by default the algorithm of each checksum is used.

    Attributes:
        framing: the frame types, prepared for the search.
        observer: the observer that receives the input and the frames, or None.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        *,
        stream: bool,
        backend: str = "auto",
        sums: Sums | None = None,
    ) -> None:
        if not sensor.incoming:
            raise UsageError(
                f"the frames of {sensor.id} are known only from its configuration file: pass the"
                " file to sensor.configure"
            )
        self.sensor = sensor
        self.stream = stream
        self.backend = backend
        self.stats = Counters()
        self.observer: DecoderObserver | None = None
        keep_freed_memory()
        self.framing = _make_framing(tuple(sensor.incoming), tuple(sensor.incoming.values()), sums)
        # Frames are read as if the frame that the answer comes after had been seen.
        answer = sensor.options.get("answer", "")
        self._state = SearchState(
            after=sensor.frames[answer].after if answer in sensor.frames else None
        )
        self._pending = b""
        self._base = 0
        self._need = 0
        self._gap = 0
        self._fillers = bytes(sensor.fillers)
        self._assembly: FragmentAssembler | None = None
        link = sensor.links.get("data")
        if isinstance(link, Udp) and link.assembled is not None and not stream:
            longest = max(frame.max_length for frame in sensor.incoming.values())
            self._assembly = FragmentAssembler(link.assembled, longest, self.stats)
        self._least = max(MIN_PIECE_BYTES, 2 * self.framing.reach)
        # Weak frames take long to find, but not as regular rows, which follow the first piece.
        if self.framing.has_weak_types:
            self._size = self._least
        else:
            self._size = max(MAX_PIECE_BYTES, self._least)

    def __repr__(self) -> str:
        return (
            f"Decoder({self.sensor.id}, {'stream' if self.stream else 'datagrams'}, {self.backend}:"
            f" {self.stats})"
        )

    @property
    def joins(self) -> bool:
        """Whether messages are joined from several datagrams (`lidarspec.spec.Assembled`)."""
        return self._assembly is not None

    def feed(self, data: Data, at: int | None = None) -> list[Found]:
        """Decode more input; return the frames that are now complete, in stream order.

        Invalid bytes are counted, and raise no exception.

        Args:
            data: the next bytes of the stream, or one datagram.
            at: the arrival time of the bytes, ns; None if unknown.
        """
        return [found for frames in self.frames(data, at) for found in frames.to_found()]

    def idle(self) -> list[Found]:
        """Reject incomplete candidates; call this when no data has arrived for a while.

        Returns:
            The frames that are found when the bytes of these candidates are searched again.
        """
        return [found for frames in self.take_pending() for found in frames.to_found()]

    def finish(self) -> list[Found]:
        """Reject incomplete candidates; call this when the input has ended.

        Returns:
            The frames that are found when the bytes of these candidates are searched again.
        """
        return self.idle()

    def frames(self, data: Data, at: int | None = None) -> list[Frames]:
        """Decode more input; return the frames that are now complete, in stream order.

        This is `feed` with arrays as the result, which is faster for many frames.

        Args:
            data: the next bytes of the stream, or one datagram.
            at: the arrival time of the bytes, ns; None if unknown.
        """
        if isinstance(data, np.ndarray):
            view = np.ascontiguousarray(data).data.cast("B")
        else:
            view = memoryview(data).cast("B")
        if not self.stream:
            return [self.datagrams([view], [at])]
        if self.observer is not None:
            buffer = np.frombuffer(data if isinstance(data, bytes) else bytes(view), np.uint8)
            self.observer.observe_input(self, buffer, range(1), repeat(len(view), 1))
        self.stats.bytes_in += len(view)
        parts: list[Frames] = []
        start = 0
        is_immutable = isinstance(data, bytes)
        if self._pending:
            held = len(self._pending)
            head = b"".join((self._pending, view[: max(self._least, self._need)]))
            start = self._find_frames(np.frombuffer(head, np.uint8), at, parts) - held
            if start < 0 or held + len(view) == len(head):
                self._pending = head[start + held :]
                start = len(view)
        if start < len(view):
            rest = np.frombuffer(view[start:], np.uint8)
            self._pending = rest[
                self._find_frames(rest, at, parts, is_immutable=is_immutable) :
            ].tobytes()
        self.stats.pending = len(self._pending)
        return parts

    def take_pending(self) -> list[Frames]:
        """Reject incomplete candidates, and return the frames found in their bytes."""
        parts: list[Frames] = []
        self._need = 0
        if self._assembly is not None:
            self._count_dropped(self._assembly.give_up())
        if self._pending:
            self._find_frames(np.frombuffer(self._pending, np.uint8), None, parts, final=True)
        self._pending = b""
        self.stats.pending = 0
        return parts

    def datagrams(
        self, data: Sequence[Any] | NDArray[np.uint8], at: Sequence[int | None] | None = None
    ) -> Frames:
        """Return the frames in datagrams; each datagram is one whole frame or invalid.

        Args:
            data: a list of bytes, or an array with a datagram in each row, (n, size).
            at: the arrival time of each datagram, ns; None if unknown.
        """
        if isinstance(data, np.ndarray):
            buffer = data.reshape(-1)
            sizes = repeat(data.shape[1], len(data))
        else:
            buffer = np.frombuffer(b"".join(data), np.uint8)
            lengths = list(map(len, data))
            is_one_size = bool(lengths) and lengths.count(lengths[0]) == len(lengths)
            if is_one_size:
                sizes = repeat(lengths[0], len(lengths))
            else:
                sizes = np.array(lengths, np.intp)
        if at is None:
            times = repeat(-1, len(data))
        else:
            times = np.array([-1 if time is None else time for time in at], np.int64)
        return self.decode_placed(buffer, _compute_offsets(sizes), sizes, times)

    def decode_placed(
        self,
        buffer: NDArray[np.uint8],
        starts: Numbers,
        sizes: NDArray[np.intp],
        at: NDArray[np.int64],
    ) -> Frames:
        """Return the frames in datagrams that are in one buffer, without copying them.

        Args:
            buffer: the bytes, one-dimensional and contiguous; bytes between datagrams are ignored.
            starts: the offset of each datagram in the buffer, in the order of arrival.
            sizes: the size of each datagram in bytes.
            at: the arrival time of each datagram, ns; -1 if unknown.
        """
        size = broadcast_value(sizes)
        if size is None:
            total = int(sizes.sum())
        else:
            total = size * len(sizes)
        places = _compute_offsets(sizes, self._base)
        joined = None
        if self.observer is not None:
            self.observer.observe_input(self, buffer, starts, sizes)
        if self._assembly is not None:
            joined = self._assembly.join(buffer, starts, sizes, at, self._base)
            buffer = joined.buffer
            starts = joined.starts
            sizes = joined.sizes
            at = joined.at
            places = joined.places
            self.stats.bytes_skipped += joined.header_bytes
            self.stats.bytes_filler += joined.header_bytes
            self.stats.pending = self._assembly.pending
        piece = classify_datagrams(self.framing, buffer, starts, sizes, self._state)
        frames = piece.frames
        self._base = self._base + total
        self.stats.bytes_in = self.stats.bytes_in + total
        self._count_rejected(piece.rejected, piece.errors)
        gaps = repeat(0, len(frames))
        kind = broadcast_value(frames.kinds)
        if kind is not None:
            is_good = kind >= 0
        else:
            is_good = not np.count_nonzero(frames.kinds < 0)
        if self._gap or not is_good or (joined is not None and joined.dropped.any()):
            good = frames.kinds >= 0
            gaps = self._count_invalid(buffer, frames.starts, sizes, good, joined)
            if not is_good:
                frames = frames.select(good)
                places = to_array(places)[good]
                at = at[good]
        self._count_frames(frames.kinds)
        return self._observe(frames.locate(self.framing.names, places, gaps, at))

    def _observe(self, frames: Frames) -> Frames:
        if self.observer is not None:
            self.observer.observe_frames(frames)
        return frames

    def _count_invalid(
        self,
        buffer: NDArray[np.uint8],
        starts: NDArray[np.intp],
        sizes: NDArray[np.intp],
        good: NDArray[np.bool_],
        joined: JoinedMessages | None,
    ) -> NDArray[np.int64]:
        """Add the skipped bytes in a batch of datagrams to the counters.

        Returns:
            The number of skipped bytes before each frame, without fillers.
        """
        lost = self._count_skipped(buffer, np.where(good, 0, sizes), starts + sizes)
        if joined is not None:
            lost = lost + joined.dropped[:-1]
            self.stats.bytes_skipped += int(joined.dropped[:-1].sum())
        before = np.concatenate([[-self._gap], np.cumsum(lost)[good]])
        self._gap = int(lost.sum() - before[-1])
        if joined is not None:
            self._count_dropped(int(joined.dropped[-1]))
        return np.diff(before)

    def _count_dropped(self, size: int) -> None:
        """Add skipped bytes to the counter, and to the gap before the next frame."""
        self._gap = self._gap + size
        self.stats.bytes_skipped = self.stats.bytes_skipped + size

    def _find_frames(
        self,
        buffer: NDArray[np.uint8],
        at: int | None,
        parts: list[Frames],
        *,
        is_immutable: bool = True,
        final: bool = False,
    ) -> int:
        """Find frames in bytes, piece by piece, and add them to `parts`.

        Args:
            is_immutable: whether the bytes are not changed later, and need not be copied.
            final: whether no bytes follow.

        Returns:
            The offset at which the pending bytes begin.
        """
        start = 0
        while start < len(buffer) and len(buffer) - start >= self._need:
            part = buffer[start : start + self._size]
            last = start + len(part) == len(buffer)
            part = part if is_immutable else part.copy()
            piece = self._decode_piece(part, final=final and last)
            frames = self._count_piece(part, piece, at)
            parts += [frames] if len(frames) else []  # none at all would keep its bytes
            start = start + piece.end
            self._base = self._base + piece.end
            self._need = piece.need if piece.is_waiting and last else 0
            if piece.is_waiting and last:
                break
            most = (
                MAX_REGULAR_PIECE_BYTES if 2 * frames.total_bytes > piece.end else MAX_PIECE_BYTES
            )
            self._size = min(max(4 * piece.end, self._least), max(most, self._least))
        return start

    def _decode_piece(self, buffer: Bytes1D, *, final: bool) -> PieceResult:
        """Find the frames in a piece of a stream."""
        piece = None
        if not final:
            piece = find_regular_frames(self.framing, buffer, self._state, self._base)
        if piece is None:
            piece = find_frames(self.framing, buffer, self._state, self._base, final=final)
        return piece

    def _count_piece(self, buffer: NDArray[np.uint8], piece: PieceResult, at: int | None) -> Frames:
        """Count all bytes of a piece, and return its frames with their offsets in the input."""
        frames = piece.frames
        base = self._base
        gaps = self._count_gaps(buffer, frames, piece.end)
        self._count_rejected(piece.rejected, piece.errors)
        self._count_frames(frames.kinds)
        places = frames.places
        if isinstance(places, range):
            places = range(places.start + base, places.stop + base, places.step)
        else:
            places = places + base
        return self._observe(
            frames.locate(
                self.framing.names, places, gaps, repeat(-1 if at is None else at, len(frames))
            )
        )

    def _count_gaps(self, buffer: NDArray[np.uint8], frames: Frames, end: int) -> NDArray[np.int64]:
        """Add the skipped bytes in a piece to the counters.

        Args:
            end: the offset of the end of the piece.

        Returns:
            The number of skipped bytes before each frame, without fillers.
        """
        places = frames.places
        if not self._gap and isinstance(places, range) and places.start == 0 and places.stop == end:
            return repeat(0, len(frames))
        gaps = np.empty(len(frames) + 1, np.int64)
        gaps[:-1], gaps[-1] = frames.starts, end
        stops = gaps.copy()
        gaps[1:] -= frames.starts + frames.sizes
        gaps = self._count_skipped(buffer, gaps, stops)
        gaps[0] += self._gap
        self._gap = int(gaps[-1])
        return gaps[:-1]

    def _count_skipped(
        self, buffer: NDArray[np.uint8], sizes: NDArray[np.int64], stops: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Add skipped ranges to the counters; return their sizes without fillers, (n,)."""
        self.stats.bytes_skipped += int(sizes.sum())
        for index in np.flatnonzero(sizes).tolist() if self._fillers else ():
            skipped = buffer[stops[index] - sizes[index] : stops[index]]
            fillers = len(skipped) - len(skipped.tobytes().translate(None, self._fillers))
            self.stats.bytes_filler += fillers
            sizes[index] -= fillers
        return sizes

    def _count_rejected(self, numbers: Mapping[str, int], errors: Sequence[PluginError]) -> None:
        for name, number in numbers.items():
            setattr(self.stats, name, getattr(self.stats, name) + number)
        self.stats.failures += errors[: 5 - len(self.stats.failures)]

    def _count_frames(self, kinds: NDArray[np.intp]) -> None:
        frames = self.stats.frames
        known = len(frames)
        only = broadcast_value(kinds)
        for kind, number in (
            [(only, len(kinds))]
            if only is not None
            else enumerate(np.bincount(kinds).tolist() if len(kinds) else ())
        ):
            if number:
                frames[self.framing.names[kind]] = frames.get(self.framing.names[kind], 0) + number
        if len(frames) > known > 0:
            for name in self.framing.names:  # in their order, however the input was cut
                if name in frames:
                    frames[name] = frames.pop(name)


@lru_cache(maxsize=256)
def _make_framing(names: tuple[str, ...], frames: tuple[Frame, ...], sums: Sums | None) -> Framing:
    return Framing(
        {name: get_codec(frame) for name, frame in zip(names, frames, strict=True)},
        sums,
    )


def _compute_offsets(sizes: NDArray[np.intp], first: int = 0) -> Numbers:
    """Return the offsets of consecutive pieces, given their sizes."""
    if size := broadcast_value(sizes):
        return range(first, first + len(sizes) * size, size)
    starts = np.cumsum(sizes)
    starts -= sizes
    starts += first
    return starts


def select_backend(name: str) -> str:
    """Return the back end to use for a name.

    If LIDARSPEC_BACKEND is set, it replaces "auto".

    Raises:
        UsageError: for an unknown name.
    """
    place = "backend"
    if name == "auto" and os.environ.get(BACKEND):
        place = BACKEND
        name = os.environ[BACKEND]
    if name not in BACKENDS:
        raise UsageError(f"{place} must be one of {', '.join(BACKENDS)}, not {name!r}")
    return name


def decode_all(decoder: Decoder, data: Any) -> list[Frames]:
    """Return all frames of a whole input.

    Args:
        data: bytes if the decoder decodes a stream, else an iterable or (n, size) array of
            datagrams.
    """
    if decoder.stream:
        return decoder.frames(data) + decoder.take_pending()
    packets: Any = (
        np.ascontiguousarray(data, np.uint8) if isinstance(data, np.ndarray) else list(data)
    )
    most = MAX_ARRAY_DATAGRAMS if isinstance(data, np.ndarray) else MAX_LIST_DATAGRAMS
    if len(packets):
        step = max(1, min(most, MAX_BATCH_BYTES // max(len(packets[0]), 1)))
    else:
        step = 1
    return [
        decoder.datagrams(packets[start : start + step]) for start in range(0, len(packets), step)
    ] + decoder.take_pending()


def is_stream(data: Any) -> bool:
    """Return whether an input is a byte stream, not datagrams.

    Raises:
        UsageError: for a text or a path.
    """
    refuse_text(data)
    return isinstance(data, bytes | bytearray | memoryview)
