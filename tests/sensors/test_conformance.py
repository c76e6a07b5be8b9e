"""The test kit over every sensor there is: those installed, and the invented shapes."""

from __future__ import annotations

import lidarspec
from lidarspec import Sensor
from lidarspec.framing.frame_engine import InterpretedCodec, codec
from lidarspec.testing import SensorConformance
from tests.shapes import SHAPES

EVERY: dict[str, Sensor] = {**lidarspec.sensors(), **SHAPES}

#: frames that construct alone can read.
REFUSED = {"shape-text data"}

_tried: set[tuple[int, ...]] = set()


def _tests(sensor: Sensor) -> type[SensorConformance]:
    """The test class of one sensor; a relative that shares its frames with one before is tried with fewer of them."""
    frames = tuple(map(id, sensor.frames.values()))
    effort = {"examples": SensorConformance.examples // 5} if frames in _tried else {}
    _tried.add(frames)
    return type(f"Test_{sensor.id.replace('-', '_')}", (SensorConformance,), {"sensor": sensor, "__module__": __name__, **effort})


globals().update({case.__name__: case for case in map(_tests, EVERY.values())})


def test_every_frame_compiles_except_those_refused_by_name() -> None:
    engines = {f"{name} {frame}": codec(value) for name, sensor in EVERY.items() for frame, value in sensor.frames.items()}
    assert {name for name, engine in engines.items() if isinstance(engine, InterpretedCodec)} == REFUSED
