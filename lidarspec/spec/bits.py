"""Find the bits of each value of a bit block by probing its parser.

A block (``BitStruct``, ``ByteSwapped``, ``BitsSwapped``, ``BytesInteger``, in any nesting) is
linear in its bits: value = sum of bit * weight. Parsing it once with no bit set and once with each
single bit set gives the weights; random blocks then confirm them. This way only the probed parser
contains rules about the order of bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

#: number of random blocks that have to agree with a probed layout.
CONFIRMATIONS = 8


@dataclass(frozen=True)
class Segment:
    """A run of bits of one byte that is part of a value.

    It adds ``((byte & mask) >> low) << target`` to the value.
    """

    byte: int
    mask: int
    low: int
    target: int


@dataclass(frozen=True)
class BitField:
    """One value of a bit block.

    Attributes:
        keys: field names and array indices that lead to it in the parsed block.
        segments: its bits.
        width: number of bits.
        signed: whether the top bit is a sign bit.
        flag: whether it is parsed as False or True.
    """

    keys: tuple[str | int, ...]
    segments: tuple[Segment, ...]
    width: int
    signed: bool
    flag: bool = False

    @cached_property
    def run(self) -> tuple[str, int, int, int] | None:
        """The value as consecutive bits of whole bytes, None if it is not.

        It is a tuple of the byte order ("<" or ">"), the first byte, the number of bytes, and the
        lowest bit.
        """
        parts = sorted(self.segments, key=lambda part: part.byte)
        first = parts[0].byte
        count = parts[-1].byte - parts[0].byte + 1
        for order, places in (("<", range(count)), (">", range(count - 1, -1, -1))):
            lowest = {8 * places[part.byte - first] + part.low - part.target for part in parts}
            if len(lowest) == 1:
                return order, first, count, lowest.pop()
        return None

    @cached_property
    def is_whole(self) -> bool:
        """Whether it consists of whole consecutive bytes."""
        return self.run is not None and (self.run[2] * 8, self.run[3]) == (self.width, 0)

    def value(self, block: bytes | memoryview) -> int:
        """Return the value in one block of bytes."""
        total = sum((block[s.byte] & s.mask) >> s.low << s.target for s in self.segments)
        if self.signed and total >> (self.width - 1):
            return total - (1 << self.width)
        return total

    def masks(self, size: int) -> bytes:
        """Return a mask for each byte of a block of `size` bytes: the bits of this value."""
        result = bytearray(size)
        for segment in self.segments:
            result[segment.byte] |= segment.mask
        return bytes(result)


@lru_cache(maxsize=64)
def whole_bytes(size: int, order: Literal["little", "big"], *, signed: bool) -> BitField:
    """Return an integer of `size` whole bytes as a bit field."""
    targets = [8 * (byte if order == "little" else size - 1 - byte) for byte in range(size)]
    return BitField(
        (),
        tuple(Segment(byte, 0xFF, 0, target) for byte, target in enumerate(targets)),
        8 * size,
        signed,
    )


#: parses a block of bytes; returns its values by the keys that lead to them.
Parse = Callable[[bytes], Mapping[tuple[str | int, ...], Any]]


def probe(parse: Parse, size: int) -> list[BitField] | None:
    """Return the bit fields of a block, or None if it is not linear in its bits.

    Args:
        parse: returns the values of a block; it must accept every pattern.
        size: of the block in bytes.
    """
    base = parse(bytes(size))
    if any(not isinstance(value, int) or value != 0 for value in base.values()):
        return None
    weights: dict[tuple[str | int, ...], list[tuple[int, int]]] = {keys: [] for keys in base}
    for bit in range(8 * size):
        for keys, value in parse((1 << bit).to_bytes(size, "little")).items():
            if value:
                weights[keys].append((bit, int(value)))
    fields = [
        _field(keys, pairs, flag=isinstance(base[keys], bool)) for keys, pairs in weights.items()
    ]
    complete = [field for field in fields if field is not None]
    if len(complete) == len(fields) and _confirm(parse, size, complete):
        return complete
    return None


def _field(
    keys: tuple[str | int, ...], pairs: list[tuple[int, int]], *, flag: bool
) -> BitField | None:
    """Return a field from pairs of (bit of the block, weight).

    Returns None unless each of the weights 1, 2, 4 ... occurs exactly once.
    """
    width = len(pairs)
    signed = any(weight < 0 for _, weight in pairs)
    targets = {}
    for bit, weight in pairs:
        magnitude = abs(weight)
        if magnitude & (magnitude - 1) or (weight < 0) != (
            signed and magnitude == 1 << (width - 1)
        ):
            return None
        targets[bit] = magnitude.bit_length() - 1
    if sorted(targets.values()) != list(range(width)) or not width:
        return None
    return BitField(keys, tuple(_segments(targets)), width, signed, flag)


def _segments(targets: dict[int, int]) -> Iterator[Segment]:
    """Yield runs of bits that keep their order within one byte."""
    runs: dict[tuple[int, int, int], list[int]] = {}
    for number, bit in enumerate(sorted(targets)):
        runs.setdefault((bit // 8, bit - number, targets[bit] - bit), []).append(bit)
    for bits in runs.values():
        low = bits[0] % 8
        yield Segment(bits[0] // 8, ((1 << len(bits)) - 1) << low, low, targets[bits[0]])


def _confirm(parse: Parse, size: int, fields: list[BitField]) -> bool:
    import random  # imported here because finding a sensor does not need it otherwise

    source = random.Random(size)
    for _ in range(CONFIRMATIONS):
        block = source.randbytes(size)
        parsed = parse(block)
        if any(field.value(block) != int(parsed[field.keys]) for field in fields):
            return False
    return True
