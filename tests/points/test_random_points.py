"""Tests of random `points` functions: plan and kernels give the plain results."""

from __future__ import annotations

import dataclasses
import random
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import lidarspec
from lidarspec import Packets, simulate
from lidarspec.points.evaluate import evaluate
from lidarspec.points.plan import Plan, plan_for
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.spec import Fields, Polar, following, previous, spread, take, wrap
from tests.agreement import assert_same_points

Expression = Callable[[Fields], Any]


@dataclasses.dataclass(frozen=True)
class Parts:
    """The values from which `points` functions for one sensor are drawn.

    Attributes:
        sensor_id: the id of the sensor.
        low: values with one entry per packet or block.
        full: values with one entry per point.
        row: the number of points in the innermost array.
    """

    sensor_id: str
    low: tuple[Expression, ...]
    full: tuple[Expression, ...]
    row: int


PARTS = {
    "serial": Parts(
        "ldrobot-stl27l",
        (
            lambda f: f.start_angle,
            lambda f: f.end_angle,
            lambda f: wrap(f.end_angle - f.start_angle, 360),
            lambda f: f.speed,
        ),
        (lambda f: f.points.distance, lambda f: f.points.intensity),
        12,
    ),
    "blocks": Parts(
        "velodyne-vlp16",
        (
            lambda f: f.blocks.azimuth,
            lambda f: following(f.blocks.azimuth) - f.blocks.azimuth,
            lambda f: previous(f.blocks.azimuth),
        ),
        (lambda f: f.blocks.channels.distance, lambda f: f.blocks.channels.intensity),
        32,
    ),
}


class Maker:
    """Draws expressions of a sensor's fields."""

    def __init__(self, parts: Parts, seed: int) -> None:
        self._parts, self._source = parts, random.Random(seed)

    def _row(self) -> Any:
        values = [self._source.uniform(-2, 2) for _ in range(self._parts.row)]
        return (
            np.array(values) if self._source.random() < 0.8 else np.full(self._parts.row, values[0])
        )

    def term(self) -> Expression:
        """Return a term of an angle in degrees."""
        low, full = self._source.choice(self._parts.low), self._source.choice(self._parts.full)
        row, number = self._row(), self._source.uniform(-400, 400)
        kinds: list[Expression] = [
            low,
            low,
            lambda f: low(f) * row,
            lambda f: low(f) * row / 50,
            lambda f: row,
            lambda f: number,
            lambda f: np.arctan(full(f) * 0.01) * 20,
            lambda f: np.where(low(f) > 180, full(f) * 0.1, number),
            lambda f: np.where(low(f) > 90, 0, np.sqrt(full(f))),
            lambda f: np.where(low(f) > 270, np.nan, full(f)),
            lambda f: np.where(full(f) > 30, low(f), number),
            lambda f: take(row, full(f)),
            lambda f: np.clip(full(f), 1, 40) * 3 - low(f),
            lambda f: spread(low(f), low(f) + row[0] * 4, self._parts.row, full=360),
        ]
        return self._source.choice(kinds)

    def angle(self) -> Expression:
        """Return a sum of terms, in radians."""
        terms, outer = (
            [self.term() for _ in range(self._source.randint(1, 4))],
            self._source.randrange(4),
        )

        def value(f: Fields) -> Any:
            total = sum((term(f) for term in terms[1:]), terms[0](f))
            total = wrap(total, 360) if outer == 1 else -total if outer == 2 else total
            return np.deg2rad(total)

        return value

    def points(self) -> Callable[[Fields], Polar]:
        """Return a whole `points` function."""
        distance, level = self._parts.full[0], self._source.randrange(4)
        azimuth, row, tilt = self.angle(), self._row(), self.angle()
        origin = (0.0, 0.0, 0.1) if self._source.random() < 0.3 else (0.0, 0.0, 0.0)
        elevation: list[Expression] = [
            lambda f: 0.0,
            lambda f: row * 0.1,
            lambda f: np.deg2rad(self._parts.low[0](f)),
            tilt,
        ]
        limit = self._source.choice([None, 1.0, 20.0])

        def points(f: Fields) -> Polar:
            far = (
                distance(f) if limit is None else np.where(distance(f) > limit, distance(f), np.nan)
            )
            return Polar(
                range=far,
                azimuth=azimuth(f),
                elevation=elevation[level](f),
                intensity=self._parts.full[1](f),
                origin=origin,
            )

        return points


def packets_of(name: str, seed: int, backend: str) -> Packets:
    """Return simulated and random packets, with a drawn `points` function."""
    parts, source = PARTS[name], random.Random(seed)
    known = lidarspec.sensor(parts.sensor_id)
    sensor = dataclasses.replace(known, points=Maker(parts, seed).points())
    frames = simulate(known, source.randint(1, 30)) + [
        known.example("data", seed=n) for n in range(source.randrange(9))
    ]
    source.shuffle(frames)
    return sensor.decode(frames if sensor.datagrams else b"".join(frames), backend=backend)


@pytest.mark.parametrize("name", list(PARTS))
@pytest.mark.parametrize(
    "seed", [*range(10), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(10, 60))]
)
def test_a_plan_of_a_random_function_gives_the_plain_points(name: str, seed: int) -> None:
    packets = packets_of(name, seed, "numpy")
    found = plan_for(packets.sensor.points_of("data"), packets.batch(), packets.table.groups[0])  # type: ignore[attr-defined]
    assert isinstance(found, Plan), found
    assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud)


@pytest.mark.parametrize("name", list(PARTS))
@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [*range(2), *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(2, 60))]
)
def test_kernels_of_a_random_function_give_the_plain_points(name: str, seed: int) -> None:
    pytest.importorskip("numba")
    packets = packets_of(name, seed, "jit")
    assert_same_points(evaluate(packets).cloud, evaluate_plainly(packets).cloud, ulps=6)
