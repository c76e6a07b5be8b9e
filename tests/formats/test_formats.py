"""Tests that files are written completely or not at all.

They have the format of their suffix and the content of the clouds.
"""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
import tracemalloc
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import PointCloud, Scan, SourceError, simulate
from lidarspec.errors import LibraryError, ReplyTimeout, UnknownFormat
from lidarspec.formats import arrays, arrow_tables as tables, format_of, formats, write
from lidarspec.formats.common import replace_file
from tests.libraries import needs
from tests.recording.test_recordings import file_size_limit
from tests.shapes import SHAPES

#: the library and the extra that a format takes.
EXTRAS = {
    **dict.fromkeys(("a.parquet", "a.arrow", "a.feather"), ("pyarrow", "arrow")),
    **dict.fromkeys(("a.las", "a.laz"), ("laspy", "las")),
    "a.e57": ("pye57", "e57"),
    "a.foxglove.mcap": ("mcap_protobuf.writer", "foxglove"),
    "a.rrd": ("rerun", "rerun"),
    "a.zarr": ("zarr", "zarr"),
}
#: the libraries that built-in formats take, by suffix.
LIBRARIES = {
    **{
        name.removeprefix("a"): (library.partition(".")[0],)
        for name, (library, _) in EXTRAS.items()
    },
    **dict.fromkeys((".mcap", ".bag", ".rosbag2", ".db3"), ("rosbags", "mcap")),
    ".lzf.pcd": ("lzf",),
}
#: every built-in format; those that take a library of others are left to `make test-all`.
BUILT_IN = [
    pytest.param(
        f"a{suffix}",
        marks=[pytest.mark.slow, needs(*LIBRARIES[suffix])] if suffix in LIBRARIES else (),
    )
    for suffix in sorted(formats())
]
COLUMNS = ["x", "y", "z", "range", "azimuth", "elevation", "intensity", "time"]


def scan(number: int, points: int = 5, *, intensity: bool = True) -> Scan:
    source = np.random.default_rng(number)
    xyz = source.normal(size=(3, points)).astype(np.float32)
    valid = np.arange(points) != 1
    cloud = PointCloud(
        x=np.where(valid, xyz[0], np.nan),
        y=np.where(valid, xyz[1], np.nan),
        z=np.where(valid, xyz[2], np.nan),
        range=np.where(valid, np.linalg.norm(xyz, axis=0), np.inf).astype(np.float32),
        azimuth=np.arctan2(xyz[1], xyz[0]),
        elevation=np.zeros(points, np.float32),
        time=np.arange(points) * 1e-9,
        valid=valid,
        intensity=source.integers(0, 255, points).astype(np.float32) if intensity else None,
        stamp_ns=10**18 + number,
    )
    return Scan(cloud, 10.0 + number, number > 0, ls.sensor("ldrobot-stl27l"))


def rows(path: Path) -> tuple[list[str], np.ndarray]:
    header, *lines = path.read_text(encoding="ascii").splitlines()
    return header.split(","), np.array(
        [[float(cell) for cell in line.split(",")] for line in lines]
    )


@pytest.mark.parametrize("every_point", [False, True])
def test_csv_holds_the_columns_of_the_clouds(tmp_path: Path, every_point: bool) -> None:
    scans = [scan(0), scan(1, points=20_000), scan(2, points=2)]
    write(tmp_path / "a.csv", scans, every_point=every_point)
    header, values = rows(tmp_path / "a.csv")
    assert header == [*COLUMNS, "scan"]
    clouds = [one.points if every_point else one.points[one.points.valid] for one in scans]
    for index, name in enumerate(COLUMNS):
        expected = np.concatenate([cloud.columns[name] for cloud in clouds])
        np.testing.assert_allclose(values[:, index], expected, rtol=5.1e-7, atol=0)
    np.testing.assert_array_equal(
        values[:, -1], np.repeat([0, 1, 2], [len(cloud) for cloud in clouds])
    )


def test_compressed_text_is_the_same_text_and_always_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.csv", "a.csv.gz", "b.csv.gz"):
        write(tmp_path / name, [scan(0), scan(1, points=20_000)])
    assert (
        gzip.decompress((tmp_path / "a.csv.gz").read_bytes()) == (tmp_path / "a.csv").read_bytes()
    )
    assert (tmp_path / "a.csv.gz").read_bytes() == (tmp_path / "b.csv.gz").read_bytes()


@pytest.mark.parametrize("every_point", [False, True])
def test_npz_holds_the_columns_of_the_clouds_and_the_stamps(
    tmp_path: Path, every_point: bool
) -> None:
    scans = [scan(0), scan(1)]
    write(tmp_path / "a.npz", scans, every_point=every_point)
    with np.load(tmp_path / "a.npz") as arrays:
        assert list(arrays) == [*COLUMNS, "scan", "stamp_ns", "rate_hz", "complete"]
        for name in COLUMNS:
            expected = np.concatenate(
                [one.points.columns[name][one.points.valid | every_point] for one in scans]
            )
            assert arrays[name].dtype == expected.dtype
            np.testing.assert_array_equal(arrays[name], expected)
        assert arrays["stamp_ns"].tolist() == [10**18, 10**18 + 1]
        assert arrays["rate_hz"].tolist() == [10, 11]
        assert arrays["complete"].tolist() == [False, True]


def test_no_scan_at_all_is_a_file_without_points(tmp_path: Path) -> None:
    write(tmp_path / "a.npz", [])
    with np.load(tmp_path / "a.npz") as arrays:
        assert {name: array.shape for name, array in arrays.items()} == dict.fromkeys(
            ["scan", "stamp_ns", "rate_hz", "complete"], (0,)
        )


def test_a_column_that_a_sensor_lacks_is_left_out(tmp_path: Path) -> None:
    write(tmp_path / "a.csv", [scan(0, intensity=False)])
    assert rows(tmp_path / "a.csv")[0] == [
        *(name for name in COLUMNS if name != "intensity"),
        "scan",
    ]
    write(tmp_path / "a.csv", [scan(0), scan(1, intensity=False)])
    header, values = rows(tmp_path / "a.csv")
    assert np.isnan(values[-4:, header.index("intensity")]).all()


@pytest.mark.parametrize("name", [*BUILT_IN, "a%d.pcd"])
def test_one_scan_is_held_at_a_time(tmp_path: Path, name: str) -> None:
    clouds: list[weakref.ref[PointCloud]] = []
    most = 0

    def scans() -> Iterator[Scan]:
        nonlocal most
        for number in range(30):
            one = scan(number)
            clouds.append(weakref.ref(one.points))
            most = max(most, sum(cloud() is not None for cloud in clouds))
            yield one
            del one

    write(tmp_path / name, scans(), every_point=True)
    assert most <= 2


BINARY = [case for case in BUILT_IN if case.values[0] not in ("a.csv", "a.csv.gz", "a.xyz")]


@pytest.mark.slow
@pytest.mark.parametrize("name", BINARY)
def test_the_memory_does_not_grow_with_the_number_of_scans(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tables, "MIN_GROUP_ROWS", 10_000)
    monkeypatch.setattr(arrays, "POINT_CHUNK", 10_000)
    peaks = []
    for number in (20, 60):
        tracemalloc.start()
        write(
            tmp_path / name, (scan(index, points=2000) for index in range(number)), every_point=True
        )
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 300_000, peaks  # bytes; the longer file has up to 5 MB


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("old", encoding="ascii")

    def scans() -> Iterator[Scan]:
        yield scan(0)
        raise ReplyTimeout("the line broke")  # which is an OSError, too, and stays what it is

    with pytest.raises(ReplyTimeout, match="the line broke"):
        write(tmp_path / name, scans())
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text(encoding="ascii") == "old"


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_full_disk_is_a_source_error_and_leaves_nothing(tmp_path: Path, name: str) -> None:
    with file_size_limit(4096), pytest.raises(SourceError, match=name):
        write(tmp_path / name, (scan(number, points=5000) for number in range(40)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", EXTRAS)
def test_a_missing_library_is_named_with_a_command(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, EXTRAS[name][0], None)
    with pytest.raises(LibraryError) as caught:
        write(tmp_path / name, [scan(0)])
    assert caught.value.extra == EXTRAS[name][1]
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_a_source_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"none.a\.csv"):
        write(tmp_path / "none" / "a.csv", [scan(0)])


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("a.cvs", "did you mean '.csv'"),
        ("a", "unknown format 'a'"),
        ("a.np", "did you mean '.npy' or '.npz'"),
        ("a.csv.g", "did you mean '.csv.gz'"),
        ("a.dxf", "unknown format '.dxf'"),
    ],
)
def test_an_unknown_suffix_gets_a_suggestion(name: str, told: str) -> None:
    with pytest.raises(UnknownFormat, match=told):
        format_of(name)


def test_suffixes_are_known_in_capitals() -> None:
    assert format_of("A.CSV") is formats()[".csv"]


def test_a_plugin_adds_a_format(tmp_path: Path) -> None:
    script = f"""
from pathlib import Path
import lidarspec as ls
from lidarspec.formats import format_of, formats, write
from lidarspec.spec import hookimpl
from lidarspec.plugins import registry
from lidarspec.errors import UnknownFormat
from lidarspec.spec import Format

class Plugin:
    @hookimpl
    def lidarspec_formats(self):
        def lines(path, scans, *, every_point):
            Path(path).write_text(f"{{len(list(scans))}} scans, {{every_point}}")
        return [Format(".count", "how many", lines), Format(".csv", "not mine", lines)]

registry().add(Plugin(), name="by hand")
assert formats()[".csv"].description.startswith("comma")
assert format_of("a.count").description == "how many"
write(r"{tmp_path / "a.count"}", [1, 2, 3], every_point=True)
try:
    format_of("a.coumt")
except UnknownFormat as error:
    assert "did you mean '.count'" in str(error)
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)
    assert (tmp_path / "a.count").read_text(encoding="utf-8") == "3 scans, True"


@pytest.mark.slow
def test_a_failing_hook_is_a_spec_error() -> None:
    script = """
import lidarspec as ls
from lidarspec.formats import format_of
from lidarspec.spec import hookimpl
from lidarspec.plugins import registry
from lidarspec.errors import UnknownFormat
from lidarspec.spec import Format

class Plugin:
    @hookimpl
    def lidarspec_formats(self):
        raise ZeroDivisionError("by hand")

registry().add(Plugin(), name="by hand")
assert format_of("a.csv")
try:
    format_of("a.count")
except ls.SpecError as error:
    assert "ZeroDivisionError: by hand" in str(error)
else:
    raise SystemExit("no error")
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)


@pytest.mark.parametrize("name", ["a.csv", "a.npz"])
def test_further_columns_are_written_under_their_names_in_their_types(
    tmp_path: Path, name: str
) -> None:
    sensor = SHAPES["shape-extras"]
    scans = list(sensor.scans(simulate(sensor, 60)))
    write(tmp_path / name, scans, every_point=True)
    if name == "a.csv":
        header, values = rows(tmp_path / name)
        assert header[-7:] == [
            "velocity",
            "near_ir",
            "signal",
            "tag",
            "confidence",
            "strong",
            "scan",
        ]
        found = dict(zip(header, values.T, strict=True))
    else:
        with np.load(tmp_path / name) as arrays:
            found = dict(arrays)
        assert {key: value.tolist() for key, value in found.items() if key.endswith(".unit")} == {
            "velocity.unit": ["m/s"],
            "signal.unit": ["photons"],
            "confidence.unit": ["1"],
        }
        assert found["signal"].dtype == np.uint32
    for key in scans[0].points.extra:
        np.testing.assert_allclose(
            found[key], np.concatenate([one.points.extra[key] for one in scans]), rtol=5.1e-7
        )


def test_text_keeps_the_digits_of_double_columns(tmp_path: Path) -> None:
    precise = np.arange(5) / 3 + 1e6
    one = scan(0)
    with_column = replace(one, points=replace(one.points, extra={"precise": precise}))
    write(tmp_path / "a.csv", [with_column], every_point=True)
    header, values = rows(tmp_path / "a.csv")
    np.testing.assert_allclose(values[:, header.index("precise")], precise, rtol=1e-14)


@pytest.mark.skipif(os.name != "posix", reason="other systems cannot tell whether a process runs")
def test_part_of_a_killed_process_is_removed_by_the_next_write(tmp_path: Path) -> None:
    target = tmp_path / "a.csv"
    killed = tmp_path / f".{2**31 - 1}.a.csv"  # above the largest process id
    running = tmp_path / f".{os.getppid()}.a.csv"
    recent = tmp_path / f".{2**31 - 2}.a.csv"
    other = tmp_path / ".notes.a.csv"
    for path in (killed, running, recent, other):
        path.touch()
    for path in (killed, running, other):
        os.utime(path, (0, 0))
    with replace_file(target) as part:
        part.touch()
    assert {path.name for path in tmp_path.iterdir()} == {
        path.name for path in (target, running, recent, other)
    }
