"""Seyond (formerly Innovusion) Falcon: a forward-looking lidar over UDP.

A packet has a header and `count` blocks of four channels, in spherical coordinates. A field has one
byte, unless its size is given in parentheses:

* header: 6A 17, major, minor, sequence(2), checksum(4), size(4), source, type, start of the
  frame(8), mode, status, frame(8), part(2), packet(2), item type, count(3), item size(2), topic(4),
  flags(2), region(4), and from version 2 on reserved(16);
* block: the angles of the first channel, and the differences to the angles of the other
  channels(17); then 4 points, or 8 points with two returns, of 4 bytes each.

The checksum is not verified, because the parameters of the CRC are not public. The vendor's SDK
moves the points by some centimetres according to a table, which this module does not use. The
number of blocks per packet and the simulated pattern are assumed.

Source: Innovusion SDK 3.102, inno_lidar_packet.h (fields, units, bits) and
inno_lidar_packet_utils.h (angles of the channels); its ROS driver (port 8010); data sheet of the
Falcon K (120 by 25 degrees, 500 m). No captured packet was available.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    ByteSwapped,
    Const,
    Enum,
    Float64l,
    If,
    Int8ul,
    Int16sl,
    Int16ul,
    Int24ul,
    Int32ul,
    Int64ul,
    Struct,
    this,
)

from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    OnChange,
    Polar,
    Scaled,
    Sensor,
    Simulation,
    Udp,
    hookimpl,
)

ANGLE_UNIT_RAD = np.pi / 32768
CHANNELS = 4
CHANNEL_STEP_UNITS = 196  # elevation from channel to channel, before the differences are added
MAX_DATAGRAM_BYTES = 1472
HEADER_1_BYTES = 54  # header of version 1
HEADER_2_BYTES = 70  # header from version 2 on
BLOCK_HEADER_BYTES = 17
POINT_BYTES = 4
#: The size of a block in bytes, by the number of returns.
BLOCK_BYTES = {
    1: BLOCK_HEADER_BYTES + CHANNELS * POINT_BYTES,
    2: BLOCK_HEADER_BYTES + 2 * CHANNELS * POINT_BYTES,
}
SIMULATED_PACKETS = 60  # of a scan
SIMULATED_LINES = 12  # of a scan
SIMULATED_RATE_HZ = 10  # scans per second
SIMULATED_START_S = 1.7e9  # time of the first scan since 1970


def make_difference(name: str, bits: int) -> Any:
    """Return the field of the angle from the first channel to another channel."""
    return name / Scaled(BitsInteger(bits, signed=True), ANGLE_UNIT_RAD, "rad")


BLOCK_HEADER = (
    "angle"
    / Scaled(Int16sl, ANGLE_UNIT_RAD, "rad")
    * "horizontal angle of the first channel: 0 ahead, positive to the right",
    "tilt" / Scaled(Int16sl, ANGLE_UNIT_RAD, "rad") * "vertical angle, positive upwards",
    "after" / Scaled(Int16ul, 1e-5, "s") * "time since the start of the frame",
    "line_index" / Int16ul,
    "more"
    / ByteSwapped(
        BitStruct(
            "reserved" / BitsInteger(2),
            "facet" / BitsInteger(3),
            "region" / Enum(BitsInteger(2), sparse=0, slow=1, centre=3),
            *(
                make_difference(f"tilt_{channel}", bits)
                for channel, bits in ((3, 9), (2, 9), (1, 8))
            ),
            *(
                make_difference(f"angle_{channel}", bits)
                for channel, bits in ((3, 11), (2, 10), (1, 9))
            ),
            "line" / BitsInteger(9),
        )
    ),
)
PIXEL = ByteSwapped(
    BitStruct(
        "elongation" / BitsInteger(4),
        "type" / Enum(BitsInteger(2), normal=0, ground=1, fog=2),
        "second" / BitsInteger(1) * "1: second return",
        "strength" / BitsInteger(8) * "reflectance or intensity, see `flags`; 255: a reflector",
        "radius"
        / Scaled(BitsInteger(17), 0.005, "m")
        * "0: no return; if `long` is 1, the radius is twice this value",
    )
)


def make_packet(returns: int) -> Struct:
    """Return the struct of a packet with this number of returns per channel."""
    return Struct(
        "magic" / Const(b"\x6a\x17"),
        "major" / Int8ul,
        "minor" / Int8ul,
        "firmware_sequence" / Int16ul,
        "checksum" / Int32ul * "not checked: the vendor's header does not name the CRC",
        "size" / Int32ul,
        "source"
        / BitStruct(
            "time_type" / BitsInteger(4),
            "number" / BitsInteger(4) * "number of the lidar",
        ),
        "lidar_type" / Int8ul,
        "start" / Scaled(Float64l, 1e-6, "s") * "time of the start of the frame, since 1970",
        "mode" / Int8ul,
        "unit_status" / Int8ul,
        "frame" / Int64ul,
        "part" / Int16ul * "index of the packet within the frame",
        "packet" / Int16ul,
        "item_type" / Const(1, Int8ul) * "spherical points",
        "count" / Int24ul,
        "item_size" / Const(BLOCK_BYTES[returns], Int16ul),
        "topic" / Int32ul,
        "flags"
        / ByteSwapped(
            BitStruct(
                "reserved" / BitsInteger(2),
                "long" / BitsInteger(1) * "1: all radii are twice the sent values",
                "last_four" / BitsInteger(1),
                "first_part" / BitsInteger(1),
                "locked" / BitsInteger(1),
                "tail" / BitsInteger(1),
                "last_packet" / BitsInteger(1),
                "last_part" / BitsInteger(1),
                "confidence" / BitsInteger(2),
                "returns"
                / Enum(BitsInteger(3), single=1, two_strongest=2, strongest_and_farthest=3),
                "reflectance"
                / BitsInteger(1)
                * "1: `strength` is the reflectance; 0: `strength` is the intensity",
                "upwards" / BitsInteger(1),
            )
        ),
        "region_angle" / Scaled(Int16sl, ANGLE_UNIT_RAD, "rad"),
        "region_tilt" / Scaled(Int16sl, ANGLE_UNIT_RAD, "rad"),
        "extended" / If(this.major >= 2, Bytes(HEADER_2_BYTES - HEADER_1_BYTES)),
        "blocks"
        / Array(this.count, Struct(*BLOCK_HEADER, "pixels" / Array(returns * CHANNELS, PIXEL))),
    )


def plausible(f: Fields) -> Any:
    """Return whether the size is consistent with block count, header and datagram."""
    header = np.where(f.major >= 2, HEADER_2_BYTES, HEADER_1_BYTES)
    return (
        (f.count >= 1) & (f.count * f.item_size + header == f.size) & (f.size <= MAX_DATAGRAM_BYTES)
    )


def points(f: Fields) -> Polar:
    """Return the points of blocks of four channels, with one or two returns."""
    block = f.blocks
    pixels = f.blocks.pixels
    differences = f.blocks.more
    channel = pixels.index % CHANNELS
    angle, tilt = (
        np.where(
            channel == 0, 0, np.where(channel == 1, first, np.where(channel == 2, second, third))
        )
        for first, second, third in (
            (differences.angle_1, differences.angle_2, differences.angle_3),
            (differences.tilt_1, differences.tilt_2, differences.tilt_3),
        )
    )
    return Polar(
        range=pixels.radius * np.where(f.flags.long == 1, 2, 1),
        azimuth=-(block.angle + angle),
        elevation=block.tilt + tilt + channel * CHANNEL_STEP_UNITS * ANGLE_UNIT_RAD,
        intensity=pixels.strength,
        time=block.after - f.blocks[0].after,
        ring=channel,
        return_index=pixels.second,
    )


def sweep(i: int, returns: int = 1) -> dict[str, Any]:
    """Return the simulated values of packet i."""
    count = (MAX_DATAGRAM_BYTES - HEADER_2_BYTES) // BLOCK_BYTES[returns]
    block_index = i % SIMULATED_PACKETS * count + np.arange(count)
    per_line = SIMULATED_PACKETS * count // SIMULATED_LINES
    return {
        "major": 2,
        "size": HEADER_2_BYTES + count * BLOCK_BYTES[returns],
        "start": SIMULATED_START_S + i // SIMULATED_PACKETS / SIMULATED_RATE_HZ,
        "frame": i // SIMULATED_PACKETS,
        "packet": i % SIMULATED_PACKETS,
        "count": count,
        "flags.returns": returns,
        "flags.locked": 1,
        "blocks.angle": np.deg2rad(block_index % per_line * 120 / per_line - 60),
        "blocks.tilt": np.deg2rad(12.5 - (block_index // per_line + 1) * 25 / SIMULATED_LINES),
        "blocks.after": np.round(block_index / (SIMULATED_PACKETS * count * SIMULATED_RATE_HZ), 5),
        "blocks.more.line": block_index // per_line,
        "blocks.pixels.second": np.tile(np.repeat(np.arange(returns), CHANNELS), (count, 1)),
    }


def make_frame(returns: int) -> Frame:
    """Return the data frame with this number of returns per channel."""
    return Frame(
        make_packet(returns),
        data=True,
        max_length=MAX_DATAGRAM_BYTES,
        plausible=plausible,
        simulation=Simulation(partial(sweep, returns=returns)),
        acknowledged={
            "LS506": "a frame consists of lines, each of which begins on the left",
        },
    )


FALCON = Sensor(
    "seyond-falcon",
    vendor="Seyond",
    model="Falcon",
    frames={"data": make_frame(1), "data_dual": make_frame(2)},
    points=points,
    scan=OnChange("frame"),
    links={"data": Udp(8010)},
    # "epoch time" in the vendor's header. The type of time is `source.time_type`, but the
    # meaning of its values is not public.
    clock=Clock(lambda f: (f.start, f.blocks[0].after), epoch="utc"),
    range_limits=(0.1, 500.0),
    turn=(5.0, 20.0),
    # two strongest, or strongest and farthest, by the field flags.returns
    returns=("strongest", "varying"),
    vendor_axes=("up", "right", "forward"),
    status="manual",
    source=(
        "Innovusion SDK 3.102 (inno_lidar_packet.h, inno_lidar_packet_utils.h); not tested"
        " with packets"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Seyond sensor."""
    return [FALCON]
