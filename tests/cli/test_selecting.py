"""Tests that the selection options work in every verb that reads.

An empty selection gives one line, and no file is written.
"""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from lidarspec.recording.format import Recording
from tests.cli.running import EXAMPLE, ran, run_json

ID = "velodyne-vlp16"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of two seconds: 21 complete scans and partial ones."""
    path = tmp_path_factory.mktemp("drive") / "drive.lsr"
    ran("sim", ID, "--to", path, "-t", "2s")
    return path


def test_convert_writes_the_selection(drive: Path, tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    words = (
        "--slice",
        "500ms:1.5s",
        "--every",
        "4",
        "--range",
        "1.5m:300cm",
        "--columns",
        "range,ring",
    )
    assert "of 3 scans" in ran("convert", drive, target, *words).stderr
    with target.open(encoding="ascii", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["range", "ring", "scan"]
    ranges = [float(row["range"]) for row in rows]
    assert 1.5 <= min(ranges) < max(ranges) <= 3
    assert (
        run_json("convert", drive, tmp_path / "all.npz", "--scans", "3:5", "--all")["points"]
        == 57888
    )


def test_an_organised_scan_is_rows_and_columns(drive: Path, tmp_path: Path) -> None:
    words = ("--organized", "--scans", "3:4", "--range", ":3m")
    for name in ("out.npy", "out.npz", "out.pcd", "scans-%d.npy"):
        ran("convert", drive, tmp_path / name, *words)
    array = np.load(tmp_path / "out.npy")
    height, width = array.shape
    assert (height, width) == (16, 1808)
    assert array.shape == np.load(tmp_path / "scans-0.npy").shape
    with np.load(tmp_path / "out.npz") as arrays:
        np.testing.assert_array_equal(arrays["x"], array["x"])
    assert (array["ring"] == array["ring"][:, :1]).all()
    assert sorted(array["ring"][:, 0]) == list(range(16))
    assert 0 < np.isnan(array["x"]).sum() < array.size
    assert b"WIDTH 1808\nHEIGHT 16\n" in (tmp_path / "out.pcd").read_bytes()[:1000]


def test_messages_have_the_beams_and_the_frame(tmp_path: Path) -> None:
    rosbags = pytest.importorskip("rosbags.highlevel")
    source, target = tmp_path / "in.lsr", tmp_path / "out.bag"
    ran("sim", "ldrobot-stl27l", "--to", source, "-t", "1s")
    ran("convert", source, target, "--beams", "450", "--frame-id", "front", "--time", "host")
    with rosbags.AnyReader([target]) as log:
        messages = [
            log.deserialize(raw, link.msgtype) for link, _, raw in log.messages(log.connections)
        ]
    assert {message.header.frame_id for message in messages} == {"front"}
    planar = [message for message in messages if hasattr(message, "ranges")]
    assert {len(message.ranges) for message in planar} == {450}
    assert all(message.time_increment < 0 for message in planar)
    assert planar[0].header.stamp.sec > 10**9


@pytest.mark.slow
def test_every_verb_takes_the_same_slice(drive: Path, tmp_path: Path) -> None:
    rows = [
        json.loads(line)
        for line in ran(
            "read", drive, "--slice", "1s:1.02s", "--columns", "x", "--json"
        ).stdout.splitlines()
    ]
    assert {row["scan"] for row in rows} == {0}
    assert {*rows[0]} == {"scan", "x"}
    packets = [
        json.loads(line)
        for line in ran(
            "read", drive, "--packets", "--slice", "1s:1.02s", "--json"
        ).stdout.splitlines()
    ]
    assert 13 < len(packets) < 17
    figures = json.loads(
        ran("stats", drive, "--slice", "1s:1.5s", "--json").stdout.splitlines()[-1]
    )
    assert figures["scans"] == 5
    assert 370 < figures["packets"] < 380
    for selecting in (
        ["--slice", "1s:1.5s", "--range", ":2m"],
        ["--scans", "12:13", "--range", ":2m"],
    ):
        assert re.search(
            r"\.\.1\.9\d m, complete\); colours: range 0 to 2 m",
            ran("view", drive, "--once", *selecting).stdout,
        )
        ran("plot", drive, "-o", tmp_path / "out.svg", *selecting)
    frames = run_json("parse", drive, "--slice", "1s:1.02s")["frames"]
    assert [frame["frame"] for frame in frames].count("data") in range(13, 17)
    assert len(run_json("explain", drive, "--slice", "1s:1.02s")["frames"]) == len(frames)
    ran("replay", drive, "--to", tmp_path / "part.lsr", "--slice", "500ms:1s")
    with Recording(drive) as whole, Recording(tmp_path / "part.lsr") as part:
        records = list(whole)
        first = records[0].at or 0
        assert list(part) == [
            record for record in records if 5 * 10**8 <= (record.at or 0) - first < 10**9
        ]


@pytest.mark.parametrize("columns", ["", "x,,y", "x,x"])
def test_columns_have_different_names(columns: str) -> None:
    refused = ran("read", "drive.lsr", "--columns", columns, code=2).stderr
    assert f"expected different names, such as x,y,z, got {columns!r}" in refused


def test_organised_points_of_several_scans_and_of_none(drive: Path, tmp_path: Path) -> None:
    failed = ran("convert", drive, tmp_path / "out.npy", "--organized", code=2)
    assert "can contain only one scan, but several are selected" in failed.stderr
    source = tmp_path / "in.bin"
    source.write_bytes(EXAMPLE * 3)
    failed = ran(
        "convert", source, tmp_path / "out.npy", "--organized", "-s", "ldrobot-stl27l", code=2
    )
    assert "the points of ldrobot-stl27l are not in rows and columns" in failed.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["in.bin"]


def test_a_unit_has_its_calibration(drive: Path, tmp_path: Path) -> None:
    wrong = tmp_path / "unit.xml"
    wrong.write_text("none", encoding="ascii")
    by_option = ran(
        "convert",
        drive,
        tmp_path / "out.csv",
        "-s",
        "velodyne-hdl64e-s2",
        "-O",
        f"calibration={wrong}",
        code=2,
    ).stderr
    assert str(wrong) in by_option
    assert (
        ran(
            "convert",
            drive,
            tmp_path / "out.csv",
            "-s",
            "velodyne-hdl64e-s2",
            "--calibration",
            wrong,
            code=2,
        ).stderr
        == by_option
    )
