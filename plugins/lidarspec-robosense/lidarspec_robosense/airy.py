"""RoboSense Airy: rotating lidar of 96 lasers from the horizon to the zenith over UDP, with an IMU.

A packet has pairs of blocks with 48 lasers each. Both blocks of a pair have the same azimuth, and
the first block has the lower half of the lasers. With dual return, two consecutive pairs have the
same azimuth.

Source: Airy user manual 1.3: Tables 8 to 13 and 32 (packets, angles, emission times), appendix C
(registers of DIFOP). From the vendor's rs_driver (decoder_RSAIRY.hpp): the optical centre, firing
times that depend on how the sensor is mounted, the bits of a distance, dual return, and the time in
a packet of the IMU.

The sources disagree about the axes. In the manual's formula, x is proportional to the sine of the
azimuth. In rs_driver, x is proportional to the cosine of the azimuth and y to its negative sine;
rs_driver uses these axes for all models. This module follows rs_driver. It is assumed that the
integers of the IMU are big-endian, like all other integers. With dual return, the order of the
blocks is assumed to be the order in rs_driver. Packets of models with 48 or 192 lasers
(`lidar_model` 1 or 3) are not accepted.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Enum,
    Float32b,
    Int8ub,
    Int16ub,
    Int32sb,
    Int32ub,
    Struct,
)

from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    Imu,
    PacketCounter,
    Polar,
    Scaled,
    Sensor,
    Simulation,
    Udp,
    following,
    take,
)
from lidarspec_robosense.rotor import (
    BLOCK_FLAG,
    COMMON,
    DIFOP_HEAD,
    DIFOP_TAIL,
    DIFOP_TIME,
    DIFOP_UNIT,
    FACTORY_SPEED_HZ,
    TEMPERATURE,
    TIME,
    RotorModel,
    laser_degrees,
    make_angles,
    make_clock_status,
    make_points,
    rotation_values,
    split_angles,
    sweep_difop,
)

AIRY_TYPE = 0x31
MODEL_96 = 2
DUAL = 3
BLOCKS = 8
HALF_LASERS = 48
IMU_RATE_HZ = 200  # factory setting (manual 4.4.4)
GRAVITY = 9.80665


def make_firing_times(*times: float) -> Any:
    """Return the firing time of each laser in seconds, (blocks, lasers).

    `times` has the firing time of each group of eight lasers in a pair of blocks, in microseconds.
    """
    return np.tile(np.repeat(times, 8).reshape(2, HALF_LASERS), (BLOCKS // 2, 1)) * 1e-6


# Table 32
UPRIGHT_DELAY_S = make_firing_times(
    0, 5.712, 12.376, 19.04, 25.704, 33.32, 41.888, 50.456, 59.024, 70.448, 81.872, 93.296
)
# rs_driver
SIDEWAYS_DELAY_S = make_firing_times(
    0, 11.424, 22.848, 34.272, 45.696, 54.264, 62.832, 71.4, 79.016, 85.68, 92.344, 99.008
)
AIRY_M_DELAY_S = make_firing_times(
    0, 7.616, 16.184, 24.752, 33.32, 42.84, 52.36, 61.88, 71.4, 79.968, 88.536, 97.104
)
# fmt: off
ELEVATION_DEG = np.array([  # Table 32
    -0.07, 0.88, 1.81, 2.76, 3.69, 4.62, 5.54, 6.48, 7.41, 8.34, 9.27, 10.21, 11.15, 12.09, 13.03, 13.98, 14.92, 15.87, 16.82, 17.77, 18.72,
    19.67, 20.62, 21.57, 22.51, 23.45, 24.4, 25.33, 26.28, 27.21, 28.15, 29.08, 30.02, 30.95, 31.88, 32.82, 33.74, 34.68, 35.62, 36.55,
    37.5, 38.43, 39.37, 40.31, 41.25, 42.21, 43.16, 44.09, 45.05, 46.0, 46.95, 47.9, 48.85, 49.8, 50.73, 51.69, 52.62, 53.56, 54.5, 55.45,
    56.37, 57.3, 58.24, 59.18, 60.12, 61.05, 61.99, 62.93, 63.86, 64.81, 65.76, 66.69, 67.65, 68.6, 69.56, 70.51, 71.46, 72.42, 73.37,
    74.33, 75.29, 76.24, 77.19, 78.14, 79.07, 80.02, 80.96, 81.9, 82.84, 83.78, 84.7, 85.64, 86.57, 87.52, 88.46, 89.4,
])
# fmt: on
ROTOR = RotorModel(
    delay=UPRIGHT_DELAY_S,
    period=111.08e-6,
    lens_distance=float(np.hypot(0.0075, 0.00664)),
    height=0.04532,
    vertical=ELEVATION_DEG,
)

ECHO = BitStruct(
    "feature" / BitsInteger(2), "distance" / Scaled(BitsInteger(14), 0.005, "m") * "0: no return"
)
DATA = Struct(
    "header" / Const(b"\x55\xaa\x05\x5a"),
    "reserved_4" / Bytes(4),
    "top_packet_count" / Int32ub,
    "packet_count" / Int32ub,
    "data_type" / Const(0, Int8ub) * "0: points",
    "returns" / Int8ub * "3: dual return",
    "reserved_18" / Bytes(2),
    *TIME,
    "reserved_30" / Bytes(1),
    "lidar_type" / Enum(Const(AIRY_TYPE, Int8ub), Airy=AIRY_TYPE),
    "lidar_model" / Const(MODEL_96, Int8ub) * "1: 48 lasers, 2: 96 lasers, 3: 192 lasers",
    "reserved_33" / Bytes(5),
    "temperature" / TEMPERATURE,
    "top_temperature" / TEMPERATURE,
    "blocks"
    / Array(
        BLOCKS,
        Struct(
            "flag" / BLOCK_FLAG,
            "azimuth"
            / Scaled(Int16ub, 0.01, "deg")
            * "angle of the rotor, clockwise, when the first laser of a pair of blocks fires",
            "channels" / Array(HALF_LASERS, Struct("echo" / ECHO, "intensity" / Int8ub)),
        ),
    ),
    "tail" / Bytes(6) * "reserved bytes, then 00 FF",
    "reserved_end" / Bytes(16),
)
DIFOP = Struct(
    *DIFOP_HEAD,
    "software" / Bytes(5),
    "motor_firmware" / Bytes(5),
    "reserved_60" / Bytes(229),
    "install_mode" / Enum(Int8ub, **{"upright": 0, "on its side": 1, "Airy M": 2}),
    "reserved_290" / Bytes(2),
    *DIFOP_UNIT,
    *DIFOP_TIME,
    "reserved_313" / Bytes(60),
    "measured_rpm" / Scaled(Int16ub, 1, "rpm"),
    "reserved_375" / Bytes(93),
    "vertical_low" / make_angles(HALF_LASERS),
    "vertical_high" / make_angles(HALF_LASERS),
    "horizontal_low" / make_angles(HALF_LASERS),
    "horizontal_high" / make_angles(HALF_LASERS),
    "board_voltage" / Scaled(Int16ub, 0.01, "V"),
    "reserved_1046" / Bytes(20),
    "voltage" / Scaled(Int16ub, 0.01, "V"),
    "voltage_12v" / Scaled(Int16ub, 0.01, "V"),
    "reserved_1070" / Bytes(10),
    "emitter_temperature" / Scaled(Int16ub, 0.01, "degC"),
    "reserved_1082" / Bytes(10),
    "imu_rotation"
    / Array(4, Float32b)
    * "orientation of the IMU in the lidar: quaternion x, y, z, w",
    "imu_position" / Array(3, Scaled(Float32b, 1, "m")),
    "reserved_1120" / Bytes(126),
    DIFOP_TAIL,
)
IMU = Struct(
    "header" / Const(b"\xaa\x55\x5a\x05"),
    *TIME,
    *(f"acceleration_{axis}" / Int32sb for axis in "xyz"),
    *(f"rotation_{axis}" / Int32sb for axis in "xyz"),
    "temperature" / Scaled(Int32sb, 0.01, "degC"),
    "data_rate" / Enum(Int8ub, **{"25 Hz": 0, "50 Hz": 1, "100 Hz": 2, "200 Hz": 3, "1000 Hz": 4}),
    "acceleration_range" / Enum(Int8ub, **{"2 g": 0, "4 g": 1, "8 g": 2, "16 g": 3}),
    "rotation_range"
    / Enum(Int8ub, **{"250 deg/s": 0, "500 deg/s": 1, "1000 deg/s": 2, "2000 deg/s": 3}),
    "count" / Int32ub,
    "tail" / Const(b"\xf0\x0f"),
)


def plausible(f: Fields) -> Any:
    """Return whether azimuths are below 360 degrees."""
    return f.blocks.azimuth < 360


def is_plausible_imu(f: Fields) -> Any:
    """Return whether the codes of the measuring ranges and of the data rate are known."""
    return (f.acceleration_range <= 3) & (f.rotation_range <= 3) & (f.data_rate <= 4)


def points(f: Fields) -> Polar:
    """Return the points of 96 lasers; the second block of a pair has the upper 48."""
    azimuth = f.blocks.azimuth
    block = f.blocks.index
    difop = f.state.difop
    dual = f.returns == DUAL
    is_lower_half = f.blocks.index % 2 == 0
    next_azimuth = np.where(dual, following(azimuth, 4), following(azimuth, 2))
    vertical = np.where(
        is_lower_half, laser_degrees(difop.vertical_low), laser_degrees(difop.vertical_high)
    )
    horizontal = np.where(
        is_lower_half, laser_degrees(difop.horizontal_low), laser_degrees(difop.horizontal_high)
    )
    delay = np.where(
        difop.install_mode == 1,
        SIDEWAYS_DELAY_S,
        np.where(difop.install_mode == 2, AIRY_M_DELAY_S, UPRIGHT_DELAY_S),
    )
    polar = make_points(
        f,
        f.blocks.channels,
        ROTOR,
        (vertical, horizontal),
        next_azimuth,
        elapsed=delay,
        duration=ROTOR.period,
        shot=np.where(dual, block // 4, block // 2),
        echo=np.where(dual, block // 2 % 2, 0),
        distance=f.blocks.channels.echo.distance,
        ring=np.arange(2 * HALF_LASERS).reshape(2, HALF_LASERS)[np.arange(BLOCKS) % 2],
    )
    return dataclasses.replace(polar, extra={"feature": f.blocks.channels.echo.feature})


def imu(f: Fields) -> Imu:
    """Return the IMU sample.

    Source: Table 13.
    """
    acceleration_step = take(GRAVITY * np.array([2, 4, 8, 16]) / 32768, f.acceleration_range)
    rotation_step = take(np.deg2rad(np.array([250, 500, 1000, 2000]) / 32768), f.rotation_range)
    return Imu(
        (f.rotation_x * rotation_step, f.rotation_y * rotation_step, f.rotation_z * rotation_step),
        (
            f.acceleration_x * acceleration_step,
            f.acceleration_y * acceleration_step,
            f.acceleration_z * acceleration_step,
        ),
    )


def sweep_data(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i, with four azimuths of two blocks each."""
    values = rotation_values(i, BLOCKS // 2, ROTOR.period, packet_count=i % (1 << 32))
    return {**values, "blocks.azimuth": np.repeat(values["blocks.azimuth"], 2)}


def sweep_imu(i: int) -> dict[str, Any]:
    """Return the values of IMU sample i, with the factory's measuring ranges."""
    codes = {"data_rate": 3, "acceleration_range": 1, "rotation_range": 1}
    return {
        "seconds": i // IMU_RATE_HZ,
        "microseconds": i % IMU_RATE_HZ / IMU_RATE_HZ,
        "count": (i + 1) % (1 << 32),
        **codes,
    }


LOWER_HALF, UPPER_HALF = np.split(ELEVATION_DEG, 2)
NO_OFFSETS = np.zeros(HALF_LASERS)
DEFAULT_ANGLES = {
    **split_angles("vertical_low", LOWER_HALF),
    **split_angles("vertical_high", UPPER_HALF),
    **split_angles("horizontal_low", NO_OFFSETS),
    **split_angles("horizontal_high", NO_OFFSETS),
}

AIRY = Sensor(
    "robosense-airy",
    model="Airy",
    frames={
        "data": Frame(DATA, data=True, plausible=plausible),
        "difop": Frame(
            DIFOP, simulation=Simulation(partial(sweep_difop, speed="measured_rpm"), rate=1)
        ),
        "imu": Frame(
            IMU,
            imu=imu,
            plausible=is_plausible_imu,
            simulation=Simulation(sweep_imu, rate=IMU_RATE_HZ),
        ),
    },
    points=points,
    sequence=PacketCounter("packet_count"),
    state={"difop": {"rpm": FACTORY_SPEED_HZ * 60, "install_mode": 0, **DEFAULT_ANGLES}},
    simulation=Simulation(sweep_data),
    range_limits=(0.1, 60.0),  # Table 1
    info={"serial": "difop.serial_number", "firmware": "difop.top_firmware"},
    source=(
        "Airy user manual 1.3, chapter 4.4 and appendices C and D; rs_driver"
        " (decoder_RSAIRY.hpp); not tested with packets"
    ),
    **{
        **COMMON,
        # the time of the grandmaster, in PTP's own scale
        "clock": Clock(("seconds", "microseconds"), epoch="tai", status=make_clock_status()),
        "links": {"data": Udp(6699, 7788, 6688)},
        "turn": (FACTORY_SPEED_HZ, FACTORY_SPEED_HZ),
    },
)
