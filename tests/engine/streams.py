"""Streams for tests of framing, with seeded damage or false headers.

The module also has decoders that check their counters, and measures the memory of a task.
"""

from __future__ import annotations

import contextlib
import gc
import random
import tracemalloc
from collections.abc import Callable, Iterator

from lidarspec import Counters, Sensor, SpecError
from lidarspec.framing.example_frames import make_random_header, random_frame
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.agreement import cuts
from tests.by_construct import reader
from tests.engine.oracle import Cut

#: Approximate bytes of a stream; the oracle is slow.
LENGTH = 800
MEGABYTE = 1 << 20
MANY_HEADERS = 200
#: Sizes in bytes of the chunks that a stream is cut into.
CHUNK_SIZES = (0, 1, 1, 2, 3, 7, 20, 100, 1000)


def cut_randomly(data: bytes, source: random.Random) -> Iterator[bytes]:
    """Yield the bytes in chunks of random sizes, including empty chunks."""
    start = 0
    while start < len(data):
        size = source.choice(CHUNK_SIZES)
        yield data[start : start + size]
        start += size


def damage(data: bytes, rate: float, seed: int, *, burst: int = 1) -> bytes:
    """Return the stream with about this share of its bytes damaged, in runs of `burst`.

    There is at least one run, unless the rate is 0.
    """
    if not rate:
        return data
    source = random.Random(f"{seed} {rate} {burst}")
    number = max(1, round(len(data) * rate / burst))
    found = bytearray(data)
    for _ in range(number):
        spot = source.randrange(len(found) + 1)
        kind = source.choice(("drop", "flip", "insert"))
        noise = source.randbytes(burst)
        if kind == "drop":
            del found[spot : spot + burst]
        elif kind == "insert":
            found[spot:spot] = noise
        else:
            found[spot : spot + burst] = bytes(
                a ^ (1 << b % 8) for a, b in zip(found[spot : spot + burst], noise, strict=False)
            )
    return bytes(found)


def worst(sensor: Sensor, length: int) -> bytes:
    """Return the most expensive candidates: headers with the maximum length.

    Each header is followed by two random bytes, so no candidate is complete.
    """
    source = random.Random(sensor.id)
    longest = max((sensor.example(sensor.main_frames[0], seed=seed) for seed in range(40)), key=len)
    unit = b"".join(longest[: source.randint(3, 8)] + source.randbytes(2) for _ in range(64))
    return (unit * (length // len(unit) + 1))[:length]


#: Random bytes behind a header, in streams of headers and random bytes.
NOISE_BYTES = (0, 2, 6)


def hostile_streams(subject: SensorUnderTest, length: int) -> Iterator[tuple[str, bytes]]:
    """Yield streams that are expensive to decode, each with a description.

    They have about `length` bytes. A stream of one frame type with `after` begins with the frame
    that activates the type.
    """
    sensor = subject.sensor
    source = random.Random(sensor.id)
    names = list(sensor.incoming)
    for name in names:
        after = sensor.frames[name].after
        lead = b"" if after is None else subject.example(after)
        frames = [subject.example(name, seed=seed) for seed in range(6)]
        longest = max(frames, key=len)
        for size in NOISE_BYTES:
            headers = _repeat(
                lambda name=name, size=size: _header(sensor, name, source) + source.randbytes(size),
                length,
            )  # type: ignore[misc]
            yield f"headers of {name} and {size} random bytes", lead + headers
        one_length = _repeat(
            lambda longest=longest: longest[: source.randint(3, 8)] + source.randbytes(2), length
        )  # type: ignore[misc]
        yield f"headers of one length of {name}", lead + one_length
        yield (
            f"truncated frames of the type {name}",
            lead + _repeat(lambda frames=frames: _cut(source.choice(frames), source), length),
        )  # type: ignore[misc]
    yield (
        "headers of all types in turn",
        _repeat(lambda: b"".join(_header(sensor, name, source) for name in names), length),
    )
    examples = [subject.example(name, seed=seed) for name in names for seed in range(4)]
    yield (
        "truncated frames of all types",
        _repeat(lambda: _cut(source.choice(examples), source), length),
    )
    yield "types in turn", (subject.stream(rounds=2) * length)[:length]


def _repeat(make: Callable[[], bytes], length: int) -> bytes:
    """Repeat pieces to at least this size; an empty piece counts as a zero byte."""
    found = bytearray()
    while len(found) < length:
        found += make() or b"\0"
    return bytes(found)


def _header(sensor: Sensor, name: str, source: random.Random) -> bytes:
    """Return the first bytes of a frame, up to the last constant at its start.

    All other bytes are random.
    """
    prefix = get_codec(sensor.frames[name]).prefix
    header = bytearray(source.randbytes(max(prefix, default=-1) + 1))
    for offset, (mask, value) in prefix.items():
        header[offset] = header[offset] & ~mask | value
    return bytes(header)


def _cut(frame: bytes, source: random.Random) -> bytes:
    """Return the first bytes of a frame, at least one."""
    return frame[: source.randint(1, len(frame))]


def clean(subject: SensorUnderTest, *, seed: int = 0, length: int = LENGTH) -> bytes:
    """Return a conversation of about this length, at least one round."""
    rounds = max(length // max(len(subject.stream(rounds=1)), 1), 1)
    return subject.stream(seed=seed, rounds=rounds)


def longest_example(subject: SensorUnderTest, name: str, headers: int = MANY_HEADERS) -> bytes:
    """Return the longest of several examples.

    One of the examples has the longest of `headers` random headers. If `headers` is small, this
    example is left out for frames with parts, whose headers have thousands of fields.
    """
    found = [
        subject.example(name, seed=seed) for seed in range(8 if headers < MANY_HEADERS else 20)
    ]
    engine = get_codec(subject.sensor.frames[name])
    source = subject.make_random(f"longest {name}")
    is_drawn = isinstance(engine, CompiledCodec) and engine.size is None
    if is_drawn and (headers >= MANY_HEADERS or not engine.schema.parts):
        with contextlib.suppress(SpecError):
            _, longest = max(
                (make_random_header(engine, source, subject.drawers(name)) for _ in range(headers)),
                key=lambda chosen: chosen[0].size,
            )
            drawn = {path: (lambda _, value=value: value) for path, value in longest.items()}
            found.append(random_frame(subject.sensor, name, source, subject.drawers(name) | drawn))
    return max(found, key=len)


class Books:
    """A decoder that verifies its counters after every call.

    Each byte is in a frame, skipped or pending.
    """

    def __init__(self, sensor: Sensor, *, backend: str = "auto") -> None:
        self.decoder = reader(sensor, backend).decoder()
        self.found: list[Cut] = []

    def feed(self, chunk: bytes) -> Books:
        """Decode a chunk and count its bytes and frames."""
        return self._add(cuts(self.decoder.feed(chunk)))

    def finish(self) -> list[Cut]:
        """End the input; return all frames."""
        return self._add(cuts(self.decoder.finish())).found

    def _add(self, found: list[Cut]) -> Books:
        self.found += found
        stats: Counters = self.decoder.stats
        known = sum(len(data) for _, _, data in self.found)
        assert stats.bytes_in == known + stats.bytes_skipped + stats.pending
        assert sum(stats.frames.values()) == len(self.found)
        return self


def decode_chunks(sensor: Sensor, data: bytes) -> list[Cut]:
    """Decode a stream in chunks of random sizes; return its frames."""
    books = Books(sensor)
    for chunk in cut_randomly(data, random.Random(len(data))):
        books.feed(chunk)
    return books.finish()


def peak(task: Callable[[], object]) -> int:
    """Return the maximum of additional bytes that a task holds."""
    # collections are to look at what is made from here on, and not at all that the tests before
    # have left
    gc.freeze()
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        task()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
