"""Checks of a sensor's points that are possible without its manual.

Four kinds of frames are used: random examples, packets of the sensor's sweep, frames with a changed
angle, and packets that are simulated in a room. The sweep is `Simulation.sweep`, a function of the
packet number that returns the angles, the counters and the time of a simulated packet.

The measured values are reported (`SensorUnderTest.picture`), so that the author can compare them
with the manual.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import random
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import LidarSpecError, SpecError, UsageError
from lidarspec.expressions.columns import Fields, align, make_value_mask
from lidarspec.expressions.graph import Node, make_sample, trace, traverse
from lidarspec.frames.frame_table import CompiledTable
from lidarspec.framing.example_frames import make_random_header, random_frame
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.packets.masked_sector import FULL_TURNS
from lidarspec.packets.packet_type import find_clock
from lidarspec.packets.packets import Packets
from lidarspec.points.cloud import PointCloud
from lidarspec.points.conventions import axis_matrix
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.scans.scan_ends import EndFinder
from lidarspec.simulation.frame_maker import FrameMaker
from lidarspec.simulation.scenes import Room, make_room
from lidarspec.simulation.simulator import frame_simulation
from lidarspec.spec import OnWrap, Polar
from lidarspec.spec.fields import factor
from lidarspec.spec.tree import FieldInfo
from lidarspec.spec.vocabulary import TableLookup
from lidarspec.testing import sensor_under_test as material
from lidarspec.testing.cloud_assertions import assert_well_formed
from lidarspec.testing.findings import ViolationError, require
from lidarspec.testing.frames import build_if_valid
from lidarspec.testing.sensor_under_test import SensorUnderTest

#: Number of packets of the `sweep` for the check of directions.
SWEEP_PACKETS = 400
#: Number of packets in a simulated room: for short frames, and for frames longer than
#: `LONG_FRAME_BYTES`.
SCENE_PACKETS = 200
LONG_SCENE_PACKETS = 50
LONG_FRAME_BYTES = 1500
#: Maximum total bytes of packets of the `sweep`, of packets for the check of counters (so many that
#: counters wrap), and of packets in the room.
MAX_SWEEP_BYTES = 1 << 22
MAX_COUNTER_BYTES = 1 << 24
MAX_SCENE_BYTES = 1 << 21
#: Minimum number of packets, even if they exceed the maximum total bytes.
MIN_PACKETS = 8
#: If an azimuth of the `sweep` is larger than this value in radians, it must be in degrees.
MAX_SWEEP_AZIMUTH_RAD = 4 * np.pi
#: If an azimuth of a random frame is larger than this value in radians, it must be in degrees.
MAX_RANDOM_AZIMUTH_RAD = 15 * np.pi
#: Minimum share of the steps of the azimuth that must be in the same direction.
MIN_ONE_WAY_SHARE = 0.8
#: Maximum step of the azimuth against the direction of rotation, in radians.
MAX_BACK_STEP_RAD = np.deg2rad(1.5)
#: The same limit as a multiple of the median step. The larger of both limits applies.
MAX_BACK_STEP_MEDIANS = 4
#: Number of raw units by which an angle is changed to test whether the points turn with it.
ANGLE_CHANGE_STEPS = 4
#: Default number of examples that are tried until one has points.
TRIED_EXAMPLES = 8
#: A sensor is treated as rotating if the median step of its azimuth, in radians, is larger than
#: this.
MIN_ROTATION_STEP_RAD = 1e-5
#: A unit vector with at least this component along an axis is treated as the direction of that
#: axis.
MIN_AXIS_COMPONENT = 0.9
#: Rounding error of a point in float32, in metres.
FLOAT32_ERROR_M = 2e-6
#: Minimum tolerance of a distance in metres. It is needed because the resolution may be worse than
#: the scale of the field.
MIN_HALF_STEP_M = 0.004


def make_sweep(
    subject: SensorUnderTest, name: str, packets: int, total: int = MAX_SWEEP_BYTES
) -> list[bytes]:
    """Return simulated packets with the values of the sensor's sweep, from packet 0.

    Returns an empty list if there is no sweep or the frame type is not compiled.

    Args:
        packets: maximum number of packets.
        total: maximum total size of the packets, in bytes.
    """
    sweep = subject.sensor.simulation_of(name).sweep
    if sweep is None:
        return []
    made = subject.swept.setdefault(name, [])
    try:
        maker = FrameMaker(subject.sensor, name)
        if not made:
            made.append(maker.frame(sweep(0)))
        packets = min(packets, max(total // len(made[0]), MIN_PACKETS))
        if len(made) < packets:
            made += maker.make_frames(
                maker.table([sweep(number) for number in range(len(made), packets)])
            )
    except LidarSpecError:
        return []
    return made[:packets]


def decode_frames(
    subject: SensorUnderTest, name: str, frames: list[bytes], *, by_clock: bool = True
) -> Packets:
    """Decode frames of one type.

    Args:
        by_clock: whether the times of packets are those of the sensor's clock; False to ignore the
            clock, so that it cannot compensate for errors of the packet counter.
    """
    if by_clock:
        sensor = subject.sensor
    else:
        sensor = dataclasses.replace(subject.sensor, clock=None)
    if sensor.frames[name].data and len(sensor.data_frames) > 1:
        sensor = sensor.configure(answer=name)
    return sensor.decode(frames if sensor.datagrams else b"".join(frames), name)


def trace_points(subject: SensorUnderTest, name: str) -> Any:
    """Call `points` with columns that record their use, and return its result.

    Returns None if the frame type is not compiled.

    Raises:
        UntraceableError: if `points` cannot be traced, with the reason.
    """
    if name not in subject.traced:
        subject.traced[name] = _trace_points(subject, name)
    return subject.traced[name]


def _trace_points(subject: SensorUnderTest, name: str) -> Any:
    few = [
        subject.example(name, seed=seed)
        for seed in (range(8) if subject.sensor.parts_with("points", name) else (0,))
    ]
    packets = decode_frames(subject, name, few * subject.sensor.frames[name].confirm).with_points
    if not isinstance(packets.table, CompiledTable) or not packets.table.groups:
        return None
    return trace(
        subject.sensor.points_of(packets.frame),
        make_sample(packets.batch(), packets.table.groups[0]),
    )[0]


def find_source_nodes(*values: Any, include_indices: bool = True) -> list[Node]:
    """Return the nodes of the fields from which traced values are calculated.

    Args:
        include_indices: whether to include fields that are only used as indices of a table.
    """
    nodes = traverse(
        *values, into=lambda node: include_indices or not isinstance(node.function, TableLookup)
    )
    return [node for node in nodes if node.kind in ("field", "state")]


def find_field_of_node(subject: SensorUnderTest, name: str, node: Node) -> FieldInfo | None:
    """Return the field that a traced node reads; None if it reads no field."""
    if node.path.startswith("frame.") and node.kind == "state":
        return subject.fields(name).get(node.path.removeprefix("frame."))
    if node.kind == "state":
        _, frame, path = node.path.split(".", 2)
        return subject.fields(frame).get(path)
    parts = subject.sensor.parts_with("points", name)
    return get_codec(subject.sensor.frames[name]).schema.scan_names.get(
        f"{parts}.{node.path}" if parts else node.path
    )


def calculate_directions(
    subject: SensorUnderTest, name: str, packets: Packets
) -> list[NDArray[np.float64]] | None:
    """Return the azimuths and elevations of packets as `points` calculates them.

    Azimuths may exceed a full circle. Returns None if `points` returns Cartesian coordinates and
    the simulation declares no directions.
    """
    packets = packets.with_points
    batch = packets.batch()
    with np.errstate(all="ignore"):
        polar = subject.sensor.points_of(packets.frame)(Fields(batch))
        if not isinstance(polar, Polar):
            return _declared_directions(subject, name)
        arrays, axes, _ = align((polar.azimuth, polar.elevation, polar.range), batch)
    shape = np.broadcast_shapes(
        (len(packets), *(1,) * len(axes)), *(array.shape for array in arrays)
    )
    mask = make_value_mask(axes, shape, batch)
    whole = [
        np.broadcast_to(np.asarray(array, np.float64), shape).reshape(
            shape[0], math.prod(shape[1:])
        )
        for array in arrays[:2]
    ]
    if mask is None:
        return whole
    return [angles[mask] for angles in whole]


def _declared_directions(subject: SensorUnderTest, name: str) -> list[NDArray[np.float64]] | None:
    """Return the azimuths and the elevations that the spec declares for simulated frames.

    Returns None if the spec declares no directions.
    """
    declared = subject.sensor.simulation_of(name).directions
    if declared is None:
        return None
    pairs = [declared(number) for number in range(64)]
    return [
        np.concatenate([np.ravel(pair[which]) for pair in pairs]).astype(np.float64)
        for which in (0, 1)
    ]


def clouds_keep_the_conventions(subject: SensorUnderTest, name: str) -> None:
    """Check that clouds keep the conventions, and that `points` raises no error."""
    frames = [subject.example(name, seed=seed) for seed in range(max(len(subject.seeds(name)), 2))]
    try:
        packets = decode_frames(subject, name, frames)
        cloud = packets.points()
    except SpecError as error:
        raise ViolationError(error.rule or "LS414", error.reason, f"{name}.points") from error
    require(not packets.stats.plugin_errors, "LS414", str(packets.stats.failure("")), name)
    try:
        assert_well_formed(cloud)
    except AssertionError as error:
        raise ViolationError("LS501", str(error).splitlines()[0], f"{name}.points") from error


def directions_are_radians(subject: SensorUnderTest, name: str) -> None:
    """Check that no direction is so large that it must be in degrees."""
    along = make_sweep(subject, name, 64)
    if not along and any(info.kind == "float" for info in subject.fields(name).values()):
        return  # a float may have any value
    frames = along or [subject.example(name, seed=seed) for seed in range(16)]
    angles = calculate_directions(subject, name, decode_frames(subject, name, frames))
    if angles is None:
        return
    azimuth, elevation = (float(np.nanmax(np.abs(part), initial=0)) for part in angles)
    where = f"{name}.{'directions' if subject.sensor.simulation_of(name).directions else 'points'}"
    require(
        azimuth <= (MAX_SWEEP_AZIMUTH_RAD if along else MAX_RANDOM_AZIMUTH_RAD),
        "LS502",
        f"an azimuth of {azimuth:.4g} rad is too large",
        where,
    )
    require(
        not along or elevation <= np.pi / 2 + 1e-6,
        "LS502",
        f"an elevation of {elevation:.4g} rad is too large",
        where,
    )


def a_single_point_has_a_direction(subject: SensorUnderTest, name: str) -> None:
    """Check that the point of a frame with a single point has a valid direction."""
    engine = get_codec(subject.sensor.frames[name])
    source = random.Random(subject.sensor.id)
    if not isinstance(engine, CompiledCodec) or engine.schema.has_measured_sizes:
        return
    counts = [
        path
        for path in make_random_header(engine, source)[1]
        if engine.schema.fields[path].const is None
    ]
    for path in counts:
        try:
            single = random_frame(
                subject.sensor, name, source, {**subject.drawers(name), path: lambda _: 1}
            )
        except SpecError:
            continue
        try:
            cloud = decode_frames(
                subject, name, [single] * max(3, subject.sensor.frames[name].confirm)
            ).points()
        except SpecError as error:
            raise ViolationError(
                "LS503", f"in a frame with {path} = 1: {error.reason}", f"{name}.{path}"
            ) from error
        if not len(cloud) or not np.isnan(cloud.azimuth).all():
            continue
        examples = decode_frames(
            subject, name, [subject.example(name, seed=seed) for seed in range(12)]
        ).points()
        require(
            np.isnan(examples.azimuth).all(),
            "LS503",
            f"all azimuths of a frame with {path} = 1 are NaN",
            f"{name}.{path}",
        )


def the_full_circle_equals_zero(subject: SensorUnderTest, name: str) -> None:
    """Check that an angle of exactly 360 degrees gives the same points as 0."""
    for path, info in _find_point_angles(subject, name).items():
        full = _find_full_circle(info)
        if full is None:
            continue
        try:
            # The full circle is set first, because few frames can represent it.
            clouds = _decode_with_values(
                subject, name, path, (full[1], full[0], full[0] + ANGLE_CHANGE_STEPS)
            )
        except SpecError as error:
            raise ViolationError(
                "LS505",
                f"{path} of {FULL_TURNS[info.unit]:g} {info.unit}: {error.reason}",
                f"{name}.{path}",
            ) from error
        if not clouds or not _find_turn_sense(info, clouds[1], clouds[2]):
            continue
        circle, nought, _ = clouds
        apart = np.nanmax(
            np.abs(nought.xyz - circle.xyz) / (1 + np.abs(nought.range))[:, None], initial=0
        )
        same = np.array_equal(nought.valid, circle.valid) and apart < 1e-3
        require(
            same,
            "LS505",
            f"{path} = {FULL_TURNS[info.unit]:g} {info.unit} and {path} = 0 give different points",
            f"{name}.{path}",
        )


def the_points_turn_as_the_axes_do(subject: SensorUnderTest, name: str) -> None:
    """Check that points turn in the direction that the vendor's axes declare."""
    for path, info in _find_point_angles(subject, name).items():
        zero = _find_zero(info)
        if zero is None:
            clouds = []
        else:
            clouds = _decode_with_values(subject, name, path, (zero, zero + ANGLE_CHANGE_STEPS))
        sense = _find_turn_sense(info, *clouds) if clouds else 0
        if not sense:
            continue
        first = float(clouds[0].azimuth[np.isfinite(clouds[0].azimuth)][0])
        words = {1: "counter-clockwise", -1: "clockwise"}
        subject.picture[f"{name}: sense"] = f"{words[sense]} as {path} grows, seen from above"
        subject.picture[f"{name}: first beam"] = (
            f"at azimuth {np.rad2deg(first) + 0:.1f} deg if {path} is 0 (0 is ahead, 90 is left)"
        )
        axes = subject.sensor.vendor_axes
        expected = _find_axis_sense(axes, first) if axes else 0
        message = (
            f"if {path} increases, the points turn {words[sense]}; with vendor_axes"
            f" {', '.join(axes or ())}, they must turn {words.get(expected)}"
        )
        # Golden vectors with points in two quadrants are better evidence than the axes.
        is_proven = name in subject.frames_with_two_quadrants
        require(is_proven or expected in (0, sense), "LS511", message, f"{name}.points")
        return


def _find_axis_sense(axes: tuple[str, str, str], zero: float) -> int:
    """Return the direction in which the vendor's angles increase.

    Args:
        axes: the directions of the vendor's x, y and z.
        zero: the azimuth at which the vendor's angle is 0, in radians.

    Returns:
        1 for counter-clockwise, -1 for clockwise, 0 if unknown.
    """
    x, y, _ = axis_matrix(axes)
    along = np.abs([x, y]) @ [np.cos(zero), np.sin(zero), 0]
    turning = round(float(np.cross(x, y)[2]))
    if max(along) < MIN_AXIS_COMPONENT:
        return 0
    if along[0] > along[1]:
        return turning
    return -turning


def angles_are_in_order(subject: SensorUnderTest, name: str) -> None:
    """Check that the azimuths of each ring turn in one direction during the sweep."""
    frames = make_sweep(
        subject,
        name,
        SWEEP_PACKETS
        if subject.sensor.frames[name].max_length <= material.MAX_SHORT_BYTES
        else SWEEP_PACKETS // 4,
    )
    if not frames:
        return
    packets = decode_frames(subject, name, frames).with_points
    evaluated = evaluate_plainly(packets)
    if evaluated.counts.ndim > 1:
        counts = evaluated.counts.reshape(len(evaluated.counts), -1).sum(axis=1)
    else:
        counts = evaluated.counts
    cloud = evaluated.cloud
    packet = np.repeat(np.arange(evaluated.ready), counts)
    rings = cloud.ring if cloud.ring is not None else np.zeros(len(cloud))
    is_cut_by_wrap = isinstance(subject.sensor.scan, OnWrap)
    scan_ends = []
    if not is_cut_by_wrap:
        scan_ends = [end.point for end in EndFinder(subject.sensor).find(packets, evaluated)]
    scan = np.searchsorted(scan_ends, np.arange(len(cloud)), "right")
    for ring in np.unique(rings)[:4]:
        selected = (rings == ring) & np.isfinite(cloud.azimuth)
        angle = cloud.azimuth[selected].astype(np.float64)
        number = packet[selected]
        steps = (np.diff(angle) + np.pi) % (2 * np.pi) - np.pi
        moving = np.abs(steps) > 1e-9
        if moving.sum() < 8:
            continue
        median = float(np.median(steps[moving]))
        turning = "counter-clockwise" if median > 0 else "clockwise"
        if abs(median) > MIN_ROTATION_STEP_RAD:
            subject.picture.setdefault(
                f"{name}: step",
                f"{abs(np.rad2deg(median)):.3g} deg {turning} from one simulated point to the next",
            )
        one_way = float((np.sign(steps[moving]) == np.sign(median)).mean())
        if one_way < MIN_ONE_WAY_SHARE:
            message = (
                f"only {one_way:.0%} of the steps of the azimuth have the same direction, but a"
                " scan ends where the azimuth wraps"
            )
            require(not is_cut_by_wrap, "LS506", message, f"{name}.points")
            continue
        largest_back_step = max(MAX_BACK_STEP_RAD, MAX_BACK_STEP_MEDIANS * abs(median))
        is_back = steps * np.sign(median) < -largest_back_step
        is_back &= np.diff(scan[selected]) == 0
        if not is_cut_by_wrap and _have_equal_packets(angle, number):
            is_back &= np.diff(number) > 0  # each packet may contain several rows of an image
        if is_back.any():
            index = int(np.flatnonzero(is_back)[0])
            before, after = np.rad2deg(angle[index : index + 2])
            message = (
                f"the azimuth steps back from {before:.1f} to {after:.1f} degrees in packet"
                f" {number[index + 1]} of the sweep"
            )
            raise ViolationError(
                "LS504" if number[index] == number[index + 1] else "LS506",
                message,
                f"{name}.points",
            )


def _have_equal_packets(angles: NDArray[np.float64], packets: NDArray[np.intp]) -> bool:
    """Return whether all packets have the same angles.

    Args:
        angles: the angle of each point, (n,).
        packets: the index of the packet of each point, ascending, (n,).
    """
    first, *others = np.split(angles, np.flatnonzero(np.diff(packets)) + 1)
    return all(np.array_equal(first, other) for other in others)


def counters_run_on(subject: SensorUnderTest, name: str) -> None:
    """Check that neither the counter nor the clock goes back in packets of the sweep."""
    is_data = subject.sensor.frames[name].data
    if is_data and name != subject.sensor.data_frame:
        return
    frames = make_sweep(
        subject,
        name,
        700 if subject.sensor.frames[name].max_length <= LONG_FRAME_BYTES else 260,
        MAX_COUNTER_BYTES,
    )
    if not frames:
        return
    packets = decode_frames(subject, name, frames)
    if subject.sensor.sequence is not None and is_data:
        # The clock would compensate for the counter.
        stats = decode_frames(subject, name, frames, by_clock=False).stats
        message = (
            f"{stats.lost} packets of the sweep count as lost, {stats.late} as late, and"
            f" {stats.duplicates} as duplicates"
        )
        require(
            (stats.lost, stats.late, stats.duplicates) == (0, 0, 0),
            "LS510",
            message,
            f"{name}.{subject.sensor.sequence.field}",
        )
    if find_clock(subject.sensor, name) is not None and len(packets) > 1:
        back = np.diff(packets.time_ns)
        index = int(back.argmin())
        require(
            back.min() >= 0,
            "LS509",
            f"packet {index + 1} of the sweep is {-back.min() / 1e9:g} s earlier than packet"
            f" {index}",
            name,
        )


def _find_zero(info: FieldInfo) -> int | None:
    """Return the raw value nearest to the angle 0; None if the field cannot have it."""
    if (
        info.kind != "int"
        or info.const is not None
        or info.unit not in FULL_TURNS
        or not info.scale
    ):
        return None
    raw = round(-info.offset / info.scale)
    if info.limits[0] <= raw <= info.limits[1] - ANGLE_CHANGE_STEPS:
        return raw
    return None


def _find_point_angles(subject: SensorUnderTest, name: str) -> dict[str, FieldInfo]:
    """Return the angle fields of a frame type that may turn its points, by path."""
    angles = {path: info for path, info in subject.fields(name).items() if info.unit in FULL_TURNS}
    try:
        result = trace_points(subject, name)
    except Exception:  # another property reports the failure
        return angles
    if result is None:
        return angles
    nodes = find_source_nodes(*vars(result).values())
    sources = {
        info.path for info in (find_field_of_node(subject, name, node) for node in nodes) if info
    }
    return {path: info for path, info in angles.items() if info.optional or path in sources}


def _find_full_circle(info: FieldInfo) -> tuple[int, int] | None:
    """Return the raw values of the angle 0 and of the full circle.

    Returns None if the field cannot represent both angles exactly.
    """
    zero = _find_zero(info)
    if zero is not None:
        circle = (FULL_TURNS[info.unit] - info.offset) / info.scale
    else:
        circle = math.nan
    whole = (
        zero is not None
        and abs(circle - round(circle)) < 1e-6
        and round(circle) <= info.limits[1]
        and not info.physical(zero)
    )
    if zero is not None and whole:
        return (zero, round(circle))
    return None


def _decode_with_values(
    subject: SensorUnderTest, name: str, path: str, values: tuple[int, ...]
) -> list[PointCloud]:
    """Decode an example with each of several values of a field; return the points."""
    for seed in range(1, 1 + subject.scale_rounds(TRIED_EXAMPLES, least=4)):
        parsed = subject.sensor.parse(subject.example(name, seed=seed), frame=name)
        if all(own != path for _, _, own in material.iter_integers(parsed)):
            continue
        frames = list(
            itertools.takewhile(
                bool, (_set_value(subject, name, path, value, parsed) for value in values)
            )
        )
        if len(frames) < len(values):
            continue
        packets = [
            decode_frames(subject, name, [frame] * max(2, subject.sensor.frames[name].confirm))
            for frame in frames
        ]
        clouds = [each.points() for each in packets if len(each)]
        if (
            len(clouds) == len(values)
            and len(clouds[0])
            and len({len(cloud) for cloud in clouds}) == 1
        ):
            return clouds
    return []


def _find_turn_sense(info: FieldInfo, nought: PointCloud, turned: PointCloud) -> int:
    """Return the direction in which points turn if the value of a field increases.

    Args:
        nought: the points if the angle is 0.
        turned: the points if the raw value is higher by `ANGLE_CHANGE_STEPS`.

    Returns:
        1 for counter-clockwise, -1 for clockwise, 0 if the points do not turn.
    """
    moved = (turned.azimuth - nought.azimuth + np.pi) % (2 * np.pi) - np.pi
    most = float(max(moved[np.isfinite(moved)], key=abs, default=0)) / (
        ANGLE_CHANGE_STEPS * info.scale * 2 * np.pi / FULL_TURNS[info.unit]
    )
    if 0.5 < abs(most) < 1.5:
        return int(np.sign(most))
    return 0


def _set_value(subject: SensorUnderTest, name: str, path: str, value: int, parsed: Any) -> bytes:
    """Set a field in `parsed`; return the frame, or b"" if the frame is invalid."""
    for holder, key, own in list(material.iter_integers(parsed)):
        if own == path:
            holder[key] = value
    built = build_if_valid(subject, name, parsed) or b""
    with contextlib.suppress(LidarSpecError):
        subject.sensor.parse(built, frame=name)
        return built
    return b""


def distance_outside(room: Room, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of each point from the nearest surface of a room, in metres.

    Args:
        xyz: the coordinates of the points in metres, (n, 3).
    """
    distances = np.full(len(xyz), np.inf)
    for body in (room.walls, *room.boxes):
        if body is None:
            continue
        middle = (np.array(body.low) + body.high) / 2
        beyond = np.abs(xyz - middle) - (np.array(body.high) - body.low) / 2
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        distances = np.minimum(distances, np.abs(outside + np.minimum(beyond.max(axis=1), 0)))
    return distances


def find_half_step(subject: SensorUnderTest, name: str) -> float:
    """Return the largest rounding error of a length field of a frame, in metres.

    The error is half of the largest scale of these fields, but at least `MIN_HALF_STEP_M`.
    """
    fields = subject.fields(name).values()
    metres = [
        abs(info.scale) * float(factor(info.unit, "m") or 0)
        for info in fields
        if factor(info.unit, "m") is not None
    ]
    return max(MIN_HALF_STEP_M, max(metres, default=0.0) / 2)


def a_simulated_scene_comes_back(subject: SensorUnderTest, name: str) -> None:
    """Check that packets simulated in a room are decoded to points on its surfaces."""
    room = make_room(len(subject.sensor.id))
    room = Room(room.walls, room.boxes)
    is_long = subject.sensor.frames[name].max_length > LONG_FRAME_BYTES
    try:
        made = frame_simulation(subject.sensor, name)
        length = len(made.block(0, 1, room).frames[0])
        packets = min(
            LONG_SCENE_PACKETS if is_long else SCENE_PACKETS,
            max(MAX_SCENE_BYTES // length, MIN_PACKETS),
        )
        block = made.block(5, packets, room)
    except UsageError:
        return
    except LidarSpecError as error:
        raise ViolationError("LS508", str(error), f"{name}.sweep") from error
    cloud = decode_frames(subject, name, block.frames).points()
    seconds = float(block.times[-1]) / 1e9
    if seconds:
        rate = len(cloud) / seconds
        subject.picture[f"{name}: rate"] = f"{rate:.0f} points per second, simulated"
    else:
        subject.picture[f"{name}: rate"] = "unknown"
    # The directions of the last packet may depend on the packet that follows.
    count = len(cloud) - 2 * len(cloud) // len(block.frames)
    valid = cloud.valid[:count]
    share = float(valid.mean()) if count else 0.0
    require(
        share > 0.5,
        "LS507",
        f"only {share:.0%} of the beams have a return, although the scene is a closed room",
        f"{name}.points",
    )
    apart = distance_outside(room, cloud.xyz[:count][valid].astype(np.float64))
    worst = float(apart.max(initial=0))
    if subject.sensor.simulation_of(name).directions:
        each = np.sqrt(3)
    else:
        each = 1  # each coordinate is rounded separately
    near_enough = worst < find_half_step(subject, name) * each + FLOAT32_ERROR_M
    require(
        near_enough,
        "LS507",
        f"a simulated point is {worst:.4f} m from the nearest surface of the simulated scene",
        f"{name}.points",
    )
    assert subject.sensor.range_limits is not None  # every sensor with points has them
    near, far = subject.sensor.range_limits
    ranges = cloud.range[:count][valid]
    inside = not len(ranges) or (
        ranges.min() >= near - MIN_HALF_STEP_M and ranges.max() <= far + MIN_HALF_STEP_M
    )
    require(
        inside,
        "LS507",
        f"the ranges of simulated points are {ranges.min() if len(ranges) else 0:.3f} to"
        f" {ranges.max() if len(ranges) else 0:.3f} m, outside of range_limits",
        name,
    )
