"""Tests of E57 files, read with pye57 and libE57Format."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarspec import simulate
from lidarspec.formats import write
from tests.formats.test_formats import scan
from tests.formats.test_las import with_points
from tests.libraries import Library, needs
from tests.shapes import SHAPES

pytestmark = [pytest.mark.slow, needs("pye57")]
pye57 = Library("pye57")


def field(file: Any, number: int, name: str, dtype: Any) -> np.ndarray:
    """Return a field that pye57 does not name."""
    points = file.get_header(number).points
    values = np.empty(points.childCount(), dtype)
    buffers = pye57.libe57.VectorSourceDestBuffer()
    buffers.append(
        pye57.libe57.SourceDestBuffer(file.image_file, name, values, len(values), True, True)
    )
    points.reader(buffers).read()
    return values


@pytest.mark.parametrize("every_point", [False, True])
def test_every_scan_has_its_header_and_points(tmp_path: Path, every_point: bool) -> None:
    scans = [scan(0, points=30_000), scan(1, intensity=False), scan(2, points=0)]
    write(tmp_path / "a.e57", scans, every_point=every_point)
    file = pye57.E57(str(tmp_path / "a.e57"))
    assert file.scan_count == 3
    for number, one in enumerate(scans):
        cloud, header = one.points[one.points.valid], file.get_header(number)
        assert header.point_count == len(one if every_point else cloud)
        assert header["name"].value() == f"scan {number}"
        assert (header["sensorVendor"].value(), header["sensorModel"].value()) == (
            one.sensor.vendor,
            one.sensor.model,
        )
        assert header.acquisitionStart_dateTimeValue == pytest.approx(
            10**9 - 315_964_800 + 18, abs=1e-6
        )
        if not len(one):
            continue
        places = file.read_scan(number, intensity=one.points.intensity is not None)
        for axis, name in zip("xyz", ("cartesianX", "cartesianY", "cartesianZ"), strict=True):
            np.testing.assert_array_equal(places[name], cloud.columns[axis])
        if cloud.intensity is not None:
            np.testing.assert_array_equal(places["intensity"], cloud.intensity)
        assert (header.xMinimum, header.zMaximum) == (cloud.x.min(), cloud.z.max())
        np.testing.assert_array_equal(
            field(file, number, "timeStamp", np.float64),
            (one.points if every_point else cloud).time,
        )


def test_rings_returns_and_further_columns(tmp_path: Path) -> None:
    ring, order = np.arange(5, dtype=np.uint16) * 300, np.array([0, 1, 0, 1, 0], np.uint8)
    sensor = SHAPES["shape-extras"]
    extras = next(iter(sensor.scans(simulate(sensor, 60))))
    extras = with_points(
        extras, extra={**extras.points.extra, "on": np.arange(len(extras)) % 3 == 0}
    )
    write(
        tmp_path / "a.e57",
        [with_points(scan(0), ring=ring, return_index=order), extras],
        every_point=True,
    )
    file = pye57.E57(str(tmp_path / "a.e57"))
    assert field(file, 0, "rowIndex", np.uint16).tolist() == ring.tolist()
    assert file.get_header(0).rowMaximum == 1200
    assert field(file, 0, "returnIndex", np.uint8).tolist() == order.tolist()
    assert field(file, 0, "returnCount", np.uint8).tolist() == [2] * 5
    assert file.get_header(1)["description"].value().startswith("velocity [m/s], signal [photons]")
    for name, column in extras.points.extra.items():
        np.testing.assert_array_equal(field(file, 1, f"lidarspec:{name}", np.float64), column)


def test_no_scan_is_a_file_without_scans(tmp_path: Path) -> None:
    write(tmp_path / "a.e57", [])
    assert pye57.E57(str(tmp_path / "a.e57")).scan_count == 0
