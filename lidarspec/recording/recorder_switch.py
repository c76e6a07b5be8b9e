"""A recorder of a live source that can be switched on and off."""

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
    """A recorder that starts a new file each time it is switched on.

    Any thread may switch it.

    Args:
        source: the SOURCE as the user typed it.
        folder: the folder of the files.

    Attributes:
        trouble: a message if the last switching failed, or if it ended a file without data; else
            "". `error` has the error of a file that is still open.
        written: (path, number of data bytes) of each closed file.
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
        """Store the transport that this recorder records, and return this recorder.

        To record a source, pass this method as the argument `record` of `open`.
        """
        self._opened = opened
        return self

    def toggle(self) -> None:
        """Start a file if the recorder is off; end the current file if it is on."""
        with self._changing:
            self._change(on=self._recorder is None)

    def set_state(self, *, on: bool) -> None:
        """Switch the recorder on to start a file, or off to end the current file.

        Does nothing if the recorder is already in this state.
        """
        with self._changing:
            if on == (self._recorder is None):
                self._change(on=on)

    @property
    def current_file(self) -> tuple[str, int] | None:
        """(name, number of data bytes) of the current file; None if the recorder is off."""
        current = self._recorder
        if current is None:
            return None
        return (Path(current.path).name, current.bytes)

    @property
    def error(self) -> SourceError | None:
        """The error of the current file; None if there is no error."""
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
            SourceError: if the file could not be written.
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
                f"no data arrived for the recording {Path(current.path).name}, so the file was"
                " removed"
            )
