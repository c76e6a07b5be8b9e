"""Which of several sensors with the same frames it is: by how fast its clock runs, and by the names that its frames hold.

A clock that advances from packet to packet as the sensor's own `sweep` says tells models apart that differ in speed. A name is
what a field of text holds, or what the author's remark calls the value of a field ("0x22 NAME"). The clock comes first: bytes
that name a model are not always true.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lidarspec.decoder import Found
from lidarspec.errors import LidarSpecError
from lidarspec.frames.schema import FieldInfo, schema
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Sensor

#: share by which the pace of a clock may be off, frames of a type that are looked into for names, and packets simulated.
OFF, READ, PACKETS = 0.03, 3, 64
_VALUE = re.compile(r"\b(0x[0-9a-fA-F]+|\d+)\s+([^,;:]+)")


def told_apart(candidates: Sequence[Sensor], found: Sequence[Found]) -> dict[str, str]:
    """The candidates that the frames speak for, by id, each with why; empty where the frames say nothing.

    Args:
        candidates: sensors whose frames these are alike.
        found: frames in the order of their arrival.
    """
    by_clock = {sensor.id: why for sensor in candidates if (why := _by_clock(sensor, found))}
    if by_clock and len(by_clock) < len(candidates):
        return by_clock
    by_name = {sensor.id: why for sensor in candidates if (why := _by_name(sensor, found))}
    return by_name if len(by_name) < len(candidates) else {}


def _by_clock(sensor: Sensor, found: Sequence[Found]) -> str:
    """Why the clock in the frames is this sensor's, "" where it is not."""
    expected = _pace(sensor.id, sensor) if sensor.clock is not None else None
    data = [item for item in found if item.frame == sensor.data_frame]
    if expected is None or len(data) < 3:
        return ""
    follows = np.array([after.offset == item.offset + len(item.data) for item, after in itertools.pairwise(data)])
    steps = _steps(sensor, [item.data for item in data])[follows]
    steps = steps[(steps >= 0) & (steps <= 10 * expected)]
    if len(steps) < 2 or steps.mean() <= 0:
        return ""
    step, grain = float(steps.mean()), min(float(np.ptp(steps)), expected)  # a coarse clock is as uneven as its steps
    if abs(step - expected) > OFF * expected + grain / (2 * len(steps) ** 0.5):
        return ""
    return f"its clock advances by {step / 1e6:.3g} ms a packet"


@functools.lru_cache(maxsize=256)
def _pace(sensor_id: str, sensor: Sensor) -> float | None:
    """Nanoseconds by which the sensor's clock advances a packet, None where nobody knows."""
    try:
        steps = _steps(sensor, simulate(sensor, PACKETS))
    except LidarSpecError:
        return None
    steps = steps[steps >= 0]
    return float(steps.mean()) if len(steps) and steps.mean() > 0 else None


def _steps(sensor: Sensor, data: Sequence[bytes]) -> NDArray[np.int64]:
    """By how many ns the clock advances from packet to packet."""
    return np.diff(sensor.decode(list(data)).time_ns)


def _by_name(sensor: Sensor, found: Sequence[Found]) -> str:
    """Why the frames name this sensor, "" where they do not."""
    model, read = _plain(sensor.model), dict.fromkeys(sensor.frames, 0)
    for item in found:
        if read.get(item.frame, READ) >= READ:
            continue
        read[item.frame] += 1
        fields = _fields(sensor, item.frame)
        for path, text in _texts(sensor.parse(item.data, item.frame), fields):
            if _plain(text) == model:
                return f"{item.frame}.{path} says {text}"
    return ""


def _fields(sensor: Sensor, frame: str) -> Mapping[str, FieldInfo]:
    return schema(sensor.frames[frame].prepared).fields


def _texts(values: object, fields: Mapping[str, FieldInfo], above: str = "") -> Iterator[tuple[str, str]]:
    """The fields outside arrays that hold a text, or a number with a meaning, and what they say."""
    if not isinstance(values, Mapping):
        return
    for name, value in values.items():
        path = f"{above}.{name}" if above else str(name)
        info = fields.get(path)
        if isinstance(value, Mapping):
            yield from _texts(value, fields, path)
        elif isinstance(value, bytes):
            text = value.split(b"\0")[0].decode("ascii", "replace")
            if text.isprintable() and text:
                yield path, text
        elif info is not None and isinstance(value, int):
            meanings = {int(number, 0): text.strip() for number, text in _VALUE.findall(info.docs)} | dict(info.labels)
            if int(value) in meanings:
                yield path, str(meanings[int(value)])


def _plain(text: str) -> str:
    return re.sub(r"[\W_]", "", text).lower()
