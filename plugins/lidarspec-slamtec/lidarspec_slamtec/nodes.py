"""Points that carry their own angle: the five-byte nodes of a scan, and the HQ capsules of 96 nodes
with a CRC-32.

A node has no checksum. What holds it together is that S and its inverse differ, that the check bit
is 1 and that the angle is below 360 degrees: 17.6 % of all random five bytes pass. So nodes are
weak frames, believed in unbroken runs of
`CONFIRM` alone. Measured, nodes accepted where none was sent, with a run of one, of 6, of 8, and of
ten as chosen:

    random bytes, 8 MiB                          865 530    1 192      32       0
    express capsules, 2 MiB                      227 743    3 767     551     159
    dense capsules, 2 MiB                        167 960    6 243   1 133     132
    ultra capsules, 2 MiB                        135 276        0       0       0
    HQ capsules, 2 MiB                           133 149        0       0       0
    joining nodes in the middle of one, 300 x        135        9       0       0
    nodes with 1 % of the bytes damaged, 2 MiB     7 430    1 811   1 760   1 732

Distances that hardly change put the same bits in every cabin of a capsule, hence rows two and
three; but nodes are looked for after the descriptor 81 alone, so that they are met only where a
later descriptor was lost. The last row counts what goes on at a shifted place in a run that was
believed already, which no confirmation prevents: of 419 430 nodes sent, a run of one brings 411 423
back, a run of ten 395 728. The streams have noise of a few millimetres; a test repeats this on
less.

Source: RPLIDAR interface protocol, "SCAN"; HQ capsules: the vendor's SDK (sl_lidar_cmd.h,
handler_hqnode.cpp).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    ByteSwapped,
    Const,
    Int8ul,
    Int16ul,
    Int32ul,
    Int64ul,
    Struct,
)

from lidarspec.spec import Checksummed, Crc, Fields, Polar, Scaled, ZeroPadded

CONFIRM = 10  # nodes in an unbroken run; see the measurement above
HQ_NODES = 96
TURN = 360  # nodes of a simulated turn
RATE = 1e6 / 508  # nodes a second: a live A1's standard time between two, which makes 5.5 turns
HQ_TURN = 960  # nodes of a simulated turn of HQ capsules
HQ_RATE = 80.0  # capsules a second, which makes 8 turns; assumed

NODE = Struct(
    "head"
    / BitStruct(
        "quality" / BitsInteger(6),
        "inverse" / BitsInteger(1) * "the inverse of start",
        "start" / BitsInteger(1) * "S, 1: first node of a revolution",
    ),
    "beam"
    / ByteSwapped(
        BitStruct(
            "angle" / Scaled(BitsInteger(15), 1 / 64, "deg"), "check" / Const(1, BitsInteger(1))
        )
    ),
    "distance" / Scaled(Int16ul, 0.00025, "m") * "0: no return",
)

CRC32 = Crc(32, 0x04C11DB7, init=0xFFFFFFFF, refin=True, refout=True, xorout=0xFFFFFFFF)

HQ = Checksummed(
    Struct(
        "sync" / Const(b"\xa5"),
        "time_stamp" / Int64ul * "unit not documented",
        "nodes"
        / Array(
            HQ_NODES,
            Struct(
                "angle" / Scaled(Int16ul, 90 / 16384, "deg"),
                "distance" / Scaled(Int32ul, 0.00025, "m") * "0: no return",
                "quality" / Int8ul,
                "flag" / Int8ul * "bit 0: first node of a revolution",
            ),
        ),
        "crc" / Int32ul,
    ),
    field="crc",
    algorithm=ZeroPadded(CRC32, to=4),
)


def plausible(f: Fields) -> Any:
    """S and its inverse differ, and the angle is below 360 degrees."""
    return (f.head.start != f.head.inverse) & (f.beam.angle < 360)


def node_points(f: Fields) -> Polar:
    """One point: the node's own; clockwise seen from above."""
    return Polar(range=f.distance, azimuth=-np.deg2rad(f.beam.angle), intensity=f.head.quality)


def hq_points(f: Fields) -> Polar:
    """Return a point for each of the 96 nodes."""
    return Polar(
        range=f.nodes.distance, azimuth=-np.deg2rad(f.nodes.angle), intensity=f.nodes.quality
    )


def node_sweep(i: int) -> Mapping[str, Any]:
    """Node i of turns of 360."""
    start = int(i % TURN == 0)
    return {"head.start": start, "head.inverse": 1 - start, "beam.angle": i % TURN * 360 / TURN}


def hq_sweep(i: int) -> Mapping[str, Any]:
    """Capsule i of turns of ten."""
    places = (i * HQ_NODES + np.arange(HQ_NODES)) % HQ_TURN
    return {"nodes.angle": places * 360 / HQ_TURN, "nodes.flag": places == 0}
