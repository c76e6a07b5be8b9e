"""The byte that does not match a header is not looked at again."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.handmade import Own, Parser
from tests.broken.sound import sensor


class Broken(Parser):
    def step(self, spot, size):
        return 2 if self.buffer[spot] == 0xAA and self.buffer[spot + 1 : spot + 2] != b"\x55" else 1


class Mine(Own):
    parser = Broken


@hookimpl
def lidarspec_sensors():
    return [sensor(kind=Mine)]
