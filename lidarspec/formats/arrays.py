"""NumPy's .npz: one array a column, and one entry a scan for the stamps."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lidarspec.points.cloud import COLUMNS, PointCloud
from lidarspec.scans.scans import Scan
from lidarspec.transports.protocol import Format


def write(path: Path, scans: Iterable[Scan], *, every_point: bool) -> None:
    """Write the columns that all scans have, `scan` for each point, and for each scan `stamp_ns`, `rate_hz` and `complete`."""
    clouds: list[PointCloud] = []
    facts: list[tuple[int, float, bool]] = []
    for scan in scans:
        clouds.append(scan.points if every_point else scan.points[scan.points.valid])
        facts.append((scan.stamp_ns, scan.rate_hz, scan.complete))
    names = [name for name in COLUMNS if clouds and all(name in cloud.columns for cloud in clouds)]
    columns = {name: np.concatenate([cloud.columns[name] for cloud in clouds]) for name in names}
    numbers = np.repeat(np.arange(len(clouds), dtype=np.int32), [len(cloud) for cloud in clouds])
    each = np.array(facts, [("stamp_ns", np.int64), ("rate_hz", np.float64), ("complete", np.bool_)])
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, **columns, scan=numbers, **{name: each[name] for name in each.dtype.names or ()})


NPZ = Format(".npz", "NumPy arrays, one a column", write)
