"""Tests of Rerun recordings, read with Rerun's own reader."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.formats import write
from lidarspec.points.appearance import choose_appearance, ramp_positions
from lidarspec.points.mount import Mount
from tests.cli.running import ran
from tests.formats.test_formats import scan
from tests.libraries import Library, needs

pytestmark = [pytest.mark.slow, needs("rerun")]
reading = Library("rerun.chunk")


def read_log(path: Path) -> dict[str, dict[str, list[Any]]]:
    """Return the logged values by path and column, in the order of the scans."""
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for chunk in reading.RrdReader(path).stream():
        found[chunk.entity_path] += chunk.to_record_batch().to_pylist()
    rows = {
        name: sorted(values, key=lambda row: row.get("scan") or 0) for name, values in found.items()
    }
    return {
        name: {column: [row.get(column) for row in values] for column in values[0]}
        for name, values in rows.items()
    }


def ns(times: list[Any]) -> list[int]:
    return [
        time.value if hasattr(time, "value") else np.datetime64(time, "ns").astype(int)
        for time in times
    ]


def test_scans_stand_on_both_clocks_with_their_points(tmp_path: Path) -> None:
    scans = [
        dataclasses.replace(scan(number, points=500), host_ns=2 * 10**18 + number)
        for number in range(3)
    ]
    write(tmp_path / "a.rrd", scans)
    found = read_log(tmp_path / "a.rrd")
    points = found["/ldrobot-stl27l/points"]
    assert points["scan"] == [0, 1, 2]
    assert ns(points["sensor_time"]) == [one.stamp_ns for one in scans]
    assert ns(points["host_time"]) == [one.host_ns for one in scans]
    for number, one in enumerate(scans):
        cloud = one.points[one.points.valid]
        np.testing.assert_array_equal(
            np.array(points["Points3D:positions"][number], np.float32), cloud.xyz
        )
        np.testing.assert_array_equal(
            np.array(points["intensity"][number], np.float32), cloud.intensity
        )
    assert found["/ldrobot-stl27l/statistics/speed_hz"]["Scalars:scalars"] == [
        [10.0],
        [11.0],
        [12.0],
    ]
    assert found["/ldrobot-stl27l/statistics/valid"]["Scalars:scalars"] == [[499.0]] * 3
    assert "model: LDROBOT STL-27L" in found["/ldrobot-stl27l/about"]["TextDocument:text"][0][0]


def test_colours_follow_the_range_on_one_scale(tmp_path: Path) -> None:
    scans = [scan(number, points=300) for number in range(2)]
    write(tmp_path / "a.rrd", scans)
    colours = read_log(tmp_path / "a.rrd")["/ldrobot-stl27l/points"]["Points3D:colors"]
    steps = [
        np.clip(
            ramp_positions(one.points[one.points.valid], choose_appearance(scans[0].points)) * 20,
            0,
            19,
        ).astype(int)
        for one in scans
    ]
    by_step = dict(
        zip(np.concatenate(steps).tolist(), np.concatenate(colours).tolist(), strict=True)
    )
    assert len(set(by_step.values())) == len(by_step) > 5
    assert [by_step[step] for step in np.concatenate(steps).tolist()] == np.concatenate(
        colours
    ).tolist()


def test_the_mount_of_a_sensor_is_reported(tmp_path: Path) -> None:
    mount = Mount(x=1.0, z=2.0, yaw_deg=90.0)
    write(tmp_path / "a.rrd", [dataclasses.replace(scan(0), mount=mount)])
    found = read_log(tmp_path / "a.rrd")
    assert found["/ldrobot-stl27l/sensor"]["Transform3D:translation"] == [[[1.0, 0.0, 2.0]]]
    columns = np.array(found["/ldrobot-stl27l/sensor"]["Transform3D:mat3x3"][0][0]).reshape(3, 3).T
    np.testing.assert_allclose(columns, mount.rotation, atol=1e-7)
    assert f"mount: {mount}" in found["/ldrobot-stl27l/about"]["TextDocument:text"][0][0]


def test_a_device_hands_its_mount_on_with_its_scans(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    (tmp_path / "frames.bin").write_bytes(b"".join(simulate(sensor, 400)))
    (tmp_path / "lidarspec.toml").write_text(
        '[device.front]\nsource = "./frames.bin"\nsensor = "ldrobot-stl27l"\nmount = {z = 0.5}\n'
    )
    monkeypatch.chdir(tmp_path)
    ran("convert", "front", "a.rrd")
    found = read_log(tmp_path / "a.rrd")
    assert found["/ldrobot-stl27l/sensor"]["Transform3D:translation"] == [[[0.0, 0.0, 0.5]]]
    assert np.array(found["/ldrobot-stl27l/points"]["Points3D:positions"][1])[
        :, 2
    ] == pytest.approx(0.5)


def test_view_writes_scans_and_figures(tmp_path: Path) -> None:
    ran("view", "sim:robosense-m1", "--rerun", "-o", tmp_path / "a.rrd", "-t", "2500ms")
    found = read_log(tmp_path / "a.rrd")
    assert len(found["/robosense-m1/points"]["scan"]) > 3
    assert found["/robosense-m1/statistics/packet_rate_hz"]["Scalars:scalars"][-1][0] > 100
    assert "/robosense-m1/statistics/loss_rate" in found


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is a display")
def test_where_no_viewer_can_be_shown_one_line_says_so(tmp_path: Path) -> None:
    hidden = {
        name: value
        for name, value in os.environ.items()
        if name not in ("DISPLAY", "WAYLAND_DISPLAY")
    }
    words = [sys.executable, "-m", "lidarspec", "view", "sim:ldrobot-stl27l", "--rerun"]
    done = subprocess.run(words, env=hidden, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "Rerun's viewer requires a display",
        "  next: lidarspec view SOURCE --rerun -o scans.rrd",
    ]
    assert (
        "needs the suffix .rrd"
        in ran("view", "sim:ldrobot-stl27l", "--rerun", "-o", "a.txt", code=2).stderr
    )
    assert (
        "-o requires --rerun"
        in ran("view", "sim:ldrobot-stl27l", "--web", "-o", "a.rrd", code=2).stderr
    )
    both = ran("view", "sim:ldrobot-stl27l", "--rerun", "--web", code=2)
    assert "cannot be combined" in both.stderr
    assert "require --web" in ran("view", "sim:ldrobot-stl27l", "--rerun", "--open", code=2).stderr
    assert (
        str(tmp_path / "no")
        in ran(
            "view", "sim:ldrobot-stl27l", "--rerun", "-o", tmp_path / "no" / "a.rrd", code=3
        ).stderr
    )
