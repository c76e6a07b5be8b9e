"""Write tables with pyarrow, one row per point: Parquet, Arrow and Feather.

Arrow and Feather files can be memory-mapped. Scans are joined to row groups or record batches of at
least `ROWS` points. Columns are passed on without a copy.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarspec.formats.common import select_points, write_in_thread
from lidarspec.optional_libraries import import_library
from lidarspec.points.cloud import PointCloud, units_of
from lidarspec.points.table_types import arrow_schema
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: minimum number of points of a row group or record batch, except the last one.
ROWS = 1 << 17
#: maximum number of scans of this size that are not joined.
MANY = 8


def _write(
    path: Path, scans: Iterable[Scan], *, every_point: bool, open_writer: Callable[[Path, Any], Any]
) -> None:
    """Write the columns of the first scan, and the scan of each point.

    `scan` is its number; `stamp` its stamp as a timestamp in ns without a zone, which pandas and
    DuckDB keep exactly (`time` counts from it); `complete` is as in `Scan`. If a later scan lacks a
    column, its values are nan, or null for integers. With `every_point`, x, y and z of a point
    without a return are nan. The metadata of a field has its unit. The metadata of the schema has
    `sensor`, `source` (the facts about its format), `frame` (the directions of x, y and z), `units`
    as JSON, and `calibration`: "nominal" or "own".
    """
    tables = iter_tables(scans, path, every_point=every_point)
    first = next(tables)
    with open_writer(path, first.schema) as writer, write_in_thread(writer.write_table) as write:
        for table in itertools.chain([first], tables):
            write(table)


def iter_tables(
    scans: Iterable[Scan], path: Path | None = None, *, every_point: bool
) -> Iterator[Any]:
    """Yield the points of scans as tables of at least `ROWS` rows, and at least one.

    Args:
        path: of the file; a column that its folder names, such as scan=7, is left out, as in Hive.
    """
    arrow = import_library("pyarrow", "arrow")
    of_scans = _of_scans(path)
    schema = None
    gathered = list[Any]()
    rows = 0
    for place, scan in enumerate(scans):
        cloud = select_points(scan, every_point=every_point)
        schema = schema or _schema(arrow, scan, cloud, of_scans)
        gathered.append(
            _batch(arrow, schema, cloud, place if scan.number is None else scan.number, scan)
        )
        rows += len(cloud)
        if rows >= ROWS:
            yield _table(arrow, gathered, schema)
            gathered = []
            rows = 0
    if gathered or schema is None:
        yield _table(arrow, gathered, schema or arrow.schema(of_scans))


def _table(arrow: Any, batches: Sequence[Any], schema: Any) -> Any:
    """Return the rows of some batches as a table; many small ones are joined."""
    table = arrow.Table.from_batches(batches, schema)
    if len(batches) > MANY:
        return table.combine_chunks()
    return table


def _of_scans(path: Path | None) -> list[Any]:
    """Return the fields about the scan of a point, except those that the folder names."""
    arrow = import_library("pyarrow", "arrow")
    folders = path.parent.parts if path else ()
    named = {part.partition("=")[0] for part in folders if "=" in part}
    types = {"scan": arrow.int32(), "stamp": arrow.timestamp("ns"), "complete": arrow.bool_()}
    return [
        arrow.field(name, kind, nullable=False) for name, kind in types.items() if name not in named
    ]


def _schema(arrow: Any, scan: Scan, cloud: PointCloud, of_scans: Sequence[Any]) -> Any:
    """Return the schema of the points of a scan."""
    schema = arrow_schema(cloud.columns, units_of(cloud), scan.facts)
    return arrow.schema([*schema, *of_scans], schema.metadata)


def _batch(arrow: Any, schema: Any, cloud: PointCloud, number: int, scan: Scan) -> Any:
    """Return the points of a scan as a record batch."""
    own: dict[str, Any] = {**cloud.columns}
    for name, value in (
        ("scan", np.int32(number)),
        ("stamp", np.datetime64(scan.stamp_ns, "ns")),
        ("complete", scan.complete),
    ):
        own[name] = np.full(len(cloud), value)
    for field in schema:
        if field.name not in own:
            if not field.nullable:
                own[field.name] = np.full(len(cloud), np.nan)
            else:
                own[field.name] = arrow.nulls(len(cloud), field.type)
    return arrow.RecordBatch.from_arrays(
        [_array(arrow, own[field.name], field.type) for field in schema], schema=schema
    )


def _array(arrow: Any, values: Any, kind: Any) -> Any:
    """Return values as an Arrow array.

    Values of the right type are not converted, because pyarrow loads pandas for that, which takes
    0.2 s.
    """
    if not isinstance(values, np.ndarray) or arrow.from_numpy_dtype(values.dtype) != kind:
        return arrow.array(values, kind)
    if values.dtype == np.bool_:
        data = np.packbits(values, bitorder="little")
    else:
        data = np.ascontiguousarray(values).view(np.uint8)
    return arrow.Array.from_buffers(kind, len(values), [None, arrow.py_buffer(data)])


def open_parquet(path: Path, schema: Any) -> Any:
    """Return a Parquet writer, without compression.

    Compression would take longer than everything else. Columns with few values use a dictionary.
    """
    few = [field.name for field in schema if str(field.type) not in ("float", "double", "bool")]
    timed = [name for name in ("scan", "stamp") if name in schema.names]
    parquet = import_library("pyarrow.parquet", "arrow")
    return parquet.ParquetWriter(
        path, schema, compression="none", use_dictionary=few, write_statistics=timed
    )


def open_batches(path: Path, schema: Any, compression: str | None) -> Any:
    """Return a writer of Arrow's file format."""
    ipc = import_library("pyarrow.ipc", "arrow")
    return ipc.new_file(str(path), schema, options=ipc.IpcWriteOptions(compression=compression))


PARQUET = Format(
    ".parquet", "Parquet, one row per point (pyarrow)", partial(_write, open_writer=open_parquet)
)
ARROW = Format(
    ".arrow",
    "Arrow, one row per point, for memory mapping (pyarrow)",
    partial(_write, open_writer=partial(open_batches, compression=None)),
)
FEATHER = Format(
    ".feather",
    "Arrow, compressed with LZ4 (pyarrow)",
    partial(_write, open_writer=partial(open_batches, compression="lz4")),
)
