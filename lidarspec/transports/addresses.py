"""Parse live SOURCEs and resolve hosts.

A live SOURCE is a scheme, a location and options: ``udp://:2368?src=10.0.0.5``.
"""

from __future__ import annotations

import contextlib
import re
import socket
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import parse_qs

from lidarspec.errors import UnknownOption, UsageError, suggest
from lidarspec.transports.protocol import Origin

#: Options of every live SOURCE. "control" is the address to send commands to; by default, it is the
#: address that sends the data. "broadcast" is the broadcast address.
_COMMON_OPTIONS = frozenset({"control", "broadcast"})
_SWITCH_VALUES = {"0": False, "1": True, "false": False, "true": True, "off": False, "on": True}
#: Matches a host and a port; an IPv6 host is in brackets.
_HOST_AND_PORT = re.compile(r"(?:\[([^\]]+)\]|([^:/]*))(?::(\d*))?/?")
#: Port that is used to find the route to a host; nothing is sent to it.
_DISCARD_PORT = 9


@dataclass(frozen=True)
class SourceAddress:
    """The parts of a live SOURCE.

    Attributes:
        location: a path, or host and port.
        options: name -> value of the options after the question mark.
    """

    text: str
    scheme: str
    location: str
    options: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str, *, scheme: str = "") -> SourceAddress:
        """Return the parts of a live SOURCE.

        Args:
            scheme: the scheme; "" to take it from `text`.
        """
        if "://" in text:
            written_scheme, _, rest = text.partition("://")
            scheme = scheme or written_scheme
        elif scheme or ":" not in text:
            scheme = scheme or text
            rest = text
        else:
            scheme, _, rest = text.partition(":")
        location, _, query = rest.partition("?")
        values = parse_qs(query, keep_blank_values=True)
        return cls(
            text, scheme, location, {name: repeated[-1] for name, repeated in values.items()}
        )

    def check(self, accepted: Collection[str]) -> None:
        """Check the names of the options.

        Args:
            accepted: the options that this source accepts, besides the general options.

        Raises:
            UnknownOption: for the first unknown option.
        """
        for name in sorted(set(self.options) - set(accepted) - _COMMON_OPTIONS):
            raise UnknownOption(name, [*accepted, *_COMMON_OPTIONS], place=self.text)

    def number(self, name: str, low: int, high: int) -> int | None:
        """Return the value of an option as an integer; None if the option is not given.

        Raises:
            UsageError: if the value is not an integer from `low` to `high`.
        """
        text = self.options.get(name)
        if text is None:
            return None
        if not text.isdecimal() or not low <= int(text) <= high:
            raise UsageError(
                f"{self.text}: {name} must be a number from {low} to {high}, not {text!r}"
            )
        return int(text)

    def switch(self, name: str) -> bool | None:
        """Return whether an option is on; None if the option is not given.

        Raises:
            UsageError: if the value is not 0, 1, true, false, on or off.
        """
        text = self.options.get(name)
        if text is None:
            return None
        if text.lower() not in _SWITCH_VALUES:
            raise UsageError(f"{self.text}: {name} must be 0 or 1, not {text!r}")
        return _SWITCH_VALUES[text.lower()]

    def host_and_port(self) -> tuple[str, int | None]:
        """Return host and port of the location; "" and None if they are omitted.

        Raises:
            UsageError: for an invalid host or port.
        """
        match = _HOST_AND_PORT.fullmatch(self.location)
        if match is None:
            raise UsageError(f"{self.text}: expected host:port, got {self.location!r}")
        port = int(match[3]) if match[3] else None
        if port is not None and not 0 < port < 65536:
            raise UsageError(f"{self.text}: a port must be a number from 1 to 65535, not {port}")
        return match[1] or match[2] or "", port


def with_option(source: str | Path, name: str, value: object) -> str:
    """Return a SOURCE with an option, which replaces any option of the same name."""
    location, _, query = str(source).partition("?")
    options = [
        option for option in query.split("&") if option and not option.startswith(f"{name}=")
    ]
    return f"{location}?{'&'.join([*options, f'{name}={value}'])}"


def parse_origin(text: str) -> Origin:
    """Return the sender that the option `src=` selects.

    A host name is replaced by its numeric address.

    Args:
        text: the value of the option.

    Raises:
        UsageError: for an invalid port or an unknown host.
    """
    origin = Origin.parse(text)
    return replace(origin, host=resolve_host(origin.host, f"src={text}"))


def resolve_host(host: str, place: str) -> str:
    """Return the numeric address of a host.

    An IPv4 address is preferred to an IPv6 address.

    Args:
        place: the option or SOURCE with the host, for the error message.

    Raises:
        UsageError: for an unknown host.
    """
    for family in (socket.AF_INET, socket.AF_INET6):
        with contextlib.suppress(OSError, ValueError):
            return socket.inet_ntop(family, socket.inet_pton(family, host.partition("%")[0]))
    # The system accepts an incomplete address, such as 192.168.1, but resolves it to another one.
    is_incomplete_address = re.fullmatch(r"[\d.]*", host) is not None
    if not is_incomplete_address:
        for family in (socket.AF_INET, socket.AF_INET6):
            with contextlib.suppress(OSError, ValueError):
                return str(socket.getaddrinfo(host, None, family, socket.SOCK_DGRAM)[0][4][0])
    error = UsageError(
        f"{place}: unknown host {host!r}: expected a host name or an address such as 192.168.1.200"
    )
    raise suggest(error, "lidarspec detect udp://")


def find_own_address(host: str) -> str | None:
    """Return the address with which this computer reaches a host; None if unknown."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        probe.connect((host, _DISCARD_PORT))
        return str(probe.getsockname()[0])
    return None
