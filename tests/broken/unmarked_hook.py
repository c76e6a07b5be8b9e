"""A hook without the hookimpl decorator."""

from tests.broken.sound import sensor


def lidarspec_sensors():
    return [sensor()]
