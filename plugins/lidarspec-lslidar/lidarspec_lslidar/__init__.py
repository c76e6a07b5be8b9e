"""LSLIDAR N10, N10P and the M10 family: 360 degree time-of-flight lidars over a UART, high byte
first; the C16 is in `c16`.

Source: the vendor's ROS drivers (lslidar_driver.cc of the edition for the N10P;
lslidar_x10_driver.cpp of Lslidar_ROS2_driver V5). The N10 and N10P are sealed by a sum; packets of
the M10 family have no checksum, only marks at both ends. What the older driver calls the speed is
the time of 15 degrees in microseconds: 4167 at 10 turns a second, and 3460 to 3490 of an M10P at
12.

Known contradictions: the older driver draws angles clockwise, as it is done here, the newer one
counter-clockwise; both spread the samples of an M10 over 15 degrees by the number of those that are
not FFFF, which comes to the same where all of them are there. What bytes 103 and 104 of an N10P
are, nobody says.
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
SPAN = 15.0
PACKETS = 24  # degrees of a packet, and packets a turn
MOST = 200  # samples of an M10P's packet: more than twice what the driver takes for sound

START = Const(b"\xa5\x5a")
MARK = Const(b"\xa5\x5a\x55")
END = Const(b"\xfa\xfb")
PERIOD: Construct = Scaled(Int16ub, 1e-6, "s") * "of 15 degrees"
ANGLE: Construct = Scaled(Int16ub, 0.01, "deg")
DISTANCE: Construct = Scaled(Int16ub, 0.001, "m") * "0 or FFFF: no return"
SAMPLE = BitStruct(
    "bright" / BitsInteger(1) * "1: strong reflection",
    "distance" / Scaled(BitsInteger(15), 0.001, "m") * "0: no return, as is 7FFF with bright",
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
    """Return a packet of the N family: 16 samples between two angles."""
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
        Checksummed(struct, field="sum", algorithm=Sum(8)), data=True, plausible=n_plausible
    )


def n_plausible(f: Fields) -> Any:
    """Angles of the circle, and a motor that turns."""
    return (f.start_angle <= 360) & (f.end_angle <= 360) & (f.period > 0)


def m_plausible(f: Fields) -> Any:
    """Return an angle of the circle."""
    return f.start_angle <= 360


def sized_plausible(f: Fields) -> Any:
    """Return an angle of the circle, and two bytes to the sample."""
    return (f.start_angle <= 360) & (f.length > 20) & (f.length % 2 == 0)


def mask_no_return(distance: Any) -> Any:
    """Return a distance, 0 where all its bits say that there is none."""
    return np.where(distance >= 65.535, 0, distance)


def from_to(f: Fields) -> tuple[Any, Any]:
    """Angles in radians, counter-clockwise, and seconds after the first sample, of the N family."""
    swept = spread(f.start_angle, f.end_angle, N_SAMPLES, full=360.0)  # degrees, (n, 16)
    return -np.deg2rad(wrap(swept, 360.0)), (swept - f.start_angle) / SPAN * f.period


def n10_points(f: Fields) -> Polar:
    """Even steps from the start angle to the end angle."""
    azimuth, time = from_to(f)
    return Polar(
        range=mask_no_return(f.samples.distance),
        azimuth=azimuth,
        intensity=f.samples.intensity,
        time=time,
    )


def n10p_points(f: Fields) -> Polar:
    """Return the same with two returns of each sample."""
    azimuth, time = from_to(f)
    return Polar(
        range=stack(mask_no_return(f.samples.first), mask_no_return(f.samples.second)),
        azimuth=azimuth,
        intensity=stack(f.samples.first_intensity, f.samples.second_intensity),
        time=time,
        return_index=np.arange(2),
    )


def m_points(f: Fields, count: Callable[[Fields], Any]) -> Polar:
    """Even steps through 15 degrees from the start angle on; what reflects strongly has an
    intensity of 255, as the driver gives it.
    """
    number = count(f)
    swept = spread(f.start_angle, f.start_angle + SPAN - SPAN / number, number, full=360.0)
    return Polar(
        range=np.where(
            (f.samples.distance >= 32.767) & (f.samples.bright == 1), 0, f.samples.distance
        ),
        azimuth=-np.deg2rad(wrap(swept, 360.0)),
        intensity=f.samples.bright * 255,
        time=(swept - f.start_angle) / SPAN * f.period,
    )


def n_sweep(i: int, packets: int) -> dict[str, float]:
    """Packet i of turns at 10 Hz with so many packets."""
    step = 360 / packets / N_SAMPLES
    first = i % packets * N_SAMPLES * step
    return {
        "start_angle": first,
        "end_angle": first + (N_SAMPLES - 1) * step,
        "period": 0.1 / PACKETS,
    }


def m_sweep(i: int, hertz: float, count: int = 0, *, timed: bool = False) -> dict[str, float]:
    """Packet i of turns of 24 packets, so many a second, with a count of samples and the time where
    it has them.
    """
    seconds, microseconds = divmod(round(i * 1e6 / (hertz * PACKETS)), 1_000_000)
    clock = {
        "second": seconds % 60,
        "minute": seconds // 60 % 60 * 60,
        "hour": seconds // 3600 % 24 * 3600,
        "day": 1,
        "month": 1,
        "year": 26,
    }
    parts = {"millisecond": microseconds // 1000 / 1000, "microsecond": microseconds % 1000 / 1e6}
    sized = {"length": 20 + 2 * count} if count else {}
    return {
        "start_angle": i % PACKETS * SPAN,
        "period": 1 / (hertz * PACKETS),
        **sized,
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
M10_HEAD = (
    "header" / START,
    "start_angle" / ANGLE,
    "period" / PERIOD,
    "samples" / Array(M_SAMPLES, SAMPLE),
)
M10_DATA = Frame(Struct(*M10_HEAD, "end" / END), data=True, plausible=m_plausible)
M10_GPS_DATA = Frame(Struct(*M10_HEAD, *TIME, "end" / END), data=True, plausible=m_plausible)
M10P_DATA = Frame(
    Struct(
        "header" / START,
        "length" / Int16ub * "bytes of the packet",
        "start_angle" / ANGLE,
        "period" / PERIOD,
        "samples" / Array((this.length - 20) // 2, SAMPLE),
        *TIME,
        "end" / END,
    ),
    data=True,
    max_length=20 + 2 * MOST,
    plausible=sized_plausible,
)
INFO = Frame(
    Struct(
        "header" / Const(b"\xa5\x5a\x55\x00"),
        "unknown" / Bytes(169),
        "compensation"
        / BitStruct(
            "negative" / BitsInteger(1),
            "angle" / Scaled(BitsInteger(15), 0.01, "deg") * "reported, but not applied",
        ),
        "reserved" / Bytes(11),
        "end" / END,
    )
)
COMMAND = Frame(
    Struct(
        "header" / MARK,
        "unused_1" / Const(bytes(169)),
        "turns" / Default(Scaled(Int8ub, 1, "Hz"), 0) * "revolutions per second",
        "unused_2" / Const(bytes(8)),
        "filter" / Int8ub * "A none, B normal, C near",
        "unused_3" / Const(bytes(2)),
        "code" / Int8ub * "1 run, 3 speed, 6 filter, 8 report state, A speed",
        "argument" / Int8ub,
        "end" / END,
    ),
    direction="out",
)


def asking(code: int, argument: int, filtered: int = 0, **more: Any) -> Command:
    """Return the command of this code, argument and filter."""
    return Command("command", {"code": code, "argument": argument, "filter": filtered}, **more)


RUNNING = {"start": asking(1, 1, starts=True), "stop": asking(1, 0, stops=True)}
N_COMMANDS = RUNNING | {"set_speed": asking(0x0A, 1, args={"speed": ("turns", 6, 12)})}
M_COMMANDS = RUNNING | {
    "stop_motor": asking(3, 0, stops=True),
    "filter_none": asking(6, 1, filtered=0x0A),
    "filter_normal": asking(6, 1, filtered=0x0B),
    "filter_near": asking(6, 1, filtered=0x0C),
    "get_info": asking(8, 1, reply="info", retries=1),
}


@dataclass(frozen=True)
class Model:
    """One row of the table of models: its packet, points, sweep, baud, turns a second, clock and
    status.
    """

    name: str
    data: Frame
    points: Callable[[Fields], Points]
    sweep: Callable[[int], Mapping[str, float]]
    baud: int
    hertz: tuple[float, float] | None = None
    clock: Clock | None = None
    status: str = "vectors"


OF_42 = partial(m_points, count=lambda f: M_SAMPLES)
OF_LENGTH = partial(m_points, count=lambda f: (f.length - 20) / 2)
MODELS = {
    "lslidar-n10": Model(
        "N10", N10_DATA, n10_points, partial(n_sweep, packets=28), 230_400, (6, 12)
    ),
    "lslidar-n10p": Model(
        "N10P", N10P_DATA, n10p_points, partial(n_sweep, packets=34), 460_800, (6, 12)
    ),
    "lslidar-m10": Model("M10", M10_DATA, OF_42, partial(m_sweep, hertz=10), 460_800),
    "lslidar-m10gps": Model(
        "M10GPS", M10_GPS_DATA, OF_42, partial(m_sweep, hertz=10, timed=True), 460_800, clock=CLOCK
    ),
    "lslidar-m10p": Model(
        "M10P",
        M10P_DATA,
        OF_LENGTH,
        partial(m_sweep, hertz=12, count=70, timed=True),
        500_000,
        clock=CLOCK,
    ),
}


def lidar(name: str) -> Sensor:
    """One row of the table as a sensor; they turn as soon as they have power, and are not stopped
    on closing: drivers rely on it.
    """
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


N10, N10P, M10, M10_GPS, M10P = SENSORS = [lidar(name) for name in MODELS]


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The LSLIDAR sensors."""
    return [*SENSORS, C16]
