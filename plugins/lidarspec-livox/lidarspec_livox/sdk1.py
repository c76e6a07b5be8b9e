"""Livox Mid-40, Mid-70, Horizon, Tele-15 and Avia: the first generation of the protocol, which
Livox-SDK speaks.

A Lidar says once a second who it is (`broadcast`, to port 55000 of everybody). It is told where its
data go (`handshake`), and goes on as long as it hears a `heartbeat` each second. Packets of points
have no checksum and no counter, so that their length and header have to prove them; they do not say
either how far apart their points are in time, which is the model's.

Source: Livox-SDK communication protocol 1.3.0, Livox-SDK 9306596 (livox_def.h, device_discovery.h)
and livox_ros_driver (lds.h: packet sizes, points a second; it prints 9 bytes for a point of type 3,
which has 10). Ranges and fields of view are as remembered from the user manuals: assumed. Which
model sends which type of data is not said: all are read of each. That the version of a packet is 5
is assumed, since vectors have it and drivers do not look at it. Hubs are not here, nor are the
parameters of commands 0B to 0D.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache, partial
from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Float32l, Int8ul, Int16ul, Int32sl, Int32ul, Struct

from lidarspec.spec import (
    Address,
    Checksummed,
    Clock,
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
    echoes,
    imu,
    looking,
    spherical,
)

CRC16 = Crc(16, 0x1021, init=0x9232, refin=True, refout=True)
CRC32 = Crc(32, 0x04C11DB7, init=0xAFE50D95, refin=True, refout=True, xorout=0xFFFFFFFF)
FARTHEST = 1000.0  # metres; twice what the Tele-15 sees
GPS = 3  # the type of timestamps that are a date
IMU_RATE = 200  # samples a second
MODEL_TYPES = "1 Mid-40, 2 Tele-15, 3 Horizon LiDAR, 6 Mid-70, 7 Avia"
STATES = "0 starts, 1 normal, 2 saves power, 3 stands by, 4 error"
COMMAND_PORT = 55_501
DATA_PORT = 56_001
IMU_PORT = 56_002  # of this computer

#: in pieces that keep 64 bits of nanoseconds exact, and hold a date as well.
TIMESTAMP = Struct(
    "low"
    / Int32ul
    * "of nanoseconds; of a date years since 2000, month, day and hour, a byte each",
    "middle" / Int16ul,
    "high" / Int16ul * "with `middle`, of a date: microseconds within the hour",
)


def packet(kind: int, *members: Any) -> Struct:
    """Return a packet with data of one type behind the header."""
    return Struct(
        "version" / Const(5, Int8ul),
        "slot" / Int8ul,
        "lidar_id" / Int8ul,
        "reserved" / Int8ul,
        "status_code"
        / Int32ul
        * "bits 0-1 temperature, 2-3 voltage, 4-5 motor, 6-7 dirt ... 30-31 system: 0 normal, 1"
        " warning, 2 error",
        "timestamp_type" / Int8ul * "0 since power-up, 1 PTP, 3 GPS and PPS: a date, 4 PPS",
        "data_type" / Const(kind, Int8ul),
        "timestamp" / TIMESTAMP,
        *members,
    )


def clock(f: Fields) -> tuple[Any, ...]:
    """Return the terms of the time in seconds: of a date, or of a number of nanoseconds.

    Each term is exact.
    """
    low = f.timestamp.low
    middle = f.timestamp.middle
    high = f.timestamp.high
    dated = f.timestamp_type == GPS
    year, month, day, hour = (np.mod(np.floor(low / 256**place), 256) for place in range(4))
    date = unix_time(year + 2000, month, day, hour)
    return (
        np.where(dated, date, 281_474 * high),
        np.where(dated, (65_536 * high + middle) * 1e-6, low * 1e-9),
        np.where(dated, 0, middle * 4.294967296),
        np.where(dated, 0, high * 0.976710656),
    )


def is_known(f: Fields) -> Any:
    """A type of timestamp that there is, and a slot and a number as a hub counts them; a Lidar by
    itself has such numbers too.
    """
    return (f.timestamp_type <= 4) & (f.timestamp_type != 2) & (f.slot <= 15) & (f.lidar_id <= 15)


#: name -> type, shots of a packet, returns of each, fields of a shot.
TYPES: dict[str, tuple[int, int, int, tuple[Any, ...]]] = {
    "cartesian": (0, 100, 1, (*MILLIMETRES, REFLECTIVITY)),
    "spherical": (1, 100, 1, (*DEPTH, *DIRECTION, REFLECTIVITY)),
    "tagged": (2, 96, 1, (*MILLIMETRES, REFLECTIVITY, TAG)),
    "tagged_spherical": (3, 96, 1, (*DEPTH, *DIRECTION, REFLECTIVITY, TAG)),
    "dual": (4, 48, 2, (echoes(2, *MILLIMETRES),)),
    "dual_spherical": (5, 48, 2, (*DIRECTION, echoes(2, *DEPTH))),
    "triple": (7, 30, 3, (echoes(3, *MILLIMETRES),)),
    "triple_spherical": (8, 30, 3, (*DIRECTION, echoes(3, *DEPTH))),
}


def pace(f: Fields, rate: float) -> Any:
    """Return the seconds that the shots of a packet take, of so many shots a second."""
    shots = np.zeros(max(kind for kind, *_ in TYPES.values()) + 1)
    for kind, count, _, _ in TYPES.values():
        shots[kind] = count
    return take(shots, f.data_type) / rate


def data_frame(name: str, rate: float, **more: Any) -> Frame:
    """Points of one type, so many shots a second."""
    kind, shots, returns, members = TYPES[name]
    by_angles = name.endswith("spherical")
    tagged = kind > 1

    def points(f: Fields) -> Any:
        made = spherical if by_angles else cartesian
        return made(f, along("points", np.arange(shots) / rate), returns=returns, tagged=tagged)

    def plausible(f: Fields) -> Any:
        if by_angles:
            return is_known(f) & (f.points[0].zenith <= 180) & (f.points[0].azimuth <= 360)
        return is_known(f)

    shot = Struct(*members)
    return Frame(
        packet(kind, "points" / Array(shots, shot)),
        data=True,
        points=points,
        plausible=plausible,
        **more,
    )


def simulation(name: str, rate: float, view: View, **more: Any) -> Simulation:
    """What a simulated Lidar needs to send points of one type."""
    _, count, returns, _ = TYPES[name]
    shots = np.arange(count)[:, None] if returns > 1 else np.arange(count)

    def look(i: int) -> tuple[Any, Any]:
        return looking(i * count + shots, rate, view)

    def sweep(i: int) -> dict[str, Any]:
        azimuth, elevation = look(i)
        angles = {
            "points.azimuth": np.ravel(azimuth) % 360,
            "points.zenith": 90 - np.ravel(elevation),
        }
        return {**make_header(round(i * count * 1e9 / rate)), **angles}

    return Simulation(
        sweep, directions=lambda i: tuple(np.deg2rad(angle) for angle in look(i)), **more
    )


def make_header(ns: int) -> dict[str, Any]:
    """Return the header of a packet of this time since power-up."""
    pieces = {"low": ns % 2**32, "middle": (ns >> 32) % 2**16, "high": ns >> 48}
    header = {"slot": 1, "lidar_id": 1, "reserved": 0, "status_code": 0, "timestamp_type": 0}
    return header | {f"timestamp.{name}": piece for name, piece in pieces.items()}


def message(packet_type: int, number: tuple[int, int] | None, *members: Any) -> Checksummed:
    """A control frame: a header with a CRC of its own, the number of the command, and its data."""
    head = Struct(
        SOF,
        "version" / Const(1, Int8ul),
        "length" / SizeOf(Int16ul, "_"),
        "packet_type" / Const(packet_type, Int8ul) * "0 command, 1 answer, 2 message",
        "seq" / Int16ul * "that of the command, in an answer",
        "crc16" / Int16ul,
    )
    names = ("cmd_set", "cmd_id")
    numbers = (
        name / (Int8ul if number is None else Const(number[at], Int8ul))
        for at, name in enumerate(names)
    )
    sealed = "head" / Checksummed(head, field="crc16", algorithm=CRC16)
    return Checksummed(
        Struct(sealed, *numbers, *members, "crc32" / Int32ul), field="crc32", algorithm=CRC32
    )


RESULT = "result" / Int8ul * "0 done, 1 failed"
NET = (
    "mode" / Int8ul * "0 DHCP, 1 static",
    *(name / Bytes(4) for name in ("ip", "mask", "gateway")),
)
POSE = (
    *(name / Scaled(Float32l, 1, "deg") for name in ("roll", "pitch", "yaw")),
    *(axis / Scaled(Int32sl, 0.001, "m") for axis in "xyz"),
)
STATUS = "status_code" / Int32ul * "as in packets of points; while it starts, per cent"
ASK = 0
ANSWER = 1
TELL = 2
#: (set, number) of what is asked without more, of what is set to a number, and of what is answered
#: with one.
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


DATE = (
    "year" / Int8ul * "since 2000",
    "month" / Int8ul,
    "day" / Int8ul,
    "hour" / Int8ul,
    "microseconds" / Int32ul * "within the hour",
)


def out(number: tuple[int, int] | None, *members: Any) -> Frame:
    """Return a command."""
    return Frame(message(ASK, number, *members), direction="out")


CONTROL: dict[str, Frame] = {
    "imu": Frame(
        packet(6, *INERTIAL),
        imu=imu,
        plausible=is_known,
        simulation=Simulation(lambda i: make_header(i * 10**9 // IMU_RATE), rate=IMU_RATE),
    ),
    "broadcast": Frame(
        message(
            TELL,
            (0, 0),
            "broadcast_code" / Bytes(16),
            "device_type" / Int8ul * MODEL_TYPES,
            "data_reserved" / Int16ul,
        )
    ),
    "abnormal": Frame(message(TELL, (0, 7), STATUS)),
    "ack": Frame(message(ANSWER, None, RESULT)),
    "number": Frame(message(ANSWER, None, RESULT, "number" / Int8ul)),
    "firmware": Frame(message(ANSWER, INFORMATION, RESULT, "firmware" / Array(4, Int8ul))),
    "heartbeat_ack": Frame(
        message(
            ANSWER,
            (0, 3),
            RESULT,
            "work_state" / Int8ul * STATES,
            "feature" / Int8ul * "bit 0: rain and fog",
            STATUS,
        )
    ),
    "address": Frame(message(ANSWER, ADDRESS, RESULT, *NET)),
    "extrinsics": Frame(message(ANSWER, EXTRINSICS, RESULT, *POSE)),
    "ask": out(None),
    "set": out(None, "number" / Int8ul),
    "handshake": out(
        (0, 1),
        "host" / Bytes(4),
        "data_port" / Int16ul,
        "command_port" / Int16ul,
        "imu_port" / Int16ul,
    ),
    "set_address": out((0, 8), *NET),
    "reboot": out((0, 0x0A), "delay" / Scaled(Int16ul, 0.001, "s")),
    "set_extrinsics": out((1, 1), *POSE),
    "set_time": out((1, 0x0A), *DATE),
}


def command(
    frame: str, reply: str | None = "ack", number: tuple[int, int] | None = None, **more: Any
) -> Command:
    """A command with a running number, which the answer repeats, and its number where the frame is
    for several.
    """
    values = {} if number is None else dict(zip(("cmd_set", "cmd_id"), number, strict=True))
    own = {
        "values": {"head.seq": Count(16), **values, **more.pop("values", {})},
        "echoes": ("head.seq",),
        "link": "control",
        "retries": 1,
    }
    return Command(frame, reply=reply, **{**own, **more})


def setter(number: tuple[int, int], low: int, high: int) -> Command:
    """Return a command that sets something to a number."""
    return command("set", number=number, args={"number": ("number", low, high)})


def getter(number: tuple[int, int]) -> Command:
    """Return a command that asks for a number."""
    return command("ask", "number", number)


DONE = {"result": 0}
COMMANDS: dict[str, Command] = {
    "handshake": command(
        "handshake",
        values={
            "host": Address(),
            "data_port": DATA_PORT,
            "command_port": COMMAND_PORT,
            "imu_port": IMU_PORT,
        },
        matches=DONE,
    ),
    "heartbeat": command("ask", "heartbeat_ack", (0, 3), every=1.0, retries=0),
    "start": command("set", number=SAMPLING, values={"number": 1}, matches=DONE, starts=True),
    "stop": command("set", number=SAMPLING, values={"number": 0}, matches=DONE, stops=True),
    "disconnect": command("ask", number=DISCONNECT, retries=0),
    "get_information": command("ask", "firmware", INFORMATION),
    "get_address": command("ask", "address", ADDRESS),
    "set_address": command(
        "set_address",
        args={
            "mode": ("mode", 0, 1),
            **{name: (name, Address()) for name in ("ip", "mask", "gateway")},
        },
        matches=DONE,
    ),
    "reboot": command("reboot", args={"delay": ("delay", 0, 65.535)}, retries=0),
    "set_coordinates": setter(COORDINATES, 0, 1),
    "set_mode": setter(MODE, 1, 3),
    "set_rain_mode": setter(RAIN, 0, 1),
    "set_fan": setter(FAN, 0, 1),
    "get_fan": getter(GET_FAN),
    "set_returns": setter(RETURNS, 0, 3),
    "get_returns": getter(GET_RETURNS),
    "set_imu": setter(IMU, 0, 1),
    "get_imu": getter(GET_IMU),
    "get_extrinsics": command("ask", "extrinsics", EXTRINSICS),
    "set_extrinsics": command(
        "set_extrinsics",
        args={
            **{name: (name, -360, 360) for name in ("roll", "pitch", "yaw")},
            **{axis: (axis, -FARTHEST, FARTHEST) for axis in "xyz"},
        },
        matches=DONE,
    ),
    "set_time": command(
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
def frames(rate: int, first: str) -> Mapping[str, Frame]:
    """All frames of the models with so many shots a second, of which the first type of data is what
    they usually send.
    """
    own = {first: data_frame(first, rate)}
    return (
        own
        | {
            name: data_frame(name, rate, simulation=simulation(name, rate, WIDEST[rate]))
            for name in TYPES
            if name != first
        }
        | CONTROL
    )


ANSWERS = {
    "get_information": (("firmware", {**DONE, "firmware": [4, 11, 0, 6]}),)
}  # of a simulated one
#: shots a second -> what a simulated one of these sees with types of data that it does not usually
#: send: a Mid-40's view, an Avia's.
WIDEST: dict[int, View] = {100_000: (-19.2, 19.2, -19.2, 19.2), 240_000: (-35.2, 35.2, -38.6, 38.6)}
#: id -> model, device type, shots a second, usual type of data, view, ranges, other ids.
MODELS: dict[str, tuple[str, int, int, str, View, tuple[float, float]]] = {
    "livox-mid40": (
        "Mid-40",
        1,
        100_000,
        "cartesian",
        WIDEST[100_000],
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
    "livox-avia": ("Avia", 7, 240_000, "tagged", WIDEST[240_000], (1.0, 450.0)),
}


def lidar(name: str) -> Sensor:
    """One row of the table as a sensor."""
    model, device_type, rate, first, view, limits = MODELS[name]
    who = {
        "head.seq": 0,
        "broadcast_code": b"0TFSIMULATED001",
        "device_type": device_type,
        "data_reserved": 0,
    }
    return Sensor(
        name,
        vendor="Livox",
        model=model,
        frames=frames(rate, first),
        points=None,
        scan=Every(0.1),
        links={
            "data": Udp(DATA_PORT, IMU_PORT, 55_000),
            "control": Udp(65_000, local=COMMAND_PORT),
        },
        commands=COMMANDS,
        clock=Clock(clock, pace=partial(pace, rate=rate)),
        simulation=simulation(
            first, rate, view, answers={"handshake": (("ack", DONE), ("broadcast", who)), **ANSWERS}
        ),
        on_open=("handshake", "heartbeat", "get_information", "start"),
        on_close=("stop", "disconnect"),
        range_limits=limits,
        vendor_axes=("forward", "left", "up"),
        relatives={
            other: "the device type in what it broadcasts"
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
            {"LS507": "it sees nothing in a small room, which is nearer than its shortest range"}
            if limits[0] > 1
            else {}
        ),
        source=(
            "Livox-SDK communication protocol 1.3.0; Livox-SDK 9306596; livox_ros_driver (lds.h);"
            " user manuals"
        ),
    )


MID40, MID70, HORIZON, TELE15, AVIA = SENSORS = [lidar(name) for name in MODELS]
