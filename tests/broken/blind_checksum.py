"""A custom checksum that ignores some bytes."""

from __future__ import annotations

from lidarspec.spec import Checksum, Checksummed, hookimpl
from tests.broken.sound import frame, sensor, struct


class EveryOther(Checksum):
    width = 16

    def __call__(self, data):
        return sum(bytes(data)[::2]) & 0xFFFF

    def describe(self):
        return "sum of every other byte"


DATA = Checksummed(struct(), field="sum", algorithm=EveryOther())


@hookimpl
def lidarspec_sensors():
    return [sensor(frame(DATA))]
