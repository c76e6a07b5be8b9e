"""The hooks that a plugin can implement; each is a function of this name, marked with ``@hookimpl``."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pluggy

from lidarspec.checksums import Checksum
from lidarspec.geometry import Points
from lidarspec.spec import Frame, Sensor

NAMESPACE = "lidarspec"

hookspec = pluggy.HookspecMarker(NAMESPACE)
hookimpl = pluggy.HookimplMarker(NAMESPACE)


@hookspec
def lidarspec_sensors() -> Iterable[Sensor]:  # type: ignore[empty-body]
    """The sensors that the plugin adds."""


@hookspec(firstresult=True)
def lidarspec_checksum(sensor: Sensor, frame: Frame) -> Checksum | None:
    """The checksum algorithm of a frame type, or None to leave it as declared; never field or span."""


@hookspec(firstresult=True)
def lidarspec_points(sensor: Sensor, fields: Any) -> Points | None:
    """The points of a batch of packets, or None to leave them to the sensor: a site's own calibration, for example."""


@hookspec(firstresult=True)
def lidarspec_source(url: str) -> Any:
    """A transport for a URL scheme that the package does not know, or None."""


@hookspec
def lidarspec_formats() -> Iterable[Any]:  # type: ignore[empty-body]
    """File formats by suffix that the plugin adds."""
