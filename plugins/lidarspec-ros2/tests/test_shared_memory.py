"""Tests of the shared memory of Fast DDS: the node's profile, and received clouds."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from client import PATIENCE, Client, end_node, format_parameters
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2

import lidarspec as ls
from lidarspec import simulate
from lidarspec.formats.messages import RosMessages
from lidarspec.sensor_operations import Sensor
from lidarspec_ros2 import shared_memory
from lidarspec_ros2.shared_memory import (
    PROFILE_VARIABLE,
    USER_FILES,
    USER_VARIABLES,
    SharedMemory,
    choose_shared_memory,
    find_largest_cloud_bytes,
    make_profile,
    use_profile,
)

#: Clouds that are counted, and the share of them that has to arrive.
CLOUDS = 40
MIN_SHARE = 0.95
FAST_DDS = "rmw_fastrtps_cpp"


@pytest.fixture(autouse=True)
def _environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Provide a user without a profile and with much shared memory."""
    monkeypatch.chdir(tmp_path)
    for name in USER_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(shared_memory, "find_free_bytes", lambda: 10**9)


def choose(sensor: str | None, rmw: str = FAST_DDS, *, is_serial: bool = False) -> SharedMemory:
    """Return the choice for an installed sensor, or for one that is unknown."""
    found = None if sensor is None else ls.sensor(sensor)
    return choose_shared_memory(rmw, lambda: found, is_serial=is_serial)


def test_the_segment_has_room_for_eight_clouds_of_the_sensor() -> None:
    memory = choose("robosense-m1")
    assert memory.segment_bytes == 21_000_000
    assert "21 MB of shared memory, for clouds of up to 2.5 MB" in memory.notice
    assert PROFILE_VARIABLE in memory.notice
    assert not memory.warning


@pytest.mark.parametrize(
    "sensor", ["ldrobot-stl27l", "hokuyo-utm30lx", "ydlidar-tg15", "sick-tim571"]
)
def test_a_planar_sensor_needs_no_profile(sensor: str) -> None:
    memory = choose(sensor)
    assert (memory.segment_bytes, memory.notice, memory.warning) == (0, "", "")


@pytest.mark.parametrize("name", USER_VARIABLES)
def test_a_variable_of_the_user_is_respected(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "")
    assert choose("robosense-m1") == SharedMemory()


@pytest.mark.parametrize("name", USER_FILES)
def test_a_file_of_the_user_is_respected(tmp_path: Path, name: str) -> None:
    (tmp_path / name).touch()
    assert choose("robosense-m1") == SharedMemory()


def test_another_middleware_needs_no_profile() -> None:
    assert choose("robosense-m1", "rmw_cyclonedds_cpp") == SharedMemory()


def test_a_system_without_its_folder_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_memory, "find_free_bytes", lambda: None)
    assert choose("robosense-m1") == SharedMemory()


@pytest.mark.parametrize(("free", "segment"), [(42, 21), (41, 11), (22, 11)])
def test_the_segment_takes_half_of_the_free_memory_at_most(
    monkeypatch: pytest.MonkeyPatch, free: int, segment: int
) -> None:
    monkeypatch.setattr(shared_memory, "find_free_bytes", lambda: free * 10**6)
    memory = choose("robosense-m1")
    assert (memory.segment_bytes, memory.warning) == (segment * 10**6, "")


def test_little_shared_memory_is_a_warning_with_a_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_memory, "find_free_bytes", lambda: 21 * 10**6)
    memory = choose("robosense-m1")
    assert (memory.segment_bytes, memory.notice) == (0, "")
    for part in (
        "2.5 MB",
        "has only 21 MB free, but 22 MB are required",
        "--shm-size",
        "--ipc=host",
        "qos:=reliable",
    ):
        assert part in memory.warning


def test_an_unknown_sensor_gets_room_for_usual_clouds_unless_its_line_is_slow() -> None:
    memory = choose(None)
    assert memory.segment_bytes == 20_000_000
    assert "unknown" in memory.notice
    assert choose(None, is_serial=True).notice == ""


def test_an_uninstalled_sensor_is_reported_by_the_node() -> None:
    def find_sensor() -> Sensor:
        return ls.sensor("acme-x1")

    assert choose_shared_memory(FAST_DDS, find_sensor, is_serial=False).segment_bytes > 0


@pytest.mark.parametrize(
    ("sensor", "packets", "slowest_share"),
    [
        ("robosense-m1", 1300, 1.0),
        ("livox-mid360", 500, 1.0),
        ("velodyne-vlp16", 200, 0.5),
        ("hokuyo-utm30lx", 4, 1.0),
    ],
)
def test_the_calculated_size_is_that_of_a_message(
    sensor: str, packets: int, slowest_share: float
) -> None:
    """The VLP-16 is simulated at 10 scans a second, and the size is for 5."""
    spec = ls.sensor(sensor)
    data = simulate(spec, packets)
    scans = spec.scans(data if spec.datagrams else b"".join(data))
    scan = next(scan for scan in scans if scan.whole)
    message = RosMessages("ROS2_HUMBLE").cloud(scan, 10**18, every_point=True)
    assert find_largest_cloud_bytes(spec) == pytest.approx(
        len(message.data) / slowest_share, rel=0.05
    )


@pytest.mark.parametrize(
    ("environment", "has_udp"),
    [
        ({}, True),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, True),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "localhost"}, False),
        ({"ROS_LOCALHOST_ONLY": "1"}, False),
    ],
)
def test_the_profile_leaves_udp_to_ros_if_discovery_is_local(
    environment: dict[str, str], has_udp: bool
) -> None:
    profile = make_profile(5_000_000, environment)
    transports = profile.partition("<userTransports>")[2].partition("</userTransports>")[0]
    assert ("udp" in transports) == has_udp
    assert "<segment_size>5000000</segment_size>" in profile


def test_file_and_variable_exist_only_while_the_participant_is_created() -> None:
    files: list[Path] = []

    def create_and_interrupt() -> None:
        with use_profile(SharedMemory(segment_bytes=5_000_000)):
            files.append(Path(os.environ[PROFILE_VARIABLE]))
            assert files[0].stat().st_size > 0
            assert files[0].parent.stat().st_mode & 0o77 == 0
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        create_and_interrupt()
    assert PROFILE_VARIABLE not in os.environ
    assert not files[0].parent.exists()
    with use_profile(SharedMemory()):
        assert PROFILE_VARIABLE not in os.environ


def sent_clouds(client: Client) -> int:
    """Return the number of clouds that the node reports to have sent."""
    values = {entry.key: entry.value for entry in client.diagnostics[-1].status[0].values}
    return int(values.get("points sent", 0))


def test_clouds_arrive_with_best_effort_at_the_full_rate(
    run: Callable[..., Any], client: Client
) -> None:
    received = client.listen("points", PointCloud2, qos=qos_profile_sensor_data)
    process = run("sim:robosense-m1", "-s", "robosense-m1")
    client.until(lambda: client.diagnostics and sent_clouds(client) > 1)
    first_sent = sent_clouds(client)
    first_received = len(received)
    client.until(lambda: sent_clouds(client) >= first_sent + CLOUDS, patience=4 * PATIENCE)
    assert client.change("deactivate")
    client.diagnostics.clear()
    client.until(lambda: len(client.diagnostics) > 1)  # no cloud is on its way any more
    sent = sent_clouds(client) - first_sent
    arrived = len(received) - first_received
    code, log = end_node(process)
    assert arrived >= MIN_SHARE * sent
    assert code == 0
    notice = "Fast DDS was configured to use 21 MB of shared memory, for clouds of up to 2.5 MB"
    assert log.count(notice) == 1


def test_larger_clouds_than_foreseen_are_a_warning(run: Callable[..., Any], client: Client) -> None:
    client.listen("points", PointCloud2, reliable=False)
    parameters = format_parameters(
        source="sim:ldrobot-stl27l", sensor="ldrobot-stl27l", autostart=False
    )
    process = run(ros=parameters, executable="lidarspec_node")
    assert client.set("source", "sim:robosense-m1") == client.set("sensor", "robosense-m1") == ""
    assert client.change("configure")
    assert client.change("activate")
    client.until(lambda: client.diagnostics and sent_clouds(client) > 3)
    _, log = end_node(process)
    assert log.count("clouds of 2.5 MB may be lost") == 1
    assert "qos:=reliable" in log


def test_nothing_of_the_profile_is_left(
    run: Callable[..., Any], client: Client, tmp_path: Path
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    environment = os.environ | {"TMPDIR": str(scratch)}
    command = [
        str(Path(sys.executable).with_name("lidarspec")),
        "ros2",
        "sim:robosense-m1",
        "-s",
        "robosense-m1",
    ]
    with subprocess.Popen(
        command, env=environment, cwd=tmp_path, text=True, stderr=subprocess.PIPE
    ) as process:
        client.until(lambda: client.diagnostics, patience=PATIENCE)
        code, log = end_node(process)
    assert (code, "of shared memory" in log) == (0, True)
    assert list(scratch.iterdir()) == []
