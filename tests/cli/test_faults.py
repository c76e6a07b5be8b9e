"""Tests of every verb with every kind of broken source.

Each gives one clear line, the next command and the documented exit code. They also cover Ctrl-C and
closed pipes.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lidarspec.cli import inputs
from tests.cli.places import babbling, busy, find_unused_address, forbidden, nothing, silent, taken
from tests.cli.running import EXAMPLE, ran
from tests.lines import free_port
from tests.view.terminal import Terminal

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")

STL, COMMANDED = ("-s", "ldrobot-stl27l"), ("-s", "cspc-m1c1-mini")
SIM = "sim:ldrobot-stl27l"
BRIEF = ("-t", "200ms")
Place = Callable[[], contextlib.AbstractContextManager[str]]

#: the words of each verb that takes a live SOURCE; what it writes goes to the working directory.
VERBS: dict[str, tuple[str, ...]] = {
    "view": ("view", "SOURCE", *STL, *BRIEF),
    "view --once": ("view", "SOURCE", *STL, *BRIEF, "--once"),
    "stats": ("stats", "SOURCE", *STL, *BRIEF),
    "read": ("read", "SOURCE", *STL, *BRIEF),
    "read --packets": ("read", "SOURCE", *STL, *BRIEF, "--packets"),
    "plot": ("plot", "SOURCE", *STL, "-o", "scan.svg"),
    "convert": ("convert", "SOURCE", "points.csv", *STL),
    "record": ("record", "SOURCE", "-o", "all.lsr", *STL, *BRIEF),
    "send": ("send", "SOURCE", "start", *COMMANDED, "--timeout", "200ms"),
    "detect": ("detect", "SOURCE", *BRIEF),
}
#: Broken sources, their documented exit code, and a word of the message.
BROKEN: tuple[tuple[Place, int, str], ...] = (
    (nothing, 3, "no such port"),
    (busy, 3, "in use"),
    (forbidden, 3, "permission denied"),
    (taken, 3, "in use"),
    (find_unused_address, 3, "refuses"),
    (silent, 5, "nothing"),
    (babbling, 4, "bytes"),
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(inputs, "FIRST_FRAME_TIMEOUT_S", 0.2)
    return tmp_path


@pytest.mark.parametrize(
    ("place", "code", "told"), BROKEN, ids=lambda value: getattr(value, "__name__", "")
)
@pytest.mark.parametrize("verb", VERBS)
def test_a_broken_source_ends_in_one_line_and_its_code(
    folder: Path, verb: str, place: Place, code: int, told: str
) -> None:
    if (verb, place) == ("send", babbling):
        code, told = 5, "no ack frame received"
    if (verb, place) == ("send", silent):
        told = "no ack frame received"
    with place() as source:
        result = ran(*(source if word == "SOURCE" else word for word in VERBS[verb]), code=code)
    lines = result.stderr.splitlines()
    said = [line for line in lines if not line.lstrip().startswith("next: ")]
    # A file that cannot be decoded yet is kept, with a message.
    kept = verb == "record" and place is babbling
    assert told in said[-1]
    assert len(said) == (2 if kept or (verb, place) == ("detect", silent) else 1), said
    assert lines[-1].lstrip().startswith("next: lidarspec "), lines
    assert os.listdir(folder) == (["all.lsr"] if kept else [])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "told"), [(place, told) for place, _, told in BROKEN if place is not forbidden]
)
def test_doctor_says_the_same_as_a_finding(folder: Path, place: Place, told: str) -> None:
    if place is silent:
        told = "no data received"
    with place() as source:
        result = ran("doctor", source, *STL, *BRIEF, code=1)
    wrong = [line for line in result.stdout.splitlines() if line.startswith("wrong")]
    assert any(told in line for line in wrong), result.stdout


def test_hexadecimal_digits_with_colons_are_no_address() -> None:
    assert "ldrobot-stl27l data, 47 bytes" in ran("parse", EXAMPLE.hex(":"), *STL).stdout
    assert (
        "lsn requires 1 byte, but has 0"
        in ran("parse", "aa:55:00", "-s", "cspc-m1c1-mini", code=4).stderr
    )


@pytest.mark.parametrize("words", [("replay", "kept.lsr"), ("sim", "ldrobot-stl27l", *BRIEF)])
def test_an_address_in_use_cannot_be_played_to(folder: Path, words: tuple[str, ...]) -> None:
    ran("record", SIM, *STL, "-n", "20", "-o", "kept.lsr")
    with find_unused_address() as source:
        result = ran(*words, "--to", source, code=3)
    number = source.rpartition(":")[2]
    assert result.stderr.splitlines() == [
        f"{source}: cannot listen: Address already in use",
        f"  next: ss -ltnp 'sport = :{number}'",
    ]


#: A sensor that is simulated slowly, because all verbs at work share the processor.
SLOW_SIM = f"{SIM}?rate=0.1"
#: verbs at work, which Ctrl-C ends; SILENT is a port behind which nobody says anything. Interrupts
#: of `view`, `stats` and `read` while they print are in tests/view/test_terminal_window.py and
#: test_live_verbs, of `parse` in test_failures.
WORKING: tuple[tuple[str, ...], ...] = (
    ("view", "SILENT", *STL),
    ("stats", "SILENT", *STL),
    ("read", "SILENT", *STL),
    ("record", SLOW_SIM, *STL, "-o", "one.lsr"),
    ("record", SLOW_SIM, "-o", "two.lsr"),
    ("record", "SILENT", *STL, "-o", "three.lsr"),
    ("replay", "kept.lsr", "--loop", "--speed", "0.1"),
    ("sim", "ldrobot-stl27l", "--rate", "0.1"),
    ("demo", *STL, "-n", "900"),
    ("convert", SLOW_SIM, "points.csv", *STL),
    ("plot", SLOW_SIM, "-o", "scan.svg", "--scan", "900", *STL),
    ("send", "SILENT", "start", *COMMANDED, "--timeout", "60s"),
    ("detect", "SILENT", "-t", "60s"),
    ("doctor", f"udp://127.0.0.1:{free_port()}", "-t", "60s"),
    ("explain", "-", *STL),
)


@pytest.fixture
def worked(tmp_path: Path) -> Iterator[list[tuple[str, Terminal]]]:
    """Yield all commands, running at the same time, each in a separate terminal."""
    ran("record", SIM, *STL, *BRIEF, "-o", tmp_path / "kept.lsr")
    with contextlib.ExitStack() as stack:
        found = []
        for words in WORKING:
            place = stack.enter_context(silent()) if "SILENT" in words else ""
            named = [place if word == "SILENT" else word for word in words]
            found.append((" ".join(words), stack.enter_context(Terminal(*named, cwd=tmp_path))))
        yield found


def seen_by_a_shell(code: int) -> int:
    """Return the exit code as a shell's `$?`: 128 plus the number of a fatal signal.

    A signal is fatal if it arrives during the imports.
    """
    return code if code >= 0 else 128 - code


@pytest.mark.slow
def test_an_interrupt_ends_every_verb_with_130(
    worked: list[tuple[str, Terminal]], tmp_path: Path
) -> None:
    for _, terminal in worked:
        terminal.wait_until_loaded()
    for _, terminal in worked:
        terminal.type("\x03")
    ends = {
        words: (
            seen_by_a_shell(terminal.wait_until_end()),
            "Traceback" in terminal.raw,
            terminal.is_as_before(),
        )
        for words, terminal in worked
    }
    assert ends == dict.fromkeys(ends, (130, False, True))
    assert {"points.csv", "scan.svg", "three.lsr"}.isdisjoint(os.listdir(tmp_path)), (
        "nothing half made is left"
    )


#: verbs whose output is cut off after its first line as by ``| head -1``; those of files are in
#: test_failures.
PRINTING: tuple[tuple[str, ...], ...] = (
    ("view", SIM, *STL),
    ("stats", SIM, *STL, "--interval", "50ms"),
    ("read", SIM, *STL, "--packets", "--json"),
    ("plot", SIM, *STL, "-o", "-"),
    ("ports",),
    ("detect", SIM, *BRIEF),
    ("send", "sim:cspc-m1c1-mini", "start", *COMMANDED),
)


@pytest.mark.slow
def test_a_closed_pipe_ends_every_verb_quietly(tmp_path: Path) -> None:
    running = {words: _start(words, tmp_path) for words in PRINTING}
    ends = {}
    for words, process in running.items():
        with process:
            assert process.stdout is not None
            assert process.stderr is not None
            assert process.stdout.readline()
            process.stdout.close()
            said = process.stderr.read()
            ends[words] = process.wait(60), "Traceback" in said or "Broken" in said
    assert ends == dict.fromkeys(ends, (0, False))


def _start(words: tuple[str, ...], folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-u", "-m", "lidarspec", *words]
    return subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
    )
