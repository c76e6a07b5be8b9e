"""An error that does not say which of the samples it was in."""

from __future__ import annotations

import re

from lidarspec import Sensor, WireError
from lidarspec.spec import hookimpl
from tests.broken.sound import sensor


class Mine(Sensor):
    def parse(self, data, frame=None, *, verify=True):
        try:
            return super().parse(data, frame, verify=verify)
        except WireError as error:
            path = re.sub(r"\[[0-9]+\]", "", error.path)
            raise WireError(error.reason, sensor=self.id, frame=error.frame, offset=error.offset, path=path) from error


@hookimpl
def lidarspec_sensors():
    return [sensor(kind=Mine)]
