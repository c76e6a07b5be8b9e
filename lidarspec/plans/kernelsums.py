"""Checksums of many frames by compiled code, where each byte adds its share by XOR: a table of 256 for each place.

A CRC is such a sum, and so is every XOR of bytes or words: the checksum of a frame is that of zeros, XORed with what each
byte, alone among zeros, changes about it. The tables are made by the algorithm itself.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from lidarspec.checksums import Crc, WordXor, Xor
from lidarspec.frames.layout import Bytes2D, Seal, Sums
from lidarspec.plans.kernels import function_of, require
from lidarspec.plans.kerneltext import HEAD

#: frames of a layout that earn its tables, and that a batch has to have.
EARNED, FEW = 4096, 64
#: bytes whose tables stay in the fastest caches.
LONGEST = 128

_SOURCE = (
    HEAD
    + """\
@njit([(BYTES, INTEGER, PLACES, WORDS, INTEGER, MADE_PLACES)], cache=True, nogil=True)
def kernel(rows, size, places, tables, start, found):
    for i in range(len(found)):
        total, base = start, i * size
        for k in range(len(places)):
            total ^= np.int64(at(tables, k * 256 + byte_at(rows, base + at(places, k))))
        put(found, i, total)
"""
)


class _Tables:
    """The tables of one checksum, once it is worth making them."""

    def __init__(self, seal: Seal) -> None:
        self.seen = 0
        self._seal = seal
        self.places = np.concatenate([np.arange(*span, dtype=np.int64) for span in seal.spans])
        self.is_suited = isinstance(seal.algorithm, Crc | Xor | WordXor) and seal.algorithm.width <= 16 and len(self.places) <= LONGEST
        self.start, self.tables = 0, np.empty(0, np.uint16)

    def make(self) -> None:
        """Ask the algorithm what each byte changes."""
        length = len(self.places)
        rows = np.zeros((length, 256, length), np.uint8)
        rows[np.arange(length), :, np.arange(length)] = np.arange(256)
        values = self._seal.algorithm.batch(rows.reshape(-1, length)).astype(np.uint16)
        self.start, self.tables = int(values[0]), values ^ values[0]


_KNOWN: WeakKeyDictionary[Seal, _Tables] = WeakKeyDictionary()


def checksums(seal: Seal, rows: Bytes2D) -> NDArray[np.uint64] | None:
    """The checksums of frames, (n,); None where NumPy is to compute them."""
    known = _KNOWN.get(seal)
    if known is None:
        known = _KNOWN[seal] = _Tables(seal)
    known.seen += len(rows)
    if not known.is_suited or len(rows) < FEW or known.seen < EARNED or not rows.flags.c_contiguous:
        return None
    if not len(known.tables):
        known.make()
    found = np.empty(len(rows), np.int64)
    function_of(_SOURCE)(rows.reshape(-1), rows.shape[1], known.places, known.tables, known.start, found)
    return found.view(np.uint64)


def compiled() -> Sums:
    """The function that a decoder computes checksums by; the values are the same.

    Raises:
        UsageError: where Numba is not installed, or does not work here.
    """
    require()
    return checksums
