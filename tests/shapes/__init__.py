"""Small invented sensors, one mechanism each, so that the engine is general before it is large; every test runs over all of them."""

from __future__ import annotations

from lidarspec import Sensor
from tests.shapes import (
    ahead,
    bits,
    calibration,
    clock,
    commands,
    coordinates,
    count,
    datagrams,
    echoes,
    grid,
    headed,
    lengths,
    middle,
    modes,
    nested,
    nibbles,
    numbers,
    options,
    outer,
    remarks,
    scales,
    sized,
    state,
    text,
    twins,
    weak,
)

_MODULES = (
    count,
    bits,
    middle,
    nibbles,
    nested,
    weak,
    twins,
    ahead,
    state,
    calibration,
    options,
    clock,
    echoes,
    text,
    modes,
    commands,
    grid,
    numbers,
    datagrams,
    lengths,
    headed,
    remarks,
    sized,
    outer,
    scales,
)

SHAPES: dict[str, Sensor] = {sensor.id: sensor for sensor in (*(module.SENSOR for module in _MODULES), *coordinates.SENSORS)}
