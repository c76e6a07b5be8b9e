"""The installed sensors, by the module that declares them.

A module is imported when its sensors are requested.
"""

from __future__ import annotations

import functools
import os
from importlib.metadata import EntryPoint, entry_points

import pytest

import lidarspec
from lidarspec import Sensor
from lidarspec.testing import assert_conformance
from tests.representatives import REPRESENTATIVES

#: sensors whose conformance is tested in the quick tier; the engine is tested on the shapes there.
QUICK = ("ldrobot-stl27l",)
#: examples of each frame type in a conformance test: few, and as many as there is time for in `make
#: test-long`.
CONFORMANCE_EXAMPLES = int(os.environ.get("LIDARSPEC_EXAMPLES", "4"))

_GROUP = "lidarspec.sensors"


@functools.cache
def _entry_points() -> list[EntryPoint]:
    return list(entry_points(group=_GROUP))


@functools.cache
def _entry_points_by_distribution() -> dict[str, list[EntryPoint]]:
    """Return the entry points by the name of their distribution.

    The name is read from the metadata of the distribution.
    """
    found: dict[str, list[EntryPoint]] = {}
    names: dict[int, str] = {}
    for entry in _entry_points():
        if entry.dist is not None:
            key = id(entry.dist)
            if key not in names:
                names[key] = entry.dist.name
            found.setdefault(names[key], []).append(entry)
    return found


def sensor_modules() -> list[str]:
    """Return the names of all modules with sensors, from entry points; nothing is imported."""
    return sorted({entry.module for entry in _entry_points()})


def sensors_in(module: str) -> list[Sensor]:
    """Load the sensors of a module, in the order of their ids."""
    names = [entry.name for entry in _entry_points() if entry.module == module]
    sensors = {sensor.id: sensor for sensor in map(lidarspec.sensor, names)}
    return [sensors[sensor_id] for sensor_id in sorted(sensors)]


def distinct_sensors_in(module: str) -> list[Sensor]:
    """Load the sensors of a module; of models that share all frames only the last."""
    distinct: dict[tuple[int, ...], Sensor] = {}
    for sensor in sensors_in(module):
        distinct[tuple(map(id, sensor.frames.values()))] = sensor
    return list(distinct.values())


def conformance_cases(distribution: str) -> list[object]:
    """Return the parameters of a distribution's conformance test: one id of each sensor.

    Only `QUICK` ones are tested in the quick tier.
    """
    return [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in sensor_ids(distribution)
    ]


def assert_installed_conformance(distribution: str, sensor_id: str) -> None:
    """Fail with every finding of `lidarspec check` for an installed sensor.

    Frames and functions that it shares with a sensor before it in its distribution are tested
    there.
    """
    ids = sensor_ids(distribution)
    before = [lidarspec.sensor(name) for name in ids[: ids.index(sensor_id)]]
    assert_conformance(sensor_id, examples=CONFORMANCE_EXAMPLES, tested=before)


def sensor_ids(distribution: str) -> list[str]:
    """Return a name of each sensor of a distribution, representatives first."""
    names: dict[str, list[str]] = {}
    for entry in _entry_points_by_distribution()[distribution]:
        names.setdefault(entry.value, []).append(entry.name)
    vendor = distribution.removeprefix("lidarspec-")
    return sorted((_full_name(vendor, entries) for entries in names.values()), key=_rank)


def _full_name(vendor: str, names: list[str]) -> str:
    """Return the name of a sensor that is its id, or else an alias that begins with the vendor."""
    full = [name for name in names if name.startswith(f"{vendor}-")]
    return min(full or names, key=_rank)


def _rank(name: str) -> tuple[bool, str]:
    return name not in REPRESENTATIVES, name
