"""File formats of scans, by the suffix of the file.

In: scans. Out: a file, which gets its name only when it is complete. `write` is the function
for callers. `formats` includes the formats of plugins. Modules in reading order:

* `common`: functions shared by the formats.
* `text`: .csv, .csv.gz and .xyz, one row per point.
* `arrays`: .npz, one array per column; .npy, a structured array; .zarr, a folder with one array per
  column.
* `arrow_tables`: .parquet, .arrow and .feather, for data tools.
* `point_rows`: points as rows of bytes after a header.
* `point_cloud_files`: .pcd, .lzf.pcd, .ply and KITTI's .bin.
* `las`: .las and .laz, for surveying tools.
* `e57`: .e57, with a header and points for each scan.
* `messages`: ROS messages of scans, packets and IMU samples.
* `bags`: .mcap, .bag, .rosbag2 and .db3, one message per scan.
* `foxglove`: .foxglove.mcap, with Foxglove messages.
* `frame_tables`: frames of any type, one row each, to .csv, .parquet, .arrow, .feather or .mcap.
* `rerun`: .rrd, for the Rerun viewer.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np

from lidarspec.errors import (
    LidarSpecError,
    SpecError,
    UnknownFormat,
    UsageError,
    suggest,
    system_errors,
)
from lidarspec.formats.arrays import NPY, NPZ, ZARR
from lidarspec.formats.arrow_tables import ARROW, FEATHER, PARQUET
from lidarspec.formats.bags import BAG, DB3, MCAP, ROSBAG2
from lidarspec.formats.common import replace_file
from lidarspec.formats.e57 import E57
from lidarspec.formats.foxglove import FOXGLOVE
from lidarspec.formats.las import LAS, LAZ
from lidarspec.formats.point_cloud_files import KITTI, LZF_PCD, PCD, PLY
from lidarspec.formats.rerun import RERUN
from lidarspec.formats.text import CSV, CSV_GZ, XYZ, write_columns
from lidarspec.packets.imu import ImuSamples
from lidarspec.plugins import registry
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Chunk, Format

#: placeholders of a path for date, hour, minute and second of a scan's stamp, as parts of an ISO
#: text; `PLACE` also matches the number of a scan.
MOMENT = {"%F": slice(10), "%H": slice(11, 13), "%M": slice(14, 16), "%S": slice(17, 19)}
PLACE = re.compile(rf"%0?\d?d|{'|'.join(MOMENT)}")
ARRAYS = (CSV, CSV_GZ, XYZ, NPZ, NPY, ZARR)
TABLES = (PARQUET, ARROW, FEATHER)
CLOUDS = (PCD, LZF_PCD, PLY, KITTI, LAS, LAZ, E57)
BAGS = (MCAP, FOXGLOVE, BAG, ROSBAG2, DB3, RERUN)
BUILT_IN = {known.suffix: known for known in (*ARRAYS, *TABLES, *CLOUDS, *BAGS)}


def formats() -> dict[str, Format]:
    """Return every format by suffix, including those of plugins.

    The package's own formats have priority.

    Raises:
        SpecError: if a plugin's hook fails.
    """
    try:
        added = [found for plugin in registry().call("lidarspec_formats") for found in plugin]
    except LidarSpecError:
        raise
    except Exception as error:
        raise SpecError(f"{type(error).__name__}: {error}", path="lidarspec_formats") from error
    return {**{found.suffix: found for found in added}, **BUILT_IN}


def format_of(path: str | Path) -> Format:
    """Return the format of a file name.

    Plugins are only loaded if the suffix is not one of the package's own.

    Raises:
        UnknownFormat: with a suggestion.
    """
    return (
        _find_by_suffix(path, BUILT_IN)
        or _find_by_suffix(path, formats_by_suffix := formats())
        or _unknown_format_error(path, formats_by_suffix)
    )


def _find_by_suffix(path: str | Path, formats_by_suffix: Mapping[str, Format]) -> Format | None:
    """Return the format with the longest suffix of a name, such as .csv.gz."""
    name = Path(path).name.lower()
    return max(
        (format for suffix, format in formats_by_suffix.items() if name.endswith(suffix)),
        key=lambda format: len(format.suffix),
        default=None,
    )


def _unknown_format_error(path: str | Path, formats_by_suffix: Mapping[str, Format]) -> NoReturn:
    raise UnknownFormat(Path(path).suffix or str(path), formats_by_suffix, place=str(path))


def write_imu(path: str | Path, samples: ImuSamples) -> None:
    """Write IMU samples to a .csv or .npz file.

    The columns are time_ns, and six columns in rad/s and m/s2.

    Raises:
        UnknownFormat: for another suffix.
        SourceError: if the file cannot be written.
    """
    path = Path(path)
    formats_by_suffix = {format.suffix: format for format in (CSV, NPZ)}
    chosen = _find_by_suffix(path, formats_by_suffix) or _unknown_format_error(
        path, formats_by_suffix
    )
    with replace_file(path) as part:
        if chosen is CSV:
            write_columns(part, samples.columns)
        else:
            np.savez(part, **samples.columns)  # type: ignore[arg-type]  # no column is called allow_pickle


def find_existing(path: str | Path) -> list[str]:
    """Return the existing files that `write` may replace.

    For a path without placeholders, it is that path, existing or not.
    """
    path = Path(path)
    if not PLACE.search(str(path)):
        return [str(path)]
    fixed = list(itertools.takewhile(lambda part: not PLACE.search(part), path.parts[:-1]))
    named = re.compile(r" *[-\d]+".join(map(re.escape, PLACE.split(str(path)))))
    files = Path(*fixed).glob("/".join("*" for _ in path.parts[len(fixed) :]))
    return sorted(str(file) for file in files if named.fullmatch(str(file)))


def write(
    path: str | Path,
    scans: Iterable[Scan],
    *,
    every_point: bool = False,
    organized: bool = False,
    packets: Iterable[Chunk] | None = None,
) -> None:
    """Write scans to a file in the format of its suffix, or to several.

    Args:
        path: the file. An old file is replaced when the new one is complete, and kept if writing
            fails. The path may have placeholders: consecutive scans with the same path share a
            file, and missing folders are made. "scans/%05d.pcd" has the number of the scan, from 0,
            so each scan gets a file. "drive/date=%F/hour=%H/%M.parquet" has a file for each minute
            of the stamps, in UTC; %S is the second.
        every_point: also write points without a valid return.
        organized: write every point of a scan in rows and columns, missing ones as nan. Each file
            then has one scan, unless the format stores scans separately.
        packets: the raw packets, to be written beside the points to a ROS log.

    Raises:
        UnknownFormat: for an unknown suffix.
        UsageError: if a file would be started again because its time occurs again; and if the
            format, the sensor or the number of scans does not support `organized` or `packets`.
        SourceError: if the file cannot be written.
    """
    path = Path(path)
    chosen = format_of(path)
    beside = {} if packets is None else {"packets": packets}
    if beside:
        check_holds(path, "packets")
        if PLACE.search(str(path)):
            raise UsageError(
                f"{path}: packets can be written beside the points to a single file only"
            )
    if organized:
        check_holds(path, "organized")
        is_alone = "scans" not in chosen.holds
        scans = _iter_organized(path, scans, alone=is_alone and not PLACE.search(str(path)))
        every_point = True
        if is_alone:
            chosen = dataclasses.replace(chosen, write=partial(chosen.write, organized=True))
    for target, held in _iter_files(path, scans) if PLACE.search(str(path)) else [(path, scans)]:
        with replace_file(target) as part:
            chosen.write(part, held, every_point=every_point, **beside)


def check_holds(path: str | Path, what: str) -> None:
    """Raise UsageError unless a format has a feature of `Format.holds`.

    Raises:
        UsageError: with the formats that have it.
    """
    if what not in format_of(path).holds:
        having = ", ".join(suffix for suffix, known in formats().items() if what in known.holds)
        raise UsageError(
            f"{path}: {format_of(path).suffix} does not support --{what}; formats that do: {having}"
        )


def _iter_organized(path: Path, scans: Iterable[Scan], *, alone: bool) -> Iterator[Scan]:
    """Yield scans, and check that they are organized.

    Args:
        alone: whether only one scan is allowed.
    """
    for number, scan in enumerate(scans):
        if scan.points.shape is None:
            raise UsageError(
                f"points of {scan.sensor.id} have no rows and columns: omit --organized"
            )
        if number and alone:
            error = UsageError(
                f"with --organized, {path} can hold one scan only, but several are selected"
            )
            raise suggest(
                error,
                "repeat with --scans 1:2, or with a file for each scan:"
                f" {path.with_suffix('')}-%05d{path.suffix}",
            )
        yield scan


def _iter_files(path: Path, scans: Iterable[Scan]) -> Iterator[tuple[Path, Iterator[Scan]]]:
    """Yield each file, and the scans for it."""
    begun = set[str]()
    for name, group in itertools.groupby(
        enumerate(scans), lambda numbered: _fill_path(str(path), *numbered)
    ):
        if name in begun:
            raise UsageError(
                f"{name} would be written twice, as its time repeats; use %F, %H, %M and %S in the"
                " name"
            )
        begun.add(name)
        with system_errors(path):
            Path(name).parent.mkdir(parents=True, exist_ok=True)
        yield (
            Path(name),
            (
                scan if scan.number is not None else dataclasses.replace(scan, number=number)
                for number, scan in group
            ),
        )


def _fill_path(path: str, number: int, scan: Scan) -> str:
    """Return a path with the number and time of a scan in place of the placeholders.

    Other percent signs are kept.
    """
    moment = str(np.datetime64(scan.stamp_ns, "ns"))
    return PLACE.sub(
        lambda place: moment[MOMENT[place[0]]] if place[0] in MOMENT else place[0] % number, path
    )
