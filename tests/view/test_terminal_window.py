"""Tests of `view` in a real terminal: drawing, keys, resizing, and restoring it."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec import simulate

if os.name == "posix":
    from tests.view.terminal import Terminal

pytestmark = pytest.mark.skipif(os.name != "posix", reason="terminals of its own are POSIX's")

SENSOR = ("-s", "ldrobot-stl27l")
LIVE = ("view", "sim:ldrobot-stl27l", *SENSOR)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a capture of three seconds of a sensor."""
    path = tmp_path_factory.mktemp("view") / "three.bin"
    path.write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 5_400)))
    return path


def test_a_sensor_is_drawn_and_q_leaves_the_terminal_clean(tmp_path: Path) -> None:
    with Terminal(*LIVE, cwd=tmp_path) as terminal:
        shown = terminal.wait_for("10.0 Hz")
        assert all(
            text in shown
            for text in ("● live", "0° forward", "2 m", "points", "2160", "q quit", "▲")
        )
        assert sum(0x2800 < ord(character) < 0x2900 for character in shown) > 150
        assert {"1049"} <= terminal.modes
        assert "25" not in terminal.modes
        terminal.type("q")
        assert terminal.wait_until_end() == 0
        assert terminal.is_clean()


@pytest.mark.slow
def test_keys_match_the_help(tmp_path: Path) -> None:
    with Terminal(*LIVE, cwd=tmp_path) as terminal:
        terminal.wait_for("6 m")
        terminal.type("?")
        assert "switch colours" in terminal.wait_for(" keys ")
        terminal.type("?c")
        terminal.wait_for("intensity")
        terminal.type("c+++++")
        assert "6 m-" not in terminal.wait_for("0.5 m") + terminal.wait_for("1 m")
        terminal.type("0 ")
        terminal.wait_for("‖ paused")
        terminal.type(" \x1b[A")
        terminal.wait_for("● live")
        terminal.type("r")
        terminal.wait_for("● ldrobot-stl27l-")
        time.sleep(0.3)
        terminal.type("rq")
        assert terminal.wait_until_end() == 0
        (recording,) = tmp_path.glob("*.lsr")
        assert f"next: lidarspec view {recording.name}" in terminal.raw
    with ls.open(recording) as device:
        assert device.sensor.id == "ldrobot-stl27l"
        assert sum(len(packets) for packets in device.packets()) > 100


@pytest.mark.slow
def test_a_paused_picture_stays_while_data_arrives(tmp_path: Path) -> None:
    with Terminal("view", "sim:ldrobot-stl27l", *SENSOR, cwd=tmp_path) as terminal:
        terminal.wait_for("Hz")
        terminal.type("r ")
        terminal.wait_for("● ldrobot")
        written = len(terminal.raw)
        time.sleep(1.5)
        terminal.text()
        drawn = terminal.raw[written:]
        assert not any(0x2800 < ord(character) < 0x2900 for character in drawn)
        (recording,) = tmp_path.glob("*.lsr")
        assert recording.stat().st_size > 50_000
        terminal.type("q")
        assert terminal.wait_until_end() == 0


@pytest.mark.slow
def test_a_file_is_played_at_its_own_speed_and_stays_at_its_end(capture: Path) -> None:
    with Terminal("view", capture, *SENSOR) as terminal:
        terminal.wait_for("▶ playing")
        began = time.monotonic()
        terminal.wait_for("end")
        assert time.monotonic() - began > 1.5
        terminal.type("q")
        assert terminal.wait_until_end() == 0
        assert terminal.is_clean()


@pytest.mark.slow
def test_the_picture_follows_the_window(tmp_path: Path) -> None:
    with Terminal(*LIVE, cwd=tmp_path) as terminal:
        terminal.wait_for("q quit")
        terminal.resize(120, 40)
        shown = terminal.wait_for("q quit").splitlines()
        assert shown[39].endswith("q quit")
        assert max(map(len, shown)) > 110
        terminal.resize(40, 10)
        terminal.wait_for("speed")
        assert "quit" not in terminal.text()
        terminal.resize(5, 2)
        terminal.wait_for("l")
        terminal.type("q")
        assert terminal.wait_until_end() == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "code"),
    [("\x03", 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)],
)
def test_whatever_ends_it_leaves_the_terminal_clean(
    tmp_path: Path, end: str | signal.Signals, code: int
) -> None:
    with Terminal(*LIVE, cwd=tmp_path) as terminal:
        terminal.wait_for("live")
        terminal.type(end) if isinstance(end, str) else terminal.process.send_signal(end)
        assert terminal.wait_until_end() == code
        assert terminal.is_clean()
        assert "Traceback" not in terminal.raw


@pytest.mark.slow
def test_an_error_is_printed_on_a_restored_terminal(tmp_path: Path) -> None:
    (tmp_path / "failing.py").write_text(_FAILING, encoding="utf-8")
    (tmp_path / "raw.bin").write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 2000)))
    with Terminal("view", "raw.bin", "-s", "./failing.py", cwd=tmp_path) as terminal:
        assert terminal.wait_until_end() == 1
        assert terminal.is_clean()
        assert (
            "a bug in lidarspec: MemoryError: by hand" in terminal.raw.rpartition("\x1b[?1049l")[2]
        )


#: a sensor whose clock gives out in the middle of the stream with what no plugin is forgiven.
_FAILING = """
import lidarspec as ls
from lidarspec.view import terminal_window

def broken(self, columns, lines):
    raise MemoryError("by hand")

terminal_window.Window.cells = broken
from lidarspec.spec import hookimpl

found = ls.sensor("ldrobot-stl27l")

@hookimpl
def lidarspec_sensors():
    return [found]
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs a shell with job control")
def test_it_can_be_suspended(tmp_path: Path) -> None:
    with Terminal(
        program=["bash", "--norc", "--noediting", "-i"], cwd=tmp_path, PS1="shell> "
    ) as terminal:
        terminal.wait_for("shell>")
        terminal.type(f"{sys.executable} -m lidarspec {' '.join(LIVE)}\n")
        terminal.wait_for("● live")
        terminal.type("\x1a")
        terminal.wait_for("Stopped")
        assert terminal.modes == {"25", "7"}
        terminal.type("fg\n")
        terminal.wait_for("q quit")
        assert "1049" in terminal.modes
        terminal.type("q")
        terminal.wait_for("shell>")
        assert terminal.modes == {"25", "7"}


@pytest.mark.slow
def test_without_colours_none_are_sent(capture: Path) -> None:
    with Terminal("view", capture, *SENSOR, NO_COLOR="1") as terminal:
        terminal.wait_for("playing")
        assert ";38;" not in terminal.raw
    with Terminal("view", capture, *SENSOR, COLORTERM="truecolor") as terminal:
        terminal.wait_for("playing")
        assert "\x1b[0;38;2;" in terminal.raw
