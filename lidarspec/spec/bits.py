"""Find the bits of each value of a bit block by probing its parser.

A block is any nesting of ``BitStruct``, ``ByteSwapped``, ``BitsSwapped`` and ``BytesInteger``. Its
values are linear functions of its bits: value = sum of bit * weight. To find the weights, the block
is parsed once with no bit set, and once for each bit with only this bit set. The weights are then
confirmed with random blocks. This module therefore needs no rules about the order of bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

#: The number of random blocks that have to confirm a probed layout.
CONFIRMATIONS = 8


@dataclass(frozen=True)
class Segment:
    """Adjacent bits of one byte that are part of a value.

    The segment adds ``((byte & mask) >> low) << target`` to the value.
    """

    byte: int
    mask: int
    low: int
    target: int


@dataclass(frozen=True)
class BitField:
    """One value of a bit block.

    Attributes:
        keys: the field names and array indices that lead to the value in the parsed block.
        segments: the bits of the value.
        width: the number of bits.
        signed: whether the top bit is a sign bit.
        flag: whether the value is parsed as False or True.
    """

    keys: tuple[str | int, ...]
    segments: tuple[Segment, ...]
    width: int
    signed: bool
    flag: bool = False

    @cached_property
    def run(self) -> tuple[str, int, int, int] | None:
        """The position of the value, if its bits are consecutive in an integer; else None.

        The items are the byte order of the integer ("<" or ">"), its first byte, its number of
        bytes, and the lowest bit of the value in the integer.
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
        """Whether the value consists of whole consecutive bytes."""
        return self.run is not None and (self.run[2] * 8, self.run[3]) == (self.width, 0)

    def value(self, block: bytes | memoryview) -> int:
        """Return the value in one block of bytes."""
        total = sum((block[s.byte] & s.mask) >> s.low << s.target for s in self.segments)
        if self.signed and total >> (self.width - 1):
            return total - (1 << self.width)
        return total

    def masks(self, size: int) -> bytes:
        """Return a mask of the bits of this value, for a block of `size` bytes."""
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


#: A function that parses a block of bytes, and returns its values by their keys.
Parse = Callable[[bytes], Mapping[tuple[str | int, ...], Any]]


def probe(parse: Parse, size: int) -> list[BitField] | None:
    """Return the bit fields of a block; None if its values are not linear in its bits.

    Args:
        parse: a function that returns the values of a block; it must accept any bytes.
        size: the size of the block in bytes.
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
        _make_field(keys, pairs, flag=isinstance(base[keys], bool))
        for keys, pairs in weights.items()
    ]
    complete = [field for field in fields if field is not None]
    if len(complete) == len(fields) and _is_confirmed(parse, size, complete):
        return complete
    return None


def _make_field(
    keys: tuple[str | int, ...], pairs: list[tuple[int, int]], *, flag: bool
) -> BitField | None:
    """Return the field with the given bits.

    Returns None unless each of the weights 1, 2, 4 ... occurs exactly once.

    Args:
        keys: the keys of the field.
        pairs: (bit of the block, weight) for each bit of the value.
        flag: whether the field is parsed as False or True.
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
    return BitField(keys, tuple(_iter_segments(targets)), width, signed, flag)


def _iter_segments(targets: dict[int, int]) -> Iterator[Segment]:
    """Yield the segments of a value: runs of bits in one byte.

    The bits of a segment are consecutive in the block and in the value.

    Args:
        targets: for each bit of the block that belongs to the value, its position in the value.
    """
    runs: dict[tuple[int, int, int], list[int]] = {}
    for number, bit in enumerate(sorted(targets)):
        runs.setdefault((bit // 8, bit - number, targets[bit] - bit), []).append(bit)
    for bits in runs.values():
        low = bits[0] % 8
        yield Segment(bits[0] // 8, ((1 << len(bits)) - 1) << low, low, targets[bits[0]])


def _is_confirmed(parse: Parse, size: int, fields: list[BitField]) -> bool:
    import random  # imported here because finding a sensor does not need it otherwise

    source = random.Random(size)
    for _ in range(CONFIRMATIONS):
        block = source.randbytes(size)
        parsed = parse(block)
        if any(field.value(block) != int(parsed[field.keys]) for field in fields):
            return False
    return True
