"""The buffer is copied for each byte: buf = buf[1:]."""

from __future__ import annotations

from lidarspec.spec import hookimpl
from tests.broken.handmade import Own, Parser
from tests.broken.sound import sensor


class Broken(Parser):
    def cut(self, *, final):
        found = []
        while self.buffer[:1] not in (b"", b"\xaa", b"\x17"):
            self.buffer = self.buffer[1:]
            self.base += 1
            self.stats.bytes_skipped += 1
        if self.buffer:
            found = super().cut(final=final)
        self.stats.pending = len(self.buffer)
        return found

    def step(self, spot, size):
        self.buffer = self.buffer[:spot] + self.buffer[spot:]  # as above, after a header that was none
        return 1


class Mine(Own):
    parser = Broken


@hookimpl
def lidarspec_sensors():
    return [sensor(kind=Mine)]
