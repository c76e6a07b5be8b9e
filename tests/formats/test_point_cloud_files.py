"""Tests of point cloud files: they hold the points in the precision of the format."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarspec import PointCloud, Scan, UsageError, simulate
from lidarspec.errors import LibraryError
from lidarspec.formats import write
from lidarspec.points.table_types import STRUCTURED
from tests.formats.readers import FOREIGN, NAMES, OWN, READERS, Columns, pcd_header, read_pcd
from tests.formats.test_formats import scan
from tests.shapes import SHAPES

Reader = Callable[[Path], Columns]
#: readers of formats that keep the types of columns.
TYPED_READERS = [case for case in READERS if case.values[0] not in ("a.bin", "a.xyz")]


def extras() -> list[Scan]:
    """Return lazy scans with further columns."""
    sensor = SHAPES["shape-extras"]
    return list(sensor.scans(simulate(sensor, 60)))


def picture(*, columns: int = 4, rows: int = 3) -> Scan:
    """Return one organised scan; `ring` is the row of a point."""
    one = scan(0, columns * rows)
    return replace(
        one,
        points=replace(
            one.points,
            shape=(columns, rows),
            ring=np.tile(np.arange(rows, dtype=np.uint16), columns),
        ),
    )


CODES = ("b1", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8")
#: types of columns, and those that they have in a file.
PCD = {**{code: code for code in CODES}, "b1": "u1", "f2": "f4"}
PLY = {**PCD, "i1": "i4", "i2": "i4", "u2": "i4", "u4": "f8", "i8": "f8", "u8": "f8"}
TYPES = {"a.pcd": PCD, "a.lzf.pcd": PCD, "a.ply": PLY, "a.npy": {code: code for code in CODES}}


def join_column(scans: Sequence[Scan], name: str, *, every_point: bool) -> np.ndarray:
    return np.concatenate(
        [one.points.read(name)[name][one.points.valid | every_point] for one in scans]
    )


@pytest.mark.parametrize("every_point", [False, True])
@pytest.mark.parametrize(("name", "reader"), READERS)
def test_files_read_back_equal(
    tmp_path: Path, name: str, reader: Reader, every_point: bool
) -> None:
    scans = [scan(0, 7), scan(1, 0), scan(2, 1), scan(3, 30_001)]
    write(tmp_path / name, scans, every_point=every_point)
    found = reader(tmp_path / name)
    assert list(found) == {"a.bin": NAMES[:4], "a.xyz": NAMES[:3]}.get(name, [*NAMES, "scan"])
    for column, values in found.items():
        if column == "scan":
            lengths = [len(join_column([one], "x", every_point=every_point)) for one in scans]
            np.testing.assert_array_equal(values, np.repeat([0, 1, 2, 3], lengths))
        else:
            np.testing.assert_allclose(
                values,
                join_column(scans, column, every_point=every_point),
                rtol=5.1e-7 if name == "a.xyz" else 6e-8,
            )


@pytest.mark.parametrize(("name", "reader"), TYPED_READERS)
def test_further_columns_keep_their_numbers_and_units(
    tmp_path: Path, name: str, reader: Reader
) -> None:
    own = {f"own_{code}": np.array([0, 1, 1, 0, 1], code) for code in TYPES[name]}
    one = scan(0)
    write(
        tmp_path / name,
        [replace(one, points=replace(one.points, extra=own, units={"own_f4": "m/s"}))],
        every_point=True,
    )
    found = reader(tmp_path / name)
    assert list(found) == [*NAMES, *own]
    assert {key: found[key].dtype.str[1:] for key in own} == {
        f"own_{code}": known for code, known in TYPES[name].items()
    }
    for key, column in own.items():
        np.testing.assert_array_equal(found[key], column)
    if name != "a.npy":
        head = (tmp_path / name).read_bytes()[:1000].decode("ascii", "replace")
        assert "sensor ldrobot-stl27l\n" in head
        assert f"stamp_ns {10**18}\n" in head
        assert "unit own_f4 m/s\n" in head


@pytest.mark.parametrize(("name", "reader"), READERS)
@pytest.mark.parametrize("number", [0, 1], ids=["no scan", "no point"])
def test_without_a_point_there_is_a_file_without_rows(
    tmp_path: Path, name: str, reader: Reader, number: int
) -> None:
    write(tmp_path / name, [scan(0, 0)] * number)
    if name == "a.xyz":
        assert (tmp_path / name).read_bytes() == b""
    else:
        assert {len(column) for column in reader(tmp_path / name).values()} == {0}


@pytest.mark.parametrize(("name", "reader"), READERS)
def test_missing_columns_are_omitted_or_0(tmp_path: Path, name: str, reader: Reader) -> None:
    write(tmp_path / name, [scan(0, intensity=False)])
    found = reader(tmp_path / name)
    if name in ("a.npy", "a.bin"):  # of one layout always
        assert not found["intensity"].any()
    else:
        assert "intensity" not in found
    write(tmp_path / name, [scan(0), scan(1, intensity=False)])
    if name != "a.xyz":
        np.testing.assert_array_equal(reader(tmp_path / name)["intensity"][-4:], 0)


def test_npy_has_the_layout_of_pcl(tmp_path: Path) -> None:
    write(tmp_path / "a.npy", [picture()], every_point=True)
    found = np.load(tmp_path / "a.npy")
    assert found.dtype == STRUCTURED
    assert found.tobytes() == picture().points.to_structured().tobytes()


PICTURES = [case for case in READERS if case.values[0].endswith(".pcd")]


@pytest.mark.parametrize(("name", "reader"), PICTURES)
def test_a_picture_keeps_its_width_and_height(tmp_path: Path, name: str, reader: Reader) -> None:
    write(tmp_path / name, [picture()], every_point=True)
    header = pcd_header(tmp_path / name)
    assert (header["WIDTH"], header["HEIGHT"], header["VIEWPOINT"]) == (
        ["4"],
        ["3"],
        ["0", "0", "0", "1", "0", "0", "0"],
    )
    found = reader(tmp_path / name)
    np.testing.assert_array_equal(found["ring"].reshape(3, 4), [[0] * 4, [1] * 4, [2] * 4])
    np.testing.assert_array_equal(found["x"].reshape(3, 4).T.reshape(-1), picture().points.x)


@pytest.mark.parametrize(
    ("number", "every_point"), [(1, False), (2, True)], ids=["valid only", "two"]
)
def test_unorganized_points_are_one_row(tmp_path: Path, number: int, every_point: bool) -> None:
    scans = [picture()] * number
    write(tmp_path / "a.pcd", scans, every_point=every_point)
    header = pcd_header(tmp_path / "a.pcd")
    assert (header["WIDTH"], header["HEIGHT"]) == (header["POINTS"], ["1"])
    np.testing.assert_array_equal(
        read_pcd(tmp_path / "a.pcd")["x"], join_column(scans, "x", every_point=every_point)
    )


def test_two_returns_of_a_place_stand_side_by_side(tmp_path: Path) -> None:
    one = picture()
    write(
        tmp_path / "a.pcd",
        [replace(one, points=replace(one.points, shape=(2, 3), ring=None))],
        every_point=True,
    )
    assert pcd_header(tmp_path / "a.pcd")["HEIGHT"] == ["3"]
    np.testing.assert_array_equal(
        read_pcd(tmp_path / "a.pcd")["x"].reshape(3, 2, 2).swapaxes(0, 1).ravel(), one.points.x
    )


@pytest.mark.slow
@pytest.mark.parametrize("points", [1, 32, 70_000])
def test_noise_is_compressed_too(tmp_path: Path, points: int) -> None:
    noise = np.random.default_rng(0).integers(0, 1 << 32, points, dtype=np.uint32).view(np.float32)
    one = scan(0, points)
    write(
        tmp_path / "a.lzf.pcd",
        [replace(one, points=replace(one.points, intensity=noise))],
        every_point=True,
    )
    np.testing.assert_array_equal(
        FOREIGN["a.lzf.pcd"](tmp_path / "a.lzf.pcd")["intensity"].view(np.uint32),
        noise.view(np.uint32),
    )


@pytest.mark.slow
def test_too_many_compressed_points_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lidarspec.formats.point_cloud_files._MAX_COMPRESSED_BYTES", 1000)
    with pytest.raises(UsageError, match="4 GiB"):
        write(tmp_path / "a.lzf.pcd", [scan(0, 100)])
    assert not list(tmp_path.iterdir())


def test_a_missing_compression_library_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lzf", None)
    with pytest.raises(LibraryError) as caught:
        write(tmp_path / "a.lzf.pcd", [scan(0)])
    assert caught.value.extra == "pcd"
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["a.pcd", "a.lzf.pcd", "a.ply"])
def test_open3d_reads_them(tmp_path: Path, name: str) -> None:
    open3d: Any = pytest.importorskip(
        "open3d", reason="open3d is not installed", exc_type=ImportError
    )
    scans = [*extras()[:2], picture()][: 2 if name != "a.ply" else 3]
    write(tmp_path / name, scans)
    found = open3d.t.io.read_point_cloud(str(tmp_path / name)).point
    xyz = np.concatenate([one.points.xyz[one.points.valid] for one in scans])
    np.testing.assert_array_equal(found.positions.numpy(), xyz)
    np.testing.assert_array_equal(
        np.asarray(open3d.io.read_point_cloud(str(tmp_path / name)).points, np.float32), xyz
    )
    assert {"scan", "time", *scans[0].points.extra} <= set(found)


@pytest.mark.parametrize("name", ["a%d_%02d.pcd", "100%_%05d.ply"])
def test_a_file_for_each_scan(tmp_path: Path, name: str) -> None:
    scans = [scan(0, 7), scan(1, 0), scan(2, 1)]
    write(tmp_path / "new" / name, scans)
    names = [
        name.replace("%d", str(n)).replace("%02d", f"{n:02}").replace("%05d", f"{n:05}")
        for n in range(3)
    ]
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == names
    read = OWN["a" + Path(name).suffix]
    assert [len(read(tmp_path / "new" / each)["x"]) for each in names] == [6, 0, 1]


def test_reading_is_the_same_for_lazy_clouds_and_whole_ones(tmp_path: Path) -> None:
    lazy = extras()
    assert not isinstance(lazy[0].points[lazy[0].points.valid], type(lazy[0].points))
    whole = [
        replace(
            one,
            points=PointCloud(
                **{name: getattr(one.points, name) for name in PointCloud.__dataclass_fields__}
            ),
        )
        for one in lazy
    ]
    for name, scans in (("a.ply", extras()), ("b.ply", whole)):
        write(tmp_path / name, scans)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
