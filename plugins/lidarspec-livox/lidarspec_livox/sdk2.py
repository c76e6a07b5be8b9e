"""Livox Mid-360 and HAP: generation 2 of the protocol (Livox-SDK2).

Points, IMU samples and parameters are sent over UDP, each from and to its own port. After `start`,
a Lidar sends points to the host that was set with `set_point_host`. It sends its parameters once a
second without a request. Point packets with a CRC of 0 are accepted without a check, because some
firmware of the Mid-360 is reported to send them.

Source: Livox Mid-360 protocol document 1.4.10 and Livox-SDK2 08f523c (livox_lidar_def.h); for
differences of the HAP, HAP protocol document 1.4.8. The point rate, range limits and field of view
of the HAP are from its user manual, table 1.2.1; those of the Mid-360 are assumed.
livox_ros_driver2 divides `time_interval` by the number of points, but the document divides it by
this number minus 1. The difference is 1 %. This module follows the driver. The HAP is assumed to
accept the commands of a Mid-360, because the SDK sends the same commands to both. The port for the
state of a HAP is unknown, so its state is not requested. Commands for logs and firmware are not
supported. Parameters with unknown keys are returned as bytes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from construct import (
    Array,
    Bytes,
    Const,
    Default,
    Enum,
    Float32l,
    Int8ul,
    Int16ul,
    Int32sl,
    Int32ul,
    Int64sl,
    Int64ul,
    Struct,
    this,
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
    PacketCounter,
    Parts,
    Relative,
    Scaled,
    Sensor,
    Simulation,
    SizeOf,
    Udp,
    steps,
)
from lidarspec_livox.points import (
    CENTIMETRES,
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

DISCOVERY_PORT = 56_000  # receives broadcast requests
REBOOT = 0x0200
FACTORY_SETTINGS = 0x0201
SET_GPS_TIME = 0x0202
CRC32 = Crc(32, 0x04C11DB7, init=0xFFFFFFFF, refin=True, refout=True, xorout=0xFFFFFFFF)
CRC16 = Crc(16, 0x1021, init=0xFFFF)
MAX_DATAGRAM_BYTES = 1472  # without fragmentation
VARIABLE_COUNT = {"LS203": "a datagram can contain any number of parameters"}
SHOTS = np.arange(96)  # shot numbers of a simulated packet
IMU_RATE_HZ = 200
DEVICE_TYPES = {"MID-360": 9, "HAP, industrial": 10, "HAP": 15, "MID-360S": 35}


#: The types of timestamps (Mid-360 protocol document, point data, time_type).
TIME_TYPES = {
    0: ClockState("not synchronized", False, epoch="boot"),
    1: ClockState("synchronized by PTP or gPTP", True),
    2: ClockState("synchronized by GPS", True, epoch="utc"),
}


def make_packet(kind: int, *members: Any) -> Checksummed:
    """Return the struct of a data packet; `kind` is its data type."""
    header = Struct(
        "version" / Const(0, Int8ul),
        "length" / SizeOf(Int16ul),
        "time_interval" / Scaled(Int16ul, 1e-7, "s") * "time from the first point to the last",
        "dot_num" / Int16ul,
        "udp_cnt" / Int16ul * "packet counter within the frame",
        "frame_cnt" / Int8ul * "frame counter; not used if the scan pattern is non-repetitive",
        "data_type" / Const(kind, Int8ul),
        "time_type" / Enum(Int8ul, power_up=0, ptp_or_gptp=1, gps=2),
        "pack_info" / Default(Int8ul, 0) * "format of the tags; only some firmware versions set it",
        "reserved" / Default(Bytes(11), bytes(11)),
        "crc32" / Int32ul * "CRC of all following bytes; 0: not set",
        "timestamp" / Scaled(Int64ul, 1, "ns") * "time of the first point",
        *members,
    )
    covered = ("timestamp", *(member.name for member in members))
    return Checksummed(header, field="crc32", algorithm=CRC32, over=covered, absent=(0,))


def point_times(f: Fields) -> Any:
    """Return the seconds from the first point of a packet to each point."""
    return steps(f.dot_num) * (f.time_interval / f.dot_num)


def has_points(f: Fields) -> Any:
    """Return whether a packet has points."""
    return f.dot_num >= 1


def dual_points(f: Fields) -> Any:
    """Return the points of both returns of each shot, at the time of the shot."""
    return cartesian(f, point_times(f).on("points"), returns=2)


def make_points_frame(kind: int, points: Any, *members: Any, **more: Any) -> Frame:
    """Return the frame of one type of points.

    Args:
        members: the fields of a shot.
    """
    struct = make_packet(kind, "points" / Array(this.dot_num, Struct(*members)))
    return Frame(
        struct,
        data=True,
        max_length=MAX_DATAGRAM_BYTES,
        plausible=has_points,
        points=points,
        **more,
    )


def make_message(cmd_id: int | None, *members: Any, ack: bool = True, lidar: bool = True) -> Any:
    """Return the struct of a control frame: header with CRC-16, data with CRC-32.

    Args:
        cmd_id: the command; None for frames of several commands.
    """
    header = Struct(
        SOF,
        "version" / Const(0, Int8ul),
        "length" / SizeOf(Int16ul, "_"),
        "seq" / Int32ul * "message number; a reply has the number of its request",
        "cmd_id" / (Int16ul if cmd_id is None else Const(cmd_id, Int16ul)),
        "cmd_type" / Const(int(ack), Int8ul) * "0: request, 1: reply",
        "sender_type" / Const(int(lidar), Int8ul) * "0: host, 1: Lidar",
        "reserved" / Default(Bytes(6), bytes(6)),
        "crc16" / Int16ul,
    )
    checked_header = "head" / Checksummed(header, field="crc16", algorithm=CRC16)
    if not members:
        return Struct(checked_header, "crc32" / Const(0, Int32ul))
    return Checksummed(
        Struct(checked_header, "crc32" / Int32ul, *members),
        field="crc32",
        algorithm=CRC32,
        over=[member.name for member in members],
    )


NUMBER = Int8ul
HOST = Struct("ip" / Bytes(4), "host_port" / Int16ul, "lidar_port" / Int16ul)
NET = Struct("ip" / Bytes(4), "mask" / Bytes(4), "gateway" / Bytes(4))
ATTITUDE = Struct(
    *(name / Scaled(Float32l, 1, "deg") for name in ("roll", "pitch", "yaw")),
    *(axis / Scaled(Int32sl, 0.001, "m") for axis in "xyz"),
)
FOV = Struct(
    *(name / Int32sl for name in ("yaw_start", "yaw_stop", "pitch_start", "pitch_stop")),
    "reserved" / Default(Bytes(4), bytes(4)),
)
#: Name -> key and value type of a parameter (Mid-360 protocol document; livox_lidar_def.h).
PARAMETERS: dict[str, tuple[int, Any]] = {
    "point_type": (0x0000, Enum(NUMBER, millimetres=1, centimetres=2, spherical=3)),
    "scan_pattern": (
        0x0001,
        Enum(NUMBER, non_repetitive=0, repetitive=1, repetitive_low_frame_rate=2),
    ),
    "lidar_address": (0x0004, NET),
    "state_host": (0x0005, HOST),
    "point_host": (0x0006, HOST),
    "imu_host": (0x0007, HOST),
    "attitude": (0x0012, ATTITUDE),
    "fov_0": (0x0015, FOV),
    "fov_1": (0x0016, FOV),
    "fov_enabled": (0x0017, Enum(NUMBER, none=0, fov_0=1, fov_1=2, both=3)),
    "detect_mode": (0x0018, Enum(NUMBER, normal=0, sensitive=1)),
    "io_functions": (0x0019, Bytes(4)),
    "work_mode": (0x001A, Enum(NUMBER, sampling=1, idle=2, ready=9)),
    "imu_enabled": (0x001C, Enum(NUMBER, off=0, on=1)),
    "serial": (0x8000, Bytes(16)),
    "app_version": (0x8002, Array(4, Int8ul)),
    "loader_version": (0x8003, Array(4, Int8ul)),
    "hardware_version": (0x8004, Array(4, Int8ul)),
    "mac": (0x8005, Bytes(6)),
    "work_state": (
        0x8006,
        Enum(
            NUMBER,
            sampling=1,
            idle=2,
            error=4,
            self_check=5,
            motor_starting=6,
            upgrade=8,
            ready=9,
        ),
    ),
    "core_temperature": (0x8007, Scaled(Int32sl, 0.01, "degC")),
    "power_ups": (0x8008, Int32ul),
    "local_time": (0x8009, Scaled(Int64ul, 1, "ns")),
    "last_sync": (0x800A, Scaled(Int64ul, 1, "ns")),
    "time_offset": (0x800B, Scaled(Int64sl, 1, "ns")),
    "time_sync": (0x800C, Enum(NUMBER, none=0, ptp=1, gptp=2, gps=3)),
    "diagnosis": (0x800E, Int16ul),
    "firmware_type": (0x8010, Enum(NUMBER, loader=0, application=1)),
    "hms_codes": (0x8011, Array(8, Int32ul)),
}


def make_parameter(name: str) -> Struct:
    """Return the struct of a parameter with its key and length."""
    key, value = PARAMETERS[name]
    return Struct(
        "key" / Const(key, Int16ul), "length" / Const(value.sizeof(), Int16ul), name / value
    )


PARAMETER_LIST = (
    "parameters"
    / Parts(
        {
            **{name: make_parameter(name) for name in PARAMETERS},
            "other": Struct("key" / Int16ul, "length" / Int16ul, "value" / Bytes(this.length)),
        },
        count=this.count,
    ),
)
RESERVED = "data_reserved" / Default(Int16ul, 0)
RESULT = "result" / Enum(
    Int8ul,
    done=0,
    failed=1,
    not_now=2,
    out_of_range=3,
    unknown_key=20,
    after_a_reboot=21,
    read_only=22,
    wrong_length=23,
    wrong_number_of_keys=24,
)


def make_set_frame(*values: Any) -> Frame:
    """Return the frame of a request to set one parameter."""
    value = Struct("key" / Int16ul, "size" / SizeOf(Int16ul, "value"), "value" / Struct(*values))
    return Frame(
        make_message(
            0x0100,
            "key_count" / Const(1, Int16ul),
            RESERVED,
            "parameter" / value,
            ack=False,
            lidar=False,
        ),
        direction="out",
    )


def make_simulation(rate: float, view: View, shots: Any = SHOTS, **more: Any) -> Simulation:
    """Return the simulation of a Lidar.

    Args:
        rate: the number of shots per second.
        shots: the numbers of the shots in a packet.
    """
    points = len(shots)

    def simulate_angles(i: int) -> tuple[Any, Any]:
        return simulated_angles(i * points + shots, rate, view)

    def sweep(i: int) -> dict[str, Any]:
        azimuth, elevation = simulate_angles(i)
        frame, number = divmod(i, int(rate / 10 / points))
        return {
            "time_interval": points / rate,
            "dot_num": points,
            "udp_cnt": number,
            "frame_cnt": frame % 256,
            "timestamp": round(i * points * 1e9 / rate),
            "points.azimuth": azimuth % 360,
            "points.zenith": 90 - elevation,
        }

    return Simulation(
        sweep, directions=lambda i: tuple(np.deg2rad(angle) for angle in simulate_angles(i)), **more
    )


def imu_values(i: int) -> dict[str, Any]:
    """Return the simulated values of IMU packet i."""
    return {
        "time_interval": 0,
        "dot_num": 1,
        "udp_cnt": i % 65_536,
        "frame_cnt": 0,
        "timestamp": i * 10**9 // IMU_RATE_HZ,
    }


def state_values(i: int) -> dict[str, Any]:
    """Return the simulated parameters that a Lidar sends once a second."""
    values = {
        "serial": b"SIMULATED",
        "app_version": [13, 18, 2, 40],
        "work_state": 1,
        "core_temperature": 41.5,
    }
    parameters = [
        {"key": PARAMETERS[name][0], "length": PARAMETERS[name][1].sizeof(), name: value}
        for name, value in values.items()
    ]
    return {"head.seq": i, "parameters": parameters}


FRAMES: dict[str, Frame] = {
    "data": make_points_frame(
        1, lambda f: cartesian(f, point_times(f)), *MILLIMETRES, REFLECTIVITY, TAG
    ),
    "centimetres": make_points_frame(
        2, lambda f: cartesian(f, point_times(f)), *CENTIMETRES, REFLECTIVITY, TAG
    ),
    "spherical": make_points_frame(
        3, lambda f: spherical(f, point_times(f)), *DEPTH, *DIRECTION, REFLECTIVITY, TAG
    ),
    "dual": make_points_frame(
        0x11,
        dual_points,
        make_returns(2, *MILLIMETRES),
        simulation=make_simulation(226_000, (-60, 60, -12.5, 12.5), SHOTS[:48, None]),
    ),
    "imu": Frame(
        make_packet(0, *INERTIAL),
        imu=imu,
        plausible=lambda f: f.dot_num == 1,
        simulation=Simulation(imu_values, rate=IMU_RATE_HZ),
    ),
    "state": Frame(
        make_message(0x0102, "count" / Int16ul, RESERVED, *PARAMETER_LIST, ack=False),
        max_length=MAX_DATAGRAM_BYTES,
        simulation=Simulation(state_values, rate=1),
        acknowledged=VARIABLE_COUNT,
    ),
    "discovery": Frame(
        make_message(
            0x0000,
            RESULT,
            "device_type" / Enum(Int8ul, **DEVICE_TYPES),
            "serial" / Bytes(16),
            "address" / Bytes(4),
            "command_port" / Int16ul,
        )
    ),
    "set_ack": Frame(make_message(0x0100, RESULT, "wrong_key" / Int16ul)),
    "parameters": Frame(
        make_message(0x0101, RESULT, "count" / Int16ul, *PARAMETER_LIST),
        max_length=MAX_DATAGRAM_BYTES,
        acknowledged=VARIABLE_COUNT,
    ),
    "ack": Frame(
        make_message(None, RESULT),
        plausible=lambda f: (f.head.cmd_id >= REBOOT) & (f.head.cmd_id <= SET_GPS_TIME),
        simulation=Simulation(lambda i: {"head.seq": i, "head.cmd_id": REBOOT, "result": 0}),
    ),
    "discover": Frame(make_message(0x0000, ack=False, lidar=False), direction="out"),
    "get": Frame(
        make_message(
            0x0101,
            "count" / Int16ul,
            RESERVED,
            "wanted" / Array(this.count, Int16ul),
            ack=False,
            lidar=False,
        ),
        direction="out",
        max_length=MAX_DATAGRAM_BYTES,
    ),
    "set_number": make_set_frame("number" / Int8ul),
    "set_host": make_set_frame(*HOST.subcons),
    "set_net": make_set_frame(*NET.subcons),
    "set_attitude": make_set_frame(*ATTITUDE.subcons),
    "set_fov": make_set_frame(*FOV.subcons),
    "reboot": Frame(
        make_message(REBOOT, "delay" / Scaled(Int16ul, 0.001, "s"), ack=False, lidar=False),
        direction="out",
    ),
    "factory_settings": Frame(
        make_message(
            FACTORY_SETTINGS, "data" / Default(Bytes(16), bytes(16)), ack=False, lidar=False
        ),
        direction="out",
    ),
    "set_gps_time": Frame(
        make_message(
            SET_GPS_TIME,
            "type" / Const(2, Int8ul),
            "time" / Scaled(Int64ul, 1, "ns"),
            ack=False,
            lidar=False,
        ),
        direction="out",
    ),
}


def make_request(
    frame: str, reply: str, values: Mapping[str, Any] | None = None, **more: Any
) -> Command:
    """Return a request with a running number, which the reply repeats."""
    defaults = {
        "values": {"head.seq": Count(16), **(values or {})},
        "reply": reply,
        "echoes": ("head.seq",),
        "link": "control",
        "retries": 1,
    }
    return Command(frame, **{**defaults, **more})


def make_setter(
    frame: str,
    name: str,
    values: Mapping[str, Any] | None = None,
    args: Mapping[str, Any] | None = None,
    **more: Any,
) -> Command:
    """Return a command that sets one parameter.

    Args:
        name: a key of `PARAMETERS`.
        values: the fixed values, by the name of a field in the parameter.
        args: for each argument, the name of a field in the parameter and the range.
    """
    all_values = {
        "parameter.key": PARAMETERS[name][0],
        **{f"parameter.value.{path}": value for path, value in (values or {}).items()},
    }
    all_args = {
        argument: (f"parameter.value.{path}", *limits)
        for argument, (path, *limits) in (args or {}).items()
    }
    return make_request(frame, "set_ack", all_values, args=all_args, matches={"result": 0}, **more)


def make_choice_setter(name: str) -> Command:
    """Return a command that sets a parameter to one of its named values."""
    enum = PARAMETERS[name][1]
    names = {text: value for value, text in enum.ksymapping.items()}
    return make_setter("set_number", name, args={name: ("number", Choice(**names))})


def make_host_setter(name: str, port: int, lidar_port: int) -> Command:
    """Return a command that makes the Lidar send one kind of data to this computer."""
    return make_setter(
        "set_host", name, {"ip": Address(), "host_port": port, "lidar_port": lidar_port}
    )


def make_mode_setter(mode: int, **more: Any) -> Command:
    """Return a command that sets the work mode."""
    return make_setter("set_number", "work_mode", {"number": mode}, **more)


MAX_POSITION_M = 1000.0  # of the attitude
COMMANDS: dict[str, Command] = {
    "start": make_mode_setter(1, starts=True),
    "stop": make_mode_setter(2, stops=True),
    "set_point_type": make_choice_setter("point_type"),
    "set_scan_pattern": make_choice_setter("scan_pattern"),
    "set_detect_mode": make_choice_setter("detect_mode"),
    "set_imu": make_choice_setter("imu_enabled"),
    "enable_fov": make_choice_setter("fov_enabled"),
    "set_address": make_setter(
        "set_net",
        "lidar_address",
        args={name: (name, Address()) for name in ("ip", "mask", "gateway")},
    ),
    "set_attitude": make_setter(
        "set_attitude",
        "attitude",
        args={
            **{name: (name, -360, 360) for name in ("roll", "pitch", "yaw")},
            **{axis: (axis, -MAX_POSITION_M, MAX_POSITION_M) for axis in "xyz"},
        },
    ),
    **{
        f"set_{name}": make_setter(
            "set_fov",
            name,
            args={
                **{name: (name, 0, 360) for name in ("yaw_start", "yaw_stop")},
                **{name: (name, -90, 90) for name in ("pitch_start", "pitch_stop")},
            },
        )
        for name in ("fov_0", "fov_1")
    },
    "get": make_request(
        "get", "parameters", {"count": 1, "wanted": [0]}, args={"key": ("wanted[0]", 0, 0xFFFF)}
    ),
    "get_state": make_request(
        "get", "parameters", {"count": 5, "wanted": [0x8000, 0x8002, 0x8006, 0x8007, 0x800C]}
    ),
    "reboot": make_request(
        "reboot", "ack", args={"delay": ("delay", 0.1, 2.0)}, matches={"result": 0}, retries=0
    ),
    "factory_settings": make_request("factory_settings", "ack", matches={"result": 0}, retries=0),
    "set_gps_time": make_request(
        "set_gps_time", "ack", args={"time": ("time", 0, 2**63)}, matches={"result": 0}
    ),
}


#: Kind of data -> port of the Lidar, port of the host.
Ports = dict[str, tuple[int, int]]
#: Id -> model, device type, command ports of Lidar and host, data ports, points per second,
#: field of view, range limits in m.
MODELS: dict[str, tuple[str, int, int, int, Ports, int, View, tuple[float, float]]] = {
    "livox-mid360": (
        "Mid-360",
        9,
        56_100,
        56_101,
        {"point": (56_300, 56_301), "imu": (56_400, 56_401), "state": (56_200, 56_201)},
        200_000,
        (-180, 180, -7, 52),
        (0.1, 70.0),
    ),
    "livox-hap": (
        "HAP",
        15,
        DISCOVERY_PORT,
        0,
        {"point": (57_000, 57_000), "imu": (58_000, 58_000)},
        452_000,
        (-60, 60, -12.5, 12.5),
        (0.5, 150.0),
    ),
}


def answer_state(request: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return the simulated reply to a request for the state."""
    return (("parameters", {"result": 0, **state_values(request["head.seq"])}),)


def make_lidar(name: str) -> Sensor:
    """Return the sensor of one row of `MODELS`."""
    model, device_type, control, local, ports, rate, view, limits = MODELS[name]
    discovery = "control" if control == DISCOVERY_PORT else "discovery"
    discovery_reply = {
        "result": 0,
        "device_type": device_type,
        "serial": b"SIMULATED",
        "address": bytes([127, 0, 0, 1]),
        "command_port": control,
    }
    return Sensor(
        name,
        vendor="Livox",
        model=model,
        frames=FRAMES,
        points=None,
        scan=Every(0.1),
        links={
            "data": Udp(*(port for _, port in ports.values())),
            "control": Udp(control, local=local),
            discovery: Udp(DISCOVERY_PORT, broadcast=DISCOVERY_PORT),
        },
        commands={
            "discover": make_request("discover", "discovery", link=discovery),
            **COMMANDS,
            **{
                f"set_{kind}_host": make_host_setter(f"{kind}_host", port, source)
                for kind, (source, port) in ports.items()
            },
        },
        # the counter restarts with each frame, and frames have no fixed number of packets
        clock=Clock(
            "timestamp",
            pace=lambda f: f.time_interval,
            epoch="tai",  # PTP's own scale, unless the grandmaster sends UTC
            status=ClockStatus("time_type", TIME_TYPES),
        ),
        sequence=PacketCounter("udp_cnt"),
        simulation=make_simulation(
            rate,
            view,
            answers={"discover": (("discovery", discovery_reply),), "get_state": answer_state},
        ),
        on_open=("discover", "get_state", *(f"set_{kind}_host" for kind in ports), "start"),
        on_close=("stop",),
        range_limits=limits,
        vendor_axes=("forward", "left", "up"),
        relatives={other: RELATIVES[other] for other in RELATIVES if other != name},
        info={
            "serial": "discovery.serial",
            "model": "discovery.device_type",
            "firmware": "parameters.parameters.app_version.app_version",
            "temperature": "parameters.parameters.core_temperature.core_temperature",
        },
        status="manual",
        source=(
            "Livox Mid-360 protocol document 1.4.10; HAP protocol document 1.4.8; Livox-SDK2"
            " 08f523c; user manuals"
        ),
    )


def is_fast(f: Fields) -> Any:
    """Return whether the time between points is about 2.2 us, as in packets of a HAP."""
    return f.time_interval < 3.3e-6 * f.dot_num


RELATIVES: dict[str, str | Relative] = {
    "livox-mid360": Relative(
        "the time between points is 5 us", lambda f: f.time_interval >= 3.3e-6 * f.dot_num
    ),
    "livox-hap": Relative("the time between points is 2.2 us", is_fast),
    "livox-mid360s": "the reply to a discovery contains the device type 35",
}
MID360, HAP = SENSORS = [make_lidar(name) for name in MODELS]
