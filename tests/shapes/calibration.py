"""Calibration from a file: the number of channels and their elevations.

Without the file there are no frames.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Struct

from lidarspec import Sensor, UsageError
from lidarspec.spec import Checksummed, Crc, Fields, Frame, OnWrap, Polar, Scaled, Serial, take

EXAMPLE = Path(__file__).with_name("calibration.json")


def data(channels: int) -> Checksummed:
    """Return the data frame of a model with this number of channels."""
    return Checksummed(
        Struct(
            "header" / Const(b"\xca\x1b"),
            "azimuth" / Scaled(Int16ul, 0.01, "deg"),
            "channels"
            / Array(channels, Struct("row" / Int8ul, "distance" / Scaled(Int16ul, 0.001, "m"))),
            "crc" / Int8ul,
        ),
        field="crc",
        algorithm=Crc(8, 0x07),
    )


def configure(sensor: Sensor, *, calibration: str | Path) -> Sensor:
    """Return the sensor with the frames and elevations of a calibration file."""
    try:
        elevations = json.loads(Path(calibration).read_text(encoding="utf-8"))["elevations"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{calibration}: not a calibration file of this sensor: {error}"
        ) from error
    table = np.deg2rad(elevations)

    def points(f: Fields) -> Polar:
        """Return points; a row that is not in the file has no direction."""
        return Polar(
            range=f.channels.distance,
            azimuth=np.deg2rad(f.azimuth),
            elevation=take(table, f.channels.row),
            ring=f.channels.row,
        )

    frame = Frame(
        data(len(table)),
        data=True,
        max_length=5 + 3 * len(table),
        acknowledged={"LS206": "no line is noisy enough for a shape"},
    )
    return dataclasses.replace(sensor, frames={"data": frame}, points=points)


BARE = Sensor(
    "shape-calibration",
    vendor="Shapes",
    model="Calibration",
    frames={},
    points=None,
    scan=OnWrap("azimuth"),
    links={"data": Serial(921_600)},
    configure=configure,
    range_limits=(0.2, 60.0),
    status="manual",
    source="invented for the tests: calibration from a file",
)

SENSOR = BARE.configure(calibration=EXAMPLE)
