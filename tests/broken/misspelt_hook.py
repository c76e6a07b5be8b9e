"""A hook that does not exist."""

from lidarspec import hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensor():
    return [sensor()]
