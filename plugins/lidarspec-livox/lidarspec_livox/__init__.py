"""Livox Lidars, of both generations of their protocol."""

from __future__ import annotations

from collections.abc import Iterable

from lidarspec.spec import Sensor, hookimpl
from lidarspec_livox import sdk1, sdk2
from lidarspec_livox.sdk1 import AVIA, HORIZON, MID40, MID70, TELE15
from lidarspec_livox.sdk2 import HAP, MID360

__all__ = ["AVIA", "HAP", "HORIZON", "MID40", "MID70", "MID360", "TELE15"]


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Livox Lidars."""
    return [*sdk2.SENSORS, *sdk1.SENSORS]
