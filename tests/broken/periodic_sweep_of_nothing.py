"""A sweep of a frame without points that sets a field that the frame does not have."""

from __future__ import annotations

from construct import Const, Int8ul, Struct

from lidarspec.spec import Checksummed, Frame, Simulation, Xor, hookimpl
from tests.broken import sound

STATUS = Checksummed(
    Struct("header" / Const(b"\x18\x81\x55"), "mode" / Int8ul, "check" / Int8ul),
    field="check",
    algorithm=Xor(),
)


def periodic_sweep(i):
    return {"status": i % 4}


@hookimpl
def lidarspec_sensors():
    status = Frame(STATUS, max_length=5, simulation=Simulation(periodic_sweep, rate=10))
    return [sound.sensor(frames={**sound.sensor().frames, "status": status})]
