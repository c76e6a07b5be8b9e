"""A hook that raises while it lists its sensors."""

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(), sensor(range_limits=(0, 1 / 0))]
