"""The types of tables of points: PCL's structured layout and the schema of Arrow."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.optional_libraries import import_library

#: The fields x y z intensity ring time at PCL's offsets.
STRUCTURED = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 16, 20, 24],
        "itemsize": 32,
    }
)
#: The size of a structured point in bytes is a multiple of this.
ALIGNMENT_BYTES = 16


def structured_type(extra: Mapping[str, np.dtype[Any]]) -> np.dtype[Any]:
    """Return the dtype of PCL's layout, followed by further columns aligned to their size."""
    formats = {name: place[:2] for name, place in (STRUCTURED.fields or {}).items()}
    end = STRUCTURED.itemsize
    for name, dtype in extra.items():
        start = end + -end % dtype.itemsize
        end = start + dtype.itemsize
        formats[name] = (dtype.newbyteorder("<"), start)
    return np.dtype(
        {
            "names": list(formats),
            "formats": [dtype for dtype, _ in formats.values()],
            "offsets": [offset for _, offset in formats.values()],
            "itemsize": end + -end % ALIGNMENT_BYTES,
        }
    )


def arrow_schema(
    columns: Mapping[str, NDArray[Any]], units: Mapping[str, str], facts: Mapping[str, str]
) -> Any:
    """Return the `pyarrow.Schema` of some columns of points.

    Args:
        units: the unit of each column by name, without columns of plain numbers.
        facts: further metadata of the schema.

    Raises:
        UsageError: if pyarrow is not installed.
    """
    # Float columns are not nullable, because this is faster to write. A missing value is nan.
    arrow = import_library("pyarrow", "arrow")
    fields = [
        arrow.field(
            name,
            arrow.from_numpy_dtype(column.dtype),
            column.dtype.kind != "f",
            {"unit": units.get(name, "")},
        )
        for name, column in columns.items()
    ]
    return arrow.schema(fields, {**facts, "units": json.dumps(units)})
