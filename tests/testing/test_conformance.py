"""The test kit over every sensor there is: those installed, and the invented shapes."""

from __future__ import annotations

import os

from lidarspec import Sensor
from lidarspec.framing.frame_engine import InterpretedCodec, codec
from lidarspec.testing import SensorConformance, agreement, hostile
from lidarspec.testing.check import target
from lidarspec.testing.properties import PROPERTIES
from tests.all_sensors import DISTINCT, EVERY, FRAMES
from tests.shapes import SHAPES

#: a third of what the kit takes where nothing is said: `make test-long` tries as many as one has time for.
EXAMPLES = int(os.environ.get("LIDARSPEC_EXAMPLES", "12"))
#: frames that construct alone can read.
REFUSED = {"shape-text data"} | {
    f"{name} {told}" for name in EVERY if name.startswith("hokuyo-") for told in ("version", "parameters", "state")
}
#: what is left out for a relative: what holds for the frames is tried on one sensor of those that share them.
OF_FRAMES = {f"test_{one.name}": None for one in PROPERTIES if one.each == "frame" or one.function.__module__ == hostile.__name__}
#: and what is left out besides where the same functions read them.
OF_READING = {f"test_{one.name}": None for one in PROPERTIES if one.function.__module__ == agreement.__name__}
READING = ("data_frame", "points", "clock", "sequence", "scan", "state")


def _shared(sensor: Sensor) -> dict[str, None]:
    """The tests that a relative has in common with the sensor that is tried for those of its frames."""
    if sensor.id in DISTINCT:
        return {}
    tried = next(other for other in DISTINCT.values() if list(other.frames.values()) == list(sensor.frames.values()))
    return OF_FRAMES | (OF_READING if all(getattr(sensor, name) == getattr(tried, name) for name in READING) else {})


def _tests(sensor: Sensor) -> type[SensorConformance]:
    """The test class of one sensor."""
    vectors = None if sensor.id in SHAPES else target(sensor.id).vectors
    elsewhere = [name for name in sensor.frames if (sensor.id, name) not in FRAMES]
    values = {"sensor": sensor, "examples": EXAMPLES, "vectors": vectors, "elsewhere": elsewhere, "__module__": __name__, **_shared(sensor)}
    return type(f"Test_{sensor.id.replace('-', '_')}", (SensorConformance,), values)


globals().update({case.__name__: case for case in map(_tests, EVERY.values())})


def test_every_frame_compiles_except_those_refused_by_name() -> None:
    engines = {f"{name} {frame}": codec(value) for name, sensor in EVERY.items() for frame, value in sensor.frames.items()}
    assert {name for name, engine in engines.items() if isinstance(engine, InterpretedCodec)} == REFUSED
