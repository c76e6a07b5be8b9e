"""LSLIDAR N10, N10P and the M10 family: 360 degree time-of-flight lidars with a UART.

Numbers are big-endian. The C16 is in the module `c16`.

Source: the vendor's ROS drivers, of which the older is lslidar_driver.cc of the edition for the
N10P, and the newer is lslidar_x10_driver.cpp of Lslidar_ROS2_driver V5. Packets of the N10 and N10P
end with a checksum, which is a sum. Packets of the M10 family have no checksum, only constant bytes
at both ends. The value that the older driver calls speed is the time for 15 degrees, in
microseconds.

Angles are clockwise in the older driver and in this module, but counter-clockwise in the newer
driver. For an M10, both drivers divide 15 degrees by the number of samples that are not FFFF. This
module divides 15 degrees by the number of all samples. The meaning of bytes 103 and 104 of an N10P
is not documented.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Construct,
    Default,
    Enum,
    Int8ub,
    Int16ub,
    Struct,
    this,
)

from lidarspec.spec import (
    Checksummed,
    Clock,
    Command,
    Fields,
    Frame,
    OnWrap,
    Points,
    Polar,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    Sum,
    hookimpl,
    spread,
    stack,
    wrap,
)
from lidarspec_lslidar.c16 import C16, DATE

N_SAMPLES = 16
M_SAMPLES = 42
SPAN_DEG = 15.0  # of a packet
PACKETS_PER_TURN = 24
MAX_SAMPLES = 200  # of an M10P's packet: more than twice the limit of the driver

START = Const(b"\xa5\x5a")
MARK = Const(b"\xa5\x5a\x55")
END = Const(b"\xfa\xfb")
PERIOD: Construct = Scaled(Int16ub, 1e-6, "s") * "time in which the rotor turns by 15 degrees"
ANGLE: Construct = Scaled(Int16ub, 0.01, "deg")
DISTANCE: Construct = Scaled(Int16ub, 0.001, "m") * "0 or FFFF: no return"
SAMPLE = BitStruct(
    "bright" / BitsInteger(1) * "1: strong reflection",
    "distance"
    / Scaled(BitsInteger(15), 0.001, "m")
    * "0: no return; 7FFF with `bright`: no return",
)
TIME = (
    *DATE,
    "millisecond" / Scaled(Int16ub, 0.001, "s"),
    "microsecond" / Scaled(Int16ub, 1e-6, "s"),
)
CLOCK = Clock(
    ("hour", "minute", "second", "millisecond", "microsecond"),
    wraps_at=86_400.0,
    pace=lambda f: f.period,
)


def make_packet(size: Construct, samples: Construct, *rest: Construct) -> Frame:
    """Return the frame of a packet of the N family, with 16 samples between two angles."""
    struct = Struct(
        "header" / START,
        "size" / size,
        "period" / PERIOD,
        "start_angle" / ANGLE,
        "samples" / samples,
        *rest,
        "end_angle" / ANGLE,
        "sum" / Int8ub,
    )
    return Frame(
        Checksummed(struct, field="sum", algorithm=Sum(8)), data=True, plausible=is_plausible_n
    )


def is_plausible_n(f: Fields) -> Any:
    """Return whether angles are at most 360 degrees and the motor rotates."""
    return (f.start_angle <= 360) & (f.end_angle <= 360) & (f.period > 0)


def is_plausible_m(f: Fields) -> Any:
    """Return whether the angle is at most 360 degrees."""
    return f.start_angle <= 360


def is_plausible_m10p(f: Fields) -> Any:
    """Return whether the angle is at most 360 degrees and samples have two bytes."""
    return (f.start_angle <= 360) & (f.length > 20) & (f.length % 2 == 0)


def mask_no_return(distance: Any) -> Any:
    """Return the distance, replaced by 0 if all its bits are set."""
    return np.where(distance >= 65.535, 0, distance)


def sample_directions(f: Fields) -> tuple[Any, Any]:
    """Return the azimuths of the samples in radians, and their times in seconds."""
    clockwise = spread(f.start_angle, f.end_angle, N_SAMPLES, full=360.0)  # degrees, (n, 16)
    return -np.deg2rad(wrap(clockwise, 360.0)), (clockwise - f.start_angle) / SPAN_DEG * f.period


def n10_points(f: Fields) -> Polar:
    """Return points at even steps from the start angle to the end angle."""
    azimuth, time = sample_directions(f)
    return Polar(
        range=mask_no_return(f.samples.distance),
        azimuth=azimuth,
        intensity=f.samples.intensity,
        time=time,
    )


def n10p_points(f: Fields) -> Polar:
    """Return points as for an N10, with two returns of each sample."""
    azimuth, time = sample_directions(f)
    return Polar(
        range=stack(mask_no_return(f.samples.first), mask_no_return(f.samples.second)),
        azimuth=azimuth,
        intensity=stack(f.samples.first_intensity, f.samples.second_intensity),
        time=time,
        return_index=np.arange(2),
    )


def m_points(f: Fields, count: Callable[[Fields], Any]) -> Polar:
    """Return points at even steps over 15 degrees from the start angle on."""
    samples = count(f)
    clockwise = spread(
        f.start_angle, f.start_angle + SPAN_DEG - SPAN_DEG / samples, samples, full=360.0
    )
    return Polar(
        range=np.where(
            (f.samples.distance >= 32.767) & (f.samples.bright == 1), 0, f.samples.distance
        ),
        azimuth=-np.deg2rad(wrap(clockwise, 360.0)),
        intensity=f.samples.bright * 255,
        time=(clockwise - f.start_angle) / SPAN_DEG * f.period,
    )


def n_sweep(i: int, packets: int) -> dict[str, float]:
    """Return the values of simulated packet i at 10 Hz."""
    step = 360 / packets / N_SAMPLES
    first = i % packets * N_SAMPLES * step
    return {
        "start_angle": first,
        "end_angle": first + (N_SAMPLES - 1) * step,
        "period": 0.1 / PACKETS_PER_TURN,
    }


def m_sweep(i: int, hertz: float, count: int = 0, *, timed: bool = False) -> dict[str, float]:
    """Return the values of simulated packet i; a revolution has 24 packets.

    Args:
        hertz: revolutions per second.
        count: the number of samples, if packets contain their length; otherwise 0.
        timed: whether packets have a time.
    """
    seconds, microseconds = divmod(round(i * 1e6 / (hertz * PACKETS_PER_TURN)), 1_000_000)
    clock = {
        "second": seconds % 60,
        "minute": seconds // 60 % 60 * 60,
        "hour": seconds // 3600 % 24 * 3600,
        "day": 1,
        "month": 1,
        "year": 26,
    }
    parts = {"millisecond": microseconds // 1000 / 1000, "microsecond": microseconds % 1000 / 1e6}
    length = {"length": 20 + 2 * count} if count else {}
    return {
        "start_angle": i % PACKETS_PER_TURN * SPAN_DEG,
        "period": 1 / (hertz * PACKETS_PER_TURN),
        **length,
        **(clock | parts if timed else {}),
    }


N10_DATA = make_packet(
    Const(58, Int8ub), Array(N_SAMPLES, Struct("distance" / DISTANCE, "intensity" / Int8ub))
)
N10P_DATA = make_packet(
    Int8ub,
    Array(
        N_SAMPLES,
        Struct(
            "first" / DISTANCE,
            "first_intensity" / Int8ub,
            "second" / DISTANCE,
            "second_intensity" / Int8ub,
        ),
    ),
    "reserved" / Bytes(2),
)
M10_FIELDS = (
    "header" / START,
    "start_angle" / ANGLE,
    "period" / PERIOD,
    "samples" / Array(M_SAMPLES, SAMPLE),
)
M10_DATA = Frame(Struct(*M10_FIELDS, "end" / END), data=True, plausible=is_plausible_m)
M10_GPS_DATA = Frame(Struct(*M10_FIELDS, *TIME, "end" / END), data=True, plausible=is_plausible_m)
M10P_DATA = Frame(
    Struct(
        "header" / START,
        "length" / Int16ub * "number of bytes of the packet",
        "start_angle" / ANGLE,
        "period" / PERIOD,
        "samples" / Array((this.length - 20) // 2, SAMPLE),
        *TIME,
        "end" / END,
    ),
    data=True,
    max_length=20 + 2 * MAX_SAMPLES,
    plausible=is_plausible_m10p,
)
INFO = Frame(
    Struct(
        "header" / Const(b"\xa5\x5a\x55\x00"),
        "unknown" / Bytes(169),
        "compensation"
        / BitStruct(
            "negative" / BitsInteger(1),
            "angle"
            / Scaled(BitsInteger(15), 0.01, "deg")
            * "angle correction that the sensor reports; it is not applied to decoded points",
        ),
        "reserved" / Bytes(11),
        "end" / END,
    )
)
#: The codes of commands. The next constant has the codes of filters.
CODES = {"run": 1, "stop_motor": 3, "filter": 6, "get_info": 8, "set_speed": 0x0A}
FILTERS = {"none": 0x0A, "normal": 0x0B, "near": 0x0C}
COMMAND = Frame(
    Struct(
        "header" / MARK,
        "unused_1" / Const(bytes(169)),
        "turns" / Default(Scaled(Int8ub, 1, "Hz"), 0) * "revolutions per second",
        "unused_2" / Const(bytes(8)),
        "filter" / Enum(Int8ub, unused=0, **FILTERS),
        "unused_3" / Const(bytes(2)),
        "code" / Enum(Int8ub, **CODES),
        "argument" / Int8ub,
        "end" / END,
    ),
    direction="out",
)


def make_command(code: str, argument: int, scan_filter: str = "unused", **more: Any) -> Command:
    """Return the command with this code, argument and filter."""
    return Command("command", {"code": code, "argument": argument, "filter": scan_filter}, **more)


RUN_COMMANDS = {
    "start": make_command("run", 1, starts=True),
    "stop": make_command("run", 0, stops=True),
}
N_COMMANDS = RUN_COMMANDS | {
    "set_speed": make_command("set_speed", 1, args={"speed": ("turns", 6, 12)})
}
M_COMMANDS = RUN_COMMANDS | {
    "stop_motor": make_command("stop_motor", 0, stops=True),
    "filter_none": make_command("filter", 1, scan_filter="none"),
    "filter_normal": make_command("filter", 1, scan_filter="normal"),
    "filter_near": make_command("filter", 1, scan_filter="near"),
    "get_info": make_command("get_info", 1, reply="info", retries=1),
}


@dataclass(frozen=True)
class Model:
    """One row of the table of models.

    Attributes:
        hertz: the lowest and the highest number of revolutions per second.
        clock: the clock in the packets; None if they have no time.
    """

    name: str
    data: Frame
    points: Callable[[Fields], Points]
    sweep: Callable[[int], Mapping[str, float]]
    baud: int
    hertz: tuple[float, float] | None = None
    clock: Clock | None = None
    status: str = "vectors"


M10_POINTS = partial(m_points, count=lambda f: M_SAMPLES)
M10P_POINTS = partial(m_points, count=lambda f: (f.length - 20) / 2)
MODELS = {
    "lslidar-n10": Model(
        "N10", N10_DATA, n10_points, partial(n_sweep, packets=28), 230_400, (6, 12)
    ),
    "lslidar-n10p": Model(
        "N10P", N10P_DATA, n10p_points, partial(n_sweep, packets=34), 460_800, (6, 12)
    ),
    "lslidar-m10": Model("M10", M10_DATA, M10_POINTS, partial(m_sweep, hertz=10), 460_800),
    "lslidar-m10gps": Model(
        "M10GPS",
        M10_GPS_DATA,
        M10_POINTS,
        partial(m_sweep, hertz=10, timed=True),
        460_800,
        clock=CLOCK,
    ),
    "lslidar-m10p": Model(
        "M10P",
        M10P_DATA,
        M10P_POINTS,
        partial(m_sweep, hertz=12, count=70, timed=True),
        500_000,
        clock=CLOCK,
    ),
}


def make_lidar(name: str) -> Sensor:
    """Return the sensor of one row of `MODELS`."""
    # the lidars are not stopped when the device is closed, because drivers expect them to rotate
    model = MODELS[name]
    family = name.startswith("lslidar-n")
    return Sensor(
        name,
        vendor="LSLIDAR",
        model=model.name,
        frames=(
            {"data": model.data, "command": COMMAND}
            if family
            else {"info": INFO, "data": model.data, "command": COMMAND}
        ),
        points=model.points,
        scan=OnWrap("azimuth"),
        links={"data": Serial(model.baud)},
        commands=N_COMMANDS if family else M_COMMANDS,
        clock=model.clock,
        simulation=Simulation(model.sweep),
        on_open=("start",),
        range_limits=(0.02, 25.0),
        turn=model.hertz,
        status=model.status,
        source=(
            "vendor's ROS drivers, lslidar_driver and Lslidar_ROS2_driver V5. Range limits"
            " are assumed"
        ),
    )


N10, N10P, M10, M10_GPS, M10P = SENSORS = [make_lidar(name) for name in MODELS]


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the LSLIDAR sensors."""
    return [*SENSORS, C16]
