"""A one-bit sync pattern, which occurs throughout the payload."""

from __future__ import annotations

from construct import BitsInteger, BitStruct, Const

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    return [
        sensor(
            frame(
                make_frame(
                    header=BitStruct("sync" / Const(1, BitsInteger(1)), "kind" / BitsInteger(7))
                ),
                max_length=SIZE - 2,
            )
        )
    ]
