"""Checksum algorithms as values: for one frame, or for every frame of a batch at once.

A batch of CRCs runs its rows side by side, two bytes a step, through one table of 65,536 registers. Long rows are cut into
segments that run side by side too and are then joined in pairs: a CRC is linear, so the earlier one is advanced over as many
zero bytes as the later one is long, and they are XORed. Tables depend on the polynomial alone, not on the length of rows.

Registers are kept in wire order, where the low byte is the one that meets the next data byte: for `refin` the usual
reflected register, otherwise the usual register aligned left with its bytes swapped. One formula serves both.
"""

import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

ByteOrder: TypeAlias = Literal["little", "big"]
Bytes: TypeAlias = bytes | bytearray | memoryview
Values: TypeAlias = NDArray[np.uint64]

_LOOP_BYTES = 2048  # below this, a Python loop over bytes is done before NumPy's calls have started
_BLOCK_BYTES = 1 << 18  # rows of a batch taken at a time; with their table they fit the second-level cache
_REGISTER_BYTES = [2] * 17 + [4] * 16 + [8] * 32  # that a register is kept in, by its width
_MIRROR = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


class Checksum(ABC):
    """A checksum algorithm: an immutable value, hashable, equal to another by its parameters.

    `width` is its size in bits; `order` is its byte order where its field is plain bytes (an integer field has its own).
    """

    width: int
    order: ByteOrder = "little"

    @abstractmethod
    def __call__(self, data: Bytes) -> int:
        """The checksum of the data, from 0 to 2**width - 1."""

    @abstractmethod
    def describe(self) -> str:
        """A short phrase for people, such as "XOR-8"."""

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        """The checksum of each row, shape (n,), for frames of one length, shape (n, m), contiguous or not."""
        return np.fromiter((self(row.tobytes()) for row in rows), np.uint64, len(rows))


@dataclass(frozen=True)
class Crc(Checksum):
    """A cyclic redundancy check, its parameters as CRC catalogues print them; a wrong one raises ValueError.

    Args:
        width: bits of the register, 1 to 64.
        poly: the polynomial without its highest term, highest power first.
        init, xorout: the register before the first byte, not reflected, and what is XORed onto it as it leaves.
        refin, refout: each byte enters, and the register leaves, with the lowest bit first.
    """

    width: int
    poly: int
    init: int = 0
    refin: bool = False
    refout: bool = False
    xorout: int = 0
    order: ByteOrder = "little"

    def __post_init__(self) -> None:
        _require(self, width=range(1, 65))
        _require(self, poly=range(1, 1 << self.width), init=range(1 << self.width), xorout=range(1 << self.width))
        _require(self, refin=(False, True), refout=(False, True), order=("little", "big"))

    def __call__(self, data: Bytes) -> int:
        data = bytes(data)
        if len(data) >= _LOOP_BYTES:
            return int(self.batch(np.frombuffer(data, np.uint8).reshape(1, -1))[0])
        table, register, size = self._loop
        if self.width <= 8:
            for byte in data:
                register = table[register ^ byte]
        else:
            for byte in data:
                register = table[(register ^ byte) & 0xFF] ^ register >> 8
        if not self.refin:
            register = int.from_bytes(register.to_bytes(size, "little"), "big") >> 8 * size - self.width
        return (register if self.refin == self.refout else _reflected(register, self.width)) ^ self.xorout

    def describe(self) -> str:
        digits, order = -(-self.width // 4), ("", " refin", " refout", " reflected")[self.refin + 2 * self.refout]
        values = (f" {name} 0x{getattr(self, name):0{digits}x}" for name in ("poly", "init", "xorout") if getattr(self, name))
        return f"CRC-{self.width}{''.join(values)}{order}"

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        if rows.size < _LOOP_BYTES:
            return super().batch(rows)
        step = max(1, _BLOCK_BYTES // rows.shape[1])
        blocks = (rows[first : first + step] for first in range(0, len(rows), step))
        registers = np.concatenate([_registers(block, self._loop[1], self.width, self.poly, self.refin) for block in blocks])
        if not self.refin:
            registers = registers.byteswap() >> 8 * registers.itemsize - self.width
        values = registers.astype(np.uint64)
        if self.refin != self.refout:
            mirrored = np.frombuffer(_MIRROR, np.uint8).take(values.byteswap().view(np.uint8))
            values = mirrored.view(np.uint64) >> np.uint64(64 - self.width)
        return values ^ np.uint64(self.xorout)

    @cached_property
    def _loop(self) -> tuple[tuple[int, ...], int, int]:
        """What a loop over bytes needs: its table, the register that it starts with, and the bytes of a register."""
        table, start = _byte_table(self.width, self.poly, self.refin), _reflected(self.init, self.width)
        return table, start if self.refin else _mirrored_bytes(start), _REGISTER_BYTES[self.width]


@dataclass(frozen=True)
class Xor(Checksum):
    """The XOR of all bytes."""

    width = 8

    def __call__(self, data: Bytes) -> int:
        return _xor(bytes(data))

    def describe(self) -> str:
        return "XOR-8"

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        return np.asarray(np.bitwise_xor.reduce(rows, axis=1), np.uint64)


@dataclass(frozen=True)
class Sum(Checksum):
    """The sum of all bytes modulo 2**width; a width outside 1 to 64 raises ValueError."""

    width: int = 8
    order: ByteOrder = "little"

    def __post_init__(self) -> None:
        _require(self, width=range(1, 65), order=("little", "big"))

    def __call__(self, data: Bytes) -> int:
        return sum(bytes(data)) & (1 << self.width) - 1

    def describe(self) -> str:
        return f"{self.width}-bit sum"

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        return np.asarray(rows.sum(axis=1, dtype=f"u{_REGISTER_BYTES[self.width]}"), np.uint64) & np.uint64((1 << self.width) - 1)


@dataclass(frozen=True)
class WordXor(Checksum):
    """The XOR of words of one or two bytes, low byte first, extended to 16 bits by zeros; wrong sizes raise ValueError.

    Args:
        head: bytes in front that are two-byte words, whatever the groups.
        groups: sizes of the words after them, 1 or 2 bytes each, repeated; a word cut short by the end counts as one byte.
    """

    head: int = 0
    groups: tuple[int, ...] = (2,)
    width = 16

    def __post_init__(self) -> None:
        _require(self, head=range(1 << 31))
        if type(self.groups) is not tuple or not self.groups or any(type(size) is not int or size not in (1, 2) for size in self.groups):
            raise ValueError(f"WordXor: groups must be a tuple of sizes, each 1 or 2, not {self.groups!r}")

    def __call__(self, data: Bytes) -> int:
        data = bytes(data)
        low, high = (_xor(b"".join([data[part] for part in half])) for half in self._halves)
        return low | high << 8

    def describe(self) -> str:
        return f"XOR-16 of {'+'.join(map(str, self.groups))}-byte words" + (f" after a head of {self.head} bytes" if self.head else "")

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        low, high = ([np.bitwise_xor.reduce(rows[:, part], axis=1) for part in half] for half in self._halves)
        return np.asarray(np.bitwise_xor.reduce(low) | np.bitwise_xor.reduce(high).astype(np.uint64) << np.uint64(8))

    @cached_property
    def _halves(self) -> tuple[list[slice], list[slice]]:
        """Where the low and the high bytes of the words stand."""
        low, high = [slice(0, self.head, 2)], [slice(1, self.head, 2)]
        for number, size in enumerate(self.groups):
            place = self.head + sum(self.groups[:number])
            low.append(slice(place, None, sum(self.groups)))
            high += [slice(place + 1, None, sum(self.groups))] * (size - 1)
        return low, high


@dataclass(frozen=True)
class Fold15(Checksum):
    """Little-endian words, each added to twice the total so far; then what is above bit 14 is added to the low 15 bits.

    The last word of an odd length is extended by a zero byte. Bits shifted past bit 29 are lost: of longer data the last 30 words count.

    Source: the trailer of many vacuum cleaners' lidars; agrees with captures of two makes.
    """

    width = 15

    def __call__(self, data: Bytes) -> int:
        odd, total = len(data) % 2, 0
        for (word,) in struct.iter_unpack("<H", bytes(data[odd - 60 :]) + bytes(odd)):
            total = (total << 1) + word
        return (total & 0x7FFF) + (total >> 15) & 0x7FFF

    def describe(self) -> str:
        return "15-bit folded sum"

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        tail, total = rows[:, rows.shape[1] % 2 - 60 :], np.zeros(len(rows), np.uint64)
        last = (tail.shape[1] - 1) // 2
        for place, byte in enumerate(tail.T):
            total += byte.astype(np.uint64) << np.uint64(last - place // 2 + 8 * (place % 2))
        return (total & np.uint64(0x7FFF)) + (total >> np.uint64(15)) & np.uint64(0x7FFF)


def _require(checksum: Checksum, **allowed: range | tuple[object, ...]) -> None:
    for name, values in allowed.items():
        value = getattr(checksum, name)
        if type(value) is not type(values[0]) or value not in values:
            raise ValueError(f"{type(checksum).__name__}: {name} must be in {values}, not {value!r}")


def _reflected(value: int, width: int) -> int:
    return int(f"{value:0{width}b}"[::-1], 2)


def _mirrored_bytes(register: int) -> int:
    """The register with the bits of each byte mirrored, which leads from one bit order to the other."""
    return int.from_bytes(register.to_bytes(8, "little").translate(_MIRROR), "little")


def _xor(data: bytes) -> int:
    """The XOR of all bytes: one large integer, folded in halves down to its low byte."""
    value = int.from_bytes(data, "little")
    for power in range((8 * len(data) - 1).bit_length() - 1, 2, -1):
        value ^= value >> (1 << power)
    return value & 0xFF


@lru_cache(maxsize=256)
def _byte_table(width: int, poly: int, refin: bool) -> tuple[int, ...]:
    """The register after one byte, by the XOR of that byte and the register's low byte."""
    table, feedback = list(range(256)), _reflected(poly, width)
    for _ in range(8):
        table = [register >> 1 ^ (feedback if register & 1 else 0) for register in table]
    return tuple(table if refin else (_mirrored_bytes(table[byte]) for byte in _MIRROR))


@lru_cache(maxsize=16)
def _word_table(width: int, poly: int, refin: bool) -> NDArray[Any]:
    """The register after two bytes, by the XOR of that little-endian word and the register's low 16 bits; shape (65536,)."""
    table = np.array(_byte_table(width, poly, refin), f"<u{_REGISTER_BYTES[width]}")
    first, second = np.tile(table, 256), np.repeat(np.arange(256, dtype=np.uint8), 256)
    return np.asarray(table[first.astype(np.uint8) ^ second] ^ first >> 8)


@lru_cache(maxsize=256)
def _jump_table(power: int, width: int, poly: int, refin: bool) -> NDArray[Any]:
    """The register after 2**power zero bytes, by place and value of each byte of the register; shape (bytes, 256)."""
    if power:
        half = _jump_table(power - 1, width, poly, refin)
        return _jumped(half.ravel(), half).reshape(half.shape)
    later_places = [[value << 8 * place for value in range(256)] for place in range(_REGISTER_BYTES[width] - 1)]
    return np.array([_byte_table(width, poly, refin), *later_places], f"<u{_REGISTER_BYTES[width]}")


def _jumped(registers: NDArray[Any], table: NDArray[Any]) -> NDArray[Any]:
    """Registers, shape (k,) and contiguous, each advanced by a jump table."""
    places = registers.view(np.uint8).reshape(len(registers), -1).T
    return np.asarray(np.bitwise_xor.reduce([of_place.take(place) for of_place, place in zip(table, places, strict=True)]))


def _registers(rows: NDArray[np.uint8], start: int, width: int, poly: int, refin: bool) -> NDArray[Any]:
    """The register after each row, shape (n,)."""
    (count, length), table = rows.shape, _word_table(width, poly, refin)
    segment = min(max(64, 1 << (rows.size // 2048).bit_length()), length + length % 2)  # enough of them to hide NumPy's cost per call
    # Zero bytes in front change nothing while the register is 0; so `start` is met in the row's first bytes.
    padded = np.zeros((count, -(-length // segment) * segment), np.uint8)
    padded[:, -length:] = rows
    padded[:, -length:][:, :8] ^= np.frombuffer(start.to_bytes(8, "little"), np.uint8)[:length]
    lanes = np.zeros(padded.size // segment, table.dtype)
    low = lanes.view("<u2")[:: table.itemsize // 2]
    for words in np.ascontiguousarray(padded.reshape(-1, segment).view("<u2").T):
        after = table.take(low ^ words)
        lanes[:] = after if width <= 16 else after ^ lanes >> 16
    registers = lanes.reshape(count, -1)
    while registers.shape[1] > 1:
        odd = registers.shape[1] % 2
        jumped = _jumped(registers[:, odd::2].ravel(), _jump_table(segment.bit_length() - 1, width, poly, refin))
        registers = np.hstack([registers[:, :odd], jumped.reshape(count, -1) ^ registers[:, odd + 1 :: 2]])
        segment *= 2
    return np.asarray(registers[:, 0] ^ (start >> 8 * length))
