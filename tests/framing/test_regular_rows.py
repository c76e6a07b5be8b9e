"""Tests that consecutive frames are found without a search.

The frames and counters equal those of the search.
"""

from __future__ import annotations

import dataclasses
import random

import numpy as np
import pytest
from construct import Bytes, Const, Struct

from lidarspec.frames.row_checksums import MAX_TABLE_BYTES, MAX_TABLE_ROW_BYTES, compute_registers
from lidarspec.framing.regular_rows import SMALL_PIECE_BYTES
from lidarspec.framing.results import Frames
from lidarspec.simulation.simulator import make_opening_frame, simulate
from lidarspec.spec import Checksummed, Frame, Xor
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.engine.streams import Books, damage
from tests.representatives import load_sensor
from tests.shapes import SHAPES

TWINS = SHAPES["shape-twins"]
#: the short type first: it begins where each of the long ones does.
SHORT_FIRST = dataclasses.replace(
    TWINS, id="shape-short-first", frames=dict(reversed(TWINS.frames.items()))
)
STREAMS = {name: sensor for name, sensor in SHAPES.items() if not sensor.datagrams} | {
    SHORT_FIRST.id: SHORT_FIRST
}

#: Streams that are tried in the quick tier: of each way to find frames.
QUICK_STREAMS = (
    "shape-count",
    "shape-bits",
    "shape-weak",
    "shape-twins",
    SHORT_FIRST.id,
    "shape-modes",
    "shape-options",
    "shape-text",
)


def split_randomly(data: bytes, size: int, seed: int) -> list[bytes]:
    """Return a stream in random pieces of up to five frames."""
    source, found = random.Random(seed), []
    while data:
        step = source.randint(1, 5 * size)
        found.append(data[:step])
        data = data[step:]
    return found


def is_steady(frames: Frames) -> bool:
    """Return whether frames were found in rows, without a search."""
    return isinstance(frames.places, range)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK_STREAMS else pytest.mark.slow)
        for name in STREAMS
    ],
)
@pytest.mark.parametrize("rate", [0.0, pytest.param(1e-3, marks=pytest.mark.soak), 5e-3])
def test_small_pieces_give_the_same_frames(name: str, rate: float) -> None:
    sensor = STREAMS[name]
    size = min(frame.max_length for frame in sensor.incoming.values())
    for seed in range(1 if rate == 0 else 2):
        other = SensorUnderTest(sensor).stream(seed=seed, rounds=1)
        train = sensor.example(sensor.data_frame, seed=seed) * 12 + other
        train += (
            b"".join(sensor.example(sensor.data_frame, seed=number) for number in range(20)) + other
        )
        data = damage(train, rate, seed)
        whole = Books(sensor).feed(data)
        expected = whole.finish()
        parts = Books(sensor)
        for piece in split_randomly(data, size, seed):
            parts.feed(piece)
        assert parts.finish() == expected
        assert parts.decoder.stats == whole.decoder.stats


def test_clean_frames_are_found_so() -> None:
    data = b"".join(TWINS.example("data", seed=seed) for seed in range(40))
    decoder = TWINS.decoder()
    found = [frames for piece in split_randomly(data, 18, 1) for frames in decoder.frames(piece)]
    assert sum(is_steady(frames) for frames in found) > 5
    assert sum(map(len, found)) == 40


def test_weak_frames_are_searched_for_in_the_first_bytes_alone() -> None:
    sensor = load_sensor("slamtec-rplidar-a1").configure(answer="node")
    data = make_opening_frame(sensor) + b"".join(simulate(sensor, 20_000))
    found = sensor.decoder().frames(data)
    steady = sum(frames.total_bytes for frames in found if is_steady(frames))
    assert steady > len(data) - 10_000


@pytest.mark.parametrize("faults", [0, 2, 40])
def test_long_pieces_are_taken_up_to_the_first_damage(faults: int) -> None:
    source = random.Random(faults)
    frames = [TWINS.example("data", seed=seed) for seed in range(40)]
    data = bytearray(b"".join(source.choice(frames) for _ in range(60_000)))
    for _ in range(faults):
        spot = source.randrange(len(data))
        data[spot : spot + source.randrange(2)] = source.randbytes(source.randint(0, 30))
    whole, parts = TWINS.decoder(), TWINS.decoder()
    found = [*whole.frames(bytes(data)), *whole.take_pending()]
    pieces = [
        spans
        for start in range(0, len(data), 5000)
        for spans in parts.frames(bytes(data[start : start + 5000]))
    ]
    pieces += parts.take_pending()
    for name in ("offsets", "gaps", "kinds"):
        assert (
            np.concatenate([getattr(one, name) for one in found]).tolist()
            == np.concatenate([getattr(one, name) for one in pieces]).tolist()
        )
    assert whole.stats == parts.stats
    longest = max(len(spans) * len(frames[0]) for spans in found if is_steady(spans) or faults > 2)
    assert longest > SMALL_PIECE_BYTES


def test_a_type_that_comes_first_is_looked_for_at_each_frame() -> None:
    frames = []
    for number in range(40):
        angle = number * 9
        check = 0xFF ^ angle & 0xFF ^ angle >> 8  # of the short type, in the first five bytes
        first = check if number % 5 == 4 else check ^ 1
        frames.append(TWINS.build("data", angle=angle, distances=[first, 2, 3, 4, 5, 6]))
    decoder = SHORT_FIRST.decoder()
    for piece in split_randomly(b"".join(frames), 18, 1):
        decoder.frames(piece)
    assert decoder.stats.frames == {"data": 32, "info": 8}
    assert decoder.stats.bad_checksum == 0


def test_a_type_that_comes_first_is_looked_for_where_only_some_frames_begin_like_it() -> None:
    marked = Struct("magic" / Const(b"\x5a\xa5\x07"), "check" / Bytes(1))
    info = Checksummed(marked, field="check", algorithm=Xor())
    sensor = dataclasses.replace(
        TWINS,
        id="shape-some",
        frames={"info": Frame(info, max_length=4), "data": TWINS.frames["data"]},
    )
    frames = [
        TWINS.build("data", angle=angle, distances=[1, 2, 3, 4, 5, 6])
        for angle in (7, 8, 263, 9, 0xF807, 10) * 4
    ]
    decoder = sensor.decoder()
    for start in range(0, len(frames), 3):
        decoder.frames(b"".join(frames[start : start + 3]))
    assert decoder.stats.frames == {"data": 20, "info": 4}
    assert decoder.stats.bad_checksum == 0


def test_impossible_candidates_do_not_wait() -> None:
    frame = TWINS.example("data", seed=1)
    decoder = TWINS.decoder()
    decoder.frames(frame * 3)
    decoder.frames(frame * 3 + bytes(10))
    assert (decoder.stats.pending, decoder.stats.bytes_skipped) == (0, 10)


def test_a_shorter_last_frame_is_returned_at_once() -> None:
    count = SHAPES["shape-count"]
    long, short = (
        count.build("data", first=0, last=9, samples=[dict(distance=1, quality=2)] * number)
        for number in (9, 2)
    )
    decoder = count.decoder()
    decoder.frames(long * 3)
    assert sum(map(len, decoder.frames(long * 3 + short))) == 4


@pytest.mark.parametrize("width", [3, 8, 16, 24, 32, 64])
@pytest.mark.parametrize("refin", [False, True])
def test_few_rows_have_the_registers_that_many_have(width: int, refin: bool) -> None:
    source = np.random.default_rng(width)
    poly = int(source.integers(1 << (width - 1))) | 1
    start = (1 << width) - 1 if refin or width % 8 == 0 else 0
    for length in (1, 7, 8, 9, 46, MAX_TABLE_ROW_BYTES):
        many = source.integers(0, 256, (MAX_TABLE_BYTES // length + 1, length + 2), dtype=np.uint8)
        spans = ((0, 1), (2, length + 1)) if length > 1 else ((1, 2),)
        together = compute_registers(many, spans, start, width, poly, refin)
        assert (
            compute_registers(many[:5], spans, start, width, poly, refin).tolist()
            == together[:5].tolist()
        )
