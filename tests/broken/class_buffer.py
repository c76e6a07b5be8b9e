"""A buffer of the class, which all decoders share."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.handmade import Own, Parser
from tests.broken.sound import sensor


class Broken(Parser):
    held = bytearray()

    def feed(self, data, at=None):
        self.stats.bytes_in += len(data)
        self.held.extend(data)
        self.buffer = bytes(self.held)
        return self.cut(final=False)

    def drop(self, number):
        super().drop(number)
        del self.held[:number]


class Mine(Own):
    parser = Broken


@hookimpl
def lidarspec_sensors():
    return [sensor(kind=Mine)]
