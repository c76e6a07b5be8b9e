"""Tables for data tools, by pyarrow: Parquet for queries, Arrow and Feather to be mapped into
memory; a row a point.

Scans are gathered until there are `ROWS`, which are a row group or a record batch. Columns are
handed over as they are, without a copy.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarspec.formats.writing import behind, written
from lidarspec.libraries import import_library
from lidarspec.points.cloud import PointCloud, units_of
from lidarspec.points.table_types import arrow_schema
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: points of a row group or record batch at least, those at the end excepted.
ROWS = 1 << 17
#: scans of so many points that are not worth joining.
MANY = 8


def _write(
    path: Path, scans: Iterable[Scan], *, every_point: bool, open_writer: Callable[[Path, Any], Any]
) -> None:
    """Write the columns that the first scan has, and for each point of which scan it is.

    `scan` is its number, `stamp` its stamp, to which `time` is added, as a timestamp in ns without
    a zone, which pandas and DuckDB keep exactly; `complete` as in `Scan`. A column that a later
    scan lacks is nan there, or null where it holds whole numbers; with `every_point` x, y and z of
    a point without a return are nan. Each field has its unit in its metadata, and the schema's has
    `sensor`, `source` (what is known of its format), `frame` (where x, y and z point), `units` as
    JSON, and `calibration`: "nominal" or "own".
    """
    made = tables(scans, path, every_point=every_point)
    first = next(made)
    with open_writer(path, first.schema) as writer, behind(writer.write_table) as write:
        for table in itertools.chain([first], made):
            write(table)


def tables(scans: Iterable[Scan], path: Path | None = None, *, every_point: bool) -> Iterator[Any]:
    """The points of scans as tables of `ROWS` rows and more, at least one.

    Args:
        path: where they go; a column that a folder of it says already, such as scan=7, is left out,
            as Hive has it.
    """
    arrow = import_library("pyarrow", "arrow")
    of_scans = _of_scans(path)
    schema = None
    gathered = list[Any]()
    rows = 0
    for place, scan in enumerate(scans):
        cloud = written(scan, every_point=every_point)
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
    """The rows of some batches; many small ones are joined."""
    table = arrow.Table.from_batches(batches, schema)
    if len(batches) > MANY:
        return table.combine_chunks()
    return table


def _of_scans(path: Path | None) -> list[Any]:
    """The fields that say of each point which scan it is from, but for those that a folder says."""
    arrow = import_library("pyarrow", "arrow")
    folders = path.parent.parts if path else ()
    said = {part.partition("=")[0] for part in folders if "=" in part}
    types = {"scan": arrow.int32(), "stamp": arrow.timestamp("ns"), "complete": arrow.bool_()}
    return [
        arrow.field(name, kind, nullable=False) for name, kind in types.items() if name not in said
    ]


def _schema(arrow: Any, scan: Scan, cloud: PointCloud, of_scans: Sequence[Any]) -> Any:
    """The fields of a scan."""
    known = arrow_schema(cloud.columns, units_of(cloud), scan.facts)
    return arrow.schema([*known, *of_scans], known.metadata)


def _batch(arrow: Any, schema: Any, cloud: PointCloud, number: int, scan: Scan) -> Any:
    """The points of a scan as a record batch."""
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
    """Values as an array of Arrow. Of its type they are not converted: for that pyarrow loads
    pandas, which takes a fifth of a second.
    """
    if not isinstance(values, np.ndarray) or arrow.from_numpy_dtype(values.dtype) != kind:
        return arrow.array(values, kind)
    if values.dtype == np.bool_:
        data = np.packbits(values, bitorder="little")
    else:
        data = np.ascontiguousarray(values).view(np.uint8)
    return arrow.Array.from_buffers(kind, len(values), [None, arrow.py_buffer(data)])


def _parquet(path: Path, schema: Any) -> Any:
    """A writer of Parquet, not compressed, which takes longer than all else; numbers of few values
    take few bits, as in a dictionary.
    """
    few = [field.name for field in schema if str(field.type) not in ("float", "double", "bool")]
    timed = [name for name in ("scan", "stamp") if name in schema.names]
    parquet = import_library("pyarrow.parquet", "arrow")
    return parquet.ParquetWriter(
        path, schema, compression="none", use_dictionary=few, write_statistics=timed
    )


def _batches(path: Path, schema: Any, compression: str | None) -> Any:
    """A writer of Arrow's file format."""
    ipc = import_library("pyarrow.ipc", "arrow")
    return ipc.new_file(str(path), schema, options=ipc.IpcWriteOptions(compression=compression))


PARQUET = Format(
    ".parquet", "Parquet, one row a point (pyarrow)", partial(_write, open_writer=_parquet)
)
ARROW = Format(
    ".arrow",
    "Arrow, one row a point, to be mapped (pyarrow)",
    partial(_write, open_writer=partial(_batches, compression=None)),
)
FEATHER = Format(
    ".feather",
    "Arrow, compressed with LZ4 (pyarrow)",
    partial(_write, open_writer=partial(_batches, compression="lz4")),
)
