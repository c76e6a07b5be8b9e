"""A hook without its mark."""

from tests.broken.sound import sensor


def lidarspec_sensors():
    return [sensor()]
