"""Packets with CRCs of their own over blocks, functional safety and tail (QT128, Pandar128, OT128).

    EE FF  major minor  status reserved | lasers blocks first_return dis_unit return_num flags
    2 x [azimuth, channels], CRC [, functional safety] , tail [, sequence], [, IMU], CRC [, signature]

Source: HesaiLidar_SDK_2.0 (udp_protocol_v3_2.h, udp_protocol_v1_4.h); what the CRCs cover was found in a capture of a QT128, and is assumed
of the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from construct import Array, BitsInteger, BitStruct, Bytes, Const, Construct, If, Int8ul, Int16sl, Int16ul, Int32ul, Struct, this

from lidarspec.spec import Checksummed, Crc, Fields, Scaled
from lidarspec_hesai.headed import USUAL_UNIT

BLOCKS = 2
CRC = Crc(32, poly=0x04C11DB7, init=0xFFFFFFFF)  # CRC-32/MPEG-2

SAFETY = Checksummed(
    Struct(
        "version" / Int8ul,
        "status" / Int8ul * "bits 7 to 5 state, 4 and 3 type of the fault, 2 to 0 a counter",
        "fault_number" / Int8ul * "how many faults, in the high half, and which of them this is",
        "fault_code" / Int16ul,
        "reserved" / Bytes(8),
        "crc" / Int32ul,
    ),
    "crc",
    CRC,
    over=("status", "fault_number", "fault_code", "reserved"),
)
IMU = Struct(
    "temperature" / Int16sl,
    "acceleration_unit" / Int16ul,
    "rate_unit" / Int16ul,
    "time" / Int32ul,
    "acceleration" / Array(3, Int16sl),
    "rate" / Array(3, Int16sl),
)


def packet(major: int, minor: int, lasers: int, tail: Sequence[Construct], *, confidence: bool, imu: bool = False) -> Construct:
    """The packet of a protocol version with so many lasers in each block, and a fourth byte of each where there is a confidence."""
    flags = BitStruct(
        "reserved" / BitsInteger(1),
        "environment" / BitsInteger(1),
        "weight" / BitsInteger(1),
        "confidence" / BitsInteger(1),
        "signature" / BitsInteger(1),
        "safety" / BitsInteger(1),
        "imu" / BitsInteger(1),
        "sequence" / BitsInteger(1),
    )
    more = ["confidence" / Int8ul] if confidence else []
    channel = Struct("distance" / Int16ul * "steps of dis_unit; 0: no return", "reflectivity" / Int8ul, *more)
    blocks = Array(BLOCKS, Struct("azimuth" / Scaled(Int16ul, 0.01, "deg"), "channels" / Array(lasers, channel)))
    frame = Struct(
        "sync" / Const(b"\xee\xff"),
        "major" / Const(major, Int8ul),
        "minor" / Const(minor, Int8ul),
        "status_version" / Int8ul,
        "header_reserved" / Bytes(1),
        "lasers" / Const(lasers, Int8ul),
        "block_count" / Const(BLOCKS, Int8ul),
        "first_return" / Int8ul * "which return the first block of a shot holds",
        "dis_unit" / Scaled(Int8ul, 1, "mm") * "one step of a distance",
        "return_count" / Int8ul * "returns of a shot; of some models the most that there can be",
        "flags" / flags,
        "body" / Checksummed(Struct("blocks" / blocks, "crc" / Int32ul), "crc", CRC),
        "safety" / If(this.flags.safety == 1, SAFETY),
        *tail,
        "sequence" / If(this.flags.sequence == 1, Int32ul),
        *(["imu" / If(this.flags.imu == 1, IMU)] if imu else []),
        "tail_crc" / Int32ul,
        "signature" / If(this.flags.signature == 1, Bytes(32)),
    )
    names = [part.name for part in frame.subcons]
    covered = names[names.index("safety") + 1 : names.index("tail_crc")]
    return Checksummed(frame, "tail_crc", CRC, over=covered)


def longest(lasers: int, unit: int) -> int:
    """The length of a packet with all that there can be, and so many bytes for each channel."""
    return 12 + BLOCKS * (2 + unit * lasers) + 4 + 17 + 26 + 4 + 22 + 4 + 32


def plausible(f: Fields) -> Any:
    """One to three returns, a unit, and azimuths below 360 degrees."""
    return (f.dis_unit >= 1) & (f.return_count >= 1) & (f.return_count <= 3) & (f.body.blocks.azimuth < 360)


#: findings of the kit that hold for these packets.
ACKNOWLEDGED = {"LS205": "as found on a captured stream: header, version of the safety part and signature are under no CRC"}


def distance(f: Fields) -> Any:
    """Metres, (n, blocks, lasers), by the unit that the header states."""
    return f.body.blocks.channels.distance * (f.dis_unit * 0.001)


def in_body(values: dict[str, Any], *, confidence: bool, status_version: int = 0) -> dict[str, Any]:
    """The values of a simulated packet with single return and a sequence: of its header, and these, its azimuths in the body."""
    flags = {"flags.sequence": 1, "flags.confidence": int(confidence)}
    header = {"status_version": status_version, "first_return": 1, "dis_unit": USUAL_UNIT, "return_count": 1, **flags}
    return {**header, **{name.replace("blocks.", "body.blocks."): value for name, value in values.items()}}
