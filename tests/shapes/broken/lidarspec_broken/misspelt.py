"""A hook that does not exist."""

from lidarspec.spec import hookimpl


@hookimpl
def lidarspec_sensor():  # type: ignore[no-untyped-def]
    return []
