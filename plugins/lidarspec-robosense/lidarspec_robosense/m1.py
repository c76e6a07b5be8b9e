"""RoboSense RS-LiDAR-M1 and M1 Plus: solid-state lidars of five channels over UDP.

Each point contains its own angles. Both models send the same packets, which do not contain the
model.

Source: RS-LiDAR-M1 user guide, 2.1.2 and Table 5 (the data blocks); RS-LiDAR-M1P user guide, pages
9 to 14 (header, tail, formulas, worked example), with which the vendor's rs_driver agrees.

Known errors and gaps of the guides: The formula for the time of a group of points is misprinted
("titime_offset"); the time is the packet's timestamp plus time_offset. The angles have an offset of
32768, which the M1P guide does not mention in its table, but on the page after the table. In the
worked example, z is printed as 2.17, but is 2.1647. The formula raw - 80 for mems_tmp gives -46
degC for the guide's own capture, so the raw byte is kept unless the option `firmware` selects a
formula. The 750 000 points per second in the guide do not agree with 630 packets in a frame, which
result in 787 500 points.

From byte 28 on, DIFOP has one of three layouts. `difop` is the layout of rs_driver since December
2023. `difop_fov` is the layout of earlier editions of the driver. `difop_guide` is the layout of
the M1P user guide. Packets do not identify their layout, so a packet is read with the first layout
in which its values are possible. If no layout fits, the packet is `difop_other`.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from construct import (
    Array,
    Bytes,
    Check,
    Const,
    Construct,
    Enum,
    Int8sb,
    Int8ub,
    Int16ub,
    Int24ub,
    Mapping,
    Struct,
    this,
)

from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    OnRewind,
    PacketCounter,
    Polar,
    Reported,
    Scaled,
    Sensor,
    Simulation,
    Udp,
)
from lidarspec_robosense.rotor import (
    RETURN_NUMBERS,
    SYNC_MODES,
    SYNC_STATES,
    TIME,
    WAVE_MODES,
    make_clock_status,
)

BLOCKS = 25
CHANNELS = 5
# Packets per frame with single return; twice as many with dual return (rs_driver; M1P user guide:
# the counter restarts with each frame)
SINGLE_RETURN_PACKETS = 630
FRAME_RATE_HZ = 10  # M1P user guide, page 6
BLOCK_PERIOD_S = 10e-6 / 3  # the M1P guide's capture has blocks at 0, 3, 7, 10, 13, 17 us
BLOCK_OFFSETS_S = np.round(np.arange(BLOCKS) * BLOCK_PERIOD_S, 6)  # rounded as by the sensor
SIMULATED_LINE_FIRINGS = 125  # per line, which gives 126 lines 0.2 degrees apart

HEADER_START: tuple[Construct, ...] = (
    "magic" / Const(b"\x55\xaa\x5a\xa5"),
    "pkt_psn"
    / Int16ub
    * "packet counter within the frame; M1: 1 to 630, or to 1260 with dual return",
    "protocol_version" / Int16ub,
    "wave_mode" / Enum(Int8ub, **WAVE_MODES),
    "time_sync_mode" / Enum(Int8ub, **SYNC_MODES),
    *TIME,
    "reserved" / Bytes(10),
    "lidar_type" / Int8ub * "0x10: M1",
)
#: Firmware -> temperature of the mirror. "current": as in the M1P user guide and rs_driver; "2021":
#: as in rs_driver of April 2021; "": unknown.
TEMPERATURES: dict[str, Construct] = {
    "": "mems_tmp" / Int8ub * "degC + 80 or signed degC, which depends on the firmware",
    "current": "mems_tmp" / Scaled(Int8ub, 1, "degC", offset=-80),
    "2021": "mems_tmp" / Scaled(Int8sb, 1, "degC"),
}
HEADER = (*HEADER_START, TEMPERATURES[""])
BLOCKS_AND_TAIL: tuple[Construct, ...] = (
    "blocks"
    / Array(
        BLOCKS,
        Struct(
            "time_offset" / Scaled(Int8ub, 1e-6, "s") * "relative to the time of the packet",
            "return_seq" / Enum(Int8ub, **RETURN_NUMBERS) * "the first return is the nearer one",
            "channels"
            / Array(
                CHANNELS,
                Struct(
                    "radius" / Scaled(Int16ub, 0.005, "m") * "0: no return",
                    "elevation" / Scaled(Int16ub, 0.01, "deg", offset=-327.68),
                    "azimuth" / Scaled(Int16ub, 0.01, "deg", offset=-327.68),
                    "intensity" / Int8ub,
                    "reserved" / Bytes(2),
                ),
            ),
        ),
    ),
    "tail" / Bytes(3) * "reserved",
)
DATA = Struct(*HEADER, *BLOCKS_AND_TAIL)

#: The first 28 bytes of every DIFOP.
DIFOP_HEAD: tuple[Construct, ...] = (
    "magic" / Const(b"\xa5\xff\x00\x5a\x11\x11\x55\x55"),
    "reserved_8" / Bytes(1),
    "frame_rate" / Scaled(Int8ub, 1, "Hz"),
    "lidar_ip" / Bytes(4),
    "host_ip" / Bytes(4),
    "mac" / Bytes(6),
    "msop_port" / Int16ub,
    "difop_port" / Int16ub,
)
FIRMWARE = ("pl_firmware" / Bytes(5), "ps_firmware" / Bytes(5))
MODES: tuple[Construct, ...] = (
    "return_mode" / Mapping(Int8ub, WAVE_MODES),
    "time_sync_mode" / Mapping(Int8ub, SYNC_MODES),
    "time_sync_status" / Mapping(Int8ub, SYNC_STATES),
    *TIME,
    "in_range" / Check((this.microseconds < 1_000_000) & (this.seconds < 2**36)),
)
FOV_FIELDS = tuple(
    f"{way}_{end}" / Scaled(Int16ub, 0.01, "deg")
    for way in ("horizontal", "vertical")
    for end in ("start", "end")
)
POWER = (
    "currents" / Array(2, Int24ub),
    "voltages" / Array(2, Int16ub),
    "reserved_power" / Bytes(50),
)
CALIBRATION = "calibration" / Array(20, Struct("sign" / Int8ub, "value" / Int16ub))
RS_DRIVER_FIELDS = ("serial_number" / Bytes(6), *MODES, *POWER, CALIBRATION)
DIFOP = Struct(*DIFOP_HEAD, *FIRMWARE, *RS_DRIVER_FIELDS, "reserved_end" / Bytes(79))
DIFOP_FOV = Struct(
    *DIFOP_HEAD, *FOV_FIELDS, *FIRMWARE, *RS_DRIVER_FIELDS, "reserved_end" / Bytes(71)
)
DIFOP_GUIDE = Struct(
    *DIFOP_HEAD,
    *FIRMWARE,
    "reserved_38" / Bytes(16),
    *MODES,
    "battery_voltage" / Int16ub,
    "reserved_69" / Bytes(67),
    "faults" / Int8ub,
    "reserved_end" / Bytes(119),
)
DIFOP_OTHER = Struct(*DIFOP_HEAD, "rest" / Bytes(228))


def plausible(f: Fields) -> Any:
    """Return whether the counter is at least 1 (M1P user guide, header)."""
    return f.pkt_psn >= 1


def count_packets_per_firing(f: Fields) -> Any:
    """Return how many consecutive packets contain returns of the same firings.

    The number is 2 with dual return, and 1 with single return.

    Source: M1 user guide, 2.1.2.
    """
    return np.where(f.wave_mode == WAVE_MODES["dual"], 2, 1)


def packets_per_frame(f: Fields) -> Any:
    """Return the number of packets in a frame, which is the highest packet number."""
    return SINGLE_RETURN_PACKETS * count_packets_per_firing(f)


def number_firings(f: Fields, blocks: int) -> Any:
    """Return the number of each block's firing, counted from the start of the frame."""
    group = np.floor((f.pkt_psn - 1) / count_packets_per_firing(f))
    return group * blocks + f.blocks.index


def pace(f: Fields) -> Any:
    """Return the time from one packet to the next, in seconds."""
    return 1 / (FRAME_RATE_HZ * packets_per_frame(f))


def points(f: Fields) -> Polar:
    """Return the points from the sent ranges and directions, in REP-103 axes.

    Source: M1P user guide, page 13.
    """
    channels = f.blocks.channels
    return Polar(
        range=channels.radius,
        azimuth=np.deg2rad(channels.azimuth),
        elevation=np.deg2rad(channels.elevation),
        intensity=channels.intensity,
        time=f.blocks.time_offset,
        ring=np.arange(CHANNELS),
        return_index=np.maximum(f.blocks.return_seq - 1, 0),
        column=number_firings(f, BLOCKS),
    )


@functools.cache
def simulated_angles(number: int) -> tuple[Any, Any]:
    """Return elevation and azimuth in degrees, (25, 5), of a simulated packet.

    `number` is the position of the packet in a frame with single return, counted from 0.

    Source: the field of view, the number of packets and the directions of the channels are from the
    guide; the pattern of the scan lines is assumed.
    """
    line, firing = np.divmod(number * BLOCKS + np.arange(BLOCKS), SIMULATED_LINE_FIRINGS)
    across = (firing + 0.5) / SIMULATED_LINE_FIRINGS - 0.5
    azimuth = np.where(line % 2, across, -across)[:, None] * 24 + np.array([48, 24, 0, -24, -48])
    elevation = 12.5 - 25 * line / (SINGLE_RETURN_PACKETS * BLOCKS // SIMULATED_LINE_FIRINGS - 1)
    return np.repeat(elevation[:, None], CHANNELS, axis=1), azimuth


def sweep(i: int, temperature: int = 105, *, is_dual: bool = False) -> dict[str, Any]:
    """Return the values of simulated packet i.

    Args:
        temperature: the raw byte, or degC if the firmware is known.
        is_dual: whether the sensor sends pairs of packets with dual return.
    """
    if is_dual:
        returns = 2
        mode = WAVE_MODES["dual"]
        return_seq = RETURN_NUMBERS["first"] + i % 2
    else:
        returns = 1
        mode = WAVE_MODES["strongest"]
        return_seq = RETURN_NUMBERS["single"]
    number = i % (SINGLE_RETURN_PACKETS * returns)
    time = i / (SINGLE_RETURN_PACKETS * returns * FRAME_RATE_HZ)
    elevation, azimuth = simulated_angles(number // returns)
    return {
        "pkt_psn": number + 1,
        "protocol_version": 0,
        "wave_mode": mode,
        "time_sync_mode": 0,
        "seconds": int(time),
        "microseconds": time % 1,
        "lidar_type": 0x10,
        "mems_tmp": temperature,
        "blocks.time_offset": BLOCK_OFFSETS_S,
        "blocks.return_seq": return_seq,
        "blocks.channels.elevation": elevation,
        "blocks.channels.azimuth": azimuth,
    }


def sweep_difop(i: int, *, is_dual: bool = False) -> dict[str, Any]:
    """Return the values of simulated device information, with factory settings."""
    addresses = {"lidar_ip": bytes([192, 168, 1, 200]), "host_ip": bytes([192, 168, 1, 102])}
    modes = {
        "return_mode": WAVE_MODES["dual" if is_dual else "strongest"],
        "time_sync_mode": 0,
        "time_sync_status": 0,
        "seconds": i,
        "microseconds": 0,
    }
    return {
        "frame_rate": FRAME_RATE_HZ,
        "msop_port": 6699,
        "difop_port": 7788,
        **addresses,
        **modes,
    }


def change_sweep(simulation: Simulation, **values: Any) -> Simulation:
    """Return a simulation whose sweep function is called with these arguments."""
    assert simulation.sweep is not None  # for mypy
    return dataclasses.replace(simulation, sweep=functools.partial(simulation.sweep, **values))


def select_firmware(sensor: Sensor, firmware: str) -> Sensor:
    """Return the sensor with the temperature in degC, by the formula of this firmware."""
    struct = Struct(*HEADER_START, TEMPERATURES[firmware], *BLOCKS_AND_TAIL)
    data = dataclasses.replace(sensor.frames["data"], struct=struct)
    return dataclasses.replace(
        sensor,
        frames={**sensor.frames, "data": data},
        simulation=change_sweep(sensor.simulation, temperature=25),
        info={**sensor.info, "temperature": "data.mems_tmp"},
    )


def select_simulated_returns(sensor: Sensor, returns: str) -> Sensor:
    """Return the sensor whose simulation sends and reports these returns."""
    is_dual = returns == "dual"
    difop = sensor.frames["difop"]
    difop = dataclasses.replace(difop, simulation=change_sweep(difop.simulation, is_dual=is_dual))
    return dataclasses.replace(
        sensor,
        frames={**sensor.frames, "difop": difop},
        simulation=change_sweep(sensor.simulation, is_dual=is_dual),
    )


def configure(
    sensor: Sensor,
    /,
    *,
    firmware: Literal["current", "2021"] | None = None,
    simulated_returns: Literal["single", "dual"] | None = None,
) -> Sensor:
    """Return the sensor for a known firmware, or with other simulated returns.

    Args:
        firmware: the formula of the temperature: "current" if the sent byte is degC + 80 (M1P user
            guide, rs_driver), "2021" if it is signed degC (rs_driver of April 2021).
        simulated_returns: the returns that the simulated sensor sends.
    """
    if firmware is not None:
        sensor = select_firmware(sensor, firmware)
    if simulated_returns is not None:
        sensor = select_simulated_returns(sensor, simulated_returns)
    return sensor


def make_reported(field: str, text: Callable[[Any], str] | None = None) -> Reported:
    """Return the `Reported` value of a field that all known layouts of DIFOP contain.

    `text` is a function that returns the value as text; by default, the value is unchanged.
    """
    return Reported(*(f"{name}.{field}" for name in LAYOUTS), text=text)


def describe_raw(values: Any) -> str:
    """Return a text with the raw values and a note that their unit is unknown."""
    numbers = ", ".join(map(str, values if isinstance(values, list) else [values]))
    return f"{numbers} (raw, the unit is not documented)"


def describe_faults(code: int) -> str:
    """Return a text with the fault code, whose bits are not documented."""
    if code == 0:
        return "none"
    return f"code {code:#04x} (not documented)"


#: The known layouts of DIFOP; only the first two have the serial number, currents and voltages.
LAYOUTS = ("difop", "difop_fov", "difop_guide")

M1 = Sensor(
    "robosense-m1",
    vendor="RoboSense",
    model="RS-LiDAR-M1, M1 Plus",
    frames={
        "data": Frame(DATA, data=True, plausible=plausible),
        # 1 packet a second (M1 user guide); an M1P sends 10
        "difop": Frame(DIFOP, simulation=Simulation(sweep_difop, rate=1)),
        "difop_fov": Frame(DIFOP_FOV, simulation=Simulation(sweep_difop)),
        "difop_guide": Frame(DIFOP_GUIDE, simulation=Simulation(sweep_difop)),
        "difop_other": Frame(DIFOP_OTHER),
    },
    points=points,
    scan=OnRewind("pkt_psn"),
    links={"data": Udp(6699, 7788)},
    # the time of the grandmaster as it is (issue rslidar_sdk 169), in PTP's own scale TAI
    clock=Clock(("seconds", "microseconds"), pace=pace, epoch="tai", status=make_clock_status()),
    sequence=PacketCounter(
        "pkt_psn", first=1, last=packets_per_frame, returns=count_packets_per_firing
    ),
    returns=("first", "last"),  # the nearer and the farther return (M1 user guide, Table 5)
    simulation=Simulation(sweep),
    range_limits=(0.2, 200.0),  # rs_driver's limits for this model
    vendor_axes=("forward", "left", "up"),
    turn=(FRAME_RATE_HZ, FRAME_RATE_HZ),
    configure=configure,
    info={
        "serial": Reported("difop.serial_number", "difop_fov.serial_number"),
        "firmware": make_reported("pl_firmware"),
        "ps_firmware": make_reported("ps_firmware"),
        "return_mode": make_reported("return_mode"),
        "sync_mode": make_reported("time_sync_mode"),
        "sync_status": make_reported("time_sync_status"),
        "voltages": Reported("difop.voltages", "difop_fov.voltages", text=describe_raw),
        "currents": Reported("difop.currents", "difop_fov.currents", text=describe_raw),
        "battery_voltage": Reported("difop_guide.battery_voltage", text=describe_raw),
        "faults": Reported("difop_guide.faults", text=describe_faults),
    },
    status="vectors",
    source=(
        "RS-LiDAR-M1 user guide 2.1.2 (Table 5); RS-LiDAR-M1P user guide, pages 9 to 14; rs_driver"
    ),
)
