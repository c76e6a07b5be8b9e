"""How a sensor is connected, as declared: facts only, nothing here opens anything."""

from __future__ import annotations

from dataclasses import dataclass

from lidarspec.errors import SpecError


@dataclass(frozen=True, init=False)
class Serial:
    """A UART or USB serial port, 8N1.

    Args:
        bauds: the baud rate, or all that the models of this id use, the most likely first.
        dtr, rts: level of the control lines while open; None leaves them alone.
    """

    bauds: tuple[int, ...]
    dtr: bool | None = None
    rts: bool | None = None

    def __init__(self, *bauds: int, dtr: bool | None = None, rts: bool | None = None) -> None:
        if not bauds or any(baud <= 0 for baud in bauds):
            raise SpecError("a serial link needs at least one baud rate above 0")
        object.__setattr__(self, "bauds", tuple(bauds))
        object.__setattr__(self, "dtr", dtr)
        object.__setattr__(self, "rts", rts)

    @property
    def baud(self) -> int:
        """The most likely baud rate."""
        return self.bauds[0]


@dataclass(frozen=True, init=False)
class Udp:
    """UDP datagrams, one frame each, or with `stream` a byte stream cut into datagrams (telegrams that span several).

    Args:
        ports: the default destination ports; hints only, since magic and length decide.
    """

    ports: tuple[int, ...]
    stream: bool = False

    def __init__(self, *ports: int, stream: bool = False) -> None:
        if any(not 0 < port < 65536 for port in ports):
            raise SpecError("a UDP port is a number from 1 to 65535")
        object.__setattr__(self, "ports", tuple(ports))
        object.__setattr__(self, "stream", stream)


@dataclass(frozen=True)
class Tcp:
    """A TCP byte stream from `port` of the sensor."""

    port: int


Link = Serial | Udp | Tcp


def is_datagram(link: Link | None) -> bool:
    """Whether frames arrive one to a datagram over this link."""
    return isinstance(link, Udp) and not link.stream
