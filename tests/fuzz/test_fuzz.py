"""Tests that every fuzz target reads its examples, and that faults are found.

`make fuzz` runs the targets with millions of inputs.
"""

from __future__ import annotations

import random
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

import lidarspec as ls
from tests.fuzz import trial
from tests.fuzz.__main__ import ROOT, spread
from tests.fuzz.campaign import Job, keep, run_mutations
from tests.fuzz.targets import SHARES, Target, targets
from tests.representatives import REPRESENTATIVES
from tests.shapes import SHAPES

#: mutated inputs that the quick tier reads, in all; and at least so many for each target.
INPUTS = 5000
LEAST = 2
#: Of the targets of a group, the quick tier reads one in so many; their examples take the time.
SHARE = {"stream": 5, "frame": 5}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture(scope="module")
def few(folder: Path) -> dict[str, Target]:
    """Return the targets of the shapes, and the calibration files of a sensor."""
    return targets(folder, [*SHAPES.values(), ls.sensor("hesai-xt16")])


@pytest.fixture
def known(
    folder: Path, few: dict[str, Target], monkeypatch: pytest.MonkeyPatch
) -> dict[str, Target]:
    monkeypatch.chdir(folder)
    return few


def read_neighbours(target: Target, number: int) -> None:
    """Read the examples of a target, and mutations of them.

    An undocumented exception fails.
    """
    source = random.Random(f"{target.name} few")
    examples = target.examples()
    valid = 0
    inputs = [*examples[: 1 if target.group == "stream" else None]]
    inputs += [
        target.mutation(source.choice(examples), source.choice(examples), source)
        for _ in range(number)
    ]
    for data in inputs:
        with warnings.catch_warnings(action="ignore"):
            try:
                target.run(data)
                valid += 1
            except target.documented:
                pass
    assert valid, f"no example of {target.name} is valid"


@pytest.mark.parametrize("group", SHARES)
def test_neighbours_of_valid_input_do_no_harm(known: dict[str, Target], group: str) -> None:
    shares = spread({target.name: target.cost for target in known.values()}, INPUTS)
    mine = [target for target in known.values() if target.group == group]
    assert mine
    for target in mine[:: SHARE.get(group, 1)]:
        read_neighbours(target, max(LEAST, shares[target.name]))


@pytest.mark.slow
def test_neighbours_of_valid_input_of_sensors_do_no_harm(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    for target in targets(folder, [ls.sensor(name) for name in REPRESENTATIVES]).values():
        read_neighbours(target, LEAST)


def raising(data: bytes) -> None:
    raise ValueError(f"{len(data)} bytes")


def endless(data: bytes) -> None:
    while True:
        pass


def greedy(data: bytes) -> None:
    bytearray(3 * trial.MEMORY)


@pytest.mark.parametrize(
    ("run", "what"), [(raising, "ValueError"), (endless, "TooLong"), (greedy, "MemoryError")]
)
def test_failures_are_found_and_stored(
    run: object, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trial, "BUSY", 0.05)
    target = Target("invented one", run, lambda: [b"abc"])  # type: ignore[arg-type]
    with trial.limits():
        found = trial.judge(target, b"abc")
        assert found is not None
        assert trial.judge(Target("invented", lambda data: None, list), b"") is None
    assert found.what.startswith(what)
    path = keep(tmp_path, found)
    assert (path.read_bytes(), path.parent.name) == (b"abc", "invented.one")
    assert found.place in path.with_suffix(".txt").read_text()


def test_an_input_that_reaches_new_lines_is_mutated_further(
    known: dict[str, Target], tmp_path: Path
) -> None:
    job = Job(known["frame shape-count data"], tmp_path / "kept", seed=1)
    run_mutations(job, 100)
    assert job.inputs == 100
    assert job.lines > 50
    assert len(list(job.corpus.iterdir())) > 0
    assert not job.findings


@pytest.mark.slow
def test_a_run_resumes_where_it_stopped(tmp_path: Path) -> None:
    assert spread({"frame a": 100.0, "frame b": 300.0, "hex": 1.0}, 1000) == {
        "frame a": 685,
        "frame b": 228,
        "hex": 86,
    }
    words = [
        sys.executable,
        "-m",
        "tests.fuzz",
        "--engine",
        "seeded",
        "--inputs",
        "200",
        "--only",
        "hex",
        "--only",
        "source",
        "--folder",
        str(tmp_path),
    ]
    first, second = (
        subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        for _ in range(2)
    )
    assert first.returncode == second.returncode == 0, first.stdout + first.stderr
    assert "0 targets done before" in first.stdout
    assert "2 targets done before" in second.stdout
    assert first.stdout.splitlines()[-1].split() == second.stdout.splitlines()[-1].split()
    assert first.stdout.splitlines()[-1].split()[:2] == ["all", "200"]
