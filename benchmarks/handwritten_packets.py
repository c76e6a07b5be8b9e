"""Packet decoders written by hand in NumPy, to compare the engine with.

They know offsets, strides and scales. They compact blocks before they compute anything, use a
lookup table for each function of a 16-bit field, and work in chunks that fit into the cache.
`handwritten_serial` has the decoders of serial streams.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

M1_CHUNK = 512  # packets: 64,000 points
VLP_CHUNK = 160  # packets: 61,440 points
XT_CHUNK = 240  # packets: 61,440 points
CODES = np.arange(1 << 16)


@functools.cache
def _m1_tables() -> dict[str, Floats]:
    """Return lookup tables for big-endian fields that are read as little-endian."""
    code = CODES.astype("<u2").view(">u2").astype(np.float64)
    angle = np.deg2rad(code * 0.01 - 327.68)
    distance = np.where(code > 0, code * 0.005, np.nan)
    return {
        "range": distance.astype(np.float32),
        "cos": np.cos(angle).astype(np.float32),
        "sin": np.sin(angle).astype(np.float32),
    }


def m1_points(packets: Bytes) -> Floats:
    """Return x, y, z and intensity of RS-LiDAR-M1 packets, (n, 1210).

    Returns:
        float32, (4, n * 125); NaN if there is no return.
    """
    tables = _m1_tables()
    block = np.dtype({"names": ["channels"], "formats": ["V45"], "offsets": [2], "itemsize": 47})
    packet = np.dtype(
        {"names": ["blocks"], "formats": [(block, 25)], "offsets": [32], "itemsize": 1210}
    )
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
        for offset, wanted in (
            (0, (("range", distance),)),
            (2, (("cos", level), ("sin", rise))),
            (4, (("cos", east), ("sin", north))),
        ):
            np.copyto(index[:count], column(compact, offset, "<u2", 9, count))
            for name, target in wanted:
                tables[name].take(index[:count], out=target, mode="wrap")
        x, y, z, intensity = found[:, start * 125 : start * 125 + count]
        np.multiply(distance, rise, out=z)
        np.multiply(distance, level, out=level)
        np.multiply(level, east, out=x)
        np.multiply(level, north, out=y)
        np.copyto(intensity, column(compact, 6, "u1", 9, count))
    return found


def vlp16_points(packets: Bytes) -> Floats:
    """Return x, y, z and intensity of VLP-16 packets with single return, (n, 1206).

    The azimuth of each firing is interpolated to the next block. If the step is larger than the
    sensor can turn, the previous step is used.

    Returns:
        float32, (4, n * 384); NaN if there is no return.
    """
    slot = np.arange(32)
    elevation = np.deg2rad(
        np.tile([-15.0, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], 2)
    )
    shares = np.stack([np.ones(32), (slot // 16 * 55.296 + slot % 16 * 2.304) / 110.592])
    level, rise = (
        np.tile(row.astype(np.float32), VLP_CHUNK * 12)
        for row in (np.cos(elevation), np.sin(elevation))
    )
    height = np.tile((-0.04191 * np.tan(elevation)).astype(np.float32), VLP_CHUNK * 12)
    blocks = (
        np.ndarray((len(packets), 12), np.dtype("<u2"), packets.data, 2, (1206, 100)).astype(
            np.float64
        )
        * 0.01
    )
    ahead = (np.append(blocks.ravel()[1:], np.nan) - blocks.ravel() + 180) % 360 - 180
    before = np.concatenate([[np.nan], ahead[:-1]])
    lows = np.stack([blocks.ravel(), np.where(np.abs(ahead) < 0.995, ahead, before)], axis=1)
    channels = np.ndarray((len(packets), 12), "V96", packets.data, 4, (1206, 100))
    found = np.empty((4, len(packets) * 384), np.float32)
    compact = np.empty((VLP_CHUNK, 12), "V96")
    scratch = Scratch(VLP_CHUNK * 384)
    for start in range(0, len(packets), VLP_CHUNK):
        rows = min(VLP_CHUNK, len(packets) - start)
        count = rows * 384
        np.copyto(compact[:rows], channels[start : start + rows])
        distance = scratch.single[0][:count]
        flat = scratch.single[1][:count]
        lookup(_metres(0.002), column(compact, 0, "<u2", 3, count), scratch, distance)
        east, north = scratch.directions(
            np.matmul(lows[start * 12 : (start + rows) * 12], shares), count
        )
        x, y, z, intensity = found[:, start * 384 : start * 384 + count]
        np.multiply(distance, rise[:count], out=z)
        np.add(z, height[:count], out=z)
        np.multiply(distance, level[:count], out=flat)
        np.multiply(flat, east, out=x)
        np.multiply(flat, north, out=y)
        np.copyto(intensity, column(compact, 2, "u1", 3, count))
    return found


def xt32_points(packets: Bytes) -> Floats:
    """Return x, y, z and intensity of PandarXT-32 packets in steps of 4 mm, (n, 1080).

    Returns:
        float32, (4, n * 256); NaN if there is no return.
    """
    elevation = np.deg2rad(15.0 - np.arange(32))
    offset = np.zeros(32)
    level, rise = (
        np.tile(row.astype(np.float32), XT_CHUNK * 8)
        for row in (np.cos(elevation), np.sin(elevation))
    )
    azimuth = (
        np.ndarray((len(packets), 8), np.dtype("<u2"), packets.data, 12, (1080, 130)).astype(
            np.float64
        )
        * 0.01
    )
    channels = np.ndarray((len(packets), 8), "V128", packets.data, 14, (1080, 130))
    found = np.empty((4, len(packets) * 256), np.float32)
    compact = np.empty((XT_CHUNK, 8), "V128")
    scratch = Scratch(XT_CHUNK * 256)
    for start in range(0, len(packets), XT_CHUNK):
        rows = min(XT_CHUNK, len(packets) - start)
        count = rows * 256
        np.copyto(compact[:rows], channels[start : start + rows])
        distance = scratch.single[0][:count]
        flat = scratch.single[1][:count]
        lookup(_metres(0.004), column(compact, 0, "<u2", 4, count), scratch, distance)
        east, north = scratch.directions(
            azimuth[start : start + rows].reshape(-1, 1) + offset, count
        )
        x, y, z, intensity = found[:, start * 256 : start * 256 + count]
        np.multiply(distance, rise[:count], out=z)
        np.multiply(distance, level[:count], out=flat)
        np.multiply(flat, east, out=x)
        np.multiply(flat, north, out=y)
        np.copyto(intensity, column(compact, 2, "u1", 4, count))
    return found


def payloads(path: Path) -> Bytes:
    """Return the UDP payloads of a pcap file with equal records, without copying.

    The file is little-endian, with Ethernet and IPv4.

    Returns:
        uint8, (n, size).

    Raises:
        ValueError: if the records differ in length or headers.
    """
    data = np.fromfile(path, np.uint8)
    length = 16 + int(data[32:36].view("<u4")[0])
    records = data[24 : 24 + (len(data) - 24) // length * length].reshape(-1, length)
    heads = np.ascontiguousarray(records[:, 8:58])  # the length, and all headers
    heads[:, 26:28] = heads[:, 32:34] = heads[:, 48:50] = 0  # identification and checksums
    if bool((heads != heads[0]).any()) or heads[0, 20:22].tolist() != [8, 0] or heads[0, 31] != 17:
        raise ValueError("not all records are alike")
    return records[:, 58:]


def m1_scans(path: Path) -> list[Floats]:
    """Return x, y, z and intensity of each frame of an RS-LiDAR-M1 in a pcap file.

    A new frame begins when the packet number decreases.
    """
    packets = np.ascontiguousarray(payloads(path))
    number = packets[:, 4].astype(np.intp) << 8 | packets[:, 5]
    cuts = (np.flatnonzero(number[1:] < number[:-1]) + 1) * 125
    return np.split(m1_points(packets), cuts, axis=1)


class Scratch:
    """Arrays for a chunk of points, reused for the next chunk."""

    def __init__(self, points: int) -> None:
        self.index = np.empty(points, np.intp)
        self.single = np.empty((5, points), np.float32)

    def directions(self, clockwise: NDArray[np.float64], count: int) -> tuple[Floats, Floats]:
        """Return the cosine and the sine of angles in degrees, rotated counter-clockwise."""
        angle, east, north = (row[:count] for row in self.single[2:])
        np.multiply(clockwise.reshape(-1), -np.pi / 180, out=angle, casting="same_kind")
        return np.cos(angle, out=east), np.sin(angle, out=north)


def lookup(table: Floats, codes: NDArray[Any], scratch: Scratch, out: Floats) -> None:
    """Write the table's values for these codes to `out`."""
    index = scratch.index[: len(out)]
    np.copyto(index, codes)
    table.take(index, out=out, mode="wrap")


@functools.cache
def _metres(step: float) -> Floats:
    return np.where(CODES > 0, CODES * step, np.nan).astype(np.float32)


def column(buffer: NDArray[Any], offset: int, kind: str, stride: int, count: int) -> NDArray[Any]:
    """Return one field of elements at a constant stride."""
    return np.ndarray((count,), kind, buffer.view(np.uint8).data, offset, (stride,))
