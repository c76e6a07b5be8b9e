"""Tests that simulated sensors measure the scene."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from construct import Array, Int8ub, Int16sl, Struct, this
from numpy.typing import NDArray

import lidarspec as ls
from lidarspec import Sensor, SourceError, SpecError, UsageError, simulate
from lidarspec.errors import PluginError
from lidarspec.simulation.device import SECOND, SimulatedDevice
from lidarspec.simulation.scenes import Box, Mover, Room, make_room, parse_scene, read_scene
from lidarspec.simulation.simulator import FramesWithoutPoints, frame_simulation
from lidarspec.spec import Cartesian, Frame, Polar, Scaled, Serial, Simulation, Udp, stack
from lidarspec.testing.geometry import distance_outside
from tests.broken import periodic_sweep_of_nothing
from tests.engine import against_construct
from tests.representatives import REPRESENTATIVES
from tests.shapes import coordinates, count, sized

#: metres by which a point may be off its surface: half a step of the range, and float32.
EXACT = 2e-6
#: half of the widest step of each kind of data frame, metres, where it is not in the unit of a
#: field.
STEPS = {"ultra": 0.004, "ultra_dense": 0.0015}
#: metres of one step where the header says the unit.
BY_HEADER = 0.004
#: metres that twelve bits of millimetres come to: what is farther is no return.
REACH = {"short": 4.095, "one_short": 4.095}


#: 40 samples a packet, and nothing that says when they are sent.
SHAPE = count.SENSOR


def take_coordinates(cloud: ls.PointCloud, packets: int) -> NDArray[np.float64]:
    """Return the coordinates of the valid points without those of the last packets.

    Their directions may depend on the next packet.
    """
    xyz = np.stack([cloud.x, cloud.y, cloud.z], axis=1)[: len(cloud) - 2 * len(cloud) // packets]
    return xyz[cloud.valid[: len(xyz)]].astype(np.float64)


def find_half_step(sensor: Sensor, frame: str) -> float:
    """Return the largest error of a point that rounding its range can cause, m.

    It is half a step of the coarsest range field. If `points` returns coordinates, which are
    rounded one by one, it is half the diagonal of a cube with edges of one step.
    """
    if frame in STEPS:
        return STEPS[frame]
    fields = (
        ls.sensor(sensor.id)
        .decode(b"" if not sensor.datagrams else [], frame)
        .table.schema.fields.values()
    )
    metres = [info.scale for info in fields if info.unit == "m" and info.axes] or [
        info.scale for info in fields if info.unit == "m"
    ]
    corner = np.sqrt(3) if sensor.simulation_of(frame).directions else 1
    return float(max(metres, default=BY_HEADER) / 2 * corner)


def run_device(sensor: Sensor, seconds: float, room: Room) -> tuple[list[bytes], SimulatedDevice]:
    """Open a simulated device; return its messages in `seconds` of its time, and the device."""
    device = SimulatedDevice(sensor, scene=room)
    device.start(0)
    out: list[bytes] = []
    answer = sensor.options.get("answer")
    opening = [name for name in sensor.on_open if sensor.commands[name].frame]
    for name in opening if answer in (None, "node") else []:
        device.receive(sensor.command(name), 0, sensor.commands[name].link)
    for now in range(0, int(seconds * SECOND), SECOND // 50):
        out += [data for _, data in device.outgoing(now)]
    return out, device


def _find_hits(
    sensor: Sensor, frame: str, cloud: ls.PointCloud, room: Room, numbers: range
) -> NDArray[np.bool_]:
    """Return which beams hit something in the sensor's range, with a margin of 0.1 m."""
    low, high = sensor.range_limits or (0.0, np.inf)
    azimuth, elevation = cloud.azimuth.astype(float), cloud.elevation.astype(float)
    # A point without a return has no coordinates.
    if (directions := sensor.simulation_of(frame).directions) is not None:
        pairs = [
            np.stack(np.broadcast_arrays(*directions(number))).reshape(2, -1) for number in numbers
        ]
        declared = np.concatenate(pairs, axis=1)
        azimuth, elevation = np.repeat(declared, len(cloud) // declared.shape[1], axis=1)
    ranges = room.measure(azimuth, elevation)
    return np.asarray((ranges > low + 0.1) & (ranges < min(high, REACH.get(frame, high)) - 0.1))


def furnished_room(seed: int) -> Room:
    """Return a room in which nothing moves."""
    room = make_room(seed)
    return Room(room.walls, room.boxes)


def assert_scene_comes_back(sensor: Sensor, frame: str, room: Room, *, number: int) -> None:
    """Simulate data frames of a sensor and find its points on the surfaces of the room."""
    if len(sensor.data_frames) > 1:
        sensor = sensor.configure(answer=frame)
    frames = simulate(sensor, number, start=5, scene=room)
    cloud = sensor.decode(frames if sensor.datagrams else b"".join(frames)).points()
    seen = _find_hits(sensor, frame, cloud, room, range(5, 5 + number))
    assert cloud.valid[seen].mean() > 0.98
    assert (
        distance_outside(room, take_coordinates(cloud, len(frames))).max()
        < find_half_step(sensor, frame) + EXACT
    )


@pytest.mark.parametrize("name", REPRESENTATIVES)
def test_simulated_points_lie_on_the_scene_within_a_step_of_the_format(name: str) -> None:
    sensor = ls.sensor(name)
    assert sensor.data_frame is not None
    number = 40 if sensor.datagrams else 300
    assert_scene_comes_back(sensor, sensor.data_frame, furnished_room(len(name)), number=number)


@pytest.mark.slow
@pytest.mark.parametrize("name", REPRESENTATIVES)
def test_every_kind_of_data_frame_of_a_sensor_gives_the_scene_back(name: str) -> None:
    sensor = ls.sensor(name)
    for frame in sensor.data_frames:
        assert_scene_comes_back(sensor, frame, furnished_room(len(name)), number=150)


@pytest.mark.parametrize("name", REPRESENTATIVES)
def test_the_bytes_of_a_device_decode_to_the_scene_without_a_byte_too_many(name: str) -> None:
    sensor, room = ls.sensor(name), Room()
    # A turn is sent in this time.
    out, device = run_device(sensor, 0.12 if sensor.datagrams else 1.3, room)
    packets = sensor.decode(out if sensor.datagrams else b"".join(out))
    cloud = packets.points()
    assert packets.stats.frames == dict(device.sent)
    assert packets.stats.bytes_skipped - packets.stats.bytes_filler in (
        0,
        2,
    )  # two stray bytes that a COIN-D4 was seen to send
    assert (packets.stats.lost, packets.stats.plugin_errors) == (0, 0)
    assert (
        distance_outside(room, take_coordinates(cloud, len(packets))).max()
        < find_half_step(sensor, packets.frame) + EXACT
    )
    assert set(np.round(np.sign(np.diff(packets.time_ns))).tolist()) <= {0.0, 1.0}


def test_a_mirrored_or_turned_scene_would_show() -> None:
    room = Room()
    xyz = np.random.default_rng(3).normal(size=(500, 3))
    xyz = xyz / np.linalg.norm(xyz, axis=1)[:, None]
    azimuth, elevation = np.arctan2(xyz[:, 1], xyz[:, 0]), np.arcsin(xyz[:, 2])
    hits = xyz * room.measure(azimuth, elevation)[:, None]
    assert distance_outside(room, hits).max() < 1e-9
    assert distance_outside(room, hits * [1, -1, 1]).max() > 0.1
    assert distance_outside(room, hits * [-1, 1, 1]).max() > 0.1


def test_beams_begin_at_their_declared_origin() -> None:
    room, origin = Room(), (0.5, -0.25, 0.125)
    azimuth = np.linspace(-np.pi, np.pi, 400, endpoint=False)
    ranges = room.measure(azimuth, np.full(400, 0.1), origin)
    hits = (
        np.stack(
            [
                np.cos(0.1) * np.cos(azimuth),
                np.cos(0.1) * np.sin(azimuth),
                np.full(400, np.sin(0.1)),
            ],
            axis=1,
        )
        * ranges[:, None]
    )
    assert distance_outside(room, hits + origin).max() < 1e-9


def test_somebody_walks() -> None:
    walker = Mover((0.4, 0.4, 2), ((1, -1), (1, 1)), speed=1.0, floor=-1)
    scene = Room(walls=None, boxes=(), movers=(walker,))
    times = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    azimuth = np.arctan2([-1, 0, 1, 0, -1], 1.0)
    ranges = scene.measure(azimuth, np.zeros(5), time=times)
    assert np.isfinite(ranges).all()
    assert ranges[1] == ranges[3] == pytest.approx(0.8)
    assert np.isinf(scene.measure(azimuth, np.zeros(5), time=times + 1)).all()


def test_scenes_move_with_the_time_of_the_device() -> None:
    sensor, scene = (
        ls.sensor("ldrobot-stl27l"),
        Room(boxes=(), movers=(Mover((0.3, 0.3, 2), ((1.5, -1), (1.5, 1)), speed=1.0, floor=-1),)),
    )
    out, _ = run_device(sensor, 2.05, scene)
    whole = [scan.points for scan in sensor.scans(b"".join(out)) if scan.complete]
    seen = [
        np.median(points.y[(points.range < 2) & (np.abs(points.y) < 1.3) & (points.x > 1)])
        for points in whole
    ]
    assert len(seen) >= 18
    assert np.allclose(np.diff(seen), 0.1, atol=0.03)


def test_a_seed_makes_a_room_and_the_same_one_each_time() -> None:
    assert make_room(3) == make_room(3) != make_room(4)
    assert make_room() == make_room(0)


@pytest.mark.parametrize("start", [0, 7, 1000])
def test_packets_are_independent_of_batch_sizes(start: int) -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    assert simulate(sensor, 12, start=start)[4:] == simulate(sensor, 8, start=start + 4)


def test_the_pace_is_that_of_the_clock_of_the_points_of_the_declaration_or_of_the_line() -> None:
    wanted = {
        "ldrobot-stl27l": 12 / 21_600,  # its clock, in steps of a millisecond
        "robosense-m1": 1 / 6300,
        "hesai-xt32": 8 / 20_000,
        "cspc-m1c1-mini": 380 / 17 / 5.5 / 380,  # the times of its points
        "slamtec-rplidar-a1": 508e-6,  # declared
    }
    for name, seconds in wanted.items():
        assert frame_simulation(
            ls.sensor(name), ls.sensor(name).data_frame
        ).interval == pytest.approx(seconds * 1e9, rel=0.01)
    bare = replace(SHAPE, links={"data": Serial(9600)})
    assert frame_simulation(bare, "data").interval == pytest.approx((9 + 3 * 40) * 10 / 9600 * 1e9)


def test_a_sensor_without_time_on_datagrams_has_to_declare_its_rate() -> None:
    bare = replace(SHAPE, links={"data": Udp(2000)})
    with pytest.raises(SpecError, match="declare `rate`"):
        SimulatedDevice(bare)
    paced = replace(
        bare,
        frames={
            **bare.frames,
            "data": replace(bare.frames["data"], simulation=Simulation(rate=50.0)),
        },
    )
    device = SimulatedDevice(paced)
    device.start(0)
    assert sum(len(device.outgoing(now)) for now in range(0, SECOND + 1, SECOND // 100)) == 51


def test_sensors_that_cannot_be_simulated_give_a_reason() -> None:
    sensor = SHAPE
    with pytest.raises(UsageError, match="declares no sweep"):
        simulate(replace(sensor, simulation=Simulation(None)), 1)
    with pytest.raises(SpecError, match=r"declare Simulation\(encode=\.\.\.\)"):
        simulate(replace(sensor, points=lambda f: Polar(f.samples.distance * 0 + 1, 0)), 1)
    with pytest.raises(SpecError, match="calculates neither ranges nor coordinates"):
        simulate(replace(sensor, points=lambda f: Polar(1, np.deg2rad(f.first))), 1)
    with pytest.raises(SpecError, match=r"requires Simulation\(directions=\.\.\.\)"):
        simulate(replace(sensor, points=lambda f: Cartesian(f.samples.distance, 0, 0)), 1)
    with pytest.raises(SpecError, match="sweep must return 'size', because the length"):
        simulate(replace(sized.SENSOR, simulation=Simulation(lambda i: {"angle": 0})), 1)
    with pytest.raises(SpecError, match="with size = 500, the frame is longer than max_length"):
        simulate(
            replace(sized.SENSOR, simulation=Simulation(lambda i: {"angle": 0, "size": 500})), 1
        )


@pytest.mark.parametrize(("stretch", "shift"), [(1, 0.1), (1, -0.02), (1.01, 0.05), (0.98, 0)])
def test_corrected_ranges_go_back_through_the_correction(stretch: float, shift: float) -> None:
    """A hook corrects ranges like this, with the calibration of a site."""

    def corrected(f: Any) -> Polar:
        polar = count.points(f)
        return Polar(
            np.where(polar.range > 0, polar.range * stretch + shift, 0),
            polar.azimuth,
            intensity=polar.intensity,
        )

    room = Room()
    frames = simulate(replace(SHAPE, points=corrected), 9, scene=room)
    cloud = replace(SHAPE, points=corrected).decode(b"".join(frames)).points()
    assert cloud.valid.all()
    assert distance_outside(room, cloud.xyz.astype(np.float64)).max() < 0.0005 * stretch + EXACT
    raw = SHAPE.decode(b"".join(frames)).points()
    np.testing.assert_allclose(cloud.range, raw.range * stretch + shift, atol=1e-5)


@pytest.mark.parametrize("sensor", coordinates.SENSORS, ids=lambda sensor: sensor.id)
def test_coordinates_give_the_scene_back_along_the_directions_that_are_declared(
    sensor: Sensor,
) -> None:
    room = make_room(3)
    room = Room(room.walls, room.boxes)
    out, device = run_device(sensor, 1.3, room)
    packets = sensor.decode(out)
    cloud = packets.points()
    assert (packets.stats.frames, packets.stats.lost) == (dict(device.sent), 0)
    assert cloud.valid.all()
    step = {"shape-millimetres": 0.001, "shape-centimetres": 0.01, "shape-floats": 0}[sensor.id]
    assert (
        distance_outside(room, cloud.xyz.astype(np.float64)).max() < step / 2 * np.sqrt(3) + EXACT
    )
    declared = np.concatenate([np.ravel(coordinates.directions(i)[0]) for i in range(len(packets))])
    np.testing.assert_allclose(cloud.azimuth, declared, atol=step + 1e-6)


def turn_points(f: Any) -> Cartesian:
    """Return two returns of each beam, rotated and moved; the header has their step."""
    first, second = f.beams.first, f.beams.second
    x, y, z = (stack(getattr(first, axis), getattr(second, axis)) * f.step for axis in "xyz")
    return Cartesian(0.8 * x - 0.6 * y + 0.1, 0.6 * x + 0.8 * y, 0.05 - z, intensity=f.beams.light)


def turned_sensor(directions: Any) -> Sensor:
    """Return a sensor with a variable number of beams, which the header gives."""
    point = Struct(*(axis / Int16sl for axis in "xyz"))
    beam = Struct("first" / point, "second" / point, "light" / Int8ub)
    sensor = against_construct.sensor(
        Struct("n" / Int8ub, "step" / Scaled(Int8ub, 0.001, "m"), "beams" / Array(this.n, beam))
    )
    simulated = Simulation(
        lambda i: dict(n=2 + i % 5, step=0.001 * (1 + i % 3)), directions=directions, rate=100
    )
    return replace(sensor, points=turn_points, simulation=simulated)


def test_coordinates_are_solved_for_linear_points_functions() -> None:
    def directions(i: int) -> tuple[Any, Any]:
        return np.linspace(-1, 1, 2 + i % 5)[:, None] + i * 0.1, np.array([0.0, 0.3])

    sensor, room = turned_sensor(directions), Room()
    frames = simulate(sensor, 50, scene=room)
    cloud = sensor.decode(frames).points()
    assert len(cloud) == sum(2 * (2 + i % 5) for i in range(50))
    assert cloud.valid.all()
    assert (
        distance_outside(room, cloud.xyz.astype(np.float64)).max() < 0.003 / 2 * np.sqrt(3) + EXACT
    )
    assert np.unique(np.round(cloud.elevation, 1)).tolist() == pytest.approx([0, 0.3])


def test_directions_that_do_not_fit_and_fields_that_are_not_there_are_named() -> None:
    with pytest.raises(
        PluginError,
        match=(
            r"the shape \(9,\), which does not broadcast to the shape \(.*\) of the points of"
            r" frame 0"
        ),
    ):
        simulate(turned_sensor(lambda i: (np.zeros(9), 0)), 1)
    with pytest.raises(
        SpecError,
        match="the coordinates of points are not a linear function of any field",
    ):
        simulate(
            replace(turned_sensor(None), points=lambda f: Cartesian(f.beams.light * 0 + 1, 2, 3)), 1
        )


def test_a_beam_without_a_hit_has_no_coordinates() -> None:
    sensor = replace(coordinates.SENSORS[0], range_limits=(0.1, 3.0))
    cloud = sensor.decode(simulate(sensor, 40)).points()
    assert 0 < cloud.valid.sum() < len(cloud)
    assert np.isinf(cloud.range[~cloud.valid]).all()


def test_coordinates_may_be_encoded_too() -> None:
    def encode(polar: Polar) -> dict[str, NDArray[np.float64]]:
        return {"points.x": np.rint(np.asarray(polar.range) * 1000 * np.cos(polar.azimuth))}

    shape = coordinates.SENSORS[0]
    sensor = replace(shape, simulation=replace(shape.simulation, encode=encode))
    plain, encoded = (each.decode(simulate(each, 9)) for each in (shape, sensor))
    assert encoded["points.x"].min() >= plain["points.x"].min() - 0.001
    assert not encoded["points.y"].any()


def test_a_frame_may_encode_its_ranges_itself() -> None:
    def encode(polar: Polar) -> dict[str, NDArray[np.float64]]:
        return {"samples.distance": np.rint(np.asarray(polar.range) * 1000 / 3)}

    sensor = SHAPE
    frame: Frame = replace(sensor.frames["data"], simulation=Simulation(encode=encode))
    thirds = replace(sensor, frames={**sensor.frames, "data": frame})
    plain, third = (
        s.decode(b"".join(simulate(s, 20)))["samples.distance"] for s in (sensor, thirds)
    )
    assert np.abs(third * 3 - plain).max() < 0.003
    assert plain.max() > 1


GOOD = """
[room]
low = [-3, -2.2, -1.2]
high = [4.6, 3.1, 1.6]
[[box]]
low = [2.0, 0.8, -1.2]
high = [2.7, 1.6, 0.9]
[[mover]]
size = [0.4, 0.5, 1.7]
path = [[1.4, -1.5], [0.8, 1.9]]
"""


def test_a_scene_can_be_a_small_file(tmp_path: Path) -> None:
    path = tmp_path / "hall.toml"
    path.write_text(GOOD)
    walker = Mover((0.4, 0.5, 1.7), ((1.4, -1.5), (0.8, 1.9)))
    assert read_scene(path) == Room(
        Room().walls, (Box((2.0, 0.8, -1.2), (2.7, 1.6, 0.9)),), (walker,)
    )
    assert parse_scene({}) == Room(None, ())


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[room]", "[rom]", "unknown key 'rom'; did you mean 'room'"),
        ("[[box]]", "[box]", r"box: expected tables in double brackets, \[\[box\]\]"),
        (
            "high = [2.7, 1.6, 0.9]",
            "hihg = [2.7, 1.6, 0.9]",
            r"box\[0\]: unknown key 'hihg'; did you mean 'high'",
        ),
        ("high = [2.7, 1.6, 0.9]", "high = [2.7, 1.6]", r"box\[0\].high: expected 3 numbers"),
        (
            "high = [2.7, 1.6, 0.9]",
            "high = [2.7, 1.6, -2]",
            r"box\[0\]: each coordinate in high must be",
        ),
        (
            "high = [4.6, 3.1, 1.6]",
            "high = [-1, 3.1, 1.6]",
            "room: the room must contain the sensor, which is at",
        ),
        (
            "size = [0.4, 0.5, 1.7]",
            "size = [0.4, 'a', 1.7]",
            r"mover\[0\].size: expected a number, got 'a'",
        ),
        (
            "size = [0.4, 0.5, 1.7]",
            "size = [0.4, 0, 1.7]",
            r"mover\[0\].size: expected numbers above 0",
        ),
        (
            "path = [[1.4, -1.5], [0.8, 1.9]]",
            "path = [[1.4, -1.5]]",
            r"mover\[0\].path: expected at least two positions",
        ),
        (
            "path = [[1.4, -1.5], [0.8, 1.9]]",
            "path = [[1, 1], [1, 1]]",
            r"mover\[0\].path: all positions are equal",
        ),
        (
            "path = [[1.4, -1.5], [0.8, 1.9]]",
            "path = [[1, 1], [2]]",
            r"path\[1\]: expected 2 numbers",
        ),
        ("[room]", "[room", "line 2"),
        ("low = [-3, -2.2, -1.2]", "low = [-3, -2.2, nan]", "room.low: expected a number, got nan"),
    ],
)
def test_a_mistake_in_a_scene_is_named_by_its_key(
    tmp_path: Path, old: str, new: str, said: str
) -> None:
    path = tmp_path / "hall.toml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new, 1))
    with pytest.raises(UsageError, match=said):
        read_scene(path)


@pytest.mark.parametrize(
    "text",
    [
        b"x = " + b"[" * 10_000,
        b"a." * 30_000 + b"b = 1",
        b"x = " + b"9" * 5000,
        b"\xff",
        b"#" * (1 << 19),
    ],
)
def test_an_invalid_scene_is_an_error_of_its_file(text: bytes, tmp_path: Path) -> None:
    (path := tmp_path / "strange.toml").write_bytes(text)
    with pytest.raises(UsageError, match=r"strange\.toml: not TOML: "):
        read_scene(path)


def test_a_scene_that_cannot_be_read_is_the_systems_fault(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="No such file"):
        read_scene(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UsageError, match="UTF-8"):
        read_scene(tmp_path / "binary.toml")


def test_an_intensity_that_sweep_gives_stays() -> None:
    frame = Struct(
        "points" / Array(3, Struct("distance" / Scaled(Int8ub, 0.05, "m"), "intensity" / Int8ub))
    )
    made = replace(
        against_construct.sensor(frame),
        points=lambda f: Polar(
            range=f.points.distance, azimuth=np.arange(3), intensity=f.points.intensity
        ),
        simulation=Simulation(lambda i: {"points.intensity": [7, 8, 9]}, rate=10),
    )
    assert made.decode(simulate(made, 2)).points().intensity.tolist() == [7, 8, 9] * 2
    free = replace(made, simulation=Simulation(lambda i: {}, rate=10))
    assert 0 < free.decode(simulate(free, 2)).points().intensity.min() != 7


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"count": 3}, "samples.distance: 4 values are simulated, but samples has 3 elements"),
        (
            {"count": [4, 4]},
            "count: the simulated values have the shape (2,), expected a single number",
        ),
        ({"count": "four"}, "count: the simulated value is 'four', expected numbers"),
        ({"count": None}, "count: the simulated value is None, expected numbers"),
        (
            {"samples.distance": np.ones((4, 2))},
            "samples.distance: the simulated values have the shape (4, 2), expected at most 1 axes",
        ),
    ],
)
def test_values_of_a_sweep_that_do_not_fit_their_field_are_spec_errors(
    given: dict[str, Any], reason: str
) -> None:
    sample = Struct("distance" / Scaled(Int8ub, 0.05, "m"))
    frame = Struct("count" / Int8ub, "samples" / Array(this.count, sample))
    values = {"count": 4, "samples.distance": [1, 2, 3, 4], **given}
    made = replace(
        against_construct.sensor(frame),
        points=lambda f: Polar(range=f.samples.distance, azimuth=f.samples.index),
        simulation=Simulation(lambda i: values, rate=10),
    )
    with pytest.raises(SpecError, match=re.escape(f": data.{reason}")):
        simulate(made, 2)


def test_an_error_of_a_periodic_frame_names_the_frame() -> None:
    device = SimulatedDevice(periodic_sweep_of_nothing.lidarspec_sensors()[0])
    with pytest.raises(SpecError, match=r"^broken-one: status\.status: a value is simulated for"):
        device.start(0)


def test_an_exception_of_a_periodic_sweep_is_a_plugin_error() -> None:
    (sensor,) = periodic_sweep_of_nothing.lidarspec_sensors()
    status = replace(sensor.frames["status"], simulation=Simulation(lambda i: 1 / 0, rate=10))
    failing = replace(sensor, frames={**sensor.frames, "status": status})
    with pytest.raises(PluginError, match="sweep of status: ZeroDivisionError"):
        FramesWithoutPoints(failing).make_frame("status", 0)
