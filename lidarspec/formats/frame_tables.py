"""Write frames of any type, one row per frame, with physical values of the fields.

A row has the time of the frame, `time_ns`, and each field that is not constant. Each element of an
array of numbers is a column, for example `gains[2]`. A part of a frame (a frame within the frame)
counts as a frame of another type, and has a row of its own.

A table contains one frame type. An MCAP file has a topic for each type, with JSON messages.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError
from lidarspec.formats.arrow_tables import ARROW, FEATHER, PARQUET, open_batches, open_parquet
from lidarspec.formats.bags import CHUNK_BYTES, MCAP
from lidarspec.formats.common import replace_file, write_in_thread
from lidarspec.formats.text import CSV, CSV_GZ, open_text_file
from lidarspec.optional_libraries import import_library
from lidarspec.packets.packets import Packets
from lidarspec.spec.tree import FieldInfo

#: Columns by name: arrays of numbers, or lists of texts.
Columns = dict[str, Any]
#: The packets that arrived together, by frame type.
Batch = Mapping[str, Packets]


def frame_columns(packets: Packets) -> Columns:
    """Return the columns of packets: `time_ns`, and all fields that are not constant."""
    columns: Columns = {"time_ns": packets.time_ns}
    schema = packets.table.schema
    for path in schema.fields:
        info = schema.columns[path]
        if info.const is not None:
            continue
        if info.kind == "other":
            columns |= _format_objects(path, packets.table.raw(path))
        elif info.kind == "bytes":
            is_text = getattr(packets.sensor.frames[packets.frame_type].wire, "is_text", False)
            columns[path] = _format_bytes(packets.table.raw(path), is_text=is_text)
        else:
            columns |= _split_elements(path, _read_numbers(packets, path, info))
    return columns


def _read_numbers(packets: Packets, path: str, info: FieldInfo) -> NDArray[Any]:
    """Return a field in its unit, (n, ...).

    Integers without a unit remain integers if all frames have the field.
    """
    values = packets[path]
    if info.kind == "int" and not info.scaled and values.ndim == 1 and not np.isnan(values).any():
        return packets.table.raw(path)
    return values


def _split_elements(path: str, values: NDArray[Any]) -> Columns:
    """Return a column for each element of an array field, or one column for a scalar."""
    if values.ndim == 1:
        return {path: values}
    columns: Columns = {}
    for index in np.ndindex(values.shape[1:]):
        name = path + "".join(f"[{number}]" for number in index)
        columns[name] = values[(slice(None), *index)]
    return columns


def _format_bytes(values: NDArray[Any], *, is_text: bool) -> list[str]:
    """Return the bytes of a field, (n, ..., bytes), as one text per frame."""
    rows = [row.tobytes() for row in values]
    if is_text:
        return [row.rstrip(b"\x00").decode("ascii", "backslashreplace") for row in rows]
    return [row.hex(" ") for row in rows]


def _format_objects(path: str, values: NDArray[Any]) -> Columns:
    """Return a column of texts for each element of a field whose values are objects."""
    return {
        name: ["" if value is None else str(value) for value in column.tolist()]
        for name, column in _split_elements(path, values).items()
    }


def write_frames(path: str | Path, batches: Iterable[Batch]) -> int:
    """Write frames to a file in the format of its suffix; return the number of frames.

    Args:
        path: the file. The suffixes .csv, .csv.gz, .parquet, .arrow and .feather require frames of
            one type. An .mcap file can contain several types.
        batches: the frames.

    Raises:
        UsageError: for any other suffix.
        SourceError: if the file cannot be written.
    """
    path = Path(path)
    name = path.name.lower()
    suffixes = [suffix for suffix in WRITERS if name.endswith(suffix)]
    if not suffixes:
        raise UsageError(
            f"{path}: frames cannot be written to this format: use {', '.join(WRITERS)}"
        )
    with replace_file(path) as part:
        return WRITERS[max(suffixes, key=len)](part, batches)


def holds_several_types(path: str | Path) -> bool:
    """Return whether a file of this name can contain several frame types."""
    return str(path).lower().endswith(MCAP.suffix)


def _iter_tables(batches: Iterable[Batch]) -> Iterator[Columns]:
    """Yield the columns of the packets of each batch.

    The tables have the columns of the first table; missing values are nan.
    """
    names: list[str] = []
    for packets in itertools.chain.from_iterable(batch.values() for batch in batches):
        columns = frame_columns(packets)
        names = names or list(columns)
        missing = np.full(len(packets), np.nan)
        yield {name: columns.get(name, missing) for name in names}


def _write_csv(path: Path, batches: Iterable[Batch], *, is_zipped: bool = False) -> int:
    count = 0
    with open_text_file(path, is_zipped=is_zipped) as put:
        for columns in _iter_tables(batches):
            if not count:
                put(",".join(columns) + "\n")
            cells = [_format_cells(values) for values in columns.values()]
            for row in zip(*cells, strict=True):
                put(",".join(row) + "\n")
                count += 1
    return count


def _format_cells(values: Any) -> list[str]:
    """Return the cells of a column for CSV, with quotes around texts that need them."""
    if isinstance(values, list):
        return [_quote(text) for text in values]
    if values.dtype.kind == "f":
        return [f"{value:.15g}" for value in values.tolist()]
    return [str(int(value)) for value in values.tolist()]


def _quote(text: str) -> str:
    if any(character in text for character in ',"\r\n'):
        return '"' + text.replace('"', '""') + '"'
    return text


def _write_table(
    path: Path, batches: Iterable[Batch], *, open_writer: Callable[[Path, Any], Any]
) -> int:
    arrow = import_library("pyarrow", "arrow")
    count = 0
    tables = (arrow.table(_with_float_integers(columns)) for columns in _iter_tables(batches))
    first = next(tables, None)
    if first is None:
        return 0
    with open_writer(path, first.schema) as writer, write_in_thread(writer.write_table) as write:
        for table in itertools.chain([first], tables):
            write(table.cast(first.schema))
            count += len(table)
    return count


def _with_float_integers(columns: Columns) -> Columns:
    """Return columns with integers converted to float64, except `time_ns`."""
    return {
        name: values.astype(np.float64)
        if name != "time_ns" and not isinstance(values, list)
        else values
        for name, values in columns.items()
    }


def _write_mcap(path: Path, batches: Iterable[Batch]) -> int:
    mcap = import_library("mcap.writer", "ros")
    channels = dict[str, int]()
    count = 0
    with path.open("wb") as file:
        log = mcap.Writer(file, chunk_size=CHUNK_BYTES, compression=mcap.CompressionType.NONE)
        log.start(profile="", library="lidarspec")
        for packets in itertools.chain.from_iterable(batch.values() for batch in batches):
            columns = frame_columns(packets)
            frame = packets.frame
            if frame not in channels:
                name = f"{packets.sensor.id}.{frame}"
                schema = log.register_schema(
                    name, "jsonschema", _make_json_schema(columns).encode()
                )
                channels[frame] = log.register_channel(f"/{frame}", "json", schema)
            times = np.where(packets.host_ns > 0, packets.host_ns, packets.time_ns)
            for row, time_ns in enumerate(np.maximum(times, 0).tolist()):
                data = json.dumps({name: _to_json(values[row]) for name, values in columns.items()})
                log.add_message(
                    channels[frame], log_time=time_ns, publish_time=time_ns, data=data.encode()
                )
                count += 1
        log.finish()
    return count


def _make_json_schema(columns: Columns) -> str:
    types = {
        name: "string" if isinstance(values, list) else "number" for name, values in columns.items()
    }
    properties = {name: {"type": kind} for name, kind in types.items()}
    return json.dumps({"type": "object", "properties": properties})


def _to_json(value: Any) -> Any:
    """Return a value for JSON; None for nan and infinity."""
    if isinstance(value, str):
        return value
    number = value.item()
    if isinstance(number, float) and not np.isfinite(number):
        return None
    return number


WRITERS: Mapping[str, Callable[[Path, Iterable[Batch]], int]] = {
    CSV.suffix: _write_csv,
    CSV_GZ.suffix: partial(_write_csv, is_zipped=True),
    PARQUET.suffix: partial(_write_table, open_writer=open_parquet),
    ARROW.suffix: partial(_write_table, open_writer=partial(open_batches, compression=None)),
    FEATHER.suffix: partial(_write_table, open_writer=partial(open_batches, compression="lz4")),
    MCAP.suffix: _write_mcap,
}
