"""A plugin that lists something else than sensors."""

from lidarspec.spec import hookimpl


@hookimpl
def lidarspec_sensors():
    return ["broken-one"]
