"""Hesai lidars, one module for each packet format."""

from __future__ import annotations

from collections.abc import Iterable

from lidarspec.spec import Sensor, hookimpl
from lidarspec_hesai.pandar40p import PANDAR40P
from lidarspec_hesai.qt64 import QT64
from lidarspec_hesai.xt import XT16, XT32


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Hesai sensors."""
    return [PANDAR40P, XT32, XT16, QT64]
