"""Write point clouds: PCD of the Point Cloud Library, PLY, and the .bin of KITTI.

If several scans are written, the field `scan` has the number of the scan.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, suggest
from lidarspec.formats.common import ColumnSpool
from lidarspec.formats.point_rows import PointRows, make_padding, write_rows
from lidarspec.optional_libraries import import_library
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Format

#: The replacements of types that a format or its common readers do not support. A 64-bit integer
#: becomes a float, which is exact up to 2**53.
_PCD_TYPES = {"f2": "f4", "b1": "u1"}
_PLY_TYPES = {
    **_PCD_TYPES,
    **dict.fromkeys(("i1", "i2", "u2"), "i4"),
    **dict.fromkeys(("u4", "i8", "u8"), "f8"),
}
_PLY_NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}
#: The largest size that the field before compressed points can express, bytes.
_MAX_COMPRESSED_BYTES = (1 << 32) - 1


def write_pcd(
    path: Path, scans: Iterable[Scan], *, every_point: bool, organized: bool = False
) -> None:
    """Write a binary PCD 0.7 file.

    If every point of a single organized scan is written, WIDTH and HEIGHT are the shape of the
    scan.
    """
    write_rows(path, _make_pcd_rows(scans, every_point=every_point), _make_pcd_header)


def write_lzf_pcd(
    path: Path, scans: Iterable[Scan], *, every_point: bool, organized: bool = False
) -> None:
    """Write a PCD file like `write_pcd`, compressed with LZF (DATA binary_compressed).

    Raises:
        UsageError: if the points have 4 GiB or more, which the format does not support.
    """
    compress = import_library("lzf", "pcd").compress
    rows = _make_pcd_rows(scans, every_point=every_point)
    with contextlib.ExitStack() as files, path.open("wb") as target:
        names = rows.dtype.names or ()
        fields = {
            name: files.enter_context(contextlib.closing(ColumnSpool(path.parent, np.uint8)))
            for name in names
        }
        for block in rows:
            _refuse_size(rows.length * rows.dtype.itemsize)
            for name, field in fields.items():
                # Concatenated compressed blocks are a valid compressed field.
                field.add(_compress(block[name], compress))
        start = target.write(_make_pcd_header(rows, "binary_compressed")) + 8
        target.seek(start)
        for field in fields.values():
            field.copy_to(target)
        sizes = [target.tell() - start, rows.length * rows.dtype.itemsize]
        _refuse_size(max(sizes))
        target.seek(start - 8)
        target.write(np.array(sizes, "<u4").tobytes())


def _compress(values: NDArray[Any], compress: Any) -> NDArray[np.uint8]:
    data = values.tobytes()
    if not data:
        return np.empty(0, np.uint8)
    max_compressed_size = len(data) + len(data) // 16 + 64  # reached by noise
    return np.frombuffer(compress(data, max_compressed_size), np.uint8)


def _refuse_size(size: int) -> None:
    if size > _MAX_COMPRESSED_BYTES:
        reason = "a compressed PCD file can contain at most 4 GiB of points"
        raise suggest(
            UsageError(reason),
            "repeat with a .pcd file, or with a file for each scan: %05d.lzf.pcd",
        )


def _make_pcd_rows(scans: Iterable[Scan], *, every_point: bool) -> PointRows:
    return PointRows(
        scans,
        lambda types: _packed_dtype(types, _PCD_TYPES),
        every_point=every_point,
        is_image=True,
    )


def _make_pcd_header(rows: PointRows, data: str = "binary") -> bytes:
    width, height = rows.shape or (rows.length, 1)
    types = [rows.dtype[name] for name in rows.dtype.names or ()]
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format" + make_padding(width, rows.length),
        *(f"# {fact}" for fact in rows.facts),
        "VERSION 0.7",
        f"FIELDS {' '.join(rows.dtype.names or ())}",
        f"SIZE {' '.join(str(dtype.itemsize) for dtype in types)}",
        f"TYPE {' '.join(dtype.kind.upper() for dtype in types)}",
        f"COUNT {' '.join('1' for _ in types)}",
        f"WIDTH {width}",
        f"HEIGHT {height}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {rows.length}",
        f"DATA {data}",
    ]
    return "".join(f"{line}\n" for line in lines).encode("ascii", "replace")


def write_ply(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write a binary little-endian PLY file.

    The types are float, double, uchar or int, because Open3D ignores other types.
    """
    write_rows(
        path,
        PointRows(scans, lambda types: _packed_dtype(types, _PLY_TYPES), every_point=every_point),
        _make_ply_header,
    )


def _make_ply_header(rows: PointRows) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(
            f"comment {fact}"
            for fact in ["made by lidarspec" + make_padding(rows.length), *rows.facts]
        ),
        f"element vertex {rows.length}",
        *(
            f"property {_PLY_NAMES[rows.dtype[name].str[1:]]} {name}"
            for name in rows.dtype.names or ()
        ),
        "end_header",
    ]
    return "".join(f"{line}\n" for line in lines).encode("ascii", "replace")


def _packed_dtype(types: Mapping[str, Any], supported: Mapping[str, str]) -> np.dtype[Any]:
    """Return the dtype of a row without padding; unsupported types are replaced."""
    codes = {name: np.dtype(dtype).str[1:] for name, dtype in types.items()}
    return np.dtype([(name, "<" + supported.get(code, code)) for name, code in codes.items()])


def write_kitti(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write x y z intensity as little-endian float32, without a header.

    The intensity is the raw value, or 0 if the sensor measures no intensity.
    """
    row = np.dtype([(name, "<f4") for name in ("x", "y", "z", "intensity")])
    write_rows(path, PointRows(scans, lambda types: row, every_point=every_point), lambda rows: b"")


PCD = Format(".pcd", "a point cloud of PCL, binary", write_pcd, ("organized",))
LZF_PCD = Format(".lzf.pcd", "a point cloud of PCL, compressed", write_lzf_pcd, ("organized",))
PLY = Format(".ply", "a point cloud, binary", write_ply)
KITTI = Format(".bin", "x y z intensity as in KITTI, float32", write_kitti)
