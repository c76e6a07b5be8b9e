"""Tests of coordinates and floating-point fields with any value.

Plans and kernels give the results of the reference evaluator.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lidarspec import Sensor, simulate
from lidarspec.points.batch_columns import BatchColumns
from lidarspec.points.cloud import LazyCloud
from lidarspec.points.evaluate import evaluate
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.spec import Cartesian
from lidarspec.testing.cloud_assertions import assert_well_formed
from tests.agreement import assert_same_points
from tests.points.backends import BACKENDS
from tests.shapes import SHAPES
from tests.shapes.coordinates import POINTS, SENSORS

#: zeros of both signs, no number, too large for float32 or a sum, and the smallest of all.
ODD = [0.0, -0.0, np.nan, np.inf, -np.inf, 3.4e38, -1.0, 1.5, 1e-45, -1e-38, 0.1, 7e9]


def bits(column: NDArray[Any]) -> NDArray[Any]:
    """Return a float32 column as bits, with all NaNs equal."""
    return np.where(np.isnan(column), np.float32(np.nan), column).view(np.uint32)


def frames_of(sensor: Sensor, points: list[Any]) -> list[bytes]:
    """Return whole frames of these points, which are dicts of raw values."""
    rows = [points[start : start + POINTS] for start in range(0, len(points) - POINTS + 1, POINTS)]
    return [
        sensor.build("data", number=index, time=index, count=POINTS, points=row)
        for index, row in enumerate(rows)
    ]


def values_of(name: str) -> list[Any]:
    """Return raw values at the limits of a coordinate."""
    if name == "shape-floats":
        return ODD
    least = -(2 ** (31 if name == "shape-millimetres" else 15))
    return [0, 1, -1, least, -least - 1, 1234, -999]


def move_points(f: Any) -> Cartesian:
    """Return points moved by an extrinsic calibration and by a row of numbers."""
    x, y, z = f.points.x, f.points.y, f.points.z
    return Cartesian(
        0.8 * x - 0.6 * y + 0.1,
        0.6 * x + 0.8 * y * np.linspace(0.9, 1.1, POINTS),
        z * np.cos(y),
        f.points.reflectivity * f.points.tag * 0.1,
        invalid=f.points.tag > 200,
    )


@BACKENDS
@pytest.mark.parametrize("name", [sensor.id for sensor in SENSORS])
@pytest.mark.parametrize("points", [None, move_points])
def test_coordinates_are_the_same_bit_by_bit(name: str, points: Any, backend: str) -> None:
    sensor = dataclasses.replace(SHAPES[name], points=points or SHAPES[name].points)
    edges = itertools.product(values_of(name), repeat=3)
    given = [
        dict(x=x, y=y, z=z, reflectivity=spot % 256, tag=spot % 251)
        for spot, (x, y, z) in enumerate(edges)
    ]
    packets = sensor.decode(frames_of(sensor, given), backend=backend)
    found, plain = evaluate(packets).cloud, evaluate_plainly(packets).cloud
    assert is_planned(found)
    for column in ("x", "y", "z", "intensity"):
        np.testing.assert_array_equal(bits(found.columns[column]), bits(plain.columns[column]))
    assert_same_points(found, plain)
    assert_well_formed(found)
    assert 0.2 < found.valid.mean() < 0.9


@BACKENDS
def test_a_point_is_drawn_at_its_coordinates(backend: str) -> None:
    sensor = SHAPES["shape-millimetres"]
    given = [(3000, 4000, -12000, 0), (0, 0, 0, 0), (0, -2000, 0, 200), (-1500, 0, 0, 199)]
    points = [dict(x=x, y=y, z=z, reflectivity=9, tag=tag) for x, y, z, tag in given]
    cloud = sensor.decode(
        [sensor.build("data", number=1, time=0, count=4, points=points)], backend=backend
    ).points()
    assert cloud.range.tolist()[::3] == [13.0, 1.5]
    assert np.isinf(cloud.range[1])
    assert np.isnan(cloud.range[2])
    np.testing.assert_allclose(cloud.azimuth, [np.arctan2(4, 3), 0, -np.pi / 2, -np.pi], atol=1e-6)
    np.testing.assert_allclose(cloud.elevation, [np.arctan2(-12, 5), 0, 0, 0], atol=1e-6)
    assert cloud.xyz[[0, 3]].tolist() == [[3, 4, -12], [-1.5, 0, 0]]
    assert cloud.valid.tolist() == [True, False, False, True]


@BACKENDS
@pytest.mark.parametrize("columns", [(1, 0, 0), (0, 1, -2), (0, 0, 1)])
def test_coordinates_may_lie_in_a_plane_and_be_turned(
    columns: tuple[int, int, int], backend: str
) -> None:
    """They are also rotated to the vendor's axes: x right, y forward."""
    shape = SHAPES["shape-centimetres"]

    def points(f: Any) -> Cartesian:
        x, y, z = (f.points.x * factor if factor else 0 for factor in columns)
        return Cartesian(x, y, z, ring=np.arange(POINTS))

    for frame in ("rep103", "vendor"):
        sensor = dataclasses.replace(
            shape, points=points, vendor_axes=("right", "forward", "up")
        ).configure(frame=frame)
        packets = sensor.decode(
            [shape.example("data", seed=seed) for seed in range(3)], backend=backend
        )
        found = evaluate(packets).cloud
        assert is_planned(found)
        assert_same_points(found, evaluate_plainly(packets).cloud)
        assert found.valid.any()


def is_planned(cloud: LazyCloud) -> bool:
    """Return whether the columns of a cloud are computed by plans, not plainly."""
    return isinstance(cloud.lazy.source, BatchColumns)


def decode_scaled(backend: str, **values: Any) -> tuple[LazyCloud, LazyCloud]:
    """Return the points of two frames with a float scale, by both evaluators.

    The second frame has the given values.
    """
    sensor = SHAPES["shape-scales"]
    usual: dict[str, Any] = dict(
        scale=2.0, start=90.0, tilt=0.1, distances=[0, 1, 2, 1000, 4660, 65535], strengths=[1.5] * 6
    )
    packets = sensor.decode(
        sensor.build("data", **usual) + sensor.build("data", **{**usual, **values}), backend=backend
    )
    assert len(packets) == 2
    return evaluate(packets).cloud, evaluate_plainly(packets).cloud


@BACKENDS
def test_floating_point_fields_are_planned(backend: str) -> None:
    for values in (
        {},
        dict(scale=0.3, start=0.0, tilt=-0.7),
        dict(strengths=[*ODD[:6]]),
        dict(strengths=[*ODD[6:]]),
    ):
        found, plain = decode_scaled(backend, **values)
        assert is_planned(found)
        assert_same_points(found, plain)
    assert found.range[3] == 2.0
    turned = np.deg2rad(94.5)
    np.testing.assert_allclose(
        found.xyz[3],
        [2 * np.cos(turned) * np.cos(0.1), 2 * np.sin(turned) * np.cos(0.1), 2 * np.sin(0.1)],
        atol=1e-6,
    )


@BACKENDS
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e-45, 3e38, -1.0])
def test_extreme_floats_use_the_reference_evaluator(number: float, backend: str) -> None:
    found, plain = decode_scaled(backend, scale=number)
    assert not is_planned(found)
    assert_same_points(found, plain)
    if number != -1:
        found, plain = decode_scaled(backend, tilt=number)
        assert not is_planned(found)
        assert_same_points(found, plain)
    assert_well_formed(found)


@BACKENDS
def test_floats_at_random(backend: str) -> None:
    shape, random = SHAPES["shape-numbers"], np.random.default_rng(5)
    for odd in (False, True):
        frames = []
        for _ in range(50):
            ranges = random.choice(ODD, 3) if odd else random.normal(0, 10, 3).clip(0, None)
            samples = [
                dict(range=float(r), elevation=int(random.integers(-9000, 9000)), spare=0)
                for r in ranges
            ]
            values = dict(
                reserved=bytes(3),
                stamp=1,
                serial=0,
                offset=0,
                azimuth=float(random.normal(0, 90)),
                samples=samples,
            )
            frames.append(shape.build("data", **values))
        packets = shape.decode(b"".join(frames), backend=backend)
        found = evaluate(packets).cloud
        assert is_planned(found) is not odd
        assert_same_points(found, evaluate_plainly(packets).cloud, ulps=6)


def test_scans_of_coordinates_are_those_of_all_points() -> None:
    sensor = SHAPES["shape-millimetres"]
    frames = simulate(sensor, 60)
    whole, scans = sensor.decode(frames).points(), list(sensor.scans(frames))
    assert len(scans) > 4
    for name in ("x", "range", "azimuth", "elevation"):
        np.testing.assert_array_equal(
            np.concatenate([scan.points.columns[name] for scan in scans]), whole.columns[name]
        )
