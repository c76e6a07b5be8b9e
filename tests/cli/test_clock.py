"""Tests of `clock` on recordings: its verdicts, exit codes, and several sources."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.cli import clock
from lidarspec.spec import Chunk
from tests.cli.running import ran
from tests.evidence import capture

ID = "livox-mid360"
BEGAN_NS = 1_767_000_000 * 10**9
PERIOD_NS = 10_000_000
DELAY_NS = 300_000
TAI_NS = 37 * 10**9


def record(path: Path, *, ahead_ns: int, time_type: int = 1, seconds: int = 2) -> Path:
    """Write a recording of a sensor whose clock is ahead of the host's, and return its path."""
    sensor = ls.sensor(ID)
    frame = sensor.parse(ls.simulate(sensor, 1)[0], sensor.data_frame)
    frame.time_type = time_type
    with ls.Recorder(path, ID, "udp://") as recorder:
        for number in range(seconds * 10**9 // PERIOD_NS):
            now_ns = BEGAN_NS + number * PERIOD_NS
            frame.timestamp = now_ns + ahead_ns
            frame.udp_cnt = number
            data = sensor.build(sensor.data_frame, frame)
            recorder.write(Chunk(data, now_ns + DELAY_NS, ("192.168.1.100", 56_300)))
    return path


@pytest.mark.parametrize(
    ("ahead_ns", "time_type", "options", "verdict"),
    [
        (TAI_NS, 1, (), "ok"),
        (0, 1, (), "utc"),
        (0, 1, ("-s", ID, "-O", "epoch=utc"), "ok"),
        (TAI_NS, 1, ("-s", ID, "-O", "epoch=utc"), "tai"),
        (0, 2, (), "ok"),
        (TAI_NS, 0, (), "not_locked"),
    ],
)
def test_the_verdict_and_the_exit_code(
    tmp_path: Path, ahead_ns: int, time_type: int, options: tuple[str, ...], verdict: str
) -> None:
    path = record(tmp_path / "drive.lsr", ahead_ns=ahead_ns, time_type=time_type)
    code = 0 if verdict == "ok" else 1
    report = json.loads(ran("clock", path, "--json", *options, code=code).stdout)
    assert report["findings"][0]["code"] == verdict
    assert (report["packets"], report["sensor"]) == (200, ID)
    text = ran("clock", path, *options, code=code).stdout
    assert report["findings"][0]["text"] in text
    assert report["findings"][0]["advice"] in text


def test_sources_are_compared_with_the_first(tmp_path: Path) -> None:
    first = record(tmp_path / "first.lsr", ahead_ns=TAI_NS)
    second = record(tmp_path / "second.lsr", ahead_ns=2_000_000, time_type=2)
    lines = ran("clock", first, second, "--json").stdout.splitlines()
    reports = [json.loads(line) for line in lines]
    assert [report["source"] for report in reports] == [str(first), str(second)]
    assert reports[0]["to_first_s"] is None
    assert reports[1]["to_first_s"] == pytest.approx(2e-3, abs=1e-6)
    assert "+2.00 ms from the first source" in ran("clock", first, second).stdout


def test_a_live_source_ends_beside_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a duration, a file is read to its end, and a live source for a limited time."""
    monkeypatch.setattr(clock, "DEFAULT_DURATION_S", 1.0)
    path = record(tmp_path / "drive.lsr", ahead_ns=TAI_NS)
    lines = ran("clock", path, f"sim:{ID}", "--json", code=1).stdout.splitlines()
    packets = [json.loads(line)["packets"] for line in lines]
    assert packets[0] == 200
    assert packets[1] > 0


def test_stats_and_doctor_report_the_clock(tmp_path: Path) -> None:
    path = record(tmp_path / "drive.lsr", ahead_ns=0)
    stats = ran("stats", path)
    assert "runs on UTC, but the declared epoch is TAI" in stats.stdout
    summary = json.loads(ran("stats", path, "--json").stdout.splitlines()[-1])
    assert summary["clock"]["findings"][0]["code"] == "utc"
    diagnoses = json.loads(ran("doctor", path, "--json", code=1).stdout)
    assert [one["ok"] for one in diagnoses] == [True, False]


def test_a_clock_that_nothing_sets_is_no_problem_for_doctor(tmp_path: Path) -> None:
    path = record(tmp_path / "drive.lsr", ahead_ns=-BEGAN_NS, time_type=0)
    diagnoses = json.loads(ran("doctor", path, "--json").stdout)
    assert all(one["ok"] for one in diagnoses)
    assert "not synchronized" in diagnoses[-1]["text"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "verdict", "state"),
    [
        ("velodyne/vlp16_old_firmware/vlp-16-test-90deg-1-50-frames.pcap", "not_locked", "no PPS"),
        ("robosense/helios16p/packets.derived.pcap", "not_locked", "internal clock"),
        ("hesai/xt32/packets.derived.pcap", "wrong_date", ""),
        ("hesai/qt64/packets.derived.pcap", "wrong_date", ""),
    ],
)
def test_the_verdict_on_a_capture_agrees_with_its_status(
    name: str, verdict: str, state: str
) -> None:
    report = json.loads(ran("clock", capture(name), "--json", code=1).stdout)
    assert report["findings"][0]["code"] == verdict
    assert report["state"] == state
