"""Draws the code of an invalid sample as a range."""

from __future__ import annotations

import numpy as np
from construct import Array, Int8ul, Int16ul, Struct, this

from lidarspec.spec import Polar, Scaled, hookimpl, spread
from tests.broken.sound import frame, make_frame, sensor

CODED = make_frame(
    samples=Array(
        this.count, Struct("error_code" / Scaled(Int16ul, 0.001, "m"), "quality" / Int8ul)
    )
)


def points(f):
    degrees = spread(f.first, f.last, f.count, full=360.0)
    return Polar(f.samples.error_code, np.deg2rad(degrees), intensity=f.samples.quality)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(CODED), points=points)]
