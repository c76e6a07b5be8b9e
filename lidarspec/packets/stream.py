"""From frames to packets: times, losses and order, and the other frames that packets depend on.

A `PacketStream` remembers between batches what the next one needs: the last clock reading, the
newest packet, the last frame of each other type, and whether bytes were skipped since the last
packet. Losses are judged by the counter of the packets (`counter_order`), for datagrams without one
by their clock (`clock_order`), else by arrival (`arrival_order`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.expressions.columns import Batch
from lidarspec.frames.arrays import broadcast_value, repeat
from lidarspec.frames.frame_table import Table
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import Counters, Frames, Numbers, array_of
from lidarspec.packets.arrival_order import ArrivalOrder
from lidarspec.packets.clock_order import ClockOrder
from lidarspec.packets.clocks import (
    ClockEpoch,
    ClockReference,
    Unwrapper,
    hold_values,
    read_clock,
)
from lidarspec.packets.counter_order import CounterOrder
from lidarspec.packets.imu import ImuSamples, WaitingSamples, join_samples
from lidarspec.packets.masked_sector import MaskedGaps
from lidarspec.packets.packet_type import find_clock, packet_type
from lidarspec.packets.packets import Index, Packets, StateOf, joined_tables
from lidarspec.spec.sensor import SensorDescription

Integers = NDArray[np.int64]
#: frames of another type, and the number of packets before each, (k,).
Earlier = tuple[Frames, NDArray[np.intp]]


class PacketStream:
    """Makes packets of one type from the frames that a decoder finds.

    Args:
        sensor: that sends them.
        frame: their type.
        stats: the decoder's counters; lost, duplicate and late packets are added to them.
        backend: what makes points of the packets, "auto", "numpy" or "jit".
        state: frames of other types, by name, that count as seen before the first packet.
        reference: tells the turn of the clock from the first packet on.

    Raises:
        UnknownFrame: if the sensor has no such type.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        frame: str,
        stats: Counters,
        *,
        backend: str = "auto",
        state: Mapping[str, bytes] | None = None,
        reference: ClockReference | None = None,
    ) -> None:
        self._type = packet_type(sensor, frame)
        self.stats = stats
        self._backend = backend
        self._last_frames: dict[str, Table] = {}  # of other types: the last one, by its name
        for name in self._type.others:
            if state and name in state:
                self._last_frames[name] = codec(sensor.frames[name]).table([state[name]])
        self._skipped = 0  # bytes since the last packet

        clock = self._type.clock
        self._clock = Unwrapper(clock.wraps_at) if clock else None
        self._time: int | None = None  # of the last packet with parts that have the clock
        self._turn = repeat(0, 0)  # completes the times of the packets at hand
        self._epoch: ClockEpoch | None = None
        if clock is not None and clock.reference is not None and sensor.frames[frame].data:
            self._epoch = ClockEpoch(self._type.timed_sensor, clock, reference)

        self._counter_order: CounterOrder | None = None
        self._clock_order: ClockOrder | None = None
        loss_clock = self._type.loss_clock
        if self._type.is_counted:
            self._counter_order = CounterOrder(sensor, stats, self._type.counter_clock)
        elif loss_clock is not None and self._type.is_ordered_by_clock:
            self._clock_order = ClockOrder(stats, loss_clock, MaskedGaps(sensor))
        self._arrival_order = ArrivalOrder(stats, loss_clock, self._type.loss_clock_step_ns)

    def add(self, batches: Sequence[Frames], *, whole: bool = False) -> Packets:
        """Return the packets among some frames.

        Args:
            whole: the frames are a whole input: packets before the first frame of another type see
                that one as state.
        """
        parts = [OwnFrames.of(frames, self._type.frame) for frames in batches if len(frames)]
        columns = _join([self._read(part) for part in parts])
        if columns is None:
            columns = self._no_columns()
        table = columns.table
        state: dict[str, StateOf] = {}
        if self._type.others:
            state = self._states(parts, len(table), whole=whole)
        host = _host_times(columns.at)
        breaks = np.zeros(len(table), np.bool_)
        if broadcast_value(columns.skipped) != 0:
            breaks = columns.skipped > 0
        time = None
        index: Index = range(0)
        order: Integers | None = None
        if len(table):
            batch = Batch(table, breaks, state, self._type.sensor.state)
            with np.errstate(all="ignore"):
                if self._clock is not None:
                    time = self._call_plugin("clock", self._times, None, batch, host, whole)
                index, breaks, order = self._judge(batch, time, columns.skipped)
        return Packets(
            self._type.sensor,
            self._type.frame,
            table,
            offset=columns.offset,
            time_ns=host if time is None else self._complete(time),
            host_ns=host,
            index=index,
            breaks=breaks,
            order=order,
            state=state,
            stats=self.stats,
            backend=self._backend,
        )

    def interrupt(self) -> None:
        """Mark a break before the next packet: input was lost here."""
        self._skipped = max(self._skipped, 1)
        for judge in (self._counter_order, self._clock_order, self._arrival_order):
            if judge is not None:
                judge.forget()

    def _judge(
        self, batch: Batch, time: Integers | None, skipped: Integers
    ) -> tuple[Index, NDArray[np.bool_], Integers | None]:
        """Return the index of packets, the breaks before them, and their order.

        The order is None if the clock does not show it.
        """
        unjudged = (range(len(batch)), batch.breaks)
        if self._clock_order is not None and time is not None:
            push = self._clock_order.push
            index, order = self._call_plugin("clock", push, (unjudged[0], None), batch, time)
            return index, batch.breaks, order
        if self._counter_order is not None:
            push_counted = self._counter_order.push
            index, breaks = self._call_plugin("sequence", push_counted, unjudged, batch, time)
        else:
            push_arrived = self._arrival_order.push
            index, breaks = self._call_plugin("clock", push_arrived, unjudged, batch, time, skipped)
        return index, breaks, None

    def _call_plugin(
        self, place: str, function: Callable[..., Any], otherwise: Any, batch: Batch, *args: Any
    ) -> Any:
        """Return the result of a function that calls a plugin; count its errors."""
        try:
            return function(batch, *args)
        except Exception as error:
            self.stats.error(PluginError.of(error, place), len(batch))
            return otherwise

    def _times(self, batch: Batch, host: Integers, whole: bool) -> Integers:
        """Return the times of packets by their clock, (n,) ns."""
        assert self._clock is not None
        which, readings = read_clock(self._type.timed_sensor, batch)
        if which is None:
            times = self._clock.push(readings, host)
            if self._epoch is not None:
                self._turn = self._epoch.push(batch, readings, times, host, whole=whole)
            return times
        times = self._clock.push(readings, host[which])
        if self._time is None:
            before = host
        else:
            before = repeat(self._time, len(host))
        if len(times):
            self._time = times.item(-1)
        return hold_values(which, times, before)

    def _complete(self, times: Integers) -> Integers:
        """Return times with the turn of the clock that other frames have told, if they have."""
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

    def _bytes_skipped(self, part: OwnFrames) -> Integers:
        """Return the bytes in no frame between each of our frames and the one before, (n,)."""
        gaps = part.piece.gaps
        rows = part.rows
        number = len(part.frames)
        if broadcast_value(gaps) == 0 and not self._skipped:
            return repeat(0, number)
        if isinstance(rows, slice) and number:
            skipped = gaps[rows].copy()
            skipped[0] += self._skipped + int(gaps[: rows.start].sum())
            self._skipped = int(gaps[rows.stop :].sum())
            return skipped
        sums = self._skipped + np.cumsum(gaps)
        own_sums = sums[rows]
        self._skipped = int(sums[-1])
        if number:
            self._skipped -= int(own_sums[-1])
        return np.diff(own_sums, prepend=0)

    def _read(self, part: OwnFrames) -> _Columns:
        """Return what a piece of input says of its packets."""
        frames = part.frames
        skipped = self._bytes_skipped(part)
        return _Columns(self._type.codec.gather(frames), frames.places, frames.at, skipped)

    def _no_columns(self) -> _Columns:
        """Return what an input without packets says of them."""
        nothing = repeat(0, 0)
        return _Columns(self._type.codec.table([]), range(0), nothing, nothing)

    def _states(
        self, parts: Sequence[OwnFrames], number: int, *, whole: bool
    ) -> dict[str, StateOf]:
        """Return the frames of each other type, and which was the last before each packet."""
        earlier = self._others_in(parts)
        return {
            name: self._state_of(name, earlier.get(name, []), number=number, whole=whole)
            for name in self._type.others
        }

    def _others_in(self, parts: Sequence[OwnFrames]) -> dict[str, list[Earlier]]:
        """Return the frames of other types, by name."""
        earlier: dict[str, list[Earlier]] = {}
        number = 0
        for part in parts:
            if part.has_others:
                mask = np.ones(len(part.piece), np.bool_)
                mask[part.rows] = False
                others = np.flatnonzero(mask)
                kinds = part.piece.kinds[others]
                before = number + others - np.arange(len(others))
                for kind in np.unique(kinds).tolist():
                    name = part.piece.names[kind]
                    if name in self._type.others:
                        which = kinds == kind
                        frames = part.piece.select(others[which])
                        earlier.setdefault(name, []).append((frames, before[which]))
            number += len(part.frames)
        return earlier

    def _state_of(
        self, name: str, earlier: Sequence[Earlier], *, number: int, whole: bool
    ) -> StateOf:
        """Return the frames of another type, and which of them was the last before each packet."""
        last_frame = self._last_frames.get(name)
        if not earlier:
            return last_frame, repeat(-1 if last_frame is None else 0, number)
        engine = codec(self._type.sensor.frames[name])
        tables: list[Table] = [engine.gather(frames) for frames, _ in earlier]
        before = np.concatenate([places for _, places in earlier])
        if last_frame is not None:
            tables = [last_frame, *tables]
            before = np.concatenate(([0], before))
        elif whole:
            before[0] = 0
        newest, _ = earlier[-1]
        self._last_frames[name] = engine.table([newest.data(len(newest) - 1)])
        which = np.repeat(np.arange(-1, len(before)), np.diff(before, prepend=0, append=number))
        return joined_tables(tables), which


class ImuStream:
    """Makes IMU samples from the frames that a decoder finds, of every type that has them.

    Args:
        sensor: that sends them.
        stats, backend, state: as of `PacketStream`.

    Attributes:
        waiting: for samples until the scan that they belong to ends; None if there is no IMU, or
            not by the clock of the points.
    """

    def __init__(
        self,
        sensor: SensorDescription,
        stats: Counters,
        *,
        backend: str = "auto",
        state: Mapping[str, bytes] | None = None,
    ) -> None:
        self._names = [name for name in sensor.imu_frames if not sensor.frames[name].data]
        self._streams = dict[str, PacketStream]()
        self._make_stream = partial(PacketStream, sensor, stats=stats, backend=backend, state=state)
        names = (*self._names, *sensor.data_frames)
        has_clock = {find_clock(sensor, name) is not None for name in names}
        self.waiting = WaitingSamples() if sensor.imu_frames and len(has_clock) == 1 else None

    def add(
        self, found: Sequence[Frames], data: Packets | None, *, whole: bool = False
    ) -> ImuSamples:
        """Return the samples among some frames, and add them to those that wait.

        Errors of a plugin are counted.

        Args:
            data: the packets of the data among them.
            whole: the frames are a whole input.
        """
        batches = list[Packets]()
        if data is not None and data.sensor.frames[data.frame].imu is not None:
            batches.append(data)
        for name in self._names:
            if not whole or any(len(OwnFrames.of(frames, name).frames) for frames in found):
                batches.append(self._stream(name).add(found, whole=whole))
        parts = list[ImuSamples]()
        for packets in batches:
            if not len(packets):
                continue
            try:
                parts.append(packets.imu())
            except SpecError as error:
                packets.stats.error(PluginError.of(error, f"imu of {packets.frame}"), len(packets))
        samples = join_samples(parts)
        if self.waiting is not None:
            self.waiting.add(samples)
        return samples

    def interrupt(self) -> None:
        """Mark a break before the next sample: input was lost here."""
        for name in self._names:
            self._stream(name).interrupt()

    def _stream(self, name: str) -> PacketStream:
        """Return the packets of one type; made when the first ones arrive."""
        if name not in self._streams:
            self._streams[name] = self._make_stream(name)
        return self._streams[name]


@dataclass(frozen=True, eq=False)
class OwnFrames:
    """The frames of one type in a piece of input.

    Attributes:
        frames: those of the type.
        piece: all frames of the piece.
        rows: the rows of `frames` in the piece, as a slice if they follow one another.
    """

    frames: Frames
    piece: Frames
    rows: NDArray[np.intp] | slice

    @classmethod
    def of(cls, piece: Frames, name: str) -> OwnFrames:
        """Return the frames of one type in a piece."""
        own_kind = -1
        if name in piece.names:
            own_kind = piece.names.index(name)
        kind = broadcast_value(piece.kinds)
        if kind is not None and kind == own_kind:
            return cls(piece, piece, slice(0, len(piece)))
        indices = np.flatnonzero(piece.kinds == own_kind)
        rows: NDArray[np.intp] | slice = indices
        if not len(indices):
            rows = slice(0, 0)
        elif indices.item(-1) - indices.item(0) == len(indices) - 1:
            rows = slice(indices.item(0), indices.item(-1) + 1)
        return cls(piece.select(rows), piece, rows)

    @property
    def has_others(self) -> bool:
        """Whether there are frames of other types in the piece."""
        return len(self.frames) < len(self.piece)


def data_frame(sensor: SensorDescription, batches: Sequence[Frames]) -> str | None:
    """Return the type of data frame that an input is read by if none is asked for.

    It is the configured one, or the first that arrived; None if the sensor has several, none is
    configured, and none has arrived yet.
    """
    names = sensor.data_frames
    if len(names) < 2 or sensor.options.get("answer") in names:
        return sensor.data_frame
    for frames in batches:
        kinds = [kind for kind, name in enumerate(frames.names) if name in names]
        own = frames.kinds[np.isin(frames.kinds, kinds)]
        if len(own):
            return frames.names[own.item(0)]
    return None


class _Columns(NamedTuple):
    """The columns of some frames of one type, (n,) each.

    Attributes:
        table: the raw columns.
        offset: of each in the input; a range if they have one size and follow one another.
        at: arrival times, ns; -1 if unknown.
        skipped: bytes in no frame before each.
    """

    table: Table
    offset: Numbers
    at: Integers
    skipped: Integers


def _join(parts: Sequence[_Columns]) -> _Columns | None:
    """Return the columns of all packets, in this order; None if there are none."""
    parts = [part for part in parts if len(part.table)]
    if len(parts) < 2:
        return parts[0] if parts else None
    return _Columns(
        joined_tables([part.table for part in parts]),
        _join_offsets([part.offset for part in parts]),
        _join_values([part.at for part in parts]),
        _join_values([part.skipped for part in parts]),
    )


def _join_offsets(parts: Sequence[Numbers]) -> Numbers:
    """Return offsets joined; as a range, if they are in equal steps."""
    first = parts[0]
    if not isinstance(first, range):
        return np.concatenate([array_of(part) for part in parts])
    stop = first.stop
    for part in parts[1:]:
        if not isinstance(part, range) or part.step != first.step or part.start != stop:
            return np.concatenate([array_of(part) for part in parts])
        stop = part.stop
    return range(first.start, stop, first.step)


def _join_values(parts: Sequence[Integers]) -> Integers:
    """Return arrays joined; as one `repeat` value, if all of them are of it."""
    values = {broadcast_value(part) for part in parts}
    if len(values) == 1:
        only = values.pop()
        if only is not None:
            return repeat(only, sum(map(len, parts)))
    return np.concatenate(parts)


def _host_times(at: Integers) -> Integers:
    """Return arrival times, 0 if unknown."""
    only = broadcast_value(at)
    if only is not None:
        return repeat(max(only, 0), len(at))
    if len(at) and int(at.min()) < 0:
        return np.maximum(at, 0)
    return at
