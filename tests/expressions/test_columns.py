"""Tests of array elements, indices, lookup tables and sums along an axis.

Every engine gives the same results.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from construct import Array, Const, Int8ub, Int16ub, Int32ub, Struct, this

from lidarspec import PointCloud, SpecError
from lidarspec.spec import Clock, Fields, OnChange, PacketCounter, Polar, Scaled, running, take
from tests.by_construct import reader
from tests.engine import against_construct

ENGINES = ["construct", "numpy", pytest.param("jit", marks=pytest.mark.slow)]
COLUMN = Struct(
    "time" / Scaled(Int32ub, 1e-9, "s"),
    "number" / Int8ub,
    "pixels" / Array(3, Struct("range" / Scaled(Int16ub, 0.1, "m"), "tag" / Int8ub)),
)
DATA = Struct(
    "header" / Const(b"\xc0\x15"),
    "count" / Int8ub,
    "grid" / Array(2, Array(3, Int8ub)),
    "tail" / Array(this.count, Int8ub),
    "columns" / Array(4, COLUMN),
)
SENSOR = replace(
    against_construct.sensor(DATA),
    clock=Clock("columns[0].time"),
    scan=OnChange("columns[-1].number"),
)


def frame(count: int, time: int = 0, number: int = 0) -> bytes:
    columns = [
        dict(
            time=time + column,
            number=number + column,
            pixels=[dict(range=10 * column + pixel + 1, tag=pixel) for pixel in range(3)],
        )
        for column in range(4)
    ]
    return SENSOR.build(
        "data",
        count=count,
        grid=[[1, 2, 3], [4, 5, 6]],
        tail=list(range(10, 10 + count)),
        columns=columns,
    )


def cloud_of(points: Any, *frames: bytes, engine: str) -> PointCloud:
    return reader(replace(SENSOR, points=points), engine).decode(b"".join(frames)).points()


@pytest.mark.parametrize("engine", ENGINES)
def test_elements_of_arrays_are_fields(engine: str) -> None:
    def points(f: Fields) -> Polar:
        return Polar(
            range=f.columns.pixels.range,
            azimuth=f.columns[1].pixels[-1].range * 0.1
            + f.columns[2].pixels.tag
            + f.grid[1].on("pixels") * 0.01,
            intensity=f.grid[1][2] + 10 * f.tail[-1] + 1000 * np.nan_to_num(f.tail[1]),
            time=f.columns.time - f.columns[0].time,
        )

    cloud = cloud_of(points, frame(2), frame(1), frame(3), engine=engine)
    np.testing.assert_allclose(cloud.azimuth[:3], [0.17, 1.18, 2.19], rtol=1e-6)
    assert cloud.intensity is not None
    assert cloud.intensity[::12].tolist() == [6 + 110 + 11_000, 6 + 100, 6 + 120 + 11_000]
    np.testing.assert_allclose(cloud.time[:12:3], [0, 1e-9, 2e-9, 3e-9])


@pytest.mark.parametrize("engine", ["construct", "auto"])
def test_clocks_counters_and_cuts_are_elements_too_in_integers(engine: str) -> None:
    times = [4_000_000_001, 4_000_000_004, 4_000_000_013, 4_000_000_016]
    counted = replace(SENSOR, sequence=PacketCounter("columns[3].number"))
    packets = reader(counted, engine).decode(
        b"".join(frame(1, time, number) for number, time in zip([0, 1, 4, 5], times, strict=True)),
    )
    assert packets.time_ns.tolist() == times
    assert packets.stats.lost == 2
    assert packets["columns[-1].number"].tolist() == [3, 4, 7, 8]
    data = b"".join(
        frame(1, 1000 * place, number) for place, number in enumerate((0, 0, 1, 1, 1, 2, 2))
    )
    assert [len(scan.points) for scan in reader(SENSOR, engine).scans(data)] == [2, 3, 2]


def test_missing_elements_are_named() -> None:
    for points, named in (
        (lambda f: Polar(range=f.columns[4].time, azimuth=0), r"columns\[4\]"),
        (lambda f: Polar(range=f.columns[0:2].time, azimuth=0), "index"),
        (lambda f: Polar(range=(f.columns.time * 2)[0], azimuth=0), "only a field"),
    ):
        with pytest.raises(SpecError, match=named):
            cloud_of(points, frame(1), engine="auto")


@pytest.mark.parametrize("engine", ENGINES)
def test_tables_over_two_arrays_are_read_by_rows(engine: str) -> None:
    table = np.arange(18.0).reshape(6, 3) / 100

    def points(f: Fields) -> Polar:
        angles = take(table, f.columns.number)
        return Polar(
            range=f.columns.pixels.range,
            azimuth=angles,
            elevation=take(table, f.grid[0][0]),
            intensity=np.cos(angles * 2) + f.count,
        )

    cloud = cloud_of(points, frame(1, number=3), frame(2), engine=engine)
    expected = np.concatenate(
        [np.resize(np.pad(table[3:], ((0, 1), (0, 0)), constant_values=np.nan), (4, 3)), table[:4]]
    )
    np.testing.assert_allclose(cloud.azimuth.reshape(8, 3), expected, rtol=1e-6)
    np.testing.assert_allclose(cloud.elevation.reshape(8, 3), np.tile(table[1], (8, 1)), rtol=1e-6)
    counts = np.repeat([[1.0], [2.0]], 4, axis=0)
    np.testing.assert_allclose(
        cloud.intensity.reshape(8, 3), np.nan_to_num(np.cos(expected * 2) + counts), rtol=1e-6
    )  # type: ignore[union-attr]
    assert not cloud.valid[9:12].any()
    np.testing.assert_allclose(
        cloud.x.reshape(8, 3)[4],
        np.array([0.1, 0.2, 0.3]) * np.cos(table[0]) * np.cos(table[1]),
        rtol=1e-6,
    )


def test_rows_of_arrays_are_picked_from_tables() -> None:
    table = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(take(table, np.array([[1], [2]])), [[[3, 4, 5]], [[np.nan] * 3]])


@pytest.mark.parametrize("engine", ENGINES)
def test_differences_are_summed_along_their_innermost_array(engine: str) -> None:
    def points(f: Fields) -> Polar:
        return Polar(
            range=running(f.columns.pixels.range),
            azimuth=running(f.columns.number) * 0.01,
            intensity=running(f.tail).on("columns"),
        )

    cloud = cloud_of(points, frame(4), frame(4, number=1), engine=engine)
    np.testing.assert_allclose(cloud.range[:6], [0.1, 0.3, 0.6, 1.1, 2.3, 3.6], rtol=1e-6)
    np.testing.assert_allclose(cloud.azimuth[12::3], [0.01, 0.03, 0.06, 0.1], rtol=1e-6)
    assert cloud.intensity[::3].tolist() == [10, 21, 33, 46] * 2  # type: ignore[index]
