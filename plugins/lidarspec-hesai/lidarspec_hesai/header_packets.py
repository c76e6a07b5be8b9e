"""Packets with the number of blocks and the distance unit in the header (PandarQT64, Pandar XT).

    EE FF  major minor  reserved(2) | lasers blocks first_return dis_unit return_num flags

Source: HesaiLidar_SDK_2.0 (udp_protocol_header.h, udp_protocol_v3_1.h, udp_protocol_v6_1.h). The
length of a packet follows from the numbers of lasers and blocks in the header; captures of a
PandarQT64 and a Pandar XT confirm this.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Construct,
    If,
    Int8ul,
    Int16ul,
    Int32ul,
    Struct,
    this,
)

from lidarspec.spec import Fields, Scaled

#: The distance unit of every known firmware; used for simulation only.
SIMULATED_UNIT_MM = 4


def make_packet(major: int, minor: int, lasers: int, tail: Sequence[Construct]) -> Struct:
    """Return the struct of a packet with `lasers` channels per block."""
    header: list[Construct] = [
        "sync" / Const(b"\xee\xff"),
        "major" / Const(major, Int8ul),
        "minor" / Const(minor, Int8ul),
        "header_reserved" / Bytes(2),
        "lasers" / Const(lasers, Int8ul),
        "block_count" / Int8ul,
        "first_return" / Int8ul * "which return the first block of each firing contains",
        "dis_unit" / Scaled(Int8ul, 1, "mm") * "size of one distance step",
        "return_count"
        / Int8ul
        * "number of returns per firing; some models always send their largest number",
        "flags" / BitStruct("reserved" / BitsInteger(7), "sequence" / BitsInteger(1)),
    ]
    channel = Struct(
        "distance" / Int16ul * "in steps of dis_unit; 0: no return",
        "reflectivity" / Int8ul,
        "reserved" / Int8ul,
    )
    block = Struct("azimuth" / Scaled(Int16ul, 0.01, "deg"), "channels" / Array(lasers, channel))
    sequence = "sequence" / If(this.flags.sequence == 1, Int32ul)
    return Struct(*header, "blocks" / Array(this.block_count, block), *tail, sequence)


def max_packet_bytes(lasers: int, blocks: int) -> int:
    """Return the size of a packet in bytes, with header, blocks, tail and sequence."""
    return 12 + blocks * (2 + 4 * lasers) + 24 + 4


def plausible(f: Fields) -> Any:
    """Return whether counts, unit and azimuths are in their ranges."""
    return (
        (f.block_count >= 1)
        & (f.dis_unit >= 1)
        & (f.return_count >= 1)
        & (f.return_count <= 3)
        & (f.blocks.azimuth < 360)
    )


def distance(f: Fields) -> Any:
    """Return distances in metres, (n, blocks, lasers)."""
    return f.blocks.channels.distance * (f.dis_unit * 0.001)


def block_numbers(f: Fields) -> Any:
    """Return the index of each block in its packet, (n, blocks, 1); the first index is 0."""
    return f.block_count.steps()[:, None]


def simulated_header(blocks: int) -> dict[str, Any]:
    """Return the header values of a simulated packet with single return."""
    return {
        "block_count": blocks,
        "first_return": 1,
        "dis_unit": SIMULATED_UNIT_MM,
        "return_count": 1,
        "flags.sequence": 1,
    }
