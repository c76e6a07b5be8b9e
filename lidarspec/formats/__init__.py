"""File formats of scans, by the suffix of the file.

`write` writes the points of scans to a file. Modules in reading order:

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
* `rerun`: .rrd, for the Rerun viewer.
* `frame_tables`: has a `write_frames` of its own, which writes frames of any type instead of scans,
  one row per frame, to .csv, .parquet, .arrow, .feather and .mcap.
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

#: For each placeholder in a path, the characters of a scan's stamp (as ISO text) that replace it.
TIME_PLACEHOLDERS = {
    "%F": slice(10),
    "%H": slice(11, 13),
    "%M": slice(14, 16),
    "%S": slice(17, 19),
}
#: Matches a placeholder in a path, for the time or the number of a scan.
PLACEHOLDER = re.compile(rf"%0?\d?d|{'|'.join(TIME_PLACEHOLDERS)}")
ARRAYS = (CSV, CSV_GZ, XYZ, NPZ, NPY, ZARR)
TABLES = (PARQUET, ARROW, FEATHER)
CLOUDS = (PCD, LZF_PCD, PLY, KITTI, LAS, LAZ, E57)
BAGS = (MCAP, FOXGLOVE, BAG, ROSBAG2, DB3, RERUN)
BUILT_IN = {format.suffix: format for format in (*ARRAYS, *TABLES, *CLOUDS, *BAGS)}


def formats() -> dict[str, Format]:
    """Return every format by suffix, including the formats of plugins.

    A built-in format takes precedence over a plugin's format with the same suffix.

    Raises:
        SpecError: if a plugin's hook fails.
    """
    try:
        added = [format for formats in registry().call("lidarspec_formats") for format in formats]
    except LidarSpecError:
        raise
    except Exception as error:
        raise SpecError(f"{type(error).__name__}: {error}", path="lidarspec_formats") from error
    return {**{format.suffix: format for format in added}, **BUILT_IN}


def format_of(path: str | Path) -> Format:
    """Return the format of a file name.

    Raises:
        UnknownFormat: if no format has the suffix.
    """
    return (
        _find_by_suffix(path, BUILT_IN)
        or _find_by_suffix(path, formats_by_suffix := formats())
        or _raise_unknown_format(path, formats_by_suffix)
    )


def _find_by_suffix(path: str | Path, formats_by_suffix: Mapping[str, Format]) -> Format | None:
    """Return the format with the longest suffix that a file name has; else None."""
    name = Path(path).name.lower()
    return max(
        (format for suffix, format in formats_by_suffix.items() if name.endswith(suffix)),
        key=lambda format: len(format.suffix),
        default=None,
    )


def _raise_unknown_format(path: str | Path, formats_by_suffix: Mapping[str, Format]) -> NoReturn:
    raise UnknownFormat(Path(path).suffix or str(path), formats_by_suffix, place=str(path))


def write_imu(path: str | Path, samples: ImuSamples) -> None:
    """Write IMU samples to a .csv or .npz file.

    The columns are time_ns, three angular velocities in rad/s and three accelerations in m/s2.

    Raises:
        UnknownFormat: for any other suffix.
        SourceError: if the file cannot be written.
    """
    path = Path(path)
    formats_by_suffix = {format.suffix: format for format in (CSV, NPZ)}
    chosen = _find_by_suffix(path, formats_by_suffix) or _raise_unknown_format(
        path, formats_by_suffix
    )
    with replace_file(path) as part:
        if chosen is CSV:
            write_columns(part, samples.columns)
        else:
            np.savez(part, **samples.columns)  # type: ignore[arg-type]  # no column is called allow_pickle


def find_replaceable_files(path: str | Path) -> list[str]:
    """Return the paths of the files that `write(path)` may replace.

    If the path has placeholders, these are the existing files with such names. Otherwise, it is the
    path itself, even if there is no such file.
    """
    path = Path(path)
    if not PLACEHOLDER.search(str(path)):
        return [str(path)]
    fixed = list(itertools.takewhile(lambda part: not PLACEHOLDER.search(part), path.parts[:-1]))
    named = re.compile(r" *[-\d]+".join(map(re.escape, PLACEHOLDER.split(str(path)))))
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
    """Write scans to one or several files in the format of the suffix.

    Args:
        path: the file. An existing file is replaced when the new file is complete, and kept if
            writing fails. The path may have placeholders, which are filled for each scan.
            Consecutive scans with the same path share a file. Missing folders are made. In
            "scans/%05d.pcd", %05d is the number of the scan, from 0, so each scan has a file. In
            "drive/date=%F/hour=%H/%M.parquet", %F, %H and %M are the date, hour and minute of the
            scan's stamp in UTC, so each minute has a file. %S is the second.
        scans: the scans.
        every_point: whether to write points without a valid return as well.
        organized: whether to write every point of a scan in rows and columns, with nan for missing
            points; implies `every_point`.
        packets: raw packets to write to a ROS log in addition to the points.

    Raises:
        UnknownFormat: for an unknown suffix.
        UsageError: if two files would have the same name; if `organized` is not possible for the
            format, the sensor or the number of scans; or if the format cannot store `packets`.
        SourceError: if the file cannot be written.
    """
    path = Path(path)
    chosen = format_of(path)
    packet_argument = {} if packets is None else {"packets": packets}
    if packet_argument:
        require_feature(path, "packets")
        if PLACEHOLDER.search(str(path)):
            raise UsageError(
                f"{path}: packets require a single output file, so omit placeholders such as %05d"
            )
    if organized:
        require_feature(path, "organized")
        has_one_scan = "scans" not in chosen.holds
        scans = _iter_organized(
            path, scans, is_single=has_one_scan and not PLACEHOLDER.search(str(path))
        )
        every_point = True
        if has_one_scan:
            chosen = dataclasses.replace(chosen, write=partial(chosen.write, organized=True))
    if PLACEHOLDER.search(str(path)):
        files: Iterable[tuple[Path, Iterable[Scan]]] = _iter_files(path, scans)
    else:
        files = [(path, scans)]
    for target, file_scans in files:
        with replace_file(target) as part:
            chosen.write(part, file_scans, every_point=every_point, **packet_argument)


def require_feature(path: str | Path, feature: str) -> None:
    """Raise UsageError if the format of a path does not support a feature.

    Args:
        feature: a name in `Format.holds`.
    """
    if feature not in format_of(path).holds:
        having = ", ".join(
            suffix for suffix, format in formats().items() if feature in format.holds
        )
        raise UsageError(
            f"{path}: {format_of(path).suffix} does not support --{feature}; these formats do:"
            f" {having}"
        )


def _iter_organized(path: Path, scans: Iterable[Scan], *, is_single: bool) -> Iterator[Scan]:
    """Yield scans, and raise an error if they are not organized.

    Args:
        is_single: whether only one scan is allowed.
    """
    for number, scan in enumerate(scans):
        if scan.points.shape is None:
            raise UsageError(
                f"the points of {scan.sensor.id} are not in rows and columns: omit --organized"
            )
        if number and is_single:
            error = UsageError(
                f"with --organized, {path} can contain only one scan, but several are selected"
            )
            raise suggest(
                error,
                "repeat with --scans 1:2, or with a file for each scan:"
                f" {path.with_suffix('')}-%05d{path.suffix}",
            )
        yield scan


def _iter_files(path: Path, scans: Iterable[Scan]) -> Iterator[tuple[Path, Iterator[Scan]]]:
    """Yield the path and the scans of each file."""
    started = set[str]()
    for name, group in itertools.groupby(
        enumerate(scans), lambda numbered: _fill_path(str(path), *numbered)
    ):
        if name in started:
            raise UsageError(
                f"{name} would be written twice, because scans of different times have this name:"
                " use %F, %H, %M and %S in the name"
            )
        started.add(name)
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
    """Return a path with the number and time of a scan in place of the placeholders."""
    stamp = str(np.datetime64(scan.stamp_ns, "ns"))

    def fill(placeholder: re.Match[str]) -> str:
        if placeholder[0] in TIME_PLACEHOLDERS:
            return stamp[TIME_PLACEHOLDERS[placeholder[0]]]
        return placeholder[0] % number

    return PLACEHOLDER.sub(fill, path)
