"""From frames to packets: clocks unwrapped, sequences checked, other frames kept as state.

A `PacketStream` remembers between batches what the next one needs: the last clock reading, the last sequence number,
the last frame of each other type, and whether bytes were skipped since the last packet.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.codecs import Codec, codec
from lidarspec.columns import Batch, Fields
from lidarspec.decoder import Counters, Found
from lidarspec.errors import SpecError, UnknownFrame
from lidarspec.packets import Packets, StateOf
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
        state: frames of other types that count as seen before the first packet.
    """

    def __init__(self, sensor: Sensor, frame: str, stats: Counters, *, interpreted: bool = False, state: Sequence[Found] = ()) -> None:
        if frame not in sensor.frames:
            raise UnknownFrame(frame, sensor.frames, place=sensor.id)
        self.sensor, self.frame, self.stats, self._interpreted = sensor, frame, stats, interpreted
        self._codec: Codec = codec(sensor.frames[frame], interpreted=interpreted)
        self._others = [name for name, other in sensor.frames.items() if other.direction == "in" and not other.data and name != frame]
        self._state: dict[str, bytes] = {found.frame: found.data for found in state}
        data = sensor.frames[frame].data
        self._sequence = SequenceTracker(sensor.sequence, stats) if sensor.sequence and data and _counted(sensor, frame) else None
        self._clock = Unwrapper(sensor.clock.wraps_at) if sensor.clock and data else None
        self._gap, self._number = False, 0

    def add(self, found: Sequence[Found], *, whole: bool = False) -> Packets:
        """The packets among these frames.

        Args:
            whole: the frames are a whole input: packets before the first frame of another type see that one as state.
        """
        mine, breaks, seen = self._sorted(found)
        table = self._codec.table(item.data for item in mine)
        state = {name: self._state_of(name, seen[name], whole=whole) for name in self._others}
        gaps = np.array(breaks, np.bool_)
        batch = Batch(table, gaps, state, self.sensor.state)
        index = np.arange(self._number, self._number + len(mine), dtype=np.int64)
        self._number += len(mine)
        if self._sequence is not None:
            index, jumps = self._guarded(lambda: self._sequence.push(batch), (index, gaps))  # type: ignore[union-attr]
            gaps = gaps | jumps
        host = np.array([item.at or 0 for item in mine], np.int64)
        time = host
        if self._clock is not None and len(mine):
            time = self._guarded(lambda: self._clock.push(clock_ns(self.sensor, batch), host), host)  # type: ignore[union-attr]
        offset = np.array([item.offset for item in mine], np.int64)
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

    def _sorted(self, found: Sequence[Found]) -> tuple[list[Found], list[bool], dict[str, tuple[list[bytes], list[int]]]]:
        """Our frames, whether something was lost before each, and the other frames with how many came before each."""
        mine: list[Found] = []
        breaks: list[bool] = []
        seen: dict[str, tuple[list[bytes], list[int]]] = {name: ([], []) for name in self._others}
        for item in found:
            self._gap = self._gap or item.gap > 0
            if item.frame == self.frame:
                mine.append(item)
                breaks.append(self._gap)
                self._gap = False
            elif item.frame in seen:
                seen[item.frame][0].append(item.data)
                seen[item.frame][1].append(len(mine))
        return mine, breaks, {name: (*value, len(mine)) for name, value in seen.items()}  # type: ignore[misc]

    def _state_of(self, name: str, seen: Any, *, whole: bool) -> StateOf:
        frames, before, number = seen
        before = list(before)
        if name in self._state:
            frames, before = [self._state[name], *frames], [0, *before]
        elif whole and before:
            before[0] = 0
        which = np.searchsorted(np.array(before, np.intp), np.arange(number), side="right").astype(np.intp) - 1
        if not frames:
            return None, which
        self._state[name] = frames[-1]
        table: Table = codec(self.sensor.frames[name], interpreted=self._interpreted).table(frames)
        return table, which


def data_frame(sensor: Sensor, found: Sequence[Found]) -> str | None:
    """The data frame type that an input is read by where none is asked for: the configured one, or the first that arrived.

    Returns:
        None where the sensor has several, none is configured, and none has arrived yet.
    """
    names = [name for name, frame in sensor.frames.items() if frame.data]
    if len(names) < 2 or sensor.options.get("answer") in names:
        return sensor.data_frame
    return next((item.frame for item in found if item.frame in names), None)


def _counted(sensor: Sensor, frame: str) -> bool:
    """Whether packets of this type are counted: not, if only other data frames have the counter."""
    assert sensor.sequence is not None
    having = [name for name, other in sensor.frames.items() if other.data and sensor.sequence.field in codec(other).schema.fields]
    return frame in having or not having


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
            passed = np.where(host > 0, np.diff(host, prepend=at), 0)
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
    return np.clip(raw, max(edges.min, -furthest), min(edges.max, furthest)).astype(np.int64)


def _nanoseconds(seconds: Any, number: int) -> Times:
    flat = np.broadcast_to(np.asarray(seconds, np.float64).reshape(-1), (number,)) if np.size(seconds) in (1, number) else None
    if flat is None:
        raise SpecError("a clock gives one time for each packet")
    return np.rint(np.clip(np.nan_to_num(flat), -9e9, 9e9) * 1e9).astype(np.int64)
