"""Angles that lie close together: as exact as those computed one by one, and the same whatever other packets are in the batch."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import lidarspec
from lidarspec import Sensor
from lidarspec.columns.columns import remainder
from lidarspec.points.evaluate import evaluated
from lidarspec.points.numpy_plan import describe
from lidarspec.points.plain import evaluate
from lidarspec.points.plan import Plan, plan_for
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Fields, Polar, spread
from lidarspec.testing.agreement import assert_same_points

STL27L = lidarspec.sensor("ldrobot-stl27l")
OFFSETS = np.linspace(-40, 25, 12)


def steps_in(azimuth: Callable[[Fields], Any]) -> tuple[Sensor, list[str]]:
    """A sensor with another direction, and the steps of its plan."""
    sensor = dataclasses.replace(STL27L, points=lambda f: Polar(range=f.points.distance, azimuth=azimuth(f)))
    packets = sensor.decode(b"".join(simulate(STL27L, 3)))
    plan = plan_for(sensor.points_of("data"), packets.batch(), packets.table.groups[0])  # type: ignore[attr-defined]
    assert isinstance(plan, Plan)
    return sensor, describe(plan)


def turning(f: Fields) -> Any:
    return -np.deg2rad(spread(f.start_angle, f.end_angle, 12, full=360))


def fixed(f: Fields) -> Any:
    return np.deg2rad(f.start_angle + OFFSETS)


def both(f: Fields) -> Any:
    return turning(f) + np.deg2rad(OFFSETS)


def alike(f: Fields) -> Any:
    return np.deg2rad(f.start_angle + np.full(12, 3.0))


@pytest.mark.parametrize(
    ("azimuth", "words"), [(turning, "cos by 5"), (fixed, "cos by 2"), (both, "cos by 10"), (alike, "cos of each block")]
)
@pytest.mark.parametrize("narrow", [True, False])
def test_points_are_those_of_the_plain_evaluation(azimuth: Any, words: str, narrow: bool) -> None:
    sensor, steps = steps_in(azimuth)
    assert words in " ".join(steps)
    frames = simulate(STL27L, 700) if narrow else [STL27L.example("data", seed=seed) for seed in range(40)]
    packets = sensor.decode(b"".join(frames))
    assert_same_points(evaluated(packets).cloud, evaluate(packets).cloud)


@pytest.mark.parametrize("azimuth", [turning, fixed])
def test_cosines_and_sines_are_nearly_as_exact_as_float32_can_be(azimuth: Any) -> None:
    sensor, _ = steps_in(azimuth)
    packets = sensor.decode(b"".join(simulate(STL27L, 1800)))
    cloud, angle = packets.points(), np.asarray(azimuth(Fields(packets.batch()))).reshape(-1)
    error = np.hypot(cloud.x - cloud.range * np.cos(angle), cloud.y - cloud.range * np.sin(angle)) / cloud.range
    assert np.nanmax(error[cloud.valid]) < 1.7e-7


def test_a_packet_has_the_same_points_in_any_company() -> None:
    close = simulate(STL27L, 6)
    apart = [STL27L.example("data", seed=seed) for seed in range(6)]
    mixed = [frame for pair in zip(close, apart, strict=True) for frame in pair]
    together = STL27L.decode(np.frombuffer(b"".join(mixed), np.uint8).reshape(12, -1)).points()
    for index, frame in enumerate(mixed):
        alone = STL27L.decode(frame).points()
        for name in "xy":
            np.testing.assert_array_equal(getattr(together, name)[12 * index : 12 * index + 12], getattr(alone, name))


@pytest.mark.parametrize("full", [360.0, 2 * np.pi, 6400.0, 0.1])
def test_remainders_are_those_of_numpy(full: float) -> None:
    edges = np.arange(-5, 6) * full
    near = [np.nextafter(edges, -np.inf), edges, np.nextafter(edges, np.inf)]
    odd = [-0.0, 1e-300, -1e-300, 1e300, np.inf, -np.inf, np.nan]
    values = np.concatenate([*near, odd, np.random.default_rng(1).uniform(-3 * full, 4 * full, 9000)])
    with np.errstate(invalid="ignore"):
        wanted, found = np.remainder(values, full), remainder(values, np.asarray(full))
    np.testing.assert_array_equal(np.signbit(wanted) & ~np.isnan(wanted), np.signbit(found) & ~np.isnan(found))
    np.testing.assert_array_equal(wanted, found)
