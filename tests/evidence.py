"""Vectors and captures for the tests of sensors, and comparison with construct."""

from __future__ import annotations

import functools
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lidarspec import Packets, PointCloud, Sensor
from tests.agreement import assert_same_points
from tests.by_construct import by_construct

_SHARED = Path(__file__).resolve().parents[2] / "shared"
CAPTURES = Path(os.environ.get("LIDARSPEC_CAPTURES", _SHARED / "captures"))
PROTOCOLS = CAPTURES.parent / "protocols"


def capture(name: str) -> Path:
    """Return the path of a capture; skip the test if it is missing."""
    return _present(CAPTURES / name)


@functools.cache
def _read_vectors(file: str) -> dict[str, dict[str, Any]]:
    return {
        vector["id"]: vector
        for vector in json.loads((PROTOCOLS / file).read_text(encoding="utf-8"))
    }


def vectors(file: str) -> dict[str, dict[str, Any]]:
    """Return the test vectors of a file by id; skip the test if it is missing."""
    _present(PROTOCOLS / file)
    return _read_vectors(file)


def vector_bytes(file: str, name: str) -> bytes:
    """Return the bytes of one vector, from the list or from the file that it names."""
    vector = vectors(file)[name]
    return (
        bytes.fromhex(vector["hex"])
        if vector["hex"]
        else _present(PROTOCOLS / vector["file"]).read_bytes()
    )


def _present(path: Path) -> Path:
    if not path.exists():
        pytest.skip(
            f"{path.name} is not here: set LIDARSPEC_CAPTURES to the folder of captures, with"
            " protocols beside it"
        )
    return path


def decode(sensor: Sensor, data: Any, frame: str | None = None) -> Packets:
    """Return the packets of an input.

    Construct has to read the same packets and points, and count the same.
    """
    packets = sensor.decode(data, frame)
    judged = by_construct(sensor).decode(data, frame)
    assert judged.raw.dtype == packets.raw.dtype
    assert judged.raw.tobytes() == packets.raw.tobytes()
    assert judged.stats == packets.stats
    assert judged.time_ns.tolist() == packets.time_ns.tolist()
    if frame is None:
        assert_same_points(judged.points(), packets.points())
    return packets


def clockwise(cloud: PointCloud) -> Any:
    """Return clockwise azimuths: degrees in [0, 360)."""
    return np.rad2deg(-cloud.azimuth.astype(np.float64)) % 360


def assert_points(
    cloud: PointCloud, expected: Iterable[tuple[int, Sequence[float]]], *, atol: float = 2e-5
) -> None:
    """Fail unless the points with these indices are at these x y z."""
    for index, xyz in expected:
        np.testing.assert_allclose(cloud.xyz[index], xyz, atol=atol, err_msg=f"point {index}")
