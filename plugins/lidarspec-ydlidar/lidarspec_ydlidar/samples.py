"""What a YDLIDAR sample holds: two, three or four bytes, in eight forms.

Source: YDLIDAR SDK, "YDLidar-SDK Communication Protocol" (scan command response) and
core/common/ydlidar_protocol.h.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from construct import BitsInteger, BitStruct, ByteSwapped, Construct, Int16ul, Struct

from lidarspec.spec import Scaled

NONE = "0: no return"


@dataclass(frozen=True, eq=False)
class Form:
    """One form of samples.

    Attributes:
        struct: one sample.
        size: its bytes.
        groups: sizes of the words that the checksum takes of it.
        correction: degrees to add to the angle of a sample, by its distance in metres.
        slowest: Hz that the field of the scan frequency counts from.
        intense: whether it has an intensity.
    """

    struct: Construct
    size: int = 2
    groups: tuple[int, ...] = (2,)
    correction: Callable[[Any], Any] | None = None
    slowest: float = 0.0
    intense: bool = False


def camera_angle(distance: Any) -> Any:
    """Return the degrees between the laser's ray and the ray of the camera.

    Source: "angle second-level analysis".
    """
    mm = np.maximum(distance * 1000, 0.25)
    return np.where(distance > 0, np.rad2deg(np.arctan(21.8 * (155.3 - mm) / (155.3 * mm))), 0)


def alone(step: float) -> Construct:
    """Return a distance and nothing else, in steps of so many metres."""
    return Struct("distance" / Scaled(Int16ul, step, "m") * NONE)


def make_distance(*below: Construct) -> Construct:
    """Whole millimetres in the upper 14 bits."""
    return ByteSwapped(BitStruct("distance" / Scaled(BitsInteger(14), 0.001, "m") * NONE, *below))


FLAGS = "flags" / BitsInteger(2)
MARKS = FLAGS * "2: mirror or glass, 3: sunlight"
EIGHT = make_distance(MARKS, "intensity" / BitsInteger(8))

TRIANGLE = Form(alone(0.00025), correction=camera_angle)
TRIANGLE_FLAGGED = Form(
    make_distance(FLAGS * "not 0: disturbed by another lidar"), correction=camera_angle
)
TRIANGLE_8 = Form(EIGHT, 3, (1, 2), camera_angle, intense=True)
TRIANGLE_10 = Form(
    make_distance("intensity" / BitsInteger(10)), 3, (1, 2), camera_angle, intense=True
)
HALF = Form(alone(0.0005), correction=camera_angle)
TOF = Form(alone(0.001), slowest=3.0)
TOF_8 = Form(EIGHT, 3, (1, 2), intense=True)
TOF_16 = Form(
    Struct("intensity" / Int16ul, "distance" / Scaled(Int16ul, 0.001, "m") * NONE), 4, intense=True
)
