"""From frames to packets: clocks unwrapped, sequences checked, other frames kept as state.

A `PacketStream` remembers between batches what the next one needs: the last clock reading, the last sequence number,
the last frame of each other type, and whether bytes were skipped since the last packet.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.access import Fields
from lidarspec.codecs import Codec, codec
from lidarspec.columns import Batch
from lidarspec.decoder import Counters, Spans
from lidarspec.errors import SpecError, UnknownFrame
from lidarspec.packets import Packets, StateOf, joined_tables
from lidarspec.sequences import SequenceTracker
from lidarspec.spec import Sensor
from lidarspec.tables import Table
from lidarspec.units import exact, factor

Times = NDArray[np.int64]

#: no clock reads more nanoseconds than this (285 years): damaged readings must not overflow.
_FURTHEST = 9 * 10**18


class PacketStream:
    """The packets of one frame type out of a decoder's frames.

    Args:
        sensor, frame: whose, and of which type.
        stats: the decoder's counters; lost, duplicate and late packets are added to them.
        interpreted: parse with construct.
        state: frames of other types, by name, that count as seen before the first packet.
    """

    def __init__(
        self, sensor: Sensor, frame: str, stats: Counters, *, interpreted: bool = False, state: Mapping[str, bytes] | None = None
    ) -> None:
        if frame not in sensor.frames:
            raise UnknownFrame(frame, sensor.frames, place=sensor.id)
        self.sensor, self.frame, self.stats, self._interpreted = sensor, frame, stats, interpreted
        self._codec: Codec = codec(sensor.frames[frame], interpreted=interpreted)
        self._others = [name for name, other in sensor.frames.items() if other.direction == "in" and not other.data and name != frame]
        self._state: dict[str, bytes] = dict(state or {})
        data = sensor.frames[frame].data
        self._sequence = SequenceTracker(sensor.sequence, stats) if sensor.sequence and data and _counted(sensor, frame) else None
        self._clock = Unwrapper(sensor.clock.wraps_at) if sensor.clock and data else None
        self._gap, self._number = False, 0

    def add(self, found: Sequence[Spans], *, whole: bool = False) -> Packets:
        """The packets among these frames.

        Args:
            whole: the frames are a whole input: packets before the first frame of another type see that one as state.
        """
        parts = [self._part(spans, _mine(spans, self.frame)) for spans in found]
        table = self._table(found, [where for where, _ in parts])
        gaps = np.concatenate([breaks for _, breaks in parts]) if parts else np.empty(0, np.bool_)
        seen = self._others_in(found, [where for where, _ in parts])
        state = {name: self._state_of(name, *seen[name], number=len(table), whole=whole) for name in self._others}
        batch = Batch(table, gaps, state, self.sensor.state)
        index = np.arange(self._number, self._number + len(table), dtype=np.int64)
        self._number += len(table)
        if self._sequence is not None and len(table):
            index, jumps = self._guarded(lambda: self._sequence.push(batch), (index, gaps))  # type: ignore[union-attr]
            gaps = gaps | jumps
        offset, at = (
            _column([getattr(spans, name)[where] for spans, (where, _) in zip(found, parts, strict=True)]) for name in ("offsets", "at")
        )
        host = np.maximum(at, 0)
        time = host
        if self._clock is not None and len(table):
            time = self._guarded(lambda: self._clock.push(clock_ns(self.sensor, batch), host), host)  # type: ignore[union-attr]
        return Packets(
            self.sensor,
            self.frame,
            table,
            offset=offset,
            time_ns=time,
            host_ns=host,
            index=index,
            breaks=gaps,
            state=state,
            stats=self.stats,
        )

    def _guarded(self, function: Callable[[], Any], otherwise: Any) -> Any:
        try:
            with np.errstate(all="ignore"):
                return function()
        except Exception:
            self.stats.error(traceback.format_exc())
            return otherwise

    def _part(self, spans: Spans, where: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Our frames in a piece, and whether something was lost before each, since ours before it."""
        losses = np.cumsum(spans.gaps > 0)
        marks = np.concatenate([[0], losses[where]])
        breaks = np.diff(marks) > 0
        if len(where):
            breaks[0] |= self._gap
        left = bool(len(losses)) and bool(losses[-1] > marks[-1])
        self._gap = left or (self._gap and not len(where))
        return where, breaks

    def _table(self, found: Sequence[Spans], where: Sequence[NDArray[np.intp]]) -> Table:
        tables = [
            self._codec.gather(spans.buffer, spans.starts[mine], spans.sizes[mine])
            for spans, mine in zip(found, where, strict=True)
            if len(mine)
        ]
        return joined_tables(tables) if tables else self._codec.table([])

    def _others_in(self, found: Sequence[Spans], where: Sequence[NDArray[np.intp]]) -> dict[str, tuple[list[bytes], list[int]]]:
        """The frames of other types, and how many of ours came before each."""
        seen: dict[str, tuple[list[bytes], list[int]]] = {name: ([], []) for name in self._others}
        number = 0
        for spans, mine in zip(found, where, strict=True):
            if len(mine) < len(spans.kinds):
                for index in np.setdiff1d(np.arange(len(spans.kinds)), mine).tolist():
                    name = spans.names[spans.kinds[index]]
                    if name in seen:
                        seen[name][0].append(spans.data(index))
                        seen[name][1].append(number + int(np.searchsorted(mine, index)))
            number += len(mine)
        return seen

    def _state_of(self, name: str, frames: list[bytes], before: list[int], *, number: int, whole: bool) -> StateOf:
        if name in self._state:
            frames, before = [self._state[name], *frames], [0, *before]
        elif whole and before:
            before = [0, *before[1:]]
        which = np.searchsorted(np.array(before, np.intp), np.arange(number), side="right").astype(np.intp) - 1
        if not frames:
            return None, which
        self._state[name] = frames[-1]
        table: Table = codec(self.sensor.frames[name], interpreted=self._interpreted).table(frames)
        return table, which


def data_frame(sensor: Sensor, found: Sequence[Spans]) -> str | None:
    """The data frame type that an input is read by where none is asked for: the configured one, or the first that arrived.

    Returns:
        None where the sensor has several, none is configured, and none has arrived yet.
    """
    names = [name for name, frame in sensor.frames.items() if frame.data]
    if len(names) < 2 or sensor.options.get("answer") in names:
        return sensor.data_frame
    arrived = ((spans.names, spans.kinds[np.isin(spans.kinds, _kinds(spans, names))]) for spans in found)
    return next((known[kinds[0]] for known, kinds in arrived if len(kinds)), None)


def _counted(sensor: Sensor, frame: str) -> bool:
    """Whether packets of this type are counted: not, if only other data frames have the counter."""
    assert sensor.sequence is not None
    having = [name for name, other in sensor.frames.items() if other.data and sensor.sequence.field in codec(other).schema.fields]
    return frame in having or not having


def _kinds(spans: Spans, names: Sequence[str]) -> list[int]:
    return [index for index, name in enumerate(spans.names) if name in names]


def _mine(spans: Spans, frame: str) -> NDArray[np.intp]:
    return np.flatnonzero(np.isin(spans.kinds, _kinds(spans, [frame])))


def _column(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.concatenate(parts) if parts else np.empty(0, np.int64)


class Unwrapper:
    """A clock that starts again at `wraps_at` seconds, made to run on; exact over any number of wraps.

    The shorter way round decides between forward and backward, so late packets go back in time. Where the host's
    times say that more than most of a turn has passed, they decide how many turns it was.
    """

    def __init__(self, wraps_at: float | None) -> None:
        self._turn = int(exact(wraps_at) * 10**9) if wraps_at else 0
        self._last: tuple[int, int, int] | None = None

    def push(self, ns: Times, host: Times) -> Times:
        """The readings of the next packets, (n,), as times that run on from those before."""
        if not self._turn or not len(ns):
            return ns
        raw, time, at = self._last or (int(ns[0]), int(ns[0]), int(host[0]))
        half = self._turn // 2
        steps = (np.diff(ns, prepend=raw) + half) % self._turn - half
        if self._turn >= 10**9:
            before = np.concatenate([[at], host[:-1]])
            passed = np.where((host > 0) & (before > 0), host - before, 0)
            turns = np.where(passed > self._turn * 3 // 4, (passed - steps + half) // self._turn, 0)
            steps += turns * self._turn
        times = time + np.cumsum(steps)
        self._last = (int(ns[-1]), int(times[-1]), int(host[-1]))
        return times


def clock_ns(sensor: Sensor, batch: Batch) -> Times:
    """The sensor's own clock in each packet, (n,) int64 nanoseconds, as it stands on the wire."""
    assert sensor.clock is not None
    source = sensor.clock.source
    if callable(source):
        terms = source(Fields(batch))
        columns = terms if isinstance(terms, tuple | list) else (terms,)
        return sum((_nanoseconds(np.asarray(column), len(batch)) for column in columns), np.zeros(len(batch), np.int64))
    total = np.zeros(len(batch), np.int64)
    paths = (source,) if isinstance(source, str) else source
    for path in paths:
        info = batch.table.schema.fields.get(path)
        per_unit = factor(info.unit, "s") if info else None
        if info is None or per_unit is None or info.axes:
            raise SpecError("a clock is a field of the header with a unit of time", path=path, sensor=sensor.id)
        raw = batch.table.raw(path)
        step, zero = exact(info.scale) * per_unit * 10**9, exact(info.offset) * per_unit * 10**9
        if raw.dtype.kind in "ui" and step.denominator == 1 and zero.denominator == 1 and step < 2**62:
            total += _within(raw, _FURTHEST // len(paths) // max(int(step), 1)) * int(step) + int(zero)
        else:
            total += _nanoseconds(raw.astype(np.float64) * float(step / 10**9) + float(zero / 10**9), len(batch))
    return total


def _within(raw: NDArray[Any], furthest: int) -> Times:
    edges = np.iinfo(raw.dtype)
    return np.asarray(np.clip(raw, max(edges.min, -furthest), min(edges.max, furthest)), np.int64)


def _nanoseconds(seconds: Any, number: int) -> Times:
    flat = np.broadcast_to(np.asarray(seconds, np.float64).reshape(-1), (number,)) if np.size(seconds) in (1, number) else None
    if flat is None:
        raise SpecError("a clock gives one time for each packet")
    return np.rint(np.clip(np.nan_to_num(flat), -9e9, 9e9) * 1e9).astype(np.int64)
