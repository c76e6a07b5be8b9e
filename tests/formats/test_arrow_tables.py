"""Tests of Parquet, Arrow and Feather files, read with pyarrow, DuckDB and pandas."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarspec import simulate
from lidarspec.errors import UsageError
from lidarspec.formats import arrow_tables as tables, find_replaceable_files, write
from tests.formats.test_formats import COLUMNS, scan
from tests.libraries import Library, needs
from tests.shapes import SHAPES

pytestmark = [pytest.mark.slow, needs("pyarrow")]
arrow = Library("pyarrow")
ipc = Library("pyarrow.ipc")
feather = Library("pyarrow.feather")
parquet = Library("pyarrow.parquet")


def read_parquet(path: Path) -> Any:
    return parquet.read_table(path)


def read_arrow(path: Path) -> Any:
    return ipc.open_file(arrow.memory_map(str(path))).read_all()


def read_feather(path: Path) -> Any:
    return feather.read_table(path)


READERS: dict[str, Callable[[Path], Any]] = {
    "a.parquet": read_parquet,
    "a.arrow": read_arrow,
    "a.feather": read_feather,
}


@pytest.mark.parametrize("every_point", [False, True])
@pytest.mark.parametrize("name", READERS)
def test_tables_hold_the_columns_of_the_clouds(
    tmp_path: Path, name: str, every_point: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "MIN_GROUP_ROWS", 1000)
    scans = [
        scan(0),
        scan(1, points=2000),
        scan(2, points=0),
        *(scan(number) for number in range(3, 20)),
    ]
    write(tmp_path / name, scans, every_point=every_point)
    table = READERS[name](tmp_path / name)
    kept = [one.points.valid | every_point for one in scans]
    assert table.column_names == [*COLUMNS, "scan", "stamp", "complete"]
    for column in COLUMNS:
        values = table[column].to_numpy()
        assert values.dtype == scans[0].points.columns[column].dtype
        np.testing.assert_array_equal(
            values,
            np.concatenate(
                [one.points.columns[column][k] for one, k in zip(scans, kept, strict=True)]
            ),
        )
    numbers = np.repeat(np.arange(20), [k.sum() for k in kept])
    np.testing.assert_array_equal(table["scan"], numbers)
    np.testing.assert_array_equal(table["stamp"].cast("int64"), numbers + 10**18)
    np.testing.assert_array_equal(table["complete"], numbers > 0)


@pytest.mark.parametrize("name", READERS)
def test_tables_have_metadata(tmp_path: Path, name: str) -> None:
    sensor = SHAPES["shape-extras"]
    scans = list(sensor.scans(simulate(sensor, 60)))
    write(tmp_path / name, scans, every_point=True)
    table = READERS[name](tmp_path / name)
    told = {key.decode(): value.decode() for key, value in table.schema.metadata.items()}
    assert (told["sensor"], told["frame"], told["calibration"]) == (
        sensor.id,
        "x forward, y left, z up",
        "own",
    )
    units = {"x": "m", "azimuth": "rad", "time": "s", "velocity": "m/s", "signal": "photons"}
    assert {key: json.loads(told["units"])[key] for key in units} == units
    assert {key: table.schema.field(key).metadata[b"unit"].decode() for key in units} == units
    for key, column in scans[0].points.extra.items():
        assert table.schema.field(key).type == arrow.from_numpy_dtype(column.dtype)
        np.testing.assert_array_equal(
            table[key], np.concatenate([one.points.extra[key] for one in scans])
        )


def test_columns_missing_in_a_later_scan_are_nan_or_null(tmp_path: Path) -> None:
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
    write(
        tmp_path / "a.parquet",
        (scan(number, points=1000) for number in range(300)),
        every_point=True,
    )
    file = parquet.ParquetFile(tmp_path / "a.parquet")
    sizes = [file.metadata.row_group(number).num_rows for number in range(file.num_row_groups)]
    assert sizes == [132_000, 132_000, 36_000]
    assert file.metadata.row_group(1).column(file.schema.names.index("scan")).statistics.min == 132


def test_pandas_is_not_loaded_to_write(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    script = f"""
import sys
from pathlib import Path
from lidarspec.formats import write
from tests.formats.test_formats import scan
write(Path({str(tmp_path)!r}) / "a.parquet", [scan(0), scan(1)])
print("pandas" in sys.modules)
"""
    assert (
        subprocess.run(
            [sys.executable, "-c", script], check=True, timeout=60, capture_output=True, text=True
        ).stdout
        == "False\n"
    )


def test_folders_of_scans_are_partitions_for_others(tmp_path: Path) -> None:
    duckdb, pandas, datasets = (
        pytest.importorskip(name) for name in ("duckdb", "pandas", "pyarrow.dataset")
    )
    scans = [scan(number, points=50) for number in range(12)]
    write(tmp_path / "out" / "scan=%d" / "points.parquet", scans)
    assert sorted(folder.name for folder in (tmp_path / "out").iterdir()) == sorted(
        f"scan={number}" for number in range(12)
    )
    expected = [
        (number, one.points.x[one.points.valid].sum(dtype=np.float64))
        for number, one in enumerate(scans)
    ]
    query = (
        f"select scan, sum(x::double) from '{tmp_path}/out/*/*.parquet' where scan > 3 group by 1"
        " order by 1"
    )
    assert duckdb.sql(query).fetchall() == [
        (number, pytest.approx(total)) for number, total in expected[4:]
    ]
    table = datasets.dataset(tmp_path / "out", partitioning="hive").to_table(
        filter=datasets.field("scan") == 7
    )
    assert (table.num_rows, set(table["scan"].to_pylist())) == (49, {7})
    frame = pandas.read_parquet(tmp_path / "out")
    assert {
        int(number): float(part.x.sum()) for number, part in frame.groupby("scan", observed=True)
    } == pytest.approx(dict(expected), rel=1e-5)


def test_times_in_the_name_share_scans_out(tmp_path: Path) -> None:
    def at(number: int, seconds: int) -> Any:
        one = scan(number)
        return replace(one, points=replace(one.points, stamp_ns=seconds * 10**9 + 5))

    name = tmp_path / "date=%F" / "hour=%H" / "%M.parquet"
    write(
        name, [at(number, seconds) for number, seconds in enumerate([0, 59, 60, 3 * 3600, 86_400])]
    )
    files = [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.rglob("*.parquet"))]
    assert files == [
        f"date=1970-01-{place}.parquet"
        for place in ("01/hour=00/00", "01/hour=00/01", "01/hour=03/00", "02/hour=00/00")
    ]
    numbers = [
        set(parquet.ParquetFile(tmp_path / file).read()["scan"].to_pylist()) for file in files
    ]
    assert numbers == [{0, 1}, {2}, {3}, {4}]  # they count on
    assert find_replaceable_files(name) == [str(tmp_path / file) for file in files]
    with pytest.raises(UsageError, match=r"00\.parquet would be written twice"):
        write(tmp_path / "%H.parquet", [at(0, 0), at(1, 3600), at(2, 86_400)])


def test_duckdb_and_pandas_read_times_to_the_nanosecond(tmp_path: Path) -> None:
    duckdb = pytest.importorskip("duckdb")
    write(tmp_path / "a.parquet", [scan(0), scan(1, points=50)])
    query = (
        f"select scan, stamp::varchar, count(*), max(x) from '{tmp_path / 'a.parquet'}' group by"
        " all order by scan"
    )
    first, second = duckdb.sql(query).fetchall()
    assert first[:3] == (0, "2001-09-09 01:46:40", 4)
    assert second[:3] == (1, "2001-09-09 01:46:40.000000001", 49)
    assert second[3] == np.nanmax(scan(1, points=50).points.x)
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_parquet(tmp_path / "a.parquet")
    assert str(frame.stamp.dtype) == "datetime64[ns]"
    assert frame.stamp.astype("int64").tolist() == [10**18] * 4 + [10**18 + 1] * 49
