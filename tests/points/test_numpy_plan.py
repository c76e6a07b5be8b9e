"""Tests that the plan gives the points of the reference evaluator.

Masks are equal, coordinates within four units in the last place.
"""

from __future__ import annotations

import dataclasses
import gc
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from construct import Array, Int8ul, Int16ul, Struct, this

import lidarspec
from lidarspec import Packets, Sensor, simulate
from lidarspec.frames.frame_table import CompiledTable
from lidarspec.points.evaluate import evaluate
from lidarspec.points.plan import Plan, plan_for
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.spec import Fields, Polar, Scaled, take
from lidarspec.spec.links import is_datagram
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.agreement import assert_same_points
from tests.broken import sound
from tests.by_construct import reader
from tests.engine.against_construct import clouds_agree, sensor
from tests.engine.random_specs import make_struct
from tests.installed import distinct_sensors_in, sensor_modules
from tests.points.backends import BACKENDS
from tests.representatives import REPRESENTATIVES, load_sensor
from tests.shapes import SHAPES

SHAPED = [name for name, sensor in SHAPES.items() if sensor.frames]


def plan(packets: Packets) -> Any:
    """Return the plan of the longest packets with points, or the reason for its absence."""
    assert isinstance(packets.table, CompiledTable)
    made: Any = None
    for group in sorted(packets.table.groups, key=lambda group: -group.layout.size):
        made = plan_for(packets.sensor.points_of(packets.frame), packets.batch(), group)
        if isinstance(made, Plan):
            break
    return made


def packets_of(sensor: Sensor, number: int) -> Packets:
    random = np.random.default_rng(number)
    frames = [
        sensor.example(sensor.data_frame, seed=int(seed))
        for seed in random.integers(0, 1000, number)
    ]
    return sensor.decode(
        frames if is_datagram(sensor.links.get("data")) else b"".join(frames)
    ).with_points


@pytest.mark.parametrize("number", [1, 4, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", SHAPED)
def test_a_plan_equals_the_reference_evaluator(name: str, number: int) -> None:
    assert_planned_points_are_the_plain_ones(packets_of(SHAPES[name], number))


@pytest.mark.slow
@pytest.mark.parametrize("name", REPRESENTATIVES)
def test_every_representative_has_a_plan(name: str) -> None:
    assert_sensors_have_a_plan([load_sensor(name)])


@pytest.mark.soak
@pytest.mark.parametrize("module", sensor_modules())
def test_every_installed_sensor_has_a_plan(module: str) -> None:
    sensors = distinct_sensors_in(module)
    assert_sensors_have_a_plan([sensor for sensor in sensors if sensor.has_points])


def assert_sensors_have_a_plan(sensors: list[Sensor]) -> None:
    """Fail unless each sensor has a plan, with the points of the reference evaluator."""
    for installed in sensors:
        packets = packets_of(installed, 5)
        if packets.points().valid.any():  # headers of random counts may leave none
            assert isinstance(plan(packets), Plan), f"{installed.id}: {plan(packets)}"
        assert_planned_points_are_the_plain_ones(packets)


def assert_planned_points_are_the_plain_ones(packets: Packets) -> None:
    """Fail unless the plan and the reference evaluator agree.

    Points, counts, and the values that are carried over to the next packets are compared.
    """
    if len(packets):
        assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud)
        one, other = (
            evaluate(packets, final=False, stamp_ns=5),
            evaluate_plainly(packets, final=False, stamp_ns=5),
        )
        assert one.ready == other.ready
        assert_same_points(one.cloud, other.cloud)
        np.testing.assert_array_equal(one.counts, other.counts)
        assert one.carry.keys() == other.carry.keys()
        for slot, values in one.carry.items():
            np.testing.assert_array_equal(values, other.carry[slot])


#: shapes with frames that take long to make; their points are compared above.
LARGE = ("shape-joined", "shape-channels", "shape-segments")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow) if name in LARGE else name for name in SHAPED],
)
def test_every_column_of_damaged_and_mixed_streams(name: str) -> None:
    sensor = SHAPES[name]
    packets = sensor.decode(SensorUnderTest(sensor).stream()).with_points
    if len(packets):
        assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud)


@pytest.mark.parametrize("frame", ["rep103", "vendor"])
def test_the_vendors_axes(frame: str) -> None:
    packets = packets_of(lidarspec.sensor("velodyne-vlp16").configure(frame=frame), 9)
    assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud)


def branching(f: Fields) -> Polar:
    far = f.points.distance * 2 if (f.start_angle > 100).array.all() else f.points.distance
    return Polar(range=far, azimuth=f.start_angle)


def reducing(f: Fields) -> Polar:
    return Polar(range=f.points.distance, azimuth=np.add.reduce(f.start_angle))


def indexing(f: Fields) -> Polar:
    return Polar(range=np.asarray(f.points.distance) * 1.0, azimuth=0)


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (branching, ".array"),
        (reducing, "np.add.reduce"),
        (indexing, "to an array"),
    ],
)
def test_untraceable_functions_are_reported_and_evaluated(points: Any, reason: str) -> None:
    sensor = dataclasses.replace(lidarspec.sensor("ldrobot-stl27l"), points=points)
    packets = sensor.decode(b"".join(sensor.example("data", seed=seed) for seed in range(4)))
    found = plan(packets)
    assert not isinstance(found, Plan)
    assert reason in str(found)
    assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud)


def test_a_zero_or_negative_factor_gives_no_points() -> None:
    sensor = lidarspec.sensor("hesai-xt32")
    frames = []
    for unit in (4, 0, 4):
        parsed = sensor.parse(sensor.example("data", seed=unit + 1))
        parsed.dis_unit = unit
        frames.append(sensor.build("data", parsed))
    table = sensor.decode(frames)
    assert_same_points(evaluate(table).cloud, evaluate_plainly(table).cloud)


@pytest.mark.parametrize(
    "text",
    [
        'Struct("text" / Bytes(3), "n" / Int64ub, "x" / Array(3, Struct("v" / Int8sb)))',
        (
            'Struct("x" / Array(2, Struct("h" / Int8ub, "y" / Array(3, Struct("text" / Bytes(2),'
            ' "v" / Int16ul)))))'
        ),
        (
            'Struct("x" / Array(2, Struct("y" / Array(3, Struct("z" / Array(2, Int8ub), "v" /'
            ' Int16ul)))), "end" / Int8ub)'
        ),
    ],
)
def test_arrays_with_equal_layouts_are_distinguished(text: str) -> None:
    """Once, one of two arrays was read at the offset of the other, beyond the frame."""
    struct = make_struct(text)
    frames = [sensor(struct).example("data", seed=seed) for seed in range(5)]
    assert clouds_agree(struct, frames, backends=("numpy",)) or "z" in text


def test_columns_are_made_once_and_slices_share_them() -> None:
    packets = packets_of(lidarspec.sensor("robosense-m1"), 5)
    cloud = packets.points()
    assert cloud.x is cloud.x
    part = cloud[125:250]
    assert part.x.base is cloud.x or part.x.base is cloud.x.base
    assert part.shape == (25, 5)
    assert isinstance(packets.batch().table, CompiledTable)


def test_a_cloud_is_freed_without_garbage_collection() -> None:
    cloud = packets_of(lidarspec.sensor("ldrobot-stl27l"), 3).points()
    assert len(cloud.x) == 36
    known = weakref.ref(cloud)
    gc.disable()
    try:
        del cloud
        assert known() is None
    finally:
        gc.enable()


def test_threads_that_decode_with_one_sensor_do_not_meet() -> None:
    sensor = lidarspec.sensor("robosense-m1")
    some = np.stack(
        [np.frombuffer(sensor.example("data", seed=seed), np.uint8) for seed in range(40)]
    )
    inputs = [np.tile(some[:20], (50, 1)), np.tile(some[20:], (50, 1))]
    wanted = [sensor.decode(rows).points().x for rows in inputs]

    def same(index: int) -> bool:
        return all(
            np.array_equal(sensor.decode(inputs[index]).points().x, wanted[index], equal_nan=True)
            for _ in range(4)
        )

    with ThreadPoolExecutor(2) as pool:
        assert all(pool.map(same, [0, 1]))


@BACKENDS
def test_sensors_that_share_a_points_function_keep_their_own_scales(backend: str) -> None:
    """Lookup tables are cached by `points` function; these sensors have other units."""
    for unit in (0.001, 0.002):
        sample = Struct("distance" / Scaled(Int16ul, unit, "m"), "quality" / Int8ul)
        made = sound.sensor(sound.frame(sound.make_frame(samples=Array(this.count, sample))))
        cloud = made.decode(b"".join(simulate(made, 40)), backend=backend).points()
        plain = reader(made, "construct").decode(b"".join(simulate(made, 40))).points()
        assert cloud.valid.any()
        assert_same_points(cloud, plain)


@BACKENDS
def test_beams_that_start_beside_the_sensor_are_exact_near_and_far(backend: str) -> None:
    random = np.random.default_rng(5)
    azimuths, elevations, starts = (
        random.uniform(-np.pi, np.pi, (9, 32)),
        random.uniform(-0.8, 0.8, (9, 32)),
        random.normal(0, 0.05, (3, 9, 32)),
    )

    def points(f: Fields) -> Polar:
        azimuth, elevation, *start = (
            take(table, f.number) for table in (azimuths, elevations, *starts)
        )
        return Polar(f.ranges, azimuth, elevation, origin=tuple(start))

    struct = Struct("number" / Int16ul, "ranges" / Array(32, Scaled(Int16ul, 0.004, "m")))
    numbers, ranges = (
        np.arange(200) % 10,
        random.integers(0, 3000, (200, 32)),
    )  # of ten rows, the table has nine
    ranges[20:60] = random.integers(0, 64_000, (40, 32))
    ranges[random.random(ranges.shape) < 0.2] = 0
    frames = np.ascontiguousarray(
        np.concatenate([numbers[:, None], ranges], axis=1).astype("<u2")
    ).view(np.uint8)
    xyz = (
        dataclasses.replace(sensor(struct), points=points)
        .decode(frames, backend=backend)
        .points()
        .xyz.reshape(200, 32, 3)
    )
    assert (np.isnan(xyz).all(axis=2) == ((ranges == 0) | (numbers == 9)[:, None])).all()
    seen, measured = numbers < 9, np.where(ranges, ranges * 0.004, np.nan)
    azimuth, elevation, start = (
        table[..., numbers[seen], :] for table in (azimuths, elevations, starts)
    )
    level = np.cos(elevation)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    np.testing.assert_allclose(
        xyz[seen], np.moveaxis(directions * measured[seen] + start, 0, -1), rtol=0, atol=1e-5
    )
