"""Make packets from frames, with their times, losses, order and state.

`PacketStream` finds lost packets by their counter (`counter_order`). Without a counter, it uses the
clock of datagrams (`clock_order`), or skipped bytes (`arrival_order`).
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
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.results import Counters, Frames, Numbers, to_array
from lidarspec.packets.arrival_order import ArrivalOrder
from lidarspec.packets.clock_order import ClockOrder
from lidarspec.packets.clocks import (
    ClockEpoch,
    ClockReference,
    Unwrapper,
    hold_times,
    read_clock,
)
from lidarspec.packets.counter_order import CounterOrder
from lidarspec.packets.imu import ImuSamples, WaitingSamples, join_samples
from lidarspec.packets.masked_sector import MaskedGaps
from lidarspec.packets.packet_type import find_clock, get_packet_type
from lidarspec.packets.packets import Index, Packets, StateOf, join_tables
from lidarspec.spec.sensor import SensorDescription

Integers = NDArray[np.int64]
#: The frames of another type, and the number of packets before each of them, (k,).
OtherFrames = tuple[Frames, NDArray[np.intp]]


class PacketStream:
    """Makes packets of one type from the frames that a decoder finds.

    Args:
        frame: the frame type of the packets.
        stats: the decoder's counters, to which lost, duplicate and late packets are added.
        backend: the back end that computes points: "auto", "numpy" or "jit".
        state: frames of other types, by name, which apply from the first packet on.
        reference: the date of a clock reading, which applies from the first packet on; None if
            unknown.

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
        self._type = get_packet_type(sensor, frame)
        self.stats = stats
        self._backend = backend
        self._last_frames: dict[str, Table] = {}  # last frame of each other type, by name
        for name in self._type.other_types:
            if state and name in state:
                self._last_frames[name] = get_codec(sensor.frames[name]).table([state[name]])
        self._skipped = 0  # bytes since the last packet

        clock = self._type.clock
        self._clock = Unwrapper(clock.wraps_at) if clock else None
        self._time: int | None = None  # time of the last packet that had a clock reading
        self._epoch_offset_ns = repeat(0, 0)  # added to the times of one `add` to date them
        self._epoch: ClockEpoch | None = None
        if clock is not None and clock.reference is not None and sensor.frames[frame].data:
            self._epoch = ClockEpoch(self._type.timed_sensor, clock, reference)

        self._counter_order: CounterOrder | None = None
        self._clock_order: ClockOrder | None = None
        loss_clock = self._type.loss_clock
        if self._type.is_counted:
            self._counter_order = CounterOrder(sensor, stats, self._type.clock_of_counter)
        elif loss_clock is not None and self._type.is_ordered_by_clock:
            self._clock_order = ClockOrder(stats, loss_clock, MaskedGaps(sensor))
        self._arrival_order = ArrivalOrder(stats, loss_clock, self._type.loss_clock_step_ns)

    def add(self, batches: Sequence[Frames], *, whole: bool = False) -> Packets:
        """Return the packets among the next frames, and update the state of the stream.

        Args:
            batches: frames of all types, in stream order.
            whole: whether the frames are the whole input. If so, the first frame of each other type
                applies from the first packet on.
        """
        parts = [OwnFrames.of(frames, self._type.frame) for frames in batches if len(frames)]
        columns = _join_columns([self._read_columns(part) for part in parts])
        if columns is None:
            columns = self._make_empty_columns()
        table = columns.table
        state: dict[str, StateOf] = {}
        if self._type.other_types:
            state = self._find_states(parts, len(table), whole=whole)
        host = _to_host_times(columns.at)
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
                    time = self._call_plugin("clock", self._read_times, None, batch, host, whole)
                index, breaks, order = self._find_losses(batch, time, columns.skipped)
        return Packets(
            self._type.sensor,
            self._type.frame,
            table,
            offset=columns.offset,
            time_ns=host if time is None else self._date_times(time),
            host_ns=host,
            index=index,
            breaks=breaks,
            order=order,
            state=state,
            stats=self.stats,
            backend=self._backend,
        )

    def interrupt(self) -> None:
        """Mark a break before the next packet because input was lost."""
        self._skipped = max(self._skipped, 1)
        for judge in (self._counter_order, self._clock_order, self._arrival_order):
            if judge is not None:
                judge.forget()

    def _find_losses(
        self, batch: Batch, time: Integers | None, skipped: Integers
    ) -> tuple[Index, NDArray[np.bool_], Integers | None]:
        """Return the index of packets, the breaks before them, and their order, (n,) each."""
        # If the plugin raises, the packets keep the order of arrival.
        fallback = (range(len(batch)), batch.breaks)
        if self._clock_order is not None and time is not None:
            push = self._clock_order.push
            index, order = self._call_plugin("clock", push, (fallback[0], None), batch, time)
            return index, batch.breaks, order
        if self._counter_order is not None:
            push_counted = self._counter_order.push
            index, breaks = self._call_plugin("sequence", push_counted, fallback, batch, time)
        else:
            push_arrived = self._arrival_order.push
            index, breaks = self._call_plugin("clock", push_arrived, fallback, batch, time, skipped)
        return index, breaks, None

    def _call_plugin(
        self,
        declaration: str,
        function: Callable[..., Any],
        fallback: Any,
        batch: Batch,
        *args: Any,
    ) -> Any:
        """Call a function of a plugin; on an error, count it and return `fallback`.

        Args:
            declaration: the part of the spec that contains the function, such as "clock".
        """
        try:
            return function(batch, *args)
        except Exception as error:
            self.stats.count_error(PluginError.of(error, declaration), len(batch))
            return fallback

    def _read_times(self, batch: Batch, host: Integers, whole: bool) -> Integers:
        """Return the unwrapped clock times of packets, (n,) ns, and store the last one.

        Args:
            host: arrival times, (n,) ns; 0 if unknown.
            whole: whether the packets are the whole input.
        """
        assert self._clock is not None
        which, readings = read_clock(self._type.timed_sensor, batch)
        if which is None:
            times = self._clock.push(readings, host)
            if self._epoch is not None:
                self._epoch_offset_ns = self._epoch.push(batch, readings, times, host, whole=whole)
            return times
        times = self._clock.push(readings, host[which])
        if self._time is None:
            before = host
        else:
            before = repeat(self._time, len(host))
        if len(times):
            self._time = times.item(-1)
        return hold_times(which, times, before)

    def _date_times(self, times: Integers) -> Integers:
        """Return times in ns since 1970; unchanged if no frame has reported the date."""
        if self._epoch is None or not len(times):
            return times
        if self._epoch.ns is None:
            self.stats.undated = (
                "times count from the start of the sensor's clock, because no"
                f" {self._epoch.frame} frame with the date has arrived"
            )
            return times
        self.stats.undated = ""
        return times + self._epoch_offset_ns

    def _count_skipped_bytes(self, part: OwnFrames) -> Integers:
        """Return the number of bytes outside frames before each packet, (n,)."""
        # The bytes after the last packet belong to the first packet of the next piece of input.
        gaps = part.piece.gaps
        rows = part.rows
        count = len(part.frames)
        if broadcast_value(gaps) == 0 and not self._skipped:
            return repeat(0, count)
        if isinstance(rows, slice) and count:
            skipped = gaps[rows].copy()
            skipped[0] += self._skipped + int(gaps[: rows.start].sum())
            self._skipped = int(gaps[rows.stop :].sum())
            return skipped
        sums = self._skipped + np.cumsum(gaps)
        own_sums = sums[rows]
        self._skipped = int(sums[-1])
        if count:
            self._skipped -= int(own_sums[-1])
        return np.diff(own_sums, prepend=0)

    def _read_columns(self, part: OwnFrames) -> _Columns:
        """Return the columns of the packets in one piece of input."""
        frames = part.frames
        skipped = self._count_skipped_bytes(part)
        return _Columns(self._type.codec.gather(frames), frames.places, frames.at, skipped)

    def _make_empty_columns(self) -> _Columns:
        empty = repeat(0, 0)
        return _Columns(self._type.codec.table([]), range(0), empty, empty)

    def _find_states(
        self, parts: Sequence[OwnFrames], packet_count: int, *, whole: bool
    ) -> dict[str, StateOf]:
        """Return the state of the packets: for each other frame type, its last frames."""
        others = self._select_others(parts)
        return {
            name: self._find_state(
                name, others.get(name, []), packet_count=packet_count, whole=whole
            )
            for name in self._type.other_types
        }

    def _select_others(self, parts: Sequence[OwnFrames]) -> dict[str, list[OtherFrames]]:
        """Return the new frames of the types in the packets' state, by frame type."""
        selected: dict[str, list[OtherFrames]] = {}
        packet_count = 0
        for part in parts:
            if part.has_others:
                mask = np.ones(len(part.piece), np.bool_)
                mask[part.rows] = False
                others = np.flatnonzero(mask)
                kinds = part.piece.kinds[others]
                before = packet_count + others - np.arange(len(others))
                for kind in np.unique(kinds).tolist():
                    name = part.piece.names[kind]
                    if name in self._type.other_types:
                        which = kinds == kind
                        frames = part.piece.select(others[which])
                        selected.setdefault(name, []).append((frames, before[which]))
            packet_count += len(part.frames)
        return selected

    def _find_state(
        self, name: str, others: Sequence[OtherFrames], *, packet_count: int, whole: bool
    ) -> StateOf:
        """Return the frames of a type, and the row of the last frame before each packet."""
        # The row is -1 if there is no earlier frame.
        last_frame = self._last_frames.get(name)
        if not others:
            return last_frame, repeat(-1 if last_frame is None else 0, packet_count)
        engine = get_codec(self._type.sensor.frames[name])
        tables: list[Table] = [engine.gather(frames) for frames, _ in others]
        before = np.concatenate([counts for _, counts in others])
        if last_frame is not None:
            tables = [last_frame, *tables]
            before = np.concatenate(([0], before))
        elif whole:
            before[0] = 0
        newest, _ = others[-1]
        self._last_frames[name] = engine.table([newest.data(len(newest) - 1)])
        packets_between = np.diff(before, prepend=0, append=packet_count)
        which = np.repeat(np.arange(-1, len(before)), packets_between)
        return join_tables(tables), which


class ImuStream:
    """Reads the IMU samples of one stream, from all frame types that have IMU data.

    Args:
        stats: the decoder's counters.
        state: frames of other types, by name, see `PacketStream`.

    Attributes:
        waiting: the samples of scans that have not ended; None without an IMU, or if only some of
            the frame types have a clock.
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
        """Return the IMU samples among the next frames, and add them to `waiting`.

        Args:
            found: frames of all types, in stream order.
            data: the data packets among the frames; None if there are none.
            whole: whether the frames are the whole input.
        """
        batches = list[Packets]()
        if data is not None and data.sensor.frames[data.frame].imu is not None:
            batches.append(data)
        for name in self._names:
            # A whole input without frames of the type has no samples, so it need not be searched.
            if not whole or any(len(OwnFrames.of(frames, name).frames) for frames in found):
                batches.append(self._find_stream(name).add(found, whole=whole))
        parts = list[ImuSamples]()
        for packets in batches:
            if not len(packets):
                continue
            parts.append(read_imu(packets))
        samples = join_samples(parts)
        if self.waiting is not None:
            self.waiting.add(samples)
        return samples

    def interrupt(self) -> None:
        """Mark a break before the next sample because input was lost."""
        for name in self._names:
            self._find_stream(name).interrupt()

    def _find_stream(self, name: str) -> PacketStream:
        """Return the stream of one type; create it on first use."""
        if name not in self._streams:
            self._streams[name] = self._make_stream(name)
        return self._streams[name]


def read_imu(packets: Packets) -> ImuSamples:
    """Return the IMU samples of packets; an error of the plugin's function is counted."""
    try:
        return packets.imu()
    except SpecError as error:
        packets.stats.count_error(PluginError.of(error, f"imu of {packets.frame}"), len(packets))
        return join_samples([])


@dataclass(frozen=True, eq=False)
class OwnFrames:
    """The frames of the stream's own type in a piece of input.

    Attributes:
        frames: the frames of the type.
        piece: all frames of the piece.
        rows: the indices of `frames` in `piece`; a slice if they are consecutive.
    """

    frames: Frames
    piece: Frames
    rows: NDArray[np.intp] | slice

    @classmethod
    def of(cls, piece: Frames, name: str) -> OwnFrames:
        """Return the frames of one type in a piece of input."""
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
        """Whether there are frames of other types in the piece of input."""
        return len(self.frames) < len(self.piece)


def choose_data_frame(sensor: SensorDescription, batches: Sequence[Frames]) -> str | None:
    """Return the default data frame type of an input; None without data frames."""
    # Of several types, the type of the first data frame in the input is the default.
    names = sensor.data_frames
    if not sensor.has_points:
        return None
    if len(names) < 2 or sensor.options.get("answer") in names:
        return sensor.data_frame
    for frames in batches:
        kinds = [kind for kind, name in enumerate(frames.names) if name in names]
        own = frames.kinds[np.isin(frames.kinds, kinds)]
        if len(own):
            return frames.names[own.item(0)]
    return None


class _Columns(NamedTuple):
    """The columns of some frames of one type, (n,) each."""

    table: Table
    offset: Numbers
    at: Integers
    skipped: Integers


def _join_columns(parts: Sequence[_Columns]) -> _Columns | None:
    """Return the columns of all pieces of input as one; None if there are no packets."""
    parts = [part for part in parts if len(part.table)]
    if len(parts) < 2:
        return parts[0] if parts else None
    return _Columns(
        join_tables([part.table for part in parts]),
        _join_offsets([part.offset for part in parts]),
        _join_values([part.at for part in parts]),
        _join_values([part.skipped for part in parts]),
    )


def _join_offsets(parts: Sequence[Numbers]) -> Numbers:
    """Return the offsets of all pieces of input; a range if all steps are equal."""
    first = parts[0]
    if not isinstance(first, range):
        return np.concatenate([to_array(part) for part in parts])
    stop = first.stop
    for part in parts[1:]:
        if not isinstance(part, range) or part.step != first.step or part.start != stop:
            return np.concatenate([to_array(part) for part in parts])
        stop = part.stop
    return range(first.start, stop, first.step)


def _join_values(parts: Sequence[Integers]) -> Integers:
    """Return the values of all pieces of input as one array."""
    values = {broadcast_value(part) for part in parts}
    if len(values) == 1:
        only = values.pop()
        if only is not None:
            return repeat(only, sum(map(len, parts)))
    return np.concatenate(parts)


def _to_host_times(at: Integers) -> Integers:
    """Return arrival times; unknown times of -1 become 0."""
    only = broadcast_value(at)
    if only is not None:
        return repeat(max(only, 0), len(at))
    if len(at) and int(at.min()) < 0:
        return np.maximum(at, 0)
    return at
