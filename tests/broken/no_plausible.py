"""A frame with a weak header and without a `plausible` test."""

from __future__ import annotations

from construct import Const, Int8ul

from lidarspec.spec import Checksummed, Xor, hookimpl
from tests.broken.sound import SIZE, frame, sensor, struct

DATA = Checksummed(struct(header=Const(b"\xaa"), sum=Int8ul), field="sum", algorithm=Xor())


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(DATA, max_length=SIZE - 3, plausible=None))]
