"""Search a file for frames that are needed to decode its first packets.

Some packets can be decoded only with a frame of another type, such as a calibration or a date. If
this frame comes after the first packets of a file, it is used from the start of the file.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.results import Frames
from lidarspec.packets.clocks import ClockReference, reference_readings, reported_seconds
from lidarspec.sensor_operations import Sensor

#: If no frame of the type that provides a date for the clock arrives within this number of bytes,
#: the search for it ends. If such frames arrive, but without a valid date, the search continues.
REFERENCE_SEARCH_BYTES = 64 << 20


@dataclass
class FirstFrames:
    """The frames that are used as if they were at the start of a file.

    Attributes:
        state: frame type in `Sensor.state` -> the first frame of this type.
        reference: the first date for the clock; None if the file has no date.
    """

    state: dict[str, bytes] = field(default_factory=dict)
    reference: ClockReference | None = None


def needs_first_frames(sensor: Sensor) -> bool:
    """Return whether the packets of a sensor are decoded with frames of other types."""
    return bool(sensor.state) or (sensor.clock is not None and sensor.clock.reference is not None)


def find_first_frames(sensor: Sensor, batches: Iterable[list[Frames]]) -> FirstFrames:
    """Return the frames to use before the first packet of a file.

    Args:
        batches: the frames of the file, which are read until all needed frames are found.
    """
    first = FirstFrames()
    missing = set(sensor.state)
    reference_frame: str | None = None  # while it is searched for
    if sensor.clock is not None and sensor.clock.reference is not None:
        reference_frame, _ = sensor.clock.reference
    has_reference_frame = False
    seen_bytes = 0
    for batch in batches:
        for frames in batch:
            seen_bytes += int(frames.sizes.sum())
            for name in missing:
                rows = _find_rows(frames, name)
                if len(rows):
                    first.state[name] = frames.data(int(rows[0]))
            missing -= set(first.state)
            if reference_frame is not None:
                rows = _find_rows(frames, reference_frame)
                if len(rows):
                    has_reference_frame = True
                    first.reference = _find_reference(sensor, reference_frame, frames, rows)
            if first.reference is not None:
                reference_frame = None
        if not has_reference_frame and seen_bytes > REFERENCE_SEARCH_BYTES:
            reference_frame = None
        if not missing and reference_frame is None:
            break
    return first


def _find_rows(frames: Frames, name: str) -> NDArray[np.intp]:
    """Return the indices of the frames of a type, (n,)."""
    if name not in frames.names:
        return np.zeros(0, np.intp)
    return np.flatnonzero(frames.kinds == frames.names.index(name))


def _find_reference(
    sensor: Sensor, name: str, frames: Frames, rows: NDArray[np.intp]
) -> ClockReference | None:
    """Return the first valid date in some frames; None if there is no valid date."""
    assert sensor.clock is not None
    table = get_codec(sensor.frames[name]).table([frames.data(int(row)) for row in rows])
    try:
        reported_s = reported_seconds(sensor.clock, table)
        readings_ns = reference_readings(sensor, table)
    except Exception:
        return None  # reported when the packets are decoded
    finite = np.flatnonzero(np.isfinite(reported_s))
    if not len(finite):
        return None
    first = finite.item(0)
    host_ns = max(frames.at.item(rows.item(first)), 0)  # -1 in `frames.at` if unknown
    return ClockReference(
        reading_ns=readings_ns.item(first), reported_s=reported_s.item(first), host_ns=host_ns
    )
