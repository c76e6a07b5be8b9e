"""The frames of a file that apply from its start.

They are the first frames with state for points, and the first reference of the clock.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import Frames
from lidarspec.packets.clocks import ClockReference, reference_readings, reported_seconds
from lidarspec.sensor_operations import Sensor

#: bytes of a file to search for a frame type that could tell the turn of the clock.
REFERENCE_SEARCH_BYTES = 64 << 20


@dataclass
class FirstFrames:
    """The frames that apply from the first packet on.

    Attributes:
        state: the first frame of each type that `points` takes its state from, by name.
        reference: the first frame that determines the turn of the clock; None if there is none.
    """

    state: dict[str, bytes] = field(default_factory=dict)
    reference: ClockReference | None = None


def is_searched(sensor: Sensor) -> bool:
    """Return whether any frames of a sensor apply from the start."""
    return bool(sensor.state) or (sensor.clock is not None and sensor.clock.reference is not None)


def find_first_frames(sensor: Sensor, batches: Iterable[list[Frames]]) -> FirstFrames:
    """Return the frames that apply from the start of a file.

    Args:
        batches: its frames, which are read only as far as needed.
    """
    first = FirstFrames()
    missing = set(sensor.state)
    clock = sensor.clock
    if clock is not None and clock.reference is not None:
        teller = clock.reference[0]
    else:
        teller = ""
    has_teller = False
    seen_bytes = 0
    for batch in batches:
        for frames in batch:
            seen_bytes += int(frames.sizes.sum())
            for name in missing & set(frames.names):
                rows = np.flatnonzero(frames.kinds == frames.names.index(name))
                if len(rows):
                    first.state[name] = frames.data(int(rows[0]))
            missing -= set(first.state)
            if teller in frames.names:
                rows = np.flatnonzero(frames.kinds == frames.names.index(teller))
                has_teller = has_teller or len(rows) > 0
                if first.reference is None and len(rows):
                    first.reference = _find_reference(sensor, teller, frames, rows)
        if teller and (
            first.reference is not None or (not has_teller and seen_bytes > REFERENCE_SEARCH_BYTES)
        ):
            teller = ""
        if not missing and not teller:
            break
    return first


def _find_reference(
    sensor: Sensor, name: str, frames: Frames, rows: NDArray[np.intp]
) -> ClockReference | None:
    """Return the first of some frames that determines the turn of the clock."""
    assert sensor.clock is not None
    table = codec(sensor.frames[name]).table([frames.data(int(row)) for row in rows])
    try:
        seconds = reported_seconds(sensor.clock, table)
        readings = reference_readings(sensor, table)
    except Exception:
        return None  # reported when the packets are decoded
    finite = np.flatnonzero(np.isfinite(seconds))
    if not len(finite):
        return None
    first = finite.item(0)
    host_ns = max(frames.at.item(rows.item(first)), 0)
    return ClockReference(readings.item(first), seconds.item(first), host_ns)
