"""Tests of Matplotlib figures: scale, units, bounded memory, PNG, PDF and SVG."""

from __future__ import annotations

import dataclasses
import math
import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan, simulate
from lidarspec.errors import UsageError
from lidarspec.points.appearance import choose_appearance, fit_to_points
from lidarspec.view.live_scans import LiveScans
from tests.cli.running import ran
from tests.formats.test_formats import scan
from tests.libraries import Library, needs

pytestmark = [pytest.mark.slow, needs("matplotlib")]
figures = Library("lidarspec.view.matplotlib_figures")


def simulate_scan(name: str, packets: int) -> Scan:
    sensor = ls.sensor(name)
    return next(one for one in sensor.scans(simulate(sensor, packets)) if one.whole)


def offsets(axes: Any) -> np.ndarray:
    """Return the points of a panel, (n, 2)."""
    return np.asarray(axes.collections[0].get_offsets())


def test_a_planar_scan_is_drawn_from_above() -> None:
    one = simulate_scan("ldrobot-stl27l", 600)
    axes, bar = figures.draw_scan(one, choose_appearance(one.points), "title").axes
    cloud = one.points[one.points.valid]
    np.testing.assert_array_equal(offsets(axes), np.stack([cloud.y, cloud.x], axis=1))
    assert axes.get_aspect() == 1  # metres alike
    left, right = axes.get_xlim()
    assert left == -right == choose_appearance(one.points).reach
    assert (axes.get_xlabel(), axes.get_ylabel(), bar.get_ylabel()) == (
        "y [m], left",
        "x [m], forward",
        "range [m]",
    )


def test_a_scan_with_heights_is_seen_from_its_side_too() -> None:
    one = simulate_scan("velodyne-vlp16", 160)
    above, side, bar = figures.draw_scan(
        one, choose_appearance(one.points, ramp="intensity"), "title"
    ).axes
    cloud = one.points[one.points.valid]
    np.testing.assert_array_equal(offsets(side), np.stack([cloud.x, cloud.z], axis=1))
    np.testing.assert_array_equal(above.collections[0].get_array(), cloud.intensity)
    assert (side.get_xlabel(), side.get_ylabel(), side.get_aspect(), bar.get_ylabel()) == (
        "x [m], forward",
        "z [m], up",
        1,
        "intensity",
    )


def test_a_fitted_scan_fills_the_panel() -> None:
    one = simulate_scan("velodyne-vlp16", 160)
    above, side, _ = figures.draw_scan(
        one, fit_to_points(one.points, choose_appearance(one.points)), "title"
    ).axes
    cloud = one.points[one.points.valid]
    spans = [np.ptp(np.quantile(cloud.x, (0.01, 0.99))), np.ptp(np.quantile(cloud.y, (0.01, 0.99)))]
    for limits in (above.get_xlim(), above.get_ylim(), side.get_xlim()):
        assert max(spans) / abs(limits[1] - limits[0]) > 0.85


def test_every_intensity_is_counted() -> None:
    scans = [scan(number, points=2000) for number in range(3)]
    (axes,) = figures.draw_intensities(iter(scans), "title").axes
    counts = [patch.get_height() for patch in axes.patches]
    assert sum(counts) == sum(int(one.points.valid.sum()) for one in scans)
    strengths = np.concatenate(
        [
            one.points.intensity[one.points.valid]
            for one in scans
            if one.points.intensity is not None
        ]
    )
    edges = [patch.get_x() for patch in axes.patches] + [
        axes.patches[-1].get_x() + axes.patches[-1].get_width()
    ]
    np.testing.assert_array_equal(counts, np.histogram(strengths, edges)[0])
    with pytest.raises(UsageError, match="no intensity"):
        figures.draw_intensities([scan(0, intensity=False)], "title")


def at_range(number: int, metres: float) -> Scan:
    one = scan(number, points=500)
    ranges = np.full(500, metres, np.float32)
    points = dataclasses.replace(
        one.points, range=ranges, valid=np.ones(500, np.bool_), stamp_ns=10**18 + number * 10**8
    )
    return dataclasses.replace(one, points=points, whole=True)


def test_ranges_stand_at_their_time() -> None:
    axes, _ = figures.draw_ranges(
        [at_range(number, 2.0 + number) for number in range(10)], "title"
    ).axes
    mesh = axes.collections[0]
    counts = np.ma.filled(mesh.get_array(), 0).reshape(200, 10)
    edges = mesh.get_coordinates()
    np.testing.assert_allclose(edges[0, :, 0], np.arange(11) / 10, atol=1e-9)
    for number in range(10):
        (row,) = np.flatnonzero(counts[:, number])
        assert edges[row, 0, 1] <= 2.0 + number < edges[row + 1, 0, 1]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time from the first scan [s]", "range [m]")


def test_a_long_source_is_held_in_part() -> None:
    peaks = []
    for number in (900, 1800):
        tracemalloc.start()
        figure = figures.draw_ranges((at_range(index, 2.0) for index in range(number)), "title")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert f"{number:,} scans, of which one in" in figure.get_suptitle()
    assert peaks[1] < 1.5 * peaks[0]


@pytest.fixture(scope="module")
def lossy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("figures") / "lossy.pcap"
    ran("sim", "velodyne-vlp16", "--to", path, "-t", "3s", "--loss", "10%", "--seed", "1")
    return path


def test_rates_are_those_of_stats(lossy: Path) -> None:
    with ls.open(lossy) as device:
        feed = LiveScans(device)
        rates = figures.RateSeries(feed, math.inf)
        reading = feed.meter.summary(device.stats)
    assert rates.totals[0].sum() == reading.packets
    packets, scans, lost, wrong = figures.draw_rates(rates, "title").axes
    assert [axes.get_ylabel() for axes in (packets, scans, lost, wrong)] == [
        "packets [1/s]",
        "scans [1/s]",
        "lost [%]",
        "invalid [%]",
    ]
    values, edges, _ = packets.patches[0].get_data()
    assert np.median(values) == pytest.approx(reading.packet_rate_hz, rel=0.1)
    assert np.diff(edges) == pytest.approx(0.1)
    shares, _, _ = lost.patches[0].get_data()
    assert np.average(shares, weights=values) == pytest.approx(
        100 * (reading.loss_rate or 0), rel=0.2
    )
    assert 5 < 100 * (reading.loss_rate or 0) < 15
    assert not wrong.patches[0].get_data().values.any()


def test_packets_without_times_are_refused(tmp_path: Path) -> None:
    sensor = ls.sensor("camsense-x1")
    (tmp_path / "a.bin").write_bytes(b"".join(simulate(sensor, 100)))
    assert (
        "packets have no times"
        in ran(
            "plot",
            tmp_path / "a.bin",
            "-s",
            sensor.id,
            "--kind",
            "rates",
            "-o",
            tmp_path / "a.png",
            code=2,
        ).stderr
    )
    assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.parametrize("kind", ["scan", "intensity", "ranges", "rates"])
def test_plot_writes_every_kind_as_a_small_png(lossy: Path, tmp_path: Path, kind: str) -> None:
    ran("plot", lossy, "--kind", kind, "-o", tmp_path / "a.png")
    data = (tmp_path / "a.png").read_bytes()
    assert data.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", data[16:24])
    assert 1000 < width < 1300
    assert 400 < height < 2000
    assert len(data) < 250_000
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_figures_are_vectors_too_and_the_same_bytes_again(lossy: Path, tmp_path: Path) -> None:
    ran("plot", lossy, "--kind", "rates", "-o", tmp_path / "a.pdf")
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    printed = [ran("plot", lossy, "--kind", "rates", "-o", "-").stdout for _ in range(2)]
    assert printed[0] == printed[1]
    assert printed[0].startswith("<?xml")
    assert (
        "expected a file name that ends in .png, .pdf, .svg"
        in ran("plot", lossy, "-o", tmp_path / "a.jpg", code=2).stderr
    )


def test_a_live_source_is_drawn_for_a_while(tmp_path: Path) -> None:
    for kind in ("ranges", "rates"):
        ran(
            "plot", "sim:ldrobot-stl27l", "--kind", kind, "-t", "1s", "-o", tmp_path / f"{kind}.png"
        )
        assert (tmp_path / f"{kind}.png").stat().st_size > 10_000
