"""RoboSense RS-LiDAR-32 and RS-Bpearl (before version 4): rotating lidars of 32 lasers over UDP, with DIFOP of the first layout.

Source: the vendor's rs_driver (decoder_RS32.hpp, decoder_RSBP.hpp: layouts, firing times, optical centre, return modes, time); angles of
an example unit of each, ros_rslidar. The date of a packet is taken for UTC: rs_driver takes it for the computer's own zone.

Assumed: that the type byte 30 is 2 from an RS-LiDAR-32 alone and 1 from an RS-LiDAR-16 alone, as rs_driver has it, and that a DIFOP packet
comes once a second. Not expressed: with a field of view set, blocks after the gap are later than a packet's times say.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Construct, Int8ub, Int16ub, Int24ub, Struct
from numpy.typing import NDArray

from lidarspec.spec import Clock, Fields, Frame, OnWrap, Polar, Scaled, Sensor, Simulation, Udp, following, previous, wrap
from lidarspec_robosense.helios import GAP, TEMPERATURE, TURNS, signed, sweep_difop

BLOCKS, LASERS = 12, 32
DUAL, STRONGEST = 0, 1  # return modes in DIFOP
PERIOD = 55.52e-6  # seconds from one firing of all lasers to the next
RS16_TYPE, RS32_TYPE = 1, 2

# fmt: off
RS32_VERTICAL = (
    -10.2637, 0.2972, -6.4063, -0.0179, 2.2794, -0.333, 3.2973, -0.667, 4.6136, 1.6849, 7.0176, 1.2972, 10.2983, 1.0, 15.0167, 0.7028,
    -25.0, -2.2794, -14.638, -2.667, -7.91, -3.0179, -5.407, -3.2973, -3.6492, -1.0179, -4.0534, -1.333, -4.3864, -1.6312, -4.6492, -1.9821,
)
RS32_HORIZONTAL = (
    9.1205, -7.1203, 8.9109, -1.7781, 9.1205, 3.5716, -6.838, 8.7856, 9.1205, -7.1555, -6.7674, -1.8139, 9.0507, 3.4859, -6.9439, 8.9007,
    -6.6968, -7.3317, -6.6614, -2.0, -6.7674, 3.3932, -6.838, 8.806, -7.1908, -7.2965, -1.8643, -1.8139, 3.4932, 3.5716, 8.806, 8.7308,
)
# fmt: on


@dataclass(frozen=True, eq=False)
class Lasers:
    """What tells the models apart.

    Attributes:
        delay: (32,) seconds from the block to the firing of each laser.
        lens: metres from the axis to the optical centre, in the rotor's direction.
        height: metres of it above the origin.
        vertical, horizontal: (32,) degrees, of an example unit, until DIFOP says the unit's own.
    """

    delay: NDArray[np.float64]
    lens: float
    height: float
    vertical: NDArray[np.float64]
    horizontal: NDArray[np.float64]

    @property
    def ring(self) -> NDArray[np.intp]:
        """(32,) the lasers, counted from the lowest one of the example unit."""
        return np.argsort(np.argsort(self.vertical))


DATA = Struct(
    "header" / Const(b"\x55\xaa\x05\x0a\x5a\xa5\x50\xa0"),
    "reserved_8" / Bytes(12),
    "year" / Int8ub * "from 2000 on",
    "month" / Int8ub,
    "day" / Int8ub,
    "hour" / Int8ub,
    "minute" / Int8ub,
    "second" / Int8ub,
    "milliseconds" / Scaled(Int16ub, 1e-3, "s"),
    "microseconds" / Scaled(Int16ub, 1e-6, "s"),
    "lidar_type" / Int8ub * "1 RS-LiDAR-16, 2 RS-LiDAR-32",
    "reserved_31" / Bytes(7),
    "temperature" / TEMPERATURE,
    "reserved_40" / Bytes(2),
    "blocks"
    / Array(
        BLOCKS,
        Struct(
            "flag" / Const(b"\xff\xee"),
            "azimuth" / Scaled(Int16ub, 0.01, "deg") * "of the rotor, clockwise, at the block's first laser",
            "channels" / Array(LASERS, Struct("distance" / Scaled(Int16ub, 0.005, "m") * "0: no return", "intensity" / Int8ub)),
        ),
    ),
    "index" / Bytes(4),
    "tail" / Const(b"\x00\xff"),
)


def difop(step: float) -> Construct:
    """Device information of the first layout; a step of the lasers' angles in degrees."""
    angle = Struct("sign" / Int8ub * "0 positive, 1 negative, 255 not calibrated", "value" / Scaled(Int16ub, step, "deg"))
    return Struct(
        "header" / Const(b"\xa5\xff\x00\x5a\x11\x11\x55\x55"),
        "rpm" / Scaled(Int16ub, 1, "rpm") * "as set",
        "lidar_ip" / Bytes(4),
        "host_ip" / Bytes(4),
        "mac" / Bytes(6),
        "msop_local_port" / Int16ub,
        "msop_port" / Int16ub,
        "difop_local_port" / Int16ub,
        "difop_port" / Int16ub,
        "fov_start" / Scaled(Int16ub, 0.01, "deg"),
        "fov_end" / Scaled(Int16ub, 0.01, "deg"),
        "reserved_36" / Bytes(2),
        "phase_lock" / Scaled(Int16ub, 1, "deg"),
        "top_firmware" / Bytes(5),
        "bottom_firmware" / Bytes(5),
        "reserved_50" / Bytes(242),
        "serial_number" / Bytes(6),
        "zero_angle_offset" / Int16ub,
        "return_mode" / Int8ub * "0 dual, 1 strongest, 2 last",
        "software" / Int16ub,
        "time" / Bytes(10),
        "currents" / Array(2, Int24ub),
        "voltages" / Array(9, Int16ub),
        "reserved_337" / Bytes(5),
        "diagnostics" / Bytes(31),
        "measured_speed" / Scaled(Int16ub, 1 / 6, "rpm"),
        "diagnostics_2" / Bytes(7),
        "gprmc" / Bytes(86),
        "vertical" / Array(LASERS, angle),
        "horizontal" / Array(LASERS, angle),
        "reserved_660" / Bytes(586),
        "tail" / Const(b"\x0f\xf0"),
    )


def plausible_rs32(f: Fields) -> Any:
    """Azimuths below 360 degrees, and this model's type."""
    return (f.blocks.azimuth < 360) & (f.lidar_type == RS32_TYPE)


def plausible_bpearl(f: Fields) -> Any:
    """Azimuths below 360 degrees, and the type of no other model with such packets."""
    return (f.blocks.azimuth < 360) & (f.lidar_type != RS16_TYPE) & (f.lidar_type != RS32_TYPE)


def clock(f: Fields) -> tuple[Any, Any, Any]:
    """Whole seconds since 1970, milliseconds and microseconds; years begin in March, so that the leap day is the last."""
    years, months = np.where(f.month <= 2, f.year + 1999, f.year + 2000), np.where(f.month <= 2, f.month + 9, f.month - 3)
    leap_days = np.floor(years / 4) - np.floor(years / 100) + np.floor(years / 400)
    days = 365 * years + leap_days + np.floor((153 * months + 2) / 5) + f.day - 719_469
    return 86_400 * days + 3600 * f.hour + 60 * f.minute + f.second, f.milliseconds, f.microseconds


def points(f: Fields, model: Lasers) -> Polar:
    """Lasers beside the rotor's direction, from an optical centre that turns with it; with dual return, pairs of blocks are one firing."""
    information, azimuth = f.state.difop, f.blocks.azimuth
    dual = information.return_mode == DUAL
    block = np.arange(BLOCKS)[:, None]
    ahead = wrap(np.where(dual, following(azimuth, 2), following(azimuth)) - azimuth, 360)
    behind = wrap(azimuth - np.where(dual, previous(azimuth, 2), previous(azimuth)), 360)
    step = np.where(ahead <= GAP, ahead, np.where(behind <= GAP, behind, information.rpm * 6 * PERIOD))
    rotor = np.deg2rad(azimuth + step * (model.delay / PERIOD))
    return Polar(
        range=f.blocks.channels.distance,
        azimuth=-(rotor + np.deg2rad(signed(information.horizontal))),
        elevation=np.deg2rad(signed(information.vertical)),
        intensity=f.blocks.channels.intensity,
        time=np.where(dual, block // 2, block) * PERIOD + model.delay,
        ring=model.ring,
        return_index=np.where(dual, block % 2, 0),
        origin=(model.lens * np.cos(rotor), -model.lens * np.sin(rotor), model.height),
    )


def sweep(i: int, lidar_type: int) -> dict[str, Any]:
    """Packet i of a sensor in single return mode, from the beginning of 2024 on."""
    time = i * BLOCKS * PERIOD
    azimuth = np.round((i * BLOCKS + np.arange(BLOCKS)) * PERIOD * TURNS * 360, 2) % 360
    date = {"year": 24, "month": 1, "day": 1, "hour": int(time / 3600), "minute": int(time / 60) % 60, "second": int(time) % 60}
    micros = round(time * 1e6) % 1_000_000
    fraction = {"milliseconds": micros // 1000 * 1e-3, "microseconds": micros % 1000 * 1e-6}
    return {**date, "second": round(time * 1e6) // 1_000_000 % 60, **fraction, "lidar_type": lidar_type, "blocks.azimuth": azimuth}


def sweep_information(i: int) -> dict[str, Any]:
    """The device information of a sensor with the factory's settings; the angles are the default ones."""
    return {**{name: value for name, value in sweep_difop(i).items() if name != "measured_rpm"}, "measured_speed": TURNS * 60}


def angles(values: NDArray[np.float64], name: str) -> dict[str, Any]:
    """Default angles as DIFOP has them."""
    return {f"{name}.sign": values < 0, f"{name}.value": np.abs(values)}


SLOT = np.arange(LASERS)
RS32_LASERS = Lasers(
    # 2.88 us apart in two rows, the second 1.44 us after the first; the last of each later (rs_driver)
    delay=(SLOT % 16 * 2.88 + SLOT // 16 * 1.44 + np.where(SLOT % 16 == 15, 1.44, 0)) * 1e-6,
    lens=0.03997,
    height=0.0,
    vertical=np.array(RS32_VERTICAL),
    horizontal=np.array(RS32_HORIZONTAL),
)
BPEARL_LASERS = Lasers(
    # 2.56 us apart in two rows, the second 1.28 us after the first, each with a pause in its middle (rs_driver)
    delay=(SLOT % 16 * 2.56 + SLOT // 16 * 1.28 + np.where(SLOT % 16 >= 8, 5.2, 0)) * 1e-6,
    lens=0.01473,
    height=0.09427,
    vertical=np.round(89.5 - 2.8125 * SLOT, 2),  # in the steps of its DIFOP
    horizontal=np.zeros(LASERS),
)

RS32 = Sensor(
    "robosense-rs32",
    vendor="RoboSense",
    model="RS-LiDAR-32",
    frames={
        "data": Frame(DATA, data=True, plausible=plausible_rs32),
        "difop": Frame(difop(0.001), simulation=Simulation(sweep_information, rate=1)),
    },
    points=partial(points, model=RS32_LASERS),
    scan=OnWrap("blocks.azimuth"),
    links={"data": Udp(6699, 7788)},
    clock=Clock(clock),
    state={
        "difop": {
            "rpm": TURNS * 60,
            "return_mode": STRONGEST,
            **angles(RS32_LASERS.vertical, "vertical"),
            **angles(RS32_LASERS.horizontal, "horizontal"),
        }
    },
    simulation=Simulation(partial(sweep, lidar_type=RS32_TYPE)),
    range_limits=(0.4, 230.0),  # rs_driver's limits for this model
    vendor_axes=("forward", "left", "up"),
    turn=(5.0, 20.0),
    info={"serial": "difop.serial_number", "firmware": "difop.top_firmware", "model": "data.lidar_type"},
    aliases=("rs32", "rs-lidar-32"),
    status="manual",
    acknowledged={"LS511": "the rotor turns clockwise, and the angle on the wire with it, in axes that are right-handed"},
    source="rs_driver (decoder_RS32.hpp); angles of an example unit in ros_rslidar",
)

BPEARL = dataclasses.replace(
    RS32,
    id="robosense-bpearl",
    model="RS-Bpearl",
    frames={
        "data": Frame(DATA, data=True, plausible=plausible_bpearl),
        "difop": Frame(difop(0.01), simulation=Simulation(sweep_information, rate=1)),
    },
    points=partial(points, model=BPEARL_LASERS),
    state={
        "difop": {
            **RS32.state["difop"],
            **angles(BPEARL_LASERS.vertical, "vertical"),
            **angles(BPEARL_LASERS.horizontal, "horizontal"),
        }
    },
    simulation=Simulation(partial(sweep, lidar_type=0)),
    range_limits=(0.1, 150.0),  # likewise
    aliases=("bpearl", "rs-bpearl", "rsbp"),
    info={"serial": "difop.serial_number", "firmware": "difop.top_firmware"},
    source="rs_driver (decoder_RSBP.hpp and its tests); angles of an example unit in ros_rslidar",
)
