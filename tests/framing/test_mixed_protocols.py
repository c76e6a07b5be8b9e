"""Tests of binary frames and lines of text on one connection."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from lidarspec import simulate
from lidarspec.framing.results import Found
from tests.cli.running import ran
from tests.shapes.mixed import SENSOR

FRAMES = simulate(SENSOR, 40)
STREAM = b"".join(FRAMES)


def cuts(found: list[Found]) -> list[tuple[str, int, bytes]]:
    return [(item.frame, item.offset, item.data) for item in found]


def split_in_chunks(data: bytes, *sizes: int) -> list[tuple[str, int, bytes]]:
    """Return the frames of a stream that arrives in chunks of these sizes, then the rest."""
    decoder = SENSOR.decoder()
    found: list[Found] = []
    start = 0
    for size in (*sizes, len(data)):
        found += decoder.feed(data[start : start + size])
        start += size
    return cuts(found + decoder.finish())


def test_no_byte_is_skipped() -> None:
    found = SENSOR.split(STREAM)
    assert [item.data for item in found] == FRAMES
    assert {item.frame for item in found} == {"fix", "warmth", "line"}
    stats = SENSOR.decode(STREAM, frame="line").stats
    assert (stats.bytes_skipped, stats.pending) == (0, 0)


def test_a_split_anywhere_changes_nothing() -> None:
    data = b"".join(FRAMES[:8])
    whole = cuts(SENSOR.split(data))
    for size in range(len(data)):
        assert split_in_chunks(data, size) == whole
    assert split_in_chunks(data, *[1] * len(data)) == whole


@pytest.mark.parametrize("seed", range(20))
def test_a_damaged_frame_costs_no_other(seed: int) -> None:
    """A byte of every third frame is changed to one that begins no frame."""
    source = random.Random(seed)
    damaged = []
    for number, frame in enumerate(FRAMES):
        data = bytearray(frame)
        if number % 3 == 0:
            data[source.randrange(len(data))] ^= source.choice((0x01, 0x40, 0x80))
        damaged.append(bytes(data))
    intact = [frame for number, frame in enumerate(FRAMES) if number % 3]
    found = [item.data for item in SENSOR.split(b"".join(damaged))]
    assert [frame for frame in found if frame in intact] == intact
    assert cuts(SENSOR.split(b"".join(damaged))) == split_in_chunks(
        b"".join(damaged), *[source.randrange(40) for _ in range(30)]
    )


def test_a_binary_frame_interrupts_a_line() -> None:
    line = next(frame for frame in FRAMES if frame.startswith(b"$"))
    fix = next(frame for frame in FRAMES if frame.startswith(b"\xc5\x01"))
    data = line[:9] + fix + line
    assert [item.frame for item in SENSOR.split(data)] == ["fix", "line"]
    assert SENSOR.decode(data, frame="fix").stats.bytes_skipped == 9


def test_check_is_clean() -> None:
    path = Path(__file__).parents[1] / "shapes" / "mixed.py"
    assert "clean" in ran("check", path).stdout
