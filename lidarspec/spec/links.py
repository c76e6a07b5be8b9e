"""The declared connections of a sensor, which the package `transports` opens."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lidarspec.errors import SpecError
from lidarspec.spec.syntax import has_member


class Link:
    """The base class of all kinds of connection.

    If a plugin declares its own kind of connection, the hook `lidarspec_link` opens it.

    Attributes:
        datagrams: whether each datagram is a frame.
    """

    @property
    def datagrams(self) -> bool:
        """Whether each datagram is a frame."""
        return False


@dataclass(frozen=True, init=False)
class Serial(Link):
    """A UART or USB serial port, 8N1.

    Args:
        bauds: the baud rate, or several rates that sensors of this model use, the most likely
            first.
        dtr: the level of the control line DTR while the port is open; None to leave it unchanged.
        rts: the level of the control line RTS while the port is open; None to leave it unchanged.
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
    """The rule for joining datagrams that are fragments of a message.

    Args:
        struct: the construct Struct of a datagram, or of only its header.
        key: the path of the field, or the paths of several fields, that identify the message, such
            as a counter. Any 16 consecutive messages must have different keys.
        index: the path of the field with the index of the fragment in its message.
        count: the path of the field with the number of fragments of the message.
        payload: the path of the field with the fragment of the message; "" if the fragment is
            everything after the struct.
        first: the index of the first fragment.
        in_bytes: whether `index` is the offset of the fragment in the message, and `count` is the
            size of the message, in bytes.

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
                raise self.make_error(f"the fragment has no field {path!r}")

    @property
    def keys(self) -> tuple[str, ...]:
        """The fields that identify a message."""
        if isinstance(self.key, str):
            return (self.key,)
        return tuple(self.key)

    def make_error(self, reason: str) -> SpecError:
        """Return the error for a mistake in this declaration."""
        return SpecError(reason, path="links.data.assembled")


@dataclass(frozen=True, init=False)
class Udp(Link):
    """UDP datagrams, which are frames or portions of a byte stream.

    Args:
        ports: the default ports. For a data link: the ports of this computer to which the sensor
            sends. For a link over which commands are sent: the port of the sensor.
        stream: whether the datagrams are portions of a byte stream, in which a frame can extend
            over several datagrams.
        assembled: the rule that joins datagrams to messages, if messages can be longer than a
            datagram. Datagrams that do not follow this rule are used unchanged.
        broadcast: the port to which commands are broadcast as long as the address of the sensor is
            unknown. The first host that replies is the sensor.
        local: the port of this computer from which commands are sent, if the sensor requires one; 0
            for any port.
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
            raise SpecError("a UDP port must be a number from 1 to 65535")
        if stream and assembled is not None:
            raise SpecError("datagrams cannot be both fragments of messages and pieces of a stream")
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
    """A TCP byte stream from a port of the sensor.

    Args:
        port: the port; 0 if the sensor reports it.
        reported: if the port is not fixed, the name under which a reply provides the port
            (`Command.provides`). The link is opened after that reply.
    """

    port: int = 0
    reported: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        if not 0 <= self.port < 65536 or bool(self.port) == bool(self.reported):
            raise SpecError("Tcp requires a port from 1 to 65535, or `reported`")


@dataclass(frozen=True)
class Http(Link):
    """Requests to the web server of the sensor.

    Commands are `HttpRequest` frames, and replies are `HttpReply` frames.

    Args:
        port: the port of the server.
        timeout: the maximum time from a request to the end of its reply, seconds.
        largest: the maximum size of the body of a reply, in bytes. A longer reply is an error.
    """

    port: int = 80
    timeout: float = 5.0
    largest: int = 1 << 20

    @property
    def datagrams(self) -> bool:
        """Always True: each message is a frame."""
        return True


def is_datagram(link: Link | None) -> bool:
    """Return whether each datagram of a link is a frame; False for None."""
    return link is not None and link.datagrams
