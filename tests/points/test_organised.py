"""Tests of columns of pixels, and of their clouds as images.

The arrays that values run along were calculated by hand.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lidarspec import PointCloud, UsageError, simulate
from lidarspec.points.evaluate import evaluate
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.spec import Fields, Polar, stack
from tests.agreement import assert_same_points
from tests.by_construct import reader
from tests.points.backends import EVERY_BACKEND
from tests.shapes import SHAPES
from tests.shapes.columns import AZIMUTHS, COLUMNS, PIXELS, TURN

SENSOR = SHAPES["shape-columns"]


def frame(first: int, **of_all: Any) -> bytes:
    pixel = [dict(range=100 + pixel, signal=2) for pixel in range(PIXELS)]
    columns = [
        dict(timestamp=1000 * number, measurement=number, status=1, pixels=pixel)
        for number in range(first, first + COLUMNS)
    ]
    return SENSOR.build(
        "data",
        **{
            "frame": 1,
            "shifts": [10 * pixel for pixel in range(PIXELS)],
            "gains": list(range(COLUMNS)),
            "columns": columns,
            **of_all,
        },
    )


def cloud_of(*frames: bytes, points: Any = SENSOR.points, backend: str = "auto") -> PointCloud:
    return reader(replace(SENSOR, points=points), backend).decode(list(frames)).points()


@EVERY_BACKEND
def test_axes_of_values(backend: str) -> None:
    cloud = cloud_of(frame(16), backend=backend)
    assert cloud.shape == (COLUMNS, PIXELS)
    at = 5 * PIXELS + 7
    assert cloud.range[at] == np.float32(1.07)
    np.testing.assert_allclose(cloud.azimuth[at], AZIMUTHS[21, 7] + np.deg2rad(0.07), atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(cloud.elevation[at]), 7 - 15.5, atol=1e-5)
    np.testing.assert_allclose(cloud.time[at], 5e-3, atol=1e-12)
    assert (cloud.intensity[at], cloud.ring[at], cloud.column[at]) == (10, 7, 21)  # type: ignore[index]


def two_returns(f: Fields) -> Polar:
    pixels = f.columns.pixels
    return Polar(
        range=stack(pixels.range, pixels.range + 1),
        azimuth=0,
        return_index=stack(0, pixels.signal * 0 + 1),
        column=f.columns.measurement,
    )


@EVERY_BACKEND
def test_the_shape_is_columns_and_rows_for_two_returns_too(backend: str) -> None:
    cloud = cloud_of(frame(0), frame(32), points=two_returns, backend=backend)
    assert cloud.shape == (2 * COLUMNS, PIXELS)
    assert cloud.range.reshape(*cloud.shape, -1)[20, 3].tolist() == pytest.approx([1.03, 2.03])
    half = cloud[COLUMNS * PIXELS * 2 :]
    assert (half.shape, cloud[1:].shape) == ((COLUMNS, PIXELS), None)
    picture = half.organise(TURN)
    assert picture.shape == (TURN, PIXELS)
    assert picture.return_index.reshape(TURN, PIXELS, 2)[50, 9].tolist() == [0, 1]  # type: ignore[union-attr]
    assert picture.range.reshape(TURN, PIXELS, 2)[33, 4].tolist() == pytest.approx([1.04, 2.04])


def test_rows_are_viewed_or_gathered() -> None:
    # The columns also pass the end of the table.
    in_order = [frame(first) for first in (*range(16, TURN, COLUMNS), 0, 16)]
    beyond, mixed = [frame(TURN - 1)], [frame(0), frame(32)]
    for frames in (in_order, beyond, mixed, in_order * 40 + beyond):
        read = reader(SENSOR, "numpy").decode(frames)
        assert_same_points(evaluate(read).cloud, evaluate_plainly(read).cloud)


@EVERY_BACKEND
def test_lost_columns_leave_gaps_in_the_place_of_their_numbers(backend: str) -> None:
    cloud = cloud_of(frame(48), frame(16), backend=backend).organise(TURN)
    assert (cloud.shape, len(cloud)) == ((TURN, PIXELS), TURN * PIXELS)
    valid = cloud.valid.reshape(TURN, PIXELS)
    assert valid.all(axis=1).nonzero()[0].tolist() == [*range(16, 32), *range(48, 64)]
    assert not valid[:16].any()
    assert np.isnan(cloud.range.reshape(TURN, PIXELS)[40]).all()
    assert np.array_equal(cloud.ring.reshape(TURN, PIXELS)[40], np.arange(PIXELS))  # type: ignore[union-attr]
    assert np.array_equal(cloud.column.reshape(TURN, PIXELS)[:, 0], np.arange(TURN))  # type: ignore[union-attr]
    shifts = [row % 3 * 8 - 8 for row in range(PIXELS)]
    straight = cloud.destagger(shifts)
    for row, shift in enumerate(shifts):
        expected = np.roll(cloud.x.reshape(TURN, PIXELS)[:, row], shift)
        np.testing.assert_array_equal(straight.x.reshape(TURN, PIXELS)[:, row], expected)
    assert straight.shape == (TURN, PIXELS)


def test_points_without_a_grid_are_refused() -> None:
    cloud = cloud_of(frame(0), frame(16))
    for wrong, said in (
        (
            lambda: cloud_of(frame(0), frame(0)).organise(TURN),
            "the column number 0 occurs 2 times",
        ),
        (lambda: cloud.organise(20), "the column number 20 is not below 20"),
        (
            lambda: cloud[cloud.valid].organise(TURN),
            "requires organised points with column numbers",
        ),
        (lambda: cloud.destagger([1, 2]), "expected one shift for each of 32 rows, got 2"),
        (
            lambda: cloud[3:].destagger([1, 2]),
            "the points are not organised in rows and columns",
        ),
    ):
        with pytest.raises(UsageError, match=said):
            wrong()


def test_a_lost_packet_is_a_gap_of_its_scan() -> None:
    frames = simulate(SENSOR, 12)
    scans = list(SENSOR.scans(frames[:6] + frames[7:]))
    assert [scan.points.shape for scan in scans] == [
        (TURN, PIXELS),
        (TURN - COLUMNS, PIXELS),
        (TURN, PIXELS),
    ]
    valid = scans[1].points.organise(TURN).valid.reshape(TURN, PIXELS)
    assert not valid[2 * COLUMNS : 3 * COLUMNS].any()
    assert valid[: 2 * COLUMNS].any(axis=1).all()
