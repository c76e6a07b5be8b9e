"""Points that need the next packet: the beams are spread up to its first angle.

They also use the previous packet and the last valid value.
"""

from __future__ import annotations

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Struct

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Crc,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Serial,
    following,
    last,
    previous,
    wrap,
)

SAMPLES = 8

DATA = Checksummed(
    Struct(
        "header" / Const(b"\x77\x99"),
        "angle" / Scaled(Int16ul, 0.01, "deg"),
        "lift" / Scaled(Int8ul, 0.1, "deg") * "0: as before",
        "distances" / Array(SAMPLES, Scaled(Int16ul, 0.001, "m")),
        "crc" / Int8ul,
    ),
    field="crc",
    algorithm=Crc(8, 0x31, init=0xFF),
)


def points(f: Fields) -> Polar:
    """Return points from the angles of a packet and the next one.

    The last packet before a loss has no next angle. It uses the step from the packet before.
    """
    step = wrap(following(f.angle) - f.angle, 360)
    before = wrap(f.angle - previous(f.angle), 360)
    step = np.where(np.isfinite(step), step, before) / SAMPLES
    return Polar(
        range=(previous(f.distances) + f.distances + following(f.distances)) / 3,
        azimuth=np.deg2rad(f.angle + step * np.arange(SAMPLES)),
        elevation=np.deg2rad(np.nan_to_num(last(f.lift, where=f.lift > 0))),
    )


SENSOR = Sensor(
    "shape-ahead",
    vendor="Shapes",
    model="Ahead",
    frames={"data": Frame(DATA, data=True, max_length=22, plausible=lambda f: f.angle < 360)},
    points=points,
    scan=OnWrap("angle"),
    links={"data": Serial(115_200)},
    range_limits=(0.05, 30.0),
    status="manual",
    source="invented for the tests: a frame that needs the next",
)
