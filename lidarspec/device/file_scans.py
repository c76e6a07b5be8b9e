"""Read the scans of a file, from its start or from a bookmark.

A bookmark is the pickled state of the decoding at a position in a file, for example an incomplete
frame and the number of clock wraps. Reading from a bookmark returns the same scans as an
uninterrupted reading. The functions and structs of a sensor cannot be pickled, so a bookmark refers
to them by name.

Bookmarks divide a file into pieces. A scan belongs to the piece in which it begins, even if it ends
in the next piece.
"""

from __future__ import annotations

import io
import pickle
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarspec.device.device_input import FileInput
from lidarspec.device.packet_reader import PacketReader
from lidarspec.errors import UsageError
from lidarspec.expressions.columns import AROUND
from lidarspec.frames.frame_table import CompiledTable, ParsedTable, Table
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.results import Counters
from lidarspec.packets.packets import Packets, StateOf
from lidarspec.scans.scan import Scan
from lidarspec.scans.stream import ScanStream
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.files import CaptureTransport, FileTransport
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.protocol import ClosingContext, LiveTransport

#: Values of these types are pickled; values of other types are referred to by name.
_PLAIN_TYPES = (bool, int, float, str, bytes, type(None), type)


class FileScans(ClosingContext):
    """The scans of a file, as an iterable.

    Args:
        bookmark: the start, from `survey` for the same file and sensor; None for the start of the
            file.
    """

    def __init__(self, source: str | Path, sensor: Sensor, bookmark: bytes | None = None) -> None:
        sensor.require_points()
        opened = open_transport(source, sensor)
        if isinstance(opened, LiveTransport):
            opened.close()
            raise UsageError(f"{source} is not a file")
        self._sensor = sensor
        self._added_warnings: list[str] = []
        self._transport = opened
        try:
            self._input = FileInput(source, sensor, opened, backend="auto")
            if bookmark is None:
                self._reader = PacketReader(
                    sensor, None, self._input.decoder, self._input.first_frames()
                )
                self._stream = self._make_scan_stream()
            else:
                self._resume(bookmark)
        except BaseException:
            opened.close()
            raise

    @property
    def stats(self) -> Counters:
        """The counters of everything read, including everything before the bookmark."""
        return self._input.stats

    @property
    def warnings(self) -> list[str]:
        """The current warnings about the file."""
        return [*self._input.warnings, *self._added_warnings]

    def add_warnings(self, warnings: Iterable[str]) -> None:
        """Make the property `warnings` return these warnings as well."""
        self._added_warnings += warnings

    def __iter__(self) -> Iterator[Scan]:
        while (scans := self._read_next_scans()) is not None:
            yield from scans
        yield from self._stream.finish()

    def survey(self, size: int) -> tuple[int, bytes | None]:
        """Count the scans of the next piece of the file, without computing points.

        Args:
            size: minimum size of the piece, in bytes.

        Returns:
            The number of scans that begin in the piece, and the bookmark of the next piece. The
            bookmark is None if this was the last piece.
        """
        scan_count = 0
        end = self._offset + size
        while (scans := self._read_next_scans()) is not None:
            scan_count += sum(1 for _ in scans)
            if self._offset >= end and (bookmark := self._make_bookmark()) is not None:
                return scan_count + self._stream.is_under_way, bookmark
        return scan_count + len(self._stream.finish()), None

    def close(self) -> None:
        """Close the file."""
        self._input.close()

    def _read_next_scans(self) -> Iterator[Scan] | None:
        """Return the scans that the next batch of frames completes; None at the end."""
        batch = self._input.next(0)
        if batch is None:
            return None
        return self._iter_scans(batch)

    def _iter_scans(self, batch: Any) -> Iterator[Scan]:
        yield from self._reader.find_scans(self._stream, batch)
        if batch.interrupted:
            self._stream = self._make_scan_stream()

    def _make_scan_stream(self) -> ScanStream:
        return ScanStream(self._sensor, imu=self._reader.waiting_imu)

    @property
    def _offset(self) -> int:
        """The approximate number of bytes read."""
        if isinstance(self._transport, CaptureTransport):
            reader = self._transport.reader
        else:
            reader = None
        if reader is None:
            return self._input.decoder.stats.bytes_in
        return reader.offset

    def _make_bookmark(self) -> bytes | None:
        """Return the pickled state; None if reading cannot be resumed from here."""
        opened = self._transport
        if not isinstance(opened, FileTransport) or not opened.can_resume:
            return None
        if isinstance(opened, CaptureTransport):
            reader = opened.reader
        else:
            reader = None
        state = (self._input.decoder, self._input.senders, reader, self._reader, self._stream)
        content = io.BytesIO()
        try:
            _StatePickler(content, self._sensor, self._input.decoder, opened.file).dump(state)
        except (pickle.PicklingError, TypeError, AttributeError):
            return None
        return content.getvalue()

    def _resume(self, bookmark: bytes) -> None:
        opened = self._transport
        assert isinstance(opened, FileTransport)
        loaded = _StateUnpickler(
            io.BytesIO(bookmark), self._sensor, self._input.decoder, opened.file
        ).load()
        self._input.decoder, self._input.senders, reader, self._reader, self._stream = loaded
        if isinstance(opened, CaptureTransport):
            opened.reader = reader
        else:
            opened.file.seek(self._input.decoder.stats.bytes_in)


def _find_constants(sensor: Sensor, decoder: Decoder) -> dict[tuple[Any, ...], Any]:
    """Return the objects to which a bookmark refers by name: name -> object."""
    constants = dict[tuple[Any, ...], Any]()
    _assign_names(sensor, (), constants, set())
    codecs = {("codec", name): get_codec(frame) for name, frame in sensor.frames.items()}
    return {**constants, **codecs, ("framing",): decoder.framing}


def _assign_names(
    value: Any, name: tuple[Any, ...], names: dict[tuple[Any, ...], Any], seen: set[int]
) -> None:
    """Give names to a value and all its parts, and store them in `names`.

    Args:
        name: the name of the value. The name of a part is this name and the key of the part.
        names: name -> object, to which the names are added.
        seen: the ids of the objects that have names.
    """
    if isinstance(value, _PLAIN_TYPES) or id(value) in seen:
        return
    names[name] = value
    seen.add(id(value))
    parts: Mapping[Any, Any] = {}
    if is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in fields(value)}
    elif isinstance(value, Mapping):
        parts = value
    elif isinstance(value, tuple | list):
        parts = dict(enumerate(value))
    for key, part in parts.items():
        _assign_names(part, (*name, key), names, seen)


class _StatePickler(pickle.Pickler):
    """Pickles the state of a reader."""

    def __init__(self, file: io.BytesIO, sensor: Sensor, decoder: Decoder, source: Any) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._constants = _find_constants(sensor, decoder)
        self._names = {id(value): name for name, value in self._constants.items()} | {
            id(source): ("file",)
        }
        self._frames = {id(get_codec(frame).schema): name for name, frame in sensor.frames.items()}

    def persistent_id(self, obj: Any) -> Any:
        """Return the name of an object in a bookmark; None if it is pickled itself."""
        name = self._names.get(id(obj))
        if name is None and isinstance(obj, Sensor):
            return ("clock", self._names[id(obj.clock)])
        return name

    def reducer_override(self, obj: Any) -> Any:
        """Return the function and the arguments that restore a table or packets."""
        if isinstance(obj, CompiledTable | ParsedTable):
            if id(obj.schema) not in self._frames:
                raise pickle.PicklingError(
                    "the parts of a frame cannot be pickled without the frame"
                )
            return _make_table, (
                self._constants[()],
                self._frames[id(obj.schema)],
                [obj.frame(index) for index in range(len(obj))],
            )
        if isinstance(obj, Packets):
            if AROUND in obj.state:
                raise pickle.PicklingError(
                    "the parts of a frame cannot be pickled alone: pickle the packets of the frame"
                )
            state = {name: _drop_unused_states(*of) for name, of in obj.state.items()}
            return object.__new__, (Packets,), {**vars(obj), "state": state, "_index": obj.index}
        if isinstance(obj, struct.Struct):
            return (struct.Struct, (obj.format,))
        return NotImplemented


class _StateUnpickler(pickle.Unpickler):
    """Unpickles the state of a reader, for the same sensor."""

    def __init__(self, file: io.BytesIO, sensor: Sensor, decoder: Decoder, source: Any) -> None:
        super().__init__(file)
        self._constants = {**_find_constants(sensor, decoder), ("file",): source}

    def persistent_load(self, name: Any) -> Any:
        if name[0:1] == ("clock",) and name not in self._constants:
            return replace(self._constants[()], clock=self._constants[name[1]])
        return self._constants[name]


def _make_table(sensor: Sensor, frame: str, frames: list[bytes]) -> Table:
    return get_codec(sensor.frames[frame]).table_of_structs(frames)


def _drop_unused_states(table: Table | None, which: Any) -> StateOf:
    """Return the state frames of packets, without frames that no packet uses.

    Args:
        table: frames of one type that packets refer to, such as calibrations.
        which: for each packet, the row of its frame in `table`; -1 for a packet without a frame.

    Returns:
        The table with the remaining frames, and `which` for the new table.
    """
    rows = np.unique(which[which >= 0])
    if table is None or not len(rows):
        return None, which
    return table.take(rows), np.where(which < 0, -1, np.searchsorted(rows, which))
