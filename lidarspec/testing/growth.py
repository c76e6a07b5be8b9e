"""Linear time: how much longer twice the worst input takes, as a ratio within one run."""

from __future__ import annotations

import random
import time

from lidarspec.frames.codecs import CompiledCodec, codec
from lidarspec.spec import Sensor
from lidarspec.testing.findings import require
from lidarspec.testing.subject import Subject

#: bytes of the whole input, and of that of a sensor that is not compiled.
LENGTH, SHORT = 240_000, 12_000
#: how many times as long twice the input may take, and how often it is tried.
RATIO, TRIES = 3.0, 5
#: CPU seconds below which a difference says nothing.
LEAST = 0.05


def worst(subject: Subject, length: int) -> bytes:
    """Headers that claim the longest frame, and two random bytes: candidates without end, as long as they can be."""
    source = random.Random(subject.sensor.id)
    longest = max((subject.example(subject.sensor.data_frame, seed=seed) for seed in range(40)), key=len)
    unit = b"".join(longest[: source.randint(3, 8)] + source.randbytes(2) for _ in range(64))
    return (unit * (length // len(unit) + 1))[:length]


def time_grows_with_the_input_and_no_faster(subject: Subject) -> None:
    """Twice the garbage, or the worst stream, takes about twice the time."""
    compiled = all(isinstance(codec(frame), CompiledCodec) for frame in subject.sensor.frames.values())
    length = LENGTH if compiled else SHORT
    for kind, data in (("noise", random.Random(1).randbytes(length)), ("headers that claim the longest frame", worst(subject, length))):
        _fed(subject.sensor, data[: length // 16])
        shortest = longest = float("inf")
        for _ in range(TRIES):
            shortest = min(shortest, _seconds(subject.sensor, data[: length // 2]))
            longest = min(longest, _seconds(subject.sensor, data))
            if longest <= max(2.2 * shortest, LEAST):
                break
        require(
            longest <= max(RATIO * shortest, LEAST), "LS413", f"twice as many bytes of {kind} take {longest / shortest:.1f} times as long"
        )


def _seconds(sensor: Sensor, data: bytes) -> float:
    """CPU seconds of one run."""
    start = time.process_time()
    _fed(sensor, data)
    return time.process_time() - start


def _fed(sensor: Sensor, data: bytes, chunk: int = 1 << 20) -> None:
    decoder = sensor.decoder()
    for start in range(0, len(data), chunk):
        decoder.feed(data[start : start + chunk])
    decoder.finish()
