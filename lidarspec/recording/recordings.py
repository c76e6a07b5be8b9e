"""Recordings: everything that came over a link, with its arrival time, in one append-only file.

Theory of operation: `lsr` packs records and finds them again. A `Recorder` takes them at the speed of the capture, and
`appending` brings them into the file. What a killed process leaves behind is whole records and at most one that is not. A
`Recording` reads them in order and stops at the first that is damaged, or salvages what lies behind. It is hostile input.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Literal

from lidarspec._version import __version__
from lidarspec.errors import SourceError, WireError
from lidarspec.plugins import registry, sensor as named_sensor
from lidarspec.recording.appending import Appender
from lidarspec.recording.format import (
    DATAGRAM,
    DIRECTIONS,
    EVENT,
    GAP,
    HEADER,
    LARGEST,
    MAGIC,
    QUIET,
    RECEIVED,
    SENT,
    VERSION,
    Header,
    Record,
    RecordReader,
    packed,
    read_header,
    whole_records,
)
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.protocol import Chunk

__all__ = ["LARGEST", "MAGIC", "Header", "Record", "Recorder", "Recording"]


class Recorder(Appender):
    """Writes an .lsr recording, from any thread; a context manager.

    Nothing that goes wrong with the file is raised by `write`: the capture goes on. It is kept in `error`, and raised once,
    by the next `sync` or by `close`; the file is then valid to its last whole record.

    Args:
        path: the file, new unless `overwrite`.
        sensor: the sensor, or its id; left out for a raw recording.
        source: the SOURCE that is recorded.
        datagrams: whether each chunk is a datagram; by default what the sensor's link says.
        baud: of a serial port.

    Attributes:
        header: what the recording says of itself.
        records, bytes: received and sent so far, and the bytes in them.
        dropped: records and events that came while the disk did not keep up, or after it failed.
        error: what went wrong with the file, None where nothing did.

    Raises:
        UsageError: where the file exists, or the sensor is not installed and nothing else says what the link carries.
        SourceError: where it cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        sensor: Sensor | str | None = None,
        source: str | Path = "",
        *,
        datagrams: bool | None = None,
        baud: int | None = None,
        overwrite: bool = False,
    ) -> None:
        self.header = _header(sensor, str(source), datagrams=datagrams, baud=baud)
        super().__init__(path, _whole, overwrite=overwrite)
        self._put(MAGIC + packed(HEADER, self.header.to_json(), self.header.wall_ns))
        try:
            self.sync()
        except BaseException:
            self._finish()
            raise

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Take what was received or sent, with its arrival time; more than 65,535 bytes of a stream become several records."""
        kind = RECEIVED if direction == "in" else SENT
        for start in range(0, len(chunk.data) or 1, LARGEST):
            data = chunk.data[start : start + LARGEST]
            flags = DATAGRAM * self.header.datagrams | (GAP * chunk.gap | QUIET * chunk.quiet) * (not start)
            self._put(packed(kind, data, chunk.at, flags=flags, sender=chunk.sender, receiver=chunk.receiver), len(data))

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Take down what happened to the line, such as "disconnect" or "reconnect"; now, unless `at` says when."""
        self._put(_event(name, time.time_ns() if at is None else at, details))

    def _told(self, dropped: int) -> bytes:
        return _event("dropped", time.time_ns(), {"records": dropped})


class Recording:
    """A recording, read in order: an iterable of `Record`s that goes on where the last loop stopped, and a context manager.

    Args:
        path: the file.
        salvage: go on behind damaged places, even where the header is one.

    Attributes:
        header: what it says of itself.

    Raises:
        SourceError: where the file cannot be opened, is no recording, or one of a later format.
        WireError: where its header is damaged, and `salvage` is not asked for.
    """

    def __init__(self, path: str | Path, *, salvage: bool = False) -> None:
        self.path, self.salvage = str(path), salvage
        try:
            self._file: BinaryIO = open(path, "rb")  # noqa: SIM115  closed by `close`
        except OSError as error:
            raise SourceError(f"{path}: {error.strerror or error}") from None
        try:
            self._reader = RecordReader(self._file, salvage=salvage)
            self._records = self._begin()
        except BaseException:
            self.close()
            raise

    @property
    def records(self) -> int:
        """Records read so far, the header and events among them."""
        return self._reader.records

    @property
    def damaged(self) -> int:
        """Damaged places so far; a record that is not whole at the end is one."""
        return self._reader.damaged

    @property
    def leftover(self) -> int:
        """Bytes in damaged places; without `salvage` all that are behind the last good record."""
        return self._reader.leftover

    @property
    def is_cut(self) -> bool:
        """Whether the last damaged place is a record that the file ends in."""
        return self._reader.is_cut

    @property
    def offset(self) -> int:
        """File offset of the next record, or of the damage that ended the reading."""
        return self._reader.offset

    def __iter__(self) -> Iterator[Record]:
        return self._records

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _begin(self) -> Iterator[Record]:
        """Read the header; the records behind it."""
        try:
            magic = self._file.read(len(MAGIC))
            if magic != MAGIC:
                seen = f"it begins with {magic.hex(' ')}" if magic else "it is empty"
                raise SourceError(f"{self.path}: not an .lsr recording: {seen}")
            pairs = iter(self._reader)
            first = next(pairs, None)
        except OSError as error:
            raise SourceError(f"{self.path}: {error.strerror or error}") from None
        if first is not None and first[0] == HEADER:
            self.header = read_header(first[1].data)
            if self.header.version > VERSION:
                raise SourceError(f"{self.path}: written in format {self.header.version}, and this lidarspec knows {VERSION}")
            return self._known(pairs)
        if not self.salvage:
            damage = WireError(f"{self.path}: the header of the recording is damaged or cut off")
            damage.add_note(f"next: lidarspec record {self.path} --salvage -o mended.lsr")
            raise damage
        self.header = Header()
        return self._known(itertools.chain([] if first is None else [first], pairs))

    def _known(self, pairs: Iterator[tuple[int, Record]]) -> Iterator[Record]:
        try:
            yield from (record for kind, record in pairs if kind in DIRECTIONS)
        except OSError as error:
            raise SourceError(f"{self.path}: {error.strerror or error}") from None


def _header(sensor: Sensor | str | None, source: str, *, datagrams: bool | None, baud: int | None) -> Header:
    known = named_sensor(sensor) if isinstance(sensor, str) and sensor and datagrams is None else sensor
    name, options, link = (known.id, dict(known.options), known.datagrams) if isinstance(known, Sensor) else (known or "", {}, False)
    homes = {plugin.distribution: plugin.version for plugin in registry().plugins if name in plugin.sensors}
    return Header(
        sensor=name,
        options=options,
        source=source,
        datagrams=link if datagrams is None else datagrams,
        baud=baud,
        versions={"lidarspec": __version__, **homes},
        created=datetime.now().astimezone().isoformat(timespec="milliseconds"),
        wall_ns=time.time_ns(),
        monotonic_ns=time.monotonic_ns(),
    )


def _event(name: str, at: int, details: dict[str, Any]) -> bytes:
    return packed(EVENT, json.dumps({"event": name, **details}, default=str).encode(), at)


def _whole(data: bytes | bytearray, limit: int) -> int:
    """How much of a piece of the file can stay; the first begins with the magic bytes."""
    if data[: len(MAGIC)] != MAGIC:
        return whole_records(data, limit)
    return len(MAGIC) + whole_records(data[len(MAGIC) :], limit - len(MAGIC)) if limit >= len(MAGIC) else 0
