"""The recorder of a live source that is switched on and off while the source is read."""

from __future__ import annotations

import itertools
import threading
import time
from pathlib import Path
from typing import Any, Literal

from lidarspec.errors import LidarSpecError, SourceError
from lidarspec.recording.background_writer import BackgroundWriter, TrafficLog
from lidarspec.recording.recorders import open_recorder
from lidarspec.transports.protocol import Chunk, Transport


class RecordingSwitch:
    """The recorder of a source, which starts a new file each time that it is switched on.

    Any thread may switch: one change at a time is made.

    Args:
        source: as the user typed it.
        folder: for the files.

    Attributes:
        trouble: the failure of the last change, "" if it succeeded.
        written: closed files, and the number of data bytes in them.
    """

    def __init__(self, source: str, folder: Path) -> None:
        self._source = source
        self._folder = folder
        self._changing = threading.Lock()
        self._opened: Transport | None = None
        self._recorder: BackgroundWriter | None = None
        self.sensor_id = ""
        self.trouble = ""
        self.written: list[tuple[str, int]] = []

    def attach(self, opened: Transport) -> TrafficLog:
        """Return itself, as the recorder of an open transport, for `open(record=...)`."""
        self._opened = opened
        return self

    def toggle(self) -> None:
        """Start or end a recording.

        The file is named after the sensor and the time.
        """
        with self._changing:
            self._change(on=self._recorder is None)

    def set(self, *, on: bool) -> None:
        """Start or end a file; does nothing if it is in that state already."""
        with self._changing:
            if on == (self._recorder is None):
                self._change(on=on)

    @property
    def recording(self) -> tuple[str, int] | None:
        """The name of the current file and the number of data bytes in it, or None."""
        current = self._recorder
        if current is None:
            return None
        return (Path(current.path).name, current.bytes)

    @property
    def error(self) -> SourceError | None:
        """The failure of the current file; None if there is none."""
        if self._recorder is not None:
            return self._recorder.error
        return None

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Record received or sent data if the switch is on."""
        if (current := self._recorder) is not None:
            current.write(chunk, direction)

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Record an event if the switch is on."""
        if (current := self._recorder) is not None:
            current.event(name, at, **details)

    def close(self) -> None:
        """End the current file.

        Raises:
            SourceError: if it could not be written.
        """
        with self._changing:
            self._end()

    def _change(self, *, on: bool) -> None:
        self.trouble = ""
        try:
            if on:
                self._begin()
            else:
                self._end()
        except LidarSpecError as error:
            self.trouble = str(error)

    def _begin(self) -> None:
        opened = self._opened
        assert opened is not None
        begin = f"{self.sensor_id}-{time.strftime('%Y%m%d-%H%M%S')}"
        paths = (
            self._folder / f"{begin}{f'-{number}' if number else ''}.lsr"
            for number in itertools.count()
        )
        path = next(path for path in paths if not path.exists())
        self._recorder = open_recorder(
            path, self.sensor_id, self._source, datagrams=opened.datagrams, baud=opened.baud
        )

    def _end(self) -> None:
        current = self._recorder
        if current is None:
            return
        self._recorder = None
        try:
            current.close()
        finally:
            if current.records:
                self.written.append((current.path, current.bytes))
            else:
                current.discard()
        if not current.records:
            self.trouble = (
                f"no data arrived while {Path(current.path).name} was recorded: the file was"
                " removed"
            )
