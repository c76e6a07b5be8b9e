"""The newest bytes of a source, and what they say: frames by number and place, and those that were
damaged on their way.

What is decoded is kept as it came, up to a bound; no frame is looked at before somebody asks for
it. Damaged bytes are where the decoder passed some over: only then they are cut out and kept, so
that they can be explained later.
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
from lidarspec.explaining.pieces import Piece, explained
from lidarspec.framing.results import Frames, Numbers, array_of
from lidarspec.scans.scans import Place

#: bytes, and decodings, that are kept; and of what was damaged how many pieces, and bytes of each.
BYTES, DECODINGS = 1 << 23, 1024
DAMAGED, LONGEST = 500, 1 << 13
#: bytes that are in no frame which stand at the beginning of a stream: whoever begins to listen
#: hears the end of a frame.
_BEGINNING = "the end of a frame that began before"


@dataclass(frozen=True)
class Damaged:
    """Bytes that were a frame before they were damaged, or that never were one.

    Attributes:
        number: how many there were before it.
        offset, size: where in the input they stand.
        at: when the frame behind them arrived, ns since 1970; -1 where nobody knows it.
        data: they; of very many the first.
        datagram: whether they are one whole datagram.
    """

    number: int
    offset: int
    size: int
    at: int
    data: bytes
    datagram: bool

    def verdict(self, sensor: Sensor) -> str:
        """What is wrong with them, in one sentence."""
        if not self.data:
            return "a message of which datagrams are missing"
        try:
            sensor.parse(self.data)
        except WireError as error:
            return error.reason
        return "its values are not plausible"


@dataclass(frozen=True)
class Taken:
    """One frame; `at` as in `Damaged`, `number` None where it has gone out of the backlog."""

    number: int | None
    frame: str
    at: int
    data: bytes


class Backlog:
    """What a decoder was fed last and found in it: a `Witness`. One thread adds to it, any may ask.

    Attributes:
        sensor: whose.
        damaged: how many damaged pieces there were.
    """

    def __init__(self, sensor: Sensor) -> None:
        self.sensor, self.damaged = sensor, 0
        self._stream, self._joins, self._lock = True, False, threading.Lock()
        self._raw = deque[tuple[int, NDArray[np.uint8], Numbers, NDArray[np.intp]]]()
        self._found = deque[tuple[int, Frames]]()
        self._broken = deque[Damaged](maxlen=DAMAGED)
        self._size = self._number = self._end = 0

    def fed(
        self, decoder: Decoder, buffer: NDArray[np.uint8], starts: Numbers, sizes: NDArray[np.intp]
    ) -> None:
        """What a decoder is fed."""
        with self._lock:
            self._stream, self._joins = decoder.stream, decoder.joins
            self._raw.append((decoder.stats.bytes_in, buffer, starts, sizes))
            self._size += int(sizes.sum())
            while self._size > BYTES and len(self._raw) > 1:
                self._size -= int(self._raw.popleft()[3].sum())
            oldest = self._raw[0][0]
            while len(self._found) > 1 and (
                len(self._found) > DECODINGS or self._found[0][1].places[-1] < oldest
            ):
                self._found.popleft()
            while len(self._raw) > 2 * DECODINGS:
                self._size -= int(self._raw.popleft()[3].sum())

    def found(self, frames: Frames) -> None:
        """Frames of the input, in its order."""
        if not len(frames):
            return
        with self._lock:
            if frames.gaps.any():
                self._note(frames)
            self._found.append((self._number, frames))
            self._number += len(frames)
            self._end = int(frames.places[-1]) + int(frames.sizes[-1])

    def forget(self) -> None:
        """The input begins anew; numbers go on."""
        with self._lock:
            self._raw.clear()
            self._found.clear()
            self._size = self._end = 0

    def frozen(self) -> Backlog:
        """It as it is now, which nothing is added to; the bytes are shared."""
        still = Backlog(self.sensor)
        with self._lock:
            still._found, still._broken = deque(self._found), deque(self._broken)
            still._number, still.damaged = self._number, self.damaged
        return still

    @property
    def newest(self) -> int:
        """The number of the newest frame; -1 before there is one."""
        return self._number - 1

    def frame(self, number: int) -> Taken | None:
        """A frame by its number, from 0 on; None where it is not kept, any more or yet."""
        with self._lock:
            spot = bisect_right(self._found, number, key=lambda entry: entry[0]) - 1
            first, frames = self._found[spot] if spot >= 0 else (0, None)
        return (
            None
            if frames is None or not 0 <= number - first < len(frames)
            else _taken(first, frames, number - first)
        )

    def at(self, place: Place) -> Taken | None:
        """The frame that a point came from; None where it is not kept any more, and the scan has
        its bytes in another form.
        """
        with self._lock:
            spot = (
                bisect_right(self._found, place.offset, key=lambda entry: int(entry[1].places[0]))
                - 1
            )
            first, frames = self._found[spot] if spot >= 0 else (0, None)
        if frames is not None:
            index = int(frames.offsets.searchsorted(place.offset))
            if index < len(frames) and frames.offsets[index] == place.offset:
                return _taken(first, frames, index)
        return (
            Taken(None, place.frame, place.host_ns or -1, place.data)
            if self.sensor.frames[place.frame].wire is None
            else None
        )

    def broken(self, number: int) -> Damaged | None:
        """A damaged piece by its number; None where it is not kept any more."""
        return next((piece for piece in self.since(number) if piece.number == number), None)

    def since(self, number: int) -> list[Damaged]:
        """The damaged pieces from a number on that are kept."""
        with self._lock:
            return [piece for piece in self._broken if piece.number >= number]

    def mended(self, piece: Damaged) -> dict[str, Any]:
        """A damaged piece in one explanation: what was a frame in it, with what would explain the
        damage, and what is between these.
        """
        parts = list(explained(self.sensor, Piece(piece.offset, piece.data, "", piece.datagram)))
        whole = [part for _, part in parts if part.frame]
        rows = [
            row.to_dict() | {"offset": row.offset + place.offset - piece.offset}
            for place, part in parts
            for row in part.rows
        ]
        named = whole[0] if whole else Explanation(self.sensor.id, "", piece.data, ())
        notes = [note for part in whole for note in part.notes]
        return named.to_dict() | {"size": len(piece.data), "notes": notes, "rows": rows}

    def _note(self, frames: Frames) -> None:
        """Keep the bytes that were passed over before some of these frames."""
        offsets, ends = (
            frames.offsets,
            np.concatenate([[self._end], (frames.offsets + frames.sizes)[:-1]]),
        )
        for index in np.flatnonzero(frames.gaps).tolist()[-DAMAGED:]:
            at, end = int(frames.at[index]), int(offsets[index])
            if self._joins:
                self._keep(end, int(frames.gaps[index]), at, b"", datagram=False)
                continue
            for offset, size, data in self._between(int(ends[index]), end):
                self._keep(offset, size, at, data, datagram=not self._stream)

    def _keep(self, offset: int, size: int, at: int, data: bytes, *, datagram: bool) -> None:
        self._broken.append(Damaged(self.damaged, offset, size, at, data, datagram))
        self.damaged += 1

    def _between(self, start: int, end: int) -> Iterator[tuple[int, int, bytes]]:
        """The bytes from one place of the input to another, each datagram by itself: where, how
        many, and they.
        """
        if self._stream:
            parts = [
                bytes(buffer[max(start - first, 0) : end - first])
                for first, buffer, _, _ in self._raw
                if first < end
            ]
            yield start, end - start, b"".join(parts)[:LONGEST]
            return
        for first, buffer, starts, sizes in self._raw:
            places = first + np.cumsum(sizes) - sizes
            for index in np.flatnonzero((places >= start) & (places < end)).tolist():
                spot, size = int(array_of(starts)[index]), int(sizes[index])
                yield int(places[index]), size, buffer[spot : spot + size].tobytes()[:LONGEST]


def _taken(first: int, frames: Frames, index: int) -> Taken:
    return Taken(
        first + index,
        frames.names[int(frames.kinds[index])],
        int(frames.at[index]),
        frames.data(index),
    )
