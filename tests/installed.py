"""The installed sensors by the module that declares them; a module is imported when its sensors are asked for."""

from __future__ import annotations

from importlib.metadata import entry_points

from lidarspec import Sensor

_GROUP = "lidarspec.sensors"


def sensor_modules() -> list[str]:
    """Return the names of all modules with sensors, from entry points; nothing is imported."""
    return sorted({entry.module for entry in entry_points(group=_GROUP)})


def sensors_in(module: str) -> list[Sensor]:
    """Load the sensors of a module, in the order of their ids."""
    import lidarspec

    names = [entry.name for entry in entry_points(group=_GROUP) if entry.module == module]
    sensors = {sensor.id: sensor for sensor in map(lidarspec.sensor, names)}
    return [sensors[sensor_id] for sensor_id in sorted(sensors)]


def distinct_sensors_in(module: str) -> list[Sensor]:
    """Load the sensors of a module; of models that share all frames only the first."""
    distinct: dict[tuple[int, ...], Sensor] = {}
    for sensor in sensors_in(module):
        distinct.setdefault(tuple(map(id, sensor.frames.values())), sensor)
    return list(distinct.values())
