"""A partial header at the end of a chunk is dropped."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.handmade import Own, Parser
from tests.broken.sound import sensor


class Broken(Parser):
    def feed(self, data, at=None):
        found = super().feed(data, at)
        if len(self.buffer) < 3:
            self.stats.bytes_skipped += len(self.buffer)
            self.drop(len(self.buffer))
        return found


class Mine(Own):
    parser = Broken


@hookimpl
def lidarspec_sensors():
    return [sensor(kind=Mine)]
