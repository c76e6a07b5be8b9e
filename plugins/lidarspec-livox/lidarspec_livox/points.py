"""Points, IMU samples and simulated beam directions of both protocol generations.

Source: Livox-SDK 9306596 (livox_def.h) and Livox-SDK2 08f523c (livox_lidar_def.h), which have the
same points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Float32l, Int8ul, Int16sl, Int16ul, Int32sl, Int32ul, Struct

from lidarspec.spec import Cartesian, Fields, Imu, Polar, Scaled

#: The field of view: the azimuths of its right and left edge, and the elevations of its lower and
#: upper edge, degrees.
View = tuple[float, float, float, float]
SOF = "sof" / Const(b"\xaa")
GRAVITY = 9.80665  # m/s2
REFLECTIVITY = (
    "reflectivity"
    / Int8ul
    * "0 to 150: a diffuse target that reflects 0 to 100 %; above 150: a retroreflector"
)
TAG = (
    "tag"
    / Int8ul
    * "confidence of the point, 0 is normal; first-generation models also send the return"
    " number"
)
MILLIMETRES = tuple(axis / Scaled(Int32sl, 0.001, "m") for axis in "xyz")
CENTIMETRES = tuple(axis / Scaled(Int16sl, 0.01, "m") for axis in "xyz")
DEPTH = ("depth" / Scaled(Int32ul, 0.001, "m"),)
DIRECTION = (
    "zenith" / Scaled(Int16ul, 0.01, "deg") * "angle from the z axis",
    "azimuth" / Scaled(Int16ul, 0.01, "deg"),
)
INERTIAL = (
    *(f"gyro_{axis}" / Scaled(Float32l, 1, "rad/s") for axis in "xyz"),
    *(f"acc_{axis}" / Scaled(Float32l, GRAVITY, "m/s2") * "sent in g" for axis in "xyz"),
)


def make_returns(count: int, *members: Any) -> Any:
    """Return the array field with the `count` returns of one shot."""
    return "returns" / Array(count, Struct(*members, REFLECTIVITY, TAG))


def cartesian(f: Fields, time: Any, *, returns: int = 1, tagged: bool = True) -> Cartesian:
    """Return the points of a packet that contains x, y and z, which are in REP-103 axes.

    Args:
        time: the time of each shot, in seconds after the packet's clock.
        returns: returns per shot.
        tagged: whether points have a tag.
    """
    members = f.points if returns == 1 else f.points.returns
    return Cartesian(
        members.x, members.y, members.z, **common_columns(members, time, returns, tagged)
    )


def spherical(f: Fields, time: Any, *, returns: int = 1, tagged: bool = True) -> Polar:
    """Return the points of a packet that contains depth, azimuth and zenith angle.

    The zenith angle is the angle from the z axis. The arguments are the same as for `cartesian`.
    """
    members = f.points if returns == 1 else f.points.returns
    azimuth = np.deg2rad(f.points.azimuth)
    elevation = np.deg2rad(90 - f.points.zenith)
    return Polar(
        members.depth, azimuth, elevation, **common_columns(members, time, returns, tagged)
    )


def common_columns(members: Fields, time: Any, returns: int, tagged: bool) -> dict[str, Any]:
    return {
        "intensity": members.reflectivity,
        "time": time,
        "return_index": np.arange(returns) if returns > 1 else None,
        "extra": {"tag": members.tag} if tagged else {},
    }


def imu(f: Fields) -> Imu:
    """Return angular rates and accelerations, in the axes of the points."""
    return Imu((f.gyro_x, f.gyro_y, f.gyro_z), (f.acc_x, f.acc_y, f.acc_z))


def simulated_angles(shots: Any, rate: float, view: View) -> tuple[Any, Any]:
    """Return azimuth and elevation in degrees of simulated shots.

    Args:
        shots: the numbers of the shots since the start.
        rate: the number of shots per second.
    """
    right, left, low, high = view
    across = np.sin(2 * np.pi * 7.3 * shots / rate)
    up = np.sin(2 * np.pi * 610 * shots / rate)
    return (right + left + (left - right) * across) / 2, (low + high + (high - low) * up) / 2
