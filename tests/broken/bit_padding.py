"""Padding among bits."""

from __future__ import annotations

from construct import BitsInteger, BitStruct, Padding

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, sealed, sensor


@hookimpl
def lidarspec_sensors():
    return [
        sensor(
            frame(
                sealed(status=BitStruct("dirty" / BitsInteger(1), Padding(7))), max_length=SIZE + 8
            )
        )
    ]
