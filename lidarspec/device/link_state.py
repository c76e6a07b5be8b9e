"""Watch the data link of a live sensor, and warn if no valid data arrives."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from shlex import quote

from lidarspec.device.capture_thread import CaptureThread
from lidarspec.device.sender_filter import SenderFilter
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Frames
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.addresses import with_option
from lidarspec.transports.protocol import LiveTransport, Sender, format_sender

#: A warning is issued if bytes arrive for this time without containing a frame.
FRAMELESS_WARNING_S = 0.9
#: A source without data for this time is considered silent. Even a busy computer reads more often
#: than this.
SILENT_AFTER_S = 3.0


class LinkState:
    """The state of the data link of a sensor.

    Attributes:
        has_data: whether a data frame has ever arrived.
    """

    def __init__(
        self,
        source: str | Path,
        sensor: Sensor,
        transport: LiveTransport,
        capture: CaptureThread,
        decoder: Decoder,
        senders: SenderFilter,
    ) -> None:
        self._source = source
        self._sensor = sensor
        self._transport = transport
        self._capture = capture
        self._decoder = decoder
        self._senders = senders
        self._framed_bytes = 0  # bytes decoded when the last frame was found
        self._frameless_since: float | None = None
        self._only_others_since: float | None = None
        self._longest_frame = max(
            (frame.max_length * frame.confirm for frame in sensor.frames.values()), default=0
        )
        self.has_data = False

    def record_arrival(self, *, from_sensor: bool) -> None:
        """Record that datagrams arrived.

        Args:
            from_sensor: whether at least one of the datagrams is from the sensor.
        """
        if from_sensor:
            self._only_others_since = None
        elif self._only_others_since is None:
            self._only_others_since = time.monotonic()

    def record_frames(self, batches: Sequence[Frames]) -> None:
        """Record decoded frames."""
        stats = self._decoder.stats
        if any(map(len, batches)):
            self._framed_bytes = stats.bytes_in
            self._frameless_since = None
            if not self.has_data:
                self.has_data = any(name in stats.frames for name in self._sensor.main_frames)
        elif self._frameless_since is None and stats.bytes_in > self._framed_bytes:
            self._frameless_since = time.monotonic()

    @property
    def silent_for(self) -> float:
        """Seconds since something last arrived from the sensor."""
        last = self._capture.last_arrival
        if self._only_others_since is not None:
            last = min(last, self._only_others_since)
        return time.monotonic() - last

    @property
    def name(self) -> str:
        """The state of the link.

        * "disconnected": the device is disconnected.
        * "silent": the sensor has sent nothing for `SILENT_AFTER_S`.
        * "no frames": bytes arrive, but they contain no frames.
        * "waiting": no frame has arrived so far, and none of these problems was found.
        * "streaming": frames have arrived.
        """
        if not self._capture.connected:
            return "disconnected"
        if self.silent_for > SILENT_AFTER_S:
            return "silent"
        if self._is_frameless():
            return "no frames"
        if self._decoder.stats.frames:
            return "streaming"
        return "waiting"

    @property
    def warnings(self) -> list[str]:
        """A list with a warning about the current problem of the link, if there is one."""
        name = self.name
        if name == "disconnected":
            text = "the device is disconnected; waiting for it to return"
        elif name == "silent":
            text = self._describe_silence()
        elif name == "no frames":
            text = f"received {self._frameless_bytes} bytes without a frame of {self._sensor.id}"
            if self._transport.baud:
                text = f"{text}; {self._transport.baud} baud is probably wrong"
        else:
            return []
        return [f"{self._source}: {text}; next: {self.suggest_command()}"]

    def suggest_command(self) -> str:
        """Return the shell command, or the action, that helps with the current problem."""
        other = self._other_sender
        if other is not None and self.name == "silent":
            chosen = with_option(self._source, "src", format_sender(other))
            return f"repeat with {quote(chosen)} to read the other sender"
        if self._decoder.stats.bytes_in and not self._decoder.stats.frames:
            return f"lidarspec detect {quote(str(self._source).partition('?')[0])}"
        return f"lidarspec doctor {quote(str(self._source))} -s {self._sensor.id}"

    @property
    def _other_sender(self) -> Sender | None:
        return self._senders.other_sender or self._transport.other_sender

    def _describe_silence(self) -> str:
        """Return a text about a silent link and the datagrams of other senders."""
        seconds = f"{self.silent_for:.1f} s"
        other = self._other_sender
        if other is None:
            return f"no data received for {seconds}"
        count = self._senders.foreign + self._transport.foreign
        return (
            f"no data received from the sensor for {seconds}, but {count} datagrams from other"
            f" senders, such as {format_sender(other)}"
        )

    @property
    def _frameless_bytes(self) -> int:
        """The number of bytes since the last frame."""
        return self._decoder.stats.bytes_in - self._framed_bytes

    def _is_frameless(self) -> bool:
        """Return whether many bytes, but no frame, have arrived for a long time."""
        if self._frameless_since is None:
            return False
        seconds = time.monotonic() - self._frameless_since
        return seconds > FRAMELESS_WARNING_S and self._frameless_bytes > self._longest_frame
