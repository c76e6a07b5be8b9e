"""Replace construct's Checksum of a RawCopy by a struct with a checksum.

A struct with ``"body" / RawCopy(...), "crc" / Checksum(Int8ub, function, this.body.data)`` is
converted to a `Checksummed` with the function as its algorithm. To find the covered part, the
expression of the Checksum is called with an object that records the names that the expression
reads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import construct
from construct import Construct, Struct

from lidarspec.spec.checksums import Checksum
from lidarspec.spec.syntax.replacements import BoundedPart, ChecksummedBase

#: The maximum width of a checksum that is computed for many frames at once, in bits.
MAX_CHECKSUM_BITS = 64


@dataclass(frozen=True)
class FunctionChecksum(Checksum):
    """A checksum algorithm that calls the function of construct's Checksum.

    Attributes:
        function: the function, which returns the checksum as a number or bytes.
        takes_raw_copy: whether the function is called with the Container that a RawCopy returns,
            instead of only the bytes of the part.
    """

    function: Callable[[Any], int | bytes]
    width: int
    takes_raw_copy: bool = False

    def __call__(self, data: bytes | bytearray | memoryview) -> int:
        content: Any = bytes(data)
        if self.takes_raw_copy:
            content = construct.Container(data=content, length=len(content))
        value = self.function(content)
        if isinstance(value, bytes):
            value = int.from_bytes(value, self.order)
        return value & ((1 << self.width) - 1)

    def describe(self) -> str:
        return getattr(self.function, "__name__", "a function")


@dataclass(frozen=True)
class _NameRecorder:
    """An object that records the names of the members that an expression reads."""

    names: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> _NameRecorder:
        return _NameRecorder((*self.names, name))

    def __getattr__(self, name: str) -> _NameRecorder:
        if name.startswith("__"):
            raise AttributeError(name)
        return self[name]


def extract_checksums(members: Sequence[Construct]) -> tuple[list[Construct], list[dict[str, Any]]]:
    """Replace each Checksum of a RawCopy by a plain field that stores the checksum.

    Args:
        members: the members of a struct.

    Returns:
        The new members of the struct, and for each replaced Checksum the arguments of a
        `ChecksummedBase` (the base class of `Checksummed`).
    """
    found = list[Construct]()
    checksums = list[dict[str, Any]]()
    for member in members:
        checksum = _strip(member)
        over = _find_covered_part(checksum, members) if member.name else None
        if over is None or not isinstance(checksum, construct.Checksum):
            found.append(member)
            continue
        names, takes_raw_copy = over
        width = 8 * int(checksum.checksumfield.sizeof())
        algorithm = FunctionChecksum(checksum.hashfunc, width, takes_raw_copy)
        checksums.append({"field": member.name, "algorithm": algorithm, "over": ".".join(names)})
        found.append(
            construct.Renamed(checksum.checksumfield, newname=member.name, newdocs=member.docs)
        )
    return found, checksums


def add_checksums(struct: Construct, checksums: Sequence[dict[str, Any]]) -> Construct:
    """Wrap a struct in one `ChecksummedBase` for each checksum, one inside another.

    Args:
        checksums: the arguments of each `ChecksummedBase`; that of the innermost struct is first.
    """
    for arguments in checksums:
        struct = ChecksummedBase.plugin_class(struct, **arguments)
    return struct


def _find_covered_part(
    checksum: Construct, members: Sequence[Construct]
) -> tuple[tuple[str, ...], bool] | None:
    """Find the RawCopy that a checksum covers, or return None.

    Returns:
        The names that lead to the RawCopy, and whether the function of the checksum is called with
        the Container of the RawCopy instead of its bytes.
    """
    if not isinstance(checksum, construct.Checksum):
        return None
    try:
        asked = checksum.bytesfunc(_NameRecorder())
        bits = 8 * int(checksum.checksumfield.sizeof())
    except Exception:  # a function of a plugin may raise anything
        return None
    if not isinstance(asked, _NameRecorder) or bits > MAX_CHECKSUM_BITS:
        return None
    if asked.names[-1:] == ("data",) and _is_raw_copy(members, asked.names[:-1]):
        return asked.names[:-1], False
    if _is_raw_copy(members, asked.names):
        return asked.names, True
    return None


def _is_raw_copy(members: Sequence[Construct], names: Sequence[str]) -> bool:
    """Return whether names lead to a RawCopy, through structs only."""
    part: Construct | None = None
    for index, name in enumerate(names):
        if index:
            if not isinstance(part, Struct):
                return False
            members = part.subcons
        part = next((_strip(member) for member in members if member.name == name), None)
    return isinstance(part, construct.RawCopy)


def _strip(con: Construct) -> Construct:
    """Return a construct without its name; for a Prefixed, return its content."""
    while isinstance(con, construct.Renamed | construct.Prefixed | BoundedPart):
        con = con.subcon
    return con
