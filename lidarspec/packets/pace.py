"""Read the declared time between each packet and the packet before (`Clock.pace`).

The pace is not estimated, because a stream with regular losses has regular steps as well.
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

#: If the clock advances by more than this from one packet to the next, it was set.
MAX_STEP_NS = 3600 * 10**9


def read_paces(clock: Clock, batch: Batch) -> Paces:
    """Return the time between each packet and the packet before, (n,) ns; nan if not declared."""
    if clock.pace is None:
        return np.broadcast_to(np.nan, (len(batch),))
    (seconds,) = header_function(clock.pace, batch.table.schema, _to_seconds)(batch)
    paces = np.where(seconds > 0, seconds * 1e9, np.nan)
    if (paces == paces[0]).all():
        paces = paces[:1]
    return np.broadcast_to(paces, (len(batch),))


def shortest_pace(paces: Paces) -> float:
    """Return the shortest of some paces, ns; inf if all are nan."""
    if paces.strides == (0,):
        paces = paces[:1]
    return float(np.fmin.reduce(paces, initial=math.inf))


def _to_seconds(values: Any, count: int) -> NDArray[np.float64]:
    return np.broadcast_to(np.asarray(values, np.float64).reshape(-1), (count,))
