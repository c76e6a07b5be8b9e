"""The checksum of one frame as a function made for its algorithm: what the checksums of a batch are too heavy for.

Algorithms of which nothing better is known are called as they are. What is made here gives the same.
"""

from __future__ import annotations

import binascii
import functools
import zlib
from collections.abc import Callable

from lidarspec.checksums import Checksum, Crc, Sum, WordXor, Xor

Single = Callable[[bytes], int]


def single(algorithm: Checksum) -> Single:
    """A function from bytes to their checksum."""
    if type(algorithm) is Crc:
        return _crc(algorithm)
    if type(algorithm) is Xor:
        return _xor
    if type(algorithm) is Sum:
        mask = (1 << algorithm.width) - 1
        return lambda data: sum(data) & mask
    if type(algorithm) is WordXor:
        return _word_xor(algorithm)
    return algorithm


@functools.lru_cache(maxsize=256)
def _crc(algorithm: Crc) -> Single:
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


def _xor(data: bytes) -> int:
    value = int.from_bytes(data, "little")
    for power in _powers(8, len(data)):
        value ^= value >> power
    return value & 0xFF


def _word_xor(algorithm: WordXor) -> Single:
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


@functools.lru_cache(maxsize=4096)
def _powers(bits: int, count: int) -> tuple[int, ...]:
    """By how much an integer is shifted and XORed onto itself until its lowest part is the XOR of so many parts."""
    return tuple(bits << power for power in reversed(range(max(count - 1, 0).bit_length())))
