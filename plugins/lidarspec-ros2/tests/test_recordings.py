"""A recording that the node plays, and the bag that `convert` makes of it, hold the same bytes at the same times; /clock goes with them."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client import Client, given, message
from rosbags.rosbag2 import Reader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan, PointCloud2

import lidarspec as ls
from lidarspec.recording.recorders import Recorder
from lidarspec.simulation.simulator import simulate
from lidarspec.transports.protocol import Chunk

BEGAN, SECOND, LATEST = 1_767_225_600_000_000_000, 1_000_000_000, 5_000_000
#: scans that are waited for.
WANTED = 10
#: how many packets a recording of some seconds has, the topic, the class of its messages, and how `convert` is told to shape them.
SENSORS = {
    "ldrobot-stl27l": (14_400, "scan", LaserScan, ["--beams", "360"]),
    "velodyne-vlp16": (4_500, "points", PointCloud2, ["--organized"]),
}


def recorded(path: Path, sensor: str) -> tuple[Path, int]:
    """A recording of a simulated sensor, each of whose packets arrived up to 5 ms late, and what its clock is behind."""
    spec, random, at = ls.sensor(sensor), np.random.default_rng(0), 0
    packets = simulate(spec, SENSORS[sensor][0])
    times = spec.decode(b"".join(packets)).time_ns
    with Recorder(path, spec) as recorder:
        for packet, time in zip(packets, times.tolist(), strict=True):
            at = max(at, time - int(times[0]) + int(random.integers(0, LATEST)))
            recorder.write(Chunk(packet, BEGAN + at))
    return path, BEGAN - int(times[0])


@pytest.mark.parametrize("sensor", SENSORS)
def test_the_messages_of_a_recording_are_those_of_its_bag(run: Callable[..., Any], client: Client, tmp_path: Path, sensor: str) -> None:
    path, _ = recorded(tmp_path / "drive.lsr", sensor)
    _, topic, kind, shape = SENSORS[sensor]
    words = ["convert", path, tmp_path / "drive.rosbag2", "--time", "host", "--frame-id", "front", *shape]
    subprocess.run([sys.executable, "-m", "lidarspec", *words], check=True)
    with Reader(tmp_path / "drive.rosbag2") as bag:
        wanted = {data for link, _, data in bag.messages() if link.topic == f"/{topic}"}
    clock, received = client.listen("/clock", Clock), client.listen(topic, kind)
    run(str(path), ros=given(use_sim_time=True, use_device_time=False, qos="reliable", frame_id="front", beams=360))
    client.until(lambda: len(received) >= WANTED and len(clock) > WANTED)
    assert set(received) < wanted
    told = [stamp(message(data, "rosgraph_msgs/msg/Clock").clock) for data in clock]
    assert told == sorted(told)
    assert BEGAN <= told[0] < told[-1] < BEGAN + 10 * SECOND


@pytest.mark.parametrize("sensor", SENSORS)
def test_stamps_by_the_sensors_clock_are_closer_to_the_truth_than_arrivals(
    run: Callable[..., Any], client: Client, tmp_path: Path, sensor: str
) -> None:
    path, behind = recorded(tmp_path / "drive.lsr", sensor)
    with ls.open(path) as device:
        truths = np.array([scan.stamp_ns + behind for scan in device.scans()])
    _, topic, kind, _ = SENSORS[sensor]
    received = client.listen(topic, kind)
    run(str(path), ros=given(qos="reliable"))
    client.until(lambda: len(received) >= WANTED)
    stamps = np.array([stamp(message(data, f"sensor_msgs/msg/{kind.__name__}").header.stamp) for data in received])
    errors = np.abs(stamps[:, None] - truths).min(axis=1)
    assert errors[1:].max() < LATEST / 10
    assert (np.diff(stamps) > 0).all()


def stamp(time: Any) -> int:
    return int(time.sec * SECOND + time.nanosec)
