"""The correct sensor that each broken plugin copies with one mistake.

Its frame has a header, a count, a first and a last angle, and a checksum.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Int16sl, Int16ul, Struct, this

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Clock,
    Command,
    Fields,
    Frame,
    OnWrap,
    PacketCounter,
    Polar,
    Scaled,
    Serial,
    Simulation,
    Sum,
    Xor,
    hookimpl,
    spread,
)

LONGEST = 24  # samples
STEP = 1.5  # degrees from one to the next
PERIOD = 0.005  # seconds from packet to packet
WRAP = 50.0  # seconds

SAMPLE = Struct("distance" / Scaled(Int16ul, 0.001, "m"), "quality" / Int8ul)
FIELDS: dict[str, Any] = {
    "header": Const(b"\xaa\x55\xc3"),
    "number": Int8ul,
    "time": Scaled(Int16ul, 0.001, "s"),
    "tilt": Scaled(Int16sl, 0.01, "deg"),
    "first": Scaled(Int16ul, 0.01, "deg"),
    "last": Scaled(Int16ul, 0.01, "deg"),
    "count": Int8ul,
    "samples": Array(this.count, SAMPLE),
    "sum": Int16ul,
}


def struct(**changes: Any) -> Struct:
    """Return the fields of the data frame with changes.

    New fields come before the checksum; a value of None removes a field.
    """
    fields = {**FIELDS, **changes}
    fields["sum"] = fields.pop("sum")
    return Struct(*(name / con for name, con in fields.items() if con is not None))


def make_frame(**changes: Any) -> Checksummed:
    """Return the struct of the data frame with changed fields."""
    return Checksummed(struct(**changes), field="sum", algorithm=Sum(16))


def plausible(f: Fields) -> Any:
    """Require a sample, angles below 360 degrees, and a time below its wrap."""
    return (
        (f.count >= 1) & (f.count <= LONGEST) & (f.first < 360) & (f.last < 360) & (f.time < WRAP)
    )


def points(f: Fields) -> Polar:
    """Return points, counter-clockwise from the first to the last angle."""
    degrees = spread(f.first, f.last, f.count, full=360.0)
    return Polar(f.samples.distance, np.deg2rad(degrees), intensity=f.samples.quality)


def sweep(i: int) -> dict[str, float]:
    """Return the values of packet i, ten packets of 24 samples a turn."""
    first = (10 + i * LONGEST * STEP) % 360
    last = (first + (LONGEST - 1) * STEP) % 360
    return dict(
        number=i % 256, time=i * PERIOD % WRAP, tilt=0, first=first, last=last, count=LONGEST
    )


ORDER = Checksummed(
    Struct("header" / Const(b"\x16\x61"), "code" / Int8ul, "check" / Int8ul),
    field="check",
    algorithm=Xor(),
)
ACK = Checksummed(
    Struct("header" / Const(b"\x17\x71\x44"), "code" / Int8ul, "check" / Int8ul),
    field="check",
    algorithm=Xor(),
)
SIZE = 15 + 3 * LONGEST


def frame(con: Any = None, **changes: Any) -> Frame:
    """Return the data frame."""
    return Frame(
        **(
            dict(struct=con or make_frame(), data=True, max_length=SIZE, plausible=plausible)
            | changes
        )
    )


def sensor(data: Frame | None = None, kind: type[Sensor] = Sensor, **changes: Any) -> Sensor:
    """Return the sensor with another data frame, or another declaration."""
    given: dict[str, Any] = dict(
        vendor="Broken",
        model="One",
        frames={
            "data": data or frame(),
            "ack": Frame(ACK, max_length=5, plausible=lambda f: f.code < 8),
            "order": Frame(ORDER, direction="out", max_length=4),
        },
        commands={
            "start": Command("order", {"code": 1}, reply="ack", matches={"code": 1}, starts=True)
        },
        points=points,
        scan=OnWrap("azimuth"),
        links={"data": Serial(115_200)},
        clock=Clock("time", wraps_at=WRAP),
        sequence=PacketCounter("number"),
        simulation=Simulation(sweep),
        range_limits=(0.05, 30.0),
        status="manual",
        source="invented for the tests",
    )
    return kind("broken-one", **given | changes)


@hookimpl
def lidarspec_sensors() -> list[Sensor]:
    """Return the correct sensor."""
    return [sensor()]
