"""Tests of the wording of the command line, with one golden file per verb: golden/VERB.txt.

A golden file is a list of command lines, each followed by its result:

    $ lidarspec parse text.bin < FILE       the part from "<" on names standard input
    exit 4                                  left out if the exit code is 0
    out| a line on standard output
    err| a line on standard error

Lines that begin with "# " are comments. To change a text, edit the code; to add a command, add the
line that begins with "$". Then run

    LIDARSPEC_UPDATE_GOLDEN=1 pytest tests/cli/test_golden.py

The commands run in this process, in a folder with the files of `example_files`. Paths, the version
and the number of installed sensors are replaced, so that the files are the same everywhere.
"""

from __future__ import annotations

import difflib
import importlib.metadata
import os
import re
import shlex
from pathlib import Path

import pytest
from click.testing import CliRunner

import lidarspec as ls
from lidarspec.cli.root import VERBS, main
from lidarspec.optional_libraries import release_numbers
from lidarspec.spec import Chunk
from tests.cli.running import APART, EXAMPLE

GOLDEN = Path(__file__).with_name("golden")
#: golden file of the program without a verb.
PROGRAM = "lidarspec"
#: version of click whose messages are in the golden files.
LEAST_CLICK_VERSION = (8, 2)
START_NS = 1_700_000_000 * 10**9
FRAME_PERIOD_NS = 555_556
STL = "ldrobot-stl27l"
TEXT = b"these are the minutes of a meeting, and no lidar was there\n"
CHECKOUT = Path(__file__).parents[2]
#: Texts that differ between machines or runs, and their replacements.
VARIABLE_TEXTS = (
    (re.compile(re.escape(str(CHECKOUT))), "CHECKOUT"),
    (re.compile(re.escape(ls.__version__)), "VERSION"),
    (re.compile(r"\d+ installed sensors"), "N installed sensors"),
    (re.compile(r" in \d+\.\d s\b"), " in SECONDS"),
    (re.compile(r"(?<=recorded  )\d{4}-\S+"), "TIME"),
)

click_version = importlib.metadata.version("click")
pytestmark = [
    pytest.mark.skipif(
        os.name != "posix", reason="the golden files have the system messages of POSIX"
    ),
    pytest.mark.skipif(
        release_numbers(click_version) < LEAST_CLICK_VERSION,
        reason=f"click {click_version} words its own messages differently",
    ),
]


@pytest.fixture(scope="module")
def example_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the contents of the files that golden commands read, by name."""
    sensor = ls.sensor(STL)
    frames = ls.simulate(sensor, 400)
    recording = tmp_path_factory.mktemp("golden") / "drive.lsr"
    with ls.Recorder(recording, STL, "/dev/ttyUSB0", baud=921_600) as recorder:
        for number, frame in enumerate(frames):
            recorder.write(Chunk(frame, START_NS + number * FRAME_PERIOD_NS))
    return {
        "empty.bin": b"",
        "text.bin": TEXT,
        "text.hex": TEXT,
        "cut.bin": EXAMPLE[:20],
        "frame.bin": EXAMPLE,
        "frames.bin": EXAMPLE * 3,
        "damaged.bin": EXAMPLE[:-1] + b"\0",
        "drive.bin": b"".join(frames),
        "drive.lsr": recording.read_bytes(),
        "no_sensor.py": b"import lidarspec\n",
    }


def run_command(line: str, folder: Path) -> str:
    """Run a line "$ lidarspec ...", and return it with its result."""
    words = shlex.split(line.removeprefix("$ lidarspec"))
    standard_input = None
    if "<" in words:
        standard_input = (folder / words[-1]).read_bytes()
        words = words[: words.index("<")]
    names_before = sorted(os.listdir(folder))
    result = CliRunner(**APART).invoke(main, words, input=standard_input)
    if result.exit_code > 1:
        assert sorted(os.listdir(folder)) == names_before, (
            f"{line}: a command that fails leaves no file"
        )
    lines = [line]
    if result.exit_code:
        lines.append(f"exit {result.exit_code}")
    lines += [f"out| {text}".rstrip() for text in replace_variable_texts(result.stdout, folder)]
    lines += [f"err| {text}".rstrip() for text in replace_variable_texts(result.stderr, folder)]
    return "\n".join(lines)


def replace_variable_texts(text: str, folder: Path) -> list[str]:
    """Return the lines of an output without texts that differ between machines and runs."""
    text = text.replace(str(folder), "FOLDER")
    for pattern, replacement in VARIABLE_TEXTS:
        text = pattern.sub(replacement, text)
    return text.splitlines()


def run_golden_file(text: str, folder: Path) -> str:
    """Return a golden file with the results of its commands as they are now."""
    blocks = []
    for line in text.splitlines():
        if line.startswith("$ "):
            blocks.append(run_command(line, folder))
        elif line.startswith("# "):
            blocks.append(line)
    return "\n\n".join(blocks) + "\n"


@pytest.mark.parametrize("name", sorted(path.stem for path in GOLDEN.glob("*.txt")))
def test_golden(
    name: str, example_files: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for file, content in example_files.items():
        (tmp_path / file).write_bytes(content)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    path = GOLDEN / f"{name}.txt"
    expected = path.read_text(encoding="utf-8")
    actual = run_golden_file(expected, tmp_path)
    if os.environ.get("LIDARSPEC_UPDATE_GOLDEN"):
        path.write_text(actual, encoding="utf-8")
    elif actual != expected:
        lines = difflib.unified_diff(
            expected.splitlines(), actual.splitlines(), f"golden/{name}.txt", "now", lineterm=""
        )
        pytest.fail("\n".join(lines), pytrace=False)


def test_every_verb_has_a_golden_file() -> None:
    assert {path.stem for path in GOLDEN.glob("*.txt")} == {PROGRAM, *VERBS}
