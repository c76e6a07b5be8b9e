"""Compute the checksums of many frames at once, given as rows of bytes.

`compute_over_spans` and `compute_checksums` have fast methods for the algorithms of
`lidarspec.spec.checksums`. For an algorithm of a plugin they call its method `batch`.

A CRC is linear: the register after a row is the XOR of the contributions of its bytes.
`compute_registers` selects the fastest of four methods.
"""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.spec.checksums import (
    MIRROR,
    REGISTER_BYTES,
    Checksum,
    Crc,
    Fletcher,
    Fold15,
    Sum,
    Values,
    WordXor,
    Xor,
    ZeroPadded,
    byte_table,
)

#: For less than this number of bytes in all rows, a Python loop is faster than NumPy.
LOOP_BYTES = 2048
#: The limit for a Python loop if registers have at most one byte.
NARROW_LOOP_BYTES = 256
#: For checksums that are not CRCs, one call for each row is faster below this number of rows.
MIN_BATCH_ROWS = 4
#: The number of bytes of rows that are processed together. It is small enough for the caches, and
#: large enough to make the cost of a call of NumPy negligible.
BLOCK_BYTES = 1 << 20
#: `_compute_by_position` is used up to this number of bytes in all rows together.
MAX_TABLE_BYTES = 1 << 13
#: `_compute_by_position` is used up to this number of bytes in each row. For longer rows, the usual
#: CRC-32 uses zlib.
MAX_TABLE_ROW_BYTES = 1 << 7
#: From this number of rows on, `_sum_words` is faster than tables.
MIN_SUM_ROWS = 1024

#: The width, polynomial and reflection of the CRC-32 that `zlib` computes. For long rows, one call
#: for each row is several times as fast as NumPy.
ZLIB_CRC = (32, 0x04C11DB7, True)

#: Ranges of bytes in a row, each as (offset of the first byte, offset after the last byte).
Spans = tuple[tuple[int, int], ...]

_BYTE = np.uint64(0xFF)
_BYTE_BITS = np.uint64(8)


def compute_checksums(algorithm: Checksum, rows: NDArray[np.uint8]) -> Values:
    """Return the checksum of each row, (n,), given rows of equal length, (n, m)."""
    return compute_over_spans(algorithm, rows, ((0, rows.shape[1]),))


def compute_over_spans(algorithm: Checksum, rows: NDArray[np.uint8], spans: Spans) -> Values:
    """Return the checksum of the concatenated spans of each row, (n,)."""
    values = _METHODS.get(type(algorithm))
    if values is None or _are_few(algorithm, rows, spans):
        return algorithm.batch(gather_spans(rows, spans))
    step = max(1, BLOCK_BYTES // max(rows.shape[1], 1))
    if len(rows) <= step:
        return values(algorithm, rows, spans)
    return np.concatenate(
        [
            values(algorithm, rows[first : first + step], spans)
            for first in range(0, len(rows), step)
        ]
    )


def _are_few(algorithm: Checksum, rows: NDArray[np.uint8], spans: Spans) -> bool:
    """Return whether the rows are so few that computing one by one is faster."""
    if not isinstance(algorithm, Crc):
        return len(rows) < MIN_BATCH_ROWS
    length = _count_bytes(spans)
    return len(rows) * length < (NARROW_LOOP_BYTES if algorithm.width <= 8 else LOOP_BYTES)


@lru_cache(maxsize=1024)
def _count_bytes(spans: Spans) -> int:
    """Return the number of bytes in the spans."""
    return sum(stop - start for start, stop in spans)


def _compute_crc(algorithm: Crc, rows: NDArray[np.uint8], spans: Spans) -> Values:
    return finalize(
        algorithm,
        compute_registers(
            rows, spans, algorithm.start, algorithm.width, algorithm.poly, algorithm.refin
        ),
    )


def finalize(algorithm: Crc, left: NDArray[Any]) -> Values:
    """Return the checksums for the final registers, (n,), uint64.

    Args:
        left: the registers after all bytes, (n,), in the smallest possible unsigned dtype.
    """
    if not algorithm.refin:
        left = left.byteswap() >> 8 * left.itemsize - algorithm.width
    values = left.astype(np.uint64)
    if algorithm.refin != algorithm.refout:
        mirrored = np.frombuffer(MIRROR, np.uint8).take(values.byteswap().view(np.uint8))
        values = mirrored.view(np.uint64) >> np.uint64(64 - algorithm.width)
    if algorithm.xorout:
        return values ^ np.uint64(algorithm.xorout)
    return values


def _compute_xor(algorithm: Xor, rows: NDArray[np.uint8], spans: Spans) -> Values:
    columns = load_words(rows, spans=spans)
    return fold_xor(xor_words(columns, range(len(columns))))


def _compute_sum(algorithm: Sum, rows: NDArray[np.uint8], spans: Spans) -> Values:
    return sum_bytes(load_words(rows, spans=spans)) & np.uint64((1 << algorithm.width) - 1)


def _compute_word_xor(algorithm: WordXor, rows: NDArray[np.uint8], spans: Spans) -> Values:
    columns = load_words(rows, spans=spans)
    low, high, part = np.zeros((3, len(rows)), np.uint64)
    for which, masks in _group_word_masks(algorithm, len(columns)):
        total = xor_words(columns, which)
        np.bitwise_xor(low, np.bitwise_and(total, masks[0], out=part), out=low)
        np.bitwise_xor(high, np.bitwise_and(total, masks[1], out=part), out=high)
    return fold_xor(low) | fold_xor(high) << np.uint64(8)


@lru_cache(maxsize=512)
def _group_word_masks(
    algorithm: WordXor, number: int
) -> list[tuple[list[int], tuple[np.uint64, np.uint64]]]:
    """Group the words of a row by the masks that select their low and high bytes.

    Args:
        number: the number of words in a row.

    Returns:
        For each group, the indices of the words, and the two masks.
    """
    masks = np.zeros((2, 8 * number), np.uint8)
    for mask, half in zip(masks, algorithm.halves, strict=True):
        for part in half:
            mask[part] = 0xFF
    places: dict[tuple[np.uint64, np.uint64], list[int]] = {}
    for word, (low, high) in enumerate(masks.view("<u8").T):
        places.setdefault((low, high), []).append(word)
    return [(which, both) for both, which in places.items()]


def _compute_fletcher(algorithm: Fletcher, rows: NDArray[np.uint8], spans: Spans) -> Values:
    rows = gather_spans(rows, spans)
    # A byte is in as many of the added sums as there are bytes from it to the end. As all sums are
    # modulo 256, bytes may overflow.
    weights = np.arange(rows.shape[1], 0, -1).astype(np.uint8)
    first = rows.sum(axis=1, dtype=np.uint8)
    second = (rows * weights).sum(axis=1, dtype=np.uint8)
    checksums: Values = first.astype(np.uint64) | second.astype(np.uint64) << _BYTE_BITS
    return checksums


def _compute_fold15(algorithm: Fold15, rows: NDArray[np.uint8], spans: Spans) -> Values:
    rows = gather_spans(rows, spans)
    tail = rows[:, rows.shape[1] % 2 - 60 :]
    total = np.zeros(len(rows), np.uint64)
    last = (tail.shape[1] - 1) // 2
    for place, byte in enumerate(tail.T):
        total += byte.astype(np.uint64) << np.uint64(last - place // 2 + 8 * (place % 2))
    return (total & np.uint64(0x7FFF)) + (total >> np.uint64(15)) & np.uint64(0x7FFF)


def _compute_zero_padded(algorithm: ZeroPadded, rows: NDArray[np.uint8], spans: Spans) -> Values:
    rows = gather_spans(rows, spans)
    return compute_checksums(
        algorithm.algorithm, np.pad(rows, ((0, 0), (0, -rows.shape[1] % algorithm.to)))
    )


_METHODS: dict[type[Checksum], Callable[[Any, NDArray[np.uint8], Spans], Values]] = {
    Crc: _compute_crc,
    Xor: _compute_xor,
    Sum: _compute_sum,
    WordXor: _compute_word_xor,
    Fletcher: _compute_fletcher,
    Fold15: _compute_fold15,
    ZeroPadded: _compute_zero_padded,
}


def load_words(
    rows: NDArray[np.uint8], *, spans: Spans | None = None, zeros_first: bool = False
) -> NDArray[np.uint64]:
    """Return rows as columns of little-endian 8-byte words, (words, n), contiguous.

    The rows are padded with zeros.

    Args:
        spans: the spans of each row to concatenate and load; by default the whole row.
        zeros_first: True to pad before the first byte, False to pad after the last byte.
    """
    spans = spans or ((0, rows.shape[1]),)
    if rows.shape[1] < 8 or rows.strides[1] != 1:
        rows = np.ascontiguousarray(np.pad(rows, ((0, 0), (0, 8))))
    count, size = rows.shape
    number, runs, parts = _plan_words(spans, size, zeros_first)
    columns = np.empty((number, count), "<u8")
    begun = -1
    for first, length, start in runs:
        first_words = rows[:, start : start + 8].view("<u8")[:, 0]
        columns[first : first + length] = np.lib.stride_tricks.as_strided(
            first_words, (length, count), (8, rows.strides[0])
        )
    for word, start, right, mask, left in parts:
        part = rows[:, start : start + 8].view("<u8")[:, 0] >> right
        if mask is not None:
            part &= mask
        if word == begun:
            columns[word] |= np.left_shift(part, left, out=part)
        else:
            np.left_shift(part, left, out=columns[word])
        begun = word
    return columns


@lru_cache(maxsize=1024)
def _plan_words(
    spans: Spans, size: int, zeros_first: bool
) -> tuple[int, list[tuple[int, int, int]], list[tuple[Any, ...]]]:
    """Return how to copy the spans of a row to words of eight bytes."""
    # A run is (first word, number of words, offset in the row). A part is (word, offset of eight
    # bytes in the row, right shift, mask or None, left shift).
    total = _count_bytes(spans)
    number = -(-total // 8)
    runs = list[tuple[int, int, int]]()
    parts = list[tuple[Any, ...]]()
    position = 8 * number - total if zeros_first else 0
    for first, stop in spans:
        start = first
        while start < stop:
            word, byte = divmod(position, 8)
            length = min(8 - byte, stop - start)
            if length == 8:
                whole = (stop - start) // 8
                runs.append((word, whole, start))
                length = 8 * whole
            else:
                place = min(start, size - 8)
                if start - place + length == 8 or byte + length == 8:
                    mask = None
                else:
                    mask = np.uint64((1 << 8 * length) - 1)
                parts.append(
                    (word, place, np.uint64(8 * (start - place)), mask, np.uint64(8 * byte))
                )
            position += length
            start += length
    return number, runs, parts


def xor_words(columns: NDArray[np.uint64], which: Sequence[int]) -> NDArray[np.uint64]:
    """Return the XOR of the selected words of each row, (n,)."""
    total = np.zeros(columns.shape[1], np.uint64)
    if len(which):
        total[:] = columns[which[0]]
    for index in which[1:]:
        np.bitwise_xor(total, columns[index], out=total)
    return total


def fold_xor(total: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the XOR of the eight bytes of each word, (n,).

    `total` is overwritten.
    """
    part = np.empty_like(total)
    for bits in (32, 16, 8):
        np.bitwise_xor(total, np.right_shift(total, np.uint64(bits), out=part), out=total)
    return np.bitwise_and(total, _BYTE, out=total)


def sum_bytes(columns: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the sum of all bytes of each row, (n,)."""
    total = np.zeros(columns.shape[1], np.uint64)
    even = np.uint64(0x00FF00FF00FF00FF)
    for first in range(0, len(columns), 128):  # 128 * 2 * 255 is less than 2**16
        some = columns[first : first + 128]
        pairs = np.add.reduce((some & even) + (some >> np.uint64(8) & even), axis=0)
        for bits in (48, 32, 16, 0):
            total += pairs >> np.uint64(bits) & np.uint64(0xFFFF)
    return total


def compute_registers(
    rows: NDArray[np.uint8], spans: Spans, start: int, width: int, poly: int, refin: bool
) -> NDArray[Any]:
    """Return the CRC register after the spans of each row, (n,).

    The dtype is the smallest integer type for the register.
    """
    length = _count_bytes(spans)
    if 0 < length <= MAX_TABLE_ROW_BYTES and len(rows) * length <= MAX_TABLE_BYTES:
        return _compute_by_position(rows, spans, length, start, width, poly, refin)
    if length > MAX_TABLE_ROW_BYTES and (width, poly, refin) == ZLIB_CRC:
        return _compute_by_zlib(gather_spans(rows, spans), start)
    return (_compute_narrow if width <= 8 else _compute_wide)(
        rows, spans, start, width, poly, refin
    )


def gather_spans(rows: NDArray[np.uint8], spans: Spans) -> NDArray[np.uint8]:
    """Return the bytes of the spans of each row, concatenated, (n, bytes)."""
    parts = [rows[:, start:stop] for start, stop in spans]
    if len(parts) == 1:
        return parts[0]
    return np.concatenate(parts, axis=1)


def _compute_by_zlib(rows: NDArray[np.uint8], start: int) -> NDArray[Any]:
    """Return the CRC-32 register after each row, computed by `zlib`, (n,)."""
    if rows.strides[1] != 1:
        rows = np.ascontiguousarray(rows)
    # zlib inverts the register at the start and at the end.
    return np.fromiter(
        map(zlib.crc32, rows, itertools.repeat(start ^ 0xFFFFFFFF)), np.uint32, len(rows)
    ) ^ np.uint32(0xFFFFFFFF)


def _compute_by_position(
    rows: NDArray[np.uint8],
    spans: Spans,
    length: int,
    start: int,
    width: int,
    poly: int,
    refin: bool,
) -> NDArray[Any]:
    """Return the result of `compute_registers` for a few short rows."""
    table, firsts, begun = make_place_tables(length, start, width, poly, refin)
    found: NDArray[Any] = np.bitwise_xor.reduce(
        table.take(gather_spans(rows, spans) + firsts), axis=1
    )
    return np.bitwise_xor(found, begun, out=found) if begun else found


@lru_cache(maxsize=64)
def make_place_tables(
    length: int, start: int, width: int, poly: int, refin: bool
) -> tuple[NDArray[Any], NDArray[np.intp], Any]:
    """Return tables of the contribution of each byte to the CRC register.

    Returns:
        The table, (256 * length,); the index of the first entry for each position, (length,); the
        register after `length` zero bytes.
    """
    table = np.array(
        byte_table(width, poly, refin), f"<u{REGISTER_BYTES[width] if width > 8 else 1}"
    )
    tables = [table]
    while len(tables) < length:
        tables.append(table[tables[-1] & 0xFF] ^ (tables[-1] >> 8 if width > 8 else 0))
    begun = table.dtype.type(start >> 8 * length)
    for place, byte in enumerate(start.to_bytes(8, "little")[:length]):
        begun ^= tables[length - 1 - place][byte]
    return np.concatenate(tables[::-1]), np.arange(length) * 256, begun


def _compute_narrow(
    rows: NDArray[np.uint8], spans: Spans, start: int, width: int, poly: int, refin: bool
) -> NDArray[np.uint8]:
    """Return the result of `compute_registers` for registers of at most one byte."""
    # To advance a byte by d is to compute its contribution to the register d bytes later. The
    # first half of each row is advanced to the second half by a table, and XORed onto it. This is
    # repeated until one byte is left.
    length = _count_bytes(spans)
    if not length:
        return np.full(len(rows), start, np.uint8)
    left = load_words(rows, spans=spans, zeros_first=True)
    if start:
        left[0] ^= np.uint64(start << 8 * (-length % 8))
    if len(rows) >= MIN_SUM_ROWS and len(left) > 1:
        left = _sum_words(left, poly << 8 - width)[None]
    while len(left) > 1:
        half = len(left) // 2
        distance = (len(left) + 1) // 2
        moved = (
            left[:half].tobytes().translate(_make_advance_table(8 * distance, width, poly, refin))
        )
        left = left[half:]
        left[-half:] ^= np.frombuffer(moved, np.uint64).reshape(half, -1)
    words: NDArray[Any] = left[0]
    for size in (4, 2, 1):
        parts = words.view(f"<u{size}")
        moved = parts[::2].tobytes().translate(_make_advance_table(size, width, poly, refin))
        words = np.frombuffer(moved, f"<u{size}") ^ parts[1::2]
    return np.frombuffer(
        words.tobytes().translate(_make_advance_table(1, width, poly, refin)), np.uint8
    )


def _sum_words(columns: NDArray[np.uint64], poly: int) -> NDArray[np.uint64]:
    """Reduce each row to one word that results in the same CRC register, (n,)."""
    # In GF(2), the eighth power of a polynomial p(x) is p(x**8). A byte advanced by eight is
    # therefore the XOR of the same byte advanced by n, for each term x**n of the polynomial with
    # n < 8. Each word is XORed onto some of eight sums, one for each n from 0 to 7. The sums are
    # then advanced and combined. `poly` has eight bits.
    shares = _assign_sums(len(columns), poly)
    onto = np.uint64(sum(1 << 8 * (7 - power) for power in range(8) if poly >> power & 1))
    total = np.zeros(columns.shape[1], np.uint64)
    first = np.empty(columns.shape[1], np.uint64)
    highest = max(shares).bit_length() - 1
    for power in range(highest, -1, -1):
        if power < highest:
            np.multiply(np.bitwise_and(total, _BYTE, out=first), onto, out=first)
            np.right_shift(total, _BYTE_BITS, out=total)
            np.bitwise_xor(total, first, out=total)
        for share, column in zip(shares, columns, strict=True):
            if share >> power & 1:
                np.bitwise_xor(total, column, out=total)
    return total


@lru_cache(maxsize=256)
def _assign_sums(number: int, poly: int) -> tuple[int, ...]:
    """Return for each word a bit mask of the sums in `_sum_words` that it is added to."""
    # Bit n stands for the one of the eight sums that `_sum_words` advances by n bytes.
    found = [1]
    while len(found) < number:
        share = found[-1]
        for _ in range(8):
            share = share << 1 ^ (0x100 | poly if share & 0x80 else 0)
        found.append(share)
    return tuple(reversed(found))


def _compute_wide(
    rows: NDArray[np.uint8], spans: Spans, start: int, width: int, poly: int, refin: bool
) -> NDArray[Any]:
    """Return the result of `compute_registers` for registers of any width."""
    # The registers of all rows advance by two bytes at a time. Long rows are split into segments,
    # which are computed side by side and then joined in pairs.
    rows = gather_spans(rows, spans)
    (count, length), table = rows.shape, _make_word_table(width, poly, refin)
    # A power of two. It is small, because many segments share the cost of a NumPy call.
    segment = min(max(64, 1 << (rows.size // 2048).bit_length()), length + length % 2)
    # Zeros are added before the rows; they leave a register of 0 unchanged. So the register
    # starts as 0, and `start` is XORed onto the first bytes of the row.
    padded = np.zeros((count, -(-length // segment) * segment), np.uint8)
    padded[:, -length:] = rows
    padded[:, -length:][:, :8] ^= np.frombuffer(start.to_bytes(8, "little"), np.uint8)[:length]
    registers = np.zeros(padded.size // segment, table.dtype)
    low = registers.view("<u2")[:: table.itemsize // 2]
    for pair in np.ascontiguousarray(padded.reshape(-1, segment).view("<u2").T):
        after = table.take(low ^ pair)
        registers[:] = after if width <= 16 else after ^ registers >> 16
    found = registers.reshape(count, -1)
    while found.shape[1] > 1:
        odd = found.shape[1] % 2
        jumped = _jump(
            found[:, odd::2].ravel(), _make_jump_table(segment.bit_length() - 1, width, poly, refin)
        )
        found = np.hstack([found[:, :odd], jumped.reshape(count, -1) ^ found[:, odd + 1 :: 2]])
        segment *= 2
    return np.asarray(found[:, 0] ^ (start >> 8 * length))


@lru_cache(maxsize=1024)
def _make_advance_table(distance: int, width: int, poly: int, refin: bool) -> bytes:
    """Return the effect of each byte value on the register `distance` bytes later."""
    if distance == 1:
        return bytes(byte_table(width, poly, refin))
    half = _make_advance_table(distance // 2, width, poly, refin)
    return half.translate(
        half
        if distance % 2 == 0
        else _make_advance_table(distance - distance // 2, width, poly, refin)
    )


@lru_cache(maxsize=16)
def _make_word_table(width: int, poly: int, refin: bool) -> NDArray[Any]:
    """Return a table of the register after two bytes, (65536,).

    The index is the XOR of the little-endian word and the low 16 bits of the register.
    """
    table = np.array(byte_table(width, poly, refin), f"<u{REGISTER_BYTES[width]}")
    first = np.tile(table, 256)
    second = np.repeat(np.arange(256, dtype=np.uint8), 256)
    return np.asarray(table[first.astype(np.uint8) ^ second] ^ first >> 8)


@lru_cache(maxsize=256)
def _make_jump_table(power: int, width: int, poly: int, refin: bool) -> NDArray[Any]:
    """Return a table that advances a register by 2**power zero bytes, (bytes, 256).

    The axes are the position and the value of a byte of the register.
    """
    if power:
        half = _make_jump_table(power - 1, width, poly, refin)
        return _jump(half.ravel(), half).reshape(half.shape)
    later_places = [
        [value << 8 * place for value in range(256)] for place in range(REGISTER_BYTES[width] - 1)
    ]
    return np.array([byte_table(width, poly, refin), *later_places], f"<u{REGISTER_BYTES[width]}")


def _jump(values: NDArray[Any], table: NDArray[Any]) -> NDArray[Any]:
    """Return contiguous registers, (k,), advanced by a jump table."""
    places = values.view(np.uint8).reshape(len(values), -1).T
    return np.asarray(
        np.bitwise_xor.reduce(
            [of_place.take(place) for of_place, place in zip(table, places, strict=True)]
        )
    )
