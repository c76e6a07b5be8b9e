"""Tests of converting many files at once, also in processes and after interruption."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import lidarspec as ls
from lidarspec import batch
from lidarspec.errors import SourceError, UsageError
from lidarspec.formats import write
from tests.cli.running import ran
from tests.device.test_file_scans import write_frames
from tests.lines import until

pq = pytest.importorskip("pyarrow.parquet")
SENSOR = "ldrobot-stl27l"
#: so small that files of a few MB are cut.
SIZE = 300_000


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a long capture, two in a subfolder, and an invalid file."""
    folder = tmp_path_factory.mktemp("drives")
    (folder / "north").mkdir()
    write_frames(ls.sensor(SENSOR), folder / "long.bin", most=1_200_000, longest=10**6)
    write_frames(ls.sensor(SENSOR), folder / "north" / "a.bin")
    write_frames(ls.sensor(SENSOR), folder / "north" / "b.bin")
    (folder / "bad.bin").write_bytes(b"no capture at all" * 100)
    return folder


@pytest.fixture(scope="module")
def whole(drives: Path) -> Any:
    """Return the points of the long capture in one pass, as a table."""
    return read_whole(drives / "long.bin", drives.parent / "whole.parquet")


def read_whole(source: Path, table: Path) -> Any:
    """Convert a capture in one pass; return the table of its points."""
    with ls.open(source, SENSOR) as device:
        write(table, device.scans())
    return pq.read_table(table)


def records(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / batch.MANIFEST).read_text().splitlines() if line]


def outputs(folder: Path) -> dict[str, bytes]:
    """Return every file of points by name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*.parquet"))
    }


def read_pieces(folder: Path, name: str = "long") -> Any:
    """Return the points of all pieces of a capture."""
    return pq.read_table([str(path) for path in sorted(folder.glob(f"{name}*.parquet"))])


def lives(group: int) -> bool:
    """Return whether any process of a group is running."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def run(sources: Path | str, folder: Path | str, **how: Any) -> list[tuple[batch.Record, bool]]:
    return list(
        batch.convert([str(sources)], str(folder), "parquet", SENSOR, **{"size": SIZE, **how})
    )


def test_pieces_have_the_points_of_one_pass_and_a_bad_file_stops_no_other(
    drives: Path, whole: Any, tmp_path: Path
) -> None:
    done = run(drives / "**" / "*.bin", tmp_path)
    assert [old for _, old in done] == [False] * len(done)
    assert read_pieces(tmp_path).equals(whole)
    assert len(list(tmp_path.glob("long-*.parquet"))) == 3
    assert {"north/a.parquet", "north/b.parquet"} < outputs(tmp_path).keys()
    failed = [record for record in records(tmp_path) if "error" in record]
    assert [Path(record["source"]).name for record in failed] == ["bad.bin"]
    assert failed[0]["error"].startswith("no scan found: ")
    told = next(record for record in records(tmp_path) if record["source"].endswith("a.bin"))
    assert told["points"] == pq.read_metadata(tmp_path / "north" / "a.parquet").num_rows
    assert {"size", "modified", "digest", "versions", "scans"} < told.keys()


@pytest.mark.slow
def test_a_second_run_converts_only_missing_files(drives: Path, tmp_path: Path) -> None:
    mine = tmp_path / "drives"
    mine.mkdir()
    for name in ("long.bin", "north/a.bin"):
        (mine / Path(name).name).write_bytes((drives / name).read_bytes())
    run(mine / "*.bin", tmp_path / "out")
    first = outputs(tmp_path / "out")
    assert all(old for _, old in run(mine / "*.bin", tmp_path / "out"))
    os.utime(mine / "a.bin")  # its content is the same
    assert all(old for _, old in run(mine / "*.bin", tmp_path / "out"))
    (tmp_path / "out" / "long-00002.parquet").unlink()
    with (tmp_path / "out" / batch.MANIFEST).open("a") as file:
        file.write('{"source": "cut of')
    again = run(mine / "*.bin", tmp_path / "out")
    assert [record["piece"] for record, old in again if not old] == [2]
    assert outputs(tmp_path / "out") == first
    write_frames(ls.sensor(SENSOR), mine / "a.bin", longest=500)
    assert [
        Path(record["source"]).name
        for record, old in run(mine / "*.bin", tmp_path / "out")
        if not old
    ] == ["a.bin"]
    assert not any(old for _, old in run(mine / "*.bin", tmp_path / "out", size=10 * SIZE))
    assert outputs(tmp_path / "out").keys() == {"long.parquet", "a.parquet"}


@pytest.mark.slow
def test_processes_make_the_same_files(drives: Path, tmp_path: Path) -> None:
    run(drives / "**" / "*.bin", tmp_path / "one")
    run(drives / "**" / "*.bin", tmp_path / "four", jobs=4)
    assert outputs(tmp_path / "one") == outputs(tmp_path / "four")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="SIGKILL is POSIX")
def test_a_killed_run_is_resumed(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> None:
    drives = tmp_path_factory.mktemp("long-drives")
    write_frames(ls.sensor(SENSOR), drives / "long.bin", most=4_000_000, longest=10**6)
    (drives / "bad.bin").write_bytes(b"no capture at all" * 100)
    whole = read_whole(drives / "long.bin", drives / "whole.parquet")
    words = [
        "convert",
        drives / "*.bin",
        tmp_path,
        "-s",
        SENSOR,
        "--to",
        "parquet",
        "--jobs",
        "2",
        "--piece",
        "1MB",
    ]
    command = [sys.executable, "-m", "lidarspec", *map(str, words)]
    with subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL) as first:
        until(lambda: (tmp_path / batch.MANIFEST).exists() and len(records(tmp_path)) >= 2)
        os.kill(first.pid, signal.SIGKILL)
    until(lambda: not lives(first.pid))  # the workers end with it
    (tmp_path / ".123.long-00001.parquet").touch()  # what one had begun
    before = [record for record in records(tmp_path) if "error" not in record]
    kept = {record["output"]: os.stat(record["output"]).st_mtime_ns for record in before}
    subprocess.run(command, stderr=subprocess.PIPE, check=False)
    assert read_pieces(tmp_path).equals(whole)
    after = [record for record in records(tmp_path) if "error" not in record]
    assert len({record["output"] for record in after}) == len(after)
    assert all(os.stat(path).st_mtime_ns == at for path, at in kept.items())
    assert not [path.name for path in tmp_path.rglob(".*")]


@pytest.fixture
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
    ) as cluster:
        yield cluster


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_dask_cluster_makes_the_same_files_though_a_worker_is_killed(
    cluster: Any, drives: Path, tmp_path: Path
) -> None:
    run(drives / "**" / "*.bin", tmp_path / "here")
    done = batch.convert(
        [str(drives / "**" / "*.bin")],
        str(tmp_path / "there"),
        "parquet",
        SENSOR,
        size=SIZE,
        scheduler=cluster.scheduler_address,
    )
    next(done)
    os.kill(next(iter(cluster.workers.values())).pid, signal.SIGKILL)
    list(done)
    assert outputs(tmp_path / "here") == outputs(tmp_path / "there")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_dask_dataframe_has_a_partition_for_each_piece(drives: Path, whole: Any) -> None:
    pytest.importorskip("dask.dataframe")
    frame = batch.read(
        [str(drives / "long.bin"), str(drives / "north" / "*.bin")], SENSOR, size=SIZE
    )
    assert frame.npartitions == 5
    long = batch.read(str(drives / "long.bin"), SENSOR, size=SIZE).compute(scheduler="sync")
    assert long.reset_index(drop=True).equals(whole.to_pandas())
    assert frame.groupby("complete").size().compute(scheduler="sync").sum() == len(frame)


@pytest.mark.slow
def test_a_store_is_read_and_written_as_a_folder_is(drives: Path, tmp_path: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    store = fsspec.filesystem("memory")
    store.put(str(drives), "/fleet", recursive=True)
    done = run("memory://fleet/**/*.bin", "memory://points")
    assert sum("error" in record for record, _ in done) == 1
    store.get("/points", str(tmp_path / "there"), recursive=True)
    run(drives / "**" / "*.bin", tmp_path / "here")
    assert outputs(tmp_path / "here") == outputs(tmp_path / "there")
    assert all(
        old
        for record, old in run("memory://fleet/**/*.bin", "memory://points")
        if "error" not in record
    )
    result = ran("stats", "memory://fleet/north/a.bin", "-s", SENSOR)
    assert "packets" in result.stdout


def test_a_hostile_manifest_is_a_source_error_with_its_line(drives: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / batch.MANIFEST).write_text('{"cut off": \n' + "[" * 200_000 + "\n")
    said = ran("convert", drives / "*.bin", out, "-s", SENSOR, "--to", "csv", code=3).stderr
    assert f"{batch.MANIFEST}: line 2" in said
    assert [path.name for path in out.iterdir()] == [batch.MANIFEST]


def test_wrong_input_is_one_line_and_leaves_nothing(drives: Path, tmp_path: Path) -> None:
    out, source = tmp_path / "out", drives / "*.bin"
    assert "no such file" in ran("convert", drives / "*.lsr", out, "--to", "parquet", code=3).stderr
    refused = ran("convert", source, out, "--to", "parket", code=2).stderr
    assert refused.startswith(f"{out}/*.parket: unknown format '.parket'; did you mean '.parquet'?")
    assert (
        "--to parquet"
        in ran("convert", drives / "long.bin", drives / "bad.bin", out, code=2).stderr
    )
    assert (
        "--jobs cannot be combined with --dask"
        in ran(
            "convert",
            source,
            out,
            "--to",
            "csv",
            "--jobs",
            2,
            "--dask",
            "tcp://localhost:1",
            code=2,
        ).stderr
    )
    assert (
        "size of at least 1MB"
        in ran("convert", source, out, "--to", "csv", "--piece", "5", code=2).stderr
    )
    assert (
        "--to cannot be combined with"
        in ran("convert", source, out, "--to", "csv", "-n", "5", code=2).stderr
    )
    assert (
        "pip install s3fs" in ran("convert", "s3://bucket/a.bin", out, "--to", "csv", code=2).stderr
    )
    assert not out.exists()
    out.write_text("a file")
    ran("convert", source, out, "--to", "csv", code=3)
    (tmp_path / "a.bin").touch()
    (tmp_path / "a.hex").touch()
    with pytest.raises(UsageError, match="would both be written to"):
        run(tmp_path / "a.*", tmp_path / "x")
    taken = tmp_path / "taken"
    taken.mkdir()
    (taken / "bad.csv").write_text("mine")
    assert "--force" in ran("convert", source, taken, "-s", SENSOR, "--to", "csv", code=2).stderr
    assert (taken / "bad.csv").read_text() == "mine"


def test_a_missing_library_is_reported_before_reading(
    drives: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError, match="pyarrow"):
        run(drives / "*.bin", tmp_path / "out")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match="distributed"):
        list(
            batch.convert(
                [str(drives / "*.bin")],
                str(tmp_path / "out"),
                "csv",
                SENSOR,
                scheduler="tcp://localhost:1",
            )
        )
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(UsageError, match="fsspec"):
        run("memory://fleet/a.bin", tmp_path / "out")


@pytest.mark.slow
def test_an_unreachable_scheduler_is_reported(drives: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    import dask

    with (
        dask.config.set({"distributed.comm.timeouts.connect": "1s"}),
        pytest.raises(SourceError, match="no reply from the Dask scheduler"),
    ):
        run(drives / "*.bin", tmp_path / "out", scheduler="tcp://127.0.0.1:9")


def test_the_result_of_a_batch_is_summarized(drives: Path, tmp_path: Path) -> None:
    words = (
        "convert",
        drives / "north" / "*.bin",
        drives / "bad.bin",
        tmp_path,
        "-s",
        SENSOR,
        "--to",
        "csv",
        "--json",
    )
    result = ran(*words, code=1)
    told = json.loads(result.stdout)
    assert (told["files"], told["before"], len(told["failed"])) == (2, 0, 1)
    assert "2 files" in result.stderr
    assert "bad.bin" in result.stderr
    assert json.loads(ran(*words, code=1).stdout)["before"] == 2
