"""RoboSense M2, MX and E1: solid-state lidars over UDP.

Each point has a radius and a unit vector. Source: the vendor's rs_driver (decoder_RSM2.hpp,
decoder_RSMX.hpp, decoder_RSE1.hpp: packets, packets per frame, limits); E1 user manual, Tables 4 to
9 (packets, tail, DIFOP).

For the E1, this module follows the manual, in which packets are counted from 0 and the return modes
9 to 11 mean dual return; in rs_driver, the mode 0 means dual return. The CRCs at the end of packets
are not verified, because the bytes that they cover are not public; the CRC of the E1 is called
AUTOSAR E2E profile 4. It is assumed that the M2 and the MX count packets from 1, as the M1 does. It
is also assumed that frames with dual return have twice as many packets, except for the MX, whose
points have two radii. The IMU of the E1 is assumed to measure in g and rad/s like the IMU of the
Airy, because rs_driver reads both in the same way.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from construct import (
    Array,
    Bytes,
    Const,
    Construct,
    Enum,
    Float32b,
    Int8ub,
    Int16sb,
    Int16ub,
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
    Simulation,
    stack,
)
from lidarspec_robosense.m1 import (
    FRAME_RATE_HZ,
    HEADER,
    M1,
    count_packets_per_firing,
    number_firings,
)
from lidarspec_robosense.rotor import RETURN_NUMBERS, TIME, WAVE_MODES, make_clock_status

# return modes
DUAL = WAVE_MODES["dual"]
STRONGEST = WAVE_MODES["strongest"]
GRAVITY = 9.80665
MAGIC = Const(b"\xa5\xff\x00\x5a\x11\x11\x55\x55")
UNIT_VECTOR = tuple(axis / Scaled(Int16sb, 1 / 32768, "") for axis in "xyz")
#: The largest component of a unit vector that a field can represent.
LARGEST_COMPONENT = 32767 / 32768


@dataclass(frozen=True)
class SolidStateModel:
    """The size of the packets and frames of a model, and its field of view.

    Attributes:
        blocks: the number of blocks per packet.
        channels: the number of channels per block.
        packets: the number of packets per frame with single return.
        first: the packet number of the first packet of a frame.
        width_deg, height_deg: the width and height of the simulated field of view.
    """

    blocks: int
    channels: int
    packets: int
    first: int
    width_deg: float
    height_deg: float


def make_packet_struct(
    model: SolidStateModel,
    offset: Construct,
    parts: tuple[Construct, ...],
    channel: tuple[Construct, ...],
    *tail: Construct,
) -> Struct:
    """Return the struct of a data packet.

    Args:
        offset: the type of a block's time offset.
        parts: the fields of a block between the time offset and the channels.
        channel: the fields of a channel.
    """
    time = "time_offset" / Scaled(offset, 1e-6, "s") * "relative to the time of the packet"
    return Struct(
        *HEADER,
        "blocks"
        / Array(
            model.blocks, Struct(time, *parts, "channels" / Array(model.channels, Struct(*channel)))
        ),
        *tail,
    )


RADIUS = "radius" / Scaled(Int16ub, 0.005, "m") * "0: no return"
ATTRIBUTE = "attribute" / Enum(Int8ub, normal=1, noise=2) * "values as documented for the E1"
ONE_RETURN = (RADIUS, *UNIT_VECTOR, "intensity" / Int8ub, ATTRIBUTE)
TWO_RETURNS = (
    RADIUS,
    "second_radius" / Scaled(Int16ub, 0.005, "m") * "second distance with dual return",
    *UNIT_VECTOR,
    "intensity" / Int8ub,
    "second_intensity" / Int8ub,
    ATTRIBUTE,
)
RETURN_NUMBER = "return_seq" / Enum(Int8ub, **RETURN_NUMBERS)
UNCHECKED_NOTE = "not checked: the covered bytes are not documented"
CRC_AND_COUNTER = ("crc" / Int32ub * UNCHECKED_NOTE, "rolling_counter" / Int16ub)

M2_MODEL = SolidStateModel(25, 5, 1260, 1, width_deg=120, height_deg=25)
MX_MODEL = SolidStateModel(50, 2, 630, 1, width_deg=120, height_deg=25)
E1_MODEL = SolidStateModel(96, 1, 288, 0, width_deg=120, height_deg=90)

M2_DATA = make_packet_struct(
    M2_MODEL, Int8ub, (RETURN_NUMBER,), ONE_RETURN, "reserved_end" / Bytes(4), *CRC_AND_COUNTER
)
MX_DATA = make_packet_struct(
    MX_MODEL, Int8ub, (), TWO_RETURNS, "reserved_end" / Bytes(16), *CRC_AND_COUNTER
)
E1_TAIL = (
    "data_length" / Const(1200, Int16ub),
    "counter" / Int16ub,
    "data_id" / Const(0xE5C, Int32ub),
    "crc" / Int32ub * UNCHECKED_NOTE,
)
E1_DATA = make_packet_struct(E1_MODEL, Int16ub, (), ONE_RETURN, "reserved_end" / Bytes(4), *E1_TAIL)
E1_DIFOP = Struct(
    "magic" / MAGIC,
    "reserved_8" / Bytes(8),
    "software" / Bytes(3),
    "reserved_19" / Bytes(1),
    "serial_number" / Bytes(6),
    "reserved_26" / Bytes(18),
    "lidar_ip" / Bytes(4),
    "subnet_mask" / Bytes(4),
    "mac" / Bytes(6),
    "msop_host_ip" / Bytes(4),
    "msop_local_port" / Int16ub,
    "msop_port" / Int16ub,
    "difop_host_ip" / Bytes(4),
    "difop_local_port" / Int16ub,
    "difop_port" / Int16ub,
    "reserved_74" / Bytes(25),
    "frame_rate" / Scaled(Int8ub, 1, "Hz"),
    "return_mode"
    / Enum(Int8ub, farthest=0, strongest=4, nearest=7, second_strongest=8)
    * "9 to 11: dual return",
    "time_sync_mode" / Enum(Int8ub, **{"internal": 0, "E2E L2": 2, "gPTP": 3}),
    "time_sync_status" / Enum(Int8ub, failed=0, success=1, timeout=2),
    *TIME,
    "phy_mode" / Enum(Int8ub, negotiated=0, master=1, slave=2),
    "reserved_114" / Bytes(94),
    *(f"acceleration_{axis}" / Scaled(Float32b, GRAVITY, "m/s2") * "sent in g" for axis in "xyz"),
    *(f"rotation_{axis}" / Scaled(Float32b, 1, "rad/s") for axis in "xyz"),
    "reserved_end" / Bytes(24),
)


def plausible(f: Fields, model: SolidStateModel) -> Any:
    """Return whether the packet number is possible."""
    return (f.pkt_psn >= model.first) & (f.pkt_psn < model.first + 2 * model.packets)


def last_packet_number(f: Fields, model: SolidStateModel, dual: tuple[int, ...]) -> Any:
    """Return the last packet number of a frame, which depends on the return mode."""
    is_dual = np.logical_or.reduce([f.wave_mode == mode for mode in dual]) if dual else False
    return np.where(is_dual, 2 * model.packets, model.packets) + model.first - 1


def pace(f: Fields, model: SolidStateModel, dual: tuple[int, ...]) -> Any:
    """Return the time from one packet to the next, in seconds."""
    return 1 / (FRAME_RATE_HZ * (last_packet_number(f, model, dual) - model.first + 1))


def make_counter_and_clock(model: SolidStateModel, dual: tuple[int, ...] = ()) -> dict[str, Any]:
    """Return the arguments of `Sensor` for the packet counter and the clock.

    Args:
        dual: the return modes with twice as many packets in a frame.
    """
    return {
        "sequence": PacketCounter(
            "pkt_psn", first=model.first, last=partial(last_packet_number, model=model, dual=dual)
        ),
        # the time of the grandmaster, in PTP's own scale
        "clock": Clock(
            ("seconds", "microseconds"), pace=partial(pace, model=model, dual=dual), epoch="tai"
        ),
    }


def common_columns(f: Fields) -> dict[str, Any]:
    """Return azimuth, elevation, time and ring of points."""
    channels = f.blocks.channels
    across = np.hypot(channels.x, channels.y)
    return {
        "azimuth": np.arctan2(channels.y, channels.x),
        "elevation": np.arctan2(channels.z, across),
        "time": f.blocks.time_offset,
        "ring": channels.index,
    }


def points(f: Fields, has_return_numbers: bool = False) -> Polar:
    """Return the points of packets with one point for each channel.

    `has_return_numbers` is true if each block contains the number of its return.
    """
    channels = f.blocks.channels
    length = np.sqrt(channels.x**2 + channels.y**2 + channels.z**2)
    echo = np.maximum(f.blocks.return_seq - 1, 0) if has_return_numbers else None
    other_columns = {
        "intensity": channels.intensity,
        "return_index": echo,
        "column": number_firings(f, M2_MODEL.blocks) if has_return_numbers else None,
        "extra": {"attribute": channels.attribute},
    }
    return Polar(range=channels.radius * length, **common_columns(f), **other_columns)


def points_mx(f: Fields) -> Polar:
    """Return two points of each channel.

    The second point is valid only with dual return.
    """
    channels = f.blocks.channels
    length = np.sqrt(channels.x**2 + channels.y**2 + channels.z**2)
    second = np.where(f.wave_mode == DUAL, channels.second_radius, 0)
    return Polar(
        range=stack(channels.radius * length, second * length),
        intensity=stack(channels.intensity, channels.second_intensity),
        return_index=stack(second * 0, second * 0 + 1),
        **common_columns(f),
    )


def imu(f: Fields) -> Imu:
    """Return the IMU sample with the axes of rs_driver."""
    return Imu(
        (f.rotation_x, f.rotation_y, f.rotation_z),
        (f.acceleration_x, f.acceleration_y, f.acceleration_z),
    )


def sweep(i: int, model: SolidStateModel, mode: int = STRONGEST) -> dict[str, Any]:
    """Return the values of simulated packet i."""
    number = i % model.packets
    time = i / (model.packets * FRAME_RATE_HZ)
    progress = (number * model.blocks + np.arange(model.blocks))[:, None] / (
        model.packets * model.blocks
    )
    lines = 100
    line, along = np.divmod(progress * lines, 1)
    along = np.where(line % 2, 1 - along, along)
    azimuth = np.deg2rad(
        (0.5 - (along + np.arange(model.channels)) / model.channels) * model.width_deg
    )
    elevation = np.deg2rad(
        np.broadcast_to((0.5 - line / (lines - 1)) * model.height_deg, azimuth.shape)
    )
    offsets = np.arange(model.blocks) / (model.packets * FRAME_RATE_HZ * model.blocks)
    return {
        "pkt_psn": number + model.first,
        "wave_mode": mode,
        "seconds": int(time),
        "microseconds": time % 1,
        "blocks.time_offset": np.round(offsets, 6),
        "blocks.channels.x": np.minimum(np.cos(elevation) * np.cos(azimuth), LARGEST_COMPONENT),
        "blocks.channels.y": np.cos(elevation) * np.sin(azimuth),
        "blocks.channels.z": np.sin(elevation),
    }


def sweep_e1(i: int) -> dict[str, Any]:
    """Return the device information of a sensor at rest with the factory's settings."""
    ports = {"msop_port": 6699, "difop_port": 7788, "lidar_ip": bytes([192, 168, 1, 200])}
    return {
        "frame_rate": FRAME_RATE_HZ,
        "return_mode": STRONGEST,
        "seconds": i,
        "microseconds": 0,
        **ports,
    }


MX_DIFOP = Struct(
    "magic" / MAGIC,
    "reserved_8" / Bytes(30),
    "serial_number" / Bytes(6),
    "reserved_44" / Bytes(212),
)

M2_TIMING = make_counter_and_clock(M2_MODEL, (DUAL,))
M2_TIMING["sequence"] = dataclasses.replace(M2_TIMING["sequence"], returns=count_packets_per_firing)

M2 = dataclasses.replace(
    M1,
    id="robosense-m2",
    model="M2",
    frames={
        **M1.frames,
        "data": Frame(
            M2_DATA,
            data=True,
            plausible=partial(plausible, model=M2_MODEL),
        ),
    },
    points=partial(points, has_return_numbers=True),
    **M2_TIMING,
    simulation=Simulation(partial(sweep, model=M2_MODEL)),
    configure=None,
    range_limits=(0.2, 250.0),  # rs_driver's limits for these models
    status="manual",
    source="rs_driver (decoder_RSM2.hpp); not tested with packets of this model",
)

MX = dataclasses.replace(
    M2,
    id="robosense-mx",
    model="MX",
    frames={
        "data": Frame(
            MX_DATA,
            data=True,
            plausible=partial(plausible, model=MX_MODEL),
        ),
        "difop": Frame(MX_DIFOP, simulation=Simulation(lambda i: {}, rate=1)),
    },
    points=points_mx,
    **make_counter_and_clock(MX_MODEL),
    # with dual return, so that the second radius is simulated too
    simulation=Simulation(partial(sweep, model=MX_MODEL, mode=DUAL)),
    range_limits=(0.2, 200.0),
    info={"serial": "difop.serial_number"},
    source="rs_driver (decoder_RSMX.hpp); not tested with packets of this model",
)

E1_TIMING = make_counter_and_clock(E1_MODEL, (9, 10, 11))
E1_TIMING["clock"] = dataclasses.replace(
    E1_TIMING["clock"], status=make_clock_status(("internal clock", "", "PTP (E2E L2)", "gPTP"))
)

E1 = dataclasses.replace(
    M2,
    id="robosense-e1",
    model="E1",
    frames={
        "data": Frame(
            E1_DATA,
            data=True,
            plausible=partial(plausible, model=E1_MODEL),
        ),
        "difop": Frame(E1_DIFOP, imu=imu, simulation=Simulation(sweep_e1, rate=1)),
    },
    points=points,
    **E1_TIMING,
    simulation=Simulation(partial(sweep, model=E1_MODEL)),
    range_limits=(0.1, 200.0),  # E1 user manual, Table 1; rs_driver's
    info={"serial": "difop.serial_number", "firmware": "difop.software"},
    source=(
        "E1 user manual, Tables 4 to 9; rs_driver (decoder_RSE1.hpp); not tested with packets"
        " of this model"
    ),
)
