"""Compute checksums of many frames by compiled code.

A checksum that is linear with respect to XOR, such as a CRC, is the checksum of a frame of zeros,
XORed with one value for each byte. This value, the share of the byte, is looked up in a table of
256 values for each offset.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.layout import Bytes2D, FrameChecksum, Sums
from lidarspec.frames.row_checksums import compute_checksums, finalize, make_place_tables
from lidarspec.points.numba_kernels.kernels import compile_source, import_numba
from lidarspec.points.numba_kernels.source import HEAD
from lidarspec.spec.checksums import Crc, WordXor, Xor

#: The tables of a layout are made after this number of frames. The next constant is the size of the
#: smallest batch that uses them; NumPy computes smaller batches.
MIN_FRAMES_SEEN = 4096
MIN_BATCH_FRAMES = 64
#: The largest number of covered bytes whose tables fit in the fastest caches.
MAX_TABLE_BYTES = 128
#: The size of a batch in bytes from which "slicing by eight" is faster than NumPy.
MIN_ROW_BATCH_BYTES = 1 << 14

_SHARES_SOURCE = (
    HEAD
    + """\
@compile_kernel(STORED, (BYTES, INTEGER, INTEGERS, WORDS, INTEGER, INTEGER_COLUMN))
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
_WORDS_SOURCE = (
    HEAD
    + """\
@compile_kernel(STORED, (BYTES, INTEGER, INTEGERS, INTEGERS, INTEGERS, INTEGER, INTEGER_COLUMN))
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


#: The names of the registers of the rows that are computed side by side.
_REGISTERS = "abcd"


def _write_slice(name: str) -> str:
    """Return the source that computes the CRC register after eight more bytes.

    Args:
        name: the name of the register. Its value has already been XORed with the bytes.
    """
    return " ^ ".join(
        f"at(table, {256 * byte} + ({name} >> {8 * byte} & 255))" for byte in range(8)
    )


def _write_single(name: str) -> str:
    """Return the source that computes the CRC register after one more byte."""
    return (
        f"at(table, 1792 + (({name} ^ byte_at(rows, at_{name} + place)) & 255)) ^ ({name} >> 8 &"
        f" {(1 << 56) - 1})"
    )


_ROWS_SOURCE = (
    HEAD
    + f"""\
@compile_kernel(STORED, (BYTES, INTEGER, INTEGERS, INTEGERS, INTEGER, INTEGER_COLUMN))
def kernel(rows, size, spans, table, start, found):
    last = len(found) - 1
    for i in range(0, len(found), {len(_REGISTERS)}):
        {"; ".join(f"{name} = start; at_{name} = min(i + {side}, last) * size" for side, name in enumerate(_REGISTERS))}
        for k in range(0, len(spans), 2):
            place, stop = at(spans, k), at(spans, k + 1)
            while place + 8 <= stop:
                {"; ".join(f"{name} ^= word_at(rows, at_{name} + place)" for name in _REGISTERS)}
                {"; ".join(f"{name} = {_write_slice(name)}" for name in _REGISTERS)}
                place += 8
            while place < stop:
                {"; ".join(f"{name} = {_write_single(name)}" for name in _REGISTERS)}
                place += 1
        {"; ".join(f"put(found, min(i + {side}, last), {name})" for side, name in enumerate(_REGISTERS))}
"""
)


def _compute_along_rows(
    algorithm: Crc, spans: tuple[tuple[int, int], ...], rows: Bytes2D
) -> NDArray[np.uint64]:
    """Return the CRC of the covered bytes of each row, (n,).

    Args:
        spans: the covered bytes, as pairs of the first offset and the offset after the last.
    """
    # Eight bytes are processed at a time ("slicing by eight"), in four rows side by side, because
    # each step of a row depends on its previous step.
    table, _, _ = make_place_tables(8, 0, algorithm.width, algorithm.poly, algorithm.refin)
    found = np.empty(len(rows), np.int64)
    edges = np.array(spans, np.int64).reshape(-1)
    start = int(np.uint64(algorithm.start).astype(np.int64))
    compile_source(_ROWS_SOURCE)(
        rows.reshape(-1), rows.shape[1], edges, table.astype(np.uint64).view(np.int64), start, found
    )
    return finalize(algorithm, found.view(np.uint64).astype(table.dtype))


class _ByteShares:
    """Tables from which the checksum of a frame is computed byte by byte.

    The share of a byte is the change of the checksum that this byte causes.
    """

    def __init__(self, checksum: FrameChecksum) -> None:
        self.seen = 0
        self._checksum = checksum
        self._places = np.concatenate([np.arange(*span, dtype=np.int64) for span in checksum.spans])
        self.is_suited = (
            isinstance(checksum.algorithm, Crc | Xor | WordXor)
            and checksum.algorithm.width <= 16
            and len(self._places) <= MAX_TABLE_BYTES
        )
        self.start = 0
        self.tables = np.empty(0, np.uint16)

    def make(self, size: int) -> None:
        """Compute the tables, for frames of `size` bytes."""
        # `words` are the offsets of words of eight bytes, and `tables` the shares of their bytes by
        # value: 0 for bytes that are not covered, or that an earlier word contains. `is_plain` is
        # set if each share is the byte itself, in the low or the high byte of the checksum; `lows`
        # and `highs` are masks of these bytes, one for each word.
        places = self._places.tolist()
        rows = np.zeros((len(places), 256, len(places)), np.uint8)
        rows[np.arange(len(places)), :, np.arange(len(places))] = np.arange(256)
        values = compute_checksums(self._checksum.algorithm, rows.reshape(-1, len(places))).astype(
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
        low, high = (self.tables.reshape(-1, 256)[:, 1] == share for share in (1, 256))
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
            compile_source(_WORDS_SOURCE)(
                flat, rows.shape[1], self.words, self.lows, self.highs, self.start, checksums
            )
        else:
            compile_source(_SHARES_SOURCE)(
                flat, rows.shape[1], self.words, self.tables, self.start, checksums
            )
        return checksums.view(np.uint64)


_SHARES_BY_CHECKSUM: WeakKeyDictionary[FrameChecksum, _ByteShares] = WeakKeyDictionary()


def checksums(checksum: FrameChecksum, rows: Bytes2D) -> NDArray[np.uint64] | None:
    """Return the checksums of frames, (n,).

    Returns None if a kernel cannot compute the checksums faster than NumPy.

    Args:
        checksum: the checksum of the frame type.
        rows: the frames, (n, size).
    """
    shares = _SHARES_BY_CHECKSUM.get(checksum)
    if shares is None and not checksum.spans:
        return None  # over no bytes there is nothing to compute
    algorithm = checksum.algorithm
    length = sum(stop - start for start, stop in checksum.spans)
    if isinstance(algorithm, Crc) and (
        algorithm.width > 16 or (algorithm.width > 8 and length > MAX_TABLE_BYTES)
    ):
        if not rows.flags.c_contiguous or rows.size < MIN_ROW_BATCH_BYTES:
            return None
        return _compute_along_rows(algorithm, checksum.spans, rows)
    if shares is None:
        shares = _SHARES_BY_CHECKSUM[checksum] = _ByteShares(checksum)
    shares.seen += len(rows)
    if (
        not shares.is_suited
        or len(rows) < MIN_BATCH_FRAMES
        or shares.seen < MIN_FRAMES_SEEN
        or rows.shape[1] < 8
        or not rows.flags.c_contiguous
    ):
        return None
    if not len(shares.tables):
        shares.make(rows.shape[1])
    return shares.values(rows)


def compile_sums() -> Sums:
    """Return the function that computes checksums for a decoder.

    Raises:
        LibraryError: if Numba is not installed or does not work.
    """
    import_numba()
    return checksums
