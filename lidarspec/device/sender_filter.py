"""Select the datagrams of one sensor.

All data of a sensor comes from one IP address. The frames of one type come from one port, which may
change after a restart. Two alternating ports belong to two sensors.

For a file, `SenderCheck` raises an error if two sensors send frames, and warns if other devices
send datagrams without such frames. For a live source, `SenderFilter` selects the first sender of
data frames, and drops the datagrams of other senders.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from shlex import quote

import numpy as np

from lidarspec.errors import UsageError, suggest
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Frames
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.addresses import with_option
from lidarspec.transports.protocol import Chunk, Sender, format_sender

#: Maximum number of senders that are examined to find the sensor; also the maximum number of stored
#: ports.
MAX_SENDERS = 16


class SenderCheck:
    """Checks that all frames of a file are from one sensor."""

    def __init__(self, source: str | Path, sensor: Sensor) -> None:
        self._source = source
        self._sensor = sensor
        self._address: Sender | None = None  # of the sensor
        self._current: dict[str, Sender] = {}  # sender of each frame type
        self._previous: dict[str, dict[Sender, None]] = {}  # its earlier senders, oldest first
        self._datagrams_by_host: dict[str, int] = {}  # of the first `MAX_SENDERS` IP addresses

    @property
    def warnings(self) -> list[str]:
        """The warning about datagrams of other devices."""
        if self._address is None:
            return []
        host = self._address[0]
        others = {other: n for other, n in self._datagrams_by_host.items() if other != host}
        if not others:
            return []
        most = max(others, key=others.__getitem__)
        text = (
            f"{self._source}: datagrams from other devices than {host}, most of them from {most},"
            f" contain no frames of {self._sensor.id}"
        )
        if str(self._source) == "-":
            return [text]
        chosen = quote(with_option(self._source, "src", host))
        return [f"{text}; next: repeat with {chosen} to leave them out"]

    def count(self, datagrams_by_host: Mapping[str, int]) -> None:
        """Count the datagrams of each IP address, for the warning."""
        for host, number in datagrams_by_host.items():
            counted = self._datagrams_by_host.get(host, 0)
            if number and (counted or len(self._datagrams_by_host) < MAX_SENDERS):
                self._datagrams_by_host[host] = counted + number

    def check(self, sent: Iterable[tuple[str, Sender]]) -> None:
        """Check the senders of the next frames.

        Args:
            sent: (frame type, sender) of each frame.

        Raises:
            UsageError: if two sensors have sent frames.
        """
        for name, sender in sent:
            self._address = self._address or sender
            other = (
                self._address
                if sender[0] != self._address[0]
                else self._find_concurrent_port(name, sender)
            )
            if other is not None:
                raise self._make_error(other, sender)

    def _find_concurrent_port(self, name: str, sender: Sender) -> Sender | None:
        """Return another port that sends the same frame type at the same time as `sender`."""
        port = self._current.setdefault(name, sender)
        previous = self._previous.setdefault(name, {})
        if sender == port:
            return None
        if sender in previous:
            return port
        if len(previous) == MAX_SENDERS:
            del previous[next(iter(previous))]
        previous[port] = None
        self._current[name] = sender
        return None

    def _make_error(self, first: Sender, other: Sender) -> UsageError:
        one, two = (
            format_sender(sender) if first[0] == other[0] else sender[0]
            for sender in (first, other)
        )
        chosen = with_option(self._source, "src", one)
        error = UsageError(
            f"{self._source}: {one} and {two} both send frames of {self._sensor.id}: choose one"
            f" sender, for example with {chosen}"
        )
        return suggest(error, f"repeat with {quote(chosen)}")


class SenderFilter(SenderCheck):
    """Selects the datagrams of one sensor from a live source.

    The sensor is the first sender of data frames, or of other frames if no data frame has arrived.

    Args:
        datagrams: whether each datagram is a whole frame, not a part of a byte stream.

    Attributes:
        foreign: number of datagrams of other senders so far.
        has_changed: whether the last call of `select` has selected another sensor.
    """

    def __init__(self, source: str | Path, sensor: Sensor, *, datagrams: bool) -> None:
        super().__init__(source, sensor)
        self.foreign = 0
        self.has_changed = False
        self.other_sender: Sender | None = None
        self._is_sure = False
        self._datagrams = datagrams
        self._first: Sender | None = None  # first sender of a stream, until a frame arrives
        self._probes: dict[Sender, Decoder] = {}
        # Ports of other sensors at the address of the sensor.
        self._other_senders: dict[Sender, None] = {}

    @property
    def address(self) -> Sender | None:
        """The address and port of the sensor; None until a frame has arrived."""
        return self._address

    def configure(self, sensor: Sensor) -> None:
        """Search for frames of a newly configured sensor from now on."""
        self._sensor = sensor
        self._probes.clear()

    def choose(self, sender: Sender) -> None:
        """Select `sender` as the sensor, unless the sensor was identified before."""
        self._address = self._address if self._is_sure else sender
        self._is_sure = True

    @property
    def warnings(self) -> list[str]:
        """The warnings about another sender that sends to the same port."""
        if self.other_sender is None or self._address is None:
            return []
        text = (
            f"{self._source}: reading data from {format_sender(self._address)}, and ignoring data"
            f" from {format_sender(self.other_sender)}"
        )
        other = quote(with_option(self._source, "src", format_sender(self.other_sender)))
        return [f"{text}; next: repeat with {other} to read the other sender"]

    def select(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        """Return the datagrams of the sensor, and count all other datagrams."""
        mine: list[Chunk] = []
        self.has_changed = False
        for chunk in chunks:
            if chunk.sender is not None and self._update_address(chunk.sender, chunk):
                self.has_changed = True
                for earlier in mine:
                    self._count_foreign(earlier.sender)
                mine = []
            if chunk.sender is None or self._is_sensor(chunk.sender):
                mine.append(chunk)
            else:
                self._count_foreign(chunk.sender)
        return mine

    def select_frames(self, sent: Sequence[tuple[str, Sender]], frames: Frames) -> Frames:
        """Return the frames from the ports of the sensor, and count the other frames.

        Args:
            sent: (frame type, sender) of the frames, as returned by `find_frame_senders`.
        """
        count_before = len(self._other_senders)
        for name, sender in sent:
            if sender not in self._other_senders:
                self._update_port(name, sender)
                if self._sensor.frames[name].data:
                    self._address = sender
        if len(self._other_senders) == count_before or len(sent) < len(frames):
            return frames
        mine = [sender not in self._other_senders for _, sender in sent]
        for (_, sender), is_mine in zip(sent, mine, strict=True):
            if not is_mine:
                self._count_foreign(sender)
        return frames.select(np.array(mine, np.bool_))

    def _update_address(self, sender: Sender, chunk: Chunk) -> bool:
        """Examine the frames in a chunk; select its sender if it is probably the sensor.

        Returns:
            Whether the new sender replaces another sender.
        """
        address = self._address
        if (
            self._is_sure
            and address is not None
            and (
                self._datagrams
                or sender == address
                or not self._may_be_same_device(sender, address)
            )
        ):
            return False
        names = self._find_frame_types(sender, chunk)
        if self._is_sure:
            if names:  # the stream comes from another port
                self._update_port("", sender)
                self._address = sender
            return False
        self._is_sure = any(self._sensor.frames[name].data for name in names)
        if self._is_sure or (names and address is None):
            self._address = self._current[""] = sender
        current = address or self._first
        return current is not None and self._address is not None and not self._is_sensor(current)

    def _is_sensor(self, sender: Sender) -> bool:
        if self._address is None:
            self._first = self._first or (None if self._datagrams else sender)
            return self._first in (None, sender)
        if self._datagrams:
            return self._may_be_same_device(sender, self._address)
        return sender == self._address

    def _may_be_same_device(self, sender: Sender, address: Sender) -> bool:
        """Return whether `sender` and `address` may be ports of the same device."""
        return sender[0] == address[0] and sender not in self._other_senders

    def _find_frame_types(self, sender: Sender, chunk: Chunk) -> set[str]:
        """Return the types of the frames that a datagram completes."""
        if sender not in self._probes and len(self._probes) >= MAX_SENDERS:
            return set()
        decoder = self._probes.setdefault(sender, self._sensor.decoder(stream=not self._datagrams))
        return {item.frame for item in decoder.feed(chunk.data)}

    def _update_port(self, name: str, sender: Sender) -> None:
        """Store the port from which the sensor currently sends a frame type."""
        concurrent_port = self._find_concurrent_port(name, sender)
        if concurrent_port is not None:
            self._other_senders |= dict.fromkeys([*self._previous[name], concurrent_port])
            del self._other_senders[sender]
            while len(self._other_senders) > MAX_SENDERS:
                del self._other_senders[next(iter(self._other_senders))]
            self._current[name] = sender
            self._previous[name] = {}

    def _count_foreign(self, sender: Sender | None) -> None:
        self.foreign += 1
        self.other_sender = self.other_sender or sender


def find_frame_senders(
    chunks: Sequence[Chunk], frames: Frames, end: int
) -> list[tuple[str, Sender]]:
    """Return pairs (frame type, sender) for the frames in some datagrams.

    The result has one pair for each frame, or, if all datagrams have the same sender, one pair for
    each frame type. If the sender of any datagram is unknown, the result is empty.

    Args:
        end: the end of the last datagram, in bytes since the start of the input.
    """
    senders = {chunk.sender for chunk in chunks}
    if None in senders:
        return []
    if len(senders) == 1:
        return [
            (frames.names[kind], sender)
            for sender in senders
            if sender
            for kind in np.unique(frames.kinds).tolist()
        ]
    ends = end - np.cumsum([len(chunk.data) for chunk in reversed(chunks)])[::-1]
    indices = np.searchsorted(ends, frames.offsets, side="right") - 1
    chunk_senders = [chunk.sender for chunk in chunks if chunk.sender is not None]
    return [
        (frames.names[kind], chunk_senders[index])
        for kind, index in zip(frames.kinds.tolist(), indices.tolist(), strict=True)
    ]
