"""Tests that a time in a recording is found without reading the records before it."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest

from lidarspec.recording.format import MARK, MAX_DATA_BYTES, RECEIVED, Recording, pack_record
from lidarspec.recording.recorders import Recorder
from lidarspec.transports.files import RecordingTransport
from lidarspec.transports.protocol import Chunk

START, STEP, NUMBER = 10**18, 10**7, 4000


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of 40 s, whose pieces of 300 bytes begin like a record."""
    path = tmp_path_factory.mktemp("recording") / "drive.lsr"
    with Recorder(path, datagrams=True) as target:
        for number in range(NUMBER):
            target.wait_for_room()
            target.write(
                Chunk(MARK + number.to_bytes(4, "big") + bytes(292), START + number * STEP)
            )
            target.write(Chunk(b"asked", START + number * STEP), "out")
    return path


@pytest.mark.parametrize("number", [2000, 3900, NUMBER, 10 * NUMBER])
def test_seeking_reads_everything_after_a_time_and_little_before(
    recording: Path, number: int
) -> None:
    with Recording(recording) as file:
        first = next(iter(file))
        assert file.seek(START + number * STEP)
        left = [record for record in file if record.direction == "in"]
    assert first.at == START
    assert left[0].at is not None
    assert left[0].at <= START + min(number, NUMBER - 1) * STEP
    assert left[-1].at == START + (NUMBER - 1) * STEP
    assert [record.at for record in left] == [left[0].at + step * STEP for step in range(len(left))]
    assert len(left) * 340 < (NUMBER - min(number, NUMBER)) * 340 + 4 * MAX_DATA_BYTES + (1 << 17)


def test_seeking_interrupts_the_stream(recording: Path) -> None:
    with contextlib.closing(RecordingTransport(recording)) as source:
        chunks = source.chunks()
        assert not next(chunks).gap
        assert source.skip_until(START + 3000 * STEP)
        assert [chunk.gap for chunk in chunks].index(True) == 0
        assert not source.skip_until(START)


def test_a_damaged_place_in_the_middle_is_no_hindrance(recording: Path, tmp_path: Path) -> None:
    data = bytearray(recording.read_bytes())
    for place in range(len(data) // 4, len(data) * 3 // 4, 5000):
        data[place] ^= 0xFF
    damaged = tmp_path / "damaged.lsr"
    damaged.write_bytes(data)
    with Recording(damaged, salvage=True) as file:
        assert file.seek(START + 3800 * STEP)
        times = [record.at for record in file if record.direction == "in"]
    assert times[0] is not None
    assert times[0] <= START + 3800 * STEP
    assert times[-1] == START + (NUMBER - 1) * STEP


def test_seeking_to_a_passed_or_unknown_time_does_nothing(recording: Path, tmp_path: Path) -> None:
    with Recording(recording) as file:
        assert not file.seek(START - STEP)
        assert sum(record.direction == "in" for record in file) == NUMBER
    timeless = tmp_path / "timeless.lsr"
    timeless.write_bytes(
        recording.read_bytes()[: recording.read_bytes().index(MARK, 12)]
        + pack_record(RECEIVED, bytes(300)) * 2000
    )
    with Recording(timeless) as file:
        assert not file.seek(START + STEP)
        assert sum(record.direction == "in" for record in file) == 2000
