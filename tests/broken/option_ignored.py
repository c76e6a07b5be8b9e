"""`configure` reads an option, and ignores its value."""

from __future__ import annotations

from typing import Literal

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


def configure(sensor, *, zero: Literal["data", "housing"] = "data"):
    assert zero
    return sensor


@hookimpl
def lidarspec_sensors():
    return [sensor(configure=configure)]
