"""How a sensor is connected, as declared: facts only, nothing here opens anything."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lidarspec.errors import SpecError
from lidarspec.spec.syntax import has_member


class Link:
    """How bytes come and go: a kind of one's own derives from it, and the hook `lidarspec_link`
    opens it.

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


@dataclass(frozen=True, eq=False)
class Assembled:
    """What a datagram says that is a fragment of a message: of which one, and which part of it.

    Args:
        struct: the construct Struct of a fragment, or of its header alone.
        key: the field, or fields, that tell messages apart, such as a counter; no two of 16
            messages in a row have the same.
        index: the field with the number of the fragment in its message.
        count: the field with the number of fragments of the message.
        payload: the field of bytes that is a part of the message; "" where that is all that stands
            behind the struct.
        first: the index of the first fragment.
        in_bytes: `index` is the place of the fragment in the message in bytes, and `count` the
            bytes of the message.

    Raises:
        SpecError: for a field that the struct does not have.
    """

    struct: Any
    key: str | tuple[str, ...] = field(kw_only=True)
    index: str = field(kw_only=True)
    count: str = field(kw_only=True)
    payload: str = field(default="", kw_only=True)
    first: int = field(default=0, kw_only=True)
    in_bytes: bool = field(default=False, kw_only=True)

    def __post_init__(self) -> None:
        for path in (*self.keys, self.index, self.count, *filter(None, (self.payload,))):
            if not has_member(self.struct, path):
                raise self.wrong(f"the fragment has no field {path!r}")

    @property
    def keys(self) -> tuple[str, ...]:
        """The fields that tell messages apart."""
        if isinstance(self.key, str):
            return (self.key,)
        return tuple(self.key)

    def wrong(self, reason: str) -> SpecError:
        """An error that says where it is."""
        return SpecError(reason, path="links.data.assembled")


@dataclass(frozen=True, init=False)
class Udp(Link):
    """UDP datagrams, one frame each, or with `stream` a byte stream cut into datagrams (telegrams
    that span several).

    Args:
        ports: the default destination ports; of data hints only, since magic and length decide; of
            commands the sensor's.
        assembled: what says how datagrams are joined to a message, where one does not fit into one;
            others pass as they are.
        broadcast: the port to which commands are broadcast while nobody knows the address of the
            sensor: whoever answers is it.
        local: the port here that commands are sent from, where the sensor asks for one; any by
            default.
    """

    ports: tuple[int, ...]
    stream: bool = False
    assembled: Assembled | None = None
    broadcast: int = 0
    local: int = 0

    def __init__(
        self,
        *ports: int,
        stream: bool = False,
        assembled: Assembled | None = None,
        broadcast: int = 0,
        local: int = 0,
    ) -> None:
        if any(not 0 < port < 65536 for port in ports) or not (
            0 <= broadcast < 65536 and 0 <= local < 65536
        ):
            raise SpecError("a UDP port is a number from 1 to 65535")
        if stream and assembled is not None:
            raise SpecError("datagrams are fragments of messages, or pieces of a stream, not both")
        given = {
            "ports": tuple(ports),
            "stream": stream,
            "assembled": assembled,
            "broadcast": broadcast,
            "local": local,
        }
        for name, value in given.items():
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
    """Requests to the web server of the sensor: the frames of its commands are `HttpRequest`, those
    of its replies `HttpReply`.

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
