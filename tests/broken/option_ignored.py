"""An option whose value is checked, and then ignored."""

from __future__ import annotations

from lidarspec import UsageError
from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


def configure(sensor, *, zero="data"):
    if zero not in ("data", "housing"):
        raise UsageError(f"zero is data or housing, not {zero!r}")
    return sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(configure=configure)]
