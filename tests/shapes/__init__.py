"""Small invented sensors, one mechanism each, so that the engine is general before it is large; every test runs over all of them."""

from __future__ import annotations

from lidarspec import Sensor
from tests.shapes import (
    ahead,
    bits,
    calibration,
    clock,
    commands,
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
)

SHAPES: dict[str, Sensor] = {module.SENSOR.id: module.SENSOR for module in _MODULES}
