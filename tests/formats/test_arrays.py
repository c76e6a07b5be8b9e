"""Tests of Zarr files, read with zarr."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidarspec import simulate
from lidarspec.formats import arrays as ours, write
from tests.formats.test_formats import COLUMNS, scan
from tests.libraries import Library, needs
from tests.shapes import SHAPES

pytestmark = [pytest.mark.slow, needs("zarr")]
zarr = Library("zarr")


@pytest.mark.parametrize("every_point", [False, True])
def test_arrays_hold_the_columns_of_the_clouds_and_the_stamps(
    tmp_path: Path, every_point: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ours, "POINT_CHUNK", 1000)
    scans = [
        scan(0),
        scan(1, points=2000),
        scan(2, points=0),
        *(scan(number, points=300) for number in range(3, 10)),
    ]
    write(tmp_path / "a.zarr", scans, every_point=every_point)
    group = zarr.open_group(tmp_path / "a.zarr", mode="r")
    kept = [one.points.valid | every_point for one in scans]
    assert {*group.array_keys()} == {*COLUMNS, "scan", "stamp_ns", "rate_hz", "complete"}
    for name in COLUMNS:
        expected = np.concatenate(
            [one.points.columns[name][k] for one, k in zip(scans, kept, strict=True)]
        )
        assert group[name].dtype == expected.dtype
        np.testing.assert_array_equal(group[name][:], expected)
    np.testing.assert_array_equal(
        group["scan"][:], np.repeat(np.arange(10), [k.sum() for k in kept])
    )
    assert group["stamp_ns"][:].tolist() == [10**18 + number for number in range(10)]
    assert group["rate_hz"][:].tolist() == [10 + number for number in range(10)]
    assert group["complete"][:].tolist() == [False] + [True] * 9


def test_units_stand_beside_the_arrays(tmp_path: Path) -> None:
    sensor = SHAPES["shape-extras"]
    scans = list(sensor.scans(simulate(sensor, 60)))
    write(tmp_path / "a.zarr", [*scans, scan(1)], every_point=True)
    group = zarr.open_group(tmp_path / "a.zarr", mode="r")
    units = {"x": "m", "azimuth": "rad", "time": "s", "velocity": "m/s", "signal": "photons"}
    assert {name: group[name].attrs["units"] for name in units} == units
    assert (group.attrs["sensor"], group.attrs["frame"]) == (sensor.id, "x forward, y left, z up")
    for name, column in scans[0].points.extra.items():
        assert group[name].dtype == column.dtype
        np.testing.assert_array_equal(
            group[name][:-5], np.concatenate([one.points.extra[name] for one in scans])
        )
    assert np.isnan(group["velocity"][-5:]).all()


def test_no_scans_give_a_group_of_empty_arrays(tmp_path: Path) -> None:
    write(tmp_path / "a.zarr", [scan(0)])
    write(tmp_path / "a.zarr", [])
    group = zarr.open_group(tmp_path / "a.zarr", mode="r")
    assert {name: array.shape for name, array in group.arrays()} == dict.fromkeys(
        ["scan", "stamp_ns", "rate_hz", "complete"], (0,)
    )
