"""Tests of clouds and scans in NumPy, pyarrow, pandas, Polars, DuckDB and DLPack."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan, simulate
from lidarspec.errors import LibraryError
from tests.shapes import SHAPES


@pytest.fixture(scope="module")
def scan() -> Scan:
    sensor = SHAPES["shape-extras"]
    return next(iter(sensor.scans(simulate(sensor, 60))))


def test_a_cloud_is_an_array_of_points_for_numpy(scan: Scan) -> None:
    cloud = scan.points
    np.testing.assert_array_equal(np.asarray(cloud), np.stack([cloud.x, cloud.y, cloud.z], axis=1))
    assert np.asarray(cloud).dtype == np.float32
    assert np.array(cloud, np.float64).dtype == np.float64
    np.testing.assert_array_equal(np.asarray(cloud[3]), cloud.xyz[3])
    np.testing.assert_allclose(
        np.linalg.norm(cloud[cloud.valid], axis=1), cloud.range[cloud.valid], rtol=1e-5
    )
    with pytest.raises(ValueError, match="must be copied"):
        np.asarray(cloud, copy=False)


def test_a_point_can_be_read(scan: Scan) -> None:
    cloud = scan.points
    first = cloud[0]
    assert repr(first).startswith(f"Point(x={first.x:.6g} m, y={first.y:.6g} m, z=")
    assert f", azimuth={first.azimuth:.6g} rad, " in repr(first)
    assert f", velocity={cloud.extra['velocity'][0]:.6g} m/s, " in repr(first)
    lost = ls.PointCloud(*np.full((6, 2), np.nan, np.float32), np.zeros(2), np.zeros(2, np.bool_))
    assert repr(lost[-1]).endswith(", time=0 s, not valid)")
    assert len(list(lost)) == 2
    with pytest.raises(IndexError):
        lost[2]


def test_every_column_goes_over_dlpack(scan: Scan) -> None:
    for name, column in [*scan.points.columns.items(), ("valid", scan.points.valid)]:
        assert np.shares_memory(np.from_dlpack(column), column), name


@pytest.mark.slow
def test_arrow_takes_columns_without_a_copy_and_knows_their_units(scan: Scan) -> None:
    arrow, cloud = pytest.importorskip("pyarrow"), scan.points
    table = arrow.table(scan)
    assert table.column_names == list(cloud.columns)
    for name, column in cloud.columns.items():
        np.testing.assert_array_equal(table[name], column)
        assert column.dtype.kind == "b" or np.shares_memory(
            cloud.to_arrow()[name].to_numpy(), column
        ), name
    told = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    assert json.loads(told.pop("units"))["velocity"] == "m/s"
    assert told == scan.facts | {"stamp_ns": str(scan.stamp_ns)}
    assert told["sensor"] == "shape-extras"
    assert table.schema.field("azimuth").metadata == {b"unit": b"rad"}
    assert b"sensor" not in cloud.to_arrow().schema.metadata


@pytest.mark.slow
def test_duckdb_asks_a_cloud_and_a_scan(scan: Scan) -> None:
    duckdb = pytest.importorskip("duckdb")
    pytest.importorskip("pyarrow")
    cloud = scan.points
    assert duckdb.sql("select count(*), max(range) from cloud where not isnan(x)").fetchall() == [
        (int(cloud.valid.sum()), cloud.range[cloud.valid].max())
    ]
    assert duckdb.sql("select count(*) from scan").fetchall() == [(len(scan),)]


@pytest.mark.slow
def test_data_frames_share_the_columns(scan: Scan) -> None:
    pandas, polars, cloud = (
        pytest.importorskip("pandas"),
        pytest.importorskip("polars"),
        scan.points,
    )
    frame, polar = cloud.to_pandas(), cloud.to_polars()
    assert isinstance(frame, pandas.DataFrame)
    assert isinstance(polar, polars.DataFrame)
    assert (frame.attrs["units"]["x"], frame.attrs["stamp_ns"]) == ("m", cloud.stamp_ns)
    for name, column in cloud.columns.items():
        np.testing.assert_array_equal(frame[name], column)
        np.testing.assert_array_equal(polar[name], column)
        assert np.shares_memory(frame[name].to_numpy(), column), name
        assert column.dtype.kind == "b" or np.shares_memory(polar[name].to_numpy(), column), name
    assert polars.DataFrame(scan).columns == polar.columns


@pytest.mark.parametrize(
    ("library", "extra"), [("pyarrow", "arrow"), ("pandas", "pandas"), ("polars", "polars")]
)
def test_a_library_that_is_missing_is_named(
    scan: Scan, library: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(LibraryError) as caught:
        getattr(scan.points, f"to_{extra}")()
    assert (caught.value.distribution, caught.value.extra) == (library, extra)
