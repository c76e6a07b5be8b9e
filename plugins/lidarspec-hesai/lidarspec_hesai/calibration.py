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

MAX_FILE_BYTES = 1_000_000
MAX_QUOTED_CHARACTERS = 60  # of a file, in an error message
MARK = "EEFF"  # above the headings of some files
HASH = re.compile(r"[0-9a-fA-F]{8,}")  # below the table of some files
#: The spread of the values of an individual sensor may differ from that of the model by at most
#: this factor. A file in radians instead of degrees would differ by a factor of 57.
MAX_SPREAD_RATIO = 10


@dataclass(frozen=True)
class Column:
    """A column of a correction file.

    Attributes:
        name: the name of the column in messages.
        headings: the accepted headings, in lower case and without parentheses.
        units: the accepted spellings of the unit, which may follow the heading in parentheses.
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
    """The corrections of each channel.

    Attributes:
        elevation: (channels,) degrees.
        azimuth: (channels,) degrees, clockwise as in the vendor's files.
        firing: (channels,) seconds after the time of the block.
        nominal: whether the angles are those of the model, not those of the individual sensor.
    """

    elevation: Table
    azimuth: Table
    firing: Table
    nominal: bool = True

    def __len__(self) -> int:
        return len(self.elevation)

    def with_file(self, source: str | Path | Learned) -> Calibration:
        """Return a copy with the angles of one unit.

        Args:
            source: the path of the sensor's correction file, or the sensor's reply to the command
                `get_calibration`.

        Raises:
            UsageError: if the file cannot be read, or belongs to another model. The error has the
                line and column.
        """
        elevation, azimuth = read_columns(
            source, {ELEVATION: self.elevation, AZIMUTH: self.azimuth}
        )
        return dataclasses.replace(self, elevation=elevation, azimuth=azimuth, nominal=False)

    def to_file(self) -> bytes:
        """Return the angles as a correction file (CSV)."""
        rows = zip(self.elevation, self.azimuth, strict=True)
        return "".join(
            [
                "Laser id,Elevation,Azimuth\n",
                *(f"{i},{e:.6f},{a:.6f}\n" for i, (e, a) in enumerate(rows, start=1)),
            ]
        ).encode()


def make_nominal_table(
    elevation: Iterable[float], azimuth: Iterable[float], firing_us: Iterable[float]
) -> Calibration:
    """Return the table of a model, given firing times in microseconds."""
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
    """Return the sensor with the tables of an individual sensor instead of the model's.

    If the angles are read from a file, opening the sensor does not request the angles.

    Args:
        points: a function that returns points, given `Fields` and the sensor's `Calibration`.
        table: the nominal corrections of the model.
        calibration: a CSV file with the columns Channel (or Laser id), Elevation and Azimuth, in
            degrees and in any order; or a binary file, if the model has one; or the sensor's reply
            to the command `get_calibration`.
        firing_times: a CSV file with the columns Channel and Fire time, in microseconds.

    Raises:
        UsageError: if a file cannot be read, or belongs to another model. The error has the line
            and column.
    """
    angles = calibration or sensor.options.get("calibration")
    times = firing_times or sensor.options.get("firing_times")
    if angles:
        table = table.with_file(angles)
    if times:
        table = dataclasses.replace(
            table, firing=read_columns(times, {FIRING: table.firing * 1e6})[0] * 1e-6
        )
    on_open = () if angles and not isinstance(angles, Learned) else sensor.on_open
    return dataclasses.replace(sensor, points=partial(points, channels=table), on_open=on_open)


def read_columns(path: str | Path | Learned, wanted: Mapping[Column, Table]) -> list[Table]:
    """Return columns of a correction file by their headings, in the order of channels.

    Each column has the shape (channels,).

    Args:
        wanted: the columns to read, each with the nominal values of the model.

    Raises:
        UsageError: if the file cannot be read, if a column lacks or repeats a channel, or if
            `check_spread` rejects a column. The error has the line and column.
    """
    (line, headings), *rows = read_rows(path)
    indexes = [find_column(path, line, headings, column) for column in (CHANNEL, *wanted)]
    channels = len(next(iter(wanted.values())))
    values_by_channel: dict[int, tuple[int, list[float]]] = {}
    for line, cells in rows:
        channel, *values = (
            parse_value(path, line, cells, index, column)
            for index, column in zip(indexes, (CHANNEL, *wanted), strict=True)
        )
        if channel != int(channel) or not 1 <= channel <= channels:
            raise make_error(
                path,
                line,
                indexes[0],
                f"channel {channel:g} is out of range: this model has channels 1 to {channels}",
            )
        if channel in values_by_channel:
            raise make_error(
                path,
                line,
                indexes[0],
                f"channel {channel:g} is already in line {values_by_channel[int(channel)][0]}",
            )
        values_by_channel[int(channel)] = line, values
    if missing := [
        channel for channel in range(1, channels + 1) if channel not in values_by_channel
    ]:
        raise UsageError(
            f"{path!s}: expected all channels from 1 to {channels}, got {len(values_by_channel)}"
            f" channels; the first missing channel is {missing[0]}"
        )
    tables = list(
        np.array([values_by_channel[channel][1] for channel in sorted(values_by_channel)]).T
    )
    for (column, nominal_values), table, index in zip(
        wanted.items(), tables, indexes[1:], strict=True
    ):
        check_spread(path, rows[0][0], index, column, table, nominal_values)
    return tables


def read_rows(path: str | Path | Learned) -> list[tuple[int, list[str]]]:
    """Return the rows of the table, each with its line number; the headings are first."""
    try:
        reader = csv.reader(
            io.StringIO(read_content(path).decode("utf-8-sig", "replace"), newline="")
        )
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


def read_content(path: str | Path | Learned) -> bytes:
    """Return the bytes of a correction file.

    Args:
        path: the path of the file, or the bytes that a unit has sent in reply to `get_calibration`.

    Raises:
        UsageError: if the file cannot be read, or is too long.
    """
    if isinstance(path, Learned):
        return path
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise UsageError(f"{path!s}: not a correction file: {error}") from error
    if len(data) > MAX_FILE_BYTES:
        raise UsageError(
            f"{path!s}: not a correction file: it is larger than {MAX_FILE_BYTES // 1_000_000} MB"
        )
    return data


def find_column(path: str | Path | Learned, line: int, headings: list[str], column: Column) -> int:
    """Return the index of a column; the first column has the index 0."""
    for index, heading in enumerate(headings):
        name, _, unit = heading.lower().partition("(")
        if re.sub(r"[^a-z]", "", name) in column.headings:
            if unit.strip(" )") not in ("", *column.units):
                raise make_error(path, line, index, f"{heading!r} must be in {column.units[0]}")
            return index
    raise UsageError(
        f"{path!s}: line {line}: no column is named {column.name!r}; the names are"
        f" {', '.join(headings)[:MAX_QUOTED_CHARACTERS]!r}"
    )


def parse_value(
    path: str | Path | Learned, line: int, cells: list[str], index: int, column: Column
) -> float:
    text = cells[index] if index < len(cells) else ""
    try:
        value = float(text)
    except ValueError:
        raise make_error(
            path,
            line,
            index,
            f"{column.name} must be a number, got {text[:MAX_QUOTED_CHARACTERS]!r}",
        ) from None
    if not column.low <= value <= column.high:  # nor nan
        raise make_error(
            path,
            line,
            index,
            f"{column.name} {value:g} is outside {column.low:g} .. {column.high:g}"
            f" {column.units[0]}",
        )
    return value


def check_spread(
    path: str | Path | Learned,
    line: int,
    index: int,
    column: Column,
    table: Table,
    nominal_values: Table,
) -> None:
    """Raise UsageError if the spread of `table` differs greatly from the model's.

    The spread is the difference between the highest and the lowest value.
    """
    spread = float(np.ptp(table))
    nominal_spread = float(np.ptp(nominal_values))
    if (
        nominal_spread > 1
        and not nominal_spread / MAX_SPREAD_RATIO < spread < nominal_spread * MAX_SPREAD_RATIO
    ):
        description = f"have a spread of {spread:g}" if spread else f"are all {table[0]:g}"
        raise make_error(
            path,
            line,
            index,
            f"the {column.name}s {description}, but for this model a spread of about"
            f" {nominal_spread:g} {column.units[0]} is expected: does the file belong to another"
            " sensor?",
        )


def make_error(path: str | Path | Learned, line: int, index: int, reason: str) -> UsageError:
    return UsageError(f"{path!s}: line {line}, column {index + 1}: {reason}")
