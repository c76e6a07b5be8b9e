"""Checksum algorithms as values, and a table of common CRCs.

An algorithm is immutable and hashable, and equal to another algorithm with the same parameters. An
algorithm is called with the bytes of one message, and returns the checksum. `make_single` returns a
function that computes the same checksum faster. `CRCS` contains common CRCs under the names that
CRC catalogues use.
"""

from __future__ import annotations

import binascii
import functools
import struct
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

ByteOrder: TypeAlias = Literal["little", "big"]
Bytes: TypeAlias = bytes | bytearray | memoryview
Values: TypeAlias = NDArray[np.uint64]

Single: TypeAlias = Callable[[bytes], int]

REGISTER_BYTES = [2] * 17 + [4] * 16 + [8] * 32  # size of the register, by its width in bits
MIRROR = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


class Checksum(ABC):
    """A checksum algorithm: an immutable, hashable value.

    Attributes:
        width: the size of the checksum in bits.
        order: the byte order of a checksum in a field of bytes; an integer field has its own order.
    """

    width: int
    order: ByteOrder = "little"

    @abstractmethod
    def __call__(self, data: Bytes) -> int:
        """Return the checksum of the data, from 0 to 2**width - 1."""

    @abstractmethod
    def describe(self) -> str:
        """Return a short name to display, for example "XOR-8"."""

    def batch(self, rows: NDArray[np.uint8]) -> Values:
        """Return the checksum of each row, (n,) uint64.

        Args:
            rows: frames of one length, (n, size).
        """
        return np.fromiter((self(row.tobytes()) for row in rows), np.uint64, len(rows))


@dataclass(frozen=True)
class Crc(Checksum):
    """A cyclic redundancy check, with the parameters of CRC catalogues.

    Args:
        width: the number of bits of the register, 1 to 64.
        poly: the polynomial without its highest term; the highest bit is the highest power.
        init: the register before the first byte, not reflected.
        refin: whether each byte is processed from its lowest bit to its highest bit.
        refout: whether the bits of the result are in reverse order.
        xorout: the number that is XORed with the result.

    Raises:
        ValueError: for an invalid parameter.
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
        _require(
            self,
            poly=range(1, 1 << self.width),
            init=range(1 << self.width),
            xorout=range(1 << self.width),
        )
        _require(self, refin=(False, True), refout=(False, True), order=("little", "big"))

    def __call__(self, data: Bytes) -> int:
        return _make_single_crc(self)(bytes(data))

    def describe(self) -> str:
        digits = -(-self.width // 4)
        order = ("", " refin", " refout", " reflected")[self.refin + 2 * self.refout]
        values = (
            f" {name} 0x{getattr(self, name):0{digits}x}"
            for name in ("poly", "init", "xorout")
            if getattr(self, name)
        )
        return f"CRC-{self.width}{''.join(values)}{order}"

    @cached_property
    def start(self) -> int:
        """The register before the first byte, in wire order."""
        # In wire order, the low byte of the register is combined with the next byte of data. With
        # `refin`, this is the usual reflected register. Without `refin`, it is the usual register,
        # aligned left, with its bytes in reverse order.
        start = reflect(self.init, self.width)
        if self.refin:
            return start
        return mirrored_bytes(start)

    def finish(self, register: int) -> int:
        """Return the checksum, given the register in wire order after the last byte."""
        if not self.refin:
            size = REGISTER_BYTES[self.width]
            register = (
                int.from_bytes(register.to_bytes(size, "little"), "big") >> 8 * size - self.width
            )
        return (
            register if self.refin == self.refout else reflect(register, self.width)
        ) ^ self.xorout


@dataclass(frozen=True)
class Xor(Checksum):
    """The XOR of all bytes."""

    width = 8

    def __call__(self, data: Bytes) -> int:
        return _xor(data)

    def describe(self) -> str:
        return "XOR-8"


@dataclass(frozen=True)
class Sum(Checksum):
    """The sum of all bytes modulo 2**width.

    Raises:
        ValueError: for a width outside 1 to 64.
    """

    width: int = 8
    order: ByteOrder = "little"

    def __post_init__(self) -> None:
        _require(self, width=range(1, 65), order=("little", "big"))

    def __call__(self, data: Bytes) -> int:
        return sum(bytes(data)) & (1 << self.width) - 1

    def describe(self) -> str:
        return f"{self.width}-bit sum"


@dataclass(frozen=True)
class WordXor(Checksum):
    """The 16-bit XOR of words of one or two bytes.

    A word of two bytes is little-endian.

    Args:
        head: the number of bytes at the start of the data that are read as words of two bytes.
        groups: the sizes (1 or 2 bytes) of the words after the head. The sequence of sizes is
            repeated up to the end of the data. If only one byte is left at the end, this byte is a
            word.

    Raises:
        ValueError: for invalid sizes.
    """

    head: int = 0
    groups: tuple[int, ...] = (2,)
    width = 16

    def __post_init__(self) -> None:
        _require(self, head=range(1 << 31))
        if (
            type(self.groups) is not tuple
            or not self.groups
            or any(type(size) is not int or size not in (1, 2) for size in self.groups)
        ):
            raise ValueError(
                f"WordXor: groups must be a tuple of sizes, each 1 or 2, not {self.groups!r}"
            )

    def __call__(self, data: Bytes) -> int:
        return _make_single_word_xor(self)(bytes(data))

    def describe(self) -> str:
        return f"XOR-16 of {'+'.join(map(str, self.groups))}-byte words" + (
            f" after a head of {self.head} bytes" if self.head else ""
        )

    @cached_property
    def halves(self) -> tuple[list[slice], list[slice]]:
        """The slices of the data with the low and with the high bytes of the words."""
        low = [slice(0, self.head, 2)]
        high = [slice(1, self.head, 2)]
        for number, size in enumerate(self.groups):
            start = self.head + sum(self.groups[:number])
            low.append(slice(start, None, sum(self.groups)))
            high += [slice(start + 1, None, sum(self.groups))] * (size - 1)
        return low, high


@dataclass(frozen=True)
class Fold15(Checksum):
    """A 15-bit sum, which is doubled before each word is added.

    The words are little-endian. If the length is odd, a zero byte is appended. At the end, the bits
    above bit 14 are added to the low 15 bits.

    Source: lidars of many vacuum cleaners; confirmed by captures of two makes.
    """

    width = 15

    def __call__(self, data: Bytes) -> int:
        odd = len(data) % 2
        total = 0
        # Bits above bit 29 are lost, so only the last 30 words count.
        for (word,) in struct.iter_unpack("<H", bytes(data[odd - 60 :]) + bytes(odd)):
            total = (total << 1) + word
        return (total & 0x7FFF) + (total >> 15) & 0x7FFF

    def describe(self) -> str:
        return "15-bit folded sum"


@dataclass(frozen=True)
class Fletcher(Checksum):
    """Two 8-bit sums, modulo 256.

    The first sum, in the low byte of the checksum, is the sum of all bytes. The second sum, in the
    high byte, is the sum of the values that the first sum has after each byte.

    Source: RFC 1145; the checksum of UBX messages.
    """

    order: ByteOrder = "little"
    width = 16

    def __post_init__(self) -> None:
        _require(self, order=("little", "big"))

    def __call__(self, data: Bytes) -> int:
        values = bytes(data)
        first = sum(values) & 0xFF
        second = sum(accumulate(values)) & 0xFF
        return first | second << 8

    def describe(self) -> str:
        return "Fletcher-16"


@dataclass(frozen=True)
class ZeroPadded(Checksum):
    """Applies another algorithm to data that is padded with zeros to whole words.

    Args:
        to: the size of a word in bytes.
    """

    algorithm: Checksum
    to: int

    def __post_init__(self) -> None:
        _require(self, to=range(1, 1 << 31))
        object.__setattr__(self, "width", self.algorithm.width)
        object.__setattr__(self, "order", self.algorithm.order)

    def __call__(self, data: Bytes) -> int:
        return self.algorithm(bytes(data) + bytes(-len(data) % self.to))

    def describe(self) -> str:
        return (
            f"{self.algorithm.describe()} of the bytes, padded with zeros to a multiple of"
            f" {self.to}"
        )


def _require(checksum: Checksum, **allowed: range | tuple[object, ...]) -> None:
    for name, values in allowed.items():
        value = getattr(checksum, name)
        if type(value) is not type(values[0]) or value not in values:
            raise ValueError(
                f"{type(checksum).__name__}: {name} must be in {values}, not {value!r}"
            )


def _xor(data: Bytes) -> int:
    """Return the XOR of all bytes."""
    value = int.from_bytes(data, "little")
    for power in _list_shifts(8, len(data)):
        value ^= value >> power
    return value & 0xFF


@lru_cache(maxsize=4096)
def _list_shifts(bits: int, count: int) -> tuple[int, ...]:
    """Return the shifts to combine `count` parts of `bits` bits by XOR.

    After ``number ^= number >> shift`` for each shift, the lowest part is the XOR of all parts.
    """
    return tuple(bits << power for power in reversed(range(max(count - 1, 0).bit_length())))


def reflect(value: int, width: int) -> int:
    """Return the value with its bits in reverse order."""
    return int(f"{value:0{width}b}"[::-1], 2)


def mirrored_bytes(register: int) -> int:
    """Return the register with the order of the bits in each byte reversed."""
    return int.from_bytes(register.to_bytes(8, "little").translate(MIRROR), "little")


@lru_cache(maxsize=256)
def byte_table(width: int, poly: int, refin: bool) -> tuple[int, ...]:
    """Return the change of a CRC register for each value of a byte, (256,)."""
    table = list(range(256))
    feedback = reflect(poly, width)
    for _ in range(8):
        table = [register >> 1 ^ (feedback if register & 1 else 0) for register in table]
    return tuple(table if refin else (mirrored_bytes(table[byte]) for byte in MIRROR))


def _crc(width: int, poly: int, init: int = 0, *, reflected: bool = False, xorout: int = 0) -> Crc:
    return Crc(width, poly, init, reflected, reflected, xorout)


_ONES = 0xFFFF_FFFF

#: The common CRCs by name, the most used first.
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
#: The polynomials of the CRCs in `CRCS`, by width.
KNOWN_POLYNOMIALS = {
    width: {crc.poly for crc in CRCS.values() if crc.width == width} for width in (8, 16, 32)
}


def name_of(crc: Crc) -> str:
    """Return the name of a CRC in catalogues; "" without a name."""
    return _NAMES.get(crc, "")


def make_single(algorithm: Checksum) -> Single:
    """Return a fast function that computes the checksum of a single frame."""
    kind = type(algorithm)  # not isinstance: a subclass may compute another checksum
    if kind is Xor:
        return _xor
    if kind is Sum:
        mask = (1 << algorithm.width) - 1
        return lambda data: sum(data) & mask
    if kind is Crc:
        return _make_single_crc(algorithm)
    if kind is WordXor:
        return _make_single_word_xor(algorithm)
    return algorithm


def _make_zlib_crc(algorithm: Crc) -> Single | None:
    """Return a function that computes a CRC by zlib; None if zlib cannot compute it."""
    if (algorithm.width, algorithm.poly, algorithm.refin, algorithm.refout) != (
        32,
        0x04C11DB7,
        True,
        True,
    ):
        return None
    start = reflect(algorithm.init, 32) ^ 0xFFFFFFFF
    end = algorithm.xorout ^ 0xFFFFFFFF
    return lambda data: zlib.crc32(data, start) ^ end


@lru_cache(maxsize=256)
def _make_single_crc(algorithm: Crc) -> Single:
    init = algorithm.init
    xorout = algorithm.xorout
    compiled = _make_zlib_crc(algorithm)
    if compiled is not None:
        return compiled
    if (algorithm.width, algorithm.poly, algorithm.refin, algorithm.refout) == (
        16,
        0x1021,
        False,
        False,
    ):
        return lambda data: binascii.crc_hqx(data, init) ^ xorout
    table = byte_table(algorithm.width, algorithm.poly, algorithm.refin)
    if algorithm.width > 8:
        return functools.partial(_compute_wide_crc, algorithm, table, algorithm.start)
    spare = 8 - algorithm.width
    leaving = [register if algorithm.refin else register >> spare for register in range(256)]
    if algorithm.refin != algorithm.refout:
        leaving = [MIRROR[register] >> spare for register in leaving]
    return functools.partial(
        _narrow_crc,
        table,
        algorithm.start,
        bytes(register ^ algorithm.xorout for register in leaving),
    )


def _narrow_crc(table: tuple[int, ...], register: int, leaving: bytes, data: bytes) -> int:
    for byte in data:
        register = table[register ^ byte]
    return leaving[register]


def _compute_wide_crc(algorithm: Crc, table: tuple[int, ...], register: int, data: bytes) -> int:
    for byte in data:
        register = table[(register ^ byte) & 0xFF] ^ register >> 8
    return algorithm.finish(register)


@lru_cache(maxsize=256)
def _make_single_word_xor(algorithm: WordXor) -> Single:
    """Return a fast function that computes a `WordXor`."""
    head = algorithm.head
    groups = algorithm.groups
    size = sum(groups)
    head_powers = _list_shifts(16, head + 1 >> 1)
    words = [
        (8 * sum(groups[:number]), (1 << 8 * width) - 1) for number, width in enumerate(groups)
    ]

    def word_xor(data: bytes) -> int:
        total = int.from_bytes(data[:head], "little")
        for power in head_powers:
            total ^= total >> power
        total &= 0xFFFF
        value = int.from_bytes(data[head:], "little")
        for power in _list_shifts(8 * size, -((head - len(data)) // size)):
            value ^= value >> power
        for start, mask in words:
            total ^= value >> start & mask
        return total

    return word_xor
