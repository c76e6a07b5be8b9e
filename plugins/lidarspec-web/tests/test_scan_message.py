"""Tests that scans are equal after encoding as messages and reading back."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan
from lidarspec_web.scan_message import make_scan_message, thin_out

from .messages import parse_message

ALL = 1 << 30
FLAT, SOLID = "ldrobot-stl27l", "robosense-m1"


@functools.cache
def scan_of(sensor: str) -> Scan:
    with ls.open(f"sim:{sensor}") as device:
        return device.latest(20)


def sent(scan: Scan, most: int = ALL) -> bytes:
    return make_scan_message(scan, 12, position=1.5, arrival=1.7e9, max_points=most)


@pytest.mark.parametrize("sensor", [FLAT, SOLID])
def test_a_message_is_the_points_with_a_return(sensor: str) -> None:
    scan = scan_of(sensor)
    header, columns = parse_message(sent(scan))
    returns = np.flatnonzero(scan.points.valid)
    assert 0 < len(returns) == header["points"] == header["of"]
    assert np.array_equal(columns["index"], returns)
    for name in columns.keys() - {"index"}:
        assert np.array_equal(columns[name], getattr(scan.points, name)[returns]), name
    assert {"x", "y", "z", "range", "intensity"} <= columns.keys()
    assert ("ring" in columns) == (scan.points.ring is not None)


def test_the_header_describes_the_scan() -> None:
    scan = scan_of(FLAT)
    header, columns = parse_message(sent(scan))
    assert (header["scan"], header["position"], header["sent"]) == (12, 1.5, 1.7e9)
    assert (header["whole"], header["nominal"]) == (scan.whole, False)
    assert header["rate_hz"] == pytest.approx(scan.rate_hz)
    assert [(column["name"], column["type"], column["unit"]) for column in header["columns"]] == [
        *((name, "f4", "m") for name in ("x", "y", "z", "range")),
        ("intensity", "f4", ""),
        ("index", "u4", ""),
    ]
    assert all(np.isfinite(columns[name]).all() for name in ("x", "y", "z", "range"))


def test_an_unknown_rate_is_null() -> None:
    scan = replace(scan_of(FLAT), rate_hz=float("nan"))
    assert parse_message(sent(scan))[0]["rate_hz"] is None


def test_a_scan_without_returns_is_empty() -> None:
    scan = scan_of(FLAT)
    none = replace(scan, points=scan.points[np.flatnonzero(~scan.points.valid)][:0])
    header, columns = parse_message(sent(none))
    assert header["points"] == header["of"] == 0
    assert all(len(column) == 0 for column in columns.values())


@pytest.mark.parametrize("most", [1, 100, 5000])
def test_points_are_thinned_to_the_requested_number(most: int) -> None:
    scan = scan_of(SOLID)
    header, columns = parse_message(sent(scan, most))
    assert header["of"] == scan.points.valid.sum()
    assert most * 0.98 - 1 <= header["points"] <= most
    assert np.array_equal(columns["x"], scan.points.x[columns["index"]])


@pytest.mark.parametrize("period", [2, 5, 16, 128])
def test_thinning_is_even_over_stretches_and_over_rings(period: int) -> None:
    """One of two points, of a sensor with alternating rings: each ring keeps its half."""
    kept = thin_out(np.arange(100_000), 50_000)
    assert len(np.unique(kept)) == len(kept)
    assert abs(np.diff(np.searchsorted(kept, np.arange(0, 100_001, 100))) - 50).max() <= 3
    of_ring = np.bincount(kept % period, minlength=period) / (100_000 / period)
    assert of_ring == pytest.approx(0.5, abs=0.05)
