"""A hook that does not exist."""

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensor():
    return [sensor()]
