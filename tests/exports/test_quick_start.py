"""Tests of the commands and notes at the start of a sensor's page."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.exports.quick_start import list_commands, read_notes, typical_source, write_python
from tests.libraries import needs

ROOT = Path(__file__).parents[2]
NOTES = sorted(ROOT.glob("plugins/*/lidarspec_*/notes/*.md"))


def run(arguments: list[str], folder: Path) -> str:
    result = subprocess.run(
        [sys.executable, *arguments], cwd=folder, capture_output=True, text=True, check=True
    )
    return result.stdout


@needs("mcap", "google")
@pytest.mark.parametrize(
    ("sensor_id", "made"), [("ldrobot-stl27l", "a.foxglove.mcap"), ("ublox-gnss", "a.csv")]
)
def test_the_commands_work_as_they_are_printed(sensor_id: str, made: str, tmp_path: Path) -> None:
    sensor = ls.sensor(sensor_id)
    source = f"sim:{sensor.id}?rate=max"
    outputs = dict[str, str]()
    for command, _ in list_commands(sensor, source):
        words = shlex.split(command.replace("10s", "1s"))
        verb = words[1]
        if verb == "read":
            words += ["-n", "1"]
        if verb not in ("view", "ros2"):
            outputs[verb] = run(["-m", *words], tmp_path)
    assert sensor.id in outputs["detect"]
    assert (tmp_path / made).stat().st_size > 0
    assert "[" in run(["-c", write_python(sensor, source)], tmp_path)


def test_a_sensor_without_points_has_commands_for_frames() -> None:
    commands = [command for command, _ in list_commands(ls.sensor("ublox-gnss"))]
    verbs = [command.split()[1] for command in commands]
    assert verbs == ["detect", "read", "record", "convert", "stats"]
    assert commands[1] == "lidarspec read /dev/ttyUSB0 -s ublox-gnss -f nav_pvt"
    assert 'packets["time_of_week"]' in write_python(ls.sensor("ublox-gnss"))


@pytest.mark.parametrize(
    ("sensor", "source"),
    [
        ("ldrobot-stl27l", "/dev/ttyUSB0"),
        ("velodyne-vlp16", "udp://"),
        ("livox-mid360", "udp://"),  # found by broadcast
        ("ouster-os1", "udp://?src=192.168.0.10"),
        ("sick-tim571", "tcp://192.168.0.10:2112"),
    ],
)
def test_the_source_fits_the_links(sensor: str, source: str) -> None:
    assert typical_source(ls.sensor(sensor)) == source


def test_notes_are_read_from_the_plugin() -> None:
    assert "ZH1.5T-4P" in read_notes("ldrobot-stl27l")
    assert read_notes("acme-x1") == ""


def test_each_notes_file_belongs_to_a_sensor() -> None:
    assert NOTES
    for file in NOTES:
        assert read_notes(file.stem) == file.read_text(encoding="utf-8").strip()
        assert not file.read_text(encoding="utf-8").startswith("# ")


@pytest.mark.parametrize("file", NOTES, ids=lambda file: file.stem)
def test_the_commands_in_notes_exist(file: Path) -> None:
    """Check the sensor, command, arguments and options of each line; send nothing."""
    for line in re.findall(r"^\$ lidarspec (.*)", file.read_text(encoding="utf-8"), re.MULTILINE):
        words = shlex.split(line)
        if "-s" not in words:
            continue
        assert words[words.index("-s") + 1] == file.stem
        sensor = ls.sensor(file.stem)
        if words[0] == "send" and "--hex" not in words:
            command = sensor.commands[words[2]]
            given = {word.partition("=")[0] for word in words[3:] if "=" in word}
            assert given == {*command.args}
        options = [words[i + 1] for i, word in enumerate(words) if word == "-O"]
        known = {"answer", *sensor.configure.types}
        assert {option.partition("=")[0] for option in options} <= known
