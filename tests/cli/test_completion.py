"""Tests of shell completion, the guide and the help."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.cli.root import VERBS
from lidarspec.plugins import Registry
from tests.cli.running import ran, ran_with_any_code

SETTINGS = '[device.front]\nsource = "sim:slamtec-rplidar-s2"\nsensor = "slamtec-rplidar-s2"\n'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "lidarspec.toml").write_text(SETTINGS, encoding="utf-8")
    (tmp_path / "drive.pcap").touch()
    (tmp_path / "scans").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("re", {"read", "record", "replay"}),
        ("help pl", {"plot", "plugins"}),
        ("show velodyne-vlp", {"velodyne-vlp16", "velodyne-vlp32c"}),
        ("read x.bin -s pu", {"puck", "puck-lite", "puck-hi-res"}),
        ("check lidarspec-ld", {"lidarspec-ldrobot"}),
        ("build ldrobot-ld06 ", {"data"}),
        ("build ldrobot-ld06 data s", {"speed=", "start_angle="}),
        ("build ldrobot-ld06 data speed = 3600 points[*].d", {"points[*].distance="}),
        ("explain x.bin -s ldrobot-ld06 -f ", {"data"}),
        ("send front motor_", {"motor_speed"}),
        ("send front motor_speed ", {"speed="}),
        ("send sim : slamtec-rplidar-s2 motor_", {"motor_speed"}),
        ("send x.bin -s nobody-x fr", set()),
        ("view fr", {"front"}),
        ("view sim : velodyne-v", {"velodyne-vlp16", "velodyne-vlp32c", "velodyne-vls128"}),
        ("view s", {"sim:", "scans/"}),
        ("view d", {"file d"}),
        ("convert drive.pcap o", {"file o"}),
        ("convert a.pcap out --to par", {"parquet"}),
        ("plot x.bin --colour ", {"range", "intensity"}),
        ("nonsense fr", set()),
    ],
)
def test_possible_words_are_completed(
    words: str, offered: set[str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("_LIDARSPEC_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", f"lidarspec {words}")
    monkeypatch.setenv("COMP_CWORD", str(words.count(" ") + 1))
    lines = ran(code=1 if "nobody" in words else 0).stdout.split("\n")
    assert {
        line.removeprefix("plain,").replace("file,", "file ") for line in lines if line
    } == offered


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
def test_bash_accepts_the_completion(folder: Path) -> None:
    script = """eval "$(_LIDARSPEC_COMPLETE=bash_source lidarspec)"
        COMP_WORDS=(lidarspec build ldrobot-ld06 data sp); COMP_CWORD=4
        _lidarspec_completion lidarspec 2>/dev/null; echo "${COMPREPLY[@]}"; complete -p lidarspec; declare -f _lidarspec_completion"""
    place = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "--norc", "-c", script],
        capture_output=True,
        text=True,
        env=place,
        check=True,
        timeout=120,
    )
    lines = done.stdout.splitlines()
    assert lines[0] == "speed="
    assert "-F _lidarspec_completion lidarspec" in lines[1]
    assert "compopt -o nospace" in done.stdout  # which stands in for a line of click's own script


def test_the_command_alone_prints_a_guide(folder: Path) -> None:
    lines = ran().stdout.splitlines()
    assert len(lines) <= 16
    assert all(len(line) <= 80 for line in lines if not line.startswith("serial ports"))
    assert lines[1].startswith(f"{len(ls.sensors())} sensors of ")
    assert "devices in lidarspec.toml: front" in lines
    commands = guide_commands(lines)
    assert {command.split()[0] for command in commands} <= set(VERBS)
    assert "view front" in commands


def guide_commands(lines: list[str]) -> list[str]:
    """Return the commands that the guide prints, without the name of the program."""
    return [
        line.removeprefix("  lidarspec ").partition("  ")[0]
        for line in lines
        if line.startswith("  lidarspec ")
    ]


@pytest.mark.slow
def test_every_command_of_the_guide_runs(folder: Path) -> None:
    for command in guide_commands(ran().stdout.splitlines()):
        words = command.replace("10s", "1s").split()
        if words[0] == "view":
            words.append("--once")
        code = ran_with_any_code(*words)
        allowed = {"detect": {0, 4, 5}, "doctor": {0, 1}}.get(words[0], {0})  # by what is attached
        assert code in allowed, command
    assert len((folder / "points.csv").read_text(encoding="ascii").splitlines()) > 1


def test_the_guide_without_sensors_names_an_installation_command(bare_registry: Registry) -> None:
    assert "no sensor is installed: pip install " in ran().stdout


def test_help_is_that_of_the_verb() -> None:
    assert ran("help", "plot").stdout == ran("plot", "--help").stdout
    assert ran("help").stdout == ran("--help").stdout
    assert "did you mean 'plot'?" in ran("help", "plt", code=2).stderr
