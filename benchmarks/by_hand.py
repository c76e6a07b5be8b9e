"""Decoders of two formats as one would write them by hand in NumPy: what the engine is to match from the spec alone.

They know offsets, strides and scales; blocks are compacted before anything is computed, what depends on one 16-bit field
is a table by its raw value, and chunks stay in the cache.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

M1_CHUNK = 512  # packets: 64,000 points
STL_CHUNK = 4096  # frames: 49,152 points
STL_FRAME, STL_POINTS = 47, 12
CODES = np.arange(1 << 16)


@functools.cache
def _m1_tables() -> dict[str, Floats]:
    """By the raw value as it is loaded little-endian, where the wire is big-endian."""
    code = CODES.astype("<u2").view(">u2").astype(np.float64)
    angle = np.deg2rad(code * 0.01 - 327.68)
    distance = np.where(code > 0, code * 0.005, np.nan)
    return {"range": distance.astype(np.float32), "cos": np.cos(angle).astype(np.float32), "sin": np.sin(angle).astype(np.float32)}


def m1_points(packets: Bytes) -> Floats:
    """x y z intensity of RS-LiDAR-M1 packets (n, 1210): float32, (4, n * 125); nan where there is no return."""
    tables = _m1_tables()
    block = np.dtype({"names": ["channels"], "formats": ["V45"], "offsets": [2], "itemsize": 47})
    packet = np.dtype({"names": ["blocks"], "formats": [(block, 25)], "offsets": [32], "itemsize": 1210})
    channels = packets.view(packet)["blocks"]["channels"]
    found = np.empty((4, len(packets) * 125), np.float32)
    compact = np.empty((M1_CHUNK, 1, 25), "V45")
    index = np.empty(M1_CHUNK * 125, np.intp)
    scratch = np.empty((5, M1_CHUNK * 125), np.float32)
    for start in range(0, len(packets), M1_CHUNK):
        rows = min(M1_CHUNK, len(packets) - start)
        count = rows * 125
        np.copyto(compact[:rows], channels[start : start + rows].reshape(rows, 1, 25))
        distance, level, rise, east, north = (row[:count] for row in scratch)
        for offset, wanted in ((0, (("range", distance),)), (2, (("cos", level), ("sin", rise))), (4, (("cos", east), ("sin", north)))):
            np.copyto(index[:count], _column(compact, offset, "<u2", 9, count))
            for name, target in wanted:
                tables[name].take(index[:count], out=target, mode="clip")
        x, y, z, intensity = found[:, start * 125 : start * 125 + count]
        np.multiply(distance, rise, out=z)
        np.multiply(distance, level, out=level)
        np.multiply(level, east, out=x)
        np.multiply(level, north, out=y)
        np.copyto(intensity, _column(compact, 6, "u1", 9, count))
    return found


def _column(buffer: NDArray[Any], offset: int, kind: str, stride: int, count: int) -> NDArray[Any]:
    return np.ndarray((count,), kind, buffer.view(np.uint8).data, offset, (stride,))


@functools.cache
def _crc_tables() -> list[NDArray[np.uint8]]:
    """What each pair of bytes adds to the CRC-8 (0x4d) of the 46 bytes before it, by the pair loaded little-endian."""
    single = np.arange(256)
    for _ in range(8):
        single = np.where(single & 0x80, single << 1 ^ 0x4D, single << 1) & 0xFF
    tables = [single.astype(np.uint8)]
    while len(tables) < STL_FRAME - 1:
        tables.insert(0, single[tables[0]].astype(np.uint8))
    return [tables[spot][CODES & 0xFF] ^ tables[spot + 1][CODES >> 8] for spot in range(0, STL_FRAME - 1, 2)]


def _good(frames: Bytes) -> NDArray[np.bool_]:
    """Which STL-27L frames (n, 47) have their checksum, angles below 360 degrees and a time of at most 30 s."""
    pairs = np.ascontiguousarray(frames[:, : STL_FRAME - 1]).view("<u2")
    crc = np.zeros(len(frames), np.uint8)
    for spot, table in enumerate(_crc_tables()):
        crc ^= table.take(pairs[:, spot], mode="clip")
    start, end, time = pairs[:, 2], pairs[:, 21], pairs[:, 22]
    good: NDArray[np.bool_] = (crc == frames[:, 46]) & (start < 36000) & (end < 36000) & (time <= 30_000)
    return good


def stl27l_points(frames: Bytes) -> Floats:
    """x y intensity of STL-27L frames (n, 47), those with a wrong checksum left out: float32, (3, points)."""
    found = np.empty((3, len(frames) * STL_POINTS), np.float32)
    end = 0
    for start in range(0, len(frames), STL_CHUNK):
        rows = frames[start : start + STL_CHUNK]
        good = _good(rows)
        end = _stl27l_chunk(rows if good.all() else rows[good], found, end)
    return found[:, :end]


def _stl27l_chunk(frames: Bytes, found: Floats, start: int) -> int:
    """Write the points of good frames from column `start` on; the column after them."""
    first, final = (np.ascontiguousarray(frames[:, at : at + 2]).view("<u2").astype(np.float64) for at in (4, 42))
    steps = np.arange(STL_POINTS) / (STL_POINTS - 1)
    angle = np.deg2rad((first + (final - first) % 36000 * steps) * -0.01).astype(np.float32).ravel()
    samples = np.ascontiguousarray(frames[:, 6:42])
    end = start + angle.size
    x, y, intensity = found[:, start:end]
    distance = _stl27l_ranges().take(_column(samples, 0, "<u2", 3, angle.size), mode="clip")
    np.multiply(distance, np.cos(angle), out=x)
    np.multiply(distance, np.sin(angle), out=y)
    np.copyto(intensity, _column(samples, 2, "u1", 3, angle.size))
    return end


@functools.cache
def _stl27l_ranges() -> Floats:
    return np.where(CODES > 0, CODES * 0.001, np.nan).astype(np.float32)


def stl27l_stream(data: bytes) -> Floats:
    """x y intensity of the STL-27L frames in a stream of bytes with noise, the leftmost of frames that overlap."""
    stream = np.frombuffer(data, np.uint8)
    here = np.flatnonzero(stream[: len(stream) - STL_FRAME + 1] == 0x54)
    here = here[stream[here + 1] == 0x2C]
    windows = np.lib.stride_tricks.sliding_window_view(stream, STL_FRAME)
    found = np.empty((3, len(here) * STL_POINTS), np.float32)
    free, end = 0, 0
    for start in range(0, len(here), STL_CHUNK):
        spots = here[start : start + STL_CHUNK]
        rows = windows[spots]
        good = np.flatnonzero(_good(rows))
        chosen = good[_leftmost(spots[good], free)]
        if len(chosen):
            free = int(spots[chosen[-1]]) + STL_FRAME
            end = _stl27l_chunk(rows[chosen], found, end)
    return found[:, :end]


def _leftmost(spots: NDArray[np.intp], free: int) -> NDArray[np.bool_]:
    """Which frames at these offsets do not overlap one that was chosen before, the first byte left being at `free`."""
    chosen = np.ones(len(spots), np.bool_)
    if bool((np.diff(spots, prepend=free - STL_FRAME) < STL_FRAME).any()):
        for index, offset in enumerate(spots.tolist()):
            chosen[index] = offset >= free
            free = offset + STL_FRAME if chosen[index] else free
    return chosen
