"""Arguments of commands, and values that are filled in when a command is sent.

An argument is a number in a range, a named number, a text, an address, a port or bytes. Each kind
describes the values that it accepts, and converts them to bytes of the frame.
"""

from __future__ import annotations

import functools
import re
import string
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lidarspec.errors import SpecError


@dataclass(frozen=True)
class Range:
    """A number from `low` to `high`, in the unit of its field."""

    low: float
    high: float


@dataclass(frozen=True)
class Port(Range):
    """The UDP port to which the sensor sends its data.

    In `Command.args`, it is the type of an argument, which is a port number. In `Command.values`,
    it stands for the port at which this computer expects the data.
    """

    low: float = 1
    high: float = 65535


@dataclass(frozen=True, init=False)
class Choice(Range):
    """One of several numbers with names, for a field that several commands use.

    An example is ``("number", Choice(cartesian=0, spherical=1))``. The argument is a name or a
    number.

    Raises:
        SpecError: if there are no names, or if the values are not different integers.
    """

    names: Mapping[str, int] = field(hash=False)

    def __init__(self, **names: int) -> None:
        is_valid = all(type(value) is int for value in names.values())
        if not names or not is_valid or len(set(names.values())) < len(names):
            raise SpecError(
                "Choice requires names with different integers, as in Choice(off=0, on=1)"
            )
        object.__setattr__(self, "low", min(names.values()))
        object.__setattr__(self, "high", max(names.values()))
        object.__setattr__(self, "names", names)


@dataclass(frozen=True)
class Text:
    """A text of at most `size` bytes.

    If the field of the text has a fixed size, the text is padded with the byte `fill`.

    Raises:
        SpecError: for a size below 1, or if `fill` is not one byte.
    """

    size: int
    fill: bytes = b"\0"
    encoding: str = "ascii"

    def __post_init__(self) -> None:
        if self.size < 1 or len(self.fill) != 1:
            raise SpecError("Text(size, fill) requires a size of at least 1 and a fill of one byte")

    def describe(self, field_size: int | None) -> str:
        """Return the accepted values as text, for messages."""
        return (
            f"a string of up to {min(self.size, field_size or self.size)} bytes in"
            f" {self.encoding.upper()}"
        )

    def pack(self, value: Any, field_size: int | None) -> bytes:
        """Return the bytes of a text.

        Raises:
            ValueError: for an invalid text.
        """
        if isinstance(value, str):
            data = value.encode(self.encoding)
        else:
            data = b""
        if not isinstance(value, str) or len(data) > min(self.size, field_size or self.size):
            raise ValueError
        return data.ljust(field_size or 0, self.fill)


@dataclass(frozen=True)
class Address:
    """An IP address, for example "192.168.1.10".

    The field of an IPv4 address is 4 bytes, an array of 4 numbers or a number of 32 bits; the field
    of an IPv6 address is 16 bytes. In the `values` of a command, `Address()` is this computer's own
    address, as seen by the sensor.
    """

    def describe(self, field_size: int | None) -> str:
        """Return the accepted values as text, for messages."""
        if field_size == 16:
            return "an IPv6 address"
        if field_size:
            return "an IPv4 address"
        return "an IP address"

    def pack(self, value: Any, field_size: int | None) -> bytes:
        """Return the bytes of an address.

        Raises:
            ValueError: for a value that is not an address, or has another size than the field.
        """
        from ipaddress import ip_address  # a slow import

        if isinstance(value, str):
            address = ip_address(value)
        else:
            address = value
        if not hasattr(address, "packed") or field_size not in (None, len(address.packed)):
            raise ValueError
        return bytes(address.packed)


@dataclass(frozen=True)
class Octets:
    """Plain bytes, which a plugin declares by the type: ("key", bytes)."""

    def describe(self, field_size: int | None) -> str:
        """Return the accepted values as text, for messages."""
        if field_size is None:
            return "bytes"
        return f"{field_size} bytes"

    def pack(self, value: Any, field_size: int | None) -> bytes:
        """Return the bytes.

        Raises:
            ValueError: for another type, or if the length differs from that of the field.
        """
        if not isinstance(value, bytes | bytearray) or field_size not in (None, len(value)):
            raise ValueError
        return bytes(value)


Taken = Range | Text | Address | Octets


@dataclass(frozen=True)
class Count:
    """A running number in `Command.values`; every sent command has the next number.

    Args:
        bits: the width of the number in bits. After the largest number, the count continues with 0.
        first: the number of the first command.

    Raises:
        SpecError: if `bits` is below 1, or `first` does not fit.
    """

    bits: int
    first: int = 0

    def __post_init__(self) -> None:
        if self.bits < 1 or not 0 <= self.first < 1 << self.bits:
            raise SpecError(
                "Count(bits, first): `bits` must be at least 1, and `first` from 0 to 2**bits - 1"
            )

    def at(self, index: int) -> int:
        """Return the running number of a command.

        Args:
            index: the number of commands that were sent before this command.
        """
        return (self.first + index) % (1 << self.bits)


#: Names in a `Template` that need no declaration.
OWN_ADDRESS = "own_address"
OWN_PORT = "own_port"
#: The characters that are allowed in a value of a `Template`. No other characters are allowed, so
#: that the values of a reply cannot add text to a later request.
_SAFE_VALUE = r"[\w.~:+-]*"


@dataclass(frozen=True)
class Template:
    """A text in `Command.values` with names in braces, which are replaced by values.

    An example is ``Template("/cmd/start?handle={handle}&port={own_port}")``. A name is a value that
    an earlier reply provided (`Command.provides`), or an argument of the command. `own_address` is
    this computer's address as seen by the sensor, and `own_port` is the port at which this computer
    expects the data. Values consist of ASCII letters, digits and ``_.~:+-``.

    Raises:
        SpecError: if the text is not ASCII, contains no names, or has an invalid name in braces.
    """

    text: str

    def __post_init__(self) -> None:
        try:
            parts = list(string.Formatter().parse(self.text))
        except ValueError as error:
            raise SpecError(f"Template({self.text!r}): {error}") from None
        names = [name for _, name, _, _ in parts if name is not None]
        for _, name, form, conversion in parts:
            if name is not None and (not name.isidentifier() or form or conversion):
                raise SpecError(f"Template({self.text!r}): expected names in braces, got {name!r}")
        if not names or len(names) != len(set(names)) or not self.text.isascii():
            raise SpecError(
                f"Template({self.text!r}): expected an ASCII text with one or more different names"
                " in braces"
            )

    @functools.cached_property
    def names(self) -> tuple[str, ...]:
        """The names in braces."""
        return tuple(
            name for _, name, _, _ in string.Formatter().parse(self.text) if name is not None
        )

    @functools.cached_property
    def literal_size(self) -> int:
        """The number of characters outside of braces."""
        return sum(len(text) for text, _, _, _ in string.Formatter().parse(self.text))

    def fill(self, values: Mapping[str, Any]) -> bytes:
        """Return the text with the names replaced by values.

        Raises:
            ValueError: for a value with a character that is not allowed.
        """
        texts = {name: _format_value(values[name]) for name in self.names}
        for name, text in texts.items():
            if re.fullmatch(_SAFE_VALUE, text, re.ASCII) is None:
                raise ValueError(
                    f"{name} must consist of letters, digits and _.~:+-, got {text!r:.60}"
                )
        return self.text.format_map(texts).encode()

    def match(self, data: Any) -> dict[str, str] | None:
        """Return the values in a text, by name; None if it does not match the template."""
        if not isinstance(data, bytes):
            return None
        matched = self._pattern.fullmatch(data.decode("latin-1"))
        return None if matched is None else matched.groupdict()

    @functools.cached_property
    def _pattern(self) -> re.Pattern[str]:
        pattern = ""
        for text, name, _, _ in string.Formatter().parse(self.text):
            pattern += re.escape(text)
            if name is not None:
                pattern += f"(?P<{name}>{_SAFE_VALUE})"
        return re.compile(pattern, re.ASCII)


def _format_value(value: Any) -> str:
    """Return a value as text, without decimal places for a whole number."""
    if isinstance(value, float) and value.is_integer():
        return str(int(value))
    return str(value)


#: A value of a command that is determined only when the command is sent.
Filled = Count | Address | Port | Template


@dataclass(frozen=True)
class Argument:
    """An argument of a command.

    Attributes:
        path: the path of the field, with an index for an element of an array, such as "ports[1]".
        kind: the values that the argument accepts.
    """

    path: str
    kind: Taken

    def to_dict(self) -> dict[str, Any]:
        """Return the path of the field and the accepted values as JSON data."""
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
    """Return the argument that a plugin declared as a tuple.

    Examples are ("motor.speed", 5, 15), ("data.host", Address()) and ("key", bytes).

    Raises:
        SpecError: for an invalid declaration.
    """
    match given:
        case (str(path), int() | float() as low, int() | float() as high):
            return Argument(path, Range(low, high))
        case (str(path), Text() | Address() | Port() | Choice() as kind):
            return Argument(path, kind)
        case (str(path), kind) if kind is bytes:
            return Argument(path, Octets())
    raise SpecError(
        "an argument must be (path, lowest, highest), (path, Text(16)), (path, Address()), (path,"
        f" Port()), (path, Choice(off=0, on=1)) or (path, bytes), not {given!r:.60}"
    )
