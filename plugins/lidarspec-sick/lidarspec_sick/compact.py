"""multiScan100 and picoScan100: compact telegrams over UDP with scans or IMU samples.

A telegram contains one or more modules, and one CRC over all of them. Each module declares its
numbers of layers, beams and echoes. The azimuths are sent for each beam, or are evenly spaced
between the azimuths of the first and the last beam. The sent elevations are positive downwards. If
bit 0 of a beam's property is 1, the beam has hit a reflector.

Source: sick_scan_xd (compact_parser.cpp and its unit tests) for the layout of versions 3 and 4;
multiScan136 operating instructions 8027119 for segments and layers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Const,
    Construct,
    Float32l,
    If,
    Int8ul,
    Int16ul,
    Int32ul,
    Int64ul,
    Struct,
    this,
)

from lidarspec.spec import (
    Checksummed,
    Clock,
    Crc,
    Fields,
    Frame,
    Imu,
    OnChange,
    PacketCounter,
    Parts,
    Polar,
    Scaled,
    Sensor,
    Simulation,
    Udp,
)

CRC = Crc(
    32, 0x04C11DB7, init=0xFFFFFFFF, refin=True, refout=True, xorout=0xFFFFFFFF, order="little"
)
MAGIC = "magic" / Const(b"\x02\x02\x02\x02")
#: Maximum size of a telegram. For a multiScan136, the 900 beams of a segment with three echoes each
#: need 14,160 bytes.
MAX_TELEGRAM_BYTES = 16_384
AZIMUTH_STEP_RAD = 1 / 5215
ZERO_AZIMUTH_STEPS = 16_384  # the azimuth straight ahead on the wire
SIMULATED_SPEED_HZ = 20.0  # revolutions per second


PROPERTY = BitStruct("reserved" / BitsInteger(7), "reflector" / BitsInteger(1))


def make_module(version: int) -> Struct:
    """Return the struct of a module in telegrams of version 3 or 4."""
    azimuth = "azimuth" / If(
        this._.beam_content.has_azimuth == 1,
        Scaled(Int16ul, AZIMUTH_STEP_RAD, "rad", -ZERO_AZIMUTH_STEPS * AZIMUTH_STEP_RAD),
    )
    properties = "property" / If(this._.beam_content.has_property == 1, PROPERTY)
    echo = Struct(
        "distance" / If(this._._.echo_content.has_distance == 1, Scaled(Int16ul, 0.001, "m")),
        "strength" / If(this._._.echo_content.has_strength == 1, Int16ul),
    )
    beam = Struct(
        "echoes" / Array(this._.echo_count, echo),
        *((properties, azimuth) if version == 4 else (azimuth, properties)),
    )
    return Struct(
        "segment" / Int64ul,
        "turn" / Int64ul,
        "sender" / Int32ul,
        "layer_count" / Int32ul,
        "beam_count" / Int32ul,
        "echo_count" / Int32ul,
        "start_time" / Array(this.layer_count, Scaled(Int64ul, 1, "us")),
        "stop_time" / Array(this.layer_count, Scaled(Int64ul, 1, "us")),
        "elevation" / Array(this.layer_count, Scaled(Float32l, 1, "rad")) * "positive downwards",
        "first_azimuth" / Array(this.layer_count, Scaled(Float32l, 1, "rad")),
        "last_azimuth" / Array(this.layer_count, Scaled(Float32l, 1, "rad")),
        *(["scale" / Float32l] if version == 4 else []),
        "next_size" / Int32ul * "size of the next module in bytes; 0 in the last one",
        "available" / Int8ul,
        "echo_content"
        / BitStruct(
            "reserved" / BitsInteger(6),
            "has_strength" / BitsInteger(1),
            "has_distance" / BitsInteger(1),
        ),
        "beam_content"
        / BitStruct(
            "reserved" / BitsInteger(6),
            "has_azimuth" / BitsInteger(1),
            "has_property" / BitsInteger(1),
        ),
        "reserved" / Int8ul,
        "beams" / Array(this.beam_count, Array(this.layer_count, beam)),
    )


def make_telegram(version: int) -> Construct:
    """Return the struct of a scan telegram of version 3 or 4."""
    struct = Struct(
        MAGIC,
        "command" / Const(1, Int32ul),
        "counter" / Int64ul,
        "sent" / Scaled(Int64ul, 1, "us"),
        "version" / Const(version, Int32ul),
        "size" / Int32ul * "size of the first module in bytes",
        "modules" / Parts(make_module(version), size=this.size, following=this.next_size),
        "crc" / Int32ul,
    )
    return Checksummed(struct, field="crc", algorithm=CRC)


IMU = Checksummed(
    Struct(
        MAGIC,
        "command" / Const(2, Int32ul),
        "version" / Const(1, Int32ul),
        *(f"acceleration_{axis}" / Scaled(Float32l, 1, "m/s2") for axis in "xyz"),
        *(f"turning_{axis}" / Scaled(Float32l, 1, "rad/s") for axis in "xyz"),
        *(f"orientation_{axis}" / Float32l for axis in "wxyz"),
        "time" / Scaled(Int64ul, 1, "us"),
        "crc" / Int32ul,
    ),
    field="crc",
    algorithm=CRC,
)


def points(f: Fields, version: int) -> Polar:
    """Return the points of one module, beam by beam, with all layers and echoes."""
    beam = f.beams
    position = beam.index / np.maximum(f.beam_count - 1, 1)
    first = f.first_azimuth.on("beams[]")
    start = f.start_time.on("beams[]")
    even_azimuth = first + (f.last_azimuth.on("beams[]") - first) * position
    return Polar(
        range=beam.echoes.distance * (f.scale if version == 4 else 1.0),
        azimuth=np.where(f.beam_content.has_azimuth == 1, beam.azimuth, even_azimuth),
        elevation=-f.elevation.on("beams[]"),
        intensity=beam.echoes.strength,
        time=(start - f.start_time[0] + (f.stop_time.on("beams[]") - start) * position) * 1e-6,
        extra={"reflector": beam.property.reflector == 1},
    )


def imu(f: Fields) -> Imu:
    """Return angular rates and accelerations, including gravity."""
    return Imu(
        (f.turning_x, f.turning_y, f.turning_z),
        (f.acceleration_x, f.acceleration_y, f.acceleration_z),
    )


def sweep(
    i: int, version: int, elevations: tuple[float, ...], beams: int, segments: int
) -> dict[str, Any]:
    """Return the values of simulated telegram i: one segment, one module, one echo.

    Args:
        elevations: elevations of the layers in degrees.
        beams: beams per segment.
        segments: segments per revolution.
    """
    layers = len(elevations)
    begin = i / segments / SIMULATED_SPEED_HZ * 1e6
    width = 360 / segments
    azimuths = np.deg2rad(i % segments * width - 180 + np.arange(beams) * width / beams)
    module = {
        "segment": i % segments,
        "turn": i // segments,
        "layer_count": layers,
        "beam_count": beams,
        "echo_count": 1,
        "start_time": np.full(layers, begin),
        "stop_time": np.full(
            layers, begin + (beams - 1) / beams / segments / SIMULATED_SPEED_HZ * 1e6
        ),
        "elevation": -np.deg2rad(elevations),
        "first_azimuth": np.full(layers, azimuths[0]),
        "last_azimuth": np.full(layers, azimuths[-1]),
        **({"scale": 1.0} if version == 4 else {}),
        "echo_content.has_distance": 1,
        "echo_content.has_strength": 1,
        "beam_content.has_azimuth": 1,
        "beam_content.has_property": 1,
        "beams.azimuth": np.repeat(azimuths[:, None], layers, axis=1),
    }
    return {"counter": i, "sent": begin, "modules": [module]}


def make_scan_frame(version: int, sweep: Callable[..., Mapping[str, Any]]) -> Frame:
    """Return the frame of scan telegrams; `sweep` gives the simulated values."""
    read = {"modules": partial(points, version=version)}
    return Frame(
        make_telegram(version),
        data=True,
        max_length=MAX_TELEGRAM_BYTES,
        points=read,
        simulation=Simulation(partial(sweep, version=version)),
    )


IMU_FRAME = Frame(
    IMU,
    imu=imu,
    clock=Clock("time"),
    simulation=Simulation(lambda i: {"time": i * 10_000}, rate=100),
)
#: Id -> model, elevations of the layers in degrees, beams per segment, segments per revolution,
#: range limits in m, status.
MODELS: dict[str, tuple[str, tuple[float, ...], int, int, tuple[float, float], str]] = {
    "sick-multiscan136": (
        "multiScan136",
        tuple(np.linspace(22.5, -42.5, 16)),
        30,
        12,
        (0.05, 60),
        "capture",
    ),
    "sick-picoscan150": ("picoScan150", (0.0,), 300, 12, (0.05, 75), "manual"),
}


def make_scanner(name: str) -> Sensor:
    """Return the sensor of one row of `MODELS`."""
    model, elevations, beams, segments, limits, status = MODELS[name]
    simulated_sweep = partial(sweep, elevations=elevations, beams=beams, segments=segments)
    return Sensor(
        name,
        vendor="SICK",
        model=model,
        frames={
            "scan": make_scan_frame(4, simulated_sweep),
            "scan_v3": make_scan_frame(3, simulated_sweep),
            "imu": IMU_FRAME,
        },
        points=None,
        scan=OnChange("modules.turn"),
        # since 1970 if NTP or PTP has set it, otherwise since power-up: the telegrams do not report
        # which (sick_scan_xd, README, timestamps)
        clock=Clock("modules.start_time[0]", epoch="utc"),
        sequence=PacketCounter("counter"),
        links={"data": Udp(2115), "imu": Udp(7503)},
        range_limits=limits,
        relatives={
            other: "a module has a different number of layers in the two models"
            for other in MODELS
            if other != name
        },
        status=status,
        source=(
            "sick_scan_xd, compact_parser.cpp; 8027119 for segments. Assumed: ranges, scan"
            " rates, beams, elevations of simulated layers"
        ),
    )


COMPACT = [make_scanner(name) for name in MODELS]
