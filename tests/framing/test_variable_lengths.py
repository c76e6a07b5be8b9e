"""Tests that candidates of many lengths are checked together.

The frames and counters equal those of checking layout by layout, with less work.
"""

from __future__ import annotations

import dataclasses
import random
import sys
from types import FrameType
from typing import Any

import numpy as np
import pytest
from construct import Array, Const, Int8ul, Int16ul, Struct, this

from lidarspec import Sensor
from lidarspec.framing import frame_engine, variable_lengths
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.variable_lengths import JointChecker
from lidarspec.spec import Checksummed, Crc, Fields, Frame, Simulation, Sum, WordXor
from lidarspec.spec.checksums import Checksum
from tests.engine.oracle import Oracle
from tests.engine.streams import Books, decode_chunks
from tests.shapes import SHAPES

COUNT = SHAPES["shape-count"]
MAX_SAMPLES = 40
SAMPLES = "samples" / Array(this.count, Struct("distance" / Int16ul, "quality" / Int8ul))
#: Such a number of layouts is never met.
NEVER = 1 << 30
#: False headers of a stream, and the calls of functions for each of them. Layout by layout there
#: are about 75.
HEADERS = 1200
MAX_CALLS = 20


def plausible(f: Fields) -> Any:
    """Check the first distance, and the quality of every sample."""
    return (f.first < 60_000) & (f.samples.quality < 255) & (f.samples.distance != 7)


def with_frame(struct: Any, samples: int = MAX_SAMPLES) -> Sensor:
    """Return a sensor with one frame type, which has at most `samples` samples."""
    frame = Frame(struct, max_length=10 + 3 * samples, plausible=plausible)
    return dataclasses.replace(
        COUNT,
        id="shape-made",
        frames={"data": frame},
        points=None,
        simulation=Simulation(),
        scan=None,
    )


def summed_behind(algorithm: Checksum, absent: tuple[int, ...] = ()) -> Sensor:
    """Return a sensor with the checksum at the end of its frames."""
    struct = Struct(
        "header" / Const(b"\xaa\x55"), "count" / Int8ul, "first" / Int16ul, SAMPLES, "sum" / Int16ul
    )
    return with_frame(Checksummed(struct, field="sum", algorithm=algorithm, absent=absent))


def summed_before(samples: int = MAX_SAMPLES) -> Sensor:
    """Return a sensor with the checksum before its samples."""
    struct = Struct(
        "header" / Const(b"\xaa\x55"), "count" / Int8ul, "first" / Int16ul, "sum" / Int16ul, SAMPLES
    )
    return with_frame(Checksummed(struct, field="sum", algorithm=WordXor(5, (1, 2))), samples)


SENSORS = {
    "behind": summed_behind(Sum(16)),
    "absent": summed_behind(Sum(16), absent=(0,)),
    "before": summed_before(),
    "count": COUNT,
    "sized": SHAPES["shape-sized"],
    "outer": SHAPES["shape-outer"],
}


def false_headers(sensor: Sensor, length: int, seed: int = 0) -> bytes:
    """Return headers, random lengths, whole frames and damaged frames."""
    source = random.Random(seed)
    frames = [sensor.example("data", seed=number) for number in range(40)]
    found = bytearray()
    while len(found) < length:
        frame = bytearray(source.choice(frames))
        kind = source.randrange(6)
        if kind == 0:
            frame[source.randrange(len(frame))] ^= 1 << source.randrange(8)
        elif kind > 1:
            frame = frame[:2] + source.randbytes(source.randrange(6))
        found += frame
    return bytes(found)


def books(sensor: Sensor, data: bytes, piece: int) -> tuple[list[Any], str]:
    """Return the frames, and the counters as text."""
    kept = Books(sensor)
    for start in range(0, len(data), piece):
        kept.feed(data[start : start + piece])
    return kept.finish(), str(kept.decoder.stats)


@pytest.mark.parametrize("name", SENSORS)
def test_the_frames_and_counters_are_those_of_each_layout_by_itself(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = SENSORS[name]
    checked = 0
    check = JointChecker.check

    def counting(self: JointChecker, buffer: Any, offsets: Any, forms: Any, sums: Any) -> Any:
        nonlocal checked
        checked += len(offsets)
        return check(self, buffer, offsets, forms, sums)

    monkeypatch.setattr(JointChecker, "check", counting)
    data = false_headers(sensor, 20_000)
    together = [books(sensor, data, piece) for piece in (700, 20_000)]
    assert checked > 300
    monkeypatch.setattr(variable_lengths, "MANY_LAYOUTS", NEVER)
    assert together == [books(sensor, data, piece) for piece in (700, 20_000)]


@pytest.mark.parametrize("name", ["behind", "absent", "before"])
def test_the_frames_are_those_of_brute_force(name: str) -> None:
    data = false_headers(SENSORS[name], 1500, seed=1)
    assert decode_chunks(SENSORS[name], data) == Oracle(SENSORS[name], data).frames()


def test_checksums_are_computed_for_all_lengths_at_once() -> None:
    """The checksum in each frame is regarded as correct, as in `detect`."""
    sensor = SENSORS["behind"]
    data = false_headers(sensor, 6000)
    found = []
    for layouts in (variable_lengths.MANY_LAYOUTS, NEVER):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(variable_lengths, "MANY_LAYOUTS", layouts)
            decoder = Decoder(
                sensor, stream=True, sums=lambda checksum, rows: checksum.load_stored(rows)
            )
            frames = decoder.feed(data) + decoder.finish()
            found.append(([(item.offset, item.data) for item in frames], str(decoder.stats)))
    assert found[0] == found[1]
    assert "bad_checksum" not in found[0][1]


def test_a_checksum_that_zeros_change_is_computed_length_by_length(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(JointChecker, "check", None)
    sensor = summed_behind(Crc(16, 0x1021))
    data = false_headers(sensor, 3000)
    assert books(sensor, data, 3000)[0]


def test_two_engines_of_one_frame_type_share_its_layouts() -> None:
    frame = summed_behind(Sum(16)).frames["data"]
    headers = [
        b"\xaa\x55" + bytes([count]) + bytes(3 * MAX_SAMPLES + 4) for count in range(MAX_SAMPLES)
    ]
    data = np.frombuffer(b"".join(headers), np.uint8)
    offsets = np.arange(len(headers)) * len(headers[0])
    first = frame_engine.CompiledCodec(frame)
    second = frame_engine.CompiledCodec(frame)
    # Not the layout without samples, which has fewer tests.
    some = first.survey(data, offsets[1:]).status
    every = second.survey(data, offsets).status
    assert every[1:].tolist() == some.tolist()


def test_a_false_header_costs_few_calls() -> None:
    sensor = summed_before(samples=255)
    source = random.Random(2)
    data = b"".join(b"\xaa\x55" + source.randbytes(5) for _ in range(HEADERS))
    sensor.decoder().feed(data)  # layouts are made once, and for all decoders
    calls = 0

    def count(frame: FrameType, event: str, argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    decoder = sensor.decoder()
    sys.setprofile(count)
    try:
        for start in range(0, len(data), 4096):
            decoder.feed(data[start : start + 4096])
    finally:
        sys.setprofile(None)
    assert calls < MAX_CALLS * HEADERS
