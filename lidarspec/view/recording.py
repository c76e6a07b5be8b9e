"""Recording that is switched on and off while a source is read."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal

from lidarspec.errors import LidarSpecError, SourceError
from lidarspec.recording.appending import Appender, Log
from lidarspec.recording.recorders import recorder
from lidarspec.transports.protocol import Chunk, Transport

#: names tried for a file before it is given up.
TRIES = 100


class Switch:
    """Stands where a recorder does, and hands on to a new one for each time that it is switched on.

    Args:
        source: as the user called it.
        folder: where the files go.

    Attributes:
        name: of the file that is being written, None while it is off.
        trouble: why it could not be switched on, "" where it could.
        written: files and the bytes of the wire in them, those that are closed.
    """

    def __init__(self, source: str, folder: Path) -> None:
        self._source, self._folder = source, folder
        self._opened: Transport | None = None
        self._recorder: Appender | None = None
        self.sensor_id = ""
        self.name: str | None = None
        self.trouble = ""
        self.written: list[tuple[str, int]] = []

    def attached(self, opened: Transport) -> Log:
        """Itself, as the recorder of an open transport: what `open(record=...)` calls."""
        self._opened = opened
        return self

    def toggle(self) -> None:
        """Start a file named after the sensor and the time, or end the one that is being written."""
        self.trouble = ""
        try:
            if self._recorder is None:
                self._begin()
            else:
                self.close()
        except LidarSpecError as error:
            self.trouble = str(error)

    @property
    def error(self) -> SourceError | None:
        """What went wrong with the file that is being written."""
        return self._recorder.error if self._recorder is not None else None

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Record what arrived or was sent, while it is on."""
        current = self._recorder
        if current is not None:
            current.write(chunk, direction)

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Record that something happened, while it is on."""
        current = self._recorder
        if current is not None:
            current.event(name, at, **details)

    def close(self) -> None:
        """End the file that is being written.

        Raises:
            SourceError: where it could not be written.
        """
        current, self._recorder = self._recorder, None
        if current is not None:
            self.written.append((current.path, current.bytes))
            self.name = None
            current.close()

    def _begin(self) -> None:
        assert self._opened is not None
        begin = f"{self.sensor_id}-{time.strftime('%Y%m%d-%H%M%S')}"
        names = (f"{begin}{f'-{number}' if number else ''}.lsr" for number in range(TRIES))
        path = self._folder / next(name for name in names if not (self._folder / name).exists())
        opened = self._opened
        self._recorder = recorder(path, self.sensor_id, self._source, datagrams=opened.datagrams, baud=opened.baud)
        self.name = path.name
