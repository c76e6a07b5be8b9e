"""The scans of a file in one pass that can be resumed at a bookmark.

Another process can continue from a bookmark.

Decoding from the middle of a file needs state from the bytes before it: an incomplete frame, frames
with state, the number of clock wraps, the packet counter, waiting packets, the direction of
rotation. A bookmark is all of this, pickled, so that the scans after it are bit for bit those of
one pass. Objects that no input changes, such as the functions, structs and rules of a sensor,
cannot be pickled. The bookmark refers to them by name, and the resumed sensor supplies them.

A scan belongs to the piece in which it begins: the piece after a bookmark leaves out the incomplete
scan, and the piece before it reads that scan to its end.
"""

from __future__ import annotations

import io
import pickle
import struct
from collections.abc import Iterator, Mapping
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
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import Counters
from lidarspec.packets.packets import Packets, StateOf
from lidarspec.scans.scan import Scan
from lidarspec.scans.stream import ScanStream
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.files import CaptureTransport, FileTransport
from lidarspec.transports.open_url import transport
from lidarspec.transports.protocol import ClosingContext, LiveTransport

#: types that are pickled as they are.
_PLAIN = (bool, int, float, str, bytes, type(None), type)


class FileScans(ClosingContext):
    """The scans of a file: an iterator, which `survey` can skip quickly.

    Args:
        source: the file.
        sensor: the sensor that recorded it.
        bookmark: the start, as returned by `survey` for the same file and sensor.

    Raises:
        UsageError: for a source that is not a file.
        SourceError: if it cannot be read.
    """

    def __init__(self, source: str | Path, sensor: Sensor, bookmark: bytes | None = None) -> None:
        opened = transport(source, sensor)
        if isinstance(opened, LiveTransport):
            opened.close()
            raise UsageError(f"{source} is no file")
        self._sensor = sensor
        self._transport = opened
        try:
            self._input = FileInput(source, sensor, opened, backend="auto")
            if bookmark is None:
                self._reader = PacketReader(
                    sensor, None, self._input.decoder, self._input.first_frames()
                )
                self._stream = self._scan_stream()
            else:
                self._resume(bookmark)
        except BaseException:
            opened.close()
            raise

    @property
    def stats(self) -> Counters:
        """The counters of everything read, including the part before the bookmark."""
        return self._input.stats

    @property
    def warnings(self) -> list[str]:
        """The present warnings about the file."""
        return self._input.warnings

    def __iter__(self) -> Iterator[Scan]:
        while (scans := self._next()) is not None:
            yield from scans
        yield from self._stream.finish()

    def survey(self, size: int) -> tuple[int, bytes | None]:
        """Return the number of scans in the next piece of the file, and a bookmark.

        The bookmark is the end of the piece. It is None if the file ends, or if none can be set.

        Args:
            size: bytes of the piece, at least.
        """
        number = 0
        end = self._place + size
        while (scans := self._next()) is not None:
            number += sum(1 for _ in scans)
            if self._place >= end and (bookmark := self._bookmark()) is not None:
                return number + self._stream.is_under_way, bookmark
        return number + len(self._stream.finish()), None

    def close(self) -> None:
        """Close the file."""
        self._input.close()

    def _next(self) -> Iterator[Scan] | None:
        """Return the scans that the next bytes complete, None at the end."""
        arrival = self._input.next(0)
        if arrival is None:
            return None
        return self._scans(arrival)

    def _scans(self, arrival: Any) -> Iterator[Scan]:
        yield from self._reader.find_scans(self._stream, arrival)
        if arrival.interrupted:
            self._stream = self._scan_stream()

    def _scan_stream(self) -> ScanStream:
        return ScanStream(self._sensor, imu=self._reader.waiting_imu)

    @property
    def _place(self) -> int:
        """The approximate number of bytes read."""
        if isinstance(self._transport, CaptureTransport):
            reader = self._transport.reader
        else:
            reader = None
        if reader is None:
            return self._input.decoder.stats.bytes_in
        return reader.offset

    def _bookmark(self) -> bytes | None:
        """Return the state that is required to go on from here.

        Returns None if it cannot be pickled, or if the file cannot seek.
        """
        opened = self._transport
        if not isinstance(opened, FileTransport) or not opened.can_go_on:
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
        loaded = _Loader(
            io.BytesIO(bookmark), self._sensor, self._input.decoder, opened.file
        ).load()
        self._input.decoder, self._input.senders, reader, self._reader, self._stream = loaded
        if isinstance(opened, CaptureTransport):
            opened.reader = reader
        else:
            opened.file.seek(self._input.decoder.stats.bytes_in)


def _constants(sensor: Sensor, decoder: Decoder) -> dict[tuple[Any, ...], Any]:
    """Return the objects that no input changes, by name.

    They are the parts of a sensor, and objects derived from it alone.
    """
    constants = dict[tuple[Any, ...], Any]()
    _name_parts(sensor, (), constants, set())
    codecs = {("codec", name): codec(frame) for name, frame in sensor.frames.items()}
    return {**constants, **codecs, ("framing",): decoder.framing}


def _name_parts(
    value: Any, name: tuple[Any, ...], names: dict[tuple[Any, ...], Any], seen: set[int]
) -> None:
    """Add a value and its parts, each under the names that lead to it."""
    if isinstance(value, _PLAIN) or id(value) in seen:
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
        _name_parts(part, (*name, key), names, seen)


class _StatePickler(pickle.Pickler):
    """Pickles the state of a reader."""

    def __init__(self, file: io.BytesIO, sensor: Sensor, decoder: Decoder, source: Any) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._constants = _constants(sensor, decoder)
        self._names = {id(value): name for name, value in self._constants.items()} | {
            id(source): ("file",)
        }
        self._frames = {id(codec(frame).schema): name for name, frame in sensor.frames.items()}

    def persistent_id(self, obj: Any) -> Any:
        """Return the name of an object that is not pickled.

        For a sensor that reads its time from another clock it is the name of that clock.
        """
        name = self._names.get(id(obj))
        if name is None and isinstance(obj, Sensor):
            return ("clock", self._names[id(obj.clock)])
        return name

    def reducer_override(self, obj: Any) -> Any:
        """Reduce tables to the bytes of their frames.

        Packets keep only the frames of other types that belong to them.
        """
        if isinstance(obj, CompiledTable | ParsedTable):
            if id(obj.schema) not in self._frames:
                raise pickle.PicklingError(
                    "parts of frames, whose layout is in what is around them"
                )
            return _table, (
                self._constants[()],
                self._frames[id(obj.schema)],
                [obj.frame(index) for index in range(len(obj))],
            )
        if isinstance(obj, Packets):
            if AROUND in obj.state:
                raise pickle.PicklingError("parts of frames")
            state = {name: _take_states(*of) for name, of in obj.state.items()}
            return object.__new__, (Packets,), {**vars(obj), "state": state, "_index": obj.index}
        if isinstance(obj, struct.Struct):
            return (struct.Struct, (obj.format,))
        return NotImplemented


class _Loader(pickle.Unpickler):
    """Unpickles the state of a reader, for the same sensor."""

    def __init__(self, file: io.BytesIO, sensor: Sensor, decoder: Decoder, source: Any) -> None:
        super().__init__(file)
        self._constants = {**_constants(sensor, decoder), ("file",): source}

    def persistent_load(self, name: Any) -> Any:
        if name[0:1] == ("clock",) and name not in self._constants:
            return replace(self._constants[()], clock=self._constants[name[1]])
        return self._constants[name]


def _table(sensor: Sensor, frame: str, frames: list[bytes]) -> Table:
    return codec(sensor.frames[frame]).table_of_structs(frames)


def _take_states(table: Table | None, which: Any) -> StateOf:
    """Return the state frames of some packets, and the row of each packet's frame.

    Frames that belong to no packet are left out.
    """
    rows = np.unique(which[which >= 0])
    if table is None or not len(rows):
        return None, which
    return table.take(rows), np.where(which < 0, -1, np.searchsorted(rows, which))
