"""Read scans from messages, as a page does."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np


def parse_message(message: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header of a message, and its columns."""
    (length,) = struct.unpack_from("<I", message)
    header, place = json.loads(message[4 : 4 + length]), 4 + length
    columns = {}
    for column in header["columns"]:
        assert place % 8 == 0
        columns[column["name"]] = np.frombuffer(
            message, "<" + column["type"], header["points"], place
        )
        place += columns[column["name"]].nbytes + -columns[column["name"]].nbytes % 8
    assert place == len(message)
    return header, columns
