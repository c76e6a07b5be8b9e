"""Livox Mid-360 and HAP: the second generation of the protocol, which Livox-SDK2 speaks.

Points, IMU and parameters come over UDP, each from and to a port of its own. A Lidar sends points
to the host that it was told of (`set_point_host`) once it is sampling (`start`), and its parameters
once a second by itself. Firmware of the Mid-360 is reported that leaves the CRC of point packets 0:
these are taken as they are.

Source: Livox Mid-360 protocol document 1.4.10 and Livox-SDK2 08f523c (livox_lidar_def.h), HAP
protocol document 1.4.8 where they differ; HAP user manual, table 1.2.1, for its rate, ranges and
view; those of a Mid-360 are assumed. livox_ros_driver2 divides `time_interval` by the number of
points, the document by one less: the driver's rule is taken, which differs by 1 %. That a HAP takes
the commands of a Mid-360 is assumed from the SDK, which sends it the same; where its state goes is
not known, and not asked for. Commands for logs and firmware are not here. Keys whose values are not
known are passed on as bytes.
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
    Clock,
    Command,
    Count,
    Crc,
    Every,
    Fields,
    Frame,
    Parts,
    Relative,
    Scaled,
    Sensor,
    Sequence,
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
    echoes,
    imu,
    looking,
    spherical,
)

DISCOVERY = 56_000  # the port that is asked by a broadcast
REBOOT = 0x0200
FACTORY_SETTINGS = 0x0201
SET_GPS_TIME = 0x0202
CRC32 = Crc(32, 0x04C11DB7, init=0xFFFFFFFF, refin=True, refout=True, xorout=0xFFFFFFFF)
CRC16 = Crc(16, 0x1021, init=0xFFFF)
LONGEST = 1472  # bytes of a datagram that is not cut into fragments
ANY_NUMBER = {"LS203": "a datagram holds any number of parameters"}
SHOTS = np.arange(96)
IMU_RATE = 200  # of a simulated packet; IMU samples a second
TYPES = "9 MID-360, 10 HAP, 15 HAP, 35 MID-360S"


def packet(kind: int, *members: Any) -> Checksummed:
    """Return a packet with data of one type behind the header."""
    header = Struct(
        "version" / Const(0, Int8ul),
        "length" / SizeOf(Int16ul),
        "time_interval" / Scaled(Int16ul, 1e-7, "s") * "from the first point to the last",
        "dot_num" / Int16ul,
        "udp_cnt" / Int16ul * "packets of the frame",
        "frame_cnt" / Int8ul * "means nothing while the pattern does not repeat",
        "data_type" / Const(kind, Int8ul),
        "time_type" / Int8ul * "0 since power-up, 1 PTP or gPTP, 2 GPS",
        "pack_info" / Default(Int8ul, 0) * "which tags the points have, of some firmware",
        "reserved" / Default(Bytes(11), bytes(11)),
        "crc32" / Int32ul * "of all that follows; 0: not filled in",
        "timestamp" / Scaled(Int64ul, 1, "ns") * "of the first point",
        *members,
    )
    covered = ("timestamp", *(member.name for member in members))
    return Checksummed(header, field="crc32", algorithm=CRC32, over=covered, absent=(0,))


def after(f: Fields) -> Any:
    """Seconds from the first point of a packet to each."""
    return steps(f.dot_num) * (f.time_interval / f.dot_num)


def has_points(f: Fields) -> Any:
    """Return a packet has points."""
    return f.dot_num >= 1


def twice(f: Fields) -> Any:
    """Both returns of each shot, at its time."""
    return cartesian(f, after(f).on("points"), returns=2)


def points_frame(kind: int, points: Any, *members: Any, **more: Any) -> Frame:
    """Point packets of one type."""
    struct = packet(kind, "points" / Array(this.dot_num, Struct(*members)))
    return Frame(
        struct,
        data=True,
        max_length=LONGEST,
        plausible=has_points,
        points=points,
        **more,
    )


def message(cmd_id: int | None, *members: Any, ack: bool = True, lidar: bool = True) -> Any:
    """A control frame: a header with a CRC-16, and data with a CRC-32, which is 0 where there are
    none.
    """
    head = Struct(
        SOF,
        "version" / Const(0, Int8ul),
        "length" / SizeOf(Int16ul, "_"),
        "seq" / Int32ul * "that of the request, in an answer",
        "cmd_id" / (Int16ul if cmd_id is None else Const(cmd_id, Int16ul)),
        "cmd_type" / Const(int(ack), Int8ul) * "0 request, 1 answer",
        "sender_type" / Const(int(lidar), Int8ul) * "0 host, 1 Lidar",
        "reserved" / Default(Bytes(6), bytes(6)),
        "crc16" / Int16ul,
    )
    sealed = "head" / Checksummed(head, field="crc16", algorithm=CRC16)
    if not members:
        return Struct(sealed, "crc32" / Const(0, Int32ul))
    return Checksummed(
        Struct(sealed, "crc32" / Int32ul, *members),
        field="crc32",
        algorithm=CRC32,
        over=[one.name for one in members],
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
#: name -> key and value of a parameter (Mid-360 protocol document; livox_lidar_def.h).
PARAMETERS: dict[str, tuple[int, Any]] = {
    "point_type": (0x0000, NUMBER * "1 millimetres, 2 centimetres, 3 spherical"),
    "scan_pattern": (
        0x0001,
        NUMBER * "0 does not repeat, 1 repeats, 2 repeats at a low frame rate",
    ),
    "lidar_address": (0x0004, NET),
    "state_host": (0x0005, HOST),
    "point_host": (0x0006, HOST),
    "imu_host": (0x0007, HOST),
    "attitude": (0x0012, ATTITUDE),
    "fov_0": (0x0015, FOV),
    "fov_1": (0x0016, FOV),
    "fov_enabled": (0x0017, NUMBER * "bits 0 and 1: of fov_0 and fov_1"),
    "detect_mode": (0x0018, NUMBER * "0 normal, 1 sensitive"),
    "io_functions": (0x0019, Bytes(4)),
    "work_mode": (0x001A, NUMBER * "1 sampling, 2 idle, 9 ready"),
    "imu_enabled": (0x001C, NUMBER),
    "serial": (0x8000, Bytes(16)),
    "app_version": (0x8002, Array(4, Int8ul)),
    "loader_version": (0x8003, Array(4, Int8ul)),
    "hardware_version": (0x8004, Array(4, Int8ul)),
    "mac": (0x8005, Bytes(6)),
    "work_state": (
        0x8006,
        NUMBER * "1 sampling, 2 idle, 4 error, 5 self-check, 6 motor starts, 8 upgrade, 9 ready",
    ),
    "core_temperature": (0x8007, Scaled(Int32sl, 0.01, "degC")),
    "power_ups": (0x8008, Int32ul),
    "local_time": (0x8009, Scaled(Int64ul, 1, "ns")),
    "last_sync": (0x800A, Scaled(Int64ul, 1, "ns")),
    "time_offset": (0x800B, Scaled(Int64sl, 1, "ns")),
    "time_sync": (0x800C, NUMBER * "0 none, 1 PTP, 2 gPTP, 3 GPS"),
    "diagnosis": (0x800E, Int16ul),
    "firmware_type": (0x8010, NUMBER * "0 loader, 1 application"),
    "hms_codes": (0x8011, Array(8, Int32ul)),
}


def parameter(name: str) -> Struct:
    """One parameter with its key and its length."""
    key, value = PARAMETERS[name]
    return Struct(
        "key" / Const(key, Int16ul), "length" / Const(value.sizeof(), Int16ul), name / value
    )


LIST = (
    "parameters"
    / Parts(
        {
            **{name: parameter(name) for name in PARAMETERS},
            "other": Struct("key" / Int16ul, "length" / Int16ul, "value" / Bytes(this.length)),
        },
        count=this.count,
    ),
)
RESERVED = "data_reserved" / Default(Int16ul, 0)
RESULT = (
    "result"
    / Int8ul
    * "0 done, 1 failed, 2 not now, 3 out of range, 20 unknown, 21 after a reboot, 22 read only, 23"
    " length, 24 keys"
)


def setting(*values: Any) -> Frame:
    """Return a request to set one parameter."""
    value = Struct("key" / Int16ul, "size" / SizeOf(Int16ul, "value"), "value" / Struct(*values))
    return Frame(
        message(
            0x0100,
            "key_count" / Const(1, Int16ul),
            RESERVED,
            "parameter" / value,
            ack=False,
            lidar=False,
        ),
        direction="out",
    )


def simulation(rate: float, view: View, shots: Any = SHOTS, **more: Any) -> Simulation:
    """What a simulated Lidar needs that shoots so many times a second; `shots` are those of a
    packet.
    """
    points = len(shots)

    def look(i: int) -> tuple[Any, Any]:
        return looking(i * points + shots, rate, view)

    def sweep(i: int) -> dict[str, Any]:
        azimuth, elevation = look(i)
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
        sweep, directions=lambda i: tuple(np.deg2rad(angle) for angle in look(i)), **more
    )


def inertia(i: int) -> dict[str, Any]:
    """IMU packet i."""
    return {
        "time_interval": 0,
        "dot_num": 1,
        "udp_cnt": i % 65_536,
        "frame_cnt": 0,
        "timestamp": i * 10**9 // IMU_RATE,
    }


def state(i: int) -> dict[str, Any]:
    """What a simulated Lidar says of itself once a second."""
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
    "data": points_frame(1, lambda f: cartesian(f, after(f)), *MILLIMETRES, REFLECTIVITY, TAG),
    "centimetres": points_frame(
        2, lambda f: cartesian(f, after(f)), *CENTIMETRES, REFLECTIVITY, TAG
    ),
    "spherical": points_frame(
        3, lambda f: spherical(f, after(f)), *DEPTH, *DIRECTION, REFLECTIVITY, TAG
    ),
    "dual": points_frame(
        0x11,
        twice,
        echoes(2, *MILLIMETRES),
        simulation=simulation(226_000, (-60, 60, -12.5, 12.5), SHOTS[:48, None]),
    ),
    "imu": Frame(
        packet(0, *INERTIAL),
        imu=imu,
        plausible=lambda f: f.dot_num == 1,
        simulation=Simulation(inertia, rate=IMU_RATE),
    ),
    "state": Frame(
        message(0x0102, "count" / Int16ul, RESERVED, *LIST, ack=False),
        max_length=LONGEST,
        simulation=Simulation(state, rate=1),
        acknowledged=ANY_NUMBER,
    ),
    "discovery": Frame(
        message(
            0x0000,
            RESULT,
            "device_type" / Int8ul * TYPES,
            "serial" / Bytes(16),
            "address" / Bytes(4),
            "command_port" / Int16ul,
        )
    ),
    "set_ack": Frame(message(0x0100, RESULT, "wrong_key" / Int16ul)),
    "parameters": Frame(
        message(0x0101, RESULT, "count" / Int16ul, *LIST),
        max_length=LONGEST,
        acknowledged=ANY_NUMBER,
    ),
    "ack": Frame(
        message(None, RESULT),
        plausible=lambda f: (f.head.cmd_id >= REBOOT) & (f.head.cmd_id <= SET_GPS_TIME),
        simulation=Simulation(lambda i: {"head.seq": i, "head.cmd_id": REBOOT, "result": 0}),
    ),
    "discover": Frame(message(0x0000, ack=False, lidar=False), direction="out"),
    "get": Frame(
        message(
            0x0101,
            "count" / Int16ul,
            RESERVED,
            "wanted" / Array(this.count, Int16ul),
            ack=False,
            lidar=False,
        ),
        direction="out",
        max_length=LONGEST,
    ),
    "set_number": setting("number" / Int8ul),
    "set_host": setting(*HOST.subcons),
    "set_net": setting(*NET.subcons),
    "set_attitude": setting(*ATTITUDE.subcons),
    "set_fov": setting(*FOV.subcons),
    "reboot": Frame(
        message(REBOOT, "delay" / Scaled(Int16ul, 0.001, "s"), ack=False, lidar=False),
        direction="out",
    ),
    "factory_settings": Frame(
        message(FACTORY_SETTINGS, "data" / Default(Bytes(16), bytes(16)), ack=False, lidar=False),
        direction="out",
    ),
    "set_gps_time": Frame(
        message(
            SET_GPS_TIME,
            "type" / Const(2, Int8ul),
            "time" / Scaled(Int64ul, 1, "ns"),
            ack=False,
            lidar=False,
        ),
        direction="out",
    ),
}


def asking(frame: str, reply: str, values: Mapping[str, Any] | None = None, **more: Any) -> Command:
    """Return a request with a running number, which the answer repeats."""
    own = {
        "values": {"head.seq": Count(16), **(values or {})},
        "reply": reply,
        "echoes": ("head.seq",),
        "link": "control",
        "retries": 1,
    }
    return Command(frame, **{**own, **more})


def setter(
    frame: str,
    name: str,
    values: Mapping[str, Any] | None = None,
    args: Mapping[str, Any] | None = None,
    **more: Any,
) -> Command:
    """Return a command that sets one parameter; values and arguments by their names in it."""
    given = {
        "parameter.key": PARAMETERS[name][0],
        **{f"parameter.value.{path}": value for path, value in (values or {}).items()},
    }
    taken = {path: (f"parameter.value.{path}", *limits) for path, limits in (args or {}).items()}
    return asking(frame, "set_ack", given, args=taken, matches={"result": 0}, **more)


def one_of(name: str, low: int, high: int) -> Command:
    """Return a command that sets a parameter to a number."""
    return setter("set_number", name, args={"number": (low, high)})


def host(name: str, port: int, lidar_port: int) -> Command:
    """Return a command that has something sent to this computer."""
    return setter("set_host", name, {"ip": Address(), "host_port": port, "lidar_port": lidar_port})


def work(mode: int, **more: Any) -> Command:
    """Return a command that puts the Lidar to work, or to rest."""
    return setter("set_number", "work_mode", {"number": mode}, **more)


# metres that it can be mounted away from where its points are counted from, and degrees that angles
# go
FAR = 1000.0
COMMANDS: dict[str, Command] = {
    "start": work(1, starts=True),
    "stop": work(2, stops=True),
    "set_point_type": one_of("point_type", 1, 3),
    "set_scan_pattern": one_of("scan_pattern", 0, 2),
    "set_detect_mode": one_of("detect_mode", 0, 1),
    "set_imu": one_of("imu_enabled", 0, 1),
    "enable_fov": one_of("fov_enabled", 0, 3),
    "set_address": setter(
        "set_net", "lidar_address", args={name: (Address(),) for name in ("ip", "mask", "gateway")}
    ),
    "set_attitude": setter(
        "set_attitude",
        "attitude",
        args={
            **dict.fromkeys(("roll", "pitch", "yaw"), (-360, 360)),
            **dict.fromkeys("xyz", (-FAR, FAR)),
        },
    ),
    **{
        f"set_{name}": setter(
            "set_fov",
            name,
            args={
                **dict.fromkeys(("yaw_start", "yaw_stop"), (0, 360)),
                **dict.fromkeys(("pitch_start", "pitch_stop"), (-90, 90)),
            },
        )
        for name in ("fov_0", "fov_1")
    },
    "get": asking(
        "get", "parameters", {"count": 1, "wanted": [0]}, args={"key": ("wanted[0]", 0, 0xFFFF)}
    ),
    "get_state": asking(
        "get", "parameters", {"count": 5, "wanted": [0x8000, 0x8002, 0x8006, 0x8007, 0x800C]}
    ),
    "reboot": asking(
        "reboot", "ack", args={"delay": ("delay", 0.1, 2.0)}, matches={"result": 0}, retries=0
    ),
    "factory_settings": asking("factory_settings", "ack", matches={"result": 0}, retries=0),
    "set_gps_time": asking(
        "set_gps_time", "ack", args={"time": ("time", 0, 2**63)}, matches={"result": 0}
    ),
}


#: what is sent to the host -> the port of the Lidar, and that of the host.
Ports = dict[str, tuple[int, int]]
#: id -> model, device type, port of the Lidar for commands and of the host, ports of the rest,
#: points a second, view, ranges, other ids.
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
        DISCOVERY,
        0,
        {"point": (57_000, 57_000), "imu": (58_000, 58_000)},
        452_000,
        (-60, 60, -12.5, 12.5),
        (0.5, 150.0),
    ),
}


def answer_state(request: Mapping[str, Any]) -> tuple[Any, ...]:
    """What a simulated one answers where it is asked for its state."""
    return (("parameters", {"result": 0, **state(request["head.seq"])}),)


def lidar(name: str) -> Sensor:
    """One row of the table as a sensor."""
    model, device_type, control, local, ports, rate, view, limits = MODELS[name]
    discovery = "control" if control == DISCOVERY else "discovery"
    found = {
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
            discovery: Udp(DISCOVERY, broadcast=DISCOVERY),
        },
        commands={
            "discover": asking("discover", "discovery", link=discovery),
            **COMMANDS,
            **{
                f"set_{what}_host": host(f"{what}_host", port, source)
                for what, (source, port) in ports.items()
            },
        },
        # the counter restarts with each frame, of which nothing says how many packets it has
        clock=Clock("timestamp", pace=lambda f: f.time_interval),
        sequence=Sequence("udp_cnt"),
        simulation=simulation(
            rate, view, answers={"discover": (("discovery", found),), "get_state": answer_state}
        ),
        on_open=("discover", "get_state", *(f"set_{what}_host" for what in ports), "start"),
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
    """452 000 points a second, 2.2 us each, and not 200 000."""
    return f.time_interval < 3.3e-6 * f.dot_num


RELATIVES: dict[str, str | Relative] = {
    "livox-mid360": Relative(
        "5 us from a point to the next", lambda f: f.time_interval >= 3.3e-6 * f.dot_num
    ),
    "livox-hap": Relative("2.2 us from a point to the next", is_fast),
    "livox-mid360s": "the device type in its answer to a discovery, 35",
}
MID360, HAP = SENSORS = [lidar(name) for name in MODELS]
