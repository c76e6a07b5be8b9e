"""What the verbs that read a source share: durations, shares, and what is said where nothing comes."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import click

from lidarspec.device.device import Device
from lidarspec.errors import CommandError, LidarSpecError, UsageError, WireError, suggest
from lidarspec.scans.scans import Scan
from lidarspec.spec.fields import duration

#: seconds that a device is given for its first frame.
PATIENCE = 10.0
#: seconds between two looks at a source that sends nothing.
LOOK = 0.1


class Number(click.ParamType):  # type: ignore[type-arg]  # older versions of click have no types
    """A number that is written in a way of its own.

    Args:
        name: what it is, for help pages.
        parse: the number of a text; a text that is none is a ValueError or UsageError.
        form: how it looks, for messages.
    """

    def __init__(self, name: str, parse: Callable[[str], float], form: str) -> None:
        self.name, self._parse, self._form = name, parse, form

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number."""
        if isinstance(value, float | int):
            return float(value)
        try:
            return self._parse(value)
        except (ValueError, UsageError):
            self.fail(f"{value!r} is no {self._form}", param, ctx)


def _duration(text: str) -> float:
    seconds = duration(text)
    if seconds <= 0:
        raise ValueError(text)
    return seconds


def _share(text: str) -> float:
    share = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    if not 0 <= share <= 1:
        raise ValueError(text)
    return share


def _speed(text: str) -> float:
    speed = 0.0 if text == "max" else float(text.removesuffix("x"))
    if text != "max" and not 0 < speed < math.inf:
        raise ValueError(text)
    return speed


#: seconds from "10s", "500ms", "2min", "1h" or a bare number.
DURATION = Number("duration", _duration, "duration above 0, such as 10s, 500ms, 2min or 1h")
#: a number from 0 to 1, from "1%" or "0.01".
SHARE = Number("share", _share, "share, such as 1% or 0.01")
#: a factor above 0; 0 for "max".
SPEED = Number("speed", _speed, "speed: a factor such as 1, 0.5 or 10, or max")


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
