"""An exception is swallowed, and what it cost is not counted."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.handmade import Own, Parser
from tests.broken.sound import sensor


class Broken(Parser):
    def feed(self, data, at=None):
        try:
            return super().feed(data, at)
        except Exception:
            return []

    def cut(self, *, final):
        if len(self.buffer) % 7 == 3:
            self.buffer = b""
            raise IndexError("bytearray index out of range")
        return super().cut(final=final)


class Mine(Own):
    parser = Broken


@hookimpl
def lidarspec_sensors():
    return [sensor(kind=Mine)]
