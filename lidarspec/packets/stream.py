"""From frames to packets: clocks unwrapped, their continuity judged, other frames kept as state.

A `PacketStream` remembers between batches what the next one needs: the last clock reading, the last
sequence number, the last frame of each other type, and whether bytes were skipped since the last
packet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError, UnknownFrame
from lidarspec.expressions.columns import Batch
from lidarspec.frames.arrays import alike, repeated, some
from lidarspec.frames.frame_table import Table
from lidarspec.frames.schema import Schema
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import Counters, Frames, Numbers
from lidarspec.packets.clock_order import ClockOrder
from lidarspec.packets.clocks import (
    ClockReference,
    Epoch,
    Unwrapper,
    clock_parts,
    clock_terms,
    clocked,
    held,
    paths,
)
from lidarspec.packets.continuity import Continuity
from lidarspec.packets.imu import ImuSamples, Waiting, joined
from lidarspec.packets.masked_sector import MaskedGaps
from lidarspec.packets.pace import Pace
from lidarspec.packets.packets import Index, Packets, StateOf, joined_tables
from lidarspec.spec.description import Spec
from lidarspec.spec.timing import Clock


class PacketStream:
    """The packets of one frame type out of a decoder's frames.

    Args:
        sensor, frame: whose, and of which type.
        stats: the decoder's counters; lost, duplicate and late packets are added to them.
        backend: what makes points of the packets, "auto", "numpy", "jit" or "construct".
        state: frames of other types, by name, that count as seen before the first packet.
        reference: tells the turn of the clock from the first packet on.
    """

    def __init__(
        self,
        sensor: Spec,
        frame: str,
        stats: Counters,
        *,
        backend: str = "auto",
        state: Mapping[str, bytes] | None = None,
        reference: ClockReference | None = None,
    ) -> None:
        if frame not in sensor.frames:
            raise UnknownFrame(frame, sensor.frames, place=sensor.id)
        self.sensor, self.frame, self.stats, self._backend = sensor, frame, stats, backend
        self._codec = self._codec_of(frame)
        self._others = [
            name for name, other in sensor.incoming.items() if not other.data and name != frame
        ]
        self._state: dict[str, bytes] = dict(state or {})
        data = sensor.frames[frame].data
        counted = (
            sensor.sequence is not None and data and _has(sensor, frame, sensor.sequence.field)
        )
        clock = _clock_of(sensor, frame, self._codec.schema)
        self._timer = (
            replace(sensor, clock=clock)
            if clock is not None and clock is not sensor.clock
            else sensor
        )
        timed = data and clock is not None
        self._clock = Unwrapper(clock.wraps_at) if clock else None
        self._turn = repeated(0, 0)  # what completes the times of the packets at hand
        self._epoch: Epoch | None = None
        if timed and clock is not None and clock.told is not None:
            self._epoch = Epoch(self._timer, clock, reference)
        in_parts = timed and clock_parts(sensor, self._codec.schema) is not None
        terms = (
            clock_terms(paths(sensor.clock), self._codec.schema, sensor.id)
            if sensor.clock and timed and not in_parts
            else []
        )
        grain = float(min((step for _, step, _, _ in terms), default=0))
        # a frame without the parts that have the clock says nothing of time, so that only a counter
        # tells what was lost beside it
        self._continuity = Continuity(
            sensor, stats, counted=counted, timed=timed and (counted or not in_parts), grain=grain
        )
        self._grain_ns = grain
        self._clock_order: ClockOrder | None = None
        if sensor.clock is not None and timed and not counted and not in_parts and sensor.datagrams:
            self._clock_order = ClockOrder(stats, Pace(sensor.clock, grain), MaskedGaps(sensor))
        self._skipped = 0  # bytes since the last packet
        self._time: int | None = None  # of the last packet with parts that have the clock
        self._tables: dict[str, tuple[bytes, Table]] = {}

    def add(self, found: Sequence[Frames], *, whole: bool = False) -> Packets:
        """The packets among these frames.

        Args:
            whole: the frames are a whole input: packets before the first frame of another type see
                that one as state.
        """
        parts = [_Part.of(frames, self.frame) for frames in found if len(frames)]
        table, skipped = (
            self._table(parts),
            _all_or_joined([self._bytes_skipped(part) for part in parts]),
        )
        state = self._states(parts, len(table), whole=whole)
        offset, host = _offsets(parts), _times([part.column(part.frames.at) for part in parts])
        index: Index = range(0)
        order: NDArray[np.int64] | None = None
        breaks, time = np.zeros(len(table), np.bool_) if alike(skipped) == 0 else skipped > 0, None
        if len(table):
            batch, otherwise = (
                Batch(table, breaks, state, self.sensor.state),
                (range(len(table)), breaks),
            )
            with np.errstate(all="ignore"):
                time = (
                    self._guarded("clock", self._times, None, batch, host, whole)
                    if self._clock is not None
                    else None
                )
                if self._clock_order is not None and time is not None:
                    index, order = self._guarded(
                        "clock", self._clock_order.push, (otherwise[0], None), batch, time
                    )
                else:
                    index, breaks = self._guarded(
                        "sequence", self._continuity.push, otherwise, batch, time, skipped
                    )
        time = host if time is None else self._complete(time)
        columns: dict[str, Any] = {
            "offset": offset,
            "time_ns": time,
            "host_ns": host,
            "index": index,
            "breaks": breaks,
        }
        if order is not None:
            columns |= {"order": order, "grain_ns": self._grain_ns}
        return Packets(
            self.sensor,
            self.frame,
            table,
            **columns,
            state=state,
            stats=self.stats,
            backend=self._backend,
        )

    def interrupt(self) -> None:
        """Input was lost here: there is a break before the next packet."""
        self._skipped = max(self._skipped, 1)
        self._continuity.forget()
        if self._clock_order is not None:
            self._clock_order.forget()

    def _guarded(
        self, what: str, function: Callable[..., Any], otherwise: Any, batch: Batch, *args: Any
    ) -> Any:
        try:
            return function(batch, *args)
        except Exception as error:
            self.stats.error(PluginError.of(error, what), len(batch))
            return otherwise

    def _times(self, batch: Batch, host: NDArray[np.int64], whole: bool) -> NDArray[np.int64]:
        assert self._clock is not None
        which, readings = clocked(self._timer, batch)
        if which is None:
            times = self._clock.push(readings, host)
            if self._epoch is not None:
                self._turn = self._epoch.push(batch, readings, times, host, whole=whole)
            return times
        times = self._clock.push(readings, host[which])
        before = host if self._time is None else repeated(self._time, len(host))
        self._time = int(times[-1]) if len(times) else self._time
        return held(which, times, before)

    def _complete(self, times: NDArray[np.int64]) -> NDArray[np.int64]:
        """Times with the turn of the clock that other frames have told, if they have."""
        if self._epoch is None or not len(times):
            return times
        if self._epoch.ns is None:
            self.stats.undated = (
                f"times count from where the sensor's clock began: no {self._epoch.frame} frame has"
                " told the date"
            )
            return times
        self.stats.undated = ""
        return times + self._turn

    def _bytes_skipped(self, part: _Part) -> NDArray[np.int64]:
        """The bytes in no frame before each of our frames, since ours before it, (n,)."""
        gaps, own = part.frames.gaps, part.own
        if alike(gaps) == 0 and not self._skipped:
            return repeated(0, part.number)
        if isinstance(own, slice) and part.number:
            skipped = gaps[own].copy()
            skipped[0] += self._skipped + int(gaps[: own.start].sum())
            self._skipped = int(gaps[own.stop :].sum())
            return skipped
        sums = self._skipped + np.cumsum(gaps)
        marks = sums[own]
        self._skipped = int(sums[-1]) - (int(marks[-1]) if part.number else 0)
        return np.diff(marks, prepend=0)

    def _table(self, parts: Sequence[_Part]) -> Table:
        tables = [
            self._codec.gather(part.frames if part.where is None else part.frames.only(part.own))
            for part in parts
            if part.number
        ]
        return joined_tables(tables) if tables else self._codec.table([])

    def _states(self, parts: Sequence[_Part], number: int, *, whole: bool) -> dict[str, StateOf]:
        """The frames of each other type, and which of them was the last before each packet."""
        if not self._state and all(part.where is None for part in parts):
            return dict.fromkeys(self._others, (None, repeated(-1, number)))
        seen = self._others_in(parts)
        return {
            name: self._state_of(name, seen.get(name, []), number=number, whole=whole)
            for name in self._others
        }

    def _others_in(
        self, parts: Sequence[_Part]
    ) -> dict[str, list[tuple[Frames, NDArray[np.intp]]]]:
        """The frames of other types, and how many of ours came before each, (k,)."""
        seen: dict[str, list[tuple[Frames, NDArray[np.intp]]]] = {}
        number = 0
        for part in parts:
            if part.where is not None:
                mask = np.ones(len(part.frames), np.bool_)
                mask[part.own] = False
                others = np.flatnonzero(mask)
                kinds, before = part.frames.kinds[others], number + others - np.arange(len(others))
                for kind in np.unique(kinds).tolist():
                    which, name = kinds == kind, part.frames.names[kind]
                    if name in self._others:
                        seen.setdefault(name, []).append(
                            (part.frames.only(others[which]), before[which])
                        )
            number += part.number
        return seen

    def _codec_of(self, name: str) -> Codec:
        return codec(self.sensor.frames[name], interpreted=self._backend == "construct")

    def _last(self, name: str) -> Table:
        """The last frame of another type, as a table."""
        data = self._state[name]
        known = self._tables.get(name)
        if known is None or known[0] is not data:
            known = self._tables[name] = (data, self._codec_of(name).table([data]))
        return known[1]

    def _state_of(
        self,
        name: str,
        seen: Sequence[tuple[Frames, NDArray[np.intp]]],
        *,
        number: int,
        whole: bool,
    ) -> StateOf:
        if not seen:
            return (
                (self._last(name), repeated(0, number))
                if name in self._state
                else (None, repeated(-1, number))
            )
        tables: list[Table] = [self._codec_of(name).gather(frames) for frames, _ in seen]
        before = np.concatenate([places for _, places in seen])
        if name in self._state:
            tables, before = [self._last(name), *tables], np.concatenate(([0], before))
        elif whole:
            before[0] = 0
        last = seen[-1][0]
        self._state[name] = last.data(len(last) - 1)
        which = np.repeat(np.arange(-1, len(before)), np.diff(before, prepend=0, append=number))
        return joined_tables(tables), which


class ImuStream:
    """What a sensor's IMU felt, out of a decoder's frames: of every type that has it.

    Args:
        stats, backend, state: as of `PacketStream`.

    Attributes:
        waiting: for samples until the scan that they belong to ends; None where there is no IMU, or
            not by the clock of the points.
    """

    def __init__(
        self,
        sensor: Spec,
        stats: Counters,
        *,
        backend: str = "auto",
        state: Mapping[str, bytes] | None = None,
    ) -> None:
        self._names = [name for name in sensor.imu_frames if not sensor.frames[name].data]
        self._made, self._new = (
            dict[str, PacketStream](),
            partial(PacketStream, sensor, stats=stats, backend=backend, state=state),
        )
        kinds = {
            _clock_of(sensor, name, codec(sensor.frames[name]).schema) is None
            for name in (*self._names, *sensor.data_frames)
        }
        self.waiting = Waiting() if sensor.imu_frames and len(kinds) == 1 else None

    def add(
        self, found: Sequence[Frames], data: Packets | None, *, whole: bool = False
    ) -> ImuSamples:
        """The samples among these frames; those that wait have them too. A failing plugin is
        counted.

        Args:
            data: the packets of the data among them.
            whole: the frames are a whole input.
        """
        own = [data] if data is not None and data.sensor.frames[data.frame].imu is not None else []
        parts = list[ImuSamples]()
        names = [
            name
            for name in self._names
            if not whole or any(_Part.of(frames, name).number for frames in found)
        ]
        for packets in (*own, *(self._stream(name).add(found, whole=whole) for name in names)):
            try:
                parts += [packets.imu()] if len(packets) else []
            except SpecError as error:
                packets.stats.error(PluginError.of(error, f"imu of {packets.frame}"), len(packets))
        samples = joined(parts)
        if self.waiting is not None:
            self.waiting.add(samples)
        return samples

    def interrupt(self) -> None:
        """Input was lost here."""
        for name in self._names:
            self._stream(name).interrupt()

    def _stream(self, name: str) -> PacketStream:
        """The packets of one type, from when there are some on."""
        if name not in self._made:
            self._made[name] = self._new(name)
        return self._made[name]


@dataclass(frozen=True, eq=False)
class _Part:
    """Our frames in a piece of input: indices, or None where all are ours."""

    frames: Frames
    where: NDArray[np.intp] | None
    number: int

    @classmethod
    def of(cls, frames: Frames, name: str) -> _Part:
        """The frames of one type in a piece."""
        own, kind = frames.names.index(name) if name in frames.names else -1, alike(frames.kinds)
        mine = None if kind is not None and kind == own else frames.kinds == own
        if mine is None or mine.all():
            return cls(frames, None, len(frames))
        where = np.flatnonzero(mine)
        return cls(frames, where, len(where))

    @cached_property
    def own(self) -> NDArray[np.intp] | slice:
        """Which frames are ours, as a slice where they follow one another."""
        where = self.where
        if where is None or not len(where):
            return slice(0, self.number)
        first, last = where.item(0), where.item(-1)
        return slice(first, last + 1) if last - first == len(where) - 1 else where

    def column(self, array: NDArray[np.int64]) -> NDArray[np.int64]:
        """What an array of the piece, (n,), holds for our frames."""
        return array if self.where is None else some(array, self.own)


def data_frame(sensor: Spec, found: Sequence[Frames]) -> str | None:
    """The data frame type that an input is read by where none is asked for: the configured one, or
    the first that arrived.

    Returns:
        None where the sensor has several, none is configured, and none has arrived yet.
    """
    names = sensor.data_frames
    if len(names) < 2 or sensor.options.get("answer") in names:
        return sensor.data_frame
    for frames in found:
        kinds = [kind for kind, name in enumerate(frames.names) if name in names]
        own = frames.kinds[np.isin(frames.kinds, kinds)]
        if len(own):
            return frames.names[own.item(0)]
    return None


def _clock_of(sensor: Spec, frame: str, schema: Schema) -> Clock | None:
    """The clock that is read in frames of a type: the sensor's in data, and where an IMU's frames
    have it; else their own, if any.
    """
    declared, shared = sensor.frames[frame], sensor.clock
    if declared.clock is not None or shared is None:
        return declared.clock
    if declared.data:
        return shared if all(_has(sensor, frame, path) for path in paths(shared)) else None
    known = declared.imu is not None and paths(shared)
    return shared if known and all(path in schema.fields for path in known) else None


def _has(sensor: Spec, frame: str, path: str) -> bool:
    """Whether packets of this type are to have a field, such as the counter: not, if only other
    data frames have it.
    """
    schemas = {name: codec(sensor.frames[name]).schema for name in sensor.data_frames}
    having = [
        name
        for name, schema in schemas.items()
        if path in schema.fields or schema.within(path) is not None
    ]
    return frame in having or not having


def _offsets(parts: Sequence[_Part]) -> Numbers:
    """Where our frames begin in the input; as a range, where all have one size and follow one
    another.
    """
    runs = [part.frames.places for part in parts if part.where is None]
    ranges = [places for places in runs if isinstance(places, range)]
    follow = all(
        before.stop == after.start and before.step == after.step
        for before, after in pairwise(ranges)
    )
    if ranges and len(ranges) == len(parts) and follow:
        return range(ranges[0].start, ranges[-1].stop, ranges[0].step)
    return _joined([part.column(part.frames.offsets) for part in parts], np.int64)


def _times(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Arrival times, 0 where nobody knows them."""
    found = _all_or_joined(parts)
    only = alike(found)
    if only is not None:
        return repeated(max(only, 0), len(found))
    return np.maximum(found, 0) if len(found) and int(found.min()) < 0 else found


def _all_or_joined(parts: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    """Arrays joined; `repeated`, where all are of one value."""
    known = {alike(part) for part in parts if len(part)}
    if len(known) == 1 and (only := known.pop()) is not None:
        return repeated(only, sum(map(len, parts)))
    return _joined(parts, np.int64)


def _joined(parts: Sequence[NDArray[Any]], dtype: Any) -> NDArray[Any]:
    if len(parts) == 1:
        return parts[0]
    return np.concatenate(parts) if parts else np.empty(0, dtype)
