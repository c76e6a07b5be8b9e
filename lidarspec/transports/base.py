"""What transports share: addresses with options, the host's clock, waiting for a descriptor,
failures with the next command.
"""

from __future__ import annotations

import contextlib
import os
import re
import selectors
import socket
import time
from abc import abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import parse_qs

from lidarspec.errors import SourceError, UnknownOption, UsageError, suggest
from lidarspec.spec.description import Spec
from lidarspec.spec.links import Link
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.protocol import Chunk, Disconnected, LiveTransport, Origin

#: options that every live SOURCE takes: the address of the link that commands go over, where it is
#: not that of the data, and of everybody.
COMMON = frozenset({"control", "broadcast"})
#: seconds between two reads, in which a fast line gathers some bytes: it would wake us for every
#: one.
PAUSE = 0.002
#: ns by which a wall clock may go differently; more is a clock that was set.
PARTED = 50_000_000
#: times that both are read where something comes between; what may come between is a part of that.
TRIES = 10
#: ns between two readings of a clock after which a thread was held up: a reading takes less than a
#: thousandth of it.
HELD_UP_NS = 200_000
_BOOTTIME: int | None = getattr(time, "CLOCK_BOOTTIME", None)
L = TypeVar("L", bound=Link)
_Descriptor = int | socket.socket
#: `select` knows no descriptor above 1,023; Windows, which has nothing else, does not number them
#: so.
_Poll = getattr(selectors, "PollSelector", selectors.SelectSelector)
_SWITCH = {"0": False, "1": True, "false": False, "true": True, "off": False, "on": True}


@dataclass(frozen=True)
class Address:
    """A live SOURCE taken apart.

    Attributes:
        text: as it was given.
        scheme: "serial", "udp", "tcp" and so on.
        place: a path, or host and port.
        options: what stands behind the question mark; of an option that is given twice, the last.
    """

    text: str
    scheme: str
    place: str
    options: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str, *, scheme: str = "") -> Address:
        """The address that a text stands for.

        Args:
            text: "udp://:2368?src=10.0.0.5", or a port's name with options, where `scheme` says
                what it is.
        """
        begin, mark, rest = (
            text.partition("://")
            if "://" in text
            else text.partition(":")
            if not scheme
            else (scheme, "", text)
        )
        place, _, query = (rest if mark else text).partition("?")
        return cls(
            text,
            scheme or begin,
            place,
            {name: values[-1] for name, values in parse_qs(query, keep_blank_values=True).items()},
        )

    def check(self, known: Collection[str]) -> None:
        """Refuse options that the source does not take.

        Raises:
            UnknownOption: for the first of them.
        """
        for name in sorted(set(self.options) - set(known) - COMMON):
            raise UnknownOption(name, [*known, *COMMON], place=self.text)

    def number(self, name: str, low: int, high: int) -> int | None:
        """A whole number among the options, None where it is not given.

        Raises:
            UsageError: where it is no number from `low` to `high`.
        """
        text = self.options.get(name)
        if text is None:
            return None
        if not text.isdecimal() or not low <= int(text) <= high:
            raise UsageError(f"{self.text}: {name} is a number from {low} to {high}, not {text!r}")
        return int(text)

    def switch(self, name: str) -> bool | None:
        """Something on or off among the options, None where it is not given.

        Raises:
            UsageError: for any other word.
        """
        text = self.options.get(name)
        if text is not None and text.lower() not in _SWITCH:
            raise UsageError(f"{self.text}: {name} is 0 or 1, not {text!r}")
        return None if text is None else _SWITCH[text.lower()]

    def host_and_port(self) -> tuple[str, int | None]:
        """Host and port of the place, "" and None where they are left out; an IPv6 host stands in
        brackets.

        Raises:
            UsageError: where the place is no host and port.
        """
        found = re.fullmatch(r"(?:\[([^\]]+)\]|([^:/]*))(?::(\d*))?/?", self.place)
        if found is None:
            raise UsageError(f"{self.text}: {self.place!r} is no host:port")
        port = int(found[3]) if found[3] else None
        if port is not None and not 0 < port < 65536:
            raise UsageError(f"{self.text}: a port is a number from 1 to 65535, not {port}")
        return found[1] or found[2] or "", port


def with_option(source: str | Path, name: str, value: object) -> str:
    """A SOURCE with an option behind its question mark, in the place of one that is there."""
    place, _, query = str(source).partition("?")
    options = [
        option for option in query.split("&") if option and not option.startswith(f"{name}=")
    ]
    return f"{place}?{'&'.join([*options, f'{name}={value}'])}"


def origin(text: str) -> Origin:
    """Whose datagrams `src=` asks for, by address.

    Raises:
        UsageError: for a port that is none, and a host that nobody knows.
    """
    found = Origin.parse(text)
    return replace(found, host=numeric(found.host, f"src={text}"))


def numeric(host: str, place: str) -> str:
    """The address that a host's address or name stands for; the IPv4 one where it has both.

    Args:
        place: for the message.

    Raises:
        UsageError: where nobody knows it.
    """
    for family in (socket.AF_INET, socket.AF_INET6):
        with contextlib.suppress(OSError, ValueError):
            return socket.inet_ntop(family, socket.inet_pton(family, host.partition("%")[0]))
    if not re.fullmatch(r"[\d.]*", host):  # which are addresses that are not whole
        for family in (socket.AF_INET, socket.AF_INET6):
            with contextlib.suppress(OSError, ValueError):
                return str(socket.getaddrinfo(host, None, family, socket.SOCK_DGRAM)[0][4][0])
    error = UsageError(
        f"{place}: there is no host {host!r}; name one, or its address, such as 192.168.1.200"
    )
    raise suggest(error, "lidarspec detect udp://")


class HostClock:
    """Times of the wall clock that a steady clock carries on: none of their intervals jumps when
    the clock is set, or lacks a suspend.

    Args:
        wall: the wall clock, ns since 1970.
    """

    def __init__(self, wall: Callable[[], int] = time.time_ns) -> None:
        self._wall, self._offset, self._ahead = wall, 0, 0
        for _ in range(TRIES):
            self._offset, doubt = self._difference()
            if doubt < PARTED // TRIES:
                break

    def now(self) -> int:
        """Nanoseconds since 1970."""
        return steady_ns() + self._offset

    def now_and_wall(self) -> tuple[int, int]:
        """Return the time of this clock and of the wall clock at one moment, ns since 1970.

        A thread may be held up between the two readings: then both are taken again, and the closest
        ones are returned.
        """
        closest: tuple[int, int, int] | None = None
        for _ in range(TRIES):
            now = self.now()
            wall = self._wall()
            gap = self.now() - now
            if closest is None or gap < closest[0]:
                closest = gap, now, wall
            if gap < HELD_UP_NS:
                break
        assert closest is not None
        return closest[1:]

    def parted(self) -> int | None:
        """By how many ns the wall clock is ahead of these times, where it was set by more than 50
        ms since the last call; else None.
        """
        difference, doubt = self._difference()
        ahead = difference - self._offset
        if abs(ahead - self._ahead) <= PARTED or doubt > PARTED // TRIES:
            return None
        self._ahead = ahead
        return ahead

    def _difference(self) -> tuple[int, int]:
        """By how much the wall clock is ahead of the steady one, and how wrong that may be: one is
        read after the other.
        """
        before, wall = steady_ns(), self._wall()
        return wall - before, steady_ns() - before


def steady_ns() -> int:
    """A clock that nobody sets, in ns; where the system has one, one that goes on while it is
    suspended.
    """
    return time.monotonic_ns() if _BOOTTIME is None else time.clock_gettime_ns(_BOOTTIME)


def own_address(host: str) -> str | None:
    """The address of this computer on the way to a host; None where there is no way. Nothing is
    sent.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        probe.connect((host, 9))
        return str(probe.getsockname()[0])
    return None


def rest(until: float) -> None:
    """Returns at a time of the monotonic clock: between two reads some bytes gather, so that not
    each of them wakes us.
    """
    if (pause := until - time.monotonic()) > 0:
        time.sleep(pause)


class StreamTransport(LiveTransport):
    """A line that bytes come over, read as they come, with a short pause after each read.

    Attributes:
        gone: everything that a line which went away raises.
    """

    gone: tuple[type[BaseException], ...] = (OSError, ValueError)

    def __init__(self, label: str, sensor: Sensor | None) -> None:
        self.label, self._sensor, self._clock, self._rested = label, sensor, HostClock(), 0.0

    def read(self, timeout: float) -> list[Chunk]:
        rest(self._rested)
        try:
            data = self._received(timeout)
        except self.gone as error:
            if self.closed:
                return []
            raise lost(self.label, error) from None
        self._rested = time.monotonic() + PAUSE if data else 0.0
        return [Chunk(data, self._clock.now())] if data else []

    @abstractmethod
    def _received(self, timeout: float) -> bytes:
        """What has arrived; nothing where nothing did for `timeout` seconds."""


def readable(descriptor: int, timeout: float) -> bool:
    """Whether there is something to read, or the other side has hung up, within so many seconds."""
    return bool(ready([descriptor], [], timeout)[0])


def ready(
    reading: Collection[_Descriptor], writing: Collection[_Descriptor], timeout: float
) -> tuple[list[Any], list[Any]]:
    """What of these can be read, or has hung up, and what can be written to, within so many
    seconds; descriptors may have any number.
    """
    with _Poll() as poll:
        for one in {*reading, *writing}:
            poll.register(
                one,
                selectors.EVENT_READ * (one in reading) | selectors.EVENT_WRITE * (one in writing),
            )
        found = poll.select(timeout)
    to_read, to_write = (
        [key.fileobj for key, events in found if events & kind]
        for kind in (selectors.EVENT_READ, selectors.EVENT_WRITE)
    )
    return to_read, to_write


def failure(text: str, following: str) -> SourceError:
    """A SourceError with the next command to type."""
    return suggest(SourceError(text), following)


def lost(label: str, error: BaseException | str) -> Disconnected:
    """The device behind a source went away."""
    return Disconnected(f"{label}: the connection was lost: {reason(error)}")


def reason(error: BaseException | str) -> str:
    """What the system says, in its own words, also where pyserial wraps it in a sentence of its
    own.
    """
    numbers = error_numbers(error) if isinstance(error, BaseException) else []
    return os.strerror(numbers[0]) if numbers else str(error)


def error_numbers(error: BaseException) -> list[int]:
    """The numbers of the system's errors that an exception was made of."""
    return [number for number in error.args if isinstance(number, int)]


def data_link(sensor: Spec | None, kind: type[L]) -> L | None:
    """The data link of a sensor, where it is of this kind."""
    link = sensor.links.get("data") if sensor is not None else None
    return link if isinstance(link, kind) else None


def named(sensor: Sensor | None) -> str:
    """The option that names a sensor in a command to type."""
    return f" -s {sensor.id}" if sensor is not None else ""
