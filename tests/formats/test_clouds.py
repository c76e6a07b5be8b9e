"""Point clouds are read by libraries of others: what they find is what the scans hold, in the precision of the format."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pypcd4
import pytest

from lidarspec import PointCloud, Scan, UsageError
from lidarspec.errors import LibraryError
from lidarspec.formats import write
from lidarspec.points.cloud import STRUCTURED
from lidarspec.simulation.simulator import simulate
from tests.formats.test_formats import scan
from tests.shapes import SHAPES

NAMES = ["x", "y", "z", "intensity", "time"]
Columns = Mapping[str, np.ndarray]


def extras() -> list[Scan]:
    """Lazy scans with columns of a sensor's own."""
    sensor = SHAPES["shape-extras"]
    return list(sensor.scans(simulate(sensor, 60)))


def picture(*, columns: int = 4, rows: int = 3) -> Scan:
    """One organised scan; `ring` is the row of a point."""
    one = scan(0, columns * rows)
    return replace(one, points=replace(one.points, shape=(columns, rows), ring=np.tile(np.arange(rows, dtype=np.uint16), columns)))


def pcd(path: Path) -> Columns:
    cloud = pypcd4.PointCloud.from_path(path)
    assert cloud.metadata.points == cloud.metadata.width * cloud.metadata.height
    return {name: cloud.pc_data[name] for name in cloud.fields}


def ply(path: Path) -> Columns:
    data = plyfile.PlyData.read(path)["vertex"].data
    return {name: data[name] for name in data.dtype.names}


def npy(path: Path) -> Columns:
    data = np.load(path, mmap_mode="r")
    return {name: data[name] for name in data.dtype.names if name != "ring"}


def kitti(path: Path) -> Columns:
    return dict(zip(NAMES, np.fromfile(path, "<f4").reshape(-1, 4).T, strict=False))


def xyz(path: Path) -> Columns:
    return dict(zip("xyz", np.loadtxt(path, ndmin=2).T, strict=True))


READERS: Mapping[str, Callable[[Path], Columns]] = {
    "a.pcd": pcd, "a.lzf.pcd": pcd, "a.ply": ply, "a.npy": npy, "a.bin": kitti, "a.xyz": xyz,
}  # fmt: skip


CODES = ("b1", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8")
#: types of columns, and those that they have in a file.
PCD = {**{code: code for code in CODES}, "b1": "u1", "f2": "f4"}
PLY = {**PCD, "i1": "i4", "i2": "i4", "u2": "i4", "u4": "f8", "i8": "f8", "u8": "f8"}
TYPES = {"a.pcd": PCD, "a.lzf.pcd": PCD, "a.ply": PLY, "a.npy": {code: code for code in CODES}}


def expected(scans: Sequence[Scan], name: str, *, every_point: bool) -> np.ndarray:
    return np.concatenate([one.points.read(name)[name][one.points.valid | every_point] for one in scans])


@pytest.mark.parametrize("every_point", [False, True])
@pytest.mark.parametrize("name", READERS)
def test_what_is_read_is_what_was_written(tmp_path: Path, name: str, every_point: bool) -> None:
    scans = [scan(0, 7), scan(1, 0), scan(2, 1), scan(3, 30_001)]
    write(tmp_path / name, scans, every_point=every_point)
    found = READERS[name](tmp_path / name)
    assert list(found) == {"a.bin": NAMES[:4], "a.xyz": NAMES[:3]}.get(name, [*NAMES, "scan"])
    for column, values in found.items():
        if column == "scan":
            lengths = [len(expected([one], "x", every_point=every_point)) for one in scans]
            np.testing.assert_array_equal(values, np.repeat([0, 1, 2, 3], lengths))
        else:
            np.testing.assert_allclose(values, expected(scans, column, every_point=every_point), rtol=5.1e-7 if name == "a.xyz" else 6e-8)


@pytest.mark.parametrize("name", TYPES)
def test_further_columns_keep_their_numbers_and_units(tmp_path: Path, name: str) -> None:
    own = {f"own_{code}": np.array([0, 1, 1, 0, 1], code) for code in TYPES[name]}
    one = scan(0)
    write(tmp_path / name, [replace(one, points=replace(one.points, extra=own, units={"own_f4": "m/s"}))], every_point=True)
    found = READERS[name](tmp_path / name)
    assert list(found) == [*NAMES, *own]
    assert {key: found[key].dtype.str[1:] for key in own} == {f"own_{code}": known for code, known in TYPES[name].items()}
    for key, column in own.items():
        np.testing.assert_array_equal(found[key], column)
    if name != "a.npy":
        head = (tmp_path / name).read_bytes()[:1000].decode("ascii", "replace")
        assert "sensor ldrobot-stl27l\n" in head
        assert f"stamp_ns {10**18}\n" in head
        assert "unit own_f4 m/s\n" in head


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("scans", [[], [scan(0, 0)]], ids=["no scan", "no point"])
def test_without_a_point_there_is_a_file_without_rows(tmp_path: Path, name: str, scans: list[Scan]) -> None:
    write(tmp_path / name, scans)
    if name == "a.xyz":
        assert (tmp_path / name).read_bytes() == b""
    else:
        assert {len(column) for column in READERS[name](tmp_path / name).values()} == {0}


@pytest.mark.parametrize("name", READERS)
def test_what_a_sensor_lacks_is_left_out_and_what_a_later_scan_lacks_is_0(tmp_path: Path, name: str) -> None:
    write(tmp_path / name, [scan(0, intensity=False)])
    found = READERS[name](tmp_path / name)
    if name in ("a.npy", "a.bin"):  # of one layout always
        assert not found["intensity"].any()
    else:
        assert "intensity" not in found
    write(tmp_path / name, [scan(0), scan(1, intensity=False)])
    if name != "a.xyz":
        np.testing.assert_array_equal(READERS[name](tmp_path / name)["intensity"][-4:], 0)


def test_npy_has_the_layout_of_pcl(tmp_path: Path) -> None:
    write(tmp_path / "a.npy", [picture()], every_point=True)
    found = np.load(tmp_path / "a.npy")
    assert found.dtype == STRUCTURED
    assert found.tobytes() == picture().points.to_structured().tobytes()


@pytest.mark.parametrize("name", ["a.pcd", "a.lzf.pcd"])
def test_a_picture_keeps_its_width_and_height(tmp_path: Path, name: str) -> None:
    write(tmp_path / name, [picture()], every_point=True)
    metadata = pypcd4.PointCloud.from_path(tmp_path / name).metadata
    assert (metadata.width, metadata.height, metadata.viewpoint) == (4, 3, (0, 0, 0, 1, 0, 0, 0))
    found = pcd(tmp_path / name)
    np.testing.assert_array_equal(found["ring"].reshape(3, 4), [[0] * 4, [1] * 4, [2] * 4])
    np.testing.assert_array_equal(found["x"].reshape(3, 4).T.reshape(-1), picture().points.x)


@pytest.mark.parametrize(("scans", "every_point"), [([picture()], False), ([picture(), picture()], True)], ids=["valid only", "two"])
def test_what_is_no_picture_is_one_row(tmp_path: Path, scans: list[Scan], every_point: bool) -> None:
    write(tmp_path / "a.pcd", scans, every_point=every_point)
    metadata = pypcd4.PointCloud.from_path(tmp_path / "a.pcd").metadata
    assert (metadata.width, metadata.height) == (metadata.points, 1)
    np.testing.assert_array_equal(pcd(tmp_path / "a.pcd")["x"], expected(scans, "x", every_point=every_point))


def test_two_returns_of_a_place_stand_side_by_side(tmp_path: Path) -> None:
    one = picture()
    write(tmp_path / "a.pcd", [replace(one, points=replace(one.points, shape=(2, 3), ring=None))], every_point=True)
    assert pypcd4.PointCloud.from_path(tmp_path / "a.pcd").metadata.height == 3
    np.testing.assert_array_equal(pcd(tmp_path / "a.pcd")["x"].reshape(3, 2, 2).swapaxes(0, 1).ravel(), one.points.x)


@pytest.mark.parametrize("points", [1, 32, 70_000])
def test_noise_is_compressed_too(tmp_path: Path, points: int) -> None:
    noise = np.random.default_rng(0).integers(0, 1 << 32, points, dtype=np.uint32).view(np.float32)
    one = scan(0, points)
    write(tmp_path / "a.lzf.pcd", [replace(one, points=replace(one.points, intensity=noise))], every_point=True)
    np.testing.assert_array_equal(pcd(tmp_path / "a.lzf.pcd")["intensity"].view(np.uint32), noise.view(np.uint32))


def test_compressed_points_of_more_than_the_format_can_say_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lidarspec.formats.clouds._MOST_COMPRESSED", 1000)
    with pytest.raises(UsageError, match="4 GiB of points at the most"):
        write(tmp_path / "a.lzf.pcd", [scan(0, 100)])
    assert not list(tmp_path.iterdir())


def test_without_its_library_a_compressed_file_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lzf", None)
    with pytest.raises(LibraryError) as caught:
        write(tmp_path / "a.lzf.pcd", [scan(0)])
    assert caught.value.extra == "pcd"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["a.pcd", "a.lzf.pcd", "a.ply"])
def test_open3d_reads_them(tmp_path: Path, name: str) -> None:
    open3d: Any = pytest.importorskip("open3d", reason="open3d is not installed", exc_type=ImportError)
    scans = [*extras()[:2], picture()][: 2 if name != "a.ply" else 3]
    write(tmp_path / name, scans)
    found = open3d.t.io.read_point_cloud(str(tmp_path / name)).point
    xyz = np.concatenate([one.points.xyz[one.points.valid] for one in scans])
    np.testing.assert_array_equal(found.positions.numpy(), xyz)
    np.testing.assert_array_equal(np.asarray(open3d.io.read_point_cloud(str(tmp_path / name)).points, np.float32), xyz)
    assert {"scan", "time", *scans[0].points.extra} <= set(found)


@pytest.mark.parametrize("name", ["a%d_%02d.pcd", "100%_%05d.ply"])
def test_a_file_for_each_scan(tmp_path: Path, name: str) -> None:
    scans = [scan(0, 7), scan(1, 0), scan(2, 1)]
    write(tmp_path / "new" / name, scans)
    names = [name.replace("%d", str(n)).replace("%02d", f"{n:02}").replace("%05d", f"{n:05}") for n in range(3)]
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == names
    read: Callable[[Path], Any] = READERS["a" + Path(name).suffix]
    assert [len(read(tmp_path / "new" / each)["x"]) for each in names] == [6, 0, 1]


def test_reading_is_the_same_for_lazy_clouds_and_whole_ones(tmp_path: Path) -> None:
    lazy = extras()
    assert not isinstance(lazy[0].points[lazy[0].points.valid], type(lazy[0].points))
    whole = [
        replace(one, points=PointCloud(**{name: getattr(one.points, name) for name in PointCloud.__dataclass_fields__})) for one in lazy
    ]
    for name, scans in (("a.ply", extras()), ("b.ply", whole)):
        write(tmp_path / name, scans)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
