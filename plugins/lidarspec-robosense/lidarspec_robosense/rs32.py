"""RoboSense RS-LiDAR-16, RS-LiDAR-32 and RS-Bpearl: rotating lidars of 16 and 32 lasers over UDP.

The DIFOP packets have the first layout that the module `rotor` describes.

Source: the vendor's rs_driver (decoder_RS16.hpp, decoder_RS32.hpp, decoder_RSBP.hpp and their
tests: layouts, firing times, optical centre, return modes, time); ros_rslidar (the angles of an
example unit of each model). This module reads the date of a packet as UTC, but rs_driver reads it
as the local time of the computer. The angles in the DIFOP of an RS-LiDAR-16 have steps of 0.0001
degrees, as in rs_driver's test.

As in rs_driver, it is assumed that the type in byte 30 is 1 only in packets of an RS-LiDAR-16, and
2 only in packets of an RS-LiDAR-32. It is also assumed that bytes 31 and 32 identify a Bpearl of
version 4. A Bpearl of version 4 is assumed to have the nominal angles of other Bpearls.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Construct, Enum, Int8ub, Int16ub, Int24ub, Struct

from lidarspec.spec import Clock, Fields, Frame, Polar, Scaled, Sensor, Simulation, unix_time
from lidarspec_robosense.rotor import (
    COMMON,
    FACTORY_SPEED_HZ,
    TEMPERATURE,
    TIME,
    RotorModel,
    make_angles,
    make_blocks,
    make_first_layout,
    pace,
    points_of_firings,
    points_of_groups,
    rotation_values,
    sweep_difop,
)

BLOCKS = 12
LASERS = 32
DUAL = 0
STRONGEST = 1  # return modes in DIFOP
RS16_TYPE = 1
RS32_TYPE = 2
V4_BYTES = (3, 4)  # bytes 31 and 32 of a Bpearl of version 4
SLOT_INDEX = np.arange(LASERS)

# fmt: off
RS16_VERTICAL = (
    -14.9994, -12.9766, -10.9894, -8.975, -6.9734, -4.99, -2.9946, -0.9918, 14.986, 12.963, 10.9756, 8.996, 6.9945, 5.0113, 2.9803, 1.0133,
)
RS32_VERTICAL = (
    -10.2637, 0.2972, -6.4063, -0.0179, 2.2794, -0.333, 3.2973, -0.667, 4.6136, 1.6849, 7.0176, 1.2972, 10.2983, 1.0, 15.0167, 0.7028,
    -25.0, -2.2794, -14.638, -2.667, -7.91, -3.0179, -5.407, -3.2973, -3.6492, -1.0179, -4.0534, -1.333, -4.3864, -1.6312, -4.6492, -1.9821,
)
RS32_HORIZONTAL = (
    9.1205, -7.1203, 8.9109, -1.7781, 9.1205, 3.5716, -6.838, 8.7856, 9.1205, -7.1555, -6.7674, -1.8139, 9.0507, 3.4859, -6.9439, 8.9007,
    -6.6968, -7.3317, -6.6614, -2.0, -6.7674, 3.3932, -6.838, 8.806, -7.1908, -7.2965, -1.8643, -1.8139, 3.4932, 3.5716, 8.806, 8.7308,
)
# fmt: on

RS16_ROTOR = RotorModel(
    delay=np.arange(16) * 2.8e-6,
    period=55.5e-6,
    lens_distance=0.03825,
    vertical=np.array(RS16_VERTICAL),
)
RS32_ROTOR = RotorModel(
    # 2.88 us apart in two rows, the second 1.44 us after the first; the last laser of a row fires
    # 1.44 us later still (rs_driver)
    delay=(
        SLOT_INDEX % 16 * 2.88 + SLOT_INDEX // 16 * 1.44 + np.where(SLOT_INDEX % 16 == 15, 1.44, 0)
    )
    * 1e-6,
    period=55.52e-6,
    lens_distance=0.03997,
    vertical=np.array(RS32_VERTICAL),
    horizontal=np.array(RS32_HORIZONTAL),
)
BPEARL_ROTOR = RotorModel(
    # 2.56 us apart in two rows, the second 1.28 us after the first, each with a pause in its middle
    # (rs_driver)
    delay=(
        SLOT_INDEX % 16 * 2.56 + SLOT_INDEX // 16 * 1.28 + np.where(SLOT_INDEX % 16 >= 8, 5.2, 0)
    )
    * 1e-6,
    period=55.52e-6,
    lens_distance=0.01473,
    height=0.09427,
    vertical=np.round(89.5 - 2.8125 * SLOT_INDEX, 2),  # in the steps of its DIFOP
)
BPEARL_V4_ROTOR = dataclasses.replace(
    # in steps of 1.6680 us, rounded to hundredths (rs_driver)
    BPEARL_ROTOR,
    delay=np.round(SLOT_INDEX * 1.668, 2) * 1e-6,
    period=55.56e-6,
    lens_distance=0.01619,
    height=0.09571,
)

DATE: tuple[Construct, ...] = (
    "year" / Int8ub * "years since 2000",
    "month" / Int8ub,
    "day" / Int8ub,
    "hour" / Int8ub,
    "minute" / Int8ub,
    "second" / Int8ub,
    "milliseconds" / Scaled(Int16ub, 1e-3, "s"),
    "microseconds" / Scaled(Int16ub, 1e-6, "s"),
)


def make_packet_struct(time: tuple[Construct, ...], blocks: Construct) -> Struct:
    """Return the struct of a data packet with this time and these blocks."""
    return Struct(
        "header" / Const(b"\x55\xaa\x05\x0a\x5a\xa5\x50\xa0"),
        "reserved_8" / Bytes(12),
        *time,
        "lidar_type" / Enum(Int8ub, **{"RS-LiDAR-16": RS16_TYPE, "RS-LiDAR-32": RS32_TYPE}),
        "series" / Int8ub * "3: RS-Bpearl version 4",
        "version" / Int8ub * "4 in an RS-Bpearl version 4",
        "reserved_33" / Bytes(5),
        "temperature" / TEMPERATURE,
        "reserved_40" / Bytes(2),
        "blocks" / blocks,
        "index" / Bytes(4),
        "tail" / Const(b"\x00\xff"),
    )


def make_difop(step: float) -> Construct:
    """Return the device information with angles of 32 lasers.

    `step` is the step of the angles in degrees.
    """
    return make_first_layout(
        "vertical" / make_angles(LASERS, step),
        "horizontal" / make_angles(LASERS, step),
        "reserved_660" / Bytes(586),
    )


DIFOP_16 = make_first_layout(
    "reserved_468" / Bytes(697),
    "pitch"
    / Array(16, Scaled(Int24ub, 0.0001, "deg"))
    * "vertical angles without their sign; the first eight lasers point below the horizon",
    "reserved_1213" / Bytes(33),
)


def is_plausible(f: Fields, lidar_type: int) -> Any:
    """Return whether azimuths are below 360 degrees and the type is that of the model."""
    return (f.blocks.azimuth < 360) & (f.lidar_type == lidar_type)


def is_plausible_bpearl(f: Fields, v4: bool) -> Any:
    """Return whether a packet can be from a Bpearl.

    `v4` selects Bpearls of version 4, or all other Bpearls.
    """
    is_version_4 = (f.series == V4_BYTES[0]) & (f.version == V4_BYTES[1])
    return (f.blocks.azimuth < 360) & (
        is_version_4
        if v4
        else (f.lidar_type != RS16_TYPE) & (f.lidar_type != RS32_TYPE) & ~is_version_4
    )


def read_time(f: Fields) -> tuple[Any, Any, Any]:
    """Return the time: whole seconds since 1970, milliseconds and microseconds."""
    date = unix_time(f.year + 2000, f.month, f.day, f.hour, f.minute, f.second)
    return date, f.milliseconds, f.microseconds


def make_clock(source: Any, firings: int, model: RotorModel) -> Clock:
    """Return the declared clock of a sensor with `firings` firings in a packet.

    `source` has the names of the fields with the time, or is a function that returns the time.
    """
    pace_of_mode = partial(pace, firings=firings, period=model.period, dual=DUAL)
    # set by PPS and GPRMC, whose time is UTC; whether it is set is not reported
    return Clock(source, pace=pace_of_mode, epoch="utc")


def points_16(f: Fields) -> Polar:
    """Return the points of blocks with two firings of 16 lasers each."""
    up = np.where(np.arange(16) < 8, -1, 1) * f.state.difop.pitch.on("channels")
    return points_of_groups(f, f.state.difop.return_mode == DUAL, RS16_ROTOR, (up, 0.0))


def points(f: Fields, model: RotorModel) -> Polar:
    """Return the points of blocks with one firing."""
    return points_of_firings(f, f.state.difop.return_mode == DUAL, model)


def sweep(i: int, block_us: float, lidar_type: int) -> dict[str, Any]:
    """Return the values of simulated packet i with single return.

    `block_us` is the duration of a block in microseconds.
    """
    values = rotation_values(i, BLOCKS, block_us * 1e-6, lidar_type=lidar_type)
    seconds, micros = divmod(round(i * BLOCKS * block_us), 1_000_000)
    date = {
        "year": 24,
        "month": 1,
        "day": 1,
        "hour": seconds // 3600 % 24,
        "minute": seconds // 60 % 60,
        "second": seconds % 60,
    }
    del values["seconds"]
    return {
        **values,
        **date,
        "milliseconds": micros // 1000 * 1e-3,
        "microseconds": micros % 1000 * 1e-6,
    }


INFORMATION = Simulation(sweep_difop, rate=1)

RS32 = Sensor(
    "robosense-rs32",
    model="RS-LiDAR-32",
    frames={
        "data": Frame(
            make_packet_struct(DATE, make_blocks(BLOCKS, LASERS, 0.005)),
            data=True,
            plausible=partial(is_plausible, lidar_type=RS32_TYPE),
        ),
        "difop": Frame(make_difop(0.001), simulation=INFORMATION),
    },
    points=partial(points, model=RS32_ROTOR),
    state=RS32_ROTOR.make_default_state(return_mode=STRONGEST),
    simulation=Simulation(partial(sweep, block_us=55.52, lidar_type=RS32_TYPE)),
    range_limits=(0.4, 230.0),  # rs_driver's limits for this model
    info={
        "serial": "difop.serial_number",
        "firmware": "difop.top_firmware",
        "model": "data.lidar_type",
    },
    source="rs_driver (decoder_RS32.hpp); angles of an example unit in ros_rslidar",
    **{**COMMON, "clock": make_clock(read_time, BLOCKS, RS32_ROTOR)},
)

RS16 = dataclasses.replace(
    RS32,
    id="robosense-rs16",
    model="RS-LiDAR-16",
    frames={
        "data": Frame(
            make_packet_struct(DATE, make_blocks(BLOCKS, 16, 0.005, firings=2)),
            data=True,
            plausible=partial(is_plausible, lidar_type=RS16_TYPE),
        ),
        "difop": Frame(DIFOP_16, simulation=INFORMATION),
    },
    points=points_16,
    clock=make_clock(read_time, 2 * BLOCKS, RS16_ROTOR),
    state={
        "difop": {
            "rpm": FACTORY_SPEED_HZ * 60,
            "return_mode": STRONGEST,
            "pitch": np.abs(RS16_ROTOR.vertical),
        }
    },
    simulation=Simulation(partial(sweep, block_us=111.0, lidar_type=RS16_TYPE)),
    source="rs_driver (decoder_RS16.hpp and its test); angles of an example unit in ros_rslidar",
)

BPEARL = dataclasses.replace(
    RS32,
    id="robosense-bpearl",
    model="RS-Bpearl",
    frames={
        "data": Frame(
            make_packet_struct(DATE, make_blocks(BLOCKS, LASERS, 0.005)),
            data=True,
            plausible=partial(is_plausible_bpearl, v4=False),
        ),
        "difop": Frame(make_difop(0.01), simulation=INFORMATION),
    },
    points=partial(points, model=BPEARL_ROTOR),
    clock=make_clock(read_time, BLOCKS, BPEARL_ROTOR),
    state=BPEARL_ROTOR.make_default_state(return_mode=STRONGEST),
    simulation=Simulation(partial(sweep, block_us=55.52, lidar_type=0)),
    range_limits=(0.1, 150.0),  # rs_driver's limits for this model
    info={"serial": "difop.serial_number", "firmware": "difop.top_firmware"},
    source="rs_driver (decoder_RSBP.hpp and its tests); angles of an example unit in ros_rslidar",
)

BPEARL_V4 = dataclasses.replace(
    BPEARL,
    id="robosense-bpearl-v4",
    model="RS-Bpearl, version 4",
    frames={
        "data": Frame(
            make_packet_struct(TIME, make_blocks(BLOCKS, LASERS, 0.0025)),
            data=True,
            plausible=partial(is_plausible_bpearl, v4=True),
        ),
        "difop": BPEARL.frames["difop"],
    },
    points=partial(points, model=BPEARL_V4_ROTOR),
    clock=make_clock(("seconds", "microseconds"), BLOCKS, BPEARL_V4_ROTOR),
    state=BPEARL_V4_ROTOR.make_default_state(return_mode=STRONGEST),
    simulation=Simulation(
        lambda i: rotation_values(
            i, BLOCKS, BPEARL_V4_ROTOR.period, series=V4_BYTES[0], version=V4_BYTES[1]
        )
    ),
)
