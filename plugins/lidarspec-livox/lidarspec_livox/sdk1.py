"""Livox Mid-40, Mid-70, Horizon, Tele-15 and Avia: generation 1 of the protocol (Livox-SDK).

A Lidar broadcasts its identity once a second (`broadcast`, to port 55000). The host sends the
address for the data (`handshake`), and then a `heartbeat` each second. Without heartbeats, the
Lidar stops sending data. Point packets have neither checksum nor counter, so they are identified by
their length and header. The time from point to point depends on the model, and packets do not
contain it.

Source: Livox-SDK communication protocol 1.3.0, Livox-SDK 9306596 (livox_def.h, device_discovery.h)
and livox_ros_driver (lds.h: packet sizes, points a second). In livox_ros_driver, the size of a
point of type 3 is given as 9 bytes, but is 10 bytes. Ranges and fields of view are assumed. The
documents do not state which model sends which type of data, so all types are accepted for each
model. Packet version 5 is assumed. Hubs and the parameters of commands 0B to 0D are not supported.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial
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
    Float32l,
    Int8ul,
    Int16ul,
    Int32sl,
    Int32ul,
    Struct,
)

from lidarspec.spec import (
    Address,
    Checksummed,
    Choice,
    Clock,
    ClockState,
    ClockStatus,
    Command,
    Count,
    Crc,
    Every,
    Fields,
    Frame,
    Scaled,
    Sensor,
    Simulation,
    SizeOf,
    Udp,
    along,
    take,
    unix_time,
)
from lidarspec_livox.points import (
    DEPTH,
    DIRECTION,
    INERTIAL,
    MILLIMETRES,
    REFLECTIVITY,
    SOF,
    TAG,
    View,
    cartesian,
    imu,
    make_returns,
    simulated_angles,
    spherical,
)

CRC16 = Crc(16, 0x1021, init=0x9232, refin=True, refout=True)
CRC32 = Crc(32, 0x04C11DB7, init=0xAFE50D95, refin=True, refout=True, xorout=0xFFFFFFFF)
MAX_POSITION_M = 1000.0  # limit of the extrinsics: twice the range of the Tele-15
GPS = 3  # the timestamp type of dates
#: The types of timestamps (Livox SDK communication protocol 1.3.0).
TIMESTAMP_TYPES = {
    0: ClockState("not synchronized", False, epoch="boot"),
    1: ClockState("synchronized by PTP", True),
    GPS: ClockState("synchronized by GPS", True, epoch="utc"),
    4: ClockState("synchronized by PPS without a date", True, epoch="boot"),
}
IMU_RATE_HZ = 200
MODEL_TYPES = {"Mid-40": 1, "Tele-15": 2, "Horizon LiDAR": 3, "Mid-70": 6, "Avia": 7}
STATES = {"starting": 0, "normal": 1, "power_saving": 2, "standby": 3, "error": 4}
WORK_MODES = {name: STATES[name] for name in ("normal", "power_saving", "standby")}
CLOCKS = {"power_up": 0, "ptp": 1, "gps_and_pps": GPS, "pps": 4}
COMMAND_PORT = 55_501
DATA_PORT = 56_001
IMU_PORT = 56_002  # port of the host

#: The 64 bits of nanoseconds are split into parts that are exact in float64. They can also contain
#: a date.
TIMESTAMP = Struct(
    "low"
    / Int32ul
    * (
        "lowest 32 bits of the nanoseconds; in a date: years since 2000, month, day and hour,"
        " each in one byte"
    ),
    "middle" / Int16ul,
    "high"
    / Int16ul
    * "highest 16 bits of the nanoseconds; in a date: `middle` and `high` are the microseconds"
    " within the hour",
)


#: The status of a packet, 32 bits little-endian (livox_def.h, LidarErrorCode).
LEVEL = Enum(BitsInteger(2), normal=0, warning=1, error=2)
STATUS_CODE = ByteSwapped(
    BitStruct(
        "system" / LEVEL,
        "reserved" / BitsInteger(13),
        "time_sync" / Enum(BitsInteger(3), none=0, ptp=1, gps=2, pps=3, abnormal=4),
        "ptp_signal" / BitsInteger(1) * "1: present",
        "self_heating" / BitsInteger(1) * "1: the heater is on, because the temperature is low",
        "fan" / Enum(BitsInteger(1), normal=0, warning=1),
        "service_life" / Enum(BitsInteger(1), normal=0, ends_soon=1),
        "pps_signal" / BitsInteger(1) * "1: present",
        "firmware" / Enum(BitsInteger(1), normal=0, needs_update=1),
        "dirt" / Enum(BitsInteger(2), clean=0, dirty_or_blocked=1),
        "motor" / LEVEL,
        "voltage" / Enum(BitsInteger(2), normal=0, high=1, extremely_high=2),
        "temperature" / Enum(BitsInteger(2), normal=0, high_or_low=1, extreme=2),
    )
)


def make_packet(kind: int, *members: Any) -> Struct:
    """Return the struct of a data packet; `kind` is its data type."""
    return Struct(
        "version" / Const(5, Int8ul),
        "slot" / Int8ul,
        "lidar_id" / Int8ul,
        "reserved" / Int8ul,
        "status_code" / STATUS_CODE,
        "timestamp_type" / Enum(Int8ul, **CLOCKS) * "with gps_and_pps, the timestamp is a date",
        "data_type" / Const(kind, Int8ul),
        "timestamp" / TIMESTAMP,
        *members,
    )


def clock(f: Fields) -> tuple[Any, ...]:
    """Return the time in seconds, as four terms that are exact; their sum would be rounded."""
    low = f.timestamp.low
    middle = f.timestamp.middle
    high = f.timestamp.high
    is_date = f.timestamp_type == GPS
    year, month, day, hour = (np.mod(np.floor(low / 256**index), 256) for index in range(4))
    date = unix_time(year + 2000, month, day, hour)
    return (
        np.where(is_date, date, 281_474 * high),
        np.where(is_date, (65_536 * high + middle) * 1e-6, low * 1e-9),
        np.where(is_date, 0, middle * 4.294967296),
        np.where(is_date, 0, high * 0.976710656),
    )


def has_known_header(f: Fields) -> Any:
    """Return whether timestamp type, slot and Lidar number are in their ranges."""
    return (f.timestamp_type <= 4) & (f.timestamp_type != 2) & (f.slot <= 15) & (f.lidar_id <= 15)


#: Name -> type, shots per packet, returns per shot, fields of a shot.
DATA_TYPES: dict[str, tuple[int, int, int, tuple[Any, ...]]] = {
    "cartesian": (0, 100, 1, (*MILLIMETRES, REFLECTIVITY)),
    "spherical": (1, 100, 1, (*DEPTH, *DIRECTION, REFLECTIVITY)),
    "tagged": (2, 96, 1, (*MILLIMETRES, REFLECTIVITY, TAG)),
    "tagged_spherical": (3, 96, 1, (*DEPTH, *DIRECTION, REFLECTIVITY, TAG)),
    "dual": (4, 48, 2, (make_returns(2, *MILLIMETRES),)),
    "dual_spherical": (5, 48, 2, (*DIRECTION, make_returns(2, *DEPTH))),
    "triple": (7, 30, 3, (make_returns(3, *MILLIMETRES),)),
    "triple_spherical": (8, 30, 3, (*DIRECTION, make_returns(3, *DEPTH))),
}


def pace(f: Fields, rate: float) -> Any:
    """Return the seconds from each packet to the next, given the shots per second."""
    shots = np.zeros(max(kind for kind, *_ in DATA_TYPES.values()) + 1)
    for kind, count, _, _ in DATA_TYPES.values():
        shots[kind] = count
    return take(shots, f.data_type) / rate


def make_data_frame(name: str, rate: float, **more: Any) -> Frame:
    """Return the frame of one data type.

    Args:
        name: a key of `DATA_TYPES`.
        rate: shots per second.
    """
    kind, shots, returns, members = DATA_TYPES[name]
    is_spherical = name.endswith("spherical")
    tagged = kind > 1

    def points(f: Fields) -> Any:
        make_points = spherical if is_spherical else cartesian
        return make_points(
            f, along("points", np.arange(shots) / rate), returns=returns, tagged=tagged
        )

    def plausible(f: Fields) -> Any:
        if is_spherical:
            return has_known_header(f) & (f.points[0].zenith <= 180) & (f.points[0].azimuth <= 360)
        return has_known_header(f)

    shot = Struct(*members)
    return Frame(
        make_packet(kind, "points" / Array(shots, shot)),
        data=True,
        points=points,
        plausible=plausible,
        **more,
    )


def make_simulation(name: str, rate: float, view: View, **more: Any) -> Simulation:
    """Return a simulated Lidar that sends points of one data type.

    Args:
        name: a key of `DATA_TYPES`.
        rate: shots per second.
    """
    _, count, returns, _ = DATA_TYPES[name]
    shots = np.arange(count)[:, None] if returns > 1 else np.arange(count)

    def simulate_angles(i: int) -> tuple[Any, Any]:
        return simulated_angles(i * count + shots, rate, view)

    def sweep(i: int) -> dict[str, Any]:
        azimuth, elevation = simulate_angles(i)
        angles = {
            "points.azimuth": np.ravel(azimuth) % 360,
            "points.zenith": 90 - np.ravel(elevation),
        }
        return {**make_header(round(i * count * 1e9 / rate)), **angles}

    return Simulation(
        sweep, directions=lambda i: tuple(np.deg2rad(angle) for angle in simulate_angles(i)), **more
    )


def make_header(ns: int) -> dict[str, Any]:
    """Return the header values of a packet `ns` nanoseconds after power-up."""
    parts = {"low": ns % 2**32, "middle": (ns >> 32) % 2**16, "high": ns >> 48}
    header = {"slot": 1, "lidar_id": 1, "reserved": 0, "timestamp_type": 0}
    return header | {f"timestamp.{name}": part for name, part in parts.items()}


def make_message(packet_type: int, number: tuple[int, int] | None, *members: Any) -> Checksummed:
    """Return the struct of a control frame.

    Args:
        packet_type: `REQUEST`, `REPLY` or `NOTIFICATION`.
        number: the command set and id; None for the frames of several commands.
    """
    header = Struct(
        SOF,
        "version" / Const(1, Int8ul),
        "length" / SizeOf(Int16ul, "_"),
        "packet_type" / Const(packet_type, Int8ul) * "0: request, 1: reply, 2: notification",
        "seq" / Int16ul * "number of the frame; a reply has the number of its request",
        "crc16" / Int16ul,
    )
    names = ("cmd_set", "cmd_id")
    command_id = (
        name / (Int8ul if number is None else Const(number[index], Int8ul))
        for index, name in enumerate(names)
    )
    checked_header = "head" / Checksummed(header, field="crc16", algorithm=CRC16)
    return Checksummed(
        Struct(checked_header, *command_id, *members, "crc32" / Int32ul),
        field="crc32",
        algorithm=CRC32,
    )


RESULT = "result" / Enum(Int8ul, done=0, failed=1)
NET = (
    "mode" / Enum(Int8ul, dhcp=0, static=1),
    *(name / Bytes(4) for name in ("ip", "mask", "gateway")),
)
POSE = (
    *(name / Scaled(Float32l, 1, "deg") for name in ("roll", "pitch", "yaw")),
    *(axis / Scaled(Int32sl, 0.001, "m") for axis in "xyz"),
)
STATUS = (
    "status_code"
    / Int32ul
    * "the bits of `status_code` in point packets; during the start-up: its progress in"
    " percent"
)
REQUEST = 0
REPLY = 1
NOTIFICATION = 2
#: Command set and id of commands without arguments, of commands that set a setting, and of commands
#: that return a setting.
INFORMATION = (0, 2)
DISCONNECT = (0, 6)
ADDRESS = (0, 9)
EXTRINSICS = (1, 2)
SAMPLING = (0, 4)
COORDINATES = (0, 5)
MODE = (1, 0)
RAIN = (1, 3)
FAN = (1, 4)
RETURNS = (1, 6)
IMU = (1, 8)
GET_FAN = (1, 5)
GET_RETURNS = (1, 7)
GET_IMU = (1, 9)
#: The values of settings (livox_def.h).
SWITCH = {"off": 0, "on": 1}
RETURN_MODES = {"first": 0, "strongest": 1, "dual": 2, "triple": 3}
IMU_RATES = {"off": 0, "200_hz": 1}


DATE = (
    "year" / Int8ul * "years since 2000",
    "month" / Int8ul,
    "day" / Int8ul,
    "hour" / Int8ul,
    "microseconds" / Int32ul * "microseconds within the hour",
)


def make_command_frame(number: tuple[int, int] | None, *members: Any) -> Frame:
    """Return the frame of a command."""
    return Frame(make_message(REQUEST, number, *members), direction="out")


CONTROL: dict[str, Frame] = {
    "imu": Frame(
        make_packet(6, *INERTIAL),
        imu=imu,
        plausible=has_known_header,
        simulation=Simulation(lambda i: make_header(i * 10**9 // IMU_RATE_HZ), rate=IMU_RATE_HZ),
    ),
    "broadcast": Frame(
        make_message(
            NOTIFICATION,
            (0, 0),
            "broadcast_code" / Bytes(16),
            "device_type" / Enum(Int8ul, **MODEL_TYPES),
            "data_reserved" / Int16ul,
        )
    ),
    "abnormal": Frame(make_message(NOTIFICATION, (0, 7), STATUS)),
    "ack": Frame(make_message(REPLY, None, RESULT)),
    "fan": Frame(make_message(REPLY, GET_FAN, RESULT, "fan" / Enum(Int8ul, **SWITCH))),
    "returns": Frame(
        make_message(REPLY, GET_RETURNS, RESULT, "mode" / Enum(Int8ul, **RETURN_MODES))
    ),
    "imu_rate": Frame(make_message(REPLY, GET_IMU, RESULT, "rate" / Enum(Int8ul, **IMU_RATES))),
    "firmware": Frame(make_message(REPLY, INFORMATION, RESULT, "firmware" / Array(4, Int8ul))),
    "heartbeat_ack": Frame(
        make_message(
            REPLY,
            (0, 3),
            RESULT,
            "work_state" / Enum(Int8ul, **STATES),
            "feature" / BitStruct("reserved" / BitsInteger(7), "rain_and_fog" / BitsInteger(1)),
            STATUS,
        )
    ),
    "address": Frame(make_message(REPLY, ADDRESS, RESULT, *NET)),
    "extrinsics": Frame(make_message(REPLY, EXTRINSICS, RESULT, *POSE)),
    "ask": make_command_frame(None),
    "set": make_command_frame(None, "number" / Int8ul),
    "handshake": make_command_frame(
        (0, 1),
        "host" / Bytes(4),
        "data_port" / Int16ul,
        "command_port" / Int16ul,
        "imu_port" / Int16ul,
    ),
    "set_address": make_command_frame((0, 8), *NET),
    "reboot": make_command_frame((0, 0x0A), "delay" / Scaled(Int16ul, 0.001, "s")),
    "set_extrinsics": make_command_frame((1, 1), *POSE),
    "set_time": make_command_frame((1, 0x0A), *DATE),
}


def make_command(
    frame: str, reply: str | None = "ack", number: tuple[int, int] | None = None, **more: Any
) -> Command:
    """Return a command with a running number, which the reply repeats.

    `number` is the command set and id, if the frame serves several commands.
    """
    values = {} if number is None else dict(zip(("cmd_set", "cmd_id"), number, strict=True))
    defaults = {
        "values": {"head.seq": Count(16), **values, **more.pop("values", {})},
        "echoes": ("head.seq",),
        "link": "control",
        "retries": 1,
    }
    return Command(frame, reply=reply, **{**defaults, **more})


def make_setter(number: tuple[int, int], argument: str, names: Mapping[str, int]) -> Command:
    """Return a command that sets a setting to one of its named values."""
    return make_command("set", number=number, args={argument: ("number", Choice(**names))})


DONE = {"result": "done"}
COMMANDS: dict[str, Command] = {
    "handshake": make_command(
        "handshake",
        values={
            "host": Address(),
            "data_port": DATA_PORT,
            "command_port": COMMAND_PORT,
            "imu_port": IMU_PORT,
        },
        matches=DONE,
    ),
    "heartbeat": make_command("ask", "heartbeat_ack", (0, 3), every=1.0, retries=0),
    "start": make_command("set", number=SAMPLING, values={"number": 1}, matches=DONE, starts=True),
    "stop": make_command("set", number=SAMPLING, values={"number": 0}, matches=DONE, stops=True),
    "disconnect": make_command("ask", number=DISCONNECT, retries=0),
    "get_information": make_command("ask", "firmware", INFORMATION),
    "get_address": make_command("ask", "address", ADDRESS),
    "set_address": make_command(
        "set_address",
        args={
            "mode": ("mode", 0, 1),
            **{name: (name, Address()) for name in ("ip", "mask", "gateway")},
        },
        matches=DONE,
    ),
    "reboot": make_command("reboot", args={"delay": ("delay", 0, 65.535)}, retries=0),
    "set_coordinates": make_setter(COORDINATES, "coordinates", {"cartesian": 0, "spherical": 1}),
    "set_mode": make_setter(MODE, "mode", WORK_MODES),
    "set_rain_mode": make_setter(RAIN, "rain_mode", SWITCH),
    "set_fan": make_setter(FAN, "fan", SWITCH),
    "get_fan": make_command("ask", "fan", GET_FAN),
    "set_returns": make_setter(RETURNS, "returns", RETURN_MODES),
    "get_returns": make_command("ask", "returns", GET_RETURNS),
    "set_imu": make_setter(IMU, "rate", IMU_RATES),
    "get_imu": make_command("ask", "imu_rate", GET_IMU),
    "get_extrinsics": make_command("ask", "extrinsics", EXTRINSICS),
    "set_extrinsics": make_command(
        "set_extrinsics",
        args={
            **{name: (name, -360, 360) for name in ("roll", "pitch", "yaw")},
            **{axis: (axis, -MAX_POSITION_M, MAX_POSITION_M) for axis in "xyz"},
        },
        matches=DONE,
    ),
    "set_time": make_command(
        "set_time",
        args={
            "year": ("year", 0, 99),
            "month": ("month", 1, 12),
            "day": ("day", 1, 31),
            "hour": ("hour", 0, 23),
            "microseconds": ("microseconds", 0, 3_599_999_999),
        },
        matches=DONE,
    ),
}


@cache
def make_frames(rate: int, first: str) -> Mapping[str, Frame]:
    """Return all frames of the models that measure at this rate.

    Args:
        rate: shots per second.
        first: the data type that the models usually send.
    """
    usual = {first: make_data_frame(first, rate)}
    return (
        usual
        | {
            name: make_data_frame(
                name, rate, simulation=make_simulation(name, rate, DEFAULT_VIEWS[rate])
            )
            for name in DATA_TYPES
            if name != first
        }
        | CONTROL
    )


SIMULATED_ANSWERS = {"get_information": (("firmware", {**DONE, "firmware": [4, 11, 0, 6]}),)}
#: Shots per second -> simulated field of view for data types that a model does not usually send.
#: The first is the field of view of a Mid-40, the second of an Avia.
DEFAULT_VIEWS: dict[int, View] = {
    100_000: (-19.2, 19.2, -19.2, 19.2),
    240_000: (-35.2, 35.2, -38.6, 38.6),
}
#: Id -> model, device type, shots per second, usual data type, field of view, range limits in m.
MODELS: dict[str, tuple[str, int, int, str, View, tuple[float, float]]] = {
    "livox-mid40": (
        "Mid-40",
        1,
        100_000,
        "cartesian",
        DEFAULT_VIEWS[100_000],
        (1.0, 260.0),
    ),
    "livox-mid70": (
        "Mid-70",
        6,
        100_000,
        "cartesian",
        (-35.2, 35.2, -35.2, 35.2),
        (0.05, 260.0),
    ),
    "livox-horizon": (
        "Horizon LiDAR",
        3,
        240_000,
        "tagged",
        (-40.85, 40.85, -12.55, 12.55),
        (0.5, 260.0),
    ),
    "livox-tele15": (
        "Tele-15",
        2,
        240_000,
        "tagged",
        (-7.25, 7.25, -8.1, 8.1),
        (3.0, 500.0),
    ),
    "livox-avia": ("Avia", 7, 240_000, "tagged", DEFAULT_VIEWS[240_000], (1.0, 450.0)),
}


def make_lidar(name: str) -> Sensor:
    """Return the sensor of one row of `MODELS`."""
    model, device_type, rate, first, view, limits = MODELS[name]
    identity = {
        "head.seq": 0,
        "broadcast_code": b"0TFSIMULATED001",
        "device_type": device_type,
        "data_reserved": 0,
    }
    return Sensor(
        name,
        vendor="Livox",
        model=model,
        frames=make_frames(rate, first),
        points=None,
        scan=Every(0.1),
        links={
            "data": Udp(DATA_PORT, IMU_PORT, 55_000),
            "control": Udp(65_000, local=COMMAND_PORT),
        },
        commands=COMMANDS,
        clock=Clock(
            clock,
            pace=partial(pace, rate=rate),
            epoch="tai",  # PTP's own scale, unless the grandmaster sends UTC
            status=ClockStatus("timestamp_type", TIMESTAMP_TYPES),
        ),
        simulation=make_simulation(
            first,
            rate,
            view,
            answers={"handshake": (("ack", DONE), ("broadcast", identity)), **SIMULATED_ANSWERS},
        ),
        on_open=("handshake", "heartbeat", "get_information", "start"),
        on_close=("stop", "disconnect"),
        range_limits=limits,
        vendor_axes=("forward", "left", "up"),
        relatives={
            other: "its broadcast contains another device type"
            for other in MODELS
            if other != name and MODELS[other][2] == rate
        },
        info={
            "serial": "broadcast.broadcast_code",
            "model": "broadcast.device_type",
            "firmware": "firmware.firmware",
        },
        status="manual",
        acknowledged=(
            {
                "LS507": "the sensor cannot measure the walls of the small simulated room, because"
                " they are nearer than its shortest range"
            }
            if limits[0] > 1
            else {}
        ),
        source=(
            "Livox-SDK communication protocol 1.3.0; Livox-SDK 9306596; livox_ros_driver (lds.h);"
            " user manuals"
        ),
    )


MID40, MID70, HORIZON, TELE15, AVIA = SENSORS = [make_lidar(name) for name in MODELS]
