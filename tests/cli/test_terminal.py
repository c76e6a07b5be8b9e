"""Tests that output has no terminal control codes and survives a closed pipe.

Printed names can be typed again as arguments.
"""

from __future__ import annotations

import ast
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import lidarspec as ls
import lidarspec.cli
from tests.cli.running import EXAMPLE, process, ran

SENSOR = "ldrobot-stl27l"
posix = pytest.mark.skipif(sys.platform == "win32", reason="closes streams as a shell does")

PLUGIN = """
import dataclasses
from lidarspec.plugins import sensor
from lidarspec.spec import hookimpl

@hookimpl
def lidarspec_sensors():
    return [dataclasses.replace(sensor("ldrobot-stl27l"), id="acme-x1", aliases=(), vendor="A\\x1b[31mB", model="C\\u202eD")]
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def steering(text: str) -> set[str]:
    return {one for one in text if not one.isprintable()} - {"\n"}


def test_names_of_files_are_spelled_out(folder: Path) -> None:
    name = "a\x1b]0;b\x07\u202e.bin"
    (folder / name).write_bytes(EXAMPLE[:20])
    for code, words in (
        (4, ("parse", name)),
        (4, ("convert", name, "x.csv")),
        (4, ("plot", name, "-o", "x.svg")),
        (3, ("read", f"no{name}")),
    ):
        said = ran(*words, "-s", SENSOR, code=code).stderr
        assert steering(said) == set()
        assert r"a\x1b]0;b\x07\u202e.bin" in said


def test_control_characters_in_sensor_names_are_escaped(folder: Path) -> None:
    (folder / "acme.py").write_text(PLUGIN)
    shown = ran("show", "./acme.py").stdout
    assert r"A\x1b[31mB C\u202eD" in shown
    assert steering(shown) == set()
    (folder / "x.bin").write_bytes(EXAMPLE)
    assert steering(ran("explain", "x.bin", "-s", "./acme.py").stdout) == set()


def test_the_next_command_can_be_typed_whatever_a_file_is_called(folder: Path) -> None:
    name, cut = "it's; touch x.bin", EXAMPLE[:20]
    twins = b"".join(ls.simulate(ls.sensor("ydlidar-tmini"), 30))
    for data, words in (
        (twins, ("convert", name, "a b.csv")),
        (cut, ("convert", name, "a b.csv", "-s", SENSOR)),
        (cut, ("parse", name, "-s", SENSOR)),
        (EXAMPLE[:-1] + b"\0", ("plot", name, "-s", SENSOR, "-o", "x.svg")),
    ):
        (folder / name).write_bytes(data)
        following = shlex.split(
            ran(*words, code=2 if data == twins else 4).stderr.rpartition("next: ")[2]
        )
        assert following[0] == "lidarspec"
        assert name in following


def test_nothing_is_printed_past_the_one_place() -> None:
    for path in Path(lidarspec.cli.__file__).parent.glob("*.py"):
        calls = [
            node.func
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Call)
        ]
        assert path.stem == "terminal" or not {"print", "click.echo", "click.secho"} & set(
            map(ast.unparse, calls)
        ), path


def shell(command: str, stderr: int = subprocess.PIPE) -> subprocess.CompletedProcess[bytes]:
    """Return a shell command line that runs `lidarspec`."""
    command = command.replace("lidarspec", f"{shlex.quote(sys.executable)} -m lidarspec")
    return subprocess.run(
        ["sh", "-c", command], stdout=subprocess.PIPE, stderr=stderr, check=False, timeout=120
    )


@pytest.mark.slow
@posix
@pytest.mark.parametrize("lost", ["2>&-", "2>/dev/full", ""])
def test_a_lost_stderr_is_no_reason_to_stop(folder: Path, lost: str) -> None:
    reader, nobody = os.pipe()
    os.close(reader)
    (folder / "x.bin").write_bytes(EXAMPLE * 300)
    assert not shell(f"lidarspec convert x.bin x.csv -s {SENSOR} {lost}", nobody).returncode
    assert (folder / "x.csv").stat().st_size > 100_000
    recorded = shell(f"lidarspec record sim:{SENSOR} -n 200 -o x.lsr --json {lost}", nobody)
    os.close(nobody)
    assert (recorded.returncode, json.loads(recorded.stdout)["packets"] >= 200) == (0, True)
    with lidarspec.open(folder / "x.lsr") as device:
        assert sum(map(len, device.packets())) >= 200


@pytest.mark.slow
@posix
def test_data_that_cannot_be_printed_are_a_failure(folder: Path) -> None:
    (folder / "x.bin").write_bytes(EXAMPLE)
    for lost, why in ((">&-", "Bad file descriptor"), (">/dev/full", "No space left on device")):
        done = shell(f"lidarspec parse x.bin -s {SENSOR} {lost}")
        assert (done.returncode, done.stderr.decode().splitlines()[0]) == (
            3,
            f"standard output: {why}",
        )
    assert not shell("lidarspec sensors | true").stderr


@pytest.mark.slow
def test_warnings_are_remarks(folder: Path) -> None:
    (folder / "acme.py").write_text(
        "import warnings\nwarnings.warn('the plugin is young')" + PLUGIN
    )
    assert process("show", "./acme.py").stderr == b"the plugin is young\n"
