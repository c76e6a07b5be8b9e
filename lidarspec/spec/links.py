"""How a sensor is connected, as declared: facts only, nothing here opens anything."""

from __future__ import annotations

from dataclasses import dataclass

from lidarspec.errors import SpecError


class Link:
    """How bytes come and go: a kind of one's own derives from it, and the hook `lidarspec_link` opens it.

    Attributes:
        datagrams: whether frames come one to a datagram.
    """

    @property
    def datagrams(self) -> bool:
        """Whether frames come one to a datagram."""
        return False


@dataclass(frozen=True, init=False)
class Serial(Link):
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
class Udp(Link):
    """UDP datagrams, one frame each, or with `stream` a byte stream cut into datagrams (telegrams that span several).

    Args:
        ports: the default destination ports; of data hints only, since magic and length decide; of commands the sensor's.
        broadcast: the port to which commands are broadcast while nobody knows the address of the sensor: whoever answers is it.
        local: the port here that commands are sent from, where the sensor asks for one; any by default.
    """

    ports: tuple[int, ...]
    stream: bool = False
    broadcast: int = 0
    local: int = 0

    def __init__(self, *ports: int, stream: bool = False, broadcast: int = 0, local: int = 0) -> None:
        if any(not 0 < port < 65536 for port in ports) or not (0 <= broadcast < 65536 and 0 <= local < 65536):
            raise SpecError("a UDP port is a number from 1 to 65535")
        for name, value in (("ports", tuple(ports)), ("stream", stream), ("broadcast", broadcast), ("local", local)):
            object.__setattr__(self, name, value)

    @property
    def datagrams(self) -> bool:
        """Whether each datagram is a frame."""
        return not self.stream


@dataclass(frozen=True)
class Tcp(Link):
    """A TCP byte stream from `port` of the sensor."""

    port: int


@dataclass(frozen=True)
class Http(Link):
    """Requests to the web server of the sensor: the frames of its commands are `HttpRequest`, those of its replies `HttpReply`.

    Args:
        port: of the server.
        timeout: seconds that a request may take in all.
        largest: the longest body of a reply, in bytes; a longer one is refused.
    """

    port: int = 80
    timeout: float = 5.0
    largest: int = 1 << 20

    @property
    def datagrams(self) -> bool:
        """Whether each message is a frame: it is."""
        return True


def is_datagram(link: Link | None) -> bool:
    """Whether frames arrive one to a datagram over this link."""
    return link is not None and link.datagrams
