"""Bit blocks, found out by probing: which bits of a block of bytes make up each value that construct parses from it.

A block (``BitStruct``, ``ByteSwapped``, ``BitsSwapped``, ``BytesInteger``, in any nesting) is linear in its bits:
value = sum of bit * weight. Parsing it once with no bit set and once with each single bit set gives the weights;
random blocks then confirm them. So no rule about bit order stands anywhere but in construct itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from construct import Adapter, BitsInteger, Bytes, BytesInteger, Construct, Enum, EnumIntegerString, Flag, FormatField, Struct, Subconstruct

#: random blocks that have to agree before a probed block is believed.
CONFIRMATIONS = 24


@dataclass(frozen=True)
class Segment:
    """A run of bits of one byte that lands in a value: ``((byte & mask) >> low) << target`` is added to it."""

    byte: int
    mask: int
    low: int
    target: int


@dataclass(frozen=True)
class BitField:
    """One value of a bit block.

    Attributes:
        keys: where the parsed block holds it: field names and array indices.
        segments: its bits.
        width: number of bits.
        signed: whether the top bit counts negative.
    """

    keys: tuple[str | int, ...]
    segments: tuple[Segment, ...]
    width: int
    signed: bool

    @cached_property
    def words(self) -> tuple[tuple[str, int, int], ...] | None:
        """The value as words, if it is whole bytes in a row: type, first byte and lowest bit of each; else None."""
        if self.run is None:
            return None
        (order, first, count), words, at = self.run, list[tuple[str, int, int]](), 0
        while at < count:
            size = 1 << min((count - at).bit_length() - 1, 3)
            words.append((f"{order}u{size}", first + at, 8 * (at if order == "<" else count - at - size)))
            at += size
        return tuple(words)

    @cached_property
    def run(self) -> tuple[str, int, int] | None:
        """The value as whole bytes in a row, if it is: "<" or ">", the first byte, and how many; else None."""
        parts = sorted(self.segments, key=lambda part: part.byte)
        first, count = parts[0].byte, len(parts)
        places = [(part.byte - first, part.target) for part in parts]
        orders = {"<": [(at, 8 * at) for at in range(count)], ">": [(at, 8 * (count - 1 - at)) for at in range(count)]}
        order = next((name for name, expected in orders.items() if places == expected), None)
        return None if order is None or any(part.mask != 0xFF or part.low for part in parts) else (order, first, count)

    def value(self, block: bytes) -> int:
        """The value in one block of bytes."""
        total = sum((block[s.byte] & s.mask) >> s.low << s.target for s in self.segments)
        return total - (1 << self.width) if self.signed and total >> (self.width - 1) else total

    def masks(self, size: int) -> bytes:
        """Which bits of each byte of a block of `size` bytes are the value's."""
        found = bytearray(size)
        for segment in self.segments:
            found[segment.byte] |= segment.mask
        return bytes(found)


def leaves(parsed: Any, keys: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """The values of a parsed object with where they stand in it, private entries left out."""
    if isinstance(parsed, dict):
        for name, value in parsed.items():
            if not name.startswith("_"):
                yield from leaves(value, (*keys, name))
    elif isinstance(parsed, list):
        for index, value in enumerate(parsed):
            yield from leaves(value, (*keys, index))
    else:
        yield keys, int(parsed) if isinstance(parsed, EnumIntegerString) else parsed


def probe(con: Construct, size: int) -> list[BitField] | None:
    """The bit fields of a block of `size` bytes, or None where it is not linear in its bits.

    The block must accept every pattern: constants in it have to be unchecked (``_verify=False`` is passed).
    """
    if not _even(con):
        return None
    base = _parse(con, bytes(size))
    if any(not isinstance(value, int) or value != 0 for value in base.values()):
        return None
    weights: dict[tuple[str | int, ...], list[tuple[int, int]]] = {keys: [] for keys in base}
    for bit in range(8 * size):
        for keys, value in _parse(con, (1 << bit).to_bytes(size, "little")).items():
            if value:
                weights[keys].append((bit, int(value)))
    fields = [_field(keys, pairs) for keys, pairs in weights.items()]
    if any(field is None for field in fields):
        return None
    known = [field for field in fields if field is not None]
    return known if _confirmed(con, size, known) else None


def _even(con: Construct) -> bool:
    """Whether every block is read in the same way: what a value decides on shows with few blocks only, and probing could miss it."""
    if isinstance(con, Struct):
        return all(map(_even, con.subcons))
    if isinstance(con, Subconstruct):
        return (isinstance(con, Enum) or not isinstance(con, Adapter)) and _even(con.subcon)
    return isinstance(con, BitsInteger | Bytes | BytesInteger | FormatField | type(Flag))


def bytes_of(con: Construct, names: Iterable[str]) -> list[int]:
    """The offsets of the bytes of a block that hold any bit of one of its fields."""
    keys = tuple(names)
    for field in probe(con, con.sizeof()) or ():
        if field.keys == keys:
            return [segment.byte for segment in field.segments]
    raise KeyError(".".join(keys))


def _parse(con: Construct, block: bytes) -> dict[tuple[str | int, ...], Any]:
    return dict(leaves(con.parse(block, _verify=False)))


def _field(keys: tuple[str | int, ...], pairs: list[tuple[int, int]]) -> BitField | None:
    """A field from (bit of the block, weight); None unless the weights are 1, 2, 4 ... each once."""
    width = len(pairs)
    signed = any(weight < 0 for _, weight in pairs)
    targets = {}
    for bit, weight in pairs:
        magnitude = abs(weight)
        if magnitude & (magnitude - 1) or (weight < 0) != (signed and magnitude == 1 << (width - 1)):
            return None
        targets[bit] = magnitude.bit_length() - 1
    if sorted(targets.values()) != list(range(width)) or not width:
        return None
    return BitField(keys, tuple(_segments(targets)), width, signed)


def _segments(targets: dict[int, int]) -> Iterator[Segment]:
    """Runs of bits that keep their order within one byte."""
    run: list[int] = []
    for bit in sorted(targets):
        if run and (bit != run[-1] + 1 or bit // 8 != run[0] // 8 or targets[bit] != targets[run[-1]] + 1):
            yield _segment(run, targets)
            run = []
        run.append(bit)
    if run:
        yield _segment(run, targets)


def _segment(run: list[int], targets: dict[int, int]) -> Segment:
    low = run[0] % 8
    return Segment(run[0] // 8, ((1 << len(run)) - 1) << low, low, targets[run[0]])


def _confirmed(con: Construct, size: int, fields: list[BitField]) -> bool:
    import random  # nothing else that finding a sensor imports needs it

    source = random.Random(size)
    for _ in range(CONFIRMATIONS):
        block = source.randbytes(size)
        parsed = _parse(con, block)
        if any(field.value(block) != int(parsed[field.keys]) for field in fields):
            return False
    return True
