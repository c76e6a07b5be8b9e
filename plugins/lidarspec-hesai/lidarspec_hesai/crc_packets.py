"""Packets with three CRCs: over the blocks, over the functional safety part, and over the tail.

The models are QT128, Pandar128, OT128, JT128 and AT128.

    EE FF  major minor  status reserved | lasers blocks first_return dis_unit return_num flags
    2 x [azimuth, channels], CRC [, functional safety], tail [, sequence] [, IMU], CRC
    [, signature]

Source: HesaiLidar_SDK_2.0 (udp_protocol_v3_2.h, udp_protocol_v1_4.h). The bytes that each CRC
covers were found in a capture of a QT128. In packets of the other models, the CRCs probably cover
the same bytes. No captured packet confirms this, so the CRCs of these models are read but not
checked.
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
    Int16sl,
    Int16ul,
    Int32ul,
    Struct,
    this,
)

from lidarspec.spec import Checksummed, Crc, Fields, Scaled
from lidarspec_hesai.header_packets import SIMULATED_UNIT_MM

LASERS = 128
BLOCKS = 2
TWO_BLOCKS = Const(BLOCKS, Int8ul)
CRC = Crc(32, poly=0x04C11DB7, init=0xFFFFFFFF)  # CRC-32/MPEG-2

UNCHECKED_NOTE = "not checked: the covered bytes are unknown for this model"


def make_safety_part(crc: Construct) -> Construct:
    """Return the struct of the functional safety part."""
    return Struct(
        "version" / Int8ul,
        "status"
        / BitStruct(
            "state" / BitsInteger(3), "fault_type" / BitsInteger(2), "counter" / BitsInteger(3)
        ),
        "fault_number"
        / BitStruct(
            "count" / BitsInteger(4),
            "index" / BitsInteger(4) * "index of the fault in `fault_code`",
        ),
        "fault_code" / Int16ul,
        "reserved" / Bytes(8),
        "crc" / crc,
    )


SAFETY_CRC_FIELDS = ("status", "fault_number", "fault_code", "reserved")
FLAGS = BitStruct(
    "reserved" / BitsInteger(1),
    "environment" / BitsInteger(1),
    "weight" / BitsInteger(1),
    "confidence" / BitsInteger(1),
    "signature" / BitsInteger(1),
    "safety" / BitsInteger(1),
    "imu" / BitsInteger(1),
    "sequence" / BitsInteger(1),
)
IMU = Struct(
    "temperature" / Scaled(Int16sl, 0.01, "degC"),
    "acceleration_unit" / Int16ul * "step of `acceleration`, in millionths of g",
    "rate_unit" / Int16ul * "step of the angular rates, in hundredths of mdeg/s",
    "time" / Int32ul * "time of the sample, in steps of 25 ns",
    "acceleration" / Array(3, Int16sl) * "x, y, z of the sensor's IMU; its axes are not documented",
    "rate" / Array(3, Int16sl),
)


def make_packet(
    version: Sequence[Construct],
    channels: Construct,
    tail: Sequence[Construct],
    *,
    fine_azimuth: Construct | None = None,
    blocks: Construct = TWO_BLOCKS,
    imu: bool = False,
    safety: bool = True,
    verify_crc: bool = False,
) -> Construct:
    """Return the struct of a packet of a protocol version.

    Args:
        tail: the fields between functional safety and sequence.
        fine_azimuth: the construct of the fine azimuth, which is between azimuth and channels of a
            block; None if blocks have no fine azimuth.
        verify_crc: whether CRCs are verified, instead of being plain fields.
    """
    crc = Int32ul if verify_crc else Int32ul * UNCHECKED_NOTE
    fine_part = [] if fine_azimuth is None else ["fine_azimuth" / fine_azimuth]
    body = Struct(
        "blocks"
        / Array(
            this._.block_count,
            Struct("azimuth" / Scaled(Int16ul, 0.01, "deg"), *fine_part, "channels" / channels),
        ),
        "crc" / crc,
    )
    safety_part: list[Construct] = []
    if safety:
        safety_struct = make_safety_part(crc)
        if verify_crc:
            safety_struct = Checksummed(safety_struct, "crc", CRC, over=SAFETY_CRC_FIELDS)
        safety_part = ["safety" / If(this.flags.safety == 1, safety_struct)]
    imu_part = ["imu" / If(this.flags.imu == 1, IMU)] if imu else []
    # the tail CRC covers these parts
    covered = (*tail, "sequence" / If(this.flags.sequence == 1, Int32ul), *imu_part)
    frame = Struct(
        "sync" / Const(b"\xee\xff"),
        *version,
        "status_version"
        / Int8ul
        * "version of the tail; models with the same protocol version can have different tails",
        "header_reserved" / Bytes(1),
        "lasers" / Const(LASERS, Int8ul),
        "block_count" / blocks,
        "first_return" / Int8ul * "which return the first block of each firing contains",
        "dis_unit" / Scaled(Int8ul, 1, "mm") * "size of one distance step",
        "return_count" / Int8ul * "returns per firing; some models send the maximum number",
        "flags" / FLAGS,
        "body" / (Checksummed(body, "crc", CRC) if verify_crc else body),
        *safety_part,
        *covered,
        "tail_crc" / crc,
        "signature" / If(this.flags.signature == 1, Bytes(32)),
    )
    if not verify_crc:
        return frame
    return Checksummed(frame, "tail_crc", CRC, over=[part.name for part in covered])


def max_packet_bytes(blocks: int, block_bytes: int) -> int:
    """Return the size of a packet with all parts, in bytes.

    Args:
        blocks: the number of blocks.
        block_bytes: the size of one block.
    """
    return 12 + blocks * block_bytes + 4 + 17 + 32 + 4 + 22 + 4 + 32


def plausible(f: Fields) -> Any:
    """Return whether counts, unit and azimuths are in their ranges."""
    has_valid_counts = (
        (f.block_count >= 1) & (f.dis_unit >= 1) & (f.return_count >= 1) & (f.return_count <= 3)
    )
    return has_valid_counts & (f.body.blocks.azimuth < 360)


#: Findings of `lidarspec check` that apply to these packets.
UNSEEN = (
    "not tested with packets of this model; its CRCs are not checked, because it is unknown which"
    " bytes they cover"
)
ACKNOWLEDGED = {
    "LS205": (
        "in a captured stream, the CRCs do not cover the header, the version of the safety part"
        " and the signature"
    )
}


def distance(f: Fields) -> Any:
    """Return distances in metres, (n, blocks, lasers)."""
    return f.body.blocks.channels.distance * (f.dis_unit * 0.001)


def packet_values(values: dict[str, Any], **more: int) -> dict[str, Any]:
    """Return the values of a simulated packet with single return and the UDP sequence.

    Args:
        values: path of a field -> value. "blocks.x" is accepted as short for "body.blocks.x".
        more: further flags and fields of the header.
    """
    flags = {
        "flags.sequence": 1,
        **{
            f"flags.{name}": value
            for name, value in more.items()
            if name in ("confidence", "imu", "safety")
        },
    }
    header = {"first_return": 1, "dis_unit": SIMULATED_UNIT_MM, "return_count": 1, **flags}
    return {
        **header,
        **{name.replace("blocks.", "body.blocks."): value for name, value in values.items()},
    }
