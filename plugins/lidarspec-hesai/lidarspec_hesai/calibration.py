"""The angles and firing times of each channel: a nominal table, or the files of one unit.

Source: HesaiLidar_SDK_2.0, correction/angle_correction and correction/firetime_correction.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarspec import UsageError
from lidarspec.spec import Points, Sensor

Table = NDArray[np.float64]


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


def nominal(elevation: Iterable[float], azimuth: Iterable[float], firing_us: Iterable[float]) -> Calibration:
    """The table of a model; firing times in microseconds."""
    return Calibration(np.array(list(elevation)), np.array(list(azimuth)), np.array(list(firing_us)) * 1e-6)


def configure(
    points: Callable[..., Points],
    table: Calibration,
    sensor: Sensor,
    /,
    *,
    calibration: str | Path | None = None,
    firing_times: str | Path | None = None,
) -> Sensor:
    """The sensor with a unit's own tables in place of the model's; a file named in an earlier `configure` stays.

    Args:
        points: the model's function of `Fields` and the channels' `Calibration`.
        table: the model's channels.
        calibration: CSV of channel, elevation and azimuth in degrees.
        firing_times: CSV of channel and firing time in microseconds.

    Raises:
        UsageError: for a file that cannot be read, or does not list the channels of this model.
    """
    angles, times = calibration or sensor.options.get("calibration"), firing_times or sensor.options.get("firing_times")
    if angles:
        elevation, azimuth = columns(angles, len(table), 2)
        table = dataclasses.replace(table, elevation=elevation, azimuth=azimuth, nominal=False)
    if times:
        table = dataclasses.replace(table, firing=columns(times, len(table), 1)[0] * 1e-6)
    return dataclasses.replace(sensor, points=partial(points, channels=table))


def columns(path: str | Path, channels: int, number: int) -> list[Table]:
    """The numbers after the channel in a correction file, by channel.

    Headings, the mark EEFF above the table and the hash below it are passed over, as the vendor's reader does.

    Raises:
        UsageError: where the file cannot be read, or its channels are not 1 to `channels`, each with finite numbers.
    """
    try:
        with open(path, encoding="utf-8", errors="replace", newline="") as file:
            rows = [[cell.strip() for cell in row] for row in csv.reader(file)]
        listed = {int(row[0]): [float(cell) for cell in row[1 : 1 + number]] for row in rows if len(row) > number and row[0].isdecimal()}
    except (OSError, ValueError, csv.Error) as error:
        raise UsageError(f"{path}: not a correction file: {error}") from error
    if sorted(listed) != list(range(1, channels + 1)):
        raise UsageError(f"{path}: lists {len(listed)} channels, and this model has channels 1 to {channels}")
    if not all(math.isfinite(value) for values in listed.values() for value in values):
        raise UsageError(f"{path}: has a value that is not a finite number")
    return list(np.array([listed[channel] for channel in sorted(listed)]).T)
