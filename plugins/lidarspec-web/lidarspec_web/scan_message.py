"""A scan as the message that a page draws: a header in JSON, then the columns of its points as they
are in memory.

A message is the length of its header, 4 bytes, little-endian; the header, with spaces up to the
next multiple of 8 bytes of the message; and each column that the header names, with zeros up to the
next one. So a page lays its typed arrays over the bytes that it received.
"""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec import PointCloud, Scan
from lidarspec.points.cloud import source_of
from lidarspec.points.conventions import UNITS

#: what begins in a message begins at a multiple of so many bytes.
ALIGNED = 8
_LENGTH = struct.Struct("<I")
#: the columns that are sent, the last two where a sensor has them.
COLUMNS = ("x", "y", "z", "range", "intensity", "ring")
#: the golden section: the fractions of its multiples are even over every stretch, and in step with
#: nothing that a sensor repeats.
_SECTION = (math.sqrt(5) - 1) / 2


def message(scan: Scan, number: int, *, position: float, sent: float, most: int) -> bytes:
    """A scan as a message, without the points that have no return.

    Args:
        number: of the scan, by which the page asks for what it is made of.
        position: of its first point, seconds since the first packet of the source.
        sent: when its last packet arrived, seconds since 1970 by this computer's clock.
        most: points at most; of more of them the message has an even choice, the same for the same
            points.
    """
    source_of(scan.points).prepare((*COLUMNS, "valid"))
    returns = np.flatnonzero(scan.points.valid)
    indices = returns if len(returns) <= most else thinned(returns, most)
    columns = _columns(scan.points, indices)
    header = {
        "scan": number,
        "position": position,
        "sent": sent,
        "points": len(indices),
        "of": len(returns),
        "whole": scan.whole,
        "rate_hz": scan.rate_hz if math.isfinite(scan.rate_hz) else None,
        "nominal": bool(scan.points.nominal),
        "columns": [
            {"name": name, "type": column.dtype.str[1:], "unit": UNITS.get(name, "")}
            for name, column in columns.items()
        ],
    }
    text = json.dumps(header).encode()
    text += b" " * (-(_LENGTH.size + len(text)) % ALIGNED)
    parts: list[Any] = [_LENGTH.pack(len(text)), text]
    for column in columns.values():
        parts += [column, bytes(-column.nbytes % ALIGNED)]
    return b"".join(parts)


def thinned(indices: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """An even choice of at most so many of some indices, in their order."""
    kept = np.arange(len(indices)) * _SECTION % 1 < most / len(indices)
    return indices[kept][:most]


def _columns(cloud: PointCloud, indices: NDArray[np.intp]) -> dict[str, NDArray[Any]]:
    """The columns of some points by name, little-endian, and the points' numbers among them."""
    columns = {
        name: column[indices] for name in COLUMNS if (column := getattr(cloud, name)) is not None
    }
    columns["index"] = indices.astype(np.uint32)
    return {
        name: column.astype(column.dtype.newbyteorder("<"), copy=False)
        for name, column in columns.items()
    }
