"""The incremental decoder: bytes in, frames out, everything counted. No clock, port or thread in here.

A byte stream is cut into pieces that stay in the cache; what a piece leaves undecided is looked at again together
with the next. Datagram links frame by datagram. However the input is cut, the frames and counters are the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.codecs import VALID, Codec, codec
from lidarspec.errors import UsageError
from lidarspec.framing import COUNTED, Framing, Mode, Piece
from lidarspec.spec import Sensor

#: bytes of a stream looked at in one go.
PIECE = 1 << 16

#: datagrams judged together.
TOGETHER = 1024

Data = bytes | bytearray | memoryview | NDArray[np.uint8]

BACKENDS = ("auto", "numpy", "jit", "construct")


@dataclass
class Counters:
    """What became of the input. ``bytes_in == bytes in frames + bytes_skipped + pending`` always holds.

    Attributes:
        frames: number of frames by type.
        bytes_filler: declared fillers among the skipped bytes.
        pending: bytes held because a candidate needs more.
        bad_checksum, bad_length, implausible: rejected candidates.
        lost, duplicates, late: packets, by the sensor's sequence.
        kernel_drops, queue_dropped, foreign, disconnects: counted by the transports.
        plugin_errors: exceptions out of a plugin; `tracebacks` keeps the first ones.
    """

    bytes_in: int = 0
    frames: dict[str, int] = field(default_factory=dict)
    bytes_skipped: int = 0
    bytes_filler: int = 0
    pending: int = 0
    bad_checksum: int = 0
    bad_length: int = 0
    implausible: int = 0
    lost: int = 0
    duplicates: int = 0
    late: int = 0
    kernel_drops: int = 0
    queue_dropped: int = 0
    foreign: int = 0
    plugin_errors: int = 0
    disconnects: int = 0
    tracebacks: list[str] = field(default_factory=list, repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """The counters by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "tracebacks"}

    def error(self, traceback: str, number: int = 1) -> None:
        """Count an exception out of a plugin, and keep the first few tracebacks."""
        self.plugin_errors += number
        if len(self.tracebacks) < 5:
            self.tracebacks.append(traceback)

    def __str__(self) -> str:
        parts = [f"{name} {value}" for name, value in self.to_dict().items() if value and name != "frames"]
        return ", ".join([*(f"{number} {name} frames" for name, number in self.frames.items()), *parts]) or "nothing yet"


@dataclass(frozen=True, slots=True)
class Found:
    """One frame in the input.

    Attributes:
        frame: the name of its type.
        offset: of its first byte in everything fed so far (of its datagram's payload, joined, for datagram links).
        data: its bytes.
        at: arrival time in ns of the piece of input that completed it; None if the caller gave none.
        gap: bytes (other than fillers) skipped since the frame before it.
    """

    frame: str
    offset: int
    data: bytes
    at: int | None = None
    gap: int = 0


@dataclass(frozen=True, eq=False)
class Spans:
    """Frames of a piece of input as arrays, in stream order.

    Attributes:
        names: the types; `kinds` are indices into them.
        buffer: the bytes that the frames stand in, at `starts`, `sizes` long.
        offsets, gaps, at: as in `Found`; `at` is -1 where nobody knows it.
    """

    names: tuple[str, ...]
    buffer: NDArray[np.uint8]
    kinds: NDArray[np.intp]
    starts: NDArray[np.intp]
    sizes: NDArray[np.intp]
    offsets: NDArray[np.int64]
    gaps: NDArray[np.int64]
    at: NDArray[np.int64]

    def data(self, index: int) -> bytes:
        """The bytes of one frame."""
        return self.buffer[self.starts[index] : self.starts[index] + self.sizes[index]].tobytes()

    def found(self) -> list[Found]:
        """The frames one by one."""
        rows = zip(self.kinds.tolist(), self.offsets.tolist(), self.gaps.tolist(), self.at.tolist(), strict=True)
        return [
            Found(self.names[kind], offset, self.data(index), None if at < 0 else at, gap)
            for index, (kind, offset, gap, at) in enumerate(rows)
        ]


class Decoder:
    """Finds the frames of one sensor in what it is fed.

    Args:
        sensor: the sensor; only its incoming frames are looked for.
        stream: a byte stream, or datagrams one for each `feed`.
        interpreted: let construct judge every candidate.
    """

    def __init__(self, sensor: Sensor, *, stream: bool, interpreted: bool = False) -> None:
        incoming = {name: frame for name, frame in sensor.frames.items() if frame.direction == "in"}
        if not incoming:
            raise UsageError(f"{sensor.id} has no frames yet: configure it with its file first")
        self.sensor, self.stream, self.interpreted = sensor, stream, interpreted
        self.stats = Counters()
        self._codecs: dict[str, Codec] = {name: codec(frame, interpreted=interpreted) for name, frame in incoming.items()}
        self._framing = Framing(self._codecs)
        self._mode = Mode(after=_first_mode(sensor))
        self._pending, self._base, self._need = b"", 0, 0
        self._gap = 0
        self._fillers = np.array(sorted(set(sensor.fillers)), np.uint8)

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
        for start in range(0, len(view), PIECE):
            self._pending += view[start : start + PIECE]
            if len(self._pending) >= self._need:
                found.append(self._scan(at, final=False))
        self.stats.pending = len(self._pending)
        return found

    def rest(self) -> list[Spans]:
        """The same as `idle` and `finish`, as arrays."""
        found = [self._scan(None, final=True)] if self._pending else []
        self.stats.pending = len(self._pending)
        return found

    def datagrams(self, data: Sequence[Any] | NDArray[np.uint8], at: Sequence[int | None] | None = None) -> Spans:
        """Datagrams, each one frame, whole, or none; a list, or the rows of an array."""
        sizes = np.array([len(one) for one in data], np.intp)
        starts = np.cumsum(sizes) - sizes
        buffer = data.reshape(-1) if isinstance(data, np.ndarray) else np.frombuffer(b"".join(data), np.uint8)
        self.stats.bytes_in += len(buffer)
        if self._framing.named:
            kinds = np.array([self._judge(buffer[a : a + n]) for a, n in zip(starts.tolist(), sizes.tolist(), strict=True)], np.intp)
        else:
            kinds = self._judge_all(buffer, starts, sizes)
        lost = np.where(kinds < 0, sizes, 0)
        for index in np.flatnonzero(lost):
            lost[index] -= self._skip(buffer[starts[index] : starts[index] + sizes[index]])
        good = np.flatnonzero(kinds >= 0)
        before = np.concatenate([[-self._gap], np.cumsum(lost)[good]])
        self._gap = int(lost.sum() - before[-1])
        offsets, self._base = self._base + starts, self._base + len(buffer)
        times = np.full(len(data), -1, np.int64) if at is None else np.array([-1 if one is None else one for one in at], np.int64)
        spans = Spans(tuple(self._codecs), buffer, kinds[good], starts[good], sizes[good], offsets[good], np.diff(before), times[good])
        self._count(spans.kinds)
        return spans

    def _scan(self, at: int | None, *, final: bool) -> Spans:
        buffer = np.frombuffer(self._pending, np.uint8)
        piece = self._framing.scan(buffer, self._mode, base=self._base, final=final)
        gaps = self._gaps(buffer, piece)
        for name, number in piece.rejected.items():
            setattr(self.stats, name, getattr(self.stats, name) + number)
        self.stats.tracebacks += piece.errors[: 5 - len(self.stats.tracebacks)]
        times = np.full(len(gaps), -1 if at is None else at, np.int64)
        spans = Spans(
            tuple(self._codecs), buffer, piece.kinds, piece.offsets, piece.sizes, self._base + piece.offsets.astype(np.int64), gaps, times
        )
        self._count(piece.kinds)
        self._pending, self._base, self._need = self._pending[piece.end :], self._base + piece.end, piece.need
        return spans

    def _gaps(self, buffer: NDArray[np.uint8], piece: Piece) -> NDArray[np.int64]:
        """The bytes skipped before each frame, fillers left out; counts them."""
        ends = np.concatenate([[0], piece.offsets + piece.sizes])
        starts = np.concatenate([piece.offsets, [max(piece.end, int(ends[-1]))]])
        gaps = (starts - ends).astype(np.int64)
        for index in np.flatnonzero(gaps).tolist() if len(self._fillers) else ():
            gaps[index] -= self._skip(buffer[ends[index] : starts[index]])
        if not len(self._fillers):
            self.stats.bytes_skipped += int(gaps.sum())
        gaps[0] += self._gap
        self._gap = int(gaps[-1])
        return np.asarray(gaps[:-1])

    def _skip(self, skipped: NDArray[np.uint8]) -> int:
        """Count skipped bytes; the number of fillers among them."""
        fillers = int(np.isin(skipped, self._fillers).sum()) if len(self._fillers) else 0
        self.stats.bytes_skipped += len(skipped)
        self.stats.bytes_filler += fillers
        return fillers

    def _count(self, kinds: NDArray[np.intp]) -> None:
        for name, number in zip(self._codecs, np.bincount(kinds, minlength=len(self._codecs)).tolist(), strict=True):
            if number:
                self.stats.frames[name] = self.stats.frames.get(name, 0) + number

    def _judge_all(self, buffer: NDArray[np.uint8], starts: NDArray[np.intp], sizes: NDArray[np.intp]) -> NDArray[np.intp]:
        """The type of each datagram, -1 where it is none."""
        kinds = np.full(len(starts), -1, np.intp)
        for index, engine in enumerate(self._codecs.values()):
            left = np.flatnonzero((kinds < 0) & (sizes > 0))
            for spot, (mask, value) in engine.prefix.items():
                left = left[sizes[left] > spot]
                left = left[buffer[starts[left] + spot] & mask == value]
            survey = engine.survey(buffer, starts[left])
            kinds[left[(survey.status == VALID) & (survey.sizes == sizes[left])]] = index
        for index in np.flatnonzero(kinds < 0).tolist():
            kinds[index] = self._judge(buffer[starts[index] : starts[index] + sizes[index]])
        return kinds

    def _judge(self, buffer: NDArray[np.uint8]) -> int:
        """The type of one datagram, -1 where it is none; counts why."""
        rejected = 0
        for index, (name, engine) in enumerate(self._codecs.items()):
            if not self._framing.active(index, self._mode) or not _starts(buffer, engine):
                continue
            survey = engine.survey(buffer, np.zeros(1, np.intp))
            if survey.status[0] == VALID and survey.sizes[0] == len(buffer):
                self._mode.after = name if name in self._framing.named else self._mode.after
                return index
            rejected = max(rejected, int(survey.status[0]))
            self.stats.tracebacks += survey.errors[: 5 - len(self.stats.tracebacks)]
        counter = COUNTED.get(rejected, "bad_length")
        setattr(self.stats, counter, getattr(self.stats, counter) + 1)
        return -1


def _starts(buffer: NDArray[np.uint8], engine: Codec) -> bool:
    return all(spot < len(buffer) and buffer[spot] & mask == value for spot, (mask, value) in engine.prefix.items())


def _first_mode(sensor: Sensor) -> str | None:
    """`configure(answer=...)` starts as if the frame that the answer comes after had been seen."""
    answer = sensor.options.get("answer")
    return sensor.frames[answer].after if isinstance(answer, str) and answer in sensor.frames else None


def backend(name: str) -> str:
    """The back end that a name stands for.

    Raises:
        UsageError: for a name that is none.
    """
    if name not in BACKENDS:
        raise UsageError(f"backend is one of {', '.join(BACKENDS)}, not {name!r}")
    return name


def spans_of(decoder: Decoder, data: Any) -> list[Spans]:
    """Every frame of a whole input: bytes as a stream, an iterable or (n, size) array as datagrams."""
    if is_stream(data):
        return decoder.spans(data) + decoder.rest()
    everything = np.ascontiguousarray(data, np.uint8) if isinstance(data, np.ndarray) else list(data)
    return [decoder.datagrams(everything[start : start + TOGETHER]) for start in range(0, len(everything), TOGETHER)]


def packed(found: Sequence[Found]) -> Spans:
    """Frames given one by one as arrays."""
    names = tuple(dict.fromkeys(item.frame for item in found))
    sizes = np.array([len(item.data) for item in found], np.intp)
    columns = [np.array(column, np.int64) for column in zip(*((f.offset, f.gap, -1 if f.at is None else f.at) for f in found), strict=True)]
    offsets, gaps, at = columns or [np.empty(0, np.int64)] * 3
    kinds = np.array([names.index(item.frame) for item in found], np.intp)
    buffer = np.frombuffer(b"".join(item.data for item in found), np.uint8)
    return Spans(names, buffer, kinds, np.cumsum(sizes) - sizes, sizes, offsets, gaps, at)


def is_stream(data: Any) -> bool:
    """Whether an input is one run of bytes, not datagrams."""
    return isinstance(data, bytes | bytearray | memoryview)
