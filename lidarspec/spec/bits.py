"""Find the bits of each value of a bit block by probing its parser.

A block is any nesting of ``BitStruct``, ``ByteSwapped``, ``BitsSwapped`` and ``BytesInteger``. The
block is parsed with different bits set, and the parsed values show the position of each bit. This
module therefore needs no rules about the order of bits.
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

        The position is a tuple (byte order, first byte, number of bytes, lowest bit). The first
        three items describe the integer: "<" or ">", the index of its first byte in the block, and
        its size. The last item is the lowest bit of the integer that belongs to the value.
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
    """Return the bit fields of a block; None if its values are not bit fields.

    Args:
        parse: a function that returns the values of a block; it must accept any bytes.
        size: the size of the block in bytes.
    """
    base = parse(bytes(size))
    if any(not isinstance(value, int) or value != 0 for value in base.values()):
        return None
    full = parse(b"\xff" * size)
    # The bits at one position of these values together are the index of a bit of the block.
    index_bits = (8 * size - 1).bit_length()
    patterns = [parse(_make_pattern(index_bit, size)) for index_bit in range(index_bits)]
    fields = list[BitField]()
    for keys, zero in base.items():
        field = _make_field(
            keys,
            int(full[keys]),
            [int(pattern[keys]) for pattern in patterns],
            flag=isinstance(zero, bool),
        )
        if field is None:
            return None
        fields.append(field)
    if _is_confirmed(parse, size, fields):
        return fields
    return None


@lru_cache(maxsize=64)
def _make_pattern(index_bit: int, size: int) -> bytes:
    """Return a block in which each bit is digit `index_bit` of its own index."""
    pattern = sum(1 << index for index in range(8 * size) if index >> index_bit & 1)
    return pattern.to_bytes(size, "little")


def _make_field(
    keys: tuple[str | int, ...], full: int, values: list[int], *, flag: bool
) -> BitField | None:
    """Return the field that has these values in the probed blocks, or None.

    Args:
        full: the value of the field if all bits of the block are set.
        values: the values of the field in the blocks of `_make_pattern`.
    """

    def find_index(position: int) -> int:
        """Return which bit of the block is bit number `position` of the value."""
        return sum((value >> position & 1) << bit for bit, value in enumerate(values))

    signed = full == -1
    indices = [find_index(0)]
    if signed:
        # Above the top bit, Python repeats the sign bit.
        while (index := find_index(len(indices))) != indices[-1]:
            indices.append(index)
    else:
        indices += [find_index(position) for position in range(1, full.bit_length())]
    width = len(indices)
    if len(set(indices)) < width or full != (-1 if signed else (1 << width) - 1):
        return None
    targets = {index: position for position, index in enumerate(indices)}
    return BitField(keys, tuple(_iter_segments(targets)), width, signed, flag)


def _iter_segments(targets: dict[int, int]) -> Iterator[Segment]:
    """Yield the segments of a value.

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
