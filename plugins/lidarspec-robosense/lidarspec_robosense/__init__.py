"""RoboSense lidars, one module for each model."""

from __future__ import annotations

from collections.abc import Iterable

from lidarspec.spec import Sensor, hookimpl
from lidarspec_robosense.helios import HELIOS_16P
from lidarspec_robosense.m1 import M1
from lidarspec_robosense.rs32 import BPEARL, RS32


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The RoboSense sensors."""
    return [M1, HELIOS_16P, RS32, BPEARL]
