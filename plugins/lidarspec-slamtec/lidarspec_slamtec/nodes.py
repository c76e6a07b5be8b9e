"""Points with their own angle: nodes of five bytes, and HQ capsules of 96 nodes.

An HQ capsule has a CRC-32, but a node has no checksum. A node is valid if its start bit S differs
from the bit that is sent as the inverse of S, the check bit is 1 and the angle is below 360
degrees. This is true for 17.6 % of all random sequences of five bytes. A node is therefore accepted
only if it is in a run, that is a sequence without a gap, of at least `CONFIRM` nodes. The table
shows the number of false nodes, i.e. accepted nodes that were not sent, if runs of 1, 6, 8 or 10
nodes are required. 10 is the selected value:

    random bytes, 8 MiB                          865 530    1 192      32       0
    express capsules, 2 MiB                      227 743    3 767     551     159
    dense capsules, 2 MiB                        167 960    6 243   1 133     132
    ultra capsules, 2 MiB                        135 276        0       0       0
    HQ capsules, 2 MiB                           133 149        0       0       0
    beginning in the middle of a node, 300 x         135        9       0       0
    nodes with 1 % of the bytes damaged, 2 MiB     7 430    1 811   1 760   1 732

The decoder searches for nodes only after the descriptor 81. It searches the bytes of capsules for
nodes only if the descriptor of the capsules was lost. In the last row of the table, 419,430 nodes
were sent; 411,423 of them are found if no run is required, and 395,728 if runs of 10 are required.
A test repeats these measurements with less data.

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
HQ_NODES = 96  # per capsule
NODES_PER_TURN = 360  # simulated
NODE_RATE_HZ = 1e6 / 508  # 508 us from node to node, as of a live A1: 5.5 revolutions a second
HQ_NODES_PER_TURN = 960  # simulated
HQ_CAPSULE_RATE_HZ = 80.0  # 8 revolutions a second; assumed

NODE = Struct(
    "head"
    / BitStruct(
        "quality" / BitsInteger(6),
        "inverse" / BitsInteger(1) * "the inverse of the bit `start`",
        "start" / BitsInteger(1) * "the bit S of the manual; 1: the first node of a revolution",
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
                "flag"
                / BitStruct(
                    "reserved" / BitsInteger(7),
                    "start" / BitsInteger(1) * "1: first node of a revolution",
                ),
            ),
        ),
        "crc" / Int32ul,
    ),
    field="crc",
    algorithm=ZeroPadded(CRC32, to=4),
)


def plausible(f: Fields) -> Any:
    """Return whether the bits `start` and `inverse` differ, and the angle is valid.

    The angle must be below 360 degrees. The check bit is a constant of the struct.
    """
    return (f.head.start != f.head.inverse) & (f.beam.angle < 360)


def node_points(f: Fields) -> Polar:
    """Return the point of a node; the angles of nodes are clockwise, seen from above."""
    return Polar(range=f.distance, azimuth=-np.deg2rad(f.beam.angle), intensity=f.head.quality)


def hq_points(f: Fields) -> Polar:
    """Return a point for each of the 96 nodes."""
    return Polar(
        range=f.nodes.distance, azimuth=-np.deg2rad(f.nodes.angle), intensity=f.nodes.quality
    )


def node_sweep(i: int) -> Mapping[str, Any]:
    """Return the values of simulated node i; a revolution has 360 nodes."""
    start = int(i % NODES_PER_TURN == 0)
    return {
        "head.start": start,
        "head.inverse": 1 - start,
        "beam.angle": i % NODES_PER_TURN * 360 / NODES_PER_TURN,
    }


def hq_sweep(i: int) -> Mapping[str, Any]:
    """Return the values of simulated capsule i; a revolution has ten capsules."""
    indices = (i * HQ_NODES + np.arange(HQ_NODES)) % HQ_NODES_PER_TURN
    return {"nodes.angle": indices * 360 / HQ_NODES_PER_TURN, "nodes.flag.start": indices == 0}
