"""The fused back end gives the points of the plain evaluation: same masks, coordinates within six units in the last place."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import lidarspec
from lidarspec.links import is_datagram
from lidarspec.packets import Packets
from lidarspec.plans.evaluation import evaluated
from lidarspec.points import evaluate
from lidarspec.testing import material
from lidarspec.testing.comparisons import assert_same_points
from tests.shapes import SHAPES

pytest.importorskip("numba", reason="the fused back end needs Numba: pip install 'lidarspec[jit]'")

SENSORS = {**lidarspec.sensors(), **{name: sensor for name, sensor in SHAPES.items() if sensor.frames}}
ULPS = 6
MANY = 16


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = Path(os.environ.get("LIDARSPEC_CACHE") or tmp_path_factory.mktemp("kernels"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIDARSPEC_CACHE", str(folder))
        yield folder


@functools.cache
def frames_of(name: str) -> list[bytes]:
    sensor = SENSORS[name]
    return [sensor.example(sensor.data_frame, seed=seed) for seed in range(MANY)]


def packets_of(name: str, number: int) -> Packets:
    sensor, frames = SENSORS[name], frames_of(name)[:number]
    data: Any = frames if is_datagram(sensor.links.get("data")) else b"".join(frames)
    return sensor.decode(data, backend="jit")


@pytest.mark.parametrize("name", list(SENSORS))
def test_kernels_give_what_the_plain_evaluation_gives(name: str) -> None:
    for number in (1, 7, MANY):
        packets = packets_of(name, number)
        if len(packets):
            assert_same_points(evaluated(packets).cloud, evaluate(packets).cloud, ulps=ULPS)
            one, other = evaluated(packets, final=False, epoch=5), evaluate(packets, final=False, epoch=5)
            assert_same_points(one.cloud, other.cloud, ulps=ULPS)


@pytest.mark.parametrize("name", list(SENSORS))
def test_every_column_of_damaged_and_mixed_streams(name: str) -> None:
    sensor = SENSORS[name]
    packets = sensor.decode(material.stream(sensor), backend="jit")
    if len(packets):
        assert_same_points(evaluated(packets).cloud, evaluate(packets).cloud, ulps=ULPS)
