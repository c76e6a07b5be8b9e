"""Wrong input: one clear message with its place and the next command on stderr, nothing on stdout, the documented exit code."""

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
from lidarspec.known_sensors import install_command
from lidarspec.simulation.simulator import simulate
from lidarspec.spec import Crc
from tests.broken import points_fail, sound
from tests.cli.running import EXAMPLE, process, ran

TEXT = b"these are the minutes of a meeting, and no lidar was there\n"
FILES = {
    "empty.bin": b"",
    "text.bin": TEXT,
    "text.hex": TEXT,
    "cut.bin": EXAMPLE[:20],
    "whole.bin": EXAMPLE,
    "damaged.bin": EXAMPLE[:-1] + b"\0",
    "other.bin": EXAMPLE * 3,
}
SENSOR = ("-s", "ldrobot-stl27l")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, data in FILES.items():
        (tmp_path / name).write_bytes(data)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (("convert", "empty.bin", "o.csv", *SENSOR), 4, ["ldrobot-stl27l", "empty.bin holds no bytes"]),
        (("convert", "empty.bin", "o.csv"), 4, ["empty.bin holds no bytes"]),
        (("convert", "text.bin", "o.csv", *SENSOR), 4, ["ldrobot-stl27l", "no frame in 59 bytes", "74 68 65 73 65"]),
        (("convert", "text.bin", "o.csv"), 4, ["no frame of any", "74 68 65 73 65"]),
        (("convert", "text.hex", "o.csv", *SENSOR), 4, ["text.hex, line 1: not hexadecimal"]),
        (
            ("convert", "cut.bin", "o.csv", *SENSOR),
            4,
            ["frame ends at byte 20 of 47: points[4].intensity needs 1 byte, 0 left", "^^ points[4]"],
        ),
        (("convert", "damaged.bin", "o.csv", *SENSOR), 4, ["crc at byte 46: checksum 0x00, expected 0x50", "^^ crc"]),
        (
            ("convert", "other.bin", "o.csv", "-s", "cspc-coin-d4"),
            4,
            ["its frames are those of", "next: lidarspec convert other.bin o.csv -s ldrobot"],
        ),
        (("convert", "missing.bin", "o.csv", *SENSOR), 3, ["missing.bin: No such file"]),
        (("convert", "whole.bin", "nowhere/o.csv", *SENSOR), 3, ["nowhere/o.csv: No such file"]),
        (("convert", ".", "o.csv", *SENSOR), 3, ["directory"]),
        (("convert", "whole.bin", "o.cvs", *SENSOR), 2, ["unknown format '.cvs'", "did you mean '.csv'?"]),
        (("convert", "whole.bin", "whole.bin", *SENSOR), 2, ["whole.bin is read: it would be overwritten"]),
        (
            ("convert", "whole.bin", "o.csv", "-s", "ldrobot-stl27"),
            2,
            ["unknown sensor", "did you mean 'ldrobot-stl27l'?", "next: lidarspec sensors"],
        ),
        (("convert", "whole.bin", "o.csv", "-s", "./missing.py"), 3, ["missing.py: no such file"]),
        (("convert", "whole.bin"), 2, ["Missing argument 'OUT'", "next: lidarspec convert --help"]),
        (("convert", "whole.bin", "o.csv", "--al", *SENSOR), 2, ["--al", "--all"]),
        (("convert", "whole.bin?port=3", "o.csv", *SENSOR), 2, ["unknown option 'port'"]),
        (("parse", "empty.bin", *SENSOR), 4, ["empty.bin holds no bytes"]),
        (("parse", "text.bin"), 4, ["no frame of any"]),
        (("parse", "cut.bin", *SENSOR), 4, ["points[4].intensity", "next: lidarspec explain cut.bin -s ldrobot-stl27l"]),
        (("parse", "damaged.bin", *SENSOR), 4, ["checksum 0x00, expected 0x50"]),
        (("parse", "missing.bin"), 3, ["missing.bin: no such file"]),
        (("parse", "54 2"), 2, ["'2' makes no whole bytes"]),
        (("parse", "54", "zz"), 2, ["'z' is no digit of it"]),
        (("parse", "whole.bin", "-s", "ldrobot"), 2, ["unknown sensor 'ldrobot'"]),
        (("explain", "text.bin"), 4, ["no frame of any"]),
        (("explain", "empty.bin", *SENSOR), 4, ["holds no bytes"]),
        (
            ("build", "ldrobot-stl27l", "data", "sped=3"),
            2,
            ["unknown field 'sped'; did you mean 'speed'?", "next: lidarspec show ldrobot-stl27l"],
        ),
        (("build", "ldrobot-stl27l", "dta"), 2, ["unknown frame 'dta'; did you mean 'data'?"]),
        (("build", "ldrobot-stl27l", "data", "speed=1"), 2, ["'start_angle' is missing"]),
        (("build", "ldrobot-stl27l", "data", "speed"), 2, ["'speed' is not field=value"]),
        (("show", "nothing-such"), 2, ["unknown sensor"]),
        (("shw",), 2, ["unknown verb 'shw'; did you mean 'show'?"]),
    ],
)
def test_wrong_input(folder: Path, words: tuple[str, ...], code: int, told: list[str]) -> None:
    before = sorted(os.listdir(folder))
    result = ran(*words, code=code)
    assert result.stdout == ""
    assert all(text in result.stderr for text in told), result.stderr
    assert result.stderr.rstrip().splitlines()[-1].startswith("  next: lidarspec "), result.stderr
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize(
    ("words", "code"), [(("shw",), 2), (("convert", "missing.bin", "o.csv", *SENSOR), 3), (("convert", "damaged.bin", "o.csv", *SENSOR), 4)]
)
def test_a_program_says_and_ends_with_the_same(folder: Path, words: tuple[str, ...], code: int) -> None:
    done = process(*words, cwd=folder)
    assert (done.returncode, done.stdout, done.stderr.decode()) == (code, b"", ran(*words, code=code).stderr)


def test_a_verb_of_a_plugin_that_is_missing_says_which() -> None:
    told = ran("ros2", "sim:cspc-m1c1-mini", code=2).stderr
    assert f"  next: {install_command('lidarspec-ros2', extra='ros2')}" in told


def test_every_verb_says_that_checksums_are_never_right(tmp_path: Path) -> None:
    crc, path, chosen = Crc(width=8, poly=0x4D), tmp_path / "bug.bin", ["-s", "ldrobot-stl27l"]
    frames = simulate(ls.sensor("ldrobot-stl27l"), 20)
    path.write_bytes(b"".join(frame[:46] + bytes([crc(frame[1:46])]) for frame in frames))
    out = tmp_path / "out.csv"
    for words in (["detect", path], ["convert", path, out], ["parse", path], ["parse", path, *chosen], ["read", path, *chosen]):
        told = ran(*words, code=4).stderr
        assert "over 45 of the 46 other bytes" in told
        assert f"next: lidarspec crc {path}" in told
    assert "over 45 of the 46 other bytes" in ran("doctor", path, code=1).stdout


def test_the_place_of_an_error_is_marked() -> None:
    result = ran("parse", "54 2c 10 0e 00 00 e8 03 c8 e9 03", *SENSOR, code=4)
    assert result.stderr.splitlines() == [
        "ldrobot-stl27l data: frame ends at byte 11 of 47: points[1].intensity needs 1 byte, 0 left",
        "  0000  54 2c 10 0e 00 00 e8 03  c8 e9 03",
        "                                          ^^ points[1].intensity",
        "  next: lidarspec explain '54 2c 10 0e 00 00 e8 03 c8 e9 03' -s ldrobot-stl27l",
    ]


def test_the_next_command_can_be_typed() -> None:
    first = process("parse", EXAMPLE[:30].hex(" "), *SENSOR)
    following = first.stderr.decode().rstrip().rpartition("next: lidarspec ")[2]
    assert process(*shlex.split(following)).stdout.startswith(b"ldrobot-stl27l data, 30 bytes\n0000  54 2c")


def test_a_truncated_frame_is_explained_before_it_fails() -> None:
    result = ran("explain", EXAMPLE[:12].hex(), code=4)
    assert "0009  dc 00 e2  points[1]    0.220 m, intensity 226" in result.stdout
    assert "frame ends at byte 12 of 47: points[2].distance needs 2 bytes, 0 left" in result.stderr


@pytest.mark.parametrize("words", [("--help",), ("sensors",), ("explain", EXAMPLE.hex()), ("demo", "-n", "1", *SENSOR)])
def test_a_closed_pipe_ends_quietly(words: tuple[str, ...]) -> None:
    command = [sys.executable, "-m", "lidarspec", *words]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        said = running.stderr.read().decode().splitlines()
        assert running.wait(60) == 0, said
        assert all(line.startswith("these bytes fit") for line in said)


@pytest.mark.skipif(os.name != "posix", reason="signals are sent as on POSIX")
def test_an_interrupt_ends_with_130() -> None:
    # a test run in the background of a shell has interrupts switched off, and its children inherit that
    restored = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    command = [sys.executable, "-c", f"{restored}; from lidarspec.cli import main; main()", "parse", "-", *SENSOR]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        deadline = time.monotonic() + 60
        while not _reads_standard_input(running.pid) and time.monotonic() < deadline:
            time.sleep(0.05)
        running.send_signal(signal.SIGINT)
        assert running.wait(60) == 130
        assert running.stderr is not None
        assert running.stderr.read() == b"interrupted\n"


def _reads_standard_input(pid: int) -> bool:
    """Whether a process has loaded what `parse` needs and now sleeps; where that cannot be seen, time has to do."""
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
def test_a_plugin_that_raises_is_named_alike_by_every_verb(words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its id, what raised, the file and line, the number of packets where some were read; exit code 1."""
    monkeypatch.chdir(tmp_path)
    Path("frames.bin").write_bytes(b"".join(ls.simulate(sound.sensor(), 12)))
    said = ran(*words, *(() if words[0] == "sim" else ("-s", RAISES)), code=1).stderr
    line = next(number for number, text in enumerate(RAISES.read_text(encoding="utf-8").splitlines(), 1) if "distnace" in text)
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


def test_a_plugin_that_raises_now_and_then_ends_with_its_message_and_in_python_is_a_warning(tmp_path: Path) -> None:
    (file := tmp_path / "sometimes.py").write_text(SOMETIMES, encoding="utf-8")
    (tmp_path / "packets.hex").write_text("\n".join(frame.hex() for frame in ls.simulate(sound.sensor(), 12)), encoding="utf-8")
    said = ran("plot", tmp_path / "packets.hex", "-o", "-", "-s", file, code=1).stderr
    assert f"broken-one: points of data: ArithmeticError: by hand ({file}:7), at " in said
    with ls.open(tmp_path / "packets.hex", str(file)) as device:
        list(device.scans())
    assert [warning for warning in device.warnings if f"({file}:7), at" in warning]


def test_what_a_sweep_raises_is_the_plugins(tmp_path: Path) -> None:
    text = SOMETIMES.replace("points=points", "simulation=Simulation(lambda i: 1 / 0)").replace(
        "import hookimpl", "import Simulation, hookimpl"
    )
    (file := tmp_path / "sweeping.py").write_text(text, encoding="utf-8")
    assert (
        f"sweep of data: ZeroDivisionError: division by zero ({file}:12)" in ran("sim", file, "--to", tmp_path / "new.bin", code=1).stderr
    )
