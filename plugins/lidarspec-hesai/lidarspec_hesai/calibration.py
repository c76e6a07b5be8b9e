"""The angles and firing times of each channel: a nominal table, or the files of one unit.

Source: HesaiLidar_SDK_2.0, correction/angle_correction and correction/firetime_correction.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarspec import UsageError
from lidarspec.spec import Learned, Points, Sensor

Table = NDArray[np.float64]

#: bytes of a correction file at most; characters of it that a message repeats.
LARGEST = 1_000_000
QUOTED = 60
#: what stands above the headings of some files, and below the table.
MARK = "EEFF"
HASH = re.compile(r"[0-9a-fA-F]{8,}")
#: how many times as far as the model's own values those of a unit may spread, or how little:
#: radians do 57 times less than degrees.
UNLIKE = 10


@dataclass(frozen=True)
class Column:
    """What a file says of each channel.

    Attributes:
        name: in words.
        headings: its letters, in small ones and without what stands in parentheses.
        low, high: between which values are.
        units: spellings of the one that they are in, which may stand in parentheses.
    """

    name: str
    headings: tuple[str, ...]
    low: float
    high: float
    units: tuple[str, ...]


CHANNEL = Column("channel", ("channel", "laserid", "laser"), 0, 1 << 16, ("numbers",))
ELEVATION = Column("elevation", ("elevation",), -90, 90, ("degrees", "degree", "deg", "°"))
AZIMUTH = Column("azimuth", ("azimuth",), -360, 360, ELEVATION.units)
FIRING = Column(
    "fire time", ("firetime", "firingtime"), -10_000, 10_000, ("microseconds", "us", "µs", "μs")
)


@dataclass(frozen=True, eq=False)
class Calibration:
    """What each channel adds to its block.

    Attributes:
        elevation, azimuth: (channels,) degrees; azimuth clockwise, as the vendor counts it.
        firing: (channels,) seconds after the time of the block.
        nominal: whether the angles are the model's, not the unit's.
    """

    elevation: Table
    azimuth: Table
    firing: Table
    nominal: bool = True

    def __len__(self) -> int:
        return len(self.elevation)

    def with_file(self, path: str | Path | Learned) -> Calibration:
        """With the angles of one unit, out of a correction file or out of what it said.

        Raises:
            UsageError: for a file that cannot be read, or is none of this model; with its place.
        """
        elevation, azimuth = columns(path, {ELEVATION: self.elevation, AZIMUTH: self.azimuth})
        return dataclasses.replace(self, elevation=elevation, azimuth=azimuth, nominal=False)

    def to_file(self) -> bytes:
        """Return the angles as a unit says them: a file of corrections."""
        rows = zip(self.elevation, self.azimuth, strict=True)
        return "".join(
            [
                "Laser id,Elevation,Azimuth\n",
                *(f"{i},{e:.6f},{a:.6f}\n" for i, (e, a) in enumerate(rows, start=1)),
            ]
        ).encode()


def nominal(
    elevation: Iterable[float], azimuth: Iterable[float], firing_us: Iterable[float]
) -> Calibration:
    """Return the table of a model; firing times in microseconds."""
    return Calibration(
        np.array(list(elevation)), np.array(list(azimuth)), np.array(list(firing_us)) * 1e-6
    )


def configure(
    points: Callable[..., Points],
    table: Calibration,
    sensor: Sensor,
    /,
    *,
    calibration: str | Path | Learned | None = None,
    firing_times: str | Path | None = None,
) -> Sensor:
    """The sensor with a unit's own tables in place of the model's; a file named in an earlier
    `configure` stays.

    A unit whose angles stand in a file is not asked for them.

    Args:
        points: the model's function of `Fields` and the channels' `Calibration`.
        table: the model's channels.
        calibration: CSV with the headings Channel (or Laser id), Elevation and Azimuth, in degrees,
            in any order, or the binary file of a model that has one; or what the unit said.
        firing_times: CSV with the headings Channel and Fire time, in microseconds.

    Raises:
        UsageError: for a file that cannot be read, or is none of this model; with line and column.
    """
    angles = calibration or sensor.options.get("calibration")
    times = firing_times or sensor.options.get("firing_times")
    if angles:
        table = table.with_file(angles)
    if times:
        table = dataclasses.replace(
            table, firing=columns(times, {FIRING: table.firing * 1e6})[0] * 1e-6
        )
    asked = () if angles and not isinstance(angles, Learned) else sensor.on_open
    return dataclasses.replace(sensor, points=partial(points, channels=table), on_open=asked)


def columns(path: str | Path | Learned, wanted: Mapping[Column, Table]) -> list[Table]:
    """Columns of a correction file by their headings, each (channels,), in the order of the
    channels.

    The mark EEFF above the headings and the hash below the table are passed over, as the vendor's
    reader does.

    Args:
        wanted: the model's own values of each column, which those of a unit are of a kind with.

    Raises:
        UsageError: with line and column, where the file cannot be read, or does not hold these
            columns for every channel of the model once.
    """
    (line, headings), *rows = _rows(path)
    places = [_place(path, line, headings, column) for column in (CHANNEL, *wanted)]
    channels = len(next(iter(wanted.values())))
    listed: dict[int, tuple[int, list[float]]] = {}
    for line, cells in rows:
        channel, *values = (
            _value(path, line, cells, place, column)
            for place, column in zip(places, (CHANNEL, *wanted), strict=True)
        )
        if channel != int(channel) or not 1 <= channel <= channels:
            raise _fault(
                path,
                line,
                places[0],
                f"channel {channel:g} is out of range: this model has channels 1 to {channels}",
            )
        if channel in listed:
            raise _fault(
                path,
                line,
                places[0],
                f"channel {channel:g} is already in line {listed[int(channel)][0]}",
            )
        listed[int(channel)] = line, values
    if missing := [channel for channel in range(1, channels + 1) if channel not in listed]:
        raise UsageError(
            f"{path!s}: contains {len(listed)} channels, expected 1 to {channels}; channel"
            f" {missing[0]} is the first missing one"
        )
    tables = list(np.array([listed[channel][1] for channel in sorted(listed)]).T)
    for (column, own), table, place in zip(wanted.items(), tables, places[1:], strict=True):
        _compare(path, rows[0][0], place, column, table, own)
    return tables


def _rows(path: str | Path | Learned) -> list[tuple[int, list[str]]]:
    """Return the headings and the table, each row with its line."""
    try:
        reader = csv.reader(io.StringIO(content(path).decode("utf-8-sig", "replace"), newline=""))
        rows = [
            (reader.line_num, [cell.strip() for cell in cells])
            for cells in reader
            if any(map(str.strip, cells))
        ]
    except csv.Error as error:
        raise UsageError(f"{path!s}: not a correction file: {error}") from error
    rows = rows[1:] if rows and rows[0][1][0] == MARK else rows
    if not rows:
        raise UsageError(f"{path!s}: not a correction file: it is empty")
    return rows[:-1] if len(rows) > 1 and HASH.fullmatch(",".join(rows[-1][1])) else rows


def content(path: str | Path | Learned) -> bytes:
    """What the unit said, or stands in a file.

    Raises:
        UsageError: for a file that cannot be read, or is longer than one can be.
    """
    if isinstance(path, Learned):
        return path
    try:
        with open(path, "rb") as file:
            data = file.read(LARGEST + 1)
    except OSError as error:
        raise UsageError(f"{path!s}: not a correction file: {error}") from error
    if len(data) > LARGEST:
        raise UsageError(
            f"{path!s}: not a correction file: it is larger than {LARGEST // 1_000_000} MB"
        )
    return data


def _place(path: str | Path | Learned, line: int, headings: list[str], column: Column) -> int:
    """Where a column stands, from 0."""
    for place, heading in enumerate(headings):
        name, _, unit = heading.lower().partition("(")
        if re.sub(r"[^a-z]", "", name) in column.headings:
            if unit.strip(" )") not in ("", *column.units):
                raise _fault(path, line, place, f"{heading!r} must be in {column.units[0]}")
            return place
    raise UsageError(
        f"{path!s}: line {line}: no column is named {column.name!r}; the names are"
        f" {', '.join(headings)[:QUOTED]!r}"
    )


def _value(
    path: str | Path | Learned, line: int, cells: list[str], place: int, column: Column
) -> float:
    text = cells[place] if place < len(cells) else ""
    try:
        value = float(text)
    except ValueError:
        raise _fault(
            path, line, place, f"{column.name} must be a number, got {text[:QUOTED]!r}"
        ) from None
    if not column.low <= value <= column.high:  # nor nan
        raise _fault(
            path,
            line,
            place,
            f"{column.name} {value:g} is outside {column.low:g} .. {column.high:g}"
            f" {column.units[0]}",
        )
    return value


def _compare(
    path: str | Path | Learned, line: int, place: int, column: Column, table: Table, own: Table
) -> None:
    """Nothing, where the values spread like the model's own, to a factor of ten, or those spread
    too little to tell by.
    """
    spread = float(np.ptp(table))
    usual = float(np.ptp(own))
    if usual > 1 and not usual / UNLIKE < spread < usual * UNLIKE:
        told = f"have a spread of {spread:g}" if spread else f"are all {table[0]:g}"
        raise _fault(
            path,
            line,
            place,
            f"the {column.name}s {told}, but those of this model have a spread of {usual:g}"
            f" {column.units[0]}: does the file belong to another unit?",
        )


def _fault(path: str | Path | Learned, line: int, place: int, reason: str) -> UsageError:
    return UsageError(f"{path!s}: line {line}, column {place + 1}: {reason}")
