"""Checksum algorithms as values: of one message, or of every frame of a batch at once; and the CRCs in common use by their names.

An algorithm is immutable, hashable and equal to another by its parameters. `Checksum.batch` gives what calls one by one would give; the
arithmetic on rows of bytes side by side is that of `lidarspec.spec.row_checksums`. `CRCS` has the names that catalogues give.
"""

from __future__ import annotations

import binascii
import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lidarspec.spec import row_checksums

ByteOrder: TypeAlias = Literal["little", "big"]
Bytes: TypeAlias = bytes | bytearray | memoryview
Values: TypeAlias = NDArray[np.uint64]

_LOOP_BYTES = 2048  # below this, a Python loop over bytes is done before NumPy's calls have started
_NARROW_LOOP_BYTES = 256  # the same where the register is a byte
_FEW = 4  # rows that are done one by one sooner than together
_BLOCK_BYTES = 1 << 20  # rows of a batch taken at a time: few enough for the caches, and many enough to hide NumPy's cost per call


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

    def over(self, rows: NDArray[np.uint8], spans: row_checksums.Spans) -> Values:
        """The checksum of some bytes of each row, shape (n,): from one place to another, one span after another."""
        return self.batch(row_checksums.cut(rows, spans))


class _Worded(Checksum):
    """An algorithm that works on words of many rows side by side, wherever in the rows the bytes stand."""

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        return self.over(rows, ((0, rows.shape[1]),))

    def over(self, rows: NDArray[np.uint8], spans: row_checksums.Spans) -> Values:
        if self._are_few(rows, spans):
            return super().batch(row_checksums.cut(rows, spans))
        return _in_blocks(lambda block: self._values(block, spans), rows)

    def _are_few(self, rows: NDArray[np.uint8], spans: row_checksums.Spans) -> bool:
        """Whether the rows are done one by one sooner than together."""
        return len(rows) < _FEW

    @abstractmethod
    def _values(self, rows: NDArray[np.uint8], spans: row_checksums.Spans) -> Values:
        """The checksums of a block of rows."""


@dataclass(frozen=True)
class Crc(_Worded):
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
        return (register if self.refin == self.refout else row_checksums.reflected(register, self.width)) ^ self.xorout

    def describe(self) -> str:
        digits, order = -(-self.width // 4), ("", " refin", " refout", " reflected")[self.refin + 2 * self.refout]
        values = (f" {name} 0x{getattr(self, name):0{digits}x}" for name in ("poly", "init", "xorout") if getattr(self, name))
        return f"CRC-{self.width}{''.join(values)}{order}"

    def _are_few(self, rows: NDArray[np.uint8], spans: row_checksums.Spans) -> bool:
        length = sum(stop - start for start, stop in spans)
        return len(rows) * length < (_NARROW_LOOP_BYTES if self.width <= 8 else _LOOP_BYTES)

    def _values(self, rows: NDArray[np.uint8], spans: row_checksums.Spans) -> Values:
        registers = row_checksums.registers(rows, spans, self._loop[1], self.width, self.poly, self.refin)
        if not self.refin:
            registers = registers.byteswap() >> 8 * registers.itemsize - self.width
        values = registers.astype(np.uint64)
        if self.refin != self.refout:
            mirrored = np.frombuffer(row_checksums.MIRROR, np.uint8).take(values.byteswap().view(np.uint8))
            values = mirrored.view(np.uint64) >> np.uint64(64 - self.width)
        return values ^ np.uint64(self.xorout) if self.xorout else values

    @cached_property
    def _loop(self) -> tuple[tuple[int, ...], int, int]:
        """What a loop over bytes needs: its table, the register that it starts with, and the bytes of a register."""
        table, start = row_checksums.byte_table(self.width, self.poly, self.refin), row_checksums.reflected(self.init, self.width)
        return table, start if self.refin else row_checksums.mirrored_bytes(start), row_checksums.REGISTER_BYTES[self.width]


@dataclass(frozen=True)
class Xor(_Worded):
    """The XOR of all bytes."""

    width = 8

    def __call__(self, data: Bytes) -> int:
        return _xor(bytes(data))

    def describe(self) -> str:
        return "XOR-8"

    def _values(self, rows: NDArray[np.uint8], spans: row_checksums.Spans) -> Values:
        columns = row_checksums.words(rows, spans=spans)
        return row_checksums.folded_xor(row_checksums.xor(columns, range(len(columns))))


@dataclass(frozen=True)
class Sum(_Worded):
    """The sum of all bytes modulo 2**width; a width outside 1 to 64 raises ValueError."""

    width: int = 8
    order: ByteOrder = "little"

    def __post_init__(self) -> None:
        _require(self, width=range(1, 65), order=("little", "big"))

    def __call__(self, data: Bytes) -> int:
        return sum(bytes(data)) & (1 << self.width) - 1

    def describe(self) -> str:
        return f"{self.width}-bit sum"

    def _values(self, rows: NDArray[np.uint8], spans: row_checksums.Spans) -> Values:
        return row_checksums.byte_sums(row_checksums.words(rows, spans=spans)) & np.uint64((1 << self.width) - 1)


@dataclass(frozen=True)
class WordXor(_Worded):
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
        low, high = (_xor(b"".join([data[part] for part in half])) for half in self.halves)
        return low | high << 8

    def describe(self) -> str:
        return f"XOR-16 of {'+'.join(map(str, self.groups))}-byte words" + (f" after a head of {self.head} bytes" if self.head else "")

    def _values(self, rows: NDArray[np.uint8], spans: row_checksums.Spans) -> Values:
        columns = row_checksums.words(rows, spans=spans)
        low, high, part = np.zeros((3, len(rows)), np.uint64)
        for which, masks in _word_masks(self, len(columns)):
            alike = row_checksums.xor(columns, which)
            np.bitwise_xor(low, np.bitwise_and(alike, masks[0], out=part), out=low)
            np.bitwise_xor(high, np.bitwise_and(alike, masks[1], out=part), out=high)
        return row_checksums.folded_xor(low) | row_checksums.folded_xor(high) << np.uint64(8)

    @cached_property
    def halves(self) -> tuple[list[slice], list[slice]]:
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


@dataclass(frozen=True)
class ZeroPadded(Checksum):
    """Another algorithm over the data and as many zero bytes as make its length a multiple of `to`, as hardware that takes words has it."""

    algorithm: Checksum
    to: int

    def __post_init__(self) -> None:
        _require(self, to=range(1, 1 << 31))

    @property
    def width(self) -> int:  # type: ignore[override]
        """The width of the algorithm that is padded for, in bits."""
        return self.algorithm.width

    @property
    def order(self) -> ByteOrder:  # type: ignore[override]
        """The byte order of the algorithm that is padded for."""
        return self.algorithm.order

    def __call__(self, data: Bytes) -> int:
        return self.algorithm(bytes(data) + bytes(-len(data) % self.to))

    def describe(self) -> str:
        return f"{self.algorithm.describe()} of the bytes padded with zeros to a multiple of {self.to}"

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        return self.algorithm.batch(np.pad(rows, ((0, 0), (0, -rows.shape[1] % self.to))))


@lru_cache(maxsize=512)
def _word_masks(algorithm: WordXor, number: int) -> list[tuple[list[int], tuple[np.uint64, np.uint64]]]:
    """Where the low and the high bytes stand in so many words of `row_checksums.words`, as masks; with the words that have the same."""
    masks = np.zeros((2, 8 * number), np.uint8)
    for mask, half in zip(masks, algorithm.halves, strict=True):
        for part in half:
            mask[part] = 0xFF
    found: dict[tuple[np.uint64, np.uint64], list[int]] = {}
    for word, (low, high) in enumerate(masks.view("<u8").T):
        found.setdefault((low, high), []).append(word)
    return [(which, both) for both, which in found.items()]


def _in_blocks(values: Callable[[NDArray[np.uint8]], NDArray[Any]], rows: NDArray[np.uint8]) -> NDArray[Any]:
    """What a function makes of each row, asked for as many rows at a time as stay in the cache."""
    step = max(1, _BLOCK_BYTES // max(rows.shape[1], 1))
    if len(rows) <= step:
        return values(rows)
    return np.concatenate([values(rows[first : first + step]) for first in range(0, len(rows), step)])


def _require(checksum: Checksum, **allowed: range | tuple[object, ...]) -> None:
    for name, values in allowed.items():
        value = getattr(checksum, name)
        if type(value) is not type(values[0]) or value not in values:
            raise ValueError(f"{type(checksum).__name__}: {name} must be in {values}, not {value!r}")


def _xor(data: bytes) -> int:
    """The XOR of all bytes: one large integer, folded in halves down to its low byte."""
    value = int.from_bytes(data, "little")
    for power in range((8 * len(data) - 1).bit_length() - 1, 2, -1):
        value ^= value >> (1 << power)
    return value & 0xFF


def _crc(width: int, poly: int, init: int = 0, *, reflected: bool = False, xorout: int = 0) -> Crc:
    return Crc(width, poly, init, reflected, reflected, xorout)


_ONES = 0xFFFF_FFFF

#: name -> its parameters, the most used first.
CRCS: dict[str, Crc] = {
    "CRC-32": _crc(32, 0x04C11DB7, _ONES, reflected=True, xorout=_ONES),
    "CRC-16/MODBUS": _crc(16, 0x8005, 0xFFFF, reflected=True),
    "CRC-16/CCITT-FALSE": _crc(16, 0x1021, 0xFFFF),
    "CRC-16/XMODEM": _crc(16, 0x1021),
    "CRC-8": _crc(8, 0x07),
    "CRC-8/MAXIM": _crc(8, 0x31, reflected=True),
    "CRC-8/LTE": _crc(8, 0x9B),
    "CRC-8/CDMA2000": _crc(8, 0x9B, 0xFF),
    "CRC-8/DARC": _crc(8, 0x39, reflected=True),
    "CRC-8/DVB-S2": _crc(8, 0xD5),
    "CRC-8/AUTOSAR": _crc(8, 0x2F, 0xFF, xorout=0xFF),
    "CRC-8/SAE-J1850": _crc(8, 0x1D, 0xFF, xorout=0xFF),
    "CRC-8/EBU": _crc(8, 0x1D, 0xFF, reflected=True),
    "CRC-8/I-CODE": _crc(8, 0x1D, 0xFD),
    "CRC-8/ITU": _crc(8, 0x07, xorout=0x55),
    "CRC-8/ROHC": _crc(8, 0x07, 0xFF, reflected=True),
    "CRC-8/WCDMA": _crc(8, 0x9B, reflected=True),
    "CRC-8/BLUETOOTH": _crc(8, 0xA7, reflected=True),
    "CRC-8/NRSC-5": _crc(8, 0x31, 0xFF),
    "CRC-16/ARC": _crc(16, 0x8005, reflected=True),
    "CRC-16/BUYPASS": _crc(16, 0x8005),
    "CRC-16/USB": _crc(16, 0x8005, 0xFFFF, reflected=True, xorout=0xFFFF),
    "CRC-16/MAXIM": _crc(16, 0x8005, reflected=True, xorout=0xFFFF),
    "CRC-16/KERMIT": _crc(16, 0x1021, reflected=True),
    "CRC-16/X-25": _crc(16, 0x1021, 0xFFFF, reflected=True, xorout=0xFFFF),
    "CRC-16/MCRF4XX": _crc(16, 0x1021, 0xFFFF, reflected=True),
    "CRC-16/GENIBUS": _crc(16, 0x1021, 0xFFFF, xorout=0xFFFF),
    "CRC-16/AUG-CCITT": _crc(16, 0x1021, 0x1D0F),
    "CRC-16/DNP": _crc(16, 0x3D65, reflected=True, xorout=0xFFFF),
    "CRC-16/EN-13757": _crc(16, 0x3D65, xorout=0xFFFF),
    "CRC-16/T10-DIF": _crc(16, 0x8BB7),
    "CRC-16/DECT-X": _crc(16, 0x0589),
    "CRC-16/TELEDISK": _crc(16, 0xA097),
    "CRC-16/CDMA2000": _crc(16, 0xC867, 0xFFFF),
    "CRC-32/MPEG-2": _crc(32, 0x04C11DB7, _ONES),
    "CRC-32/BZIP2": _crc(32, 0x04C11DB7, _ONES, xorout=_ONES),
    "CRC-32/POSIX": _crc(32, 0x04C11DB7, xorout=_ONES),
    "CRC-32/JAMCRC": _crc(32, 0x04C11DB7, _ONES, reflected=True),
    "CRC-32C": _crc(32, 0x1EDC6F41, _ONES, reflected=True, xorout=_ONES),
    "CRC-32D": _crc(32, 0xA833982B, _ONES, reflected=True, xorout=_ONES),
    "CRC-32/AUTOSAR": _crc(32, 0xF4ACFB13, _ONES, reflected=True, xorout=_ONES),
    "CRC-32Q": _crc(32, 0x814141AB),
    "CRC-32/XFER": _crc(32, 0x000000AF),
}
_NAMES = {crc: name for name, crc in CRCS.items()}
#: polynomials by width.
KNOWN = {width: {crc.poly for crc in CRCS.values() if crc.width == width} for width in (8, 16, 32)}


def name_of(crc: Crc) -> str:
    """The catalogue's name of a CRC, "" where it has none."""
    return _NAMES.get(crc, "")


Single = Callable[[bytes], int]


def single(algorithm: Checksum) -> Single:
    """A function from bytes to their checksum, made for one frame at a time; of other algorithms the algorithm itself."""
    if type(algorithm) is Crc:
        return _single_crc(algorithm)
    if type(algorithm) is Xor:
        return _single_xor
    if type(algorithm) is Sum:
        mask = (1 << algorithm.width) - 1
        return lambda data: sum(data) & mask
    if type(algorithm) is WordXor:
        return _single_word_xor(algorithm)
    return algorithm


@lru_cache(maxsize=256)
def _single_crc(algorithm: Crc) -> Single:
    init, xorout = algorithm.init, algorithm.xorout
    if (algorithm.width, algorithm.poly, algorithm.refin, algorithm.refout) == (16, 0x1021, False, False):
        return lambda data: binascii.crc_hqx(data, init) ^ xorout
    if (algorithm.width, algorithm.poly, algorithm.refin, algorithm.refout) == (32, 0x04C11DB7, True, True):
        start, end = int(f"{init:032b}"[::-1], 2) ^ 0xFFFFFFFF, xorout ^ 0xFFFFFFFF
        return lambda data: zlib.crc32(data, start) ^ end
    if algorithm.width != 8:
        return algorithm
    # One byte more changes the register by a table, whichever bit comes first; `refout` and `xorout` apply at the end.
    plain = Crc(8, algorithm.poly, refin=algorithm.refin, refout=algorithm.refin)
    table = tuple(plain(bytes([byte])) for byte in range(256))
    first = int(f"{init:08b}"[::-1], 2) if algorithm.refin else init
    mirrored = algorithm.refin != algorithm.refout
    leaving = bytes((int(f"{value:08b}"[::-1], 2) if mirrored else value) ^ xorout for value in range(256))

    def crc8(data: bytes, table: tuple[int, ...] = table) -> int:
        register = first
        for byte in data:
            register = table[register ^ byte]
        return leaving[register]

    return crc8


def _single_xor(data: bytes) -> int:
    value = int.from_bytes(data, "little")
    for power in _powers(8, len(data)):
        value ^= value >> power
    return value & 0xFF


def _single_word_xor(algorithm: WordXor) -> Single:
    """Groups of words are XORed as a whole, whatever their sizes, and only their XOR is taken apart."""
    head, groups = algorithm.head, algorithm.groups
    size = sum(groups)
    starts = [8 * sum(groups[:number]) for number in range(len(groups))]
    head_powers = _powers(16, head + 1 >> 1)
    words = [(start, (1 << 8 * width) - 1) for start, width in zip(starts, groups, strict=True)]

    def word_xor(data: bytes) -> int:
        found = int.from_bytes(data[:head], "little")
        for power in head_powers:
            found ^= found >> power
        found &= 0xFFFF
        value = int.from_bytes(data[head:], "little")
        for power in _powers(8 * size, -((head - len(data)) // size)):
            value ^= value >> power
        for start, mask in words:
            found ^= value >> start & mask
        return found

    return word_xor


@lru_cache(maxsize=4096)
def _powers(bits: int, count: int) -> tuple[int, ...]:
    """By how much an integer is shifted and XORed onto itself until its lowest part is the XOR of so many parts."""
    return tuple(bits << power for power in reversed(range(max(count - 1, 0).bit_length())))
