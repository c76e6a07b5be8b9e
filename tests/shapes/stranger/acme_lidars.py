"""The Acme X1, an invented sensor that uses only public names, as other authors do.

It has a variable count, bit fields, a checksum in the middle, a command, state from another packet,
access to the next packet, and a calibration file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    ByteSwapped,
    Const,
    Int8ul,
    Int16ul,
    Struct,
    this,
)

from lidarspec import Sensor, UsageError
from lidarspec.spec import (
    Checksummed,
    Command,
    Crc,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Serial,
    Simulation,
    Xor,
    following,
    hookimpl,
    previous,
    take,
    wrap,
)

LONGEST = 32

DATA = Checksummed(
    Struct(
        "header" / Const(b"\xac\x3e"),
        "count" / Int8ul,
        "crc" / Int16ul,
        "start" / Scaled(Int16ul, 0.01, "deg"),
        "samples"
        / Array(
            this.count,
            ByteSwapped(
                BitStruct(
                    "distance" / Scaled(BitsInteger(16), 0.001, "m"),
                    "row" / BitsInteger(2),
                    "quality" / BitsInteger(6),
                )
            ),
        ),
    ),
    field="crc",
    algorithm=Crc(16, 0x1021, init=0xFFFF),
)
MOUNT = Checksummed(
    Struct("header" / Const(b"\xac\x3f"), "zero" / Scaled(Int16ul, 0.01, "deg"), "check" / Int8ul),
    field="check",
    algorithm=Xor(),
)
ORDER = Checksummed(
    Struct("header" / Const(b"\xac\x01"), "rate" / Scaled(Int8ul, 0.1, "Hz"), "check" / Int8ul),
    field="check",
    algorithm=Xor(),
)

NOMINAL = (-1.5, -0.5, 0.5, 1.5)


def points_with(elevations: Iterable[float]) -> Any:
    """Return the points function for these elevations of the four rows, in degrees."""
    table = np.deg2rad(list(elevations))

    def points(f: Fields) -> Polar:
        """Return points spread from this packet's start up to the next packet's."""
        step = wrap(following(f.start) - f.start, 360)
        step = np.where(np.isfinite(step), step, wrap(f.start - previous(f.start), 360)) / f.count
        clockwise = f.start - f.state.mount.zero + step * f.count.steps()
        return Polar(
            range=f.samples.distance,
            azimuth=-np.deg2rad(clockwise),
            elevation=take(table, f.samples.row),
            intensity=f.samples.quality,
        )

    return points


def configure(sensor: Sensor, *, calibration: str | Path) -> Sensor:
    """Return the sensor with the elevations of a file: four numbers in degrees."""
    try:
        elevations = [float(word) for word in Path(calibration).read_text(encoding="utf-8").split()]
    except (OSError, ValueError) as error:
        raise UsageError(f"{calibration}: not a file of elevations: {error}") from error
    return dataclasses.replace(sensor, points=points_with(elevations))


def sweep(i: int) -> dict[str, float]:
    """Return the values of packet i, thirty-six packets a turn."""
    return dict(count=4, start=i * 10.0 % 360)


X1 = Sensor(
    "acme-x1",
    vendor="Acme",
    model="X1",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=7 + 3 * LONGEST,
            plausible=lambda f: (f.count >= 1) & (f.start < 360),
        ),
        "mount": Frame(MOUNT, max_length=5, plausible=lambda f: f.zero < 360),
        "order": Frame(ORDER, direction="out", max_length=4),
    },
    points=points_with(NOMINAL),
    scan=OnWrap("start"),
    links={"data": Serial(256_000)},
    commands={"spin": Command("order", args={"rate": ("rate", 5.0, 15.0)})},
    state={"mount": {"zero": 0.0}},
    simulation=Simulation(sweep),
    configure=configure,
    range_limits=(0.1, 30.0),
    aliases=("acme-x1-lite",),
    status="manual",
    source="Acme X1 manual, which nobody wrote",
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Acme sensors."""
    return [X1]
