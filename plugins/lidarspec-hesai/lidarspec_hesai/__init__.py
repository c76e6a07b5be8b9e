"""Hesai lidars, one module for each packet format."""

from __future__ import annotations

from collections.abc import Iterable

from lidarspec.spec import Sensor, hookimpl
from lidarspec_hesai.at128 import AT128
from lidarspec_hesai.jt16 import JT16
from lidarspec_hesai.jt128 import JT128
from lidarspec_hesai.pandar40p import PANDAR40P
from lidarspec_hesai.pandar64 import PANDAR64
from lidarspec_hesai.pandar128 import OT128, PANDAR128
from lidarspec_hesai.qt64 import QT64
from lidarspec_hesai.qt128 import QT128
from lidarspec_hesai.xt import XT16, XT32, XT32M


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Hesai sensors."""
    return [
        PANDAR40P,
        PANDAR64,
        XT32,
        XT16,
        XT32M,
        QT64,
        QT128,
        PANDAR128,
        OT128,
        JT128,
        JT16,
        AT128,
    ]
