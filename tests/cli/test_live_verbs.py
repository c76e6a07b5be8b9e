"""Tests of `view`, `stats`, `read` and `plot` on files, simulations and real ports.

Each kind of failure gives one line and the documented exit code.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.simulation.simulator import simulate
from tests.cli.places import nobody
from tests.cli.running import process, ran

ID = "ldrobot-stl27l"
SENSOR = ("-s", ID)
SIM = f"sim:{ID}"
VERBS = [("view", "--once", "-t", "1"), ("stats", "-t", "1"), ("read", "-t", "1")]
posix = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a capture of two seconds of a sensor, with one frame in fifty damaged."""
    path = tmp_path_factory.mktemp("live") / "two.bin"
    frames = simulate(ls.sensor(ID), 3600)
    path.write_bytes(
        b"".join(
            frame[:-1] + b"\0" if number % 50 == 0 else frame for number, frame in enumerate(frames)
        )
    )
    return path


@posix
@pytest.mark.parametrize("words", VERBS, ids=lambda words: words[0])
def test_missing_permission_is_reported(
    capture: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    path = tmp_path / "secret.bin"
    path.write_bytes(b"x")
    path.chmod(0)
    ran(words[0], capture, *SENSOR, *words[1:])  # what is loaded later may not be readable
    with nobody():
        result = ran(words[0], path, *SENSOR, *words[1:], code=3)
    assert f"{path}: Permission denied" in result.stderr


@pytest.mark.slow
@posix
@pytest.mark.parametrize("words", [("stats",), ("read",)])
def test_an_interrupt_ends_with_130(words: tuple[str, ...]) -> None:
    restored = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [
        sys.executable,
        "-u",
        "-c",
        f"{restored}; from lidarspec.cli import main; main()",
        *words,
        SIM,
        *SENSOR,
    ]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        for _ in range(3):
            assert running.stdout.readline()
        running.send_signal(signal.SIGINT)
        rest, said = running.communicate(timeout=60)
    assert running.returncode == 130
    assert said == "interrupted\n"
    assert ("complete scans" in rest) == (words == ("stats",))


@pytest.mark.slow
def test_stats_of_a_simulated_sensor() -> None:
    done = process(
        "stats", f"sim:{ID}?errors=0.001", *SENSOR, "-t", "1.2", "--interval", "400ms", "--json"
    )
    *intervals, summary = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0
    assert {line["kind"] for line in intervals} == {"interval"}
    assert summary["kind"] == "summary"
    assert summary["speed_hz"] == pytest.approx(10, rel=0.05)
    assert summary["points"] == pytest.approx(2160, rel=0.1)
    assert summary["packets"] == summary["stats"]["frames"]["data"] > 0
    assert 0.005 < summary["error_rate"] < 0.15  # of 47 bytes one in a thousand is wrong
    assert summary["loss_rate"] == pytest.approx(summary["error_rate"], rel=0.5)  # by its clock
    assert summary["jitter_s"] > 0
    assert sum(line["packets"] for line in intervals) <= summary["packets"]


def test_stats_of_a_file(capture: Path) -> None:
    lines = [
        json.loads(line)
        for line in ran(
            "stats", capture, *SENSOR, "--json", "--interval", "500ms"
        ).stdout.splitlines()
    ]
    summary = lines[-1]
    assert summary["packets"] == 3600 - 72
    assert summary["error_rate"] == pytest.approx(0.02)
    assert summary["packet_rate_hz"] == pytest.approx(1800 * 0.98, rel=0.01)
    assert summary["jitter_s"] is None  # nobody knows when it arrived
    assert summary["queue"] is None
    assert summary["skipped_rate"] == pytest.approx(0.02)
    text = ran("stats", capture, *SENSOR).stdout
    assert f"{ID}: 3528 packets, " in text
    assert all(len(line) <= 80 for line in text.splitlines() if not line.startswith(ID))


@pytest.mark.parametrize(("limit", "code"), [("1%", 1), ("0.019", 1), ("2.5 %", 0), ("0.5", 0)])
def test_too_many_errors_are_a_finding(capture: Path, limit: str, code: int) -> None:
    result = ran("stats", capture, *SENSOR, "--max-errors", limit, code=code)
    assert ("2.000% of the frames are invalid or lost" in result.stderr) == bool(code)


@pytest.mark.slow
def test_read_prints_the_points_that_the_scans_have(capture: Path) -> None:
    header, *lines = ran("read", capture, *SENSOR, "-n", "5").stdout.splitlines()
    assert (
        " ".join(header.split())
        == "scan x [m] y [m] z [m] range [m] azimuth [rad] elevation [rad] intensity time [s]"
    )
    assert len({len(line) for line in [header, *lines]}) == 1
    rows = [
        json.loads(line) for line in ran("read", capture, *SENSOR, "--json").stdout.splitlines()
    ]
    with ls.open(capture, ID) as device:
        clouds = [scan.points[scan.points.valid] for scan in device.scans()]
    assert [row["scan"] for row in rows] == [
        number for number, cloud in enumerate(clouds) for _ in range(len(cloud))
    ]
    np.testing.assert_array_equal(
        np.array([row["x"] for row in rows], np.float32),
        np.concatenate([cloud.x for cloud in clouds]),
    )
    assert [float(value) for value in lines[0].split()[1:3]] == pytest.approx(
        [rows[0]["x"], rows[0]["y"]], abs=1e-3
    )


def test_read_prints_packets_with_units(capture: Path) -> None:
    header, first, *_ = ran("read", capture, *SENSOR, "--packets", "-n", "2").stdout.splitlines()
    assert "start_angle [deg]" in header
    assert "points" not in header
    row = json.loads(ran("read", capture, *SENSOR, "--packets", "-n", "1", "--json").stdout)
    with ls.open(capture, ID) as device:
        packets = next(device.packets())
    assert row["offset"] == packets.offset[0] == int(first.split()[0])
    assert row["start_angle"] == pytest.approx(packets["start_angle"][0])
    assert row["points.distance"] == pytest.approx(packets["points.distance"][0].tolist())


def test_view_prints_one_picture_where_there_is_no_terminal(capture: Path) -> None:
    result = ran("view", capture, *SENSOR)
    *picture, told = result.stdout.splitlines()
    assert told.startswith(f"{ID}: Scan(")
    assert told.endswith("colours: range 0 to 6 m")
    assert "0° forward" in picture[0]
    assert "\x1b" not in result.stdout


@pytest.mark.slow
def test_view_draws_in_ascii_where_that_is_the_encoding(capture: Path) -> None:
    plain = subprocess.run(
        [sys.executable, "-m", "lidarspec", "view", str(capture), *SENSOR],
        capture_output=True, check=True,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
    )  # fmt: skip
    assert b"^" in plain.stdout
    assert b"?" not in plain.stdout


def test_view_of_a_live_source_waits_for_a_whole_scan() -> None:
    began = time.monotonic()
    assert ", complete)" in ran("view", SIM, *SENSOR, "--once").stdout
    assert time.monotonic() - began < 30


def test_plot_writes_a_picture(capture: Path, tmp_path: Path) -> None:
    import xml.etree.ElementTree as ET

    ran(
        "plot", capture, *SENSOR, "-o", tmp_path / "scan.svg", "--scan", "3", "--color", "intensity"
    )
    root = ET.fromstring((tmp_path / "scan.svg").read_text(encoding="utf-8"))
    dots = [
        place
        for path in root.findall(".//{*}path")
        if "dots" in path.get("class", "")
        for place in path.get("d", "").split("m")[1:]
    ]
    assert 500 < len(dots) <= 2160
    assert "10.0 Hz, " in "".join(text.text or "" for text in root.findall(".//{*}text"))
    assert ran("plot", capture, *SENSOR, "-o", "-").stdout.startswith("<svg")
    assert (
        "expected a file name that ends in"
        in ran("plot", capture, *SENSOR, "-o", tmp_path / "scan.gif", code=2).stderr
    )


def test_a_plot_names_the_range_that_excludes_all_points(capture: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    far = ("--kind", "intensity", "--range", "1000m:2000m")
    refused = ran("plot", capture, *SENSOR, "-o", tmp_path / "far.svg", *far, code=2)
    assert "has a return in the selected range" in refused.stderr


@pytest.mark.parametrize(
    ("library", "words", "extra"),
    [
        ("matplotlib", ("plot", "IN", "-o", "a.png"), "plot"),
        ("matplotlib", ("plot", "IN", "--kind", "rates", "-o", "a.svg"), "plot"),
        ("rerun", ("convert", "IN", "a.rrd"), "rerun"),
        ("rerun", ("view", "IN", "--rerun", "-o", "a.rrd"), "rerun"),
    ],
)
def test_a_missing_library_is_named_with_its_extra(
    capture: Path,
    tmp_path: Path,
    library: str,
    words: Sequence[str],
    extra: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == library]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.chdir(tmp_path)
    result = ran(*(capture if word == "IN" else word for word in words), *SENSOR, code=2)
    assert result.stderr.endswith(f"  next: pip install 'lidarspec[{extra}]'\n")
    assert not list(tmp_path.iterdir())
