"""A recording as a transport: what was received, at the times of then."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from lidarspec.errors import SourceError
from lidarspec.files import Chunk
from lidarspec.recording.recordings import MAGIC, Header, Record, Recording

#: events behind which a frame begun earlier does not go on.
INTERRUPTIONS = frozenset({"disconnect", "reconnect", "dropped"})


def is_recording(head: bytes) -> bool:
    """Whether a file that begins so is a recording."""
    return head[: len(MAGIC)] == MAGIC


class RecordingTransport:
    """What was received, as it arrived; commands that were sent and events are passed over, and leave their gap.

    Args:
        path: the file.
        sender: only datagrams from this address.
        salvage: go on behind damaged places.

    Attributes:
        datagrams: whether each chunk is one datagram.
        foreign: datagrams from other addresses.
        disconnects: interruptions of the line.
        warnings: what is to be said, such as where the file is damaged.
    """

    def __init__(self, path: str | Path, *, sender: str | None = None, salvage: bool = False) -> None:
        self._recording = Recording(path, salvage=salvage)
        self.datagrams, self._sender = self._recording.header.datagrams, sender
        self.foreign = self.disconnects = 0
        self.warnings: list[str] = []

    @property
    def header(self) -> Header:
        """What the recording says of itself."""
        return self._recording.header

    def chunks(self) -> Iterator[Chunk]:
        """What was received, in order, with the arrival times of then."""
        interrupted, damaged = False, 0
        for record in self._recording:
            interrupted, damaged = interrupted or self._recording.damaged > damaged, self._recording.damaged
            if record.direction == "event":
                interrupted = self._interrupts(record) or interrupted
            elif record.direction == "in" and self._wanted(record):
                yield Chunk(record.data, record.at, record.sender, record.receiver, interrupted or record.gap, record.quiet)
                interrupted = False
        if self._recording.damaged:
            self.warnings.append(_damage(self._recording))

    def write(self, data: bytes) -> None:
        raise SourceError(f"{self._recording.path} is a recording: nothing can be sent to it")

    def close(self) -> None:
        self._recording.close()

    def _wanted(self, record: Record) -> bool:
        if self._sender is None or (record.sender is not None and record.sender[0] == self._sender):
            return True
        self.foreign += 1
        return False

    def _interrupts(self, record: Record) -> bool:
        """Whether an event says that the line was interrupted; counts disconnects."""
        try:
            event = json.loads(record.data)
        except (ValueError, RecursionError):
            return False
        name = event.get("event") if isinstance(event, dict) else None
        self.disconnects += name == "disconnect"
        return name in INTERRUPTIONS


def _damage(recording: Recording) -> str:
    """Where a recording is damaged, and how much of it was not read."""
    lost = f"{recording.leftover} bytes were not read"
    if recording.salvage:
        return f"{recording.path} is damaged in {recording.damaged} place{'s' * (recording.damaged > 1)}: {lost}, everything else was"
    if recording.is_cut:
        return f"{recording.path} is cut off in its last record: {lost}, everything before them was"
    return (
        f"{recording.path} is damaged at byte {recording.offset}: {lost}; next: lidarspec record {recording.path} --salvage -o mended.lsr"
    )
