"""Adds a sensor with the id of another plugin's sensor."""

import dataclasses

from lidarspec.spec import hookimpl
from lidarspec_broken.failing import plain


@hookimpl
def lidarspec_sensors():  # type: ignore[no-untyped-def]
    return [plain("broken-fresh"), dataclasses.replace(plain("broken-fresh"), id="acme-x1")]
