"""Bit fields in both orders: 24-bit samples from the low and from the high end.

The frame also has mirrored bits and plain 24-bit integers.
"""

from __future__ import annotations

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitsSwapped,
    BitStruct,
    ByteSwapped,
    Const,
    Int16ub,
    Int24sb,
    Int24ul,
    Struct,
)

from lidarspec import Sensor
from lidarspec.spec import Checksummed, Crc, Fields, Frame, OnWrap, Polar, Scaled, Serial, stack

SAMPLES = 6


def sample() -> BitStruct:
    """Return the struct of a sample of 24 bits; its fields begin at the high end."""
    return BitStruct(
        "distance" / Scaled(BitsInteger(14), 0.001, "m"),
        "mode" / BitsInteger(2),
        "intensity" / BitsInteger(8),
    )


DATA = Checksummed(
    Struct(
        "header" / Const(b"\xb1\x7e"),
        "first" / Scaled(Int24ul, 0.0001, "deg"),
        "drift" / Scaled(Int24sb, 0.001, "deg"),
        "little" / Array(SAMPLES, ByteSwapped(sample())),
        "big" / Array(SAMPLES, sample()),
        "mirrored"
        / BitsSwapped(
            BitStruct(
                "flags" / BitsInteger(3), "tilt" / Scaled(BitsInteger(5, signed=True), 1, "deg")
            )
        ),
        "crc" / Int16ub,
    ),
    field="crc",
    algorithm=Crc(16, 0x1021, init=0xFFFF, order="big"),
)


def points(f: Fields) -> Polar:
    """Return two returns of each beam, from two arrays, on the axis of the first."""
    step = np.arange(SAMPLES) * 2.0
    azimuth = np.deg2rad(f.first + f.drift * 0.001 + step)
    return Polar(
        range=stack(f.little.distance, f.big.distance.on("little")),
        azimuth=azimuth,
        elevation=np.deg2rad(f.mirrored.tilt),
        intensity=stack(f.little.intensity, f.big.intensity.on("little")),
        return_index=np.arange(2),
        invalid=stack(f.little.mode, f.big.mode.on("little")) == 3,
    )


SENSOR = Sensor(
    "shape-bits",
    vendor="Shapes",
    model="Bits",
    frames={"data": Frame(DATA, data=True, max_length=47)},
    points=points,
    scan=OnWrap("first"),
    links={"data": Serial(460_800)},
    range_limits=(0.05, 16.0),
    status="manual",
    source="invented for the tests: bit fields in both orders",
)
