"""Compute checksums of many frames by compiled code.

The contributions of all bytes are combined by XOR. Each position has a table of 256.

A CRC is such a sum, and so is every XOR of bytes or words: the checksum of a frame is that of
zeros, XORed with what each byte, alone among zeros, changes about it. The tables are made by the
algorithm itself; where a share is the byte as it stands, words of eight bytes are XORed instead.

A CRC over more bytes, or of more than 16 bits, runs along the row eight bytes at a time by eight
tables of 256 ("slicing by eight"), four rows side by side, since each step waits for the one
before.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D, Seal, Sums
from lidarspec.frames.row_checksums import compute_checksums, finalize, make_place_tables
from lidarspec.points.numba_kernels.kernels import compile_source, import_numba
from lidarspec.points.numba_kernels.source import HEAD
from lidarspec.spec.checksums import Crc, WordXor, Xor

#: frames of a layout that earn its tables, and that a batch has to have.
EARNED = 4096
FEW = 64
#: bytes whose tables stay in the fastest caches.
LONGEST = 128
#: bytes of a batch that earn calling a kernel that goes along the rows.
WORTH = 1 << 14

_SHARES = (
    HEAD
    + """\
@compiled(KEPT, (BYTES, INTEGER, PLACES, WORDS, INTEGER, MADE_PLACES))
def kernel(rows, size, places, tables, start, found):
    for i in range(len(found)):
        total, base = start, i * size
        for k in range(len(places)):
            word, first = word_at(rows, base + at(places, k)), k * 2048
            total ^= np.int64(at(tables, first + (word & 255)) ^ at(tables, first + 256 + (word >> 8 & 255)))
            total ^= np.int64(at(tables, first + 512 + (word >> 16 & 255)) ^ at(tables, first + 768 + (word >> 24 & 255)))
            total ^= np.int64(at(tables, first + 1024 + (word >> 32 & 255)) ^ at(tables, first + 1280 + (word >> 40 & 255)))
            total ^= np.int64(at(tables, first + 1536 + (word >> 48 & 255)) ^ at(tables, first + 1792 + (word >> 56 & 255)))
        put(found, i, total)
"""
)
_XORED = (
    HEAD
    + """\
@compiled(KEPT, (BYTES, INTEGER, PLACES, PLACES, PLACES, INTEGER, MADE_PLACES))
def kernel(rows, size, places, lows, highs, start, found):
    for i in range(len(found)):
        low, high, base = 0, 0, i * size
        for k in range(len(places)):
            word = word_at(rows, base + at(places, k))
            low ^= word & at(lows, k)
            high ^= word & at(highs, k)
        for bits in (32, 16, 8):
            low ^= low >> bits
            high ^= high >> bits
        put(found, i, start ^ (low & 255) ^ (high & 255) << 8)
"""
)


#: rows that are gone along side by side.
_SIDE = "abcd"


def _slice(name: str) -> str:
    """Return a register after eight more bytes, by what it and they are together."""
    return " ^ ".join(
        f"at(table, {256 * byte} + ({name} >> {8 * byte} & 255))" for byte in range(8)
    )


def _single(name: str) -> str:
    """Return a register after one more byte."""
    return (
        f"at(table, 1792 + (({name} ^ byte_at(rows, at_{name} + place)) & 255)) ^ ({name} >> 8 &"
        f" {(1 << 56) - 1})"
    )


_ALONG = (
    HEAD
    + f"""\
@compiled(KEPT, (BYTES, INTEGER, PLACES, PLACES, INTEGER, MADE_PLACES))
def kernel(rows, size, spans, table, start, found):
    last = len(found) - 1
    for i in range(0, len(found), {len(_SIDE)}):
        {"; ".join(f"{name} = start; at_{name} = min(i + {side}, last) * size" for side, name in enumerate(_SIDE))}
        for k in range(0, len(spans), 2):
            place, stop = at(spans, k), at(spans, k + 1)
            while place + 8 <= stop:
                {"; ".join(f"{name} ^= word_at(rows, at_{name} + place)" for name in _SIDE)}
                {"; ".join(f"{name} = {_slice(name)}" for name in _SIDE)}
                place += 8
            while place < stop:
                {"; ".join(f"{name} = {_single(name)}" for name in _SIDE)}
                place += 1
        {"; ".join(f"put(found, min(i + {side}, last), {name})" for side, name in enumerate(_SIDE))}
"""
)


def _along(algorithm: Crc, spans: tuple[tuple[int, int], ...], rows: Bytes2D) -> NDArray[np.uint64]:
    """Return the CRCs of some bytes of each row, (n,)."""
    table, _, _ = make_place_tables(8, 0, algorithm.width, algorithm.poly, algorithm.refin)
    found = np.empty(len(rows), np.int64)
    edges = np.array(spans, np.int64).reshape(-1)
    start = int(np.uint64(algorithm.start).astype(np.int64))
    compile_source(_ALONG)(
        rows.reshape(-1), rows.shape[1], edges, table.astype(np.uint64).view(np.int64), start, found
    )
    return finalize(algorithm, found.view(np.uint64).astype(table.dtype))


class _ByteShares:
    """The share of each byte of a frame in one checksum, computed on first use.

    Attributes:
        words: where eight bytes are loaded at a time.
        tables: of each of these bytes, its share by its value; 0 for those that are not covered, or
            were before.
        is_plain: whether all shares are the bytes as they stand, in the low byte of the checksum or
            the high one.
        lows, highs: where shares are the bytes themselves, which of them go into the low byte of
            the checksum, and the high one.
    """

    def __init__(self, seal: Seal) -> None:
        self.seen = 0
        self._seal = seal
        self._places = np.concatenate([np.arange(*span, dtype=np.int64) for span in seal.spans])
        self.is_suited = (
            isinstance(seal.algorithm, Crc | Xor | WordXor)
            and seal.algorithm.width <= 16
            and len(self._places) <= LONGEST
        )
        self.start = 0
        self.tables = np.empty(0, np.uint16)

    def make(self, size: int) -> None:
        """Ask the algorithm, for frames of so many bytes."""
        places = self._places.tolist()
        rows = np.zeros((len(places), 256, len(places)), np.uint8)
        rows[np.arange(len(places)), :, np.arange(len(places))] = np.arange(256)
        values = compute_checksums(self._seal.algorithm, rows.reshape(-1, len(places))).astype(
            np.uint16
        )
        shares = dict(zip(places, (values ^ values[0]).reshape(-1, 256), strict=True))
        words: list[int] = []
        for place in sorted(shares):
            if not words or place >= words[-1] + 8:
                words.append(min(place, size - 8))
        none = np.zeros(256, np.uint16)
        self.words = np.array(words, np.int64)
        self.start = int(values[0])
        self.tables = np.concatenate(
            [shares.pop(word + byte, none) for word in words for byte in range(8)]
        )
        low, high = (self.tables.reshape(-1, 256)[:, 1] == one for one in (1, 256))
        bytes_ = np.arange(256, dtype=np.uint16)
        self.is_plain = np.array_equal(
            self.tables.reshape(-1, 256), np.outer(low, bytes_) + np.outer(high, bytes_ << 8)
        )
        self.lows, self.highs = (
            np.packbits(np.repeat(part, 8)).view("<i8").astype(np.int64) for part in (low, high)
        )

    def values(self, rows: Bytes2D) -> NDArray[np.uint64]:
        """Return the checksums of frames, (n,)."""
        checksums = np.empty(len(rows), np.int64)
        flat = rows.reshape(-1)
        if self.is_plain:
            compile_source(_XORED)(
                flat, rows.shape[1], self.words, self.lows, self.highs, self.start, checksums
            )
        else:
            compile_source(_SHARES)(
                flat, rows.shape[1], self.words, self.tables, self.start, checksums
            )
        return checksums.view(np.uint64)


_KNOWN: WeakKeyDictionary[Seal, _ByteShares] = WeakKeyDictionary()


def checksums(seal: Seal, rows: Bytes2D) -> NDArray[np.uint64] | None:
    """Return the checksums of frames, (n,); None where NumPy is to compute them."""
    known = _KNOWN.get(seal)
    if known is None and not seal.spans:
        return None  # over no bytes there is nothing to compute
    algorithm = seal.algorithm
    length = sum(stop - start for start, stop in seal.spans)
    if isinstance(algorithm, Crc) and (
        algorithm.width > 16 or (algorithm.width > 8 and length > LONGEST)
    ):
        if not rows.flags.c_contiguous or rows.size < WORTH:
            return None
        return _along(algorithm, seal.spans, rows)
    if known is None:
        known = _KNOWN[seal] = _ByteShares(seal)
    known.seen += len(rows)
    if (
        not known.is_suited
        or len(rows) < FEW
        or known.seen < EARNED
        or rows.shape[1] < 8
        or not rows.flags.c_contiguous
    ):
        return None
    if not len(known.tables):
        known.make(rows.shape[1])
    return known.values(rows)


def compile_sums() -> Sums:
    """Return the function that a decoder computes checksums by; the values are the same.

    Raises:
        UsageError: where Numba is not installed, or does not work here.
    """
    import_numba()
    return checksums
