"""The time that each packet takes by the sensor's clock, as the spec declares it (`Clock.pace`).

Without a declared pace nothing is known about lost packets from the clock: a rate is never
estimated from the stream, since a stream with regular losses has a regular rate, too.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.expressions.columns import Batch
from lidarspec.expressions.graph import header_function
from lidarspec.spec.timing import Clock

Paces = NDArray[np.float64]


def read_paces(clock: Clock, batch: Batch) -> Paces:
    """Return the nanoseconds that each packet takes, (n,); nan if they are not declared.

    Packets with one common pace share a zero-stride array.
    """
    if clock.pace is None:
        return np.broadcast_to(np.nan, (len(batch),))
    (seconds,) = header_function(clock.pace, batch.table.schema, _seconds)(batch)
    paces = np.where(seconds > 0, seconds * 1e9, np.nan)
    if (paces == paces[0]).all():
        paces = paces[:1]
    return np.broadcast_to(paces, (len(batch),))


def shortest_pace(paces: Paces) -> float:
    """Return the shortest of some paces, ns; inf if none is known."""
    if paces.strides == (0,):
        paces = paces[:1]
    return float(np.fmin.reduce(paces, initial=math.inf))


def _seconds(values: Any, count: int) -> NDArray[np.float64]:
    return np.broadcast_to(np.asarray(values, np.float64).reshape(-1), (count,))
