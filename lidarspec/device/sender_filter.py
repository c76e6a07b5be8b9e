"""Select the datagrams of one sensor, so that frames of two are never mixed.

A sensor is an address: its data, calibration and replies come from there. The frames of one type
come from one port of it, and from another port only after a restart; two ports that take turns are
two sensors. A file with frames of two sensors is refused (`SenderCheck`): the user can select one.
From a live source the first sender of data is read (`SenderFilter`): datagrams of others are left
out before they are decoded.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from shlex import quote

import numpy as np

from lidarspec.errors import UsageError, suggest
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Frames
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.addresses import with_option
from lidarspec.transports.protocol import Chunk, Sender, endpoint

#: limit of examined senders while the sensor is unknown, and of remembered ports.
MAX_SENDERS = 16


class SenderCheck:
    """Checks that one sensor sends the frames of a file.

    Args:
        source: for messages.
    """

    def __init__(self, source: str | Path, sensor: Sensor) -> None:
        self._source = source
        self._sensor = sensor
        self._owner: Sender | None = None
        self._now: dict[str, Sender] = {}  # the current and previous senders of each frame type
        self._before: dict[str, dict[Sender, None]] = {}

    def check(self, sent: Iterable[tuple[str, Sender]]) -> None:
        """Check the senders of frames.

        Args:
            sent: the type and the sender of each frame.

        Raises:
            UsageError: if two sensors send frames.
        """
        for name, sender in sent:
            self._owner = self._owner or sender
            other = (
                self._owner
                if sender[0] != self._owner[0]
                else self._find_concurrent_port(name, sender)
            )
            if other is not None:
                raise self._warn_of_senders(other, sender)

    def _find_concurrent_port(self, name: str, sender: Sender) -> Sender | None:
        """Return the port that took turns with this one for frames of a type.

        Returns None if there is none. The frames then come from this port.
        """
        port = self._now.setdefault(name, sender)
        before = self._before.setdefault(name, {})
        if sender == port or sender in before:
            if sender == port:
                return None
            return port
        if len(before) == MAX_SENDERS:
            del before[next(iter(before))]
        before[port], self._now[name] = None, sender
        return None

    def _warn_of_senders(self, first: Sender, other: Sender) -> UsageError:
        one, two = (
            endpoint(sender) if first[0] == other[0] else sender[0] for sender in (first, other)
        )
        chosen = with_option(self._source, "src", one)
        error = UsageError(
            f"{self._source}: {one} and {two} both send frames of {self._sensor.id}; choose one"
            f" with {chosen}"
        )
        return suggest(error, f"the same with {quote(chosen)}")


class SenderFilter(SenderCheck):
    """Selects the datagrams of one sensor from a live source.

    The sensor is the first sender of data frames, and before that the first sender of any frame.

    Args:
        datagrams: whether each datagram is a whole frame, not a piece of a stream.

    Attributes:
        foreign: number of datagrams of other senders so far; `other_sender` sent the first of them.
        has_changed: whether the last call of `select` has selected another sender than the one read
            before.
    """

    def __init__(self, source: str | Path, sensor: Sensor, *, datagrams: bool) -> None:
        super().__init__(source, sensor)
        self.foreign = 0
        self.has_changed = False
        self.other_sender: Sender | None = None
        self._is_sure = False
        self._datagrams = datagrams
        self._first: Sender | None = None  # sender of a stream before its first frame
        self._probes: dict[Sender, Decoder] = {}
        self._other_senders: dict[
            Sender, None
        ] = {}  # ports of other sensors at the address of the sensor

    @property
    def address(self) -> Sender | None:
        """The address and port of the sensor, None until a frame has arrived."""
        return self._owner

    def configure(self, sensor: Sensor) -> None:
        """Continue with a sensor that has been configured."""
        self._sensor = sensor
        self._probes.clear()

    def choose(self, sender: Sender) -> None:
        """Select a sender, since it has answered on another link."""
        self._owner = self._owner if self._is_sure else sender
        self._is_sure = True

    @property
    def warnings(self) -> list[str]:
        """A warning about another sender on the same port."""
        if self.other_sender is None or self._owner is None:
            return []
        text = (
            f"{self._source}: {endpoint(self._owner)} is read; {endpoint(self.other_sender)} sends"
            " as well, and is left out"
        )
        other = quote(with_option(self._source, "src", endpoint(self.other_sender)))
        return [f"{text}; next: the same with {other} to read that one"]

    def select(self, chunks: Sequence[Chunk]) -> list[Chunk]:
        """Return the datagrams that the sensor sent.

        Until a sender has sent a frame, all datagrams are returned, of a stream those of the first
        sender.
        """
        mine: list[Chunk] = []
        self.has_changed = False
        for chunk in chunks:
            if chunk.sender is not None and self._replaces(chunk.sender, chunk):
                self.has_changed = True
                for one in mine:
                    self._count_foreign(one.sender)
                mine = []
            if chunk.sender is None or self._is_ours(chunk.sender):
                mine.append(chunk)
            else:
                self._count_foreign(chunk.sender)
        return mine

    def select_ports(self, sent: Sequence[tuple[str, Sender]], frames: Frames) -> Frames:
        """Return those of the frames from the address of the sensor that its ports sent.

        Args:
            sent: the type and the sender of each frame, or of each type if one sender sent all.
        """
        count_before = len(self._other_senders)
        for name, sender in sent:
            if sender not in self._other_senders:
                self._take_turns(name, sender)
                if self._sensor.frames[name].data:
                    self._owner = sender
                else:
                    self._owner = self._owner
        if len(self._other_senders) == count_before or len(sent) < len(frames):
            return frames
        mine = [sender not in self._other_senders for _, sender in sent]
        for (_, sender), is_mine in zip(sent, mine, strict=True):
            if not is_mine:
                self._count_foreign(sender)
        return frames.select(np.array(mine, np.bool_))

    def _replaces(self, sender: Sender, chunk: Chunk) -> bool:
        """Decide from a chunk which sender is the sensor.

        Returns:
            Whether the sender replaces another one.
        """
        owner = self._owner
        if (
            self._is_sure
            and owner is not None
            and (self._datagrams or sender == owner or not self._may_be_same_device(sender, owner))
        ):
            return False
        names = self._names(sender, chunk)
        if self._is_sure:
            if names:  # of a stream that comes from another port
                self._owner = self._take_turns("", sender)
            return False
        self._is_sure = any(self._sensor.frames[name].data for name in names)
        if self._is_sure or (names and owner is None):
            self._owner = self._now[""] = sender
        current = owner or self._first
        return current is not None and self._owner is not None and not self._is_ours(current)

    def _is_ours(self, sender: Sender) -> bool:
        if self._owner is None:
            self._first = self._first or (None if self._datagrams else sender)
            return self._first in (None, sender)
        if self._datagrams:
            return self._may_be_same_device(sender, self._owner)
        return sender == self._owner

    def _may_be_same_device(self, sender: Sender, owner: Sender) -> bool:
        """Return whether a sender may be the sensor at another port."""
        return sender[0] == owner[0] and sender not in self._other_senders

    def _names(self, sender: Sender, chunk: Chunk) -> set[str]:
        """Return the types of the frames that a datagram completes.

        Only the first few senders are examined.
        """
        if sender not in self._probes and len(self._probes) >= MAX_SENDERS:
            return set()
        decoder = self._probes.setdefault(sender, self._sensor.decoder(stream=not self._datagrams))
        return {item.frame for item in decoder.feed(chunk.data)}

    def _take_turns(self, name: str, sender: Sender) -> Sender:
        """Return the port that frames of a type come from.

        If several ports take turns, it is the first one.
        """
        younger = self._find_concurrent_port(name, sender)
        if younger is not None:
            self._other_senders |= dict.fromkeys([*self._before[name], younger])
            del self._other_senders[sender]
            while len(self._other_senders) > MAX_SENDERS:
                del self._other_senders[next(iter(self._other_senders))]
            self._now[name], self._before[name] = sender, {}
        return self._now[name]

    def _count_foreign(self, sender: Sender | None) -> None:
        self.foreign = self.foreign + 1
        self.other_sender = self.other_sender or sender


def frame_senders(chunks: Sequence[Chunk], frames: Frames, end: int) -> list[tuple[str, Sender]]:
    """Return the type and the sender of each frame found in datagrams.

    If one sender sent all of them, each type is listed once. Returns [] if senders are not known.

    Args:
        end: the end of these datagrams, in bytes since the start of the input.
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
    places = np.searchsorted(ends, frames.offsets, side="right") - 1
    chunk_senders = [chunk.sender for chunk in chunks if chunk.sender is not None]
    return [
        (frames.names[kind], chunk_senders[place])
        for kind, place in zip(frames.kinds.tolist(), places.tolist(), strict=True)
    ]
