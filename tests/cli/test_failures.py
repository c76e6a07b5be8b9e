"""Tests of wrong input: one clear message on stderr and the documented exit code.

The message names the place of the error and the next command. Nothing is written to stdout.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Crc
from tests.broken import points_fail, sound
from tests.cli.running import EXAMPLE, process, ran

SENSOR = ("-s", "ldrobot-stl27l")


def test_a_process_prints_and_exits_as_a_call_does(tmp_path: Path) -> None:
    done = process("shw", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.decode()) == (
        2,
        b"",
        ran("shw", code=2).stderr,
    )


@pytest.mark.slow
def test_every_verb_says_that_checksums_are_never_right(tmp_path: Path) -> None:
    crc, path, chosen = Crc(width=8, poly=0x4D), tmp_path / "bug.bin", ["-s", "ldrobot-stl27l"]
    frames = simulate(ls.sensor("ldrobot-stl27l"), 20)
    path.write_bytes(b"".join(frame[:46] + bytes([crc(frame[1:46])]) for frame in frames))
    out = tmp_path / "out.csv"
    for words in (
        ["detect", path],
        ["convert", path, out],
        ["parse", path],
        ["parse", path, *chosen],
        ["read", path, *chosen],
    ):
        told = ran(*words, code=4).stderr
        assert "over 45 of 47 bytes" in told
        assert f"next: lidarspec crc {path}" in told
    assert "over 45 of 47 bytes" in ran("doctor", path, code=1).stdout


def test_the_next_command_can_be_typed() -> None:
    first = ran("parse", EXAMPLE[:30].hex(" "), *SENSOR, code=4)
    following = first.stderr.rstrip().rpartition("next: lidarspec ")[2]
    explained = ran(*shlex.split(following), code=4)
    assert explained.stdout.startswith("ldrobot-stl27l data, 30 bytes\n0000  54 2c")


@pytest.mark.parametrize(
    "words",
    [
        ("--help",),
        pytest.param(("sensors",), marks=pytest.mark.slow),
        pytest.param(("explain", EXAMPLE.hex()), marks=pytest.mark.slow),
        pytest.param(("demo", "-n", "1", *SENSOR), marks=pytest.mark.slow),
    ],
)
def test_a_closed_pipe_ends_quietly(words: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "lidarspec", *words]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        said = running.stderr.read().decode().splitlines()
        assert running.wait(60) == 0, said
        assert all(line.startswith("these bytes are frames of") for line in said)


@pytest.mark.skipif(os.name != "posix", reason="signals are sent as on POSIX")
def test_an_interrupt_ends_with_130() -> None:
    # a test run in the background of a shell has interrupts switched off, and its children inherit
    # that
    restored = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [
        sys.executable,
        "-c",
        f"{restored}; from lidarspec.cli import main; main()",
        "parse",
        "-",
        *SENSOR,
    ]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as running:
        deadline = time.monotonic() + 60
        while not _reads_standard_input(running.pid) and time.monotonic() < deadline:
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        assert running.wait(60) == 130
        assert running.stderr is not None
        assert running.stderr.read() == b"interrupted\n"


def _reads_standard_input(pid: int) -> bool:
    """Return whether a process has imported `parse` and sleeps.

    On systems without this information, wait for a fixed time.
    """
    try:
        maps = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8")
        state = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(") ")[2]
    except OSError:
        time.sleep(3)
        return True
    return "_multiarray_umath" in maps and state.startswith("S")


def test_a_bug_is_owned_up_to_without_a_traceback(tmp_path: Path) -> None:
    broken = tmp_path / "broken.py"
    broken.write_text("raise ZeroDivisionError('by hand')\n", encoding="utf-8")
    done = process("show", f"./{broken.name}", cwd=tmp_path)
    assert done.returncode == 1
    assert b"ZeroDivisionError: by hand" in done.stderr


RAISES = Path(points_fail.__file__)


@pytest.mark.parametrize(
    "words",
    [
        ("read", "frames.bin"),
        ("stats", "frames.bin"),
        ("plot", "frames.bin", "-o", "picture.svg"),
        ("view", "frames.bin", "--once"),
        ("convert", "frames.bin", "points.csv"),
        ("demo",),
        ("sim", str(RAISES), "--to", "new.bin"),
    ],
    ids=lambda words: words[0],
)
def test_every_verb_names_a_failing_plugin_in_the_same_way(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages name its id, exception, file and line; the exit code is 1.

    They include the number of packets if some were read.
    """
    monkeypatch.chdir(tmp_path)
    Path("frames.bin").write_bytes(b"".join(ls.simulate(sound.sensor(), 12)))
    said = ran(*words, *(() if words[0] == "sim" else ("-s", RAISES)), code=1).stderr
    line = next(
        number
        for number, text in enumerate(RAISES.read_text(encoding="utf-8").splitlines(), 1)
        if "distnace" in text
    )
    assert "broken-one: points of data: UnknownField: unknown field 'samples.distnace'" in said
    assert f"points_fail.py:{line})" in said
    assert "frames.bin" not in words or f":{line}), at 12 packets\n" in said
    assert f"next: lidarspec check {RAISES}" in said


SOMETIMES = """
from lidarspec.spec import hookimpl
from tests.broken import sound

def points(f):
    if (f.number.array > 5).any():
        raise ArithmeticError("by hand")
    return sound.points(f)

@hookimpl
def lidarspec_sensors():
    return [sound.sensor(points=points)]
"""


def test_a_plugin_that_raises_now_and_then_ends_with_its_message_and_in_python_is_a_warning(
    tmp_path: Path,
) -> None:
    (file := tmp_path / "sometimes.py").write_text(SOMETIMES, encoding="utf-8")
    (tmp_path / "packets.hex").write_text(
        "\n".join(frame.hex() for frame in ls.simulate(sound.sensor(), 12)), encoding="utf-8"
    )
    said = ran("plot", tmp_path / "packets.hex", "-o", "-", "-s", file, code=1).stderr
    assert f"broken-one: points of data: ArithmeticError: by hand ({file}:7), at " in said
    with ls.open(tmp_path / "packets.hex", str(file)) as device:
        list(device.scans())
    assert [warning for warning in device.warnings if f"({file}:7), at" in warning]


def test_an_exception_of_a_sweep_is_a_plugin_error(tmp_path: Path) -> None:
    text = SOMETIMES.replace("points=points", "simulation=Simulation(lambda i: 1 / 0)").replace(
        "import hookimpl", "import Simulation, hookimpl"
    )
    (file := tmp_path / "sweeping.py").write_text(text, encoding="utf-8")
    assert (
        f"sweep of data: ZeroDivisionError: division by zero ({file}:12)"
        in ran("sim", file, "--to", tmp_path / "new.bin", code=1).stderr
    )
