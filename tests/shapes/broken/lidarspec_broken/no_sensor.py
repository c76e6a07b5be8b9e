"""Lists an object that is not a sensor."""

from lidarspec.spec import hookimpl


@hookimpl
def lidarspec_sensors():  # type: ignore[no-untyped-def]
    return ["acme-x2"]
