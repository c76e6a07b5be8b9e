"""The length that a frame claims is skipped where its checksum is wrong."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.handmade import Own, Parser
from tests.broken.sound import sensor


class Broken(Parser):
    def step(self, spot, size):
        return max(size, 1)


class Mine(Own):
    parser = Broken


@hookimpl
def lidarspec_sensors():
    return [sensor(kind=Mine)]
