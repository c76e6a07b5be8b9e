"""The incremental decoder: bytes in, frames out, everything counted. No clock, port or thread in here.

A byte stream is cut into pieces that stay in the cache; what a piece leaves undecided is looked at again together
with the next. Datagram links frame by datagram. However the input is cut, the frames and counters are the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.codecs import VALID, Codec, codec
from lidarspec.errors import UsageError
from lidarspec.framing import COUNTED, Framing, Mode
from lidarspec.spec import Sensor

#: bytes of a stream looked at in one go.
PIECE = 1 << 16

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

    def feed(self, data: bytes | bytearray | memoryview | NDArray[np.uint8], at: int | None = None) -> list[Found]:
        """The frames that these bytes complete, in stream order. Raises on no bytes whatever.

        Args:
            data: the next bytes of the stream, or one datagram.
            at: their arrival time in ns, if known.
        """
        view = np.ascontiguousarray(data).data.cast("B") if isinstance(data, np.ndarray) else memoryview(data).cast("B")
        self.stats.bytes_in += len(view)
        if not self.stream:
            return self._datagram(view.tobytes(), at)
        found: list[Found] = []
        for start in range(0, len(view), PIECE):
            self._pending += view[start : start + PIECE]
            if len(self._pending) >= self._need:
                found += self._scan(at, final=False)
        self.stats.pending = len(self._pending)
        return found

    def idle(self) -> list[Found]:
        """The line fell silent: candidates that wait for bytes are given up, and their bytes looked at again."""
        found = self._scan(None, final=True) if self._pending else []
        self.stats.pending = len(self._pending)
        return found

    def finish(self) -> list[Found]:
        """The input ended; the same as `idle`."""
        return self.idle()

    def _scan(self, at: int | None, *, final: bool) -> list[Found]:
        buffer = np.frombuffer(self._pending, np.uint8)
        piece = self._framing.scan(buffer, self._mode, base=self._base, final=final)
        found, position = [], 0
        for kind, offset, size in zip(piece.kinds, piece.offsets, piece.sizes, strict=True):
            self._skip(buffer[position:offset])
            position = offset + size
            found.append(self._found(self._framing.names[kind], self._base + offset, self._pending[offset:position], at))
        self._skip(buffer[position : piece.end])
        for name, number in piece.rejected.items():
            setattr(self.stats, name, getattr(self.stats, name) + number)
        self.stats.tracebacks += piece.errors[: 5 - len(self.stats.tracebacks)]
        self._pending, self._base, self._need = self._pending[piece.end :], self._base + piece.end, piece.need
        return found

    def _found(self, name: str, offset: int, data: bytes, at: int | None) -> Found:
        self.stats.frames[name] = self.stats.frames.get(name, 0) + 1
        found = Found(name, offset, data, at, self._gap)
        self._gap = 0
        return found

    def _skip(self, skipped: NDArray[np.uint8]) -> None:
        if not len(skipped):
            return
        fillers = int(np.isin(skipped, self._fillers).sum()) if len(self._fillers) else 0
        self.stats.bytes_skipped += len(skipped)
        self.stats.bytes_filler += fillers
        self._gap += len(skipped) - fillers

    def _datagram(self, data: bytes, at: int | None) -> list[Found]:
        """A datagram is one frame, whole, or none."""
        offset, self._base = self._base, self._base + len(data)
        buffer, rejected = np.frombuffer(data, np.uint8), 0
        for index, (name, engine) in enumerate(self._codecs.items()):
            if not self._framing.active(index, self._mode) or not _starts(buffer, engine):
                continue
            survey = engine.survey(buffer, np.zeros(1, np.intp))
            if survey.status[0] == VALID and survey.sizes[0] == len(data):
                self._mode.after = name if name in self._framing.named else self._mode.after
                return [self._found(name, offset, data, at)]
            rejected = max(rejected, int(survey.status[0]))
            self.stats.tracebacks += survey.errors[: 5 - len(self.stats.tracebacks)]
        counter = COUNTED.get(rejected, "bad_length")
        setattr(self.stats, counter, getattr(self.stats, counter) + 1)
        self._skip(buffer)
        return []


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


def feed_all(decoder: Decoder, data: Any) -> list[Found]:
    """Every frame of a whole input: bytes as a stream, an iterable or (n, size) array as datagrams."""
    found: list[Found] = []
    chunks: Iterable[Any] | Sequence[Any] = [data] if isinstance(data, bytes | bytearray | memoryview) else data
    for chunk in chunks:
        found += decoder.feed(chunk)
    return found + decoder.finish()


def is_stream(data: Any) -> bool:
    """Whether an input is one run of bytes, not datagrams."""
    return isinstance(data, bytes | bytearray | memoryview)
