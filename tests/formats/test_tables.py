"""Parquet, Arrow and Feather, as pyarrow, DuckDB and pandas read them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarspec.formats import tables, write
from lidarspec.simulation.simulator import simulate
from tests.formats.test_formats import COLUMNS, scan
from tests.shapes import SHAPES

arrow = pytest.importorskip("pyarrow")
ipc, feather, parquet = (pytest.importorskip(f"pyarrow.{name}") for name in ("ipc", "feather", "parquet"))

READERS: dict[str, Callable[[Path], Any]] = {
    "a.parquet": parquet.read_table,
    "a.arrow": lambda path: ipc.open_file(arrow.memory_map(str(path))).read_all(),
    "a.feather": feather.read_table,
}


@pytest.mark.parametrize("every_point", [False, True])
@pytest.mark.parametrize("name", READERS)
def test_tables_hold_the_columns_of_the_clouds(tmp_path: Path, name: str, every_point: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "ROWS", 1000)
    scans = [scan(0), scan(1, points=2000), scan(2, points=0), *(scan(number) for number in range(3, 20))]
    write(tmp_path / name, scans, every_point=every_point)
    table = READERS[name](tmp_path / name)
    kept = [one.points.valid | every_point for one in scans]
    assert table.column_names == [*COLUMNS, "scan", "stamp", "complete"]
    for column in COLUMNS:
        values = table[column].to_numpy()
        assert values.dtype == scans[0].points.columns[column].dtype
        np.testing.assert_array_equal(values, np.concatenate([one.points.columns[column][k] for one, k in zip(scans, kept, strict=True)]))
    numbers = np.repeat(np.arange(20), [k.sum() for k in kept])
    np.testing.assert_array_equal(table["scan"], numbers)
    np.testing.assert_array_equal(table["stamp"].cast("int64"), numbers + 10**18)
    np.testing.assert_array_equal(table["complete"], numbers > 0)


@pytest.mark.parametrize("name", READERS)
def test_tables_say_what_is_in_them(tmp_path: Path, name: str) -> None:
    sensor = SHAPES["shape-extras"]
    scans = list(sensor.scans(simulate(sensor, 60)))
    write(tmp_path / name, scans, every_point=True)
    table = READERS[name](tmp_path / name)
    told = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    assert (told["sensor"], told["frame"], told["calibration"]) == (sensor.id, "x forward, y left, z up", "own")
    units = {"x": "m", "azimuth": "rad", "time": "s", "velocity": "m/s", "signal": "photons"}
    assert {key: json.loads(told["units"])[key] for key in units} == units
    assert {key: table.schema.field(key).metadata[b"unit"].decode() for key in units} == units
    for key, column in scans[0].points.extra.items():
        assert table.schema.field(key).type == arrow.from_numpy_dtype(column.dtype)
        np.testing.assert_array_equal(table[key], np.concatenate([one.points.extra[key] for one in scans]))


def test_what_a_later_scan_lacks_is_nan_or_null(tmp_path: Path) -> None:
    sensor = SHAPES["shape-extras"]
    full = next(iter(sensor.scans(simulate(sensor, 60))))
    write(tmp_path / "a.parquet", [full, scan(1)], every_point=True)
    table = parquet.read_table(tmp_path / "a.parquet")
    assert np.isnan(table["velocity"].to_numpy()[-5:]).all()
    assert table["signal"].null_count == 5


@pytest.mark.parametrize("name", READERS)
def test_no_scan_is_a_table_without_rows(tmp_path: Path, name: str) -> None:
    write(tmp_path / name, [])
    table = READERS[name](tmp_path / name)
    assert (table.num_rows, table.column_names) == (0, ["scan", "stamp", "complete"])


def test_row_groups_are_of_many_scans_and_bounded(tmp_path: Path) -> None:
    write(tmp_path / "a.parquet", (scan(number, points=1000) for number in range(300)), every_point=True)
    file = parquet.ParquetFile(tmp_path / "a.parquet")
    sizes = [file.metadata.row_group(number).num_rows for number in range(file.num_row_groups)]
    assert sizes == [132_000, 132_000, 36_000]
    assert file.metadata.row_group(1).column(file.schema.names.index("scan")).statistics.min == 132


def test_duckdb_and_pandas_read_times_to_the_nanosecond(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    write(tmp_path / "a.parquet", [scan(0), scan(1, points=50)])
    query = f"select scan, stamp::varchar, count(*), max(x) from '{tmp_path / 'a.parquet'}' group by all order by scan"
    first, second = duckdb.sql(query).fetchall()
    assert first[:3] == (0, "2001-09-09 01:46:40", 4)
    assert second[:3] == (1, "2001-09-09 01:46:40.000000001", 49)
    assert second[3] == np.nanmax(scan(1, points=50).points.x)
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_parquet(tmp_path / "a.parquet")
    assert str(frame.stamp.dtype) == "datetime64[ns]"
    assert frame.stamp.astype("int64").tolist() == [10**18] * 4 + [10**18 + 1] * 49
