"""The eight formats of YDLIDAR samples, which have two, three or four bytes.

Source: YDLIDAR SDK, "YDLidar-SDK Communication Protocol" (scan command response) and
core/common/ydlidar_protocol.h.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from construct import BitsInteger, BitStruct, ByteSwapped, Construct, Enum, Int16ul, Struct

from lidarspec.spec import Scaled

NO_RETURN_NOTE = "0: no return"


@dataclass(frozen=True, eq=False)
class SampleFormat:
    """One format of samples.

    Attributes:
        size: bytes of a sample.
        groups: the sizes in bytes of the words into which the checksum divides a sample.
        correction: a function of the distance in metres that returns the degrees to add to the
            angle.
        lowest_frequency_hz: the offset of the scan frequency in Hz. The frequency is this offset
            plus 0.1 Hz times the raw value. The raw value 0 is decoded as the offset, but means
            that the frequency is unknown.
    """

    struct: Construct
    size: int = 2
    groups: tuple[int, ...] = (2,)
    correction: Callable[[Any], Any] | None = None
    lowest_frequency_hz: float = 0.0
    has_intensity: bool = False


def camera_angle(distance: Any) -> Any:
    """Return the angle between laser beam and ray to the image sensor, in degrees.

    Models that triangulate have an image sensor beside the laser. Source: YDLidar-SDK Communication
    Protocol, angle second-level analysis.
    """
    mm = np.maximum(distance * 1000, 0.25)
    return np.where(distance > 0, np.rad2deg(np.arctan(21.8 * (155.3 - mm) / (155.3 * mm))), 0)


def make_plain_distance(step: float) -> Construct:
    """Return the struct of a sample with only a distance, in steps of `step` metres."""
    return Struct("distance" / Scaled(Int16ul, step, "m") * NO_RETURN_NOTE)


def make_packed_sample(*lower_fields: Construct) -> Construct:
    """Return the struct of a sample with the distance in mm in the upper 14 bits."""
    return ByteSwapped(
        BitStruct("distance" / Scaled(BitsInteger(14), 0.001, "m") * NO_RETURN_NOTE, *lower_fields)
    )


REFLECTION = "flags" / Enum(BitsInteger(2), plain=0, mirror_or_glass=2, sunlight=3)
SAMPLE_8 = make_packed_sample(REFLECTION, "intensity" / BitsInteger(8))

TRIANGLE = SampleFormat(make_plain_distance(0.00025), correction=camera_angle)
TRIANGLE_FLAGGED = SampleFormat(
    make_packed_sample("flags" / BitsInteger(2) * "not 0: interference from another lidar"),
    correction=camera_angle,
)
TRIANGLE_8 = SampleFormat(SAMPLE_8, 3, (1, 2), camera_angle, has_intensity=True)
TRIANGLE_10 = SampleFormat(
    make_packed_sample("intensity" / BitsInteger(10)), 3, (1, 2), camera_angle, has_intensity=True
)
HALF = SampleFormat(make_plain_distance(0.0005), correction=camera_angle)
TOF = SampleFormat(make_plain_distance(0.001), lowest_frequency_hz=3.0)
TOF_8 = SampleFormat(SAMPLE_8, 3, (1, 2), has_intensity=True)
TOF_16 = SampleFormat(
    Struct("intensity" / Int16ul, "distance" / Scaled(Int16ul, 0.001, "m") * NO_RETURN_NOTE),
    4,
    has_intensity=True,
)
