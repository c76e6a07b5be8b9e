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
from lidarspec.formats.common import GPS_EPOCH, select_columns, write_in_thread
from lidarspec.optional_libraries import import_library
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: columns with a standard field in LAS, and columns that become extra dimensions.
PLACED = ("x", "y", "z", "intensity", "time", "return_index", "valid")
EXTRA = ("ring", "column")
#: types that extra dimensions do not support, and their replacements.
WIDER = {"f2": np.dtype(np.float32), "b1": np.dtype(np.uint8)}
#: size of a coordinate step in metres, and the distance in metres up to which the offset is 0.
STEP = 1e-4
NEAR = 1e5
#: ns since 1970 of the origin of adjusted standard GPS time.
EPOCH = GPS_EPOCH + 10**18
#: points per write; the largest step, intensity and return number; and the withheld flag.
ROWS = 1 << 17
FARTHEST = (1 << 31) - 1
BRIGHTEST = 0xFFFF
LAST = 15
WITHHELD = 1 << 2


def _write(path: Path, scans: Iterable[Scan], *, every_point: bool, is_compressed: bool) -> None:
    """Write coordinates, intensity, return and GPS time, and extra dimensions.

    Ring, column, the number of the scan and the additional columns are extra dimensions.
    `intensity` is the raw value, rounded, at most 65535. The stamp is taken as a time since 1970,
    and written as adjusted standard GPS time with 18 leap seconds, exact to 0.1 microseconds.
    `number_of_returns` is the maximum of the scan. The unit of an additional column is its
    description; "_" is appended to a name that LAS already uses. With `every_point`, a point
    without a return is withheld and at the file's offset, 0, because there is no nan. If a later
    scan lacks a column, its values are nan, or 0. Range and angles are omitted: they follow from
    the coordinates.

    Raises:
        UsageError: if coordinates are farther apart than 32-bit numbers reach, 214 km.
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
                scan, (*PLACED, *EXTRA, *scan.points.extra), every_point=every_point
            )
            own["scan"] = np.full(len(own["x"]), number, np.uint32)
            if writer is None:
                further = _describe(laspy, header, own, scan)
                buffers = itertools.cycle(
                    np.zeros((2, ROWS), header.point_format.dtype())
                )  # one is filled while the other is written
                writer = files.enter_context(opened())
                write = files.enter_context(write_in_thread(writer.write_points))
            own["returns"] = _returns(own)
            own["time"] = own.get("time", np.zeros(len(own["x"]))) + (scan.stamp_ns - EPOCH) * 1e-9
            for start in range(0, len(own["x"]), ROWS):
                part = {name: column[start : start + ROWS] for name, column in own.items()}
                _fill(record := next(buffers)[: len(part["x"])], part, further, header.offsets)
                write(laspy.PackedPointRecord(record, header.point_format))
        if writer is None:
            opened().close()


def _describe(
    laspy: Any, header: Any, own: Mapping[str, NDArray[Any]], scan: Scan
) -> dict[str, str]:
    """Add extra dimensions and facts of the first scan to a header.

    Returns:
        column -> name of its extra dimension.
    """
    taken = {*header.point_format.dimension_names, *header.point_format.dtype().names}
    further = {name: f"{name}_" if name in taken else name for name in own if name not in PLACED}
    kinds = {name: WIDER.get(own[name].dtype.str[1:], own[name].dtype) for name in further}
    units = scan.points.units
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(label, kinds[name], units.get(name, ""))
            for name, label in further.items()
        ]
    )
    header.scales = [STEP] * 3
    header.offsets = [_offset(own[axis]) for axis in "xyz"]
    header.global_encoding.wkt = True  # required for this point format
    header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.generating_software = "lidarspec"
    header.system_identifier = scan.sensor.id[:32]
    return further


def _offset(places: NDArray[Any]) -> float:
    """Return the offset of coordinates along an axis, metres.

    It is 0 near the origin. Otherwise it is the first finite coordinate, rounded to whole metres.
    """
    near = places[np.isfinite(places)][:1].round()
    if len(near) and abs(near[0]) > NEAR:
        return float(near[0])
    return 0.0


def _returns(own: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
    """Return the number of each return and the number of returns, (n,).

    The number is in the low bits, from 1, and the number of returns above it.
    """
    if "return_index" in own:
        numbers = np.minimum(own["return_index"], LAST - 1) + 1
    else:
        numbers = np.ones(len(own["x"]), np.uint8)
    returns: NDArray[np.uint8] = (numbers | numbers.max(initial=1) << 4).astype(np.uint8)
    return returns


def _fill(
    rows: NDArray[Any],
    part: Mapping[str, NDArray[Any]],
    further: Mapping[str, str],
    offsets: Iterable[float],
) -> None:
    """Fill records with points."""
    valid = part["valid"]
    for axis, offset in zip("xyz", offsets, strict=True):
        steps = np.rint(np.subtract(part[axis], offset, dtype=np.float64) * (1 / STEP))
        steps = steps if valid.all() else np.where(valid, steps, 0)
        if np.abs(steps).max() > FARTHEST:
            far = (
                f"{axis} is {np.abs(steps).max() * STEP / 1000:.0f} km from {offset:.0f} m, which"
                " exceeds LAS with steps of 0.1 mm"
            )
            raise suggest(UsageError(far), "lidarspec convert IN OUT.parquet")
        rows[axis.upper()] = steps
    rows["classification_flags"] = np.where(valid, 0, WITHHELD)
    rows["intensity"] = np.rint(np.fmin(np.fmax(part.get("intensity", 0), 0), BRIGHTEST))
    rows["bit_fields"], rows["gps_time"] = part["returns"], part["time"]
    for name, label in further.items():
        rows[label] = part.get(name, np.nan if rows.dtype[label].kind == "f" else 0)


def _write_compressed(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write a compressed file: 1/6 to 1/2 of the size, in seven times the time."""
    lazrs = import_library("lazrs", "las")
    try:
        _write(path, scans, every_point=every_point, is_compressed=True)
    except lazrs.LazrsError as error:  # it omits the text of system errors
        raise OSError(f"{error}; is the disk full?") from error


LAS = Format(".las", "LAS 1.4 (laspy)", partial(_write, is_compressed=False))
LAZ = Format(".laz", "LAS 1.4, compressed (laspy, lazrs)", _write_compressed)
