"""A scan as the binary message that a page draws.

The message consists of, in this order:

1. the length of the header, 4 bytes, little-endian;
2. the header in JSON, padded with spaces so that the message so far is a multiple of 8 bytes;
3. each column that the header names, as a little-endian array, padded with zeros to a multiple of
   8 bytes.

Because of the padding, the page can use typed arrays on the received bytes without copying them.
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

#: Each column begins at a multiple of this size in the message.
ALIGNMENT_BYTES = 8
#: The columns in a message; intensity and ring only if the sensor has them.
COLUMNS = ("x", "y", "z", "range", "intensity", "ring")
_HEADER_LENGTH = struct.Struct("<I")
#: The golden section: the fractional parts of its multiples are evenly distributed over every
#: interval, and have no common period with the pattern of a sensor.
_GOLDEN_SECTION = (math.sqrt(5) - 1) / 2


def make_scan_message(
    scan: Scan, number: int, *, position: float, arrival: float, max_points: int
) -> bytes:
    """Return a scan as a message, without points that have no return.

    Args:
        number: number of the scan; the page uses it to request the frame of a point.
        position: the time of the scan, in seconds after the first scan of the source.
        arrival: the arrival time of the scan's last packet, in seconds since 1970 by this
            computer's clock. The message contains this time under the key `sent`, from which the
            page calculates how old the scan is.
        max_points: maximum number of points. If there are more points, evenly distributed points
            are selected.
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
        "sent": arrival,
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
    text += b" " * _count_padding(_HEADER_LENGTH.size + len(text))
    parts: list[Any] = [_HEADER_LENGTH.pack(len(text)), text]
    for column in columns.values():
        parts += [column, bytes(_count_padding(column.nbytes))]
    return b"".join(parts)


def thin_out(indices: NDArray[np.intp], max_points: int) -> NDArray[np.intp]:
    """Return an evenly distributed selection of at most `max_points` indices."""
    fractions = np.arange(len(indices)) * _GOLDEN_SECTION % 1
    return indices[fractions < max_points / len(indices)][:max_points]


def _count_padding(size: int) -> int:
    """Return the number of padding bytes that follow `size` bytes of the message."""
    return -size % ALIGNMENT_BYTES


def _take_columns(points: PointCloud, indices: NDArray[np.intp]) -> dict[str, NDArray[Any]]:
    """Return the little-endian columns of some points, and a column `index`."""
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
