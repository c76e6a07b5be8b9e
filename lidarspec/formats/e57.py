"""Write ASTM E57 files, with a header and points for each scan, with pye57."""

from __future__ import annotations

import contextlib
import uuid
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.formats.common import GPS_EPOCH_NS, select_columns
from lidarspec.optional_libraries import import_library
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: The name of each column in the standard.
FIELD_NAMES = {
    **{
        "x": "cartesianX",
        "y": "cartesianY",
        "z": "cartesianZ",
        "valid": "cartesianInvalidState",
        "intensity": "intensity",
    },
    **{
        "time": "timeStamp",
        "ring": "rowIndex",
        "column": "columnIndex",
        "return_index": "returnIndex",
    },
}
#: The limits in the header, by group: the beginning of a limit's name, and its field in the
#: standard.
LIMITS_BY_GROUP = {
    "cartesianBounds": {"x": "cartesianX", "y": "cartesianY", "z": "cartesianZ"},
    "intensityLimits": {"intensity": "intensity"},
    "indexBounds": {"row": "rowIndex", "column": "columnIndex", "return": "returnIndex"},
}
#: The standard's value for a point without valid coordinates.
INVALID_COORDINATES = 2
#: The prefix and URL of the extension that contains the additional columns.
PREFIX = "lidarspec"
EXTENSION = "urn:lidarspec:columns"
#: The replacements of types that libE57Format does not support.
REPLACED_TYPES = {
    "f2": np.float32,
    "b1": np.uint8,
    **dict.fromkeys(("i4", "u4", "i8", "u8"), np.longlong),
}


def _write(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write each scan with a header."""
    pye57 = import_library("pye57", "e57")
    libe57 = import_library("pye57.libe57", "e57")
    with contextlib.ExitStack() as files:
        try:
            file = pye57.E57(str(path), mode="w")
            files.callback(file.image_file.cancel)
            file.image_file.extensionsAdd(PREFIX, EXTENSION)
            for number, scan in enumerate(scans):
                own = select_columns(
                    scan, (*FIELD_NAMES, *scan.points.extra), every_point=every_point
                )
                _add_scan(libe57, file, _make_header(number, scan), _convert_columns(own))
            file.close()
        except libe57.E57Exception as error:  # the library omits the text of system errors
            raise OSError(f"{str(error).splitlines()[0]}; is the disk full?") from None


def _add_scan(
    libe57: Any, file: Any, header: Mapping[str, Any], columns: Mapping[str, NDArray[Any]]
) -> None:
    """Add a scan to a file."""
    image = file.image_file
    length = len(columns["cartesianX"])
    prototype = libe57.StructureNode(image)
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        prototype.set(name, _make_column_node(libe57, image, column))
        buffers.append(libe57.SourceDestBuffer(image, name, column, max(length, 1), True, True))
    points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
    scan = _make_node(libe57, image, {**header, **_find_limits(columns)})
    scan.set("points", points)
    file.data3d.append(scan)
    writer = points.writer(buffers)
    try:
        writer.write(length)
        writer.close()
    finally:
        del writer  # its destructor writes to the file, so it has to run before the file is closed


def _convert_columns(own: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the columns by their names in E57, converted to supported types."""
    invalid = ~own["valid"]
    columns = {FIELD_NAMES.get(name, f"{PREFIX}:{name}"): column for name, column in own.items()}
    columns["cartesianInvalidState"] = invalid * np.uint8(INVALID_COORDINATES)
    if invalid.any():
        columns |= {
            name: np.where(invalid, 0, columns[name])
            for name in (FIELD_NAMES[axis] for axis in "xyz")
        }
    if "returnIndex" in columns:
        columns["returnCount"] = np.full(
            len(invalid), columns["returnIndex"].max(initial=0) + 1, np.uint8
        )
    return {
        name: np.ascontiguousarray(column, REPLACED_TYPES.get(column.dtype.str[1:]))
        for name, column in columns.items()
    }


def _make_header(number: int, scan: Scan) -> dict[str, Any]:
    """Return the header of a scan as values by name."""
    units = ", ".join(f"{name} [{unit}]" for name, unit in scan.points.units.items() if unit)
    start = (scan.stamp_ns - GPS_EPOCH_NS) * 1e-9
    return {
        "guid": f"{{{uuid.uuid4()}}}",
        "name": f"scan {number}",
        "description": units,
        "sensorVendor": scan.sensor.vendor,
        "sensorModel": scan.sensor.model,
        "acquisitionStart": {"dateTimeValue": start, "isAtomicClockReferenced": 0},
        "acquisitionEnd": {
            "dateTimeValue": start + float(scan.points.time.max(initial=0)),
            "isAtomicClockReferenced": 0,
        },
    }


def _find_limits(columns: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Return the minimum and the maximum of the columns, for the header of a scan."""
    valid = columns["cartesianInvalidState"] == 0
    if not valid.any():
        return {}
    return {
        group: {
            f"{name}{end}": extreme.reduce(columns[field][valid]).item()
            for name, field in names.items()
            if field in columns
            for end, extreme in (("Minimum", np.fmin), ("Maximum", np.fmax))
        }
        for group, names in LIMITS_BY_GROUP.items()
        if columns.keys() & names.values()
    }


def _make_node(libe57: Any, image: Any, value: Any) -> Any:
    """Return the node of a header value; a mapping becomes a structure."""
    if not isinstance(value, Mapping):
        kinds = {str: libe57.StringNode, int: libe57.IntegerNode, float: libe57.FloatNode}
        return kinds[type(value)](image, value)
    structure = libe57.StructureNode(image)
    for name, part in value.items():
        structure.set(name, _make_node(libe57, image, part))
    return structure


def _make_column_node(libe57: Any, image: Any, column: NDArray[Any]) -> Any:
    """Return the node of a column."""
    if column.dtype.kind != "f":
        low, high = (int(column.min()), int(column.max())) if len(column) else (0, 0)
        return libe57.IntegerNode(image, low, low, high)
    if column.dtype == np.float64:
        return libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE)
    return libe57.FloatNode(
        image, 0.0, libe57.E57_SINGLE, libe57.E57_FLOAT_MIN, libe57.E57_FLOAT_MAX
    )


E57 = Format(".e57", "ASTM E57, one header per scan (pye57)", _write)
