"""Hesai JT16: 16 channels over a serial line.

A packet of 80 bytes contains the points of one azimuth, and a packet of 34 bytes contains an IMU
sample:

    EE FF 01 08  time_version  00 | date, microseconds
        | azimuth, 16 x (distance, reflectivity), dirt, state, sequence | CRC
    EE FF 01 08  time_version  01 | date, microseconds
        | acceleration, rate, sequence | CRC

No captured packet was available. The azimuths per revolution and the rotation speed are not public.
The simulation has 600 azimuths per revolution, as in the vendor's code, and makes 5 revolutions a
second. The axes of the IMU are not documented, so its samples are available as fields only.

Commands are not supported: they use a second line (RS232, 9600 baud), and contain random numbers.
The angles of a sensor come from a correction file.

Source: HesaiLidar_SDK_2.0 (udp_protocol_v1_8.h, udp1_8_parser.cc: fields, steps of 4 mm, angles,
CRC; serial_source.cc: lengths; parameter_introduction.md: 3,125,000 baud; JT16 correction file).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Int16sl, Int16ul, Int32ul, Struct

from lidarspec.spec import (
    Checksummed,
    Fields,
    Frame,
    OnWrap,
    PacketCounter,
    Polar,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    ZeroPadded,
)
from lidarspec_hesai.calibration import Calibration, configure, make_nominal_table
from lidarspec_hesai.crc_packets import CRC
from lidarspec_hesai.parts import CLOCK, UTC, rotation_values

CHANNELS = 16
BLOCKS_PER_TURN = 600
RATE_HZ = 5.0

ELEVATION = (
    0.60366, 3.32389, 6.01037, 8.64237, 11.27961, 13.92824, 16.57279, 19.21504,
    21.918, 24.56885, 27.21406, 29.88939, 32.52066, 35.22156, 37.91053, 40.66427,
)  # fmt: skip
AZIMUTH = (
    193.33747, 193.36131, 193.34482, 193.41829, 193.47669, 193.46605, 193.60451, 193.77519,
    187.86962, 187.84975, 187.85431, 187.85183, 187.65341, 187.80239, 187.84902, 187.77156,
)  # fmt: skip


def make_packet(data_type: int, *body: Any) -> Struct:
    """Return the struct of a packet of this type."""
    return Struct(
        "sync" / Const(b"\xee\xff\x01\x08"),
        "time_version" / Int8ul,
        "data_type" / Const(data_type, Int8ul),
        "utc" / UTC,
        "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time since the date and time in `utc`",
        *body,
        "crc" / Int32ul,
    )


DATA = Checksummed(
    make_packet(
        0,
        "azimuth" / Scaled(Int16ul, 0.01, "deg"),
        "channels"
        / Array(
            CHANNELS,
            Struct(
                "distance" / Scaled(Int16ul, 0.004, "m") * "0: no return", "reflectivity" / Int8ul
            ),
        ),
        "dirt"
        / Int32ul
        * "soiling of the window, two bits per channel; the first channel is in the lowest bits",
        "unit_state" / Int8ul,
        "reserved_id"
        / Int8ul
        * "selects the content of `reserved_info`; 12 to 15: software version; 16 to 19: hardware"
        " version",
        "reserved_info" / Int16ul,
        "sequence" / Int16ul,
    ),
    "crc",
    CRC,
)
IMU = Checksummed(
    make_packet(
        1,
        "acceleration"
        / Array(3, Scaled(Int16sl, 1 / 8192, "g"))
        * "x, y, z of the sensor's IMU; its axes are not documented",
        "rate" / Array(3, Scaled(Int16sl, 1 / 32.8, "deg/s")),
        "sequence" / Int16ul,
    ),
    "crc",
    ZeroPadded(CRC, 4),
)


def points(f: Fields, channels: Calibration) -> Polar:
    """Return the points of one azimuth, all at the packet's time."""
    return Polar(
        range=f.channels.distance,
        azimuth=-np.deg2rad(f.azimuth + channels.azimuth),
        elevation=np.deg2rad(channels.elevation),
        intensity=f.channels.reflectivity,
        ring=np.arange(CHANNELS),
        nominal=channels.nominal,
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i."""
    values = rotation_values(i, 1, BLOCKS_PER_TURN, RATE_HZ)
    date_and_time = {
        name: value
        for name, value in values.items()
        if name == "timestamp" or name.startswith("utc.")
    }
    return {
        **date_and_time,
        "azimuth": float(values["blocks.azimuth"][0]),
        "sequence": i % (1 << 16),
    }


TABLE = make_nominal_table(ELEVATION, AZIMUTH, np.zeros(CHANNELS))

JT16 = Sensor(
    "hesai-jt16",
    vendor="Hesai",
    model="JT16",
    frames={
        "data": Frame(DATA, data=True, plausible=lambda f: f.azimuth < 360),
        "imu": Frame(IMU, simulation=Simulation(rate=100)),
    },
    points=partial(points, channels=TABLE),
    scan=OnWrap("azimuth"),
    links={"data": Serial(3_125_000)},
    clock=CLOCK,
    sequence=PacketCounter("sequence"),
    simulation=Simulation(sweep),
    configure=partial(configure, points, TABLE),
    range_limits=(0.0, 262.14),  # the limits of the field
    vendor_axes=("right", "forward", "up"),
    status="manual",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_v1_8.h, udp1_8_parser.cc, JT16 correction file);"
        " not tested with packets of this model"
    ),
)
