"""LDROBOT STL-27L and related 360 degree lidars, which stream over a UART.

The models measure by time of flight or by triangulation and send data without a request.

Source: STL-27L development manual, section 3. Point rates, baud rates, and all frames except the
data frame come from the vendor's SDKs (ldlidar_sdk, ldlidar_stl_ros2). LD06, LD19 and STL-19P have
the same frame, baud rate and point rate, so they are a single sensor in this plugin. An LD14
measures by triangulation. Its angles are converted to angles around the axis of rotation, as in the
SDK (sl_transform.cpp). An older LD14P measures 2300 points a second.

The replies of an LD14P to commands are not documented, so commands do not wait for a reply. The
baud rates of LD20, STL-06P and STL-26 are assumed to be the LD19's. No captured frame of an STL-06P
or an STL-26 was available. The STL-50 is left out, because its protocol is not public.

Known errors of the manual: The CRC table lacks entries 175 to 186; this module generates the table.
In the decoded example, point 2 is printed as 200 mm, but 0x00dc is 220. Point 12 is printed as B0
00 EA, but the dump, whose CRC is valid, has C0 00 E5. There is no rule for frames that cross 360
degrees.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Const, Enum, Int8ul, Int16ul, Int32ul, Struct

from lidarspec.spec import (
    Checksummed,
    Clock,
    Command,
    Crc,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Relative,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    hookimpl,
    spread,
    wrap,
)

POINTS = 12
#: Points per second by model. Sources: STL-27L manual, section 1; LD06 data sheet (450 points a
#: revolution at 10 Hz); SDKs; a captured frame of the LD20.
POINT_RATES_HZ = {
    "STL-27L": 21_600,
    "LD06": 4_500,
    "STL-06P": 5_000,
    "LD14": 2_300,
    "LD14P": 4_000,
    "LD20": 4_000,
}
# The ORADAR MS200 sends the same frames; its rate is assumed.
MS200_POINT_RATE_HZ = 4_500
CRC8 = Crc(width=8, poly=0x4D)


def add_crc(*members: Any) -> Checksummed:
    """Return the struct with these members, followed by their CRC."""
    return Checksummed(Struct(*members, "crc" / Int8ul), field="crc", algorithm=CRC8)


DATA = add_crc(
    "header" / Const(b"\x54\x2c") * "start byte 0x54; type 1 and 12 points",
    "speed" / Scaled(Int16ul, 1, "deg/s"),
    "start_angle" / Scaled(Int16ul, 0.01, "deg"),
    "points"
    / Array(
        POINTS,
        Struct(
            "distance" / Scaled(Int16ul, 0.001, "m") * "0: no return",
            "intensity" / Int8ul,
        ),
    ),
    "end_angle" / Scaled(Int16ul, 0.01, "deg"),
    "timestamp" / Scaled(Int16ul, 0.001, "s") * "restarts from 0 after 30 s",
)
HEALTH = add_crc(
    "header" / Const(b"\x54\xe0"),
    "error" / Enum(Int8ul, none=0, motor_blocked=1, occluded=2, both=3),
)
INFO = add_crc(
    "header" / Const(b"\x54\x0f"),
    "speed" / Scaled(Int16ul, 1, "deg/s"),
    "product_version" / Int16ul,
    "serial_high" / Int32ul,
    "serial_low" / Int32ul,
    "hardware_version" / Int32ul,
    "firmware_version" / Int32ul,
)
#: Codes of commands; "get_firmware" returns the firmware of the motor's board.
CODES = {"start": 0xA0, "stop": 0xA1, "set_speed": 0xA2, "get_firmware": 0xA8}
COMMAND = add_crc(
    "header" / Const(b"\x54"),
    "command" / Enum(Int8ul, **CODES),
    "length" / Const(4, Int8ul),
    "speed" / Scaled(Int32ul, 1, "deg/s") * "0 except for set_speed",
)


def plausible(f: Fields) -> Any:
    """Return whether angles are below 360 degrees and the time is at most 30 s.

    Source: manual 3.1.
    """
    return (f.start_angle < 360) & (f.end_angle < 360) & (f.timestamp <= 30)


def parallax_angle(distance: Any) -> Any:
    """Return the degrees to subtract from the clockwise angle of an LD14's points.

    `distance` is in metres. Source: SDK, sl_transform.cpp.
    """
    mm = distance * 1000
    return np.where(mm > 0, np.rad2deg(np.arctan((0.11923 * mm - 18.975571) / (mm + 5.9))), 0)


def points(f: Fields, rate: int, *, correct_parallax: bool = False) -> Polar:
    """Return points at even steps from the start angle to the end angle.

    Source: manual 3.2.

    Args:
        rate: points per second.
        correct_parallax: whether to subtract `parallax_angle`, for a model that measures by
            triangulation.
    """
    clockwise = spread(f.start_angle, f.end_angle, POINTS, full=360.0)  # degrees, (n, 12)
    if correct_parallax:
        clockwise = clockwise - parallax_angle(f.points.distance)
    return Polar(
        range=f.points.distance,
        azimuth=-np.deg2rad(clockwise),  # left-handed, clockwise (manual, section 4)
        intensity=f.points.intensity,
        time=np.arange(POINTS) / rate,
    )


def sweep(i: int, rate: int, turns: int) -> dict[str, float]:
    """Return the simulated values of frame i.

    Args:
        rate: points per second.
        turns: revolutions per second.
    """
    step = 360.0 * turns / rate
    start = i * POINTS * step % 360
    return dict(
        speed=360 * turns,
        start_angle=start,
        end_angle=(start + (POINTS - 1) * step) % 360,
        timestamp=i * POINTS / rate % 30,
    )


def make_id(name: str) -> str:
    """Return the id of a model."""
    return "ldrobot-" + name.lower().replace("-", "")


def matches_rate(f: Fields, rate: int) -> Any:
    """Return whether `rate` is the rate that best fits a frame's speed and angles.

    `rate` is in points per second.
    """
    measured_rate = (
        (POINTS - 1)
        * np.maximum(f.speed, 1)
        / np.maximum(wrap(f.end_angle - f.start_angle, 360.0), 0.01)
    )
    rates = (rate, *POINT_RATES_HZ.values())
    deviations = [np.abs(np.log(measured_rate / candidate)) for candidate in rates]
    return np.min(deviations, axis=0) == deviations[0]


def pace(f: Fields, rate: int, older_rate: int | None = None) -> Any:
    """Return the seconds from a frame to the next.

    Args:
        rate: points per second.
        older_rate: points per second of older units, recognized by the angles of their frames.
    """
    seconds = POINTS / rate
    if older_rate is None:
        return seconds
    return np.where(matches_rate(f, older_rate), POINTS / older_rate, seconds)


def relatives(own: str) -> dict[str, str | Relative]:
    """Return how to recognize each of the other models by its point rate.

    Args:
        own: the name of the model for which the others are described, a key of `POINT_RATES_HZ`.

    Returns:
        Id of another model -> how its frames differ.
    """
    others = {make_id(name): rate for name, rate in POINT_RATES_HZ.items() if name != own}
    others["oradar-ms200"] = MS200_POINT_RATE_HZ
    return {
        name: (
            "both models send the same packets at the same rate"
            if rate == POINT_RATES_HZ[own]
            else Relative(
                f"{rate} points per second, calculated from speed and angles",
                partial(matches_rate, rate=rate),
            )
        )
        for name, rate in others.items()
    }


DATA_FRAME = Frame(DATA, data=True, plausible=plausible)
STATUS_FRAMES = {
    "info": Frame(INFO, plausible=lambda f: f.speed <= 3600),
    "health": Frame(HEALTH, plausible=lambda f: (f.error >= 1) & (f.error <= 3)),
}


def make_lidar(
    name: str,
    *,
    turns: int = 10,
    correct_parallax: bool = False,
    older_rate: int | None = None,
    frames: Mapping[str, Frame] | None = None,
    **more: Any,
) -> Sensor:
    """Return the sensor of one model.

    Args:
        name: a key of `POINT_RATES_HZ`.
        turns: simulated revolutions per second.
        correct_parallax: whether to correct the angles for the parallax.
        older_rate: points per second of older units.
    """
    rate = POINT_RATES_HZ[name]
    return Sensor(
        make_id(name),
        vendor="LDROBOT",
        model=more.pop("model", name),
        frames={"data": DATA_FRAME, **(frames or {})},
        points=partial(points, rate=rate, correct_parallax=correct_parallax),
        scan=OnWrap("azimuth"),
        clock=Clock(
            "timestamp",
            wraps_at=30.0,
            pace=partial(pace, rate=rate, older_rate=older_rate),
            epoch="boot",
        ),
        simulation=Simulation(partial(sweep, rate=rate, turns=turns)),
        vendor_axes=("forward", "right", "up"),
        relatives=relatives(name),
        **more,
    )


STL27L = make_lidar(
    "STL-27L",
    links={"data": Serial(921_600)},
    range_limits=(0.03, 25.0),
    # no `turn`: internal control has 10 Hz (manual, section 1), but PWM control has no limits
    status="vectors",
    source="STL-27L development manual, sections 1 to 4",
)
LD06 = make_lidar(
    "LD06",
    model="LD06, LD19, STL-19P",
    links={"data": Serial(230_400)},
    range_limits=(0.02, 12.0),
    turn=(5.0, 13.0),  # with PWM control, as for the LD19 (inno-maker's page of the LD06)
    status="capture",
    source=(
        "LD06 and LD19 development manual v2.5 (same frame as the STL-27L); three consecutive"
        " captured frames"
    ),
)
LD20 = make_lidar(
    "LD20",
    turns=6,
    links={"data": Serial(230_400)},
    range_limits=(0.02, 12.0),
    status="vectors",
    source="one captured frame; baud rate and range are assumed to equal those of the LD19",
)
STL06P = make_lidar(
    "STL-06P",
    model="STL-06P, STL-26",
    links={"data": Serial(230_400)},
    range_limits=(0.02, 12.0),
    status="manual",
    source=(
        "ldlidar_stl_ros2, lipkg.cpp (the rate); baud rate and range are assumed to equal those"
        " of the LD19"
    ),
)
LD14 = make_lidar(
    "LD14",
    turns=6,
    correct_parallax=True,
    frames=STATUS_FRAMES,
    links={"data": Serial(115_200)},
    range_limits=(0.1, 8.0),
    status="vectors",
    source=(
        "ldlidar_sdk (ldlidar_protocol.h, sl_transform.cpp, demo.cpp); the STL-27L manual's"
        " example; the range is assumed"
    ),
)
LD14P = make_lidar(
    "LD14P",
    turns=6,
    correct_parallax=True,
    older_rate=POINT_RATES_HZ["LD14"],
    frames={**STATUS_FRAMES, "command": Frame(COMMAND, direction="out")},
    links={"data": Serial(230_400)},
    commands={
        "start": Command("command", {"command": "start", "speed": 0}, starts=True),
        "stop": Command("command", {"command": "stop", "speed": 0}, stops=True),
        "set_speed": Command(
            "command", {"command": "set_speed"}, args={"speed": ("speed", 720, 2880)}
        ),
        "get_firmware": Command("command", {"command": "get_firmware", "speed": 0}),
    },
    # it rotates after power-up, but not if it was stopped before
    on_open=("start",),
    range_limits=(0.1, 8.0),
    turn=(2.0, 8.0),
    status="vectors",
    source=(
        "ldlidar_sdk, same as the LD14; commands from kaiaai/LDS; Waveshare's page of the"
        " D200 kit (range, speed, baud rate)"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the LDROBOT sensors."""
    return [STL27L, LD06, LD20, STL06P, LD14, LD14P]
