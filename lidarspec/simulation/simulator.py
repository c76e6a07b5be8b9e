"""Frames that a sensor would send from a scene, made from its own spec, and when it would send them.

The sensor's `sweep` says what is not measured (angles, counters, time). The packets are filled with that, `points` says where the
beams go, the scene says how far, and the ranges go back through the scale of the fields that they come from (`Measurement`): no inverse of
`points` is written anywhere, but by giving each field in metres a probing value it is found out which points answer to it. Where
direction depends on range the measurement is repeated; a beam that finds no fixed point is a no-return. A frame type with an `encode` of
its own is given the measured points and returns the values of its fields.

When each packet is sent follows from what the spec says of time, in this order: the rate that is declared; the sensor's clock, which
its `sweep` sets; the times of the points, which say how long one takes; the speed of its serial line, which no sensor outruns.

Points by coordinates (M2) are linear in the range: with the directions declared in the spec, `Measurement` writes each coordinate back.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.columns import AROUND, Batch, Column, Fields, of_points
from lidarspec.errors import SpecError, UsageError, plugin_errors
from lidarspec.framing.examples import example
from lidarspec.packets.clocks import clock_ns
from lidarspec.simulation.frame_maker import FrameMaker, sealed
from lidarspec.simulation.scenes import Room, Scene
from lidarspec.spec.description import Spec
from lidarspec.spec.fields import factor
from lidarspec.spec.links import Serial
from lidarspec.spec.results import Polar
from lidarspec.spec.tree import exact
from lidarspec.wire.frame_table import Group, Rows, Table

Times = NDArray[np.int64]
#: bits on a serial line for each byte: start, eight, stop.
BITS = 10
#: ns; a clock that strays less from even steps is taken for a coarse one, and the steps for even.
COARSE = 1_000_000
#: packets simulated beyond those asked for, since directions may depend on the next packet.
AHEAD = 1
#: packets on which it is found out how a sensor carries its ranges, and how fast it is.
PROBED = 256
Floats = NDArray[np.float64]
#: how often ranges are measured again while directions still move.
ROUNDS = 8
#: raw value that a range field is given to see which points answer to it.
PROBE = 100


@dataclass(frozen=True, eq=False)
class Target:
    """A field that ranges come from.

    Attributes:
        path: of the field.
        inner: index of the innermost axes of the points that belongs to it.
        step, zero: metres of one raw step and of raw 0; no step where packets have their own, such as the header's or a calibration's.
    """

    path: str
    inner: tuple[int, ...]
    step: float | None
    zero: float = 0.0


@dataclass(frozen=True, eq=False)
class Beams:
    """Where the beams of a table go: arrays that broadcast, the first axis for the packets.

    Attributes:
        range, azimuth, elevation, time, origin: as in `Polar`, directions that nobody knows nan.
        counts: (n,) points of each packet.
        intensity: path of the field that it comes from, "" where it is none.
    """

    range: Floats
    azimuth: Floats
    elevation: Floats
    time: Floats
    origin: tuple[Floats, Floats, Floats]
    counts: NDArray[np.intp]
    intensity: str


class Measurement:
    """How one frame type of a sensor carries its ranges; found out once, on a table of its frames.

    Raises:
        SpecError: where ranges cannot be traced back to fields and there is no `encode`.

    Args:
        given: paths of the fields that the sensor's `sweep` gives, which are left as they are where they are not ranges.
    """

    def __init__(self, sensor: Spec, frame: str, table: Rows, given: Container[str] = ()) -> None:
        self._sensor, self._frame = sensor, frame
        parts = sensor.parts_with_points(frame)
        self._points = sensor.points_of(f"{frame}.{parts}" if parts else frame)
        self._encode: Callable[[Polar], Mapping[str, Any]] | None = sensor.simulation_of(frame).encode
        self._targets = () if self._encode else self._traced(table)
        intensity = self.beams(table).intensity
        self._intensity = "" if intensity in given else intensity
        self._coupled = self._encode is not None or self._turning(table)

    def fill(self, table: Rows, scene: Scene, times: Floats) -> None:
        """Measure a table's ranges in the scene, and write them.

        Args:
            times: (n,) seconds since the scene began, of each packet.
        """
        steps = [self._step(table, target) for target in self._targets]
        before, blind = np.zeros(1), np.zeros(1, np.bool_)
        known: dict[str, NDArray[Any]] = {}
        for attempt in range(ROUNDS):
            beams = self.beams(table)
            ranges = self._measured(beams, scene, times)
            if attempt == ROUNDS - 2:
                blind = ~np.isclose(ranges, before)
            before, ranges = ranges, np.where(blind, 0, ranges)
            values = self._values(table, beams, ranges, steps)
            if known and all(np.array_equal(known[path], raw) for path, raw in values.items()):
                break
            known = values
            for path, raw in values.items():
                store(table, path, raw)
            if not self._coupled or attempt >= ROUNDS - 2:
                break
        if self._intensity and not self._encode:
            first = known[self._targets[0].path]
            store(table, self._intensity, np.where(first > 0, 40 + first % 160, 0))

    def beams(self, table: Rows) -> Beams:
        """Where the beams of a table go as it stands."""
        number = len(table)
        state: dict[str, tuple[Table | None, NDArray[np.intp]]]
        state = {name: (None, np.full(number, -1, np.intp)) for name in self._sensor.state}
        if isinstance(table, PartRows):
            state[AROUND] = (table.frames, table.which)
        batch = Batch(table, np.zeros(number, np.bool_), state, self._sensor.state)
        with np.errstate(all="ignore"), plugin_errors(f"points of {self._frame}", self._sensor.id, self._points):
            polar = self._points(Fields(batch))
            if not isinstance(polar, Polar) or not isinstance(polar.range, Column):
                raise SpecError("only polar points can be simulated", path="points", sensor=self._sensor.id)
            parts = {name: getattr(polar, name) for name in ("range", "azimuth", "elevation", "time")}
            parts |= dict(zip(("ox", "oy", "oz"), polar.origin, strict=True))
            arrays = [np.asarray(array, np.float64) for array in of_points(parts, batch)[0]]
        depth = max(array.ndim for array in arrays)
        full = [array.reshape(*(1,) * (depth - array.ndim), *array.shape) for array in arrays]
        intensity = polar.intensity.source if isinstance(polar.intensity, Column) else ""
        return Beams(full[0], full[1], full[2], np.nan_to_num(full[3]), (full[4], full[5], full[6]), _counts(polar.range, batch), intensity)

    def _measured(self, beams: Beams, scene: Scene, times: Floats) -> Floats:
        """Metres along each beam; 0 where the sensor does not reach, or nobody knows where the beam goes."""
        known = np.isfinite(beams.azimuth) & np.isfinite(beams.elevation)
        at = times.reshape(-1, *(1,) * (beams.range.ndim - 1)) + beams.time
        metres = scene.measure(np.nan_to_num(beams.azimuth), np.nan_to_num(beams.elevation), beams.origin, at)
        near, far = self._sensor.range_limits
        metres = np.where(known & (metres >= near) & (metres <= far), metres, 0)
        return np.asarray(np.broadcast_to(metres, np.broadcast_shapes(metres.shape, beams.range.shape)))

    def _values(self, table: Rows, beams: Beams, ranges: Floats, steps: list[Any]) -> dict[str, NDArray[Any]]:
        """The raw values of the fields that carry these ranges."""
        if self._encode is not None:
            polar = Polar(ranges, np.broadcast_to(beams.azimuth, ranges.shape), np.broadcast_to(beams.elevation, ranges.shape))
            with plugin_errors(f"encode of {self._frame}", self._sensor.id, self._encode):
                return {path: np.asarray(values) for path, values in self._encode(polar).items()}
        found: dict[str, NDArray[Any]] = {}
        for target, (step, zero) in zip(self._targets, steps, strict=True):
            info = table.schema.fields[target.path]
            part = _part(ranges, target.inner)
            with np.errstate(all="ignore"):
                raw = np.rint((part - zero) / step)
            top = float((1 << info.bits) - 1) if info.kind == "int" else np.inf
            found[target.path] = np.where((part > 0) & (raw > 0) & (raw <= top), raw, 0)
        return found

    def _traced(self, table: Rows) -> tuple[Target, ...]:
        """The fields in metres that the ranges of the points answer to."""
        found: list[Target] = []
        for path, info in table.schema.fields.items():
            if factor(info.unit, "m") is None or not any(path in group.layout.leaves for group in table.groups):
                continue
            answer = self._probed(table, [path], PROBE)[0].range
            expected = info.physical(PROBE)
            inner = [spot for spot in self._inner(table, answer) if np.isclose(_part(answer, spot), expected).any()]
            found += [Target(path, spot, info.scale, info.offset) for spot in inner]
        found = found or self._linear(table)
        if not found:
            reason = "no field in metres makes the range of a point: the sensor has to give `encode`"
            raise SpecError(reason, path="points", sensor=self._sensor.id)
        return tuple(found)

    def _linear(self, table: Rows) -> list[Target]:
        """The fields that ranges are linear in, not by their own scale: those in metres, shifted or stretched by a correction; and
        the elements of arrays without a unit to which ranges are in proportion, since the header has the unit."""
        found = []
        for path, info in table.schema.fields.items():
            metres = factor(info.unit, "m") is not None
            if not metres and (info.unit or info.kind != "int" or not info.axes):
                continue
            answers = [beams.range for beams in self._probed(table, [path], PROBE, 2 * PROBE, 3 * PROBE)]
            for spot in self._inner(table, answers[0]):
                once, twice, thrice = (_part(answer, spot) for answer in answers)
                even = np.isclose(thrice - twice, twice - once) & (twice > once) & (once > 0)
                if (even & (metres | np.isclose(twice, 2 * once))).any():
                    found.append(Target(path, spot, None))
        return found

    def _probed(self, table: Rows, paths: Iterable[str], *probes: int) -> list[Beams]:
        """The beams while some fields have one value and another; the table is left as it was."""
        before, beams = {path: table.raw(path) for path in paths}, []
        for probe in probes:
            for path in before:
                store(table, path, np.array(probe))
            beams.append(self.beams(table))
        for path, raw in before.items():
            store(table, path, raw)
        return beams

    def _step(self, table: Rows, target: Target) -> tuple[Any, Any]:
        """Metres of one raw step and of raw 0, numbers or for each point."""
        if target.step is not None:
            return target.step, target.zero
        once, twice = (_part(beams.range, target.inner) for beams in self._probed(table, [target.path], PROBE, 2 * PROBE))
        return (twice - once) / PROBE, 2 * once - twice

    def _inner(self, table: Rows, answer: Floats) -> list[tuple[int, ...]]:
        """The indices of the axes of the points that are further in than those of the fields."""
        extra = answer.ndim - 1 - table.schema.depth()
        return list(np.ndindex(*answer.shape[answer.ndim - extra :])) if extra > 0 else [()]

    def _turning(self, table: Rows) -> bool:
        """Whether directions depend on ranges."""
        first, second = self._probed(table, [target.path for target in self._targets], PROBE, 2 * PROBE)
        same = (np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True) for name in ("azimuth", "elevation"))
        return not all(same)


class PartRows(Rows):
    """The parts that have the points of frames, with these frames, and the one that each is in.

    Args:
        frames: which are written to by `put_back`.
        path: of the parts.
    """

    def __init__(self, frames: Rows, path: str) -> None:
        place = frames.schema.within(path)
        if place is None or place[2]:
            raise SpecError("the frame has no such parts", path=path)
        self.place, self.frames = place[:2], frames
        own, self.which = frames.parts(*self.place)
        super().__init__(own.schema, [Group(group.layout, group.where, group.rows.copy()) for group in own.groups])

    def put_back(self) -> None:
        """Write the parts into their frames, sealed."""
        left = iter(sealed(self))
        axis, kind = self.place
        spots = list[tuple[int, int, NDArray[np.uint8]]]()
        for group in self.frames.groups:
            if (region := group.layout.regions.get(axis)) is not None:
                buffer, walked = region.in_rows(group.rows)
                pieces = [piece for pieces in walked.rounds for piece in pieces if region.kinds[piece.kind].node.name == kind]
                spots += [
                    (int(group.where[owner]), int(spot), buffer)
                    for piece in pieces
                    for owner, spot in zip(piece.owners, piece.spots, strict=True)
                ]
        for _, spot, buffer in sorted(spots, key=lambda found: found[:2]):
            part = next(left)
            buffer[spot : spot + len(part)] = np.frombuffer(part, np.uint8)


def store(table: Rows, path: str, values: NDArray[Any]) -> None:
    """Write raw values, (n, ...) or one for all, into every frame that has the field."""
    for group in table.groups:
        leaf = group.layout.leaves.get(path)
        if leaf is None:
            continue
        own = values if values.ndim == 0 else values[group.where]
        if own.ndim:
            own = own.reshape(own.shape[: 1 + len(leaf.shape)])[(slice(None), *(slice(0, length) for length in leaf.shape))]
        leaf.store(group.rows, own)


def _part(array: Floats, inner: tuple[int, ...]) -> Floats:
    corner: Any = (..., *inner)
    return np.asarray(array[corner])


def _counts(column: Column, batch: Batch) -> NDArray[np.intp]:
    """How many points each packet has."""
    counts = np.ones(len(batch), np.intp)
    for length, name in zip(column.shape[1:], column.axes, strict=True):
        counts = counts * (length if name is None or name.startswith("<") else batch.table.counts(name))
    return counts


class Pace:
    """The times of a sensor's packets, batch by batch.

    Args:
        beams: those of the first packets, `table`.

    Attributes:
        interval: ns from one packet to the next, on average; 0 where the spec says nothing of time.
    """

    def __init__(self, sensor: Spec, frame: str, table: Rows, beams: Beams) -> None:
        self._sensor, self._rate = sensor, sensor.simulation_of(frame).rate
        self._point = _seconds_per_point(beams)
        self._baud = next((link.baud for link in (sensor.links.get("data"),) if isinstance(link, Serial)), 0)
        times = self.times(table, lambda: beams)
        self.interval = float(times[-1]) / (len(times) - 1)

    def times(self, table: Rows, beams: Callable[[], Beams]) -> Times:
        """(n,) ns of each packet of a batch after its first; `beams` gives those of the batch where they are needed."""
        if self._rate:
            return np.asarray(np.rint(np.arange(len(table)) * 1e9 / self._rate), np.int64)
        if self._sensor.clock:
            return self._by_clock(table)
        if self._point:
            steps = beams().counts * self._point * 1e9
        else:
            steps = _sizes(table) * BITS * 1e9 / self._baud if self._baud else np.zeros(len(table))
        return np.asarray(np.rint(np.concatenate([[0], np.cumsum(steps[:-1])])), np.int64)

    def _by_clock(self, table: Rows) -> Times:
        assert self._sensor.clock is not None
        steps = np.diff(clock_ns(self._sensor, Batch(table, np.zeros(len(table), np.bool_))))
        if self._sensor.clock.wraps_at:
            turn = int(exact(self._sensor.clock.wraps_at) * 10**9)
            steps = (steps + turn // 2) % turn - turn // 2
        times = np.concatenate([[0], np.cumsum(steps)])
        even = np.asarray(np.rint(np.linspace(0, times[-1], len(times))), np.int64)
        return even if bool((np.abs(even - times) <= COARSE).all()) else times


def _seconds_per_point(beams: Beams) -> float:
    """From one point of a packet to the next, 0 where the points bear one time."""
    times = np.broadcast_to(beams.time, beams.range.shape).reshape(len(beams.range), -1)
    steps: NDArray[Any] = np.diff(times, axis=1)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _sizes(table: Rows) -> NDArray[np.intp]:
    sizes = np.zeros(len(table), np.intp)
    for group in table.groups:
        sizes[group.where] = group.layout.size
    return sizes


@dataclass(frozen=True, eq=False)
class Block:
    """Packets in a row: their bytes, and (n + 1,) int64 ns from the first one to each, and to the one after them."""

    frames: list[bytes]
    times: NDArray[np.int64]


class Simulation:
    """A data frame type of a sensor, ready to be simulated.

    Attributes:
        interval: ns from one packet to the next, on average; 0 where the spec says nothing of time.

    Raises:
        UsageError: where the sensor declares no `sweep`.
        SpecError: where its ranges cannot be traced back to fields.
    """

    def __init__(self, sensor: Spec, frame: str) -> None:
        sweep = sensor.simulation_of(frame).sweep
        if sweep is None:
            raise UsageError(f"{sensor.id} declares no sweep for {frame!r} frames, and cannot be simulated")
        self._sensor, self._frame, self._sweep = sensor, frame, sweep
        self._maker = FrameMaker(sensor, frame)
        swept = self._swept(range(PROBED))
        table = self._maker.table(swept)
        self._parts = sensor.parts_with_points(frame)
        given = [part for values in swept for part in values[self._parts.partition(".")[0]]] if self._parts else swept
        self._measurement = Measurement(sensor, frame, self._with_points(table), {path for values in given for path in values})
        self._pace = Pace(sensor, frame, table, self._beams(table))
        self.interval = self._pace.interval

    def block(self, start: int, count: int, scene: Scene, since: float = 0.0) -> Block:
        """The packets from number `start` on.

        Args:
            since: seconds since the scene began at the first of them.
        """
        table = self._maker.table(self._swept(range(start, start + count + AHEAD)))
        times = self._pace.times(table, functools.partial(self._beams, table))
        measured = self._with_points(table)
        if isinstance(measured, PartRows):
            self._measurement.fill(measured, scene, since + times[measured.which] / 1e9)
            measured.put_back()
        else:
            self._measurement.fill(table, scene, since + times / 1e9)
        return Block(sealed(table)[:count], times[: count + 1])

    def _with_points(self, table: Rows) -> Rows:
        """What points are made of: frames, or the parts in them."""
        return PartRows(table, self._parts) if self._parts else table

    def _beams(self, table: Rows) -> Beams:
        """The beams of frames, those of their parts together."""
        measured = self._with_points(table)
        beams = self._measurement.beams(measured)
        if not isinstance(measured, PartRows):
            return beams
        counts = np.bincount(measured.which, beams.counts, len(table))
        return replace(beams, counts=counts.astype(np.intp))

    def _swept(self, numbers: range) -> list[Mapping[str, Any]]:
        """The values of the packets of these numbers, before anything is measured."""
        with plugin_errors(f"sweep of {self._frame}", self._sensor.id, self._sweep):
            return [self._sweep(number) for number in numbers]


@functools.lru_cache(maxsize=64)
def simulation(sensor: Spec, frame: str) -> Simulation:
    """The simulation of a data frame type; kept, since it takes a while to find out how a sensor carries its ranges."""
    return Simulation(sensor, frame)


def simulate(sensor: Spec, packets: int = 100, *, start: int = 0, scene: Scene | None = None) -> list[bytes]:
    """The data frames that a sensor standing in a scene sends, one after another.

    Args:
        packets: how many.
        start: the number of the first one since the sensor was switched on.
        scene: what it sees, such as `read_scene` reads from a file; a room where left out.

    Raises:
        UsageError: where the sensor declares no `sweep`.
        SpecError: where its ranges cannot be traced back to fields.
    """
    made = simulation(sensor, sensor.data_frame)
    return made.block(start, packets, scene or Room(), start * made.interval / 1e9).frames


def opening(sensor: Spec) -> bytes:
    """What the sensor sends before its data frames: the frame that they come after; empty where they need none."""
    after = sensor.frames[sensor.data_frame].after
    return b"" if after is None else example(sensor, after)
