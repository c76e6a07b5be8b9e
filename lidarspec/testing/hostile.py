"""Hostile streams: what costs a sensor's frames most to find, made of its own frames, and what they
cost.

The engine's work is linear in the input, whatever that is; how much a byte costs depends on the
declaration, on frame types that follow one another, on headers that make a new layout each, on
functions of the author's own that are called for every false header. So streams are made for each
sensor of all that: frames of all types in any order, announcements alone and with what they
announce, heads of frames, random headers, damaged frames, and of all of these in turn. Their cost
is counted, in function calls and in bytes of memory: a time would depend on what else the machine
does.
"""

from __future__ import annotations

import contextlib
import cProfile
import functools
import gc
import itertools
import random
import tracemalloc
from collections.abc import Callable

from lidarspec.errors import SpecError
from lidarspec.framing.examples import random_frame
from lidarspec.framing.frame_engine import CompiledCodec, codec
from lidarspec.framing.results import Frames
from lidarspec.spec.sensor import Sensor
from lidarspec.testing.findings import require
from lidarspec.testing.subject import Subject

#: bytes of a stream, with the usual number of examples, and at least.
LENGTH = 12_000
LEAST_LENGTH = 4_000
#: function calls that a stream may take per byte. The engine needs up to 16 for the sensors that
#: exist, and 40 where construct reads every frame.
MAX_CALLS_PER_BYTE = 100
#: bytes of memory that frames may be kept in per byte of the stream.
MAX_KEPT_PER_BYTE = 64
#: seeds of the examples that streams are made of, with the usual number of examples, and at least.
SEEDS = 6
LEAST_SEEDS = 3
#: frames with random headers, bytes of a head, and of noise behind it.
HEADERS, HEAD, NOISE = 60, 12, 3
#: one in so many frames comes behind its announcement, where the others of its type need one.
ANNOUNCED = 40


def no_stream_costs_much_more_than_frames(subject: Subject) -> None:
    """No stream takes more than 100 function calls for each of its bytes, or is kept in more than
    64 bytes of memory.
    """
    length = min(subject.scale_rounds(LENGTH, LEAST_LENGTH), LENGTH)
    first = streams(subject, length=length)
    calls = {name: calls_per_byte(subject.sensor, parts) for name, parts in first.items()}
    dear = [name for name in calls if calls[name] >= MAX_CALLS_PER_BYTE]
    # a second stream does not pay for layouts that the engine remembers, and its own layouts are
    # others
    if dear:
        second = streams(subject, seed=1, length=length)
        calls |= {
            name: min(calls[name], calls_per_byte(subject.sensor, second[name])) for name in dear
        }
    name = max(calls, key=lambda name: calls[name])
    subject.measured["the dearest stream"] = f"{name}, {calls[name]:.1f} calls a byte"
    require(
        calls[name] < MAX_CALLS_PER_BYTE,
        "LS416",
        f"{name}: {calls[name]:.0f} function calls for each byte",
    )
    held, name = max(
        (kept_per_byte(subject.sensor, first[name]), name) for name in calls if name != SMOOTH
    )
    require(held < MAX_KEPT_PER_BYTE, "LS416", f"{name}: {held:.0f} bytes are kept for each byte")


SMOOTH = "data frames"


def streams(subject: Subject, seed: int = 0, *, length: int = LENGTH) -> dict[str, list[bytes]]:
    """Streams of at least so many bytes by what they are made of, in pieces: frames, and what looks
    like them; one of data frames alone.
    """
    source, makers = subject.source(f"hostile {seed}"), _makers(subject)
    found = {
        name: _of_length(length, functools.partial(make, source)) for name, make in makers.items()
    }
    found["all of these in turn"] = _of_length(
        length, lambda: source.choice(list(makers.values()))(source)
    )
    sensor = subject.sensor
    data = sensor.frames[sensor.data_frame]
    seeds = itertools.cycle(range(_seeds(subject)))
    frames = _of_length(length, lambda: subject.example(sensor.data_frame, seed=next(seeds)))
    return {**found, SMOOTH: [*([subject.example(data.after)] if data.after else []), *frames]}


def calls_per_byte(sensor: Sensor, parts: list[bytes]) -> float:
    """Return how many function calls it takes to find the frames of a stream, per byte.

    Calls of functions written in C count too; the work inside one of them does not.
    """
    profile = cProfile.Profile()
    collects = gc.isenabled()
    gc.disable()  # a collection calls the finalizers of whatever else the program keeps
    profile.enable()
    try:
        _frames(sensor, parts)
    finally:
        profile.disable()
        if collects:
            gc.enable()
    return sum(entry.callcount for entry in profile.getstats()) / sum(map(len, parts))


def kept_per_byte(sensor: Sensor, parts: list[bytes]) -> float:
    """Return how many bytes the frames of a stream take, apart from its own bytes, per byte.

    If these are too many, the stream is read again, because layouts that the engine remembers count
    only the first time.
    """
    length = sum(map(len, parts))
    gc.freeze()  # collections are to look at what is made from here on, and at nothing else
    tracemalloc.start()
    try:
        held = _held(sensor, parts)
        if held >= MAX_KEPT_PER_BYTE * length:
            held = min(held, _held(sensor, parts))
        return held / length
    finally:
        tracemalloc.stop()
        gc.unfreeze()


def _held(sensor: Sensor, parts: list[bytes]) -> int:
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    found = _frames(sensor, parts)
    gc.collect()
    return (tracemalloc.get_traced_memory()[0] - before) * bool(found)


def _frames(sensor: Sensor, parts: list[bytes]) -> list[Frames]:
    decoder = sensor.decoder()
    return (
        [decoder.datagrams(parts)]
        if sensor.datagrams
        else [*decoder.frames(b"".join(parts)), *decoder.rest()]
    )


def _seeds(subject: Subject) -> int:
    """Return how many examples of each frame type streams are made of."""
    return min(subject.scale_rounds(SEEDS, LEAST_SEEDS), SEEDS)


def _of_length(length: int, make: Callable[[], bytes]) -> list[bytes]:
    parts, size = list[bytes](), 0
    while size < length:
        parts.append(make() or b"\0")
        size += len(parts[-1])
    return parts


def _makers(subject: Subject) -> dict[str, Callable[[random.Random], bytes]]:
    """What makes a piece of each kind of stream."""
    incoming = subject.sensor.incoming
    names, after = list(incoming), {name: frame.after for name, frame in incoming.items()}
    announcing = sorted({name for name in after.values() if name})
    of_header = functools.cache(functools.partial(_of_random_header, subject))
    seeds = _seeds(subject)
    with_headers = [(name, seed) for name in names if of_header(name, 0) for seed in range(HEADERS)]

    def example(source: random.Random, name: str) -> bytes:
        return subject.example(name, seed=source.randrange(seeds))

    def behind(source: random.Random, name: str, data: bytes) -> bytes:
        """Some bytes like a frame, once in a while behind the announcement that they need."""
        announced = after[name]
        return (
            example(source, announced) + data
            if announced and not source.randrange(ANNOUNCED)
            else data
        )

    def any_frame(source: random.Random) -> bytes:
        return example(source, source.choice(names))

    def announced(source: random.Random) -> bytes:
        name = source.choice([name for name in names if after[name]])
        return example(source, after[name] or "") + example(source, name) * source.choice(
            (1, incoming[name].confirm)
        )

    def head(source: random.Random) -> bytes:
        name = source.choice(names)
        return behind(
            source,
            name,
            example(source, name)[: source.randint(1, HEAD)]
            + source.randbytes(source.randint(0, NOISE)),
        )

    def header(source: random.Random) -> bytes:
        name = source.choice(names)
        data = bytearray(source.randbytes(source.randint(HEAD, 3 * HEAD)))
        for spot, (mask, value) in codec(incoming[name]).prefix.items():
            data[spot : spot + 1] = bytes([data[spot] & ~mask | value]) if spot < len(data) else b""
        return behind(source, name, bytes(data))

    def damaged(source: random.Random) -> bytes:
        name = source.choice(names)
        data = bytearray(example(source, name))
        data[source.randrange(len(data))] ^= 1 << source.randrange(8)
        return behind(source, name, bytes(data))

    makers: dict[str, Callable[[random.Random], bytes]]
    makers = {
        "frames of all types": any_frame,
        "heads of frames": head,
        "random headers": header,
        "damaged frames": damaged,
    }
    if announcing:
        makers |= {
            "announcements": lambda source: example(source, source.choice(announcing)),
            "what was announced": announced,
        }
    if with_headers:
        makers["frames with random headers"] = lambda source: of_header(
            *source.choice(with_headers)
        )
    return makers


def _of_random_header(subject: Subject, name: str, seed: int) -> bytes:
    """A frame of a type whose header says how long it is, or what is in it; none where it is not
    so, or only those along the sweep are.
    """
    engine = codec(subject.sensor.frames[name])
    if isinstance(engine, CompiledCodec) and engine.size is None:
        with contextlib.suppress(SpecError):
            return random_frame(
                subject.sensor,
                name,
                subject.source(f"header {seed} of {name}"),
                subject.drawers(name),
            )
    return b""
