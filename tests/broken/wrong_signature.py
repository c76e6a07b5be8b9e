"""A hook with an argument that the engine does not pass."""

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors(everything):
    return [sensor()]
