"""Raises while it lists its sensors."""

from lidarspec.spec import hookimpl


@hookimpl
def lidarspec_sensors():  # type: ignore[no-untyped-def]
    return [1 / 0]
