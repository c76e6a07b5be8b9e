"""Tests of Hesai captures: our points are the published points, and no others.

A published cloud is one revolution in the vendor's axes. It begins where the azimuth of a point
(not of its block) passes 0. It has no second return at the position of the first return, and no
points below a minimum range.

The tests therefore assign our points to revolutions by the azimuth of each point, leave out points
that are nearer than the nearest published point, and compare distinct positions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lidarspec as ls
from lidarspec import PointCloud, Sensor
from lidarspec.captures.pcap import CaptureReader
from tests.evidence import capture, decode

pytestmark = pytest.mark.slow  # captures of many megabytes

PUBLISHED = {"40p": "hesai-pandar40p", "xt32": "hesai-xt32", "qt64": "hesai-qt64"}
TURN = {"40p": 2, "xt32": 3, "qt64": 2}  # which turn of the capture was published
REACH = 0.002
FAST = ls.sensor("hesai-pandar40p")

Points = NDArray[np.float64]


def datagrams(path: Path) -> list[bytes]:
    with path.open("rb") as file:
        return [datagram.data for datagram in CaptureReader(file)]


def configure_sensor(name: str, **more: Any) -> Sensor:
    file = next(capture(f"hesai/{name}").glob("*.csv"))
    sensor: Sensor = ls.sensor(PUBLISHED[name]).configure(calibration=file, **more)
    return sensor


def read_published_points(name: str) -> Points:
    data = next(capture(f"hesai/{name}").glob("*.pcd")).read_bytes()
    _, _, binary = data.partition(b"DATA binary\n")
    return np.frombuffer(binary, "<f4").reshape(-1, 3).astype(np.float64)


def nearest(points: Points, queries: Points) -> NDArray[np.float64]:
    """Return the distance from each query to the nearest point; inf beyond `REACH`.

    The points are sorted into cells of the size `REACH`, so that only adjacent cells are searched.
    """

    def codes(cells: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.asarray((cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2])

    keys = codes(np.floor(points / REACH).astype(np.int64))
    order = np.argsort(keys, kind="stable")
    keys, points = keys[order], points[order]
    cells, best = np.floor(queries / REACH).astype(np.int64), np.full(len(queries), np.inf)
    for step in np.ndindex(3, 3, 3):
        wanted = codes(cells + np.array(step) - 1)
        first, end = np.searchsorted(keys, wanted), np.searchsorted(keys, wanted, side="right")
        for spot in range(int((end - first).max(initial=0))):
            there = first + spot < end
            distance = np.linalg.norm(points[np.where(there, first + spot, 0)] - queries, axis=1)
            best = np.where(there & (distance <= REACH), np.minimum(best, distance), best)
    return best


def turns(cloud: PointCloud) -> NDArray[np.intp]:
    """Return how often the azimuth has passed 0 since the first point, for each point."""
    assert cloud.shape is not None
    clockwise = np.rad2deg(-cloud.azimuth.astype(np.float64)).reshape(cloud.shape)
    return np.asarray(np.unwrap(clockwise, axis=0, period=360) // 360, np.intp).ravel()


def places(cloud: PointCloud, which: NDArray[np.bool_]) -> Points:
    """Return the distinct positions of some of the points, in the vendor's axes."""
    return np.unique(
        np.stack([-cloud.y, cloud.x, cloud.z], axis=1)[which & cloud.valid], axis=0
    ).astype(np.float64)


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_points_of_a_turn_are_those_that_were_published(name: str) -> None:
    theirs = read_published_points(name)
    packets = configure_sensor(name).decode(
        datagrams(capture(f"hesai/{name}/packets.derived.pcap"))
    )
    cloud = packets.points()
    assert not cloud.nominal
    near = cloud.range >= np.linalg.norm(theirs, axis=1).min() - 1e-4
    ours = places(cloud, near & (turns(cloud) == TURN[name]))
    assert len(ours) == len(theirs)
    assert nearest(ours, theirs).max() < 1e-5
    assert nearest(theirs, ours).max() < 1e-5
    vendor = (
        configure_sensor(name, frame="vendor")
        .decode(datagrams(capture(f"hesai/{name}/packets.derived.pcap")))
        .points()
    )
    np.testing.assert_array_equal(
        vendor.xyz[vendor.valid], np.stack([-cloud.y, cloud.x, cloud.z], axis=1)[cloud.valid]
    )


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_capture_is_five_pieces_and_nothing_is_lost(name: str) -> None:
    path = capture(f"hesai/{name}/packets.derived.pcap")
    with ls.open(path) as device:
        assert device.sensor.id == PUBLISHED[name]
        scans = list(device.scans())
    assert [scan.complete for scan in scans] == [False, True, True, True, False]
    assert [round(scan.rate_hz, 1) for scan in scans[1:4]] == [10.0, 10.0, 10.0]
    assert (device.stats.lost, device.stats.bytes_skipped, device.stats.plugin_errors) == (0, 0, 0)
    theirs = len(read_published_points(name))
    for scan in scans[1:4]:
        cloud = scan.points
        kept = cloud.range >= np.linalg.norm(read_published_points(name), axis=1).min() - 1e-4
        assert abs(len(places(cloud, kept)) - theirs) < 0.001 * theirs


@pytest.mark.parametrize("name", [*PUBLISHED, "40p_20hz"])
def test_compiled_and_interpreted_agree_on_captured_packets(name: str) -> None:
    path = capture(
        "hesai/40p_20hz/lidar_20Hz.pcapng"
        if name == "40p_20hz"
        else f"hesai/{name}/packets.derived.pcap"
    )
    assert (
        len(decode(FAST if name == "40p_20hz" else configure_sensor(name), datagrams(path)[:8]))
        == 8
    )


def test_the_sequence_of_the_20_hz_pandar40p_is_unbroken() -> None:
    packets = FAST.decode(datagrams(capture("hesai/40p_20hz/lidar_20Hz.pcapng")))
    assert (len(packets), packets.frame) == (200, "data_sequence")
    assert (packets.stats.lost, packets.stats.bytes_skipped) == (0, 0)
    assert set(np.diff(packets["sequence"])) == {1}
    # Ten shots. The clock counts microseconds.
    assert abs(np.diff(packets.time_ns) - 555_600).max() < 2000
    with ls.open(capture("hesai/40p_20hz/lidar_20Hz.pcapng")) as device:
        assert device.sensor.id == FAST.id
        assert [len(scan) for scan in device.scans() if scan.complete] == [36_000]


@pytest.mark.parametrize("removed", [{20}, {1, 2, 3, 50}, set(range(60, 160)), {5, 7, 9, 198}])
def test_exactly_the_removed_packets_are_lost(removed: set[int]) -> None:
    data = datagrams(capture("hesai/40p_20hz/lidar_20Hz.pcapng"))
    packets = FAST.decode([datagram for index, datagram in enumerate(data) if index not in removed])
    assert (packets.stats.lost, packets.stats.duplicates, packets.stats.late) == (
        len(removed),
        0,
        0,
    )
    assert packets.index.tolist() == [
        int(packets.index[0]) + index for index in range(200) if index not in removed
    ]


def test_the_angles_and_firing_times_of_the_20_hz_unit() -> None:
    folder = capture("hesai/40p_20hz")
    own = FAST.configure(
        calibration=folder / "Pandar40P_Angle Correction File.csv",
        firing_times=folder / "Pandar40P_Firetime Correction File.csv",
    )
    cloud = own.decode(datagrams(folder / "lidar_20Hz.pcapng")).points()
    assert not cloud.nominal
    assert np.rad2deg(cloud.elevation[:3]) == pytest.approx([15.21, 11.36, 8.387])
    assert np.diff(cloud.time[:4]) * 1e6 == pytest.approx([13.75, 12.43, 12.42], abs=1e-4)
    assert 0.29 < cloud.range[cloud.valid].min() < cloud.range[cloud.valid].max() < 10
