"""An invalid sensor id."""

from __future__ import annotations

import dataclasses

from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


@hookimpl
def lidarspec_sensors():
    return [dataclasses.replace(sensor(), id="Broken One")]
