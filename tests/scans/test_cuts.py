"""Tests of each cut rule on sequences of one value, with scans worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from lidarspec import Sensor, simulate
from lidarspec.scans.stream import iter_scans
from lidarspec.spec import OnChange, OnFlag, OnJump, OnRewind, OnWrap
from tests.shapes import SHAPES

POINTS_PER_FRAME = 4

#: a rule for `angle`, the angles of frames in degrees, and how many frames are in each scan.
CASES: dict[str, tuple[Any, list[float], list[int]]] = {
    "a wrap": (OnWrap("angle"), [240, 300, 359, 1, 60, 120, 180, 240, 300, 0, 60], [3, 6, 2]),
    "a wrap the other way": (
        OnWrap("angle"),
        [120, 60, 1, 359, 300, 240, 180, 120, 60, 359],
        [3, 6, 1],
    ),
    "a wrap elsewhere": (
        OnWrap("angle", at=90),
        [0, 60, 91, 150, 210, 270, 330, 30, 89, 90],
        [2, 7, 1],
    ),
    "jitter at the wrap": (
        OnWrap("angle"),
        [300, 330, 359, 0.5, 359.9, 0.3, 60, 120, 180, 240, 300, 1],
        [3, 8, 1],
    ),
    "a rewind": (OnRewind("angle"), [1, 2, 2, 3, 1, 1, 2], [4, 3]),
    "a change": (OnChange("angle"), [1, 1, 2, 2, 2, 1], [2, 3, 1]),
    "a flag": (OnFlag("angle", value=5), [1, 2, 5, 6, 7, 5], [2, 3, 1]),
    "a jump": (OnJump("angle", 10), [0, 10, 20, 30.01, 40], [3, 2]),
    "a jump across 0": (OnJump("angle", 10), [340, 350, 355, 4.9, 14, 30], [5, 1]),
}


def frames_of(sensor: Sensor, angles: list[float]) -> bytes:
    """Return a stream of one frame for each angle."""
    samples = [dict(quality=1, distance=1000)] * POINTS_PER_FRAME
    return b"".join(
        sensor.build("data", angle=round(angle * 100), samples=samples) for angle in angles
    )


@pytest.mark.parametrize("frames_per_batch", [1, 3, 100])
@pytest.mark.parametrize("case", CASES)
def test_scans_end_where_the_rule_says(case: str, frames_per_batch: int) -> None:
    rule, angles, sizes = CASES[case]
    sensor = replace(SHAPES["shape-middle"], scan=rule)
    packets = sensor.decode(frames_of(sensor, angles))
    assert len(packets) == len(angles)
    starts = range(0, len(packets), frames_per_batch)
    batches = [packets.take(slice(start, start + frames_per_batch)) for start in starts]
    scans = list(iter_scans(sensor, batches))
    assert [len(scan) // POINTS_PER_FRAME for scan in scans] == sizes


@pytest.mark.parametrize("frames_per_batch", [1, 100])
def test_a_period_begins_with_its_first_instant(frames_per_batch: int) -> None:
    """Each scan of the shape lasts 0.1 s."""
    sensor = SHAPES["shape-clock"]
    tenths_of_ms = [0, 500, 999, 1000, 1500, 2000, 2500, 4999]
    frames = [
        sensor.build("data", seconds=0, ticks=ticks, distances=[1000] * 4) for ticks in tenths_of_ms
    ]
    packets = sensor.decode(b"".join(frames))
    starts = range(0, len(packets), frames_per_batch)
    batches = [packets.take(slice(start, start + frames_per_batch)) for start in starts]
    assert [len(scan) // POINTS_PER_FRAME for scan in iter_scans(sensor, batches)] == [3, 2, 2, 1]


def test_a_rule_may_name_any_column_of_points() -> None:
    sensor = SHAPES["shape-lines"]
    data = b"".join(simulate(sensor, 20))
    points = len(sensor.decode(data).points())
    for name in ("z", "elevation"):  # of a planar sensor neither passes an angle
        scans = list(replace(sensor, scan=OnWrap(name)).scans(data))
        assert [len(scan.points) for scan in scans] == [points]
