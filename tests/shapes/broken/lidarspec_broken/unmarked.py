"""A hook without the hookimpl decorator."""


def lidarspec_sensors():  # type: ignore[no-untyped-def]
    return []
