"""Contenders that use construct on plain structs, without adapters and checksums."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from construct import (
    Array,
    Bytes,
    Const,
    If,
    Int8ub,
    Int8ul,
    Int16ub,
    Int16ul,
    Int32ub,
    Int32ul,
    Struct,
    this,
)
from measure import Contender

STRUCTS = {
    "m1": Struct(
        "magic" / Const(b"\x55\xaa\x5a\xa5"),
        "pkt_psn" / Int16ub,
        "protocol_version" / Int16ub,
        "wave_mode" / Int8ub,
        "time_sync_mode" / Int8ub,
        "seconds" / Bytes(6),
        "microseconds" / Int32ub,
        "reserved" / Bytes(10),
        "lidar_type" / Int8ub,
        "mems_tmp" / Int8ub,
        "blocks"
        / Array(
            25,
            Struct(
                "time_offset" / Int8ub,
                "return_seq" / Int8ub,
                "channels"
                / Array(
                    5,
                    Struct(
                        "radius" / Int16ub,
                        "elevation" / Int16ub,
                        "azimuth" / Int16ub,
                        "intensity" / Int8ub,
                        "reserved" / Bytes(2),
                    ),
                ),
            ),
        ),
        "tail" / Bytes(3),
    ),
    "stl27l": Struct(
        "header" / Const(b"\x54\x2c"),
        "speed" / Int16ul,
        "start_angle" / Int16ul,
        "points" / Array(12, Struct("distance" / Int16ul, "intensity" / Int8ul)),
        "end_angle" / Int16ul,
        "timestamp" / Int16ul,
        "crc" / Int8ul,
    ),
    "m1c1": Struct(
        "header" / Const(b"\xaa\x55"),
        "mt" / Int8ul,
        "lsn" / Int8ul,
        "fsa" / Int16ul,
        "lsa" / Int16ul,
        "cs" / Int16ul,
        "samples" / Array(this.lsn, Struct("low" / Int8ul, "middle" / Int8ul, "high" / Int8ul)),
    ),
    "vlp16": Struct(
        "blocks"
        / Array(
            12,
            Struct(
                "flag" / Const(b"\xff\xee"),
                "azimuth" / Int16ul,
                "channels" / Array(32, Struct("distance" / Int16ul, "intensity" / Int8ul)),
            ),
        ),
        "timestamp" / Int32ul,
        "return_mode" / Int8ul,
        "product" / Int8ul,
    ),
    "xt32": Struct(
        "sync" / Const(b"\xee\xff"),
        "version" / Bytes(4),
        "lasers" / Int8ul,
        "block_count" / Int8ul,
        "first_return" / Int8ul,
        "dis_unit" / Int8ul,
        "return_count" / Int8ul,
        "flags" / Int8ul,
        "blocks"
        / Array(
            this.block_count,
            Struct(
                "azimuth" / Int16ul,
                "channels"
                / Array(
                    this._.lasers,
                    Struct("distance" / Int16ul, "reflectivity" / Int8ul, "reserved" / Int8ul),
                ),
            ),
        ),
        "tail" / Bytes(24),
        "sequence" / If(this.flags == 1, Int32ul),
    ),
    "rplidar": Struct("head" / Int8ul, "beam" / Int16ul, "distance" / Int16ul),
}


def construct_on(key: str, frames: Sequence[bytes], points: int, *, compiled: bool) -> Contender:
    """Prepare construct on these frames, one at a time, without computing points."""
    parse: Callable[[bytes], Any] = (STRUCTS[key].compile() if compiled else STRUCTS[key]).parse
    return Contender(lambda: [parse(frame) for frame in frames], points)
