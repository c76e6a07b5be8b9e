"""RawCopy and construct's Checksum, which ignore edits when they build again."""

from __future__ import annotations

from construct import Checksum, Int8ul, RawCopy, Struct, this

from lidarspec.spec import hookimpl
from tests.broken.sound import SIZE, frame, sensor, struct

DATA = Struct(
    "body" / RawCopy(struct()),
    "check" / Checksum(Int8ul, lambda data: sum(data) & 0xFF, this.body.data),
)


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(DATA, max_length=SIZE + 1))]
