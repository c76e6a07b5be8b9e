"""The benchmarks run and say what they measured; how fast anything was is no matter here."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

RUN = Path(__file__).parents[1] / "benchmarks" / "run.py"


def measured(folder: Path, *options: str) -> list[dict[str, Any]]:
    record = folder / "record.json"
    command = [sys.executable, str(RUN), "--quick", "--runs", "5", "--json", str(record), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    rows: list[dict[str, Any]] = json.loads(record.read_text(encoding="utf-8"))["rows"]
    assert all(row["title"].split()[0] in done.stdout for row in rows)
    return rows


def test_single_frames_are_measured_beside_construct(tmp_path: Path) -> None:
    rows = measured(tmp_path, "--only", "parse")
    assert {row["work"] for row in rows} == {f"parse-{key}" for key in ("stl27l", "m1c1", "vlp16", "xt32", "m1")}
    assert {(row["unit"], row["runs"]) for row in rows} == {("frames", 5)}
    for row in rows:
        assert set(row["times"]) == {"construct", "compiled"}
        assert row["million_per_s"] == pytest.approx(row["amount"] / row["seconds"] / 1e6)
        assert min(row["share_of_memcpy"], *row["times"].values()) > 0


def test_the_noisy_stream_loses_no_intact_frame(tmp_path: Path) -> None:
    (row,) = measured(tmp_path, "--only", "stl27l-stream", "--backend", "numpy")
    assert {"construct", "compiled", "plain", "by hand"} <= set(row["times"])
    assert row["facts"]["intact frames"] > 500
    assert row["facts"]["intact frames lost"] == 0
    assert row["not_installed"] in ([], ["lds2d"])


def test_an_unknown_work_is_refused_with_the_names_there_are() -> None:
    done = subprocess.run([sys.executable, str(RUN), "--only", "fastest"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "stl27l-stream" in done.stderr
