"""Find codes without a name: values of enumerated fields that the spec does not list."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lidarspec.errors import WireError
from lidarspec.frames.schema import make_schema
from lidarspec.framing.results import Found
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.enum_values import EnumValue

#: The maximum number of frames of one type to parse.
MAX_PARSED_FRAMES = 4


def find_unknown_codes(sensor: Sensor, frames: Sequence[Found]) -> list[str]:
    """Return a message for each code in the frames that the spec does not name."""
    texts: dict[str, str] = {}
    for name, frame in sensor.frames.items():
        paths = [
            info.path
            for info in make_schema(frame.tree).fields.values()
            if info.labels and not info.axes
        ]
        if not paths:
            continue
        for item in [item for item in frames if item.frame == name][:MAX_PARSED_FRAMES]:
            for path, value in _iter_unknown(sensor, item, paths):
                texts.setdefault(f"{name}.{path}", f"{name}.{path} is {value}, an unknown code")
    return list(texts.values())


def _iter_unknown(
    sensor: Sensor, item: Found, paths: Sequence[str]
) -> Iterator[tuple[str, EnumValue]]:
    try:
        parsed = sensor.parse(item.data, item.frame)
    except WireError:
        return
    for path in paths:
        value = parsed
        for step in path.split("."):
            value = value.get(step) if isinstance(value, dict) else None
        # unused fields are often 0
        if isinstance(value, EnumValue) and value and not value.name:
            yield path, value
