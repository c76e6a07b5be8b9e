"""Tests of the times of published messages: recordings, /clock and IMU."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client import Client, format_parameters, message
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, LaserScan, PointCloud2

import lidarspec as ls
from lidarspec import simulate
from lidarspec.recording.recorders import Recorder
from lidarspec.transports.protocol import Chunk

BEGAN, SECOND, LATEST = 1_767_225_600_000_000_000, 1_000_000_000, 5_000_000
#: scans that are waited for.
WANTED = 10
#: how many packets a recording of some seconds has, the topic, the class of its messages, and how
#: `convert` is told to shape them.
SENSORS = {
    "ldrobot-stl27l": (14_400, "scan", LaserScan, ["--beams", "360"]),
    "velodyne-vlp16": (4_500, "points", PointCloud2, ["--organized"]),
}


def record(path: Path, sensor: str, *, jumps: int = 0) -> tuple[Path, int]:
    """Write a recording of a simulated sensor; return it and the delay of its clock.

    Each packet arrived up to 5 ms late.

    Args:
        jumps: number of packets by which the clock is set in the middle.
    """
    spec, random, at, number = ls.sensor(sensor), np.random.default_rng(0), 0, SENSORS[sensor][0]
    times = spec.decode(b"".join(simulate(spec, number))).time_ns
    packets = simulate(spec, number // 2) + simulate(
        spec, number - number // 2, start=number // 2 + jumps
    )
    with Recorder(path, spec) as recorder:
        for packet, sent in zip(packets, times.tolist(), strict=True):
            at = max(at, sent - int(times[0]) + int(random.integers(0, LATEST)))
            recorder.write(Chunk(packet, BEGAN + at))
    return path, BEGAN - int(times[0])


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_messages_of_a_recording_are_those_of_its_bag(
    run: Callable[..., Any], client: Client, tmp_path: Path, sensor: str
) -> None:
    path, _ = record(tmp_path / "drive.lsr", sensor)
    _, topic, kind, shape = SENSORS[sensor]
    words = [
        "convert",
        path,
        tmp_path / "drive.rosbag2",
        "--time",
        "host",
        "--frame-id",
        "front",
        *shape,
    ]
    subprocess.run([sys.executable, "-m", "lidarspec", *words], check=True)
    with Reader(tmp_path / "drive.rosbag2") as bag:
        wanted = {data for link, _, data in bag.messages() if link.topic == f"/{topic}"}
    clock, received = client.listen("/clock", Clock), client.listen(topic, kind)
    run(
        str(path),
        ros=format_parameters(
            use_sim_time=True, use_device_time=False, qos="reliable", frame_id="front", beams=360
        ),
    )
    client.until(lambda: len(received) >= WANTED and len(clock) > WANTED)
    assert set(received) < wanted
    clocked = [stamp(message(data, "rosgraph_msgs/msg/Clock").clock) for data in clock]
    assert clocked == sorted(clocked)
    assert BEGAN <= clocked[0] < clocked[-1] < BEGAN + 10 * SECOND


@pytest.mark.parametrize("sensor", SENSORS)
def test_stamps_by_the_sensors_clock_are_closer_to_the_truth_than_arrivals(
    run: Callable[..., Any], client: Client, tmp_path: Path, sensor: str
) -> None:
    path, behind = record(tmp_path / "drive.lsr", sensor)
    with ls.open(path) as device:
        truths = np.array([scan.stamp_ns + behind for scan in device.scans()])
    _, topic, kind, _ = SENSORS[sensor]
    received = client.listen(topic, kind)
    run(str(path), ros=format_parameters(qos="reliable"))
    client.until(lambda: len(received) >= WANTED)
    stamps = np.array(
        [stamp(message(data, f"sensor_msgs/msg/{kind.__name__}").header.stamp) for data in received]
    )
    errors = np.abs(stamps[:, None] - truths).min(axis=1)
    assert errors[1:].max() < LATEST / 10
    assert (np.diff(stamps) > 0).all()


def test_a_clock_change_is_reported(
    run: Callable[..., Any], client: Client, tmp_path: Path
) -> None:
    path, _ = record(tmp_path / "drive.lsr", "velodyne-vlp16", jumps=7540)  # packets of ten seconds
    clouds = client.listen("points", PointCloud2)
    run(str(path), ros=format_parameters(qos="reliable"))
    client.until(
        lambda: any("clock was changed by +10.0" in text for text in list_diagnostics(client))
    )
    stamps = np.array(
        [stamp(message(data, "sensor_msgs/msg/PointCloud2").header.stamp) for data in clouds]
    )
    assert (np.diff(stamps) > 0).all()
    assert stamps[-1] < BEGAN + 10 * SECOND


# The IMU samples of the Avia have no clock, those of the OS0 have the clock of the points.
@pytest.mark.parametrize("sensor", ["livox-avia", "ouster-os0"])
def test_imu_samples_and_points_have_consistent_stamps(
    run: Callable[..., Any], client: Client, sensor: str
) -> None:
    felt, clouds = client.listen("imu", Imu), client.listen("points", PointCloud2)
    run(f"sim:{sensor}", "-s", sensor, ros=format_parameters(qos="reliable"))
    client.until(lambda: len(felt) > WANTED and len(clouds) > 2)
    now = time.time_ns()
    for data, kind in ((felt[-1], "Imu"), (clouds[-1], "PointCloud2")):
        assert abs(stamp(message(data, f"sensor_msgs/msg/{kind}").header.stamp) - now) < 5 * SECOND


def list_diagnostics(client: Client) -> list[str]:
    """Return the messages of all diagnostics."""
    return [
        entry.value
        for array in client.diagnostics
        for status in array.status
        for entry in status.values
    ]


def stamp(time_of: Any) -> int:
    return int(time_of.sec * SECOND + time_of.nanosec)
