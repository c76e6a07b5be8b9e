"""What the verbs that read a source share: durations, shares, and what is said where nothing comes."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from lidarspec.cli.failures import suggest
from lidarspec.device.device import Device
from lidarspec.errors import CommandError, LidarSpecError, WireError
from lidarspec.scans.scans import Scan

#: seconds that a device is given for its first frame.
PATIENCE = 10.0
#: seconds between two looks at a source that sends nothing.
LOOK = 0.1
_UNITS = {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "m": 60.0, "h": 3600.0}


if TYPE_CHECKING:
    Parameter = click.ParamType[float]
else:
    Parameter = click.ParamType


class Duration(Parameter):
    """Seconds from "10s", "500ms", "2min", "1h" or a bare number."""

    name = "duration"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The seconds."""
        if isinstance(value, float | int):
            return float(value)
        found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)", value.strip())
        if found is None or found[2] not in _UNITS or float(found[1]) <= 0:
            self.fail(f"{value!r} is no duration above 0, such as 10s, 500ms, 2min or 1h", param, ctx)
        return float(found[1]) * _UNITS[found[2]]


class Share(Parameter):
    """A number from 0 to 1, from "1%" or "0.01"."""

    name = "share"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The share."""
        if isinstance(value, float):
            return value
        found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(%?)", value.strip())
        share = float(found[1]) / (100 if found[2] else 1) if found else -1.0
        if not 0 <= share <= 1:
            self.fail(f"{value!r} is no share, such as 1% or 0.01", param, ctx)
        return share


def nothing_came(device: Device, source: str, seconds: float | None = None) -> LidarSpecError:
    """Why there is nothing to show: no data frame in a file, a silent device, or one whose bytes are no frames."""
    sensor, stats = device.sensor, device.stats
    if not device.is_live:
        what = "holds no bytes" if stats.bytes_in == 0 else f"has no data frame: {stats}"
        return suggest(WireError(f"{source} {what}", sensor=sensor.id), f"lidarspec explain {source} -s {sensor.id}")
    waited = "" if seconds is None else f" within {seconds:.1f} s".replace(".0 s", " s")
    if stats.bytes_in == 0:
        return suggest(CommandError(f"{sensor.id} on {source} sent nothing{waited}"), f"lidarspec doctor {source} -s {sensor.id}")
    error = WireError(f"{source}: {stats.bytes_in} bytes{waited}, and not a scan of data frames among them: {stats}", sensor=sensor.id)
    return suggest(error, f"lidarspec detect {source}")


class Patience:
    """The time in which a live source has to send its first frame."""

    def __init__(self, device: Device, source: str) -> None:
        self._device, self._source, self._began = device, source, time.monotonic()

    def check(self) -> None:
        """Nothing, while there is hope.

        Raises:
            CommandError, WireError: where the device has sent nothing, or nothing of the sensor's, for too long.
        """
        waited = time.monotonic() - self._began
        if waited > PATIENCE and self._device.is_live and not self._device.stats.frames:
            raise nothing_came(self._device, self._source, waited)


def scans_of(device: Device, source: str) -> Iterator[Scan]:
    """The scans of a device, which has to send its first frame in time.

    Raises:
        CommandError, WireError: see `Patience`.
    """
    patience = Patience(device, source)
    for scan in device.scans(wait=LOOK):
        if scan is not None:
            yield scan
        patience.check()
