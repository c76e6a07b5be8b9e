"""The parts that all packets of the family share: date, return modes, points of a shot.

Source: HesaiLidar_SDK_2.0 (year rule, return modes, timing) and tier4/nebula (geometry; it
reproduces the point clouds that nebula publishes).
"""

from __future__ import annotations

import datetime
from typing import Any

import numpy as np
from construct import Bytes, Enum, Int8ul, Int16ul, Int32ul, Struct

from lidarspec.spec import Clock, Fields, Polar, Scaled, unix_time
from lidarspec_hesai.calibration import Calibration

RETURN_MODES = {
    "first": 0x33,
    "second": 0x34,
    "strongest": 0x37,
    "last": 0x38,
    "last_and_strongest": 0x39,
    "first_and_last": 0x3B,
    "first_and_strongest": 0x3C,
    "three": 0x3D,
}
RETURN_MODE = Enum(Int8ul, **RETURN_MODES)
FACTORY = "42 or 43"
EPOCH = datetime.datetime(2024, 1, 1)  # of simulated packets
#: Revolutions per second: 300 to 1200 rpm (tier4/nebula, rotation_speed of all models).
SPEED_LIMITS_HZ = (
    5.0,
    20.0,
)

UTC = Struct(
    "year"
    / Int8ul
    * (
        "70 or more: years since 1900; 1 to 69: years since 2000; 0: the next five bytes are"
        " Unix seconds, big-endian"
    ),
    "month" / Int8ul,
    "day" / Int8ul,
    "hour" / Int8ul,
    "minute" / Int8ul,
    "second" / Int8ul,
)


#: The tail of a Pandar40P and a Pandar64.
TAIL_40P = (
    "reserved" / Bytes(5),
    "shutdown" / Int8ul * "1: overheated, about to shut down",
    "tail_reserved" / Bytes(2),
    "motor_speed" / Scaled(Int16ul, 1, "rpm"),
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time since the date and time in `utc`",
    "return_mode" / RETURN_MODE,
    "factory" / Int8ul * FACTORY,
    "utc" / UTC,
)


def count_returns(mode: Any) -> Any:
    """Return the number of consecutive blocks with the returns of one shot."""
    dual = (mode == 0x39) | (mode == 0x3B) | (mode == 0x3C)
    return np.where(mode == 0x3D, 3, np.where(dual, 2, 1))


def clock(f: Fields) -> tuple[Any, Any]:
    """Return the whole seconds since 1970, and the microseconds within the second."""
    utc = f.utc
    year = np.where(utc.year < 70, utc.year + 2000, utc.year + 1900)
    date = unix_time(year, utc.month, utc.day, utc.hour, utc.minute, utc.second)
    unix = (((utc.month * 256 + utc.day) * 256 + utc.hour) * 256 + utc.minute) * 256 + utc.second
    return np.where(utc.year == 0, unix, date), f.timestamp


#: With GPS, the date is UTC. With PTP, it is the time of the grandmaster. Data packets do not
#: report the state of the clock; GPS packets (UDP port 10110) and the sensor's web page report it.
#: Until the clock is set, it counts from a virtual UTC such as 2000-01-01 (user manuals of the
#: Pandar64 and the PandarXT, appendix B).
CLOCK = Clock(clock, epoch="utc")


def make_points(
    blocks: Fields, channels: Calibration, *, distance: Any, block: Any, returns: Any, fired: Any
) -> Polar:
    """Return the points of a packet.

    Args:
        distance: the distances in metres, (n, blocks, channels).
        block: the number of each block, (blocks, 1) or (n, blocks, 1).
        returns: the number of consecutive blocks with the returns of one shot.
        fired: the time from the packet's time to the shot of each block, seconds.
    """
    return Polar(
        range=distance,
        azimuth=-np.deg2rad(blocks.azimuth + channels.azimuth),
        elevation=np.deg2rad(channels.elevation),
        intensity=blocks.channels.reflectivity,
        time=fired + channels.firing,
        ring=np.arange(len(channels)),
        return_index=block % returns,
        nominal=channels.nominal,
    )


def rotation_values(i: int, blocks: int, per_turn: int, rate_hz: float = 10.0) -> dict[str, Any]:
    """Return azimuths, speed and time of packet i of a simulated rotating sensor."""
    shots = i * blocks + np.arange(blocks)
    now = EPOCH + datetime.timedelta(
        microseconds=round(1e6 * (i + 1) * blocks / (per_turn * rate_hz))
    )
    date = {
        "year": now.year - 1900,
        **{name: getattr(now, name) for name in ("month", "day", "hour", "minute", "second")},
    }
    return {
        "blocks.azimuth": np.round(shots % per_turn * 360 / per_turn, 2),
        "motor_speed": rate_hz * 60,
        "timestamp": now.microsecond * 1e-6,
        "return_mode": 0x37,
        "factory": 0x42,
        "sequence": i,
        **{f"utc.{name}": value for name, value in date.items()},
    }
