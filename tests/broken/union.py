"""Union, which ignores edits of all but one of its members."""

from __future__ import annotations

from construct import Bytes, Int16ul, Union

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, make_frame, sensor


@hookimpl
def lidarspec_sensors():
    spare = Union(0, "number" / Int16ul, "data" / Bytes(2))
    return [sensor(frame(make_frame(spare=spare), max_length=SIZE + 8))]
