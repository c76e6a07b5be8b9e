"""Tables for data tools, by pyarrow: Parquet for queries, Arrow and Feather to be mapped into memory; a row a point.

Scans are gathered until there are `ROWS`, which are a row group or a record batch. Columns are handed over as they are, without a copy.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidarspec.errors import library
from lidarspec.formats.writing import facts, units_of, written
from lidarspec.points.cloud import PointCloud
from lidarspec.scans.scans import Scan
from lidarspec.transports.protocol import Format

#: points of a row group or record batch at least, those at the end excepted.
ROWS = 1 << 17
#: scans of so many points that are not worth joining.
MANY = 8


def _write(path: Path, scans: Iterable[Scan], *, every_point: bool, open_writer: Callable[[Path, Any], Any]) -> None:
    """Write the columns that the first scan has, and for each point of which scan it is.

    `scan` is its number, `stamp` its stamp, to which `time` is added, as a timestamp in ns without a zone, which pandas and DuckDB keep
    exactly; `complete` as in `Scan`. A column that a later scan lacks is nan there, or null where it holds whole numbers; with
    `every_point` x, y and z of a point without a return are nan. Each field has its unit in its metadata, and the schema's has `sensor`,
    `source` (what is known of its format), `frame` (where x, y and z point), `units` as JSON, and `calibration`: "nominal" or "own".
    """
    made = tables(scans, every_point=every_point)
    first = next(made)
    with open_writer(path, first.schema) as writer:
        for table in itertools.chain([first], made):
            writer.write_table(table)


def tables(scans: Iterable[Scan], *, every_point: bool) -> Iterator[Any]:
    """The points of scans as tables of `ROWS` rows and more, at least one."""
    arrow = library("pyarrow", "arrow")
    schema, gathered, rows = None, list[Any](), 0
    for place, scan in enumerate(scans):
        cloud = written(scan, every_point=every_point)
        schema = schema or _schema(arrow, scan, cloud)
        gathered.append(_batch(arrow, schema, cloud, place if scan.number is None else scan.number, scan))
        rows += len(cloud)
        if rows >= ROWS:
            yield _table(arrow, gathered, schema)
            gathered, rows = [], 0
    if gathered or schema is None:
        yield _table(arrow, gathered, schema or arrow.schema(_of_scans(arrow)))


def _table(arrow: Any, batches: Sequence[Any], schema: Any) -> Any:
    """The rows of some batches; many small ones are joined."""
    table = arrow.Table.from_batches(batches, schema)
    return table.combine_chunks() if len(batches) > MANY else table


def _of_scans(arrow: Any) -> list[Any]:
    """The fields that say of each point which scan it is from."""
    types = {"scan": arrow.int32(), "stamp": arrow.timestamp("ns"), "complete": arrow.bool_()}
    return [arrow.field(name, kind, nullable=False) for name, kind in types.items()]


def _schema(arrow: Any, scan: Scan, cloud: PointCloud) -> Any:
    """The fields of a scan. Those that cannot be null are written faster; of a float nan says that there is none."""
    units = units_of(cloud)
    fields = [
        arrow.field(name, arrow.from_numpy_dtype(column.dtype), column.dtype.kind != "f", {"unit": units.get(name, "")})
        for name, column in cloud.columns.items()
    ]
    return arrow.schema([*fields, *_of_scans(arrow)], facts(scan) | {"units": json.dumps(units)})


def _batch(arrow: Any, schema: Any, cloud: PointCloud, number: int, scan: Scan) -> Any:
    """The points of a scan as a record batch."""
    own: dict[str, Any] = {**cloud.columns}
    for name, value in (("scan", number), ("stamp", scan.stamp_ns), ("complete", scan.complete)):
        own[name] = arrow.repeat(arrow.scalar(value, schema.field(name).type), len(cloud))
    for field in schema:
        if field.name not in own:
            own[field.name] = np.full(len(cloud), np.nan) if not field.nullable else arrow.nulls(len(cloud), field.type)
    return arrow.record_batch([arrow.array(own[field.name], field.type) for field in schema], schema=schema)


def _parquet(path: Path, schema: Any) -> Any:
    """A writer of Parquet, not compressed, which takes longer than all else; numbers of few values take few bits, as in a dictionary."""
    few = [field.name for field in schema if str(field.type) not in ("float", "double", "bool")]
    parquet = library("pyarrow.parquet", "arrow")
    return parquet.ParquetWriter(path, schema, compression="none", use_dictionary=few, write_statistics=["scan", "stamp"])


def _batches(path: Path, schema: Any, compression: str | None) -> Any:
    """A writer of Arrow's file format."""
    ipc = library("pyarrow.ipc", "arrow")
    return ipc.new_file(str(path), schema, options=ipc.IpcWriteOptions(compression=compression))


PARQUET = Format(".parquet", "Parquet, one row a point (pyarrow)", partial(_write, open_writer=_parquet))
ARROW = Format(".arrow", "Arrow, one row a point, to be mapped (pyarrow)", partial(_write, open_writer=partial(_batches, compression=None)))
FEATHER = Format(".feather", "Arrow, compressed with LZ4 (pyarrow)", partial(_write, open_writer=partial(_batches, compression="lz4")))
