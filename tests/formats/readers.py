"""Readers of point cloud files for tests.

Some are our own, written from the formats' specifications; others use other libraries. Each returns
the columns of a file by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

Columns = Mapping[str, np.ndarray]
Readers = Mapping[str, Callable[[Path], Columns]]

#: the columns of every cloud that the tests write, in the order of the files.
NAMES = ["x", "y", "z", "intensity", "time"]
#: letters of PCD's types, and those of NumPy.
_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}
_PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}


def pcd_header(path: Path) -> dict[str, list[str]]:
    """Return the words of each line of a PCD header, by the first word."""
    head = path.read_bytes().partition(b"\nDATA ")[0].decode("ascii")
    lines = (line.split() for line in head.splitlines() if not line.startswith("#"))
    return {name: words for name, *words in lines}


def read_pcd(path: Path) -> Columns:
    """Read an uncompressed binary PCD file.

    Source: PCL documentation, the PCD file format, version 0.7.
    """
    header = pcd_header(path)
    kinds = [
        f"<{_PCD_KINDS[kind]}{size}"
        for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)
    ]
    data = path.read_bytes().partition(b"\nDATA binary\n")[2]
    points = np.frombuffer(data, np.dtype(list(zip(header["FIELDS"], kinds, strict=True))))
    assert [len(points)] == [int(number) for number in header["POINTS"]]
    assert len(points) == int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    return {name: points[name] for name in header["FIELDS"]}


def read_ply(path: Path) -> Columns:
    """Read a binary PLY file of vertices (Greg Turk, The PLY Polygon File Format)."""
    head, _, data = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii").splitlines()]
    assert ["format", "binary_little_endian", "1.0"] in lines
    properties = [
        (words[2], f"<{_PLY_TYPES[words[1]]}") for words in lines if words[0] == "property"
    ]
    points = np.frombuffer(data, np.dtype(properties))
    assert ["element", "vertex", str(len(points))] in lines
    return {name: points[name] for name, _ in properties}


def read_npy(path: Path) -> Columns:
    """Read the structured array of an NPY file, without the column "ring".

    No cloud of the tests has this column.
    """
    points = np.load(path, mmap_mode="r")
    return {name: points[name] for name in points.dtype.names if name != "ring"}


def read_kitti(path: Path) -> Columns:
    """Read a file of KITTI: four float32 numbers a point."""
    return dict(zip(NAMES, np.fromfile(path, "<f4").reshape(-1, 4).T, strict=False))


def read_xyz(path: Path) -> Columns:
    """Read a text file of three numbers a line."""
    return dict(zip("xyz", np.loadtxt(path, ndmin=2).T, strict=True))


def read_pcd_by_pypcd4(path: Path) -> Columns:
    """Read a PCD file, compressed or not, by pypcd4."""
    pypcd4 = pytest.importorskip("pypcd4")
    cloud = pypcd4.PointCloud.from_path(path)
    return {name: cloud.pc_data[name] for name in cloud.fields}


def read_ply_by_plyfile(path: Path) -> Columns:
    """Read a PLY file by plyfile."""
    plyfile = pytest.importorskip("plyfile")
    vertices = plyfile.PlyData.read(path)["vertex"].data
    return {name: vertices[name] for name in vertices.dtype.names}


OWN: Readers = {
    "a.pcd": read_pcd,
    "a.ply": read_ply,
    "a.npy": read_npy,
    "a.bin": read_kitti,
    "a.xyz": read_xyz,
}
FOREIGN: Readers = {
    "a.pcd": read_pcd_by_pypcd4,
    "a.lzf.pcd": read_pcd_by_pypcd4,
    "a.ply": read_ply_by_plyfile,
}

#: (name of a file, its reader), where those of other libraries are left to `make test-all`.
READERS = [
    *(pytest.param(name, reader, id=name) for name, reader in OWN.items()),
    *(
        pytest.param(name, reader, id=f"{name} elsewhere", marks=pytest.mark.slow)
        for name, reader in FOREIGN.items()
    ),
]
