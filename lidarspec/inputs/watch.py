"""How a live source is doing: data, silence, bytes that are no frames, a device that went away; and what to type next."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from lidarspec.decoder import Decoder, Spans
from lidarspec.files import LiveTransport
from lidarspec.inputs.capture import Capture
from lidarspec.spec import Sensor

#: seconds after which silence, or bytes without a frame, are worth a word.
PATIENCE = 0.9


class Watch:
    """The state of the data link of a device.

    Attributes:
        streams: whether a data frame has come, ever.
    """

    def __init__(self, source: str | Path, sensor: Sensor, opened: LiveTransport, capture: Capture, decoder: Decoder) -> None:
        self._source, self._sensor, self._transport, self._capture, self._decoder = source, sensor, opened, capture, decoder
        self._framed, self._bytes = time.monotonic(), 0
        self._unframed_since: float | None = None
        self.streams = False

    def saw(self, found: Sequence[Spans]) -> None:
        """Take note of what was decoded."""
        if any(map(len, found)):
            self._framed, self._bytes, self._unframed_since = time.monotonic(), self._decoder.stats.bytes_in, None
            if not self.streams:
                self.streams = any(frame.data and name in self._decoder.stats.frames for name, frame in self._sensor.frames.items())
        elif self._unframed_since is None and self._decoder.stats.bytes_in > self._bytes:
            self._unframed_since = time.monotonic()

    @property
    def silent_for(self) -> float:
        """Seconds since something last arrived."""
        return time.monotonic() - self._capture.last

    @property
    def state(self) -> str:
        """One of "disconnected", "silent", "no frames", "waiting" (for the first frame) and "streaming"."""
        if not self._capture.connected:
            return "disconnected"
        if self.silent_for > PATIENCE:
            return "silent"
        if self._unframed_since is not None and time.monotonic() - self._unframed_since > PATIENCE and self._unframed > self._longest:
            return "no frames"
        return "streaming" if self._decoder.stats.frames else "waiting"

    @property
    def warnings(self) -> list[str]:
        """What is wrong, with the next command."""
        state = self.state
        text = {
            "disconnected": f"{self._source}: the device is gone; waiting for it to come back",
            "silent": f"{self._source}: nothing has arrived for {self.silent_for:.1f} s",
            "no frames": f"{self._source}: {self._unframed} bytes, and no frame of {self._sensor.id} among them{self._baud}",
        }.get(state)
        return [f"{text}; next: {self.following()}"] if text else []

    def following(self) -> str:
        """The command that finds out more."""
        if self._decoder.stats.bytes_in and not self._decoder.stats.frames:
            return f"lidarspec detect '{str(self._source).partition('?')[0]}'"
        return f"lidarspec doctor '{self._source}' -s {self._sensor.id}"

    @property
    def _unframed(self) -> int:
        return self._decoder.stats.bytes_in - self._bytes

    @property
    def _longest(self) -> int:
        return max((frame.max_length * frame.confirm for frame in self._sensor.frames.values()), default=0)

    @property
    def _baud(self) -> str:
        baud = getattr(self._transport, "baud", None)
        return f": {baud} baud is likely wrong" if baud else ""
