"""What comes out of an input, live or not: frames in batches, and who may have sent them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

import numpy as np

from lidarspec.errors import UsageError, suggest
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Found, Frames
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.protocol import Chunk

#: other senders of a stream that are looked at; datagrams of further ones are foreign unseen.
SENDERS = 16


@dataclass(frozen=True, eq=False)
class Arrival:
    """Frames of a piece of input, in stream order.

    Attributes:
        found: the frames of every incoming type.
        interrupted: whether input is missing behind them: no frame, packet or scan goes on there.
    """

    found: list[Frames] = field(default_factory=list)
    interrupted: bool = False


class Senders:
    """Frames of several senders must not be mixed into one cloud.

    Args:
        source: for messages.
    """

    def __init__(self, source: str | Path, sensor: Sensor) -> None:
        self._source, self._sensor = source, sensor
        self._first: dict[str, str] = {}
        self._ours: str | None = None
        self._others: dict[str, Decoder] = {}

    def check(self, chunks: Sequence[Chunk], found: Frames) -> None:
        """Look who sent the frames of these datagrams.

        Raises:
            UsageError: where two addresses send frames of one type.
        """
        senders = {chunk.sender for chunk in chunks}
        sender = senders.pop() if len(senders) == 1 else None
        if sender is not None and all(host == sender[0] for host in self._first.values()):
            for kind in np.unique(found.kinds).tolist():
                self._first.setdefault(found.names[kind], sender[0])
            return
        hosts = [chunk.sender[0] if chunk.sender else None for chunk in chunks]
        sizes = np.array([len(chunk.data) for chunk in chunks])
        places = np.searchsorted(np.cumsum(sizes) - sizes, found.starts, side="right") - 1
        for kind, place in zip(found.kinds.tolist(), places.tolist(), strict=True):
            host = hosts[place]
            if host is not None and self._first.setdefault(found.names[kind], host) != host:
                raise self._several(self._first[found.names[kind]], host, f"{found.names[kind]} frames")

    def see(self, hosts: Mapping[str, Sequence[str]]) -> None:
        """Look who sent the frames of each type.

        Raises:
            UsageError: where two addresses send frames of one type.
        """
        for name, senders in hosts.items():
            for host in senders:
                if self._first.setdefault(name, host) != host:
                    raise self._several(self._first[name], host, f"{name} frames")

    def ours(self, chunks: Sequence[Chunk], main: Decoder) -> list[Chunk]:
        """Those pieces of a stream in datagrams that come from the sender which is listened to, the first that sends frames.

        Raises:
            UsageError: where another address sends frames as well.
        """
        hosts = {chunk.sender[0] for chunk in chunks if chunk.sender}
        if not hosts - {self._ours or next(iter(hosts), None)}:
            self._ours = self._ours or next(iter(hosts), None)
            return list(chunks)
        self._ours = self._ours or next(chunk.sender[0] for chunk in chunks if chunk.sender)
        for chunk in chunks:
            host = chunk.sender[0] if chunk.sender else self._ours
            if host == self._ours or not self._sends_frames(host, chunk):
                continue
            if main.stats.frames:
                raise self._several(self._ours, host, f"frames of {self._sensor.id}")
            self._ours = host
        return [chunk for chunk in chunks if not chunk.sender or chunk.sender[0] == self._ours]

    def _sends_frames(self, host: str, chunk: Chunk) -> bool:
        if host not in self._others and len(self._others) >= SENDERS:
            return False
        decoder = self._others.setdefault(host, self._sensor.decoder(stream=True))
        return bool(decoder.feed(chunk.data))

    def _several(self, first: str, other: str, what: str) -> UsageError:
        mark = "&" if "?" in str(self._source) else "?"
        error = UsageError(f"{self._source}: {first} and {other} both send {what}; choose one with {mark}src={first}")
        return suggest(error, f"the same with '{self._source}{mark}src={first}'")


def fed(decoder: Decoder, chunks: Sequence[Chunk]) -> list[Frames]:
    """The frames that consecutive chunks complete, each with the arrival time of the chunk that holds its last byte."""
    if not decoder.stream:
        return [decoder.datagrams([chunk.data for chunk in chunks], [chunk.at for chunk in chunks])]
    if len(chunks) == 1:
        return decoder.frames(chunks[0].data, chunks[0].at)
    data = [chunk.data for chunk in chunks]
    ends = np.array([*accumulate(map(len, data), initial=decoder.stats.bytes_in)])[1:]
    found = decoder.frames(b"".join(data), chunks[-1].at)
    times = np.array([-1 if chunk.at is None else chunk.at for chunk in chunks], np.int64)
    return [frames.arrived(times[ends.searchsorted(frames.offsets + frames.sizes)]) for frames in found]


def answers(found: Sequence[Frames], awaited: frozenset[str]) -> list[Found]:
    """The frames of some types, one by one."""
    picked = []
    for spans in found:
        kinds = [index for index, name in enumerate(spans.names) if name in awaited]
        for index in np.flatnonzero(np.isin(spans.kinds, kinds)).tolist():
            at = int(spans.at[index])
            picked.append(Found(spans.names[spans.kinds[index]], int(spans.offsets[index]), spans.data(index), None if at < 0 else at))
    return picked
