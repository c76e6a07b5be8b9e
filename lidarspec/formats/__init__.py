"""File formats of scans, by the suffix of the file.

In: scans. Out: a file, which appears under its name only when it is whole. `write` is all that is asked for; `formats` knows the plugins'
formats, too. Modules in reading order:

* `text`: .csv, a row a point.
* `arrays`: .npz, an array a column.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from lidarspec.errors import LidarSpecError, SpecError, UnknownFormat, system_errors
from lidarspec.formats.arrays import NPZ
from lidarspec.formats.text import CSV, write_columns
from lidarspec.packets.imu import ImuSamples
from lidarspec.plugins import registry
from lidarspec.scans.scans import Scan
from lidarspec.transports.protocol import Format

BUILT_IN = {known.suffix: known for known in (CSV, NPZ)}


def formats() -> dict[str, Format]:
    """Every format by suffix, those of plugins too; lidarspec's own come first.

    Raises:
        SpecError: where a plugin's hook fails.
    """
    try:
        added = [found for plugin in registry().call("lidarspec_formats") for found in plugin]
    except LidarSpecError:
        raise
    except Exception as error:
        raise SpecError(f"{type(error).__name__}: {error}", path="lidarspec_formats") from error
    return {**{found.suffix: found for found in added}, **BUILT_IN}


def format_of(path: str | Path) -> Format:
    """The format that a file name asks for by its suffix; plugins are asked only where it is not one of our own.

    Raises:
        UnknownFormat: with a suggestion.
    """
    suffix = Path(path).suffix.lower()
    if suffix in BUILT_IN:
        return BUILT_IN[suffix]
    known = formats()
    if suffix not in known:
        raise UnknownFormat(suffix or str(path), known, place=str(path))
    return known[suffix]


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside another one to write to, which takes its place when the block ends, and is gone if that fails.

    Raises:
        SourceError: where the file cannot be written.
    """
    part = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        with system_errors(path):
            part.unlink(missing_ok=True)
            yield part
            os.replace(part, path)
    finally:
        with contextlib.suppress(OSError):
            part.unlink()


def write_imu(path: str | Path, samples: ImuSamples) -> None:
    """Write what an IMU felt to a .csv or .npz file: time_ns, and six columns in rad/s and m/s2.

    Raises:
        UnknownFormat: for another suffix.
        SourceError: where the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in BUILT_IN:
        raise UnknownFormat(path.suffix or str(path), BUILT_IN, place=str(path))
    with replacing(path) as part:
        if path.suffix.lower() == CSV.suffix:
            write_columns(part, samples.columns)
        else:
            np.savez(part, **samples.columns)  # type: ignore[arg-type]  # no column is called allow_pickle


def write(path: str | Path, scans: Iterable[Scan], *, every_point: bool = False) -> None:
    """Write scans to a file in the format of its suffix.

    Args:
        path: the file; what it held is replaced once the new content is whole, and stays if that fails.
        every_point: also the points without a valid return.

    Raises:
        UnknownFormat: for a suffix that is none.
        SourceError: where the file cannot be written.
    """
    path = Path(path)
    chosen = format_of(path)
    with replacing(path) as part:
        chosen(part, scans, every_point=every_point)
