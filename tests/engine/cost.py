"""Measure the cost of finding frames, in function calls and bytes of memory.

Times are not used, because they depend on the other load of the machine.
"""

from __future__ import annotations

import cProfile
import gc
import tracemalloc

from lidarspec import Sensor
from lidarspec.framing.results import Frames

#: Function calls for each byte of a stream. Compiled frames need up to 16.
MAX_CALLS_PER_BYTE = 100
#: Function calls for each byte of headers without a frame, which are rejected in bulk.
MAX_REJECTING_CALLS_PER_BYTE = 8
#: Bytes of memory for each byte of a stream that its frames are kept in.
MAX_KEPT_PER_BYTE = 64


def calls_per_byte(sensor: Sensor, data: bytes) -> float:
    """Return the number of function calls per byte that it takes to find the frames of a stream.

    Calls of functions written in C count too; the work inside one of them does not.
    """
    profile = cProfile.Profile()
    collects = gc.isenabled()
    gc.disable()  # a collection calls finalizers of other objects
    profile.enable()
    try:
        _find_frames(sensor, data)
    finally:
        profile.disable()
        if collects:
            gc.enable()
    return sum(entry.callcount for entry in profile.getstats()) / len(data)


def kept_per_byte(sensor: Sensor, data: bytes) -> float:
    """Return the memory that the frames of a stream take, as bytes per byte of input.

    The bytes of the stream itself do not count.
    """
    _find_frames(sensor, data)  # imports and layouts are made once
    gc.freeze()  # collections skip the objects that exist already
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        found = _find_frames(sensor, data)
        gc.collect()
        kept = tracemalloc.get_traced_memory()[0] - before
        return kept / len(data) if found else 0.0
    finally:
        tracemalloc.stop()
        gc.unfreeze()


def _find_frames(sensor: Sensor, data: bytes) -> list[Frames]:
    decoder = sensor.decoder()
    if sensor.datagrams:
        return [decoder.datagrams([data])]
    return [*decoder.frames(data), *decoder.take_pending()]
