"""What a command is told: the kinds of its arguments, and the values that are found out when it is
sent.

An argument is a number in a range, a text, an address or bytes; each kind says in words what it
takes, and as which bytes that stands in the frame. `Count` and `Address` among the `values` of a
command are filled in by the conversation: a running number, and where we are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lidarspec.errors import SpecError


@dataclass(frozen=True)
class Range:
    """A number from `low` to `high`, in the unit of its field; written as two numbers behind the
    path.
    """

    low: float
    high: float


@dataclass(frozen=True)
class Text:
    """A text of at most `size` bytes; where its field has a fixed size, it is filled up with
    `fill`.

    Raises:
        SpecError: for a size below 1, and a fill that is not one byte.
    """

    size: int
    fill: bytes = b"\0"
    encoding: str = "ascii"

    def __post_init__(self) -> None:
        if self.size < 1 or len(self.fill) != 1:
            raise SpecError(
                "Text(size, fill) has room for a byte at least, and is filled up with one"
            )

    def words(self, room: int | None) -> str:
        """What it takes."""
        return (
            f"a text of up to {min(self.size, room or self.size)} bytes in {self.encoding.upper()}"
        )

    def pack(self, value: Any, room: int | None) -> bytes:
        """The bytes of a text; ValueError for what it does not take."""
        if isinstance(value, str):
            data = value.encode(self.encoding)
        else:
            data = b""
        if not isinstance(value, str) or len(data) > min(self.size, room or self.size):
            raise ValueError
        return data.ljust(room or 0, self.fill)


@dataclass(frozen=True)
class Address:
    """An IP address, "192.168.1.10": 4 bytes, an array of 4 numbers or one of 32 bits; 16 for IPv6.

    Among the `values` of a command it is this computer's own, as the sensor sees it.
    """

    def words(self, room: int | None) -> str:
        """What it takes."""
        if room == 16:
            return "an IPv6 address"
        if room:
            return "an IPv4 address"
        return "an IP address"

    def pack(self, value: Any, room: int | None) -> bytes:
        """The bytes of an address; ValueError for what is none, or does not fit."""
        from ipaddress import ip_address  # which takes longer to import than all else here

        if isinstance(value, str):
            found = ip_address(value)
        else:
            found = value
        if not hasattr(found, "packed") or room not in (None, len(found.packed)):
            raise ValueError
        return bytes(found.packed)


@dataclass(frozen=True)
class Octets:
    """Bytes as they are; written as `bytes` behind the path."""

    def words(self, room: int | None) -> str:
        """What it takes."""
        if room is None:
            return "bytes"
        return f"{room} bytes"

    def pack(self, value: Any, room: int | None) -> bytes:
        """The bytes; ValueError for what are none, or not so many."""
        if not isinstance(value, bytes | bytearray) or room not in (None, len(value)):
            raise ValueError
        return bytes(value)


Taken = Range | Text | Address | Octets


@dataclass(frozen=True)
class Count:
    """A running number of so many bits in `Command.values`, of which each command that is sent has
    the next; `first` is that of the first.

    Raises:
        SpecError: for a number of bits below 1, or a first number that they cannot hold.
    """

    bits: int
    first: int = 0

    def __post_init__(self) -> None:
        if self.bits < 1 or not 0 <= self.first < 1 << self.bits:
            raise SpecError(
                "Count(bits, first) has a bit at least, and begins with a number that its bits hold"
            )

    def at(self, index: int) -> int:
        """The number of the command that is sent as the `index`-th one, from 0."""
        return (self.first + index) % (1 << self.bits)


#: what stands among the values of a command until it is sent.
Filled = Count | Address


@dataclass(frozen=True)
class Argument:
    """An argument of a command: the path of its field, with the indices of elements of arrays
    ("ports[1]"), and what it takes.
    """

    path: str
    kind: Taken

    def to_dict(self) -> dict[str, Any]:
        """As data: its field, and the ends of its range or what else it takes."""
        own = {
            name: value.decode("latin-1") if isinstance(value, bytes) else value
            for name, value in vars(self.kind).items()
        }
        return {
            "field": self.path,
            **({} if isinstance(self.kind, Range) else {"kind": type(self.kind).__name__.lower()}),
            **own,
        }


def argument(given: Any) -> Argument:
    """What ("motor.speed", 5, 15), ("data.host", Address()), ("name", Text(16)) or ("key", bytes)
    declares.

    Raises:
        SpecError: for anything else.
    """
    match given:
        case (str(path), int() | float() as low, int() | float() as high):
            return Argument(path, Range(low, high))
        case (str(path), Text() | Address() as kind):
            return Argument(path, kind)
        case (str(path), kind) if kind is bytes:
            return Argument(path, Octets())
    raise SpecError(
        "an argument is (path, lowest, highest), (path, Text(16)), (path, Address()) or (path,"
        f" bytes), not {given!r:.60}"
    )
