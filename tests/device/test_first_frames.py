"""Tests that the first clock reference in a file applies from the start of the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Recorder, simulate
from lidarspec.transports.protocol import Chunk
from tests.representatives import load_sensor
from tests.shapes.paced import FAST_S, TURN_S

PACED = load_sensor("shape-paced")
#: the minute since 1970 that position frames tell, and its first second.
MINUTES = 12_000_000
BEGIN_S = MINUTES * 60
#: number of the first packet behind the whole minute, 10 s into it.
FIRST = round((TURN_S + 10) / FAST_S)


def position(second: float, minutes: int) -> bytes:
    return PACED.build("position", seconds=second, micros=0, minutes=minutes, units=True)


def write_recording(path: Path, frames: list[tuple[float, bytes]]) -> Path:
    """Write frames with the seconds of their arrival."""
    with Recorder(path, PACED) as recorder:
        for second, data in frames:
            recorder.write(Chunk(data, 10**18 + round(second * 1e9)))
    return path


def stamps(path: Path) -> np.ndarray:
    """Return the stamps of the scans of a file, seconds since 1970."""
    with ls.open(path, PACED) as device:
        return np.array([scan.stamp_ns * 1e-9 for scan in device.scans()])


@pytest.mark.parametrize("before", [3, 100])
def test_packets_before_the_first_position_have_its_date(tmp_path: Path, before: int) -> None:
    data = simulate(PACED, 200, start=FIRST)
    told = position(10 + before * FAST_S, MINUTES)
    frames = [(number * FAST_S, frame) for number, frame in enumerate(data)]
    path = write_recording(
        tmp_path / "gps.lsr", [*frames[:before], (before * FAST_S, told), *frames[before:]]
    )
    found = stamps(path)
    assert found[0] == pytest.approx(BEGIN_S + 10)
    assert np.all(np.diff(found) < 1)


def test_a_reference_more_than_half_a_turn_later_is_placed_by_arrival(tmp_path: Path) -> None:
    """The clock wraps once a minute; the position comes 50 s after the first packet."""
    early = [
        (number * FAST_S, frame) for number, frame in enumerate(simulate(PACED, 60, start=FIRST))
    ]
    later = [
        (50 + second, frame)
        for second, frame in enumerate(simulate(PACED, 3, start=FIRST + round(50 / FAST_S)))
    ]
    told = position(0.0, MINUTES + 1)
    path = write_recording(tmp_path / "late.lsr", [*early, (50.0, told), *later])
    assert stamps(path)[0] == pytest.approx(BEGIN_S + 10)


def test_decoded_datagrams_have_the_date_of_the_first_position() -> None:
    data = simulate(PACED, 60, start=FIRST)
    packets = PACED.decode([*data[:40], position(10 + 40 * FAST_S, MINUTES), *data[40:]])
    assert packets.time_ns[0] == pytest.approx((BEGIN_S + 10) * 10**9)
    assert not packets.stats.undated
