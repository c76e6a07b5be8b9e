"""Tests that the benchmarks run and print their measurements, whatever the speed."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytestmark = pytest.mark.slow

RUN = Path(__file__).parents[1] / "benchmarks" / "run.py"

BY_HAND = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import handwritten_packets, handwritten_serial
import numpy as np
from inputs import Inputs
from packet_workloads import BY_HAND, FIXED
from lidarspec.simulation.simulator import make_opening_frame

inputs = Inputs(Path(sys.argv[2]), quick=True)

def alike(key, data, found):
    cloud = inputs.sensor(key).decode(data).points()
    wanted = [cloud.x, cloud.y, cloud.intensity] if len(found) == 3 else [cloud.x, cloud.y, cloud.z, cloud.intensity]
    for column, own in zip(wanted, found, strict=True):
        np.testing.assert_allclose(own, column, rtol=0, atol=1e-5)
    print(key)

for key, function in BY_HAND.items():
    alike(key, inputs.array(key), function(inputs.array(key)))
alike("stl27l", inputs.noisy("stl27l").data, handwritten_serial.stl27l_stream(inputs.noisy("stl27l").data))
alike("m1c1", inputs.stream("m1c1"), handwritten_serial.m1c1_stream(inputs.stream("m1c1")))
first = len(make_opening_frame(inputs.sensor("rplidar")))
alike("rplidar", inputs.stream("rplidar"), handwritten_serial.rplidar_stream(inputs.stream("rplidar"), first))
assert handwritten_packets.payloads(inputs.capture("m1")).tobytes() == b"".join(inputs.frames("m1"))
print("payloads")
scans = [scan.points for scan in inputs.sensor("m1").scans(inputs.array("m1"))]
np.testing.assert_array_equal(np.hstack(handwritten_packets.m1_scans(inputs.capture("m1")))[0], np.concatenate([cloud.x for cloud in scans]))
print("scans")
for key, (_, fixed, is_stream) in FIXED.items():
    data = b"".join(inputs.frames(key)) if is_stream else inputs.frames(key)
    cloud = fixed(inputs.sensor(key), inputs.frames(key)[0]).decode(data).points()
    alike(key, data, [cloud.x, cloud.y, cloud.z, cloud.intensity])
"""


def run_benchmarks(folder: Path, *options: str) -> list[dict[str, Any]]:
    record = folder / "record.json"
    command = [sys.executable, str(RUN), "--quick", "--runs", "5", "--json", str(record), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows: list[dict[str, Any]] = json.loads(record.read_text(encoding="utf-8"))["rows"]
    assert all(row["title"].split()[0] in done.stdout for row in rows)
    return rows


def test_single_frames_are_measured_beside_construct(tmp_path: Path) -> None:
    rows = run_benchmarks(tmp_path, "--only", "parse")
    assert {row["work"] for row in rows} == {
        f"parse-{key}" for key in ("stl27l", "m1c1", "vlp16", "xt32", "m1")
    }
    assert {(row["unit"], row["runs"]) for row in rows} == {("frames", 5)}
    for row in rows:
        assert set(row["times"]) == {"construct", "compiled"}
        assert row["million_per_s"] == pytest.approx(row["amount"] / row["seconds"] / 1e6)
        assert min(row["share_of_memcpy"], *row["times"].values()) > 0


def test_the_noisy_stream_loses_no_intact_frame(tmp_path: Path) -> None:
    (row,) = run_benchmarks(tmp_path, "--only", "stl27l-stream", "--backend", "numpy")
    assert {"construct", "compiled", "plain", "by hand"} <= set(row["times"])
    assert row["facts"]["intact frames"] > 500
    assert row["facts"]["intact frames lost"] == 0
    assert set(row["not_installed"]) <= {"lds2d"}


def test_frames_with_counts_and_parts_are_measured_beside_fixed_places(tmp_path: Path) -> None:
    named = [
        word
        for name in ("livox", "multiscan", "picoscan", "colab", "scip")
        for word in ("--only", name)
    ]
    rows = run_benchmarks(tmp_path, "--backend", "numpy", *named)
    compared = {"livox", "multiscan", "picoscan", "colab-tim", "colab-lms"}
    assert {row["work"]: set(row["facts"]) for row in rows} == {
        "scip": set(),
        **{name: {"times as long as with fixed places"} for name in compared},
    }
    assert all(row["amount"] > 5000 and row["bytes"] > row["amount"] for row in rows)


def test_conversions_are_compared_with_a_copy_and_plain_code(tmp_path: Path) -> None:
    names = ("to-vlp16.npz", "to-stl27l.mcap", "to-many.parquet")
    only = [word for name in names for word in ("--only", name)]
    rows = {
        row["work"]: row
        for row in run_benchmarks(tmp_path, "--backend", "numpy", "--size", "1", *only)
    }
    beside = ({"np.savez", "velodyne-decoder and np.savez"}, set(), {"one process"})
    assert {name: {*row["times"], *row["not_installed"]} for name, row in rows.items()} == dict(
        zip(names, beside, strict=True)
    )
    for row in rows.values():
        facts = row["facts"]
        assert row["runs"] == 1
        assert (
            min(
                facts[name]
                for name in ("s", "s of the processors", "% of the speed of copying that")
            )
            > 0
        )
        assert all(value > 20 for name, value in facts.items() if name.startswith("MB of memory"))
        assert facts["MB written"] > row["bytes"] / 1e6


def load_module(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Import a module of benchmarks/."""
    monkeypatch.syspath_prepend(RUN.parent)
    return importlib.import_module(name)


def test_one_library_that_cannot_be_installed_does_not_stop_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    environments = load_module("environments", monkeypatch)
    installed: list[str] = []

    def run_installer(python: Path, requirements: list[str]) -> str:
        if "lds2d>=99" in requirements:
            return "no such version"
        installed.extend(requirements)
        return ""

    monkeypatch.setattr(environments, "run_installer", run_installer)
    failures = environments.install(Path("python"), ["lidarspec[jit]", "lds2d>=99", "dpkt>=1.9"])
    assert failures == {"lds2d": "no such version"}
    assert installed == ["lidarspec[jit]", "dpkt>=1.9"]


@pytest.mark.parametrize(
    ("stderr", "reason"),
    [
        (
            (
                "WARNING: slow\nERROR: Could not find lds2d>=99 (from versions: 0.7)\n"
                "ERROR: No match\n"
            ),
            "Could not find lds2d>=99 (from versions: 0.7)",
        ),
        (
            "  x No solution found when resolving dependencies:\n"
            "  ╰─▶ Because only lds2d<=0.7 is available and you require\n"
            "      lds2d>=99, there is none.\n",
            "Because only lds2d<=0.7 is available and you require lds2d>=99, there is none.",
        ),
        ("line one\nkilled\n", "killed"),
        ("", "no message"),
    ],
)
def test_the_reason_comes_from_the_installer(
    stderr: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load_module("environments", monkeypatch).find_reason(stderr) == reason


def test_a_contender_runs_in_another_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    measure = load_module("measure", monkeypatch)
    remote_contender = load_module("remote_contender", monkeypatch)
    contender = remote_contender.RemoteContender(
        Path(sys.executable), partial(measure.memcpy, quick=True)
    )
    try:
        assert contender.amount == measure.memcpy(quick=True).amount
        assert 0 < contender.seconds(2, time.perf_counter) < 10
        assert 0 < contender.seconds(1, measure.cpu_seconds) < 10
    finally:
        contender.close()


def test_a_library_that_is_missing_in_the_other_environment_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    libraries = load_module("libraries", monkeypatch)
    remote_contender = load_module("remote_contender", monkeypatch)
    with pytest.raises(libraries.Missing, match="not installed"):
        remote_contender.prepare_in(Path(sys.executable), libraries.library, "no_such_library")


def test_an_unknown_work_is_refused_with_the_names_there_are() -> None:
    done = subprocess.run(
        [sys.executable, str(RUN), "--only", "fastest"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "stl27l-stream" in done.stderr


def test_handwritten_decoders_give_the_same_points(tmp_path: Path) -> None:
    """Handwritten decoders and the engine give the same points.

    The comparison runs in a separate process, which can import the decoders.
    """
    done = subprocess.run(
        [sys.executable, "-c", BY_HAND, str(RUN.parent), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [
        "m1",
        "stl27l",
        "m1c1",
        "vlp16",
        "xt32",
        "rplidar",
        "stl27l",
        "m1c1",
        "rplidar",
        "payloads",
        "scans",
        "livox",
        "multiscan",
        "picoscan",
        "colab-tim",
        "colab-lms",
    ]
