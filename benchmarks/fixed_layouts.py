"""Frames of sensors with variable layouts, declared with every field at a fixed offset.

They have no variable parts, counts or conditions, and can parse only the frames of one workload.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Construct,
    Float32b,
    Float32l,
    Int8ub,
    Int8ul,
    Int16ub,
    Int16ul,
    Int32sb,
    Int32ub,
    Int32ul,
    Int64ul,
    Struct,
)

import lidarspec as ls
from lidarspec.spec import (
    Checksummed,
    Clock,
    Fields,
    Frame,
    OnChange,
    Polar,
    Scaled,
    Sensor,
    Tcp,
    Udp,
    Xor,
)
from lidarspec_livox import points as livox, sdk2
from lidarspec_sick import compact, telegrams


def make_sensor(
    struct: Construct, points: Any, size: int, *, scan: str, clock: str, stream: bool = False
) -> Sensor:
    """Return a sensor with frames of this size alone."""
    return Sensor(
        "fixed-places",
        vendor="Fixed",
        model="Places",
        frames={"data": Frame(struct, data=True, max_length=size)},
        points=points,
        scan=OnChange(scan),
        clock=Clock(clock),
        links={"data": Tcp(2112) if stream else Udp(2115)},
        range_limits=(0.05, 100.0),
        status="manual",
        source="the plugins of the same sensors",
    )


def compact_telegram(sensor: ls.Sensor, frame: bytes) -> Sensor:
    """Return a telegram of one module, as `lidarspec_sick.compact` has it."""
    (module,) = sensor.parse(frame).modules
    layers = module.layer_count
    beams = module.beam_count
    echoes = module.echo_count
    echo = Struct("distance" / Scaled(Int16ul, 0.001, "m"), "strength" / Int16ul)
    azimuth = "azimuth" / Scaled(
        Int16ul,
        compact.AZIMUTH_STEP_RAD,
        "rad",
        -compact.ZERO_AZIMUTH_STEPS * compact.AZIMUTH_STEP_RAD,
    )
    beam = Struct("echoes" / Array(echoes, echo), "property" / compact.PROPERTY, azimuth)
    struct = Struct(
        compact.MAGIC,
        "command" / Const(1, Int32ul),
        "counter" / Int64ul,
        "sent" / Scaled(Int64ul, 1, "us"),
        "version" / Const(4, Int32ul),
        "size" / Int32ul,
        "segment" / Int64ul,
        "turn" / Int64ul,
        "sender" / Int32ul,
        "layer_count" / Const(layers, Int32ul),
        "beam_count" / Const(beams, Int32ul),
        "echo_count" / Const(echoes, Int32ul),
        *(name / Array(layers, Scaled(Int64ul, 1, "us")) for name in ("start_time", "stop_time")),
        *(
            name / Array(layers, Scaled(Float32l, 1, "rad"))
            for name in ("elevation", "first_azimuth", "last_azimuth")
        ),
        "scale" / Float32l,
        "next_size" / Int32ul,
        "available" / Int8ul,
        "echo_content" / Int8ul,
        "beam_content"
        / BitStruct(
            "reserved" / BitsInteger(6),
            "has_azimuth" / BitsInteger(1),
            "has_property" / BitsInteger(1),
        ),
        "reserved" / Int8ul,
        "beams" / Array(beams, Array(layers, beam)),
        "crc" / Int32ul,
    )
    checksummed = Checksummed(struct, field="crc", algorithm=compact.CRC)
    return make_sensor(
        checksummed,
        partial(compact.points, version=4),
        len(frame),
        scan="turn",
        clock="start_time[0]",
    )


def cola_telegram(sensor: ls.Sensor, frame: bytes) -> Sensor:
    """Return a sensor with a CoLa B telegram of DIST1 and RSSI1 in 16 bits.

    The struct follows `lidarspec_sick.telegrams`.
    """
    beams = sensor.parse(frame).dist1.count

    def channel(content: bytes, values: Construct) -> Struct:
        angles = ("start" / Scaled(Int32sb, 1e-4, "deg"), "step" / Scaled(Int16ub, 1e-4, "deg"))
        factors = ("scale" / Float32b, "offset" / Float32b)
        return Struct(
            "content" / Const(content),
            *factors,
            *angles,
            "count" / Const(beams, Int16ub),
            "samples" / Array(beams, values),
        )

    content = (
        "kind" / Bytes(3),
        "method" / Const(b" LMDscandata "),
        "device" / Bytes(10),
        "telegram_counter" / Int16ub,
        "scan_counter" / Int16ub,
        "time" / Scaled(Int32ub, 1, "us"),
        "rates" / Bytes(18),
        "channels" / Const(2, Int32ub),  # behind no encoders
        "dist1" / channel(b"DIST1", telegrams.DISTANCE),
        "rssi1" / channel(b"RSSI1", Int16ub),
        "nothing" / Const(bytes(12)),
    )
    struct = Struct(
        "magic" / Const(b"\x02\x02\x02\x02"),
        "length" / Const(len(frame) - 9, Int32ub),
        *content,
        "checksum" / Int8ub,
    )
    checksummed = Checksummed(
        struct, field="checksum", algorithm=Xor(), over=tuple(part.name for part in content)
    )

    def points(f: Fields) -> Polar:
        first = f.dist1
        second = f.rssi1
        return Polar(
            range=first.samples * first.scale + first.offset * 0.001,
            azimuth=np.deg2rad(
                first.start - telegrams.AHEAD_DEG + first.step * first.samples.index
            ),
            intensity=(second.samples * second.scale + second.offset).on("dist1.samples"),
            invalid=first.samples < telegrams.MIN_DISTANCE_M,
        )

    return make_sensor(
        checksummed, points, len(frame), scan="telegram_counter", clock="time", stream=True
    )


def livox_packet(sensor: ls.Sensor, frame: bytes) -> Sensor:
    """Return a packet of points in millimetres, as `lidarspec_livox.sdk2` has it."""
    shots = sensor.parse(frame).dot_num
    points = "points" / Array(shots, Struct(*livox.MILLIMETRES, livox.REFLECTIVITY, livox.TAG))
    struct = Struct(
        "version" / Const(0, Int8ul),
        "length" / Const(len(frame), Int16ul),
        "time_interval" / Scaled(Int16ul, 1e-7, "s"),
        "dot_num" / Const(shots, Int16ul),
        "udp_cnt" / Int16ul,
        "frame_cnt" / Int8ul,
        "data_type" / Const(1, Int8ul),
        "time_type" / Int8ul,
        "pack_info" / Int8ul,
        "reserved" / Bytes(11),
        "crc32" / Int32ul,
        "timestamp" / Scaled(Int64ul, 1, "ns"),
        points,
    )
    checksummed = Checksummed(
        struct, field="crc32", algorithm=sdk2.CRC32, over=("timestamp", "points"), absent=(0,)
    )
    return make_sensor(
        checksummed,
        lambda f: livox.cartesian(f, sdk2.point_times(f)),
        len(frame),
        scan="frame_cnt",
        clock="timestamp",
    )
