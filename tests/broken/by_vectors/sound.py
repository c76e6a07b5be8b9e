"""The sound sensor beside the vectors."""

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [sensor()]
