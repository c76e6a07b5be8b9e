"""A hook with an argument that the engine does not pass."""

from lidarspec.spec import hookimpl


@hookimpl
def lidarspec_sensors(everything):  # type: ignore[no-untyped-def]
    return []
