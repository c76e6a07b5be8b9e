"""Stores the newest bytes of a source: its frames, and damaged bytes.

A decoder passes its input, and the frames that it has found, to `RecentBytes` (a
`DecoderObserver`). The input and the frames are stored unchanged, up to a limit, so that reading is
not slowed down. The bytes of a frame are copied only on request.
"""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec import Decoder, Sensor, WireError
from lidarspec.explaining.explanation import Explanation
from lidarspec.explaining.input_segments import InputPiece, explain_piece
from lidarspec.framing.results import Frames, Numbers, to_array
from lidarspec.scans.provenance import PointOrigin

#: Maximum number of bytes of stored input.
MAX_INPUT_BYTES = 1 << 23
#: Maximum number of stored results of the decoder.
MAX_RESULTS = 1024
#: Maximum number of stored damaged pieces.
MAX_DAMAGED = 500
#: Maximum number of stored bytes of one damaged piece.
MAX_DAMAGED_BYTES = 1 << 13


@dataclass(frozen=True)
class DamagedBytes:
    """Consecutive bytes of the input that are not in valid frames: a damaged piece.

    Attributes:
        number: number of the damaged piece, counted from 0.
        offset: offset in the input.
        at: arrival time of the frame after these bytes, ns since 1970; -1 if it is unknown.
        data: the bytes, but at most the first `MAX_DAMAGED_BYTES`.
        is_datagram: whether the bytes are one whole datagram.
    """

    number: int
    offset: int
    size: int
    at: int
    data: bytes
    is_datagram: bool

    def describe_fault(self, sensor: Sensor) -> str:
        """Return a text that says why the bytes are not a valid frame."""
        if not self.data:
            return "the message is incomplete, because datagrams are missing"
        try:
            sensor.parse(self.data)
        except WireError as error:
            return error.reason
        return "the values are not plausible"


@dataclass(frozen=True)
class StoredFrame:
    """The bytes of a frame that a page can explain.

    Attributes:
        number: number of the frame, counted from 0; None if `RecentBytes` no longer has the frame.
            Its bytes were then taken from the scan that contains the requested point.
        at: arrival time, ns since 1970; -1 if it is unknown.
    """

    number: int | None
    frame: str
    at: int
    data: bytes


@dataclass(frozen=True)
class _DecoderInput:
    """The bytes that the decoder received in one call.

    Attributes:
        offset: offset of the first of these bytes, counted from the start of the source.
        buffer: an array with these bytes, and possibly further bytes.
        starts: the offset of each part in the buffer. A stream has one part; otherwise, each
            datagram is a part.
        sizes: the number of bytes of each part.
    """

    offset: int
    buffer: NDArray[np.uint8]
    starts: Numbers
    sizes: NDArray[np.intp]

    @property
    def size(self) -> int:
        return int(self.sizes.sum())


@dataclass(frozen=True)
class _FoundFrames:
    """The frames that the decoder found in one call, with the first frame's number."""

    first_number: int
    frames: Frames

    @property
    def offset(self) -> int:
        return int(self.frames.places[0])

    @property
    def last_offset(self) -> int:
        return int(self.frames.places[-1])

    def take(self, index: int) -> StoredFrame:
        frames = self.frames
        kind = int(frames.kinds[index])
        return StoredFrame(
            self.first_number + index,
            frames.names[kind],
            int(frames.at[index]),
            frames.data(index),
        )


class RecentBytes:
    """Stores the newest input of a decoder and the frames in it: a `DecoderObserver`.

    One thread adds to it; any thread may read it.

    Attributes:
        damaged: number of damaged pieces (`DamagedBytes`) so far.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.sensor = sensor
        self.damaged = 0
        self._lock = threading.Lock()
        self._is_stream = True
        self._joins_datagrams = False
        self._inputs = deque[_DecoderInput]()
        self._input_size = 0
        self._results = deque[_FoundFrames]()
        self._frame_count = 0
        self._end = 0  # end of the last frame, an offset in the input
        self._damaged = deque[DamagedBytes](maxlen=MAX_DAMAGED)

    def observe_input(
        self, decoder: Decoder, buffer: NDArray[np.uint8], starts: Numbers, sizes: NDArray[np.intp]
    ) -> None:
        """Store the input of the decoder."""
        with self._lock:
            self._is_stream = decoder.stream
            self._joins_datagrams = decoder.joins
            added = _DecoderInput(decoder.stats.bytes_in, buffer, starts, sizes)
            self._inputs.append(added)
            self._input_size += added.size
            self._drop_old()

    def observe_frames(self, frames: Frames) -> None:
        """Store frames in their order in the input."""
        if not len(frames):
            return
        with self._lock:
            if frames.gaps.any():
                self._keep_skipped(frames)
            self._results.append(_FoundFrames(self._frame_count, frames))
            self._frame_count += len(frames)
            self._end = int(frames.places[-1]) + int(frames.sizes[-1])

    def forget(self) -> None:
        """Discard the bytes, because the input restarts; frame numbers continue."""
        with self._lock:
            self._inputs.clear()
            self._results.clear()
            self._input_size = 0
            self._end = 0

    def freeze(self) -> RecentBytes:
        """Return an unchanging copy of the stored frames and damaged bytes."""
        copy = RecentBytes(self.sensor)
        with self._lock:
            copy._results = deque(self._results)
            copy._damaged = deque(self._damaged)
            copy._frame_count = self._frame_count
            copy.damaged = self.damaged
        return copy

    @property
    def newest_number(self) -> int:
        """The number of the newest frame; -1 before the first."""
        return self._frame_count - 1

    def frame(self, number: int) -> StoredFrame | None:
        """Return a frame by its number; None if it is no longer stored."""
        with self._lock:
            following = bisect_right(self._results, number, key=lambda one: one.first_number)
            result = self._results[following - 1] if following else None
        if result is None or number - result.first_number >= len(result.frames):
            return None
        return result.take(number - result.first_number)

    def find_point_frame(self, point_origin: PointOrigin) -> StoredFrame | None:
        """Return the frame that contained a point; None if the frame is not available."""
        with self._lock:
            following = bisect_right(self._results, point_origin.offset, key=lambda one: one.offset)
            result = self._results[following - 1] if following else None
        if result is not None:
            offsets = result.frames.offsets
            index = int(offsets.searchsorted(point_origin.offset))
            if index < len(offsets) and offsets[index] == point_origin.offset:
                return result.take(index)
        if self.sensor.frames[point_origin.frame].wire is not None:
            return None
        return StoredFrame(None, point_origin.frame, point_origin.host_ns or -1, point_origin.data)

    def find_damaged(self, number: int) -> DamagedBytes | None:
        """Return damaged bytes by their number; None if they are no longer stored."""
        return next((piece for piece in self.list_damaged(number) if piece.number == number), None)

    def list_damaged(self, number: int) -> list[DamagedBytes]:
        """Return the stored `DamagedBytes` whose number is at least `number`."""
        with self._lock:
            return [piece for piece in self._damaged if piece.number >= number]

    def explain_damaged(self, piece: DamagedBytes) -> dict[str, Any]:
        """Return the explanation of damaged bytes, in the form of `Explanation.to_dict`."""
        parts = list(
            explain_piece(self.sensor, InputPiece(piece.offset, piece.data, "", piece.is_datagram))
        )
        frames = [explanation for _, explanation in parts if explanation.frame]
        rows = []
        for part, explanation in parts:
            shift = part.offset - piece.offset
            rows += [row.to_dict() | {"offset": row.offset + shift} for row in explanation.rows]
        notes = [note for explanation in frames for note in explanation.notes]
        if frames:
            first = frames[0]
        else:
            first = Explanation(self.sensor.id, "", piece.data, ())
        return first.to_dict() | {"size": len(piece.data), "notes": notes, "rows": rows}

    def _drop_old(self) -> None:
        """Drop the oldest inputs and the oldest frames until the limits are met."""
        inputs = self._inputs
        results = self._results
        while self._input_size > MAX_INPUT_BYTES and len(inputs) > 1:
            self._input_size -= inputs.popleft().size
        oldest = inputs[0].offset
        while len(results) > 1 and (len(results) > MAX_RESULTS or results[0].last_offset < oldest):
            results.popleft()
        # Inputs without frames give no results.
        while len(inputs) > 2 * MAX_RESULTS:
            self._input_size -= inputs.popleft().size

    def _keep_skipped(self, frames: Frames) -> None:
        """Store the bytes that the decoder skipped before these frames."""
        ends = frames.offsets + frames.sizes
        previous_ends = np.concatenate([[self._end], ends[:-1]])
        for index in np.flatnonzero(frames.gaps).tolist()[-MAX_DAMAGED:]:
            at = int(frames.at[index])
            begin = int(previous_ends[index])
            end = int(frames.offsets[index])
            if self._joins_datagrams:
                size = int(frames.gaps[index])
                self._keep_damaged(end, size, at, b"", is_datagram=False)
            elif self._is_stream:
                data = self._copy_stream_bytes(begin, end)
                self._keep_damaged(begin, end - begin, at, data, is_datagram=False)
            else:
                for offset, data in self._iter_datagrams(begin, end):
                    self._keep_damaged(offset, len(data), at, data, is_datagram=True)

    def _keep_damaged(
        self, offset: int, size: int, at: int, data: bytes, *, is_datagram: bool
    ) -> None:
        data = data[:MAX_DAMAGED_BYTES]
        self._damaged.append(DamagedBytes(self.damaged, offset, size, at, data, is_datagram))
        self.damaged += 1

    def _copy_stream_bytes(self, begin: int, end: int) -> bytes:
        """Return the stored bytes of a stream from one offset to another."""
        parts = [
            bytes(
                stored_input.buffer[max(begin - stored_input.offset, 0) : end - stored_input.offset]
            )
            for stored_input in self._inputs
            if stored_input.offset < end
        ]
        return b"".join(parts)

    def _iter_datagrams(self, begin: int, end: int) -> Iterator[tuple[int, bytes]]:
        """Yield offset and bytes of each datagram that begins in a range of offsets."""
        for stored_input in self._inputs:
            offsets = stored_input.offset + np.cumsum(stored_input.sizes) - stored_input.sizes
            starts = to_array(stored_input.starts)
            for index in np.flatnonzero((offsets >= begin) & (offsets < end)).tolist():
                start = int(starts[index])
                data = stored_input.buffer[start : start + int(stored_input.sizes[index])]
                yield int(offsets[index]), data.tobytes()
