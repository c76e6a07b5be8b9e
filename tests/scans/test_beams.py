"""Tests that a sensor's planar scans share one grid of beams and one line of times."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import LaserScan, Scan, UsageError, simulate
from lidarspec.points.mount import Mount
from lidarspec.scans.beams import PlanarScans


def simulate_scans(name: str, packets: int = 1000) -> list[Scan]:
    """Return the complete scans of a simulated sensor."""
    sensor = ls.sensor(name)
    return [scan for scan in sensor.scans(simulate(sensor, packets)) if scan.whole]


def planar(planes: PlanarScans, scans: Iterable[Scan]) -> list[LaserScan]:
    found = [planes.project(scan) for scan in scans]
    assert None not in found
    return [one for one in found if one is not None]


def beams_of(one: LaserScan, scan: Scan) -> np.ndarray:
    """Return the beam of each point."""
    ahead = scan.points.azimuth.astype(float) - one.angle_min + one.angle_increment / 2
    return np.floor(ahead % (2 * math.pi) / one.angle_increment).astype(int)


def test_a_sensor_that_looks_one_way_has_one_beam() -> None:
    for planes in (PlanarScans(), PlanarScans(beams=360), PlanarScans(field=(-1.0, 1.0))):
        for scan, one in zip(
            scans := simulate_scans("benewake-tfmini"), planar(planes, scans), strict=True
        ):
            assert one.ranges.tolist() == [scan.points.range[scan.points.valid].min()]
            assert one.angle_min == one.angle_max == 0


#: sensors that send text, and do not see the whole turn.
TEXT = [pytest.param(name, marks=pytest.mark.slow) for name in ("hokuyo-utm30lx", "sick-tim571")]


@pytest.mark.parametrize("name", ["ldrobot-stl27l", *TEXT])
def test_each_beam_is_as_late_as_its_points(name: str) -> None:
    """The tolerance is three beams, and two steps of a clock that counts milliseconds."""
    scans = simulate_scans(name)
    found = planar(PlanarScans(), scans)
    assert len(found) > 2
    assert (
        len({(one.angle_min, one.angle_max, one.angle_increment, len(one.ranges)) for one in found})
        == 1
    )
    for one, scan in zip(found, scans, strict=True):
        assert one.angle_max == pytest.approx(
            one.angle_min + (len(one.ranges) - 1) * one.angle_increment
        )
        late = (one.stamp_ns - scan.stamp_ns) * 1e-9 + beams_of(one, scan) * one.time_increment
        off = np.abs(late - scan.points.time)
        # Where two scans meet some points are beyond the end.
        turned = np.abs(off - one.scan_time) < 3 * abs(one.time_increment)
        assert (off[~turned] <= 3 * abs(one.time_increment) + 2e-3).all()
        assert turned.sum() <= 0.04 * len(scan)


def test_beams_cover_the_field_of_view() -> None:
    scan, *_ = simulate_scans("hokuyo-utm30lx")
    (one,) = planar(PlanarScans(), [scan])
    assert (math.degrees(one.angle_min), math.degrees(one.angle_max)) == pytest.approx((-135, 135))
    assert len(one.ranges) == len(scan) == 1081
    np.testing.assert_array_equal(
        one.ranges, np.where(scan.points.valid, scan.points.range, np.inf)
    )
    (fewer,) = planar(PlanarScans(541), [scan])
    assert (fewer.angle_min, fewer.angle_max, len(fewer.ranges)) == (
        one.angle_min,
        one.angle_max,
        541,
    )


def test_a_requested_field_has_its_share_of_the_beams() -> None:
    scans = simulate_scans("ldrobot-stl27l")
    (whole, *_), (half, *_) = (
        planar(PlanarScans(), scans),
        planar(PlanarScans(field=(-math.pi / 2, math.pi / 2)), scans),
    )
    assert len(half.ranges) == len(whole.ranges) // 2 + 1
    assert half.angle_increment == pytest.approx(whole.angle_increment)
    assert (half.angle_min, half.angle_max) == (-math.pi / 2, math.pi / 2)
    (few, *_) = planar(PlanarScans(90, (-math.pi / 2, math.pi / 2)), scans)
    assert (len(few.ranges), few.angle_max) == (90, math.pi / 2)


def test_a_sensor_upside_down_is_planar_and_mirrored() -> None:
    scans = simulate_scans("ldrobot-stl27l")
    over = [replace(scan, points=Mount(inverted=True).apply(scan.points)) for scan in scans]
    (one, *_), (other, *_) = (
        planar(PlanarScans(360, (-math.pi / 2, math.pi / 2)), scans),
        planar(PlanarScans(360, (-math.pi / 2, math.pi / 2)), over),
    )
    assert np.sign(other.time_increment) == -np.sign(one.time_increment)
    assert np.mean(np.isclose(one.ranges, other.ranges[::-1], atol=0.05)) > 0.95


def test_a_ring_or_a_layer_of_a_sensor_of_several_is_planar() -> None:
    scans = [scan for scan in simulate_scans("velodyne-vlp16") if scan.complete]
    scan = scans[0]
    assert PlanarScans().project(scan) is None
    (ring, *_) = planar(PlanarScans(1800, ring=15), scans)
    points = scan.points[scan.points.valid & (scan.points.ring == 15)]
    away = np.hypot(points.x, points.y)
    np.testing.assert_allclose(ring.ranges.min(), away.min(), rtol=1e-6)
    assert (ring.ranges[np.isfinite(ring.ranges)] <= away.max() + 1e-3).all()
    assert np.isfinite(ring.ranges).mean() > 0.9
    (layer, *_) = planar(PlanarScans(1800, heights=(-0.1, 0.1)), scans)
    inside = scan.points[np.abs(scan.points.z) <= 0.1]
    np.testing.assert_allclose(layer.ranges.min(), np.hypot(inside.x, inside.y).min(), rtol=1e-6)
    with pytest.raises(UsageError, match="ring 16"):
        PlanarScans(ring=16).project(scan)
    with pytest.raises(UsageError, match="ring 1 "):
        PlanarScans(ring=1).project(simulate_scans("ldrobot-stl27l")[0])
