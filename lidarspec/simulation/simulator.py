"""Make the frames that a sensor would send in a scene, and calculate their times.

Packets are made in four steps:

1. The sensor's `sweep` gives the values that are not measured, such as angles, counters and time.
2. The sensor's `points` gives the directions of the beams.
3. The scene gives the range of each beam.
4. `Measurement` writes the ranges into the range fields. `PointPlacement` writes the coordinates of
   Cartesian points.

The range fields are found by probing: each field in metres is set to a probe value, and the points
that then have this range belong to the field. If the sensor declares a function `encode`, nothing
is probed: `encode` converts the ranges to the values of the fields.
"""

from __future__ import annotations

import functools
import heapq
import itertools
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError, UsageError, plugin_errors
from lidarspec.expressions.columns import AROUND, Batch, Column, Fields, align_points
from lidarspec.frames.frame_table import CompiledTable, Table
from lidarspec.framing.example_frames import example
from lidarspec.framing.frame_engine import get_codec
from lidarspec.packets.clocks import clock_ns, to_exact_ns
from lidarspec.packets.packet_type import find_clock
from lidarspec.points.conventions import coordinates, find_direction
from lidarspec.points.reference_evaluator import list_parts
from lidarspec.sensor_operations import Sensor
from lidarspec.simulation.clock_faults import ClockFaults, ClockTimeline
from lidarspec.simulation.clock_writer import FrameClock, find_status_clocks
from lidarspec.simulation.frame_maker import FrameMaker
from lidarspec.simulation.raw_values import PartRows, round_raw, write_raw
from lidarspec.simulation.scenes import Room, Scene
from lidarspec.spec.fields import factor
from lidarspec.spec.links import Serial
from lidarspec.spec.results import Cartesian, Points, Polar
from lidarspec.spec.timing import DATED_EPOCHS, Every

Times = NDArray[np.int64]
#: Number of bits on a serial line for each byte: a start bit, eight data bits and a stop bit.
BITS_PER_BYTE = 10
#: If a clock deviates from equal steps by less than this, the deviation is attributed to its coarse
#: resolution, and equal steps are used.
CLOCK_TOLERANCE_NS = 1_000_000
#: Number of packets that are simulated after the last requested packet. They are needed because
#: directions may depend on the next packet.
EXTRA_PACKETS = 1
#: Maximum number of packets that are made to find the fields with ranges, and the packet rate.
MAX_PROBED_PACKETS = 256
#: Minimum number of these packets.
MIN_PROBED_PACKETS = 4
#: Maximum total size of these packets, unless fewer than the minimum number fit.
MAX_PROBED_BYTES = 1 << 21
#: Number of packets from which the fields of the clock are found.
CLOCK_PROBE_PACKETS = 2
Floats = NDArray[np.float64]
#: Maximum number of repeated measurements if directions depend on ranges.
MAX_ROUNDS = 8
#: The attributes of points that define beams.
_MEASURED = ("range", "azimuth", "elevation", "ox", "oy", "oz", "x", "y", "z", "time")
#: The raw value that is set to find the points that depend on a field.
PROBE_VALUE = 100
#: Relative tolerance for rounding errors between a range and the value of its field.
RANGE_TOLERANCE = 1e-9
#: Number of periodic frames without points to make together.
PERIODIC_BATCH = 50
#: Standard gravity, m/s2.
GRAVITY = 9.80665


@dataclass(frozen=True, eq=False)
class RangeField:
    """A field that contains ranges.

    Attributes:
        path: path of the field.
        inner: the index of the field's points on the axes that the points have and the field does
            not, for example an axis of returns; () if there are no such axes.
        step: metres per raw step; None if it differs between packets.
        zero: range of the raw value 0, metres.
    """

    path: str
    inner: tuple[int, ...]
    step: float | None
    zero: float = 0.0


@dataclass(frozen=True, eq=False)
class Beams:
    """The beams of n packets; the first axis of each array is the packet.

    Attributes:
        range: as in `Polar`.
        azimuth: as in `Polar`; nan if unknown.
        elevation: as in `Polar`; nan if unknown.
        time: as in `Polar`.
        origin: as in `Polar`.
        counts: number of points of each packet, (n,).
        intensity: path of the field with the intensity; "" if the points have no intensity.
        positions: x, y and z of Cartesian points, (3, n, ...); None for polar points.
    """

    range: Floats
    azimuth: Floats
    elevation: Floats
    time: Floats
    origin: tuple[Floats, Floats, Floats]
    counts: NDArray[np.intp]
    intensity: str
    positions: Floats | None = None

    def unit(self) -> Floats:
        """Return x, y and z of the unit vectors of the beams, (3, n, ...)."""
        return np.stack(
            np.broadcast_arrays(*coordinates(np.ones(()), self.azimuth, self.elevation, (0, 0, 0)))
        )


class Measurement:
    """Writes measured ranges into frames of one type of a sensor.

    Args:
        table: example frames, in which the fields with ranges are searched.
        given: paths of the fields that `sweep` gives; they are changed only if they are ranges.

    Raises:
        SpecError: if no fields that determine the ranges are found, and the sensor has no `encode`.
    """

    def __init__(
        self, sensor: Sensor, frame: str, table: CompiledTable, given: Container[str] = ()
    ) -> None:
        self._sensor = sensor
        self._frame = frame
        self._points = sensor.points_of(_get_table_name(frame, table))
        self._encode: Callable[[Polar], Mapping[str, Any]] | None = sensor.simulation_of(
            frame
        ).encode
        intensity = self.beams(table).intensity
        self._given = given
        self._intensity = "" if intensity in given else intensity
        self._targets = () if self._encode else self._trace_targets(table)
        self._coupled = self._encode is not None or self._directions_depend_on_range(table)

    @classmethod
    def of(
        cls, sensor: Sensor, frame: str, table: CompiledTable, given: Container[str]
    ) -> Measurement:
        """Return a `Measurement`, or a `PointPlacement` if the points are Cartesian."""
        result, _ = _evaluate_points(sensor, frame, table)
        if isinstance(result, Cartesian):
            return PointPlacement(sensor, frame, table, given)
        return Measurement(sensor, frame, table, given)

    def fill(
        self, table: CompiledTable, numbers: Sequence[int], scene: Scene, times: Floats
    ) -> None:
        """Measure the ranges of a table in the scene, and write them into the table.

        Args:
            table: the frames, or the parts of frames.
            numbers: number of each packet in the sweep; for parts, the number of the packet that
                contains the part.
            times: time of each packet, (n,) seconds since the scene began.
        """
        steps = [self._measure_step(table, target) for target in self._targets]
        before = np.zeros(1)
        blind = np.zeros(1, np.bool_)
        written: dict[str, NDArray[Any]] = {}
        # If directions depend on ranges, the beams are measured again with the new directions.
        # A beam whose direction keeps changing gets no return.
        for attempt in range(MAX_ROUNDS):
            beams = self.beams(table)
            ranges = self._measure(beams, scene, times)
            if attempt == MAX_ROUNDS - 2:
                blind = ~np.isclose(ranges, before)
            before = ranges
            ranges = np.where(blind, 0, ranges)
            values = self._to_raw_values(table, beams, ranges, steps)
            if written and all(np.array_equal(written[path], raw) for path, raw in values.items()):
                break
            written = values
            for path, raw in values.items():
                write_raw(table, path, raw)
            if not self._coupled or attempt >= MAX_ROUNDS - 2:
                break
        if self._intensity and not self._encode:
            self._fill_intensity(table, written[self._targets[0].path])

    def _fill_intensity(self, table: CompiledTable, ranges: NDArray[Any]) -> None:
        """Write an intensity for each range; 0 for a beam without a return."""
        write_raw(table, self._intensity, np.where(ranges > 0, 40 + np.rint(ranges) % 160, 0))

    def beams(self, table: CompiledTable) -> Beams:
        """Return the beams of a table."""
        result, batch = _evaluate_points(self._sensor, self._frame, table)
        with (
            np.errstate(all="ignore"),
            plugin_errors(f"points of {self._frame}", self._sensor.id, self._points),
        ):
            parts = {name: part for name, part in list_parts(result).items() if name in _MEASURED}
            arrays, axes, _, shape = align_points(parts, batch)
        depth = len(shape)
        full = {
            name: _add_leading_axes(np.asarray(array, np.float64), depth)
            for name, array in zip(parts, arrays, strict=True)
        }
        positions = None
        if isinstance(result, Cartesian):
            positions = np.stack([np.broadcast_to(full[name], shape) for name in "xyz"])
            full |= dict(
                zip(("range", "azimuth", "elevation"), find_direction(*positions), strict=True)
            )
        origin = [full.get(name, np.zeros((1,) * depth)) for name in ("ox", "oy", "oz")]
        if isinstance(result.intensity, Column):
            intensity = result.intensity.source
        else:
            intensity = ""
        own = {name: full[name] for name in ("range", "azimuth", "elevation")} | {
            "time": np.nan_to_num(full["time"])
        }
        return Beams(
            **own,
            origin=(origin[0], origin[1], origin[2]),
            counts=_count_points(shape, axes, batch),
            intensity=intensity,
            positions=positions,
        )

    def _measure(self, beams: Beams, scene: Scene, times: Floats) -> Floats:
        """Return the range of each beam in metres; 0 if it cannot be measured."""
        has_direction = np.isfinite(beams.azimuth) & np.isfinite(beams.elevation)
        seconds = times.reshape(-1, *(1,) * (beams.range.ndim - 1)) + beams.time
        metres = scene.measure(
            np.nan_to_num(beams.azimuth), np.nan_to_num(beams.elevation), beams.origin, seconds
        )
        assert self._sensor.range_limits is not None  # as of every sensor with points
        near, far = self._sensor.range_limits
        metres = np.where(has_direction & (metres >= near) & (metres <= far), metres, 0)
        return np.asarray(
            np.broadcast_to(metres, np.broadcast_shapes(metres.shape, beams.range.shape))
        )

    def _to_raw_values(
        self, table: CompiledTable, beams: Beams, ranges: Floats, steps: list[Any]
    ) -> dict[str, NDArray[Any]]:
        """Convert ranges to raw values of fields, and return them by path."""
        if self._encode is not None:
            polar = Polar(
                ranges,
                np.broadcast_to(beams.azimuth, ranges.shape),
                np.broadcast_to(beams.elevation, ranges.shape),
            )
            with plugin_errors(f"encode of {self._frame}", self._sensor.id, self._encode):
                return {path: np.asarray(values) for path, values in self._encode(polar).items()}
        raw_values: dict[str, NDArray[Any]] = {}
        for target, (step, zero) in zip(self._targets, steps, strict=True):
            info = table.schema.fields[target.path]
            part = _select_inner(ranges, target.inner)
            with np.errstate(all="ignore"):
                raw = round_raw(info, (part - zero) / step)
            raw_values[target.path] = np.where(
                (part > 0) & (raw > 0) & (raw <= self._find_max_raw(table, target.path)), raw, 0
            )
        return raw_values

    def _find_max_raw(self, table: CompiledTable, path: str) -> float:
        """Return the largest raw value that can be sent in a field."""
        most = table.schema.fields[path].limits[1]
        form = self._sensor.frames[self._frame].wire
        leaves = [
            group.layout.leaves[path] for group in table.groups if path in group.layout.leaves
        ]
        if form is None:
            return most
        return min(most, *(form.largest(leaf.size) for leaf in leaves))

    def _trace_targets(self, table: CompiledTable) -> tuple[RangeField, ...]:
        """Return the fields into which the ranges of the points are written.

        They are the fields in metres that are a range of a point. If there are none, the fields of
        `_find_linear_fields` are returned.
        """
        targets: list[RangeField] = []
        for path, info in table.schema.fields.items():
            if factor(info.unit, "m") is None or not any(
                path in group.layout.leaves for group in table.groups
            ):
                continue
            answer = self._probe(table, [path], PROBE_VALUE)[0].range
            expected = info.physical(PROBE_VALUE)
            for inner in self._list_inner_indices(table, answer):
                part = _select_inner(answer, inner)
                # A unit vector whose length is not exactly 1 affects the range.
                near = part[np.isclose(part, expected)]
                if np.allclose(near, expected, RANGE_TOLERANCE, 0):
                    step = info.scale
                else:
                    step = None
                targets += [RangeField(path, inner, step, info.offset)] if near.size else []
        targets = targets or self._find_linear_fields(table)
        if not targets:
            reason = (
                f"{self._frame!r} frames cannot be simulated, because no field contains only the"
                " range of a point: declare Simulation(encode=...)"
            )
            raise SpecError(reason, path="points", sensor=self._sensor.id)
        return tuple(targets)

    def _find_linear_fields(self, table: CompiledTable) -> list[RangeField]:
        """Return the fields from which `points` calculates ranges by a linear function."""
        targets = []
        for path, info in table.schema.fields.items():
            metres = factor(info.unit, "m") is not None
            if not metres and (info.unit or info.kind != "int" or not info.axes):
                continue
            answers = [
                beams.range
                for beams in self._probe(
                    table, [path], PROBE_VALUE, 2 * PROBE_VALUE, 3 * PROBE_VALUE
                )
            ]
            for inner in self._list_inner_indices(table, answers[0]):
                once, twice, thrice = (_select_inner(answer, inner) for answer in answers)
                even = np.isclose(thrice - twice, twice - once) & (twice > once) & (once > 0)
                if (even & (metres | np.isclose(twice, 2 * once))).any():
                    targets.append(RangeField(path, inner, None))
        return targets

    def _probe(self, table: CompiledTable, paths: Iterable[str], *probes: int) -> list[Beams]:
        """Set fields to each of several raw values, and return the beams for each value."""
        before = {path: table.raw(path) for path in paths}
        beams = []
        for probe in probes:
            for path in before:
                write_raw(table, path, np.array(probe))
            beams.append(self.beams(table))
        for path, raw in before.items():
            write_raw(table, path, raw)
        return beams

    def _measure_step(self, table: CompiledTable, target: RangeField) -> tuple[Any, Any]:
        """Return metres per raw step, and the range of the raw value 0 in metres."""
        if target.step is not None:
            return target.step, target.zero
        once, twice = (
            _select_inner(beams.range, target.inner)
            for beams in self._probe(table, [target.path], PROBE_VALUE, 2 * PROBE_VALUE)
        )
        return (twice - once) / PROBE_VALUE, 2 * once - twice

    def _list_inner_indices(self, table: CompiledTable, answer: Floats) -> list[tuple[int, ...]]:
        """Return all possible values of `RangeField.inner`.

        Args:
            answer: the ranges of the points, (n, ...).
        """
        extra = answer.ndim - 1 - table.schema.depth()
        if extra > 0:
            return list(np.ndindex(*answer.shape[answer.ndim - extra :]))
        return [()]

    def _directions_depend_on_range(self, table: CompiledTable) -> bool:
        """Return whether directions depend on ranges."""
        first, second = self._probe(
            table, [target.path for target in self._targets], PROBE_VALUE, 2 * PROBE_VALUE
        )
        same = (
            np.array_equal(getattr(first, name), getattr(second, name), equal_nan=True)
            for name in ("azimuth", "elevation")
        )
        return not all(same)


class PointPlacement(Measurement):
    """Writes the coordinates of the point that each beam hits into frames.

    Raises:
        SpecError: if no directions are declared, or no field determines the coordinates of a point.
    """

    def fill(
        self, table: CompiledTable, numbers: Sequence[int], scene: Scene, times: Floats
    ) -> None:
        beams = self.beams(table)
        azimuth, elevation = self._get_directions(numbers, beams.range.shape[1:])
        beams = replace(beams, azimuth=azimuth, elevation=elevation)
        ranges = self._measure(beams, scene, times)
        for path, raw in self._to_raw_values(table, beams, ranges, []).items():
            write_raw(table, path, raw)
        if self._intensity and not self._encode:
            self._fill_intensity(table, _select_inner(ranges, self._targets[0].inner) * 1000)

    def _get_directions(
        self, numbers: Sequence[int], shape: tuple[int, ...]
    ) -> tuple[Floats, Floats]:
        """Return the declared azimuths and elevations of packets, (n, *shape) each."""
        declared = self._sensor.simulation_of(self._frame).directions
        if declared is None:
            reason = "a sensor with Cartesian points requires Simulation(directions=...)"
            raise SpecError(reason, path="simulation", sensor=self._sensor.id)
        directions = np.full((2, len(numbers), *shape), np.nan)
        with plugin_errors(f"directions of {self._frame}", self._sensor.id, declared):
            for index, number in enumerate(numbers):
                azimuth, elevation = np.broadcast_arrays(*declared(number))
                stacked = np.stack([azimuth, elevation]).reshape(
                    2, *(1,) * (len(shape) - azimuth.ndim), *azimuth.shape
                )
                if any(
                    own > length for own, length in zip(stacked.shape[1:], shape, strict=False)
                ) or stacked.ndim > 1 + len(shape):
                    raise SpecError(
                        f"azimuth and elevation have the shape {azimuth.shape}, which does not"
                        f" broadcast to the shape {shape} of the points of frame {number}"
                    )
                corner: Any = tuple(
                    slice(0, length if length > 1 else None) for length in stacked.shape[1:]
                )
                directions[:, index][(slice(None), *corner)] = stacked
        return directions[0], directions[1]

    def _to_raw_values(
        self, table: CompiledTable, beams: Beams, ranges: Floats, steps: list[Any]
    ) -> dict[str, NDArray[Any]]:
        if self._encode is not None:
            return super()._to_raw_values(table, beams, ranges, steps)
        raw_values: dict[str, NDArray[Any]] = {}
        aims = ranges * beams.unit()
        for inner in dict.fromkeys(target.inner for target in self._targets):
            paths = [target.path for target in self._targets if target.inner == inner]
            infos = [table.schema.fields[path] for path in paths]
            zero, *ones = (
                _select_inner(positions, inner)
                for positions in self._probe_coordinates(table, paths)
            )
            slopes = np.stack([(probed - zero) / PROBE_VALUE for probed in ones])
            raw = [
                round_raw(info, column)
                for info, column in zip(
                    infos, _solve(slopes, _select_inner(aims, inner) - zero), strict=True
                )
            ]
            kept = _select_inner(ranges, inner) > 0
            for info, column in zip(infos, raw, strict=True):
                kept = kept & (
                    (column >= info.limits[0]) & (column <= info.limits[1])
                    if info.kind == "int"
                    else np.isfinite(column)
                )
            raw_values |= {
                path: np.where(kept, column, 0) for path, column in zip(paths, raw, strict=True)
            }
        return raw_values

    def _probe_coordinates(self, table: CompiledTable, paths: Sequence[str]) -> list[Floats]:
        """Return the coordinates for several sets of field values.

        Returns:
            The x, y and z of the points for each set, (3, n, ...).
        """
        before = {path: table.raw(path) for path in paths}
        for path in paths:
            write_raw(table, path, np.array(0))
        beams = [self.beams(table), *(self._probe(table, [path], PROBE_VALUE)[0] for path in paths)]
        for path, raw in before.items():
            write_raw(table, path, raw)
        return [each.positions for each in beams if each.positions is not None]

    def _trace_targets(self, table: CompiledTable) -> tuple[RangeField, ...]:
        """Return the fields into which the coordinates of the points are written.

        The coordinates have to be a linear function of each of these fields.
        """
        targets = []
        for path, info in table.schema.fields.items():
            metres = not info.unit or factor(info.unit, "m") is not None
            if (
                not metres
                or info.kind not in ("int", "float")
                or path in self._given
                or len(info.axes) < table.schema.depth()
            ):
                continue
            positions = [
                beams.positions
                for beams in self._probe(
                    table, [path], PROBE_VALUE, 2 * PROBE_VALUE, 3 * PROBE_VALUE
                )
                if beams.positions is not None
            ]
            for inner in self._list_inner_indices(table, positions[0][0]):
                once, twice, thrice = (_select_inner(position, inner) for position in positions)
                if (twice != once).any() and np.allclose(thrice - twice, twice - once):
                    targets.append(RangeField(path, inner, None))
        if not targets:
            reason = (
                f"{self._frame!r} frames cannot be simulated, because the coordinates of points are"
                " not a linear function of any field: declare Simulation(encode=...)"
            )
            raise SpecError(reason, path="points", sensor=self._sensor.id)
        return tuple(targets)

    def _directions_depend_on_range(self, table: CompiledTable) -> bool:
        return False


def _solve(slopes: Floats, aims: Floats) -> Floats:
    """Solve linear equations for raw values, (k, n, ...).

    Args:
        slopes: changes of the values per raw step, (k, m, n, ...).
        aims: the values to reach, (m, n, ...).
    """
    matrices = np.moveaxis(slopes, (0, 1), (-1, -2))
    wanted = np.moveaxis(aims, 0, -1)
    first = matrices[(0,) * (matrices.ndim - 2)]
    inverse = np.linalg.pinv(first if (matrices == first).all() else matrices)
    return np.moveaxis((inverse @ wanted[..., None])[..., 0], -1, 0)


def _get_table_name(frame: str, table: CompiledTable) -> str:
    """Return the name of the frame type, or of the parts, in a table."""
    if isinstance(table, PartRows):
        return ".".join(filter(None, (frame, *table.place)))
    return frame


def _evaluate_points(sensor: Sensor, frame: str, table: CompiledTable) -> tuple[Points, Batch]:
    """Return the result of `points` for a table, and the batch of the table."""
    batch = _make_point_batch(sensor, table)
    points = sensor.points_of(_get_table_name(frame, table))
    with np.errstate(all="ignore"), plugin_errors(f"points of {frame}", sensor.id, points):
        result = points(Fields(batch))
    measured = [getattr(result, name, None) for name in ("range", "x", "y", "z")]
    if not any(isinstance(part, Column) for part in measured):
        raise SpecError(
            f"{frame!r} frames cannot be simulated, because `points` calculates neither ranges nor"
            " coordinates from fields",
            path="points",
            sensor=sensor.id,
        )
    return result, batch


def _make_point_batch(sensor: Sensor, table: CompiledTable) -> Batch:
    """Return a table as a batch that begins a stream."""
    state: dict[str, tuple[Table | None, NDArray[np.intp]]]
    state = {name: (None, np.full(len(table), -1, np.intp)) for name in sensor.state}
    if isinstance(table, PartRows):
        state[AROUND] = (table.frames, table.which)
    return Batch(table, np.zeros(len(table), np.bool_), state, sensor.state)


def _select_inner(array: Floats, inner: tuple[int, ...]) -> Floats:
    corner: Any = (..., *inner)
    return np.asarray(array[corner])


def _add_leading_axes(array: Floats, depth: int) -> Floats:
    return array.reshape(*(1,) * (depth - array.ndim), *array.shape)


def _count_points(
    shape: tuple[int, ...], axes: tuple[str | None, ...], batch: Batch
) -> NDArray[np.intp]:
    """Return the number of points of each packet, (n,)."""
    counts = np.ones(len(batch), np.intp)
    for length, name in zip(shape[1:], axes, strict=True):
        counts = counts * (
            length if name is None or name.startswith("<") else batch.table.counts(name)
        )
    return counts


class RestingImu:
    """Writes the measurements of an IMU at rest into frames of one type.

    Args:
        given: paths of the fields that `sweep` gives; they are not changed.

    Raises:
        SpecError: if no fields that determine the measurements are found.
    """

    def __init__(self, sensor: Sensor, frame: str, given: Container[str]) -> None:
        self._sensor = sensor
        self._frame = frame
        self._given = given
        self._path = sensor.parts_with("imu", frame)
        self._targets: list[str] | None = None

    def fill(self, frames: CompiledTable, shake: float, seed: Sequence[int]) -> None:
        """Write the measurements into frames.

        Args:
            shake: standard deviation of the noise, m/s2 and rad/s; 0 for no noise.
        """
        table = PartRows(frames, self._path) if self._path else frames
        if not len(table):
            return
        if self._targets is None:
            self._targets = self._find_linear_fields(table)
        before = {path: table.raw(path) for path in self._targets}
        for path in self._targets:
            write_raw(table, path, np.array(0))
        zero = self._read_motion(table)
        slopes = np.stack([self._probe(table, path) - zero for path in self._targets]) / PROBE_VALUE
        if shake:
            aims = np.random.default_rng(seed).normal(0.0, shake, zero.shape)
        else:
            aims = np.zeros(zero.shape)
        aims[5] += GRAVITY
        for path, raw in zip(self._targets, _solve(slopes, aims - zero), strict=True):
            info = table.schema.fields[path]
            write_raw(
                table,
                path,
                (
                    np.clip(round_raw(info, raw), *info.limits).reshape(before[path].shape)
                    if info.kind == "int"
                    else raw
                ),
            )
        if isinstance(table, PartRows):
            table.put_back()

    def _find_linear_fields(self, table: CompiledTable) -> list[str]:
        """Return the fields on which the IMU measurements depend linearly."""
        zero = self._read_motion(table)
        paths = list[str]()
        for path, info in table.schema.fields.items():
            if info.kind not in ("int", "float") or info.const is not None or path in self._given:
                continue
            before = table.raw(path)
            answers = []
            for probe in (0, PROBE_VALUE, 2 * PROBE_VALUE):
                write_raw(table, path, np.array(probe))
                answers.append(self._read_motion(table))
            write_raw(table, path, before)
            none, once, twice = answers
            if (once != none).any() and np.allclose(twice - once, once - none):
                paths.append(path)
        if not paths or zero.shape[0] != 6:
            raise SpecError(
                "cannot be simulated, because no field determines the IMU samples",
                path=f"{self._frame}.imu",
                sensor=self._sensor.id,
            )
        return paths

    def _probe(self, table: CompiledTable, path: str) -> Floats:
        """Return the IMU measurements in a table whose field is set to `PROBE_VALUE`."""
        write_raw(table, path, np.array(PROBE_VALUE))
        readings = self._read_motion(table)
        write_raw(table, path, np.array(0))
        return readings

    def _read_motion(self, table: CompiledTable) -> Floats:
        """Return the angular velocities and accelerations in a table, (6, n, ...)."""
        batch = _make_point_batch(self._sensor, table)
        function = self._sensor.imu_of(_get_table_name(self._frame, table))
        with (
            np.errstate(all="ignore"),
            plugin_errors(f"imu of {self._frame}", self._sensor.id, function),
        ):
            result = function(Fields(batch))
            parts = dict(enumerate((*result.angular_velocity, *result.linear_acceleration)))
            arrays, _, _, shape = align_points(
                {str(number): part for number, part in parts.items()}, batch
            )
        return np.stack(
            [
                np.broadcast_to(_add_leading_axes(np.asarray(array, np.float64), len(shape)), shape)
                for array in arrays
            ]
        )


class PacketTimes:
    """Calculates the times of a sensor's packets, one batch after another.

    Attributes:
        interval: mean time between packets, ns; 0 if the spec does not determine times.
    """

    def __init__(self, sensor: Sensor, frame: str, table: CompiledTable, beams: Beams) -> None:
        self._sensor = sensor
        self._rate = sensor.simulation_of(frame).rate
        self._point = _seconds_per_point(beams)
        self._baud = next(
            (link.baud for link in (sensor.links.get("data"),) if isinstance(link, Serial)), 0
        )
        times = self.times(table, lambda: beams)
        self.interval = float(times[-1]) / (len(times) - 1)

    def times(self, table: CompiledTable, beams: Callable[[], Beams]) -> Times:
        """Return the times of the packets of a batch, since the first packet, (n,) ns.

        Args:
            beams: returns the beams of the packets; called only if they are needed.
        """
        if self._rate:
            return np.asarray(np.rint(np.arange(len(table)) * 1e9 / self._rate), np.int64)
        if self._sensor.clock:
            return self._read_clock_times(table)
        if self._point:
            steps = beams().counts * self._point * 1e9
        else:
            if self._baud:
                steps = _get_frame_sizes(table) * BITS_PER_BYTE * 1e9 / self._baud
            else:
                steps = np.zeros(len(table))
        return np.asarray(np.rint(np.concatenate([[0], np.cumsum(steps[:-1])])), np.int64)

    def _read_clock_times(self, table: CompiledTable) -> Times:
        assert self._sensor.clock is not None
        steps = np.diff(clock_ns(self._sensor, Batch(table, np.zeros(len(table), np.bool_))))
        if self._sensor.clock.wraps_at:
            turn = to_exact_ns(self._sensor.clock.wraps_at)
            steps = (steps + turn // 2) % turn - turn // 2
        times = np.concatenate([[0], np.cumsum(steps)])
        even = np.asarray(np.rint(np.linspace(0, times[-1], len(times))), np.int64)
        if bool((np.abs(even - times) <= CLOCK_TOLERANCE_NS).all()):
            return even
        return times


def _seconds_per_point(beams: Beams) -> float:
    """Return the median time between consecutive points of a packet, in seconds."""
    times = np.broadcast_to(beams.time, beams.range.shape).reshape(len(beams.range), -1)
    steps: NDArray[Any] = np.diff(times, axis=1)
    if (steps > 0).any():
        return float(np.median(steps[steps > 0]))
    return 0.0


def _get_frame_sizes(table: CompiledTable) -> NDArray[np.intp]:
    sizes = np.zeros(len(table), np.intp)
    for group in table.groups:
        sizes[group.where] = group.layout.size
    return sizes


@dataclass(frozen=True, eq=False)
class PacketBlock:
    """n consecutive packets.

    Attributes:
        times: time of each packet, and of the packet after the block, since the first packet, (n +
            1,) int64 ns.
    """

    frames: list[bytes]
    times: NDArray[np.int64]


class FrameSimulation:
    """Makes the packets of one data frame type of a sensor.

    Args:
        blocked: whether the rotor is blocked, so that the angles are the same in all frames.

    Attributes:
        interval: mean time between packets, ns; 0 if the spec does not determine times.

    Raises:
        UsageError: if the sensor declares no `sweep`.
        SpecError: if no fields that determine the ranges are found.
    """

    def __init__(self, sensor: Sensor, frame: str, *, blocked: bool = False) -> None:
        sweep = sensor.simulation_of(frame).sweep
        if sweep is None:
            raise UsageError(
                f"{sensor.id} cannot be simulated, because it declares no sweep for {frame!r}"
                " frames"
            )
        self._sensor = sensor
        self._frame = frame
        self._sweep = sweep
        self._maker = FrameMaker(sensor, frame)
        self._blocked_values = self._select_angle_values(sweep(1)) if blocked else {}
        length = len(self._maker.frame(self._call_sweep(range(1))[0]))
        swept = self._call_sweep(
            range(min(MAX_PROBED_PACKETS, max(MAX_PROBED_BYTES // length, MIN_PROBED_PACKETS)))
        )
        table = self._maker.table(swept)
        self._parts = sensor.parts_with("points", frame)
        if self._parts:
            given = [part for values in swept for part in values[self._parts.partition(".")[0]]]
        else:
            given = swept
        self._measurement = Measurement.of(
            sensor, frame, self._with_points(table), {path for values in given for path in values}
        )
        self._pace = PacketTimes(sensor, frame, table, self._find_beams(table))
        self._rest = (
            RestingImu(sensor, frame, {path for values in swept for path in values})
            if sensor.frames[frame].imu
            else None
        )
        self.interval = self._pace.interval

    @functools.cached_property
    def clock(self) -> FrameClock:
        """The clock of the frames.

        Raises:
            UsageError: if it cannot be written.
        """
        table = self._maker.table(self._call_sweep(range(CLOCK_PROBE_PACKETS)))
        return FrameClock(self._sensor, self._frame, table)

    def block(
        self,
        start: int,
        count: int,
        scene: Scene,
        since: float = 0.0,
        shake: float = 0.0,
        timeline: ClockTimeline | None = None,
    ) -> PacketBlock:
        """Return `count` packets of the sweep, beginning with number `start`.

        Args:
            since: time of the first packet, seconds since the scene began.
            shake: standard deviation of the noise on IMU measurements, m/s2 and rad/s.
            timeline: the faults of the sensor's clock; None for no faults.
        """
        numbers = range(start, start + count + EXTRA_PACKETS)
        table = self._maker.table(self._call_sweep(numbers))
        times = self._pace.times(table, functools.partial(self._find_beams, table))
        seconds = since + times / 1e9
        measured = self._with_points(table)
        if isinstance(measured, PartRows):
            self._measurement.fill(
                measured,
                [numbers[frame] for frame in measured.which],
                scene,
                seconds[measured.which],
            )
            measured.put_back()
        else:
            self._measurement.fill(table, numbers, scene, seconds)
        if self._rest is not None:
            self._rest.fill(table, shake, [start])
        if timeline is not None and not timeline.is_perfect:
            since_ns = round(since * 1e9)
            self.clock.apply(table, timeline, since_ns + times)
        return PacketBlock(self._maker.make_frames(table)[:count], times[: count + 1])

    def _with_points(self, table: CompiledTable) -> CompiledTable:
        """Return a table whose rows have points: the frames, or the parts of the frames."""
        if self._parts:
            return PartRows(table, self._parts)
        return table

    def _find_beams(self, table: CompiledTable) -> Beams:
        """Return the beams of the frames, or of the parts in the frames."""
        measured = self._with_points(table)
        beams = self._measurement.beams(measured)
        if not isinstance(measured, PartRows):
            return beams
        counts = np.bincount(measured.which, beams.counts, len(table))
        return replace(beams, counts=counts.astype(np.intp))

    def _call_sweep(self, numbers: range) -> list[Mapping[str, Any]]:
        """Return the values that the sweep gives for packets."""
        with plugin_errors(f"sweep of {self._frame}", self._sensor.id, self._sweep):
            return [{**self._sweep(number), **self._blocked_values} for number in numbers]

    def _select_angle_values(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of a frame that are constant while the rotor is blocked."""
        fields = get_codec(self._sensor.frames[self._frame]).schema.fields
        rule = self._sensor.scan
        assert rule is not None  # as of every sensor with points
        cut_by = "" if isinstance(rule, Every) else rule.name
        return {
            path: value
            for path, value in values.items()
            if path == cut_by or fields[path].unit in ("deg", "rad")
        }


class FramesWithoutPoints:
    """Makes frames without points: replies and periodic frames.

    Args:
        shake: standard deviation of the noise on IMU measurements, m/s2 and rad/s.
    """

    def __init__(self, sensor: Sensor, shake: float = 0.0) -> None:
        self._sensor = sensor
        self._shake = shake
        self._timeline = ClockTimeline(ClockFaults())
        self._clocks = dict[str, FrameClock]()
        self._makers = dict[str, FrameMaker]()
        self._rests = dict[str, RestingImu]()
        #: Frame type -> the number of the first frame of a batch, and the batch.
        self._batches = dict[str, tuple[int, list[bytes]]]()

    def use_timeline(self, timeline: ClockTimeline) -> None:
        """Set the faults of the clock for all later periodic frames."""
        self._timeline = timeline
        self._batches.clear()

    def find_clock(self, name: str) -> FrameClock:
        """Return the clock of a frame type that is sent periodically."""
        if name not in self._clocks:
            self._clocks[name] = FrameClock(self._sensor, name, self._fill(name, range(1), {}))
        return self._clocks[name]

    def make(self, name: str, values: Mapping[str, Any], now: float) -> bytes:
        """Return a frame of a type.

        Args:
            values: physical values that replace the values that the spec declares.
            now: the time of the frame, ns since power-on.
        """
        table = self._fill(name, range(1), values)
        if not self._timeline.is_perfect and find_clock(self._sensor, name) is not None:
            self.find_clock(name).apply(table, self._timeline, np.array([round(now)]))
        return self._get_maker(name).make_frames(table)[0]

    def make_frame(self, name: str, number: int) -> bytes:
        """Return frame number `number` of a type."""
        start = number - number % PERIODIC_BATCH
        if self._batches.get(name, (-1, []))[0] != start:
            batch = self._make_batch(name, range(start, start + PERIODIC_BATCH))
            self._batches[name] = start, batch
        return self._batches[name][1][number - start]

    def iter_periodic(self) -> Iterator[bytes]:
        """Yield the periodic frames without points, in the order of their times."""
        rates = find_periodic_rates(self._sensor)
        due = heapq.merge(*(_iter_due(name, rate) for name, rate in rates.items()))
        return (self.make_frame(name, number) for _, name, number in due)

    def _make_batch(self, name: str, numbers: range) -> list[bytes]:
        """Return consecutive frames of a type that is sent periodically."""
        table = self._fill(name, numbers, {})
        if not self._timeline.is_perfect:
            rate = self._sensor.frames[name].simulation.rate
            times = np.rint(np.array(numbers) * 1e9 / rate).astype(np.int64)
            self.find_clock(name).apply(table, self._timeline, times)
        return self._get_maker(name).make_frames(table)

    def _fill(self, name: str, numbers: range, values: Mapping[str, Any]) -> CompiledTable:
        """Return frames with the values that the spec declares.

        Args:
            values: physical values that replace declared values.
        """
        declared = self._sensor.frames[name]
        state = self._sensor.state.get(name, {})
        sweep = declared.simulation.sweep
        if sweep is None:
            swept: list[Mapping[str, Any]] = [{} for _ in numbers]
        else:
            with plugin_errors(f"sweep of {name}", self._sensor.id, sweep):
                swept = [sweep(number) for number in numbers]
        given = [{**state, **own, **values} for own in swept]
        table = self._get_maker(name).table(given)
        if declared.imu is not None:
            rest = self._rests.setdefault(name, RestingImu(self._sensor, name, given[0]))
            rest.fill(table, self._shake, [numbers.start])
        return table

    def _get_maker(self, name: str) -> FrameMaker:
        if name not in self._makers:
            self._makers[name] = FrameMaker(self._sensor, name)
        return self._makers[name]


def find_periodic_rates(sensor: Sensor) -> dict[str, float]:
    """Return {type: rate in Hz} of the periodic frames without points."""
    return {
        name: frame.simulation.rate
        for name, frame in sensor.incoming.items()
        if frame.simulation.rate and not frame.data
    }


def _iter_due(name: str, rate: float) -> Iterator[tuple[float, str, int]]:
    """Yield (time in seconds, type, number) for each frame of a type, without end."""
    return ((number / rate, name, number) for number in itertools.count())


@functools.lru_cache(maxsize=64)
def frame_simulation(sensor: Sensor, frame: str, *, blocked: bool = False) -> FrameSimulation:
    """Return the `FrameSimulation` of a data frame type, which is made only once."""
    return FrameSimulation(sensor, frame, blocked=blocked)


def simulate(
    sensor: Sensor,
    packets: int = 100,
    *,
    start: int = 0,
    scene: Scene | None = None,
    clock: ClockFaults | None = None,
) -> list[bytes]:
    """Return the data frames that a sensor sends in a scene, in order.

    For a sensor without points, returns the frames that it sends periodically.

    Args:
        packets: number of frames.
        start: number of the first frame; frame 0 is sent when the sensor is switched on.
        scene: the scene to measure, for example from `read_scene`; by default a room.
        clock: the faults of the sensor's clock. If the clock follows a time scale, the sensor is
            switched on at the start of 1970.

    Raises:
        UsageError: if the sensor declares no `sweep`, if a sensor without points declares no
            `rate`, or if its frames cannot show the faults of the clock.
        SpecError: if no fields that determine the ranges are found.
    """
    timeline = ClockTimeline(clock or ClockFaults())
    check_clock_faults(sensor, timeline.faults)
    if not sensor.has_points:
        makers = FramesWithoutPoints(sensor)
        makers.use_timeline(timeline)
        frames = list(itertools.islice(makers.iter_periodic(), start, start + packets))
        if not frames and packets:
            raise UsageError(
                f"{sensor.id} sends no frames periodically, because no frame type declares a `rate`"
            )
        return frames
    stream = frame_simulation(sensor, sensor.data_frame)
    since = start * stream.interval / 1e9
    return stream.block(start, packets, scene or Room(), since, timeline=timeline).frames


def check_clock_faults(sensor: Sensor, faults: ClockFaults) -> None:
    """Raise UsageError if a simulated sensor cannot show faults of its clock."""
    if not faults:
        return
    others = FramesWithoutPoints(sensor)
    periodic = find_periodic_rates(sensor)
    main = _find_main_clock(sensor, others)
    if main is None:
        raise UsageError(
            f"{sensor.id} sends no frames with a clock, so the clock cannot have faults"
        )
    if sensor.has_points:
        main[1].check(faults)
    if not faults.unlocked:
        return
    status_frames = list(find_status_clocks(sensor))
    if not status_frames:
        raise UsageError(
            f"{sensor.id} does not declare the status of its clock, so the clock cannot lose its"
            " lock"
        )
    if sensor.has_points and sensor.data_frame in status_frames:
        frame_simulation(sensor, sensor.data_frame).clock.check_status()
        return
    sent = [name for name in status_frames if name in periodic]
    if not sent:
        raise UsageError(
            f"the clock of {sensor.id} cannot lose its lock, because the status of the clock is in"
            f" {status_frames[0]!r} frames, which the simulated sensor does not send"
        )
    others.find_clock(sent[0]).check_status()


@functools.lru_cache(maxsize=64)
def find_followed_scale(sensor: Sensor) -> str:
    """Return the time scale that the clock of a simulated sensor follows.

    Returns:
        "utc", "tai" or "gps"; "" if the clock is not synchronized, or if no date can be written
        into the clock.
    """
    others = FramesWithoutPoints(sensor)
    try:
        main = _find_main_clock(sensor, others)
    except UsageError:  # the clock cannot be written
        return ""
    if main is None:
        return ""
    name, written = main
    clock = find_clock(sensor, name)
    if clock is None or not written.can_follow_dates:
        return ""
    if clock.status is None:
        return _find_scale(clock.epoch)
    status_frame = clock.status.frame or name
    if status_frame != name:
        if status_frame not in find_periodic_rates(sensor):
            return ""
        written = others.find_clock(status_frame)
    state = written.read_state(clock.status)
    if state.locked is False:
        return ""
    return _find_scale(clock.epoch_in(state))


def _find_main_clock(sensor: Sensor, others: FramesWithoutPoints) -> tuple[str, FrameClock] | None:
    """Return the frame type with the sensor's clock, and its clock, or None.

    Raises:
        UsageError: if the clock of the data frame cannot be written.
    """
    if sensor.has_points:
        return sensor.data_frame, frame_simulation(sensor, sensor.data_frame).clock
    for name in find_periodic_rates(sensor):
        if others.find_clock(name).has_clock:
            return name, others.find_clock(name)
    return None


def _find_scale(epoch: str) -> str:
    """Return the time scale of a clock's epoch; "" if the epoch has none."""
    if epoch == "hour":
        return "utc"
    if epoch in DATED_EPOCHS:
        return epoch
    return ""


def make_opening_frame(sensor: Sensor) -> bytes:
    """Return the frame that must precede the data frames, or b""."""
    after = sensor.frames[sensor.data_frame].after
    if after is None:
        return b""
    return example(sensor, after)
