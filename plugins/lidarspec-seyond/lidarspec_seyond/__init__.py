"""Seyond (once Innovusion) Falcon: a lidar that looks ahead, over UDP, with blocks of four channels
in spherical coordinates.

    6A 17 major minor, sequence(2) | checksum(4) size(4) source type | start of the frame(8) mode
    status frame(8) part(2) packet(2) | item type, count(3) item size(2) topic(4) flags(2) region(4)
    [reserved(16), from version 2] count x [angles and their differences, 17 bytes, 4 points of 4
    bytes, or 8 with two returns]

What the checksum covers is public, which CRC it is is not: it is not held. The vendor's SDK moves
points by some centimetres beside the axis, by a table of its own, which is left out. How many
blocks a packet holds, and the pattern of a simulated one, are assumed.

Source: Innovusion SDK 3.102, inno_lidar_packet.h (fields, units, bits) and
inno_lidar_packet_utils.h (angles of the channels); its ROS driver (port 8010); data sheet of the
Falcon K (120 by 25 degrees, 500 m). No packet of a sensor was seen.
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

UNIT = np.pi / 32768  # of angles
CHANNELS = 4
APART = 196  # units from channel to channel, to which their own differences are added
DATAGRAM = 1472
SHORT = 54
HEADER = 70
BLOCK = 17
POINT = 4  # bytes: header of version 1 and from 2 on, head of a block, point
SIZE = {1: BLOCK + CHANNELS * POINT, 2: BLOCK + 2 * CHANNELS * POINT}  # of a block, by the returns
PACKETS = 60
LINES = 12  # of a simulated frame
RATE = 10
START = 1.7e9  # seconds since 1970 of a simulated frame


def difference(name: str, bits: int) -> Any:
    """What the angle of a channel adds to that of the first."""
    return name / Scaled(BitsInteger(bits, signed=True), UNIT, "rad")


HEAD = (
    "angle"
    / Scaled(Int16sl, UNIT, "rad")
    * "horizontal, of the first channel: 0 ahead, to the right positive",
    "tilt" / Scaled(Int16sl, UNIT, "rad") * "vertical: up positive",
    "after" / Scaled(Int16ul, 1e-5, "s") * "the start of the frame",
    "line_index" / Int16ul,
    "more"
    / ByteSwapped(
        BitStruct(
            "reserved" / BitsInteger(2),
            "facet" / BitsInteger(3),
            "region" / BitsInteger(2) * "0 sparse, 1 slow, 3 the centre",
            *(difference(f"tilt_{channel}", bits) for channel, bits in ((3, 9), (2, 9), (1, 8))),
            *(difference(f"angle_{channel}", bits) for channel, bits in ((3, 11), (2, 10), (1, 9))),
            "line" / BitsInteger(9),
        )
    ),
)
PIXEL = ByteSwapped(
    BitStruct(
        "elongation" / BitsInteger(4),
        "type" / BitsInteger(2) * "0 normal, 1 ground, 2 fog",
        "second" / BitsInteger(1) * "1: second return",
        "strength" / BitsInteger(8) * "reflectance or intensity, by the flags; 255: a reflector",
        "radius"
        / Scaled(BitsInteger(17), 0.005, "m")
        * "twice that with long distances; 0: no return",
    )
)


def packet(returns: int) -> Struct:
    """Return the packet with so many returns."""
    return Struct(
        "magic" / Const(b"\x6a\x17"),
        "major" / Int8ul,
        "minor" / Int8ul,
        "firmware_sequence" / Int16ul,
        "checksum" / Int32ul * "not checked: the vendor's header does not say which CRC it is",
        "size" / Int32ul,
        "source" / Int8ul * "number of the lidar below, kind of time above",
        "lidar_type" / Int8ul,
        "start" / Scaled(Float64l, 1e-6, "s") * "of the frame, since 1970",
        "mode" / Int8ul,
        "unit_status" / Int8ul,
        "frame" / Int64ul,
        "part" / Int16ul * "of the frame",
        "packet" / Int16ul,
        "item_type" / Const(1, Int8ul) * "spherical points",
        "count" / Int24ul,
        "item_size" / Const(SIZE[returns], Int16ul),
        "topic" / Int32ul,
        "flags"
        / ByteSwapped(
            BitStruct(
                "reserved" / BitsInteger(2),
                "long" / BitsInteger(1) * "1: long distances",
                "last_four" / BitsInteger(1),
                "first_part" / BitsInteger(1),
                "locked" / BitsInteger(1),
                "tail" / BitsInteger(1),
                "last_packet" / BitsInteger(1),
                "last_part" / BitsInteger(1),
                "confidence" / BitsInteger(2),
                "returns"
                / BitsInteger(3)
                * "1 one, 2 the two strongest, 3 the strongest and the farthest",
                "reflectance" / BitsInteger(1) * "1: strength is reflectance, else intensity",
                "upwards" / BitsInteger(1),
            )
        ),
        "region_angle" / Scaled(Int16sl, UNIT, "rad"),
        "region_tilt" / Scaled(Int16sl, UNIT, "rad"),
        "extended" / If(this.major >= 2, Bytes(HEADER - SHORT)),
        "blocks" / Array(this.count, Struct(*HEAD, "pixels" / Array(returns * CHANNELS, PIXEL))),
    )


def plausible(f: Fields) -> Any:
    """As long as it says, with as many returns, and no more blocks than a datagram takes."""
    header = np.where(f.major >= 2, HEADER, SHORT)
    return (f.count >= 1) & (f.count * f.item_size + header == f.size) & (f.size <= DATAGRAM)


def points(f: Fields) -> Polar:
    """Blocks of four channels, of which the second return stands behind the first."""
    block = f.blocks
    pixels = f.blocks.pixels
    more = f.blocks.more
    channel = pixels.index % CHANNELS
    angle, tilt = (
        np.where(channel == 0, 0, np.where(channel == 1, one, np.where(channel == 2, two, three)))
        for one, two, three in (
            (more.angle_1, more.angle_2, more.angle_3),
            (more.tilt_1, more.tilt_2, more.tilt_3),
        )
    )
    return Polar(
        range=pixels.radius * np.where(f.flags.long == 1, 2, 1),
        azimuth=-(block.angle + angle),
        elevation=block.tilt + tilt + channel * APART * UNIT,
        intensity=pixels.strength,
        time=block.after - f.blocks[0].after,
        ring=channel,
        return_index=pixels.second,
    )


def sweep(i: int, returns: int = 1) -> dict[str, Any]:
    """Return the values of packet i.

    Lines of 120 degrees, with four channels each, run from the top to the bottom of 25 degrees.
    """
    count = (DATAGRAM - HEADER) // SIZE[returns]
    spot = i % PACKETS * count + np.arange(count)
    per_line = PACKETS * count // LINES
    return {
        "major": 2,
        "size": HEADER + count * SIZE[returns],
        "start": START + i // PACKETS / RATE,
        "frame": i // PACKETS,
        "packet": i % PACKETS,
        "count": count,
        "flags.returns": returns,
        "flags.locked": 1,
        "blocks.angle": np.deg2rad(spot % per_line * 120 / per_line - 60),
        "blocks.tilt": np.deg2rad(12.5 - (spot // per_line + 1) * 25 / LINES),
        "blocks.after": np.round(spot / (PACKETS * count * RATE), 5),
        "blocks.more.line": spot // per_line,
        "blocks.pixels.second": np.tile(np.repeat(np.arange(returns), CHANNELS), (count, 1)),
    }


def frame(returns: int) -> Frame:
    """Return the data frame with so many returns."""
    return Frame(
        packet(returns),
        data=True,
        max_length=DATAGRAM,
        plausible=plausible,
        simulation=Simulation(partial(sweep, returns=returns)),
        acknowledged={
            "LS506": "a frame is lines, each of which begins on the left",
        },
    )


FALCON = Sensor(
    "seyond-falcon",
    vendor="Seyond",
    model="Falcon",
    frames={"data": frame(1), "data_dual": frame(2)},
    points=points,
    scan=OnChange("frame"),
    links={"data": Udp(8010)},
    clock=Clock(lambda f: (f.start, f.blocks[0].after)),
    range_limits=(0.1, 500.0),
    turn=(5.0, 20.0),
    vendor_axes=("up", "right", "forward"),
    status="manual",
    source=(
        "Innovusion SDK 3.102 (inno_lidar_packet.h, inno_lidar_packet_utils.h); no packet of a"
        " sensor was seen"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Seyond sensor."""
    return [FALCON]
