"""RoboSense lidars, one module for each packet format."""

from __future__ import annotations

from collections.abc import Iterable

from lidarspec.spec import Sensor, hookimpl
from lidarspec_robosense.airy import AIRY
from lidarspec_robosense.helios import HELIOS_16P, HELIOS_32, HELIOS_5515
from lidarspec_robosense.m1 import M1
from lidarspec_robosense.rs32 import BPEARL, BPEARL_V4, RS16, RS32
from lidarspec_robosense.ruby import RS48, RS80, RS128, RUBY_PLUS_48, RUBY_PLUS_80, RUBY_PLUS_128
from lidarspec_robosense.solid import E1, M2, MX


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the RoboSense sensors."""
    rotating = [HELIOS_16P, HELIOS_32, HELIOS_5515, RS16, RS32, BPEARL, BPEARL_V4, AIRY]
    return [M1, *rotating, RS128, RS80, RS48, RUBY_PLUS_128, RUBY_PLUS_80, RUBY_PLUS_48, M2, MX, E1]
