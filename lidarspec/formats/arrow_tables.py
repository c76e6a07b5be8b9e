"""Write tables with pyarrow, one row per point: Parquet, Arrow and Feather.

A row group or record batch has at least `MIN_GROUP_ROWS` points.
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

#: The minimum number of points in a row group or record batch; the last may have fewer.
MIN_GROUP_ROWS = 1 << 17
#: The maximum number of record batches in a table. More are copied to a single batch.
MAX_UNJOINED_BATCHES = 8


def _write(
    path: Path, scans: Iterable[Scan], *, every_point: bool, open_writer: Callable[[Path, Any], Any]
) -> None:
    """Write the points of scans as a table with the columns of the first scan.

    If a later scan lacks a column, its values are nan, or null for integers.
    """
    tables = iter_tables(scans, path, every_point=every_point)
    first = next(tables)
    with open_writer(path, first.schema) as writer, write_in_thread(writer.write_table) as write:
        for table in itertools.chain([first], tables):
            write(table)


def iter_tables(
    scans: Iterable[Scan], path: Path | None = None, *, every_point: bool
) -> Iterator[Any]:
    """Yield the points of scans as tables of at least `MIN_GROUP_ROWS` rows.

    Args:
        path: the path of the file. If a folder of the path has a name such as scan=7, the column
            `scan` is left out, because readers take it from the name (Hive partitioning).
        every_point: whether to include points without a valid return.
    """
    arrow = import_library("pyarrow", "arrow")
    scan_fields = _make_scan_fields(path)
    schema = None
    batches = list[Any]()
    row_count = 0
    for index, scan in enumerate(scans):
        cloud = select_points(scan, every_point=every_point)
        schema = schema or _make_schema(scan, cloud, scan_fields)
        number = index if scan.number is None else scan.number
        batches.append(_make_batch(arrow, schema, cloud, number, scan))
        row_count += len(cloud)
        if row_count >= MIN_GROUP_ROWS:
            yield _make_table(arrow, batches, schema)
            batches = []
            row_count = 0
    if batches or schema is None:
        yield _make_table(arrow, batches, schema or arrow.schema(scan_fields))


def _make_table(arrow: Any, batches: Sequence[Any], schema: Any) -> Any:
    """Return the rows of record batches as a table."""
    table = arrow.Table.from_batches(batches, schema)
    if len(batches) > MAX_UNJOINED_BATCHES:
        return table.combine_chunks()
    return table


def _make_scan_fields(path: Path | None) -> list[Any]:
    """Return the schema fields with facts about scans, except those in the path."""
    arrow = import_library("pyarrow", "arrow")
    folders = path.parent.parts if path else ()
    named = {part.partition("=")[0] for part in folders if "=" in part}
    types = {"scan": arrow.int32(), "stamp": arrow.timestamp("ns"), "complete": arrow.bool_()}
    return [
        arrow.field(name, kind, nullable=False) for name, kind in types.items() if name not in named
    ]


def _make_schema(scan: Scan, cloud: PointCloud, scan_fields: Sequence[Any]) -> Any:
    """Return the schema of the points of a scan."""
    arrow = import_library("pyarrow", "arrow")
    schema = arrow_schema(cloud.columns, units_of(cloud), scan.facts)
    return arrow.schema([*schema, *scan_fields], schema.metadata)


def _make_batch(arrow: Any, schema: Any, cloud: PointCloud, number: int, scan: Scan) -> Any:
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
        [_make_array(arrow, own[field.name], field.type) for field in schema], schema=schema
    )


def _make_array(arrow: Any, values: Any, kind: Any) -> Any:
    """Return values as an Arrow array."""
    # pyarrow's own conversion loads pandas, which takes 0.2 s.
    if not isinstance(values, np.ndarray) or arrow.from_numpy_dtype(values.dtype) != kind:
        return arrow.array(values, kind)
    if values.dtype == np.bool_:
        data = np.packbits(values, bitorder="little")
    else:
        data = np.ascontiguousarray(values).view(np.uint8)
    return arrow.Array.from_buffers(kind, len(values), [None, arrow.py_buffer(data)])


def open_parquet(path: Path, schema: Any) -> Any:
    """Return a writer of a Parquet file without compression."""
    dictionary_columns = [
        field.name for field in schema if str(field.type) not in ("float", "double", "bool")
    ]
    statistics_columns = [name for name in ("scan", "stamp") if name in schema.names]
    parquet = import_library("pyarrow.parquet", "arrow")
    return parquet.ParquetWriter(
        path,
        schema,
        # Compression would take longer than all other steps together.
        compression="none",
        use_dictionary=dictionary_columns,
        write_statistics=statistics_columns,
    )


def open_batches(path: Path, schema: Any, compression: str | None) -> Any:
    """Return a writer of Arrow's file format; `compression` is None or "lz4"."""
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
