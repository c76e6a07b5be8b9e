"""Streams that are expensive to search for frames, made from a sensor's own frames.

The cost of a byte depends on the declaration: on frame types that follow each other, and on
headers that each select a new layout. So the streams contain frames of all types in any order,
announcements with and without their frames, truncated frames, random headers, damaged frames, and
a mixture of all of these.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import random
from collections.abc import Callable

from lidarspec.errors import SpecError
from lidarspec.framing.example_frames import random_frame
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.testing.sensor_under_test import SensorUnderTest

#: Number of examples of each frame type in the streams.
EXAMPLES = 6
#: Frames with random headers.
RANDOM_HEADERS = 60
#: Bytes of the head of a frame, at most.
MAX_HEAD_BYTES = 12
#: Random bytes after a head, at most.
MAX_NOISE_BYTES = 3
#: One in 40 frames follows its announcement, if its type needs one.
ANNOUNCED_INTERVAL = 40


def streams(subject: SensorUnderTest, length: int) -> dict[str, list[bytes]]:
    """Return streams of at least `length` bytes by kind, as lists of frames and fragments."""
    sensor = subject.sensor
    source = subject.make_random("hostile 0")
    makers = _makers(subject)
    made = {
        name: _of_length(length, functools.partial(make, source)) for name, make in makers.items()
    }
    made["all of these in turn"] = _of_length(
        length, lambda: source.choice(list(makers.values()))(source)
    )
    seeds = itertools.cycle(range(EXAMPLES))
    frames = _of_length(length, lambda: subject.example(sensor.data_frame, seed=next(seeds)))
    announcement = sensor.frames[sensor.data_frame].after
    made["data frames"] = [subject.example(announcement), *frames] if announcement else frames
    return made


def _of_length(length: int, make: Callable[[], bytes]) -> list[bytes]:
    parts: list[bytes] = []
    size = 0
    while size < length:
        parts.append(make() or b"\0")
        size += len(parts[-1])
    return parts


def _makers(subject: SensorUnderTest) -> dict[str, Callable[[random.Random], bytes]]:
    """Return a function for each kind of stream that makes a piece of it."""
    incoming = subject.sensor.incoming
    names = list(incoming)
    after = {name: frame.after for name, frame in incoming.items()}
    announcing = sorted({name for name in after.values() if name})
    of_header = functools.cache(functools.partial(_of_random_header, subject))
    with_headers = [
        (name, seed) for name in names if of_header(name, 0) for seed in range(RANDOM_HEADERS)
    ]

    def example(source: random.Random, name: str) -> bytes:
        return subject.example(name, seed=source.randrange(EXAMPLES))

    def behind(source: random.Random, name: str, data: bytes) -> bytes:
        """Return `data`, sometimes after an announcement of its frame type."""
        announced = after[name]
        return (
            example(source, announced) + data
            if announced and not source.randrange(ANNOUNCED_INTERVAL)
            else data
        )

    def any_frame(source: random.Random) -> bytes:
        return example(source, source.choice(names))

    def announced_frame(source: random.Random) -> bytes:
        name = source.choice([name for name in names if after[name]])
        return example(source, after[name] or "") + example(source, name) * source.choice(
            (1, incoming[name].confirm)
        )

    def head(source: random.Random) -> bytes:
        name = source.choice(names)
        return behind(
            source,
            name,
            example(source, name)[: source.randint(1, MAX_HEAD_BYTES)]
            + source.randbytes(source.randint(0, MAX_NOISE_BYTES)),
        )

    def header(source: random.Random) -> bytes:
        name = source.choice(names)
        data = bytearray(source.randbytes(source.randint(MAX_HEAD_BYTES, 3 * MAX_HEAD_BYTES)))
        for spot, (mask, value) in get_codec(incoming[name]).prefix.items():
            data[spot : spot + 1] = bytes([data[spot] & ~mask | value]) if spot < len(data) else b""
        return behind(source, name, bytes(data))

    def damaged_frame(source: random.Random) -> bytes:
        name = source.choice(names)
        data = bytearray(example(source, name))
        data[source.randrange(len(data))] ^= 1 << source.randrange(8)
        return behind(source, name, bytes(data))

    makers: dict[str, Callable[[random.Random], bytes]]
    makers = {
        "frames of all types": any_frame,
        "heads of frames": head,
        "random headers": header,
        "damaged frames": damaged_frame,
    }
    if announcing:
        makers |= {
            "announcements": lambda source: example(source, source.choice(announcing)),
            "announced frames": announced_frame,
        }
    if with_headers:
        makers["frames with random headers"] = lambda source: of_header(
            *source.choice(with_headers)
        )
    return makers


def _of_random_header(subject: SensorUnderTest, name: str, seed: int) -> bytes:
    """Return a frame with a random header.

    Returns no bytes if the type has one layout, or if no such frame can be generated.
    """
    engine = get_codec(subject.sensor.frames[name])
    if isinstance(engine, CompiledCodec) and engine.size is None:
        with contextlib.suppress(SpecError):
            return random_frame(
                subject.sensor,
                name,
                subject.make_random(f"header {seed} of {name}"),
                subject.drawers(name),
            )
    return b""
