"""Tests of `convert --time`: the clocks of stamps, and changes of the source of UTC."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from tests.cli.running import ran

SECOND = 1_000_000_000


def record(path: Path, sensor: str, seconds: str, clock: str | None = None) -> Path:
    """Write a recording of a simulated sensor."""
    faults = ("--clock", clock) if clock else ()
    ran("sim", sensor, "--to", path, "-t", seconds, *faults)
    return path


def read_first_time(source: Path, time: str) -> int:
    """Return the time of the first frame in a table of frames, ns."""
    target = source.with_suffix(f".{time}.csv")
    ran("convert", source, target, "-f", "data", "-n", "1", "--time", time)
    with target.open() as table:
        (row,) = csv.DictReader(table)
    return int(row["time_ns"])


def find_changes(stderr: str) -> list[str]:
    """Return the reports about the source of UTC."""
    return [line for line in stderr.splitlines() if "UTC comes from" in line]


def test_a_lost_lock_is_reported_once(tmp_path: Path) -> None:
    """The RS-LiDAR-M1 reports the state of its clock once a second."""
    source = record(tmp_path / "m1.pcap", "robosense-m1", "1.3s", "utc,unlock@0.5s")
    words = ("-s", "robosense-m1", "--force")
    result = ran("convert", source, tmp_path / "out.bin", *words, "--time", "utc")
    (change,) = find_changes(result.stderr)
    assert "PPS lost" in change
    for time in ("sensor", "host"):
        result = ran("convert", source, tmp_path / "out.bin", *words, "--time", time)
        assert find_changes(result.stderr) == []


def test_a_clock_of_the_hour_is_completed(tmp_path: Path) -> None:
    """The VLP-16 restarts, and counts from power-up then."""
    source = record(tmp_path / "vlp16.pcap", "velodyne-vlp16", "2s", "utc,restart@1s")
    words = ("-s", "velodyne-vlp16", "--time", "utc")
    result = ran("convert", source, tmp_path / "out.bin", *words)
    (change,) = find_changes(result.stderr)
    assert "power-up" in change


def test_frames_of_a_free_clock_have_the_time_that_was_chosen(tmp_path: Path) -> None:
    source = record(tmp_path / "stl27l.lsr", "ldrobot-stl27l", "1s")
    assert read_first_time(source, "sensor") < SECOND
    utc_ns = read_first_time(source, "utc")
    assert 0 <= read_first_time(source, "host") - utc_ns < SECOND // 50
    # `read` prints the same times.
    printed = ran("read", source, "--packets", "-n", "1", "--json", "--time", "utc")
    assert json.loads(printed.stdout.splitlines()[0])["time_ns"] == utc_ns


@pytest.mark.parametrize(
    ("name", "sensor", "advice"),
    [
        ("drive.bin", "ldrobot-stl27l", "--time sensor"),  # without arrival times
        ("drive.lsr", "cspc-m1c1-mini", "--time host"),  # without a clock
    ],
)
def test_unknown_utc_is_an_error_with_advice(
    tmp_path: Path, name: str, sensor: str, advice: str
) -> None:
    source = record(tmp_path / name, sensor, "1s")
    target = tmp_path / "out.csv"
    refused = ran("convert", source, target, "-s", sensor, "--time", "utc", code=2)
    assert refused.stderr.splitlines()[-1].startswith(f"  next: repeat with {advice}")
    assert not target.exists()
