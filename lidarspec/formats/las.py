"""Write LAS and its compressed form LAZ, with laspy.

The files have version 1.4, point format 6 and GPS time, with coordinates in steps of 0.1 mm.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, suggest
from lidarspec.formats.common import GPS_EPOCH_NS, select_columns, write_in_thread
from lidarspec.optional_libraries import import_library
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: Columns for which LAS has a standard field.
STANDARD_COLUMNS = ("x", "y", "z", "intensity", "time", "return_index", "valid")
#: Columns that are written as extra dimensions.
EXTRA_COLUMNS = ("ring", "column")
#: The replacements of types that extra dimensions do not support.
REPLACED_TYPES = {"f2": np.dtype(np.float32), "b1": np.dtype(np.uint8)}
#: The size of a coordinate step, metres.
STEP_M = 1e-4
#: The maximum coordinate, metres, for which the offset of coordinates stays 0.
MAX_UNSHIFTED_M = 1e5
#: The origin of adjusted standard GPS time, in ns since 1970.
ADJUSTED_GPS_EPOCH_NS = GPS_EPOCH_NS + 10**18
#: The number of points per write.
BLOCK_POINTS = 1 << 17
MAX_STEPS = (1 << 31) - 1
MAX_INTENSITY = 0xFFFF
MAX_RETURN_NUMBER = 15
WITHHELD_FLAG = 1 << 2


def _write(path: Path, scans: Iterable[Scan], *, every_point: bool, is_compressed: bool) -> None:
    """Write a LAS or LAZ file.

    Raises:
        UsageError: if a coordinate is more than 214 km from the offset in the header.
    """
    laspy = import_library("laspy", "las")
    with contextlib.ExitStack() as files:
        header = laspy.LasHeader(point_format=6, version="1.4")
        writer = None
        opened = partial(
            laspy.open,
            files.enter_context(path.open("wb")),
            "w",
            header=header,
            do_compress=is_compressed,
            closefd=False,
        )
        for number, scan in enumerate(scans):
            own = select_columns(
                scan,
                (*STANDARD_COLUMNS, *EXTRA_COLUMNS, *scan.points.extra),
                every_point=every_point,
            )
            own["scan"] = np.full(len(own["x"]), number, np.uint32)
            if writer is None:
                extra_names = _fill_header(laspy, header, own, scan)
                # One buffer is filled while the other is written.
                buffers = itertools.cycle(np.zeros((2, BLOCK_POINTS), header.point_format.dtype()))
                writer = files.enter_context(opened())
                write = files.enter_context(write_in_thread(writer.write_points))
            own["returns"] = _pack_returns(own)
            own["time"] = (
                own.get("time", np.zeros(len(own["x"])))
                + (scan.stamp_ns - ADJUSTED_GPS_EPOCH_NS) * 1e-9
            )
            for start in range(0, len(own["x"]), BLOCK_POINTS):
                part = {name: column[start : start + BLOCK_POINTS] for name, column in own.items()}
                record = next(buffers)[: len(part["x"])]
                _fill_records(record, part, extra_names, header.offsets)
                write(laspy.PackedPointRecord(record, header.point_format))
        if writer is None:
            opened().close()


def _fill_header(
    laspy: Any, header: Any, own: Mapping[str, NDArray[Any]], scan: Scan
) -> dict[str, str]:
    """Set the extra dimensions, scales, offsets and sensor of a header, from a scan.

    Returns:
        The name of the extra dimension of each column.
    """
    taken = {*header.point_format.dimension_names, *header.point_format.dtype().names}
    extra_names = {
        name: f"{name}_" if name in taken else name for name in own if name not in STANDARD_COLUMNS
    }
    kinds = {
        name: REPLACED_TYPES.get(own[name].dtype.str[1:], own[name].dtype) for name in extra_names
    }
    units = scan.points.units
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(label, kinds[name], units.get(name, ""))
            for name, label in extra_names.items()
        ]
    )
    header.scales = [STEP_M] * 3
    header.offsets = [_choose_offset(own[axis]) for axis in "xyz"]
    header.global_encoding.wkt = True  # required for this point format
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.generating_software = "lidarspec"
    header.system_identifier = scan.sensor.id[:32]
    return extra_names


def _choose_offset(coordinates: NDArray[Any]) -> float:
    """Return the offset of the coordinates along one axis, in metres."""
    first = coordinates[np.isfinite(coordinates)][:1].round()
    if len(first) and abs(first[0]) > MAX_UNSHIFTED_M:
        return float(first[0])
    return 0.0


def _pack_returns(own: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Return the return number and number of returns of each point in a byte, (n,).

    The low four bits are the return number, from 1. The high four bits are the number of returns.
    """
    if "return_index" in own:
        numbers = np.minimum(own["return_index"], MAX_RETURN_NUMBER - 1) + 1
    else:
        numbers = np.ones(len(own["x"]), np.uint8)
    returns: NDArray[np.uint8] = (numbers | numbers.max(initial=1) << 4).astype(np.uint8)
    return returns


def _fill_records(
    rows: NDArray[Any],
    part: Mapping[str, NDArray[Any]],
    extra_names: Mapping[str, str],
    offsets: Iterable[float],
) -> None:
    """Fill LAS records with points.

    Args:
        rows: the records to fill.
        part: the columns of the points.
        extra_names: the name of the extra dimension of each column.
        offsets: the offsets of x, y and z, in metres.
    """
    valid = part["valid"]
    for axis, offset in zip("xyz", offsets, strict=True):
        steps = np.rint(np.subtract(part[axis], offset, dtype=np.float64) * (1 / STEP_M))
        steps = steps if valid.all() else np.where(valid, steps, 0)
        if np.abs(steps).max() > MAX_STEPS:
            reason = (
                f"a point is {np.abs(steps).max() * STEP_M / 1000:.0f} km from the origin of the"
                f" file ({axis} = {offset:.0f} m): LAS cannot store this distance in steps of"
                " 0.1 mm"
            )
            raise suggest(UsageError(reason), "lidarspec convert IN OUT.parquet")
        rows[axis.upper()] = steps
    rows["classification_flags"] = np.where(valid, 0, WITHHELD_FLAG)
    rows["intensity"] = np.rint(np.fmin(np.fmax(part.get("intensity", 0), 0), MAX_INTENSITY))
    rows["bit_fields"] = part["returns"]
    rows["gps_time"] = part["time"]
    for name, label in extra_names.items():
        rows[label] = part.get(name, np.nan if rows.dtype[label].kind == "f" else 0)


def _write_compressed(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write a LAZ file, which is a compressed LAS file."""
    lazrs = import_library("lazrs", "las")
    try:
        _write(path, scans, every_point=every_point, is_compressed=True)
    except lazrs.LazrsError as error:  # the library omits the text of system errors
        raise OSError(f"{error}; is the disk full?") from error


LAS = Format(".las", "LAS 1.4 (laspy)", partial(_write, is_compressed=False))
LAZ = Format(".laz", "LAS 1.4, compressed (laspy, lazrs)", _write_compressed)
