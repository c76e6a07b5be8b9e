"""A plugin that lists an object that is not a sensor."""

from lidarspec.spec import hookimpl


@hookimpl
def lidarspec_sensors():
    return ["broken-one"]
