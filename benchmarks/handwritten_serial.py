"""Decoders of serial streams, written by hand in NumPy, with framing and checksums.

`handwritten_packets` has the decoders of packets.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from handwritten_packets import CODES, Bytes, Floats, Scratch, column, lookup
from numpy.typing import NDArray

STL_CHUNK = 4096  # frames: 49,152 points
STL_FRAME = 47
STL_POINTS = 12
M1C1_CHUNK = 1 << 16  # points
NODE_CHUNK = 1 << 16  # nodes


@functools.cache
def _crc_tables() -> list[NDArray[np.uint8]]:
    """Return what each pair of bytes adds to the CRC-8 (0x4d) of 46 bytes.

    The tables are indexed by the position of the pair and its little-endian value.
    """
    single = np.arange(256)
    for _ in range(8):
        single = np.where(single & 0x80, single << 1 ^ 0x4D, single << 1) & 0xFF
    tables = [single.astype(np.uint8)]
    while len(tables) < STL_FRAME - 1:
        tables.insert(0, single[tables[0]].astype(np.uint8))
    return [
        tables[spot][CODES & 0xFF] ^ tables[spot + 1][CODES >> 8]
        for spot in range(0, STL_FRAME - 1, 2)
    ]


def _good(frames: Bytes) -> NDArray[np.bool_]:
    """Return which STL-27L frames, (n, 47), are valid.

    Their checksum is right, angles are below 360 degrees, and the time is at most 30 s.
    """
    pairs = np.ascontiguousarray(frames[:, : STL_FRAME - 1]).view("<u2")
    crc = np.zeros(len(frames), np.uint8)
    for spot, table in enumerate(_crc_tables()):
        crc ^= table.take(pairs[:, spot], mode="wrap")
    start = pairs[:, 2]
    end = pairs[:, 21]
    time = pairs[:, 22]
    good: NDArray[np.bool_] = (
        (crc == frames[:, 46]) & (start < 36000) & (end < 36000) & (time <= 30_000)
    )
    return good


def stl27l_points(frames: Bytes) -> Floats:
    """Return x, y and intensity of valid STL-27L frames, (n, 47): float32, (3, points)."""
    found = np.empty((3, len(frames) * STL_POINTS), np.float32)
    end = 0
    for start in range(0, len(frames), STL_CHUNK):
        rows = frames[start : start + STL_CHUNK]
        good = _good(rows)
        end = _stl27l_chunk(rows if good.all() else rows[good], found, end)
    return found[:, :end]


def _stl27l_chunk(frames: Bytes, found: Floats, start: int) -> int:
    """Write the points of valid frames from column `start` on; return the next column."""
    first, final = (
        np.ascontiguousarray(frames[:, at : at + 2]).view("<u2").astype(np.float64)
        for at in (4, 42)
    )
    steps = np.arange(STL_POINTS) / (STL_POINTS - 1)
    angle = np.deg2rad((first + (final - first) % 36000 * steps) * -0.01).astype(np.float32).ravel()
    samples = np.ascontiguousarray(frames[:, 6:42])
    end = start + angle.size
    x, y, intensity = found[:, start:end]
    distance = _stl27l_ranges().take(column(samples, 0, "<u2", 3, angle.size), mode="wrap")
    np.multiply(distance, np.cos(angle), out=x)
    np.multiply(distance, np.sin(angle), out=y)
    np.copyto(intensity, column(samples, 2, "u1", 3, angle.size))
    return end


@functools.cache
def _stl27l_ranges() -> Floats:
    return np.where(CODES > 0, CODES * 0.001, np.nan).astype(np.float32)


def stl27l_stream(data: bytes) -> Floats:
    """Return x, y and intensity of the STL-27L frames in a stream with noise.

    If frames overlap, the first is used.
    """
    stream = np.frombuffer(data, np.uint8)
    here = np.flatnonzero(stream[: len(stream) - STL_FRAME + 1] == 0x54)
    here = here[stream[here + 1] == 0x2C]
    windows = np.lib.stride_tricks.sliding_window_view(stream, STL_FRAME)
    found = np.empty((3, len(here) * STL_POINTS), np.float32)
    free = 0
    end = 0
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
    """Return which frames do not overlap an earlier selected frame.

    Args:
        free: the first offset at which a frame may start.
    """
    chosen = np.ones(len(spots), np.bool_)
    if bool((np.diff(spots, prepend=free - STL_FRAME) < STL_FRAME).any()):
        for index, offset in enumerate(spots.tolist()):
            chosen[index] = offset >= free
            free = offset + STL_FRAME if chosen[index] else free
    return chosen


def m1c1_points(packets: Bytes) -> Floats:
    """Return x, y and intensity of valid M1C1_Mini packets, (n, 10 + 3 k).

    Packets with a wrong checksum or angle are left out.

    Returns:
        float32, (3, points).
    """
    count = (packets.shape[1] - 10) // 3
    step = max(M1C1_CHUNK // count, 1)
    scratch = Scratch(step * count)
    end = 0
    found = np.empty((3, len(packets) * count), np.float32)
    for start in range(0, len(packets), step):
        rows = packets[start : start + step]
        good = _m1c1_good(rows)
        end = _m1c1_chunk(rows if good.all() else rows[good], found, end, scratch)
    return found[:, :end]


def _m1c1_good(rows: Bytes) -> NDArray[np.bool_]:
    """Return which packets of one length are valid.

    Their checksum is right and angles are below 360 degrees.
    """
    words = np.ascontiguousarray(rows[:, :10]).view("<u2")
    samples = rows[:, 10:].reshape(len(rows), -1, 3)
    low, middle, high = (
        np.bitwise_xor.reduce(samples[:, :, byte], axis=1).astype(np.uint16) for byte in range(3)
    )
    total = (
        words[:, 0] ^ words[:, 1] ^ words[:, 2] ^ words[:, 3] ^ low ^ middle ^ high << np.uint16(8)
    )
    good: NDArray[np.bool_] = (
        (words[:, 2] >> 1 < 23040) & (words[:, 3] >> 1 < 23040) & (rows[:, 4] & rows[:, 6] & 1 == 1)
    )
    good &= total == words[:, 4]
    return good


def _m1c1_chunk(packets: Bytes, found: Floats, start: int, scratch: Scratch) -> int:
    """Write the points of valid packets of one length from column `start` on.

    Returns the column after them.
    """
    count = int(packets.shape[1] - 10) // 3
    first, final = (
        np.ascontiguousarray(packets[:, at : at + 2]).view("<u2")[:, 0] >> 1 for at in (4, 6)
    )
    span = (final.astype(np.float64) - first) % 23040
    lows = np.stack([first / 64, span / 64], axis=1)
    angle = np.matmul(
        lows, np.stack([np.ones(count), np.arange(count) / max(count - 1, 1)])
    ).reshape(-1)
    samples = np.ascontiguousarray(packets[:, 10:])
    size = len(packets) * count
    x, y, intensity = found[:, start : start + size]
    distance = scratch.single[0][:size]
    correction = scratch.single[1][:size]
    metres, corrections, levels = _m1c1_tables()
    lookup(metres, column(samples, 1, "<u2", 3, size), scratch, distance)
    corrections.take(scratch.index[:size], out=correction, mode="wrap")
    np.subtract(angle, correction, out=angle)
    east, north = scratch.directions(angle, size)
    np.multiply(distance, east, out=x)
    np.multiply(distance, north, out=y)
    lookup(levels, column(samples, 0, "<u2", 3, size), scratch, intensity)
    return start + size


@functools.cache
def _m1c1_tables() -> tuple[Floats, Floats, Floats]:
    """Return lookup tables of a sample.

    Range and correction are indexed by its upper two bytes, intensity by its lower two.
    """
    mm = CODES >> 2
    correction = np.rad2deg(
        np.arctan(19.16 * (np.maximum(mm, 1) - 90.15) / (90.15 * np.maximum(mm, 1)))
    )
    tables = (
        np.where(mm > 0, mm * 0.001, np.nan),
        np.where(mm > 0, correction, 0),
        CODES >> 2 & 0xFF,
    )
    return tuple(table.astype(np.float32) for table in tables)  # type: ignore[return-value]


def m1c1_stream(data: bytes) -> Floats:
    """Return x, y and intensity of the M1C1_Mini packets in a stream of bytes.

    If packets overlap, the first is used.
    """
    stream = np.frombuffer(data, np.uint8)
    here = np.flatnonzero((stream[:-1] == 0xAA) & (stream[1:] == 0x55))
    here = here[here < len(stream) - 12]
    numbers = stream[here + 3].astype(np.intp)
    sizes = 10 + 3 * numbers
    good = (
        (numbers > 0)
        & (here + sizes <= len(stream))
        & ((stream[here + 2] & 1 == 0) | (numbers == 1))
    )
    rows: dict[int, Any] = {}
    for number in np.unique(numbers[good]).tolist():
        which = np.flatnonzero(good & (numbers == number))
        windows: NDArray[Any] = np.ndarray(
            (len(stream) - 9 - 3 * number,), f"V{10 + 3 * number}", stream.data, 0, (1,)
        )
        rows[number] = windows[here[which]].view(np.uint8).reshape(len(which), -1)
        good[which] = _m1c1_good(rows[number])
        rows[number] = rows[number][good[which]]
    spots = np.flatnonzero(good)
    if bool((here[spots[1:]] < here[spots[:-1]] + sizes[spots[:-1]]).any()):
        raise NotImplementedError("packets in packets: this stream has none")
    starts = np.cumsum(numbers[spots]) - numbers[spots]
    found = np.empty((3, int(numbers[spots].sum())), np.float32)
    for number, packets in rows.items():
        points = m1c1_points(packets)
        where = starts[numbers[spots] == number]
        target: NDArray[Any] = np.ndarray(
            (3, found.shape[1] - number + 1), f"V{4 * number}", found.data, 0, (found.strides[0], 4)
        )
        target[:, where] = points.reshape(3, -1, number).view(f"V{4 * number}")[:, :, 0]
    return found


def rplidar_points(nodes: Bytes) -> Floats:
    """Return x, y and intensity of valid RPLIDAR nodes, (n, 5): float32, (3, n)."""
    head = nodes[:, 0]
    check = nodes[:, 1]
    angle = column(nodes, 1, "<u2", 5, len(nodes))
    good = ((head ^ head >> 1) & 1 == 1) & (check & 1 == 1) & (angle < 46080)
    nodes = nodes if good.all() else np.ascontiguousarray(nodes[good])
    found = np.empty((3, len(nodes)), np.float32)
    scratch = Scratch(NODE_CHUNK)
    cosine, sine, metres, quality = _node_tables()
    for start in range(0, len(nodes), NODE_CHUNK):
        rows = nodes[start : start + NODE_CHUNK]
        distance = scratch.single[0][: len(rows)]
        x, y, intensity = found[:, start : start + len(rows)]
        lookup(metres, column(rows, 3, "<u2", 5, len(rows)), scratch, distance)
        lookup(cosine, column(rows, 1, "<u2", 5, len(rows)), scratch, x)
        sine.take(scratch.index[: len(rows)], out=y, mode="wrap")
        np.multiply(distance, x, out=x)
        np.multiply(distance, y, out=y)
        lookup(quality, rows[:, 0], scratch, intensity)
    return found


def rplidar_stream(data: bytes, opening: int) -> Floats:
    """Return x, y and intensity of an undisturbed stream of nodes after a prefix."""
    stream = np.frombuffer(data, np.uint8)[opening:]
    return rplidar_points(stream[: len(stream) // 5 * 5].reshape(-1, 5))


@functools.cache
def _node_tables() -> tuple[Floats, Floats, Floats, Floats]:
    """Return lookup tables of a node.

    Cosine and sine are indexed by the angle's two bytes, range by the distance's, and quality by
    the first byte.
    """
    angle = -np.deg2rad((CODES >> 1) / 64)
    tables = (
        np.cos(angle),
        np.sin(angle),
        np.where(CODES > 0, CODES * 0.00025, np.nan),
        CODES[:256] >> 2,
    )
    return tuple(table.astype(np.float32) for table in tables)  # type: ignore[return-value]
