"""Sensors that load but raise when used.

They raise in a checksum, an expression of the struct, `plausible` or `points`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Struct, this

from lidarspec import Sensor
from lidarspec.spec import Checksum, Checksummed, Fields, Frame, OnWrap, Polar, Serial, hookimpl

BODY = (
    "header" / Const(b"\xbb\xad"),
    "angle" / Int8ul,
    "distances" / Array(4, Int8ul),
    "check" / Int8ul,
)


class Fails(Checksum):
    """Divides by zero."""

    width = 8

    def __call__(self, data: Any) -> int:
        return len(data) // 0

    def batch(self, rows: Any) -> Any:
        return len(rows) // 0

    def describe(self) -> str:
        return "one that fails"


def points(f: Fields) -> Polar:
    return Polar(range=f.distances, azimuth=np.deg2rad(f.angle))


def fails(f: Fields) -> Any:
    raise RuntimeError("no such luck")


def plain(name: str, **changes: Any) -> Sensor:
    """Return a sensor with one frame of eight bytes and no checksum."""
    sensor = Sensor(
        name,
        vendor="Broken",
        model=name,
        frames={"data": Frame(Struct(*BODY), data=True, max_length=8)},
        points=points,
        scan=OnWrap("azimuth"),
        links={"data": Serial(115_200)},
        range_limits=(0.1, 1.0),
        status="manual",
        source="invented for the tests",
    )
    return dataclasses.replace(sensor, **changes)


def make_frames(struct: Any, **options: Any) -> dict[str, Frame]:
    return {"data": Frame(struct, data=True, max_length=8, **options)}


@hookimpl
def lidarspec_sensors() -> list[Sensor]:
    return [
        plain(
            "broken-checksum",
            frames=make_frames(Checksummed(Struct(*BODY), field="check", algorithm=Fails())),
        ),
        plain(
            "broken-parse",
            frames=make_frames(
                Struct(
                    *BODY[:2],
                    "distances" / Array(4 + 1 // (this.angle - this.angle), Int8ul),
                    BODY[3],
                )
            ),
        ),
        plain("broken-plausible", frames=make_frames(Struct(*BODY), plausible=fails)),
        plain("broken-points", points=fails),
        plain("broken-field", points=lambda f: Polar(range=f.distance, azimuth=0)),
        plain("broken-shape", points=lambda f: Polar(range=f.distances, azimuth=np.zeros(3))),
        plain("broken-result", points=lambda f: f.distances),
        plain("broken-nan", points=lambda f: Polar(range=f.distances * np.nan, azimuth=np.nan)),
    ]
