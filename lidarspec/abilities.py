"""What can be done with a sensor, as an interface, and where the engine comes from that does it.

A sensor is found and looked at far more often than all of this is needed, so the engine is imported by the first method that asks for it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from lidarspec.decoder import Decoder, Found
    from lidarspec.packets import Packets
    from lidarspec.scans import Scan
    from lidarspec.spec import Sensor


class Engine(Protocol):
    """What the methods of `Sensor` hand over to."""

    def parse(self, sensor: Sensor, data: bytes, *, frame: str | None, verify: bool) -> Any: ...
    def build(self, sensor: Sensor, frame: str, value: Any, values: Mapping[str, Any], *, units: bool) -> bytes: ...
    def example(self, sensor: Sensor, frame: str, *, seed: int) -> bytes: ...
    def command(self, sensor: Sensor, name: str, arguments: Mapping[str, Any]) -> bytes: ...
    def decoder(self, sensor: Sensor, *, stream: bool | None, backend: str) -> Decoder: ...
    def split(self, sensor: Sensor, data: Any, *, backend: str) -> list[Found]: ...
    def decode(self, sensor: Sensor, data: Any, *, frame: str | None, backend: str) -> Packets: ...
    def scans(self, sensor: Sensor, data: Any, *, backend: str) -> Iterator[Scan]: ...
    def configure(self, sensor: Sensor, options: Mapping[str, Any]) -> Sensor: ...
    def rebuild(self, sensor_id: str, options: Mapping[str, Any]) -> Sensor: ...


_loaders: list[Callable[[], Engine]] = []


def install(load: Callable[[], Engine]) -> None:
    """Make what `load` returns the engine of every sensor; it is called once, by the first method that needs it."""
    _loaders[:] = [load]
    engine.cache_clear()


@functools.cache
def engine() -> Engine:
    """The engine that is installed."""
    return _loaders[0]()
