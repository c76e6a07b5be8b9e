"""Read the clock status that a sensor sends (`spec.timing.ClockStatus`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Batch, Fields, load_physical
from lidarspec.frames.frame_table import Table
from lidarspec.packets.packet_type import find_clock
from lidarspec.packets.packets import Packets
from lidarspec.spec.timing import ClockStatus

Values = NDArray[np.float64]


def read_clock_status(packets: Packets) -> Values:
    """Return the clock's status at each packet, (n,); nan if it was not sent."""
    clock = find_clock(packets.sensor, packets.frame)
    unknown = np.full(len(packets), np.nan)
    if clock is None or clock.status is None:
        return unknown
    status = clock.status
    if not status.frame or status.frame == packets.frame:
        return frame_status(status, packets.table)
    table, which = packets.state.get(status.frame, (None, np.full(len(packets), -1)))
    if table is None:
        return unknown
    values = frame_status(status, table)
    return np.where(which < 0, np.nan, values[which])


def frame_status(status: ClockStatus, frames: Table) -> Values:
    """Return the clock's status in each frame, (n,); nan in frames without the field."""
    if callable(status.source):
        batch = Batch(frames, np.zeros(len(frames), np.bool_))
        column = status.source(Fields(batch))
        values = np.asarray(column, np.float64).reshape(-1)
        return np.broadcast_to(values, (len(frames),))
    info = frames.schema.columns.get(status.source)
    if info is None or info.axes:
        return np.full(len(frames), np.nan)
    return load_physical(info, frames)
