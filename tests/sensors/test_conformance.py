"""The test kit over every sensor there is: those installed, and the invented shapes."""

from __future__ import annotations

from lidarspec import Sensor
from lidarspec.framing.frame_engine import InterpretedCodec, codec
from lidarspec.testing import SensorConformance
from lidarspec.testing.conformance import PROPERTIES
from tests.all_sensors import DISTINCT, EVERY

#: frames that construct alone can read.
REFUSED = {"shape-text data"}
#: what is left out for a relative: what holds for the frames is tried on one sensor of those that share them.
OF_FRAMES = {f"test_{one.name}": None for one in PROPERTIES if one.each == "frame"}


def _tests(sensor: Sensor) -> type[SensorConformance]:
    """The test class of one sensor."""
    shared = {} if sensor.id in DISTINCT else OF_FRAMES
    return type(f"Test_{sensor.id.replace('-', '_')}", (SensorConformance,), {"sensor": sensor, "__module__": __name__, **shared})


globals().update({case.__name__: case for case in map(_tests, EVERY.values())})


def test_every_frame_compiles_except_those_refused_by_name() -> None:
    engines = {f"{name} {frame}": codec(value) for name, sensor in EVERY.items() for frame, value in sensor.frames.items()}
    assert {name for name, engine in engines.items() if isinstance(engine, InterpretedCodec)} == REFUSED
