"""A scan as the binary message that a page draws.

The message is, in this order:

1. the length of the header, 4 bytes, little-endian;
2. the header, JSON, with spaces up to the next multiple of 8 bytes of the message;
3. each column that the header names, as in memory, with zeros up to the next multiple of 8 bytes.

So the page uses its typed arrays on the received bytes without a copy.
"""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec import PointCloud, Scan
from lidarspec.points.conventions import UNITS

#: Header and columns begin at a multiple of this in the message.
ALIGNMENT_BYTES = 8
#: The columns in a message; intensity and ring only if the sensor has them.
COLUMNS = ("x", "y", "z", "range", "intensity", "ring")
_HEADER_LENGTH = struct.Struct("<I")
#: The golden section: the fractional parts of its multiples are evenly distributed over every
#: interval, and have no common period with the pattern of a sensor.
_GOLDEN_SECTION = (math.sqrt(5) - 1) / 2


def make_scan_message(
    scan: Scan, number: int, *, position: float, sent: float, max_points: int
) -> bytes:
    """Return a scan as a message, without points that have no return.

    Args:
        scan: the scan.
        number: number of the scan, by which the page asks for the frame of a point.
        position: position of its first point, seconds since the first packet of the source.
        sent: arrival of its last packet, seconds since 1970 by this computer's clock.
        max_points: maximum number of points; if there are more, an even selection is sent, always
            the same.
    """
    points = scan.points
    points.load(*COLUMNS, "valid")
    returns = np.flatnonzero(points.valid)
    indices = returns
    if len(returns) > max_points:
        indices = thin_out(returns, max_points)
    columns = _take_columns(points, indices)
    header = {
        "scan": number,
        "position": position,
        "sent": sent,
        "points": len(indices),
        "of": len(returns),
        "whole": scan.whole,
        "rate_hz": scan.rate_hz if math.isfinite(scan.rate_hz) else None,
        "nominal": bool(points.nominal),
        "columns": [
            {"name": name, "type": column.dtype.str[1:], "unit": UNITS.get(name, "")}
            for name, column in columns.items()
        ],
    }
    text = json.dumps(header).encode()
    text += b" " * _padding(_HEADER_LENGTH.size + len(text))
    parts: list[Any] = [_HEADER_LENGTH.pack(len(text)), text]
    for column in columns.values():
        parts += [column, bytes(_padding(column.nbytes))]
    return b"".join(parts)


def thin_out(indices: NDArray[np.intp], max_points: int) -> NDArray[np.intp]:
    """Return an even selection of at most `max_points` indices, in their order."""
    fractions = np.arange(len(indices)) * _GOLDEN_SECTION % 1
    return indices[fractions < max_points / len(indices)][:max_points]


def _padding(size: int) -> int:
    """Return the bytes from the end of a part to the next multiple of the alignment."""
    return -size % ALIGNMENT_BYTES


def _take_columns(points: PointCloud, indices: NDArray[np.intp]) -> dict[str, NDArray[Any]]:
    """Return the columns of some points, little-endian, and their indices as `index`."""
    columns: dict[str, NDArray[Any]] = {}
    for name in COLUMNS:
        column = getattr(points, name)
        if column is not None:
            columns[name] = column[indices]
    columns["index"] = indices.astype(np.uint32)
    return {
        name: column.astype(column.dtype.newbyteorder("<"), copy=False)
        for name, column in columns.items()
    }
