"""The incremental decoder: bytes in, frames out, everything counted. No clock, port or thread in here.

A byte stream is cut into pieces that stay in the cache; what a piece leaves undecided is looked at again together
with the next. Datagram links frame by datagram. However the input is cut, the frames and counters are the same.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, refuse_text
from lidarspec.framing.datagrams import Datagrams, evenly
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import Alike, Counters, Found, Spans, packed
from lidarspec.framing.search import Framing, Mode, Piece
from lidarspec.framing.weak_frames import cut
from lidarspec.spec.description import Frame, Spec
from lidarspec.wire.arrays import alike, repeated
from lidarspec.wire.layout import Bytes2D, Sums, summed_by

__all__ = ["BACKENDS", "Counters", "Decoder", "Found", "Spans", "backend", "is_stream", "packed", "spans_of"]

#: bytes of a stream looked at in one go: at most, where frames follow one another and where not; and at least.
LONGEST, PIECE, LEAST = 24 << 16, 6 << 16, 1 << 12

#: datagrams of a list judged together; rows of an array, which need not be gathered first; and bytes of either, about.
TOGETHER, ROWS, ROW_BYTES = 1 << 14, 1 << 17, 1 << 23

Data = bytes | bytearray | memoryview | NDArray[np.uint8]

BACKENDS = ("auto", "numpy", "jit", "construct")
#: the variable of the environment that names the default.
BACKEND = "LIDARSPEC_BACKEND"


class Decoder:
    """Finds the frames of one sensor in what it is fed.

    Args:
        sensor: the sensor; only its incoming frames are looked for.
        stream: a byte stream, or datagrams one for each `feed`.
        interpreted: let construct judge every candidate.
        backend: what makes points of its packets, "auto", "numpy" or "jit".
        sums: what computes checksums; by default their algorithms.
    """

    def __init__(self, sensor: Spec, *, stream: bool, interpreted: bool = False, backend: str = "auto", sums: Sums | None = None) -> None:
        incoming = {name: frame for name, frame in sensor.frames.items() if frame.direction == "in"}
        if not incoming:
            raise UsageError(f"{sensor.id} has no frames yet: configure it with its file first")
        self.sensor, self.stream, self.interpreted, self.backend = sensor, stream, interpreted, backend
        self.stats, self._sums = Counters(), sums
        self._framing = _framing(tuple(incoming), tuple(incoming.values()), interpreted)
        self._mode = Mode(after=_first_mode(sensor))
        self._pending, self._base, self._need = b"", 0, 0
        self._gap = 0
        self._fillers, self._names = bytes(sensor.fillers), tuple(incoming)
        self._least = max(LEAST, 2 * self._framing.reach)
        self._size = max(PIECE, self._least)
        self._datagrams = Datagrams(self._framing)

    def feed(self, data: Data, at: int | None = None) -> list[Found]:
        """The frames that these bytes complete, in stream order. Raises on no bytes whatever.

        Args:
            data: the next bytes of the stream, or one datagram.
            at: their arrival time in ns, if known.
        """
        return [found for spans in self.spans(data, at) for found in spans.found()]

    def idle(self) -> list[Found]:
        """The line fell silent: candidates that wait for bytes are given up, and their bytes looked at again."""
        return [found for spans in self.rest() for found in spans.found()]

    def finish(self) -> list[Found]:
        """The input ended; the same as `idle`."""
        return self.idle()

    def spans(self, data: Data, at: int | None = None) -> list[Spans]:
        """The same as `feed`, as arrays."""
        view = np.ascontiguousarray(data).data.cast("B") if isinstance(data, np.ndarray) else memoryview(data).cast("B")
        if not self.stream:
            return [self.datagrams([view], [at])]
        self.stats.bytes_in += len(view)
        found: list[Spans] = []
        start, lasting = 0, isinstance(data, bytes)
        if self._pending:
            held = len(self._pending)
            head = b"".join((self._pending, view[: max(self._least, self._need)]))
            start = self._cut(np.frombuffer(head, np.uint8), at, found) - held
            if start < 0 or held + len(view) == len(head):
                self._pending, start = head[start + held :], len(view)
        if start < len(view):
            rest = np.frombuffer(view[start:], np.uint8)
            self._pending = rest[self._cut(rest, at, found, lasting=lasting) :].tobytes()
        self.stats.pending = len(self._pending)
        return found

    def rest(self) -> list[Spans]:
        """The same as `idle` and `finish`, as arrays."""
        found: list[Spans] = []
        self._need = 0
        if self._pending:
            self._cut(np.frombuffer(self._pending, np.uint8), None, found, final=True)
        self._pending, self.stats.pending = b"", 0
        return found

    def datagrams(self, data: Sequence[Any] | NDArray[np.uint8], at: Sequence[int | None] | None = None) -> Spans:
        """Datagrams, each one frame, whole, or none; a list, or the rows of an array."""
        if isinstance(data, np.ndarray):
            buffer, sizes = data.reshape(-1), repeated(data.shape[1], len(data))
        else:
            buffer, sizes = np.frombuffer(b"".join(data), np.uint8), _sizes(list(map(len, data)))
        times = repeated(-1, len(data)) if at is None else np.array([-1 if one is None else one for one in at], np.int64)
        rows = buffer.reshape(len(data), -1) if alike(sizes) else None
        found = None if rows is None else self._alike(buffer, 0, rows, times)
        return self._sorted(buffer, _starts(sizes), sizes, times) if found is None else found

    def placed(self, buffer: NDArray[np.uint8], starts: NDArray[np.intp], sizes: NDArray[np.intp], at: NDArray[np.int64]) -> Spans:
        """Datagrams that stand in one buffer already; the same as `datagrams`, and nothing is copied.

        Args:
            buffer: one-dimensional and contiguous; what stands between the datagrams does not matter.
            starts, sizes: of each datagram, in the order of their arrival.
            at: their arrival times in ns, -1 where nobody knows.
        """
        rows = evenly(buffer, starts, sizes)
        found = None if rows is None else self._alike(buffer, starts.item(0), rows, at)
        return self._sorted(buffer, starts, sizes, at) if found is None else found

    def _alike(self, buffer: NDArray[np.uint8], first: int, rows: Bytes2D, at: NDArray[np.int64]) -> Spans | None:
        """Datagrams of one size and distance, if all are frames of one layout that change nothing."""
        with summed_by(self._sums):
            known = self._datagrams.alike(rows, self._mode)
        if known is None:
            return None
        found = Alike(self._names, buffer, *known, rows, first, self._base, self._gap, at)
        self.stats.bytes_in += rows.size
        self._base, self._gap = self._base + rows.size, 0
        self._count(found.kinds)
        return found

    def _sorted(self, buffer: NDArray[np.uint8], starts: NDArray[np.intp], sizes: NDArray[np.intp], at: NDArray[np.int64]) -> Spans:
        """Datagrams of any kinds."""
        offsets = _starts(sizes, self._base)
        total = offsets.item(-1) + sizes.item(-1) - self._base if len(offsets) else 0
        self.stats.bytes_in += total
        with summed_by(self._sums):
            kinds = self._datagrams.kinds(buffer, starts, sizes, self._mode)
        self._rejected(self._datagrams.rejected, self._datagrams.errors)
        self._base += total
        gaps, kind = repeated(0, len(starts)), alike(kinds)
        if self._gap or bool((kinds < 0).any() if kind is None else kind < 0):
            good = kinds >= 0
            gaps = self._lost(buffer, starts, sizes, good)
            kinds, starts, sizes, offsets, at = (array[good] for array in (kinds, starts, sizes, offsets, at))
        self._count(kinds)
        return Spans(self._names, buffer, kinds, starts, sizes, offsets, gaps, at)

    def _lost(
        self, buffer: NDArray[np.uint8], starts: NDArray[np.intp], sizes: NDArray[np.intp], good: NDArray[np.bool_]
    ) -> NDArray[np.int64]:
        """The bytes in datagrams that are no frames before each one that is, fillers left out; counts them."""
        lost = np.where(good, 0, sizes)
        if self._fillers:
            for index in np.flatnonzero(lost).tolist():
                lost[index] -= self._skip(buffer[starts[index] : starts[index] + sizes[index]])
        else:
            self.stats.bytes_skipped += int(lost.sum())
        before = np.concatenate([[-self._gap], np.cumsum(lost)[good]])
        self._gap = int(lost.sum() - before[-1])
        return np.diff(before)

    def _cut(self, buffer: NDArray[np.uint8], at: int | None, found: list[Spans], *, lasting: bool = True, final: bool = False) -> int:
        """Cut bytes into frames, piece by piece, and add those with frames to what is found.

        Args:
            lasting: nobody will change the bytes.
            final: nothing follows them.

        Returns:
            Where the rest begins that waits for what follows.
        """
        start = 0
        while start < len(buffer) and len(buffer) - start >= self._need:
            part = buffer[start : start + self._size]
            last = start + len(part) == len(buffer)
            part = part if lasting else part.copy()
            with summed_by(self._sums):
                piece = cut(self._framing, part, self._mode, base=self._base, final=final and last)
            spans = self._entered(part, piece, at)
            found += [spans] if len(spans) else []  # one without frames would keep its bytes
            start, self._base = start + piece.end, self._base + piece.end
            self._need = piece.need if piece.waiting and last else 0
            if piece.waiting and last:
                break
            most = LONGEST if 2 * (piece.sizes.sum() if piece.rows is None else piece.rows.size) > piece.end else PIECE
            self._size = min(max(4 * piece.end, self._least), max(most, self._least))
        return start

    def _entered(self, buffer: NDArray[np.uint8], piece: Piece, at: int | None) -> Spans:
        """The frames of a piece, with all that was found in it counted."""
        if piece.layout is not None and piece.rows is not None:
            times = repeated(-1 if at is None else at, len(piece.rows))
            found = Alike(self._names, buffer, piece.kinds.item(0), piece.layout, piece.rows, 0, self._base, self._gap, times)
            self._gap = 0
            self._count(found.kinds)
            return found
        gaps = self._gaps(buffer, piece)
        self._rejected(piece.rejected, piece.errors)
        self._count(piece.kinds)
        starts, offsets = piece.offsets, np.add(piece.offsets, self._base)
        if piece.rows is not None:
            buffer, starts = piece.rows.reshape(-1), np.arange(len(piece.rows)) * piece.rows.shape[1]
        times = repeated(-1 if at is None else at, len(gaps))
        return Spans(self._names, buffer, piece.kinds, starts, piece.sizes, offsets, gaps, times)

    def _gaps(self, buffer: NDArray[np.uint8], piece: Piece) -> NDArray[np.int64]:
        """The bytes skipped before each frame, fillers left out; counts them."""
        gaps = np.empty(len(piece.offsets) + 1, np.int64)
        gaps[:-1], gaps[-1] = piece.offsets, piece.end
        gaps[1:] -= piece.offsets + piece.sizes
        if self._fillers:
            for index in np.flatnonzero(gaps).tolist():
                stop = int(piece.offsets[index]) if index < len(piece.offsets) else piece.end
                gaps[index] -= self._skip(buffer[stop - gaps[index] : stop])
        else:
            self.stats.bytes_skipped += int(gaps.sum())
        gaps[0] += self._gap
        self._gap = int(gaps[-1])
        return gaps[:-1]

    def _skip(self, skipped: NDArray[np.uint8]) -> int:
        """Count skipped bytes; the number of fillers among them."""
        fillers = len(skipped) - len(skipped.tobytes().translate(None, self._fillers)) if self._fillers else 0
        self.stats.bytes_skipped += len(skipped)
        self.stats.bytes_filler += fillers
        return fillers

    def _rejected(self, numbers: Mapping[str, int], errors: Sequence[str]) -> None:
        for name, number in numbers.items():
            setattr(self.stats, name, getattr(self.stats, name) + number)
        self.stats.tracebacks += errors[: 5 - len(self.stats.tracebacks)]

    def _count(self, kinds: NDArray[np.intp]) -> None:
        frames = self.stats.frames
        known = len(frames)
        only = alike(kinds)
        for kind, number in [(only, len(kinds))] if only is not None else enumerate(np.bincount(kinds).tolist() if len(kinds) else ()):
            if number:
                frames[self._names[kind]] = frames.get(self._names[kind], 0) + number
        if len(frames) > known > 0:
            for name in self._names:  # in their order, however the input was cut
                if name in frames:
                    frames[name] = frames.pop(name)


@lru_cache(maxsize=256)
def _framing(names: tuple[str, ...], frames: tuple[Frame, ...], interpreted: bool) -> Framing:
    return Framing({name: codec(frame, interpreted=interpreted) for name, frame in zip(names, frames, strict=True)})


def _starts(sizes: NDArray[np.intp], first: int = 0) -> NDArray[np.intp]:
    """Where pieces of these sizes begin that stand back to back from `first` on."""
    if size := alike(sizes):
        return np.arange(first, first + len(sizes) * size, size)
    starts = np.cumsum(sizes)
    starts -= sizes
    starts += first
    return starts


def _sizes(lengths: list[int]) -> NDArray[np.intp]:
    """Sizes as an array."""
    if lengths and lengths.count(lengths[0]) == len(lengths):
        return repeated(lengths[0], len(lengths))
    return np.array(lengths, np.intp)


def _first_mode(sensor: Spec) -> str | None:
    """`configure(answer=...)` starts as if the frame that the answer comes after had been seen."""
    answer = sensor.options.get("answer")
    return sensor.frames[answer].after if isinstance(answer, str) and answer in sensor.frames else None


def backend(name: str) -> str:
    """The back end that a name stands for; "auto" is what LIDARSPEC_BACKEND says, if it says anything.

    Raises:
        UsageError: for a name that is none.
    """
    place = "backend"
    if name == "auto" and os.environ.get(BACKEND):
        place, name = BACKEND, os.environ[BACKEND]
    if name not in BACKENDS:
        raise UsageError(f"{place} is one of {', '.join(BACKENDS)}, not {name!r}")
    return name


def spans_of(decoder: Decoder, data: Any) -> list[Spans]:
    """Every frame of a whole input: bytes as a stream, an iterable or (n, size) array as datagrams."""
    if is_stream(data):
        return decoder.spans(data) + decoder.rest()
    if isinstance(data, np.ndarray):
        everything, step = np.ascontiguousarray(data, np.uint8), min(max(ROW_BYTES // max(data.shape[1], 1), 1), ROWS)
        return [decoder.datagrams(everything[start : start + step]) for start in range(0, len(everything), step)]
    packets = list(data)
    step = max(1, min(TOGETHER, ROW_BYTES // max(len(packets[0]), 1))) if packets else 1
    return [decoder.datagrams(packets[start : start + step]) for start in range(0, len(packets), step)]


def is_stream(data: Any) -> bool:
    """Whether an input is one run of bytes, not datagrams.

    Raises:
        UsageError: for a text or a path.
    """
    refuse_text(data)
    return isinstance(data, bytes | bytearray | memoryview)
