"""Tests that sines and cosines are exact and do not depend on other packets."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import lidarspec
from lidarspec import Sensor, simulate
from lidarspec.expressions.columns import remainder
from lidarspec.points.evaluate import evaluate
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.spec import Fields, Polar, spread
from tests.agreement import assert_same_points

OFFSETS = np.linspace(-40, 25, 12)


@pytest.fixture(scope="module")
def stl27l() -> Sensor:
    return lidarspec.sensor("ldrobot-stl27l")


def with_azimuth(sensor: Sensor, azimuth: Callable[[Fields], Any]) -> Sensor:
    """Return the sensor with another direction of its points."""
    return dataclasses.replace(
        sensor, points=lambda f: Polar(range=f.points.distance, azimuth=azimuth(f))
    )


def turning(f: Fields) -> Any:
    return -np.deg2rad(spread(f.start_angle, f.end_angle, 12, full=360))


def fixed_directions(f: Fields) -> Any:
    return np.deg2rad(f.start_angle + OFFSETS)


def both(f: Fields) -> Any:
    return turning(f) + np.deg2rad(OFFSETS)


def alike(f: Fields) -> Any:
    return np.deg2rad(f.start_angle + np.full(12, 3.0))


@pytest.mark.parametrize("azimuth", [turning, fixed_directions, both, alike])
@pytest.mark.parametrize("narrow", [True, False])
def test_points_are_those_of_the_plain_evaluation(
    stl27l: Sensor, azimuth: Any, narrow: bool
) -> None:
    sensor = with_azimuth(stl27l, azimuth)
    frames = (
        simulate(stl27l, 700)
        if narrow
        else [stl27l.example("data", seed=seed) for seed in range(40)]
    )
    packets = sensor.decode(b"".join(frames))
    assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud)


@pytest.mark.parametrize("azimuth", [turning, fixed_directions])
def test_cosines_and_sines_are_nearly_as_exact_as_float32_can_be(
    stl27l: Sensor, azimuth: Any
) -> None:
    sensor = with_azimuth(stl27l, azimuth)
    packets = sensor.decode(b"".join(simulate(stl27l, 1800)))
    cloud, angle = packets.points(), np.asarray(azimuth(Fields(packets.batch()))).reshape(-1)
    error = (
        np.hypot(cloud.x - cloud.range * np.cos(angle), cloud.y - cloud.range * np.sin(angle))
        / cloud.range
    )
    assert np.nanmax(error[cloud.valid]) < 2.5e-7


def test_a_packet_has_the_same_points_in_any_company(stl27l: Sensor) -> None:
    close = simulate(stl27l, 6)
    apart = [stl27l.example("data", seed=seed) for seed in range(6)]
    mixed = [frame for pair in zip(close, apart, strict=True) for frame in pair]
    together = stl27l.decode(np.frombuffer(b"".join(mixed), np.uint8).reshape(12, -1)).points()
    for index, frame in enumerate(mixed):
        alone = stl27l.decode(frame).points()
        for name in "xy":
            np.testing.assert_array_equal(
                getattr(together, name)[12 * index : 12 * index + 12], getattr(alone, name)
            )


@pytest.mark.parametrize("full", [360.0, 2 * np.pi, 6400.0, 0.1])
def test_remainders_are_those_of_numpy(full: float) -> None:
    edges = np.arange(-5, 6) * full
    near = [np.nextafter(edges, -np.inf), edges, np.nextafter(edges, np.inf)]
    odd = [-0.0, 1e-300, -1e-300, 1e300, np.inf, -np.inf, np.nan]
    values = np.concatenate(
        [*near, odd, np.random.default_rng(1).uniform(-3 * full, 4 * full, 9000)]
    )
    with np.errstate(invalid="ignore"):
        wanted, found = np.remainder(values, full), remainder(values, np.asarray(full))
    np.testing.assert_array_equal(
        np.signbit(wanted) & ~np.isnan(wanted), np.signbit(found) & ~np.isnan(found)
    )
    np.testing.assert_array_equal(wanted, found)
