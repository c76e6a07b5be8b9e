"""Replays: what was recorded goes out again, byte for byte, at the times of then or faster or slower.

Every chunk has a deadline on the monotonic clock, reckoned from the first one and not from the one before, so that what a wait
oversleeps is not added up. A chunk that is late goes out at once.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol

from lidarspec.transports.protocol import Chunk

_SECOND = 1_000_000_000


class Player(Protocol):
    """Where a replay goes to."""

    #: what a user names it by, as a SOURCE.
    place: str

    def wait(self) -> None:
        """Returns when somebody listens, where that can be known."""

    def send(self, chunk: Chunk) -> None:
        """Pass on what was received then.

        Raises:
            Disconnected: where nobody listens any more.
            SourceError: where it cannot be sent.
        """

    def close(self) -> None:
        """Give the port, socket or file back, when all of it has arrived."""


class Deadlines:
    """When each chunk is due, in ns of the monotonic clock.

    Times that go back a little, as those of datagrams that overtook each other, are due at once; behind a step back of more than
    a second, as when a clock was set, time is reckoned on from there.

    Args:
        speed: 2.0 is twice as fast; None as fast as possible.
        start: when the first one is due.
    """

    def __init__(self, speed: float | None, start: int) -> None:
        self._speed, self._start = speed, start
        self._origin: int | None = None
        self._latest = 0

    def due(self, at: int | None) -> int:
        """When something that arrived at this time is due; at once, where nobody knows when that was."""
        if self._speed is None or at is None:
            return self._start
        if self._origin is None:
            self._origin = self._latest = at
        elif at < self._latest - _SECOND:
            self._origin, self._latest = self._origin + at - self._latest, at
        self._latest = max(self._latest, at)
        return self._start + round((at - self._origin) / self._speed)


def replayed(
    chunks: Iterable[Chunk],
    player: Player,
    *,
    speed: float | None = 1.0,
    now: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[tuple[Chunk, int]]:
    """Each chunk once it has been sent, and by how many ns it was late.

    Args:
        chunks: with their arrival times.
        speed: 2.0 is twice as fast; None as fast as possible.
    """
    deadlines: Deadlines | None = None
    for chunk in chunks:
        deadlines = deadlines or Deadlines(speed, now())
        due = deadlines.due(chunk.at)
        while (left := due - now()) > 0:
            sleep(left / _SECOND)
        player.send(chunk)
        yield chunk, max(-left, 0) if speed is not None else 0
