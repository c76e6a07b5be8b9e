"""A sensor with rare features, for the tests of exports.

It has formulas of every kind, unusual numbers, and unusual names.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    BytesInteger,
    ByteSwapped,
    Const,
    Enum,
    Float16b,
    Float16l,
    Float32l,
    If,
    IfThenElse,
    Int8sb,
    Int8ub,
    Int16sl,
    Int16ub,
    Int16ul,
    Int24sl,
    Int24ub,
    Int32ul,
    Int64ub,
    Struct,
    Switch,
    this,
)

from lidarspec import Sensor
from lidarspec.spec import (
    Checksummed,
    Crc,
    Fields,
    Fletcher,
    Fold15,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Serial,
    Sum,
    Tcp,
    WordXor,
    Xor,
    ZeroPadded,
)

FORMULAS = Struct(
    "magic" / Const(b"\xf0\x01"),
    "a" / Int8ub,
    "b" / Int8ub,
    "c" / Int8sb,
    "lambda_" / Array(lambda context: context.a % 4 + 1, Int8ub),
    "floor" / Bytes((this.a - this.b) // 7 % 5),
    "shifts" / Bytes(((this.a >> 6) << 1) + (this.b & 3) ^ (this.a | 1) & 1),
    "negated" / If(~(this.a > 128), Int16ub),
    "either"
    / IfThenElse(
        (this.c < 0) & (this.b != 7),
        Struct("low" / Int8ub, "wide" / Int16ub),
        Struct("low" / Int16ub),
    ),
    "rows"
    / Array(
        this.b % 3,
        Struct(
            "cells"
            / Array(
                this._.a % 3 + 1, Struct("x" / Int8ub, "y" / Scaled(Int16sl, 0.5, "mm", offset=3))
            )
        ),
    ),
)
KINDS = Struct(
    "magic" / Const(b"\xf0\x02"),
    "kind" / Enum(Int8ub, plain=1, fancy=2, nothing=9) * 'with "quotes" and */ signs',
    "body"
    / Switch(
        this.kind,
        {
            "plain": Struct("value" / Int8ub),
            "fancy": Struct("value" / Int32ul, "size" / Int8ub, "data" / Bytes(this.size % 4)),
        },
        default=Struct("other" / Float32l),
    ),
    "length" / Int8ub,
    "frame_length" / Int8ub,
    "is_frame" / Int8ub,
)
NUMBERS = Struct(
    "magic" / Const(b"\xf0\x03"),
    "halves" / Array(3, Struct("big" / Float16b, "little" / Float16l)),
    "int24" / Int24sl,
    "uint24" / Int24ub,
    "int40" / BytesInteger(5, signed=True),
    "uint56" / BytesInteger(7, swapped=True),
    "uint64" / Int64ub,
    "bits"
    / BitStruct(
        "few" / Array(3, BitsInteger(5)),
        "flag" / BitsInteger(1),
        "wide" / BitsInteger(56),
        "end" / BitsInteger(8, signed=True),
    ),
    "pairs"
    / Array(
        2,
        Struct(
            "mark" / Const(0x5A, Int8ub),
            Const(b"\x77"),
            "tail" / ByteSwapped(BitStruct("u" / BitsInteger(12), "v" / BitsInteger(4))),
        ),
    ),
)


def make_checksummed_struct(number: int, algorithm: Any, field: Any) -> Checksummed:
    """Return a struct with a checksum in the middle."""
    body = Struct(
        "magic" / Const(bytes([0xF1, number])),
        "count" / Int8ub,
        "data" / Bytes(this.count % 90),
        "sum" / field,
        "rest" / Bytes(3),
    )
    return Checksummed(body, field="sum", algorithm=algorithm)


ALGORITHMS = [
    (
        Crc(64, 0x42F0E1EBA9EA3693, init=2**64 - 1, refin=True, refout=True, xorout=2**64 - 1),
        Int64ub,
    ),
    (Crc(40, 0x0004820009, init=0x123456789A, order="big"), BytesInteger(5)),
    (Crc(32, 0x04C11DB7, init=0xFFFFFFFF), Int32ul),
    (Crc(24, 0x864CFB, init=0xB704CE), Int24ub),
    (Crc(12, 0x80F, refout=True, xorout=5), Int16ub),
    (Crc(5, 0x05, init=0x1F, refin=True, refout=True, xorout=0x1F), Int8ub),
    (Crc(16, 0x8005, refin=True, order="big"), Bytes(2)),
    (Crc(3, 0x3, xorout=0x7), Int8ub),
    (Sum(16, order="big"), Bytes(2)),
    (Sum(64), Int64ub),
    (Xor(), Int8ub),
    (WordXor(3, (2, 1)), Int16ub),
    (WordXor(0, (1, 2, 2)), Int16sl),
    (Fletcher(), Int16ul),
    (Fold15(), Int16ub),
    (ZeroPadded(Crc(32, 0x04C11DB7, refin=True), 4), Int32ul),
    (ZeroPadded(WordXor(1, (1, 2)), 8), Int16ub),
]

DATA = Struct(
    "magic" / Const(b"\xf0\x00"),
    "angle" / Scaled(Int16ub, 0.01, "deg"),
    "distance" / Scaled(Int16ub, 0.001, "m"),
)


def points(f: Fields) -> Polar:
    return Polar(range=f.distance, azimuth=np.deg2rad(f.angle))


SENSOR = Sensor(
    "shape-oddities",
    vendor="Shapes",
    model='Odd "ities"',
    frames={
        "data": Frame(DATA, data=True, max_length=6),
        "formulas": Frame(FORMULAS, max_length=80),
        "kinds": Frame(KINDS, max_length=20),
        "numbers": Frame(NUMBERS, max_length=70),
        **{
            f"checksummed{number}": Frame(make_checksummed_struct(number, *pair), max_length=110)
            for number, pair in enumerate(ALGORITHMS)
        },
    },
    points=points,
    scan=OnWrap("angle"),
    links={"data": Serial(115_200), "control": Tcp(7010)},
    range_limits=(0.1, 10.0),
    status="manual",
    source="invented for the tests: */ what exports may stumble over",
)
