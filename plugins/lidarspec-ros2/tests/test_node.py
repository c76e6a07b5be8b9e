"""Tests of the node: lifecycle, parameters, services, reconnection and exit."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from client import PATIENCE, Client, end_node, format_parameters, message
from rcl_interfaces.msg import ParameterType
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan, PointCloud2

import lidarspec as ls
from lidarspec import simulate
from lidarspec.formats.messages import CLOUD, SCAN
from lidarspec_ros2.parameters import PARAMETERS, Settings
from lidarspec_ros2.topics import make_transform

STL = ("sim:ldrobot-stl27l", "-s", "ldrobot-stl27l")


def values(status: Any) -> dict[str, str]:
    """Return the values of a diagnostic by name."""
    return {entry.key: entry.value for entry in status.values}


def test_nothing_of_ros_is_imported_before_the_node_starts() -> None:
    code = (
        "import lidarspec_ros2, lidarspec_ros2.command, lidarspec_ros2.parameters, sys;"
        " print('rclpy' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=PATIENCE
    )
    assert done.stdout == "False\n"


def test_without_ros_one_line_says_both_ways_to_have_it(tmp_path: Path) -> None:
    (tmp_path / "rclpy.py").write_text("raise ImportError('no rclpy here')", encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-m", "lidarspec", "ros2", *STL]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE
    )
    first, *_ = done.stderr.splitlines()
    assert done.returncode == 2
    assert "no rclpy here" in first
    assert "setup.bash" in first
    assert "pip install" in first
    assert "lidarspec-ros2[ros2]" in first


def test_a_manager_can_control_the_lifecycle(run: Any, client: Client) -> None:
    scans = client.listen("scan", LaserScan)
    process = run(
        ros=format_parameters(source=STL[0], sensor=STL[2], autostart=False, qos="reliable"),
        executable="lidarspec_node",
    )
    assert client.state == "unconfigured"
    assert not client.change("activate")
    assert client.change("configure")
    assert (client.state, scans) == ("inactive", [])
    client.until(lambda: client.diagnostics)
    assert values(client.diagnostics[-1].status[0])["lifecycle"] == "inactive"
    assert client.change("activate")
    client.until(lambda: len(scans) > 2)
    assert client.change("deactivate")
    number = len(scans)
    client.diagnostics.clear()
    client.until(lambda: client.diagnostics)  # it goes on reading
    assert values(client.diagnostics[-1].status[0])["packets [/s]"] != "-"
    assert len(scans) <= number + 1  # one may have been under way
    assert client.change("cleanup")
    assert client.state == "unconfigured"
    assert client.change("configure")
    assert client.change("activate")
    client.until(lambda: len(scans) > number + 2)
    assert client.change("shutdown")
    assert process.wait(PATIENCE) == 0


def test_a_command_may_be_called_as_a_service_of_every_node(run: Any, client: Client) -> None:
    run("sim:hokuyo-utm30lx", "-s", "hokuyo-utm30lx")
    client.until(lambda: client.diagnostics)
    answered = client.trigger("get_state")
    assert (answered.success, client.state) == (True, "active")


def test_configuring_fails_until_the_source_can_be_opened(
    run: Any, client: Client, tmp_path: Path
) -> None:
    run(
        ros=format_parameters(source=str(tmp_path / "none"), sensor=STL[2], autostart=False),
        executable="lidarspec_node",
    )
    assert not client.change("configure")
    assert client.state == "unconfigured"
    assert client.set("source", STL[0]) == ""
    assert client.change("configure")
    assert client.state == "inactive"


@pytest.mark.parametrize(
    ("words", "parameters"),
    [
        (
            ["sim:ldrobot-stl27l", "-s", "ldrobot-stl27"],
            {"source": "sim:ldrobot-stl27l", "sensor": "ldrobot-stl27"},
        ),
        (
            ["sim:ldrobot-stl27l", "-s", "ldrobot-stl27l", "-O", "answer"],
            {"source": STL[0], "sensor": STL[2], "options": "[answer]"},
        ),
        (
            ["sim:ldrobot-stl27l?bad=1", "-s", "ldrobot-stl27l"],
            {"source": "sim:ldrobot-stl27l?bad=1", "sensor": STL[2]},
        ),
        (
            ["absent.pcap", "-s", "robosense-m1"],
            {"source": "absent.pcap", "sensor": "robosense-m1"},
        ),
    ],
)
def test_invalid_arguments_give_the_errors_of_the_command_line(
    run: Any, tmp_path: Path, words: list[str], parameters: dict[str, Any]
) -> None:
    stats = [sys.executable, "-m", "lidarspec", "stats", *words]
    known = subprocess.run(
        stats, capture_output=True, text=True, check=False, cwd=tmp_path, timeout=PATIENCE
    )
    reason = known.stderr.splitlines()[0]
    for process in (
        run(*words),
        run(ros=format_parameters(**parameters), executable="lidarspec_node"),
    ):
        _, complaints = process.communicate(timeout=PATIENCE)
        assert (process.returncode, reason in complaints) == (known.returncode, True)


def test_parameters_have_descriptions_and_some_can_be_changed(run: Any, client: Client) -> None:
    scans = client.listen("scan", LaserScan)
    run(*STL, ros=format_parameters(qos="reliable", frame_id="front"))
    client.until(lambda: scans)
    for parameter, descriptor in zip(
        PARAMETERS, client.describe_parameters(*(one.name for one in PARAMETERS)), strict=True
    ):
        kind = getattr(ParameterType, f"PARAMETER_{parameter.kind.upper()}")
        assert (descriptor.description, descriptor.type) == (parameter.text, kind)
    assert (client.value("frame_id"), client.value("beams"), client.value("source")) == (
        "front",
        0,
        STL[0],
    )
    assert (
        client.set("beams", 450)
        == client.set("range_max", 3.0)
        == client.set("frame_id", "rear")
        == ""
    )
    assert client.set("angle_min", -1.0) == client.set("angle_max", 1.0) == ""

    def newest() -> Any:
        return message(scans[-1], SCAN)

    client.until(lambda: newest().header.frame_id == "rear" and newest().angle_max == 1.0)
    assert (len(newest().ranges), newest().range_max, newest().angle_min) == (450, 3.0, -1.0)
    assert all(one <= 3.0 or one == float("inf") for one in newest().ranges)
    assert "source is only read when" in client.set("source", "udp://")
    assert client.set("scan_z_min", 2.0) == "scan_z_min 2.0 is above scan_z_max 0.0"
    assert "5.0 to 3.0" in client.set("range_min", 5.0)
    assert client.set("beams", -1)
    assert (client.value("scan_z_min"), client.value("range_min")) == (0.0, 0.0)
    # The range passes the back, up to the last beam in the next turn.
    assert client.set("angle_min", 2.0) == ""
    client.until(lambda: newest().angle_min == 2.0)
    assert newest().angle_max == pytest.approx(1.0 + 2 * math.pi)


def test_returns_selects_one_point_of_each_firing(run: Any, client: Client) -> None:
    clouds = client.listen("points", PointCloud2)
    source = "sim:robosense-mx?seed=3&rate=0.25"  # two valid returns of each firing
    run(source, "-s", "robosense-mx", ros=format_parameters(qos="reliable", returns="last"))

    def newest_count() -> int:
        cloud = message(clouds[-1], CLOUD)
        return int(cloud.width * cloud.height)

    client.until(lambda: len(clouds) > 1)
    firings = newest_count()
    assert client.set("returns", "all") == ""
    client.until(lambda: newest_count() != firings)
    assert newest_count() == 2 * firings
    assert client.set("returns", "nearest") == (
        "returns must be one of first, last, strongest, all, not 'nearest'"
    )
    assert client.value("returns") == "all"


def test_an_unknown_parameter_is_reported(run: Any, client: Client) -> None:
    process = run(
        *STL,
        ros=[
            *format_parameters(beam=720, qos="reliable"),
            "-p",
            "qos_overrides./points.publisher.depth:=5",
        ],
    )
    client.until(lambda: client.diagnostics)
    code, complaints = end_node(process)
    (said,) = complaints.splitlines()
    assert (
        code,
        said.endswith("unknown parameter 'beam' is ignored; did you mean 'beams'?"),
    ) == (0, True)


def test_qos_is_sensor_data_unless_overridden(run: Any, client: Client) -> None:
    client.listen("/points", PointCloud2, reliable=False)
    for words, is_reliable in (
        ([], False),
        (format_parameters(qos="reliable"), True),
        (["-p", "qos_overrides./points.publisher.reliability:=reliable"], True),
    ):
        process = run(*STL, ros=words or format_parameters(qos="best_effort"))
        client.until(lambda: client.reliable("/points"))
        assert client.reliable("/points") == [is_reliable]
        assert end_node(process)[0] == 0
        client.until(lambda: not client.reliable("/points"))


def test_a_ring_that_the_sensor_lacks_is_a_warning_and_clouds_go_on(
    run: Any, client: Client
) -> None:
    clouds, scans = client.listen("points", PointCloud2), client.listen("scan", LaserScan)
    run(
        "sim:velodyne-vlp16",
        "-s",
        "velodyne-vlp16",
        ros=format_parameters(qos="reliable", scan_ring=7, frame_id="mast"),
    )
    client.until(lambda: len(scans) > 1)
    assert message(scans[-1], SCAN).header.frame_id == "mast"
    assert client.set("scan_ring", 99) == ""
    asked = "ring 99 does not exist"
    client.until(
        lambda: any(
            asked in text
            for said in client.diagnostics[-1:]
            for text in values(said.status[0]).values()
        )
    )
    number = len(clouds)
    client.until(lambda: len(clouds) > number)


def test_commands_are_services_with_arguments_as_parameters(run: Any, client: Client) -> None:
    run("sim:ldrobot-ld14p", "-s", "ldrobot-ld14p")
    client.until(lambda: client.diagnostics)
    refused = client.trigger("set_speed")
    assert (refused.success, refused.message) == (
        False,
        "ldrobot-ld14p set_speed: field 'speed' is missing",
    )
    assert client.set("set_speed.speed", 9000.0) == ""
    assert "outside 720 .. 2880" in client.trigger("set_speed").message
    assert client.set("set_speed.speed", "6turns") == ""
    assert not client.trigger("set_speed").success
    assert client.set("set_speed.speed", 1440) == ""
    sent = client.trigger("set_speed")
    assert (sent.success, "no reply is documented" in sent.message) == (True, True)
    assert client.trigger("stop").success


def test_the_message_contains_the_reply(run: Any, client: Client) -> None:
    run("sim:slamtec-rplidar-a1", "-s", "slamtec-rplidar-a1")
    client.until(lambda: client.diagnostics)
    assert client.trigger("stop").success
    found = client.trigger("get_health")
    assert found.success
    assert "replied with health" in found.message
    assert "status" in found.message


def test_diagnostics_report_the_state_of_the_sensor(run: Any, client: Client) -> None:
    run("sim:ldrobot-stl27l?errors=0.001", "-s", "ldrobot-stl27l")
    client.until(lambda: len(client.diagnostics) > 3)
    (status,) = client.diagnostics[-1].status
    found = values(status)
    assert (status.name, status.hardware_id) == (
        "lidar: ldrobot-stl27l",
        "sim:ldrobot-stl27l?errors=0.001",
    )
    assert float(found["speed [Hz]"]) == pytest.approx(10, rel=0.2)
    assert float(found["errors [%]"]) > 0
    assert (found["state"], found["lifecycle"]) == ("streaming", "active")
    assert {"packets [/s]", "loss [%]", "jitter [ms]", "latency [ms]"} <= set(found)
    assert client.diagnostics[-1].header.stamp.sec > 0


def test_a_file_is_played_with_its_times_on_clock_and_then_the_node_ends(
    run: Any, client: Client, tmp_path: Path
) -> None:
    file = tmp_path / "drive.lsr"
    ran = subprocess.run(
        [sys.executable, "-m", "lidarspec", "sim", "ldrobot-stl27l", "--to", str(file), "-t", "6s"],
        capture_output=True, text=True, check=True, timeout=PATIENCE)  # fmt: skip
    scans, clock = client.listen("scan", LaserScan), client.listen("/clock", Clock)
    process = run(
        str(file),
        "-s",
        "ldrobot-stl27l",
        ros=format_parameters(use_sim_time=True, qos="reliable", replay_speed=2.0),
    )
    client.until(lambda: len(scans) > 2)
    assert client.state == "active"
    client.until(lambda: process.poll() is not None)
    _, complaints = process.communicate()
    assert (process.returncode, complaints, ran.returncode) == (0, "", 0)
    times = [deserialize_message(data, Clock).clock for data in clock]
    assert times == sorted(times, key=lambda time: (time.sec, time.nanosec))
    stamps = {message(data, SCAN).header.stamp.sec for data in scans}
    assert stamps <= {time.sec + later for time in times for later in (0, 1)}


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw", "inverted"),
    [(0.0, 0.0, 90.0, False), (10.0, -20.0, 130.0, True), (0.0, 90.0, 5.0, False)],
)
def test_a_transform_turns_as_the_mount_does(
    roll: float, pitch: float, yaw: float, inverted: bool
) -> None:
    given = {
        "mount.x": 0.5,
        "mount.roll_deg": roll,
        "mount.pitch_deg": pitch,
        "mount.yaw_deg": yaw,
        "mount.inverted": inverted,
    }
    settings = Settings(
        {one.name: one.default for one in PARAMETERS}
        | given
        | {"source": "udp://", "frame_id": "mast"}
    )
    found = make_transform(settings, Time(sec=5))
    q = found.transform.rotation
    turned = [
        [1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y - q.z * q.w), 2 * (q.x * q.z + q.y * q.w)],
        [2 * (q.x * q.y + q.z * q.w), 1 - 2 * (q.x**2 + q.z**2), 2 * (q.y * q.z - q.x * q.w)],
        [2 * (q.x * q.z - q.y * q.w), 2 * (q.y * q.z + q.x * q.w), 1 - 2 * (q.x**2 + q.y**2)],
    ]
    mount = settings.find_mount()
    assert mount is not None
    np.testing.assert_allclose(turned, mount.rotation, atol=1e-12)
    assert (found.header.frame_id, found.child_frame_id, found.transform.translation.x) == (
        "base_link",
        "mast",
        0.5,
    )


def test_a_transform_is_refused_where_ros_has_no_message_for_it(run: Any, client: Client) -> None:
    process = run(*STL, ros=format_parameters(publish_tf=True))
    _, complaints = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    assert "publish_tf requires tf2_msgs" in complaints


@pytest.fixture
def plugged(tmp_path: Path) -> Iterator[Callable[..., tuple[Path, int]]]:
    """Yield a function that simulates a sensor on a pty; it returns path and process."""
    begun = list[subprocess.Popen[str]]()

    def started(*words: str) -> tuple[Path, int]:
        link = tmp_path / "port"
        command = [
            sys.executable,
            "-m",
            "lidarspec",
            "sim",
            "ldrobot-stl27l",
            "--to",
            "pty",
            "--link",
            str(link),
            *words,
        ]
        begun.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        assert begun[-1].stdout is not None
        assert begun[-1].stdout.readline()
        return link, begun[-1].pid

    yield started
    for process in begun:
        process.terminate()
        process.communicate()


def test_a_missing_port_makes_the_node_inactive(run: Any, client: Client, plugged: Any) -> None:
    port, _ = plugged("--unplug", "5s", "--absent", "3s")
    scans = client.listen("scan", LaserScan)
    run(str(port), "-s", "ldrobot-stl27l", ros=format_parameters(qos="reliable"))
    client.until(lambda: len(scans) > 2)
    assert client.state == "active"
    client.until(lambda: client.diagnostics and client.diagnostics[-1].status[0].level == b"\2")
    assert client.state == "inactive"
    client.until(lambda: values(client.diagnostics[-1].status[0])["lifecycle"] == "inactive")
    assert "waiting for it to return" in client.diagnostics[-1].status[0].message
    number = len(scans)
    client.until(lambda: len(scans) > number + 2)
    assert client.state == "active"
    client.until(lambda: client.diagnostics[-1].status[0].level != b"\2")


def test_a_sensor_that_falls_silent_makes_the_node_inactive_until_it_sends(
    run: Any, client: Client
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind(("127.0.0.1", 0))
        free = sender.getsockname()[1] + 1
        sends, over = threading.Event(), threading.Event()
        sends.set()

        def send() -> None:
            for frame in itertools.cycle(simulate(ls.sensor("velodyne-vlp16"), 1500)):
                sends.wait()
                if over.wait(0.001):
                    return
                sender.sendto(frame, ("127.0.0.1", free))

        thread = threading.Thread(target=send)
        thread.start()
        try:
            run(f"udp://127.0.0.1:{free}", "-s", "velodyne-vlp16")
            client.until(lambda: client.diagnostics)
            client.until(lambda: client.state == "active")
            sends.clear()
            client.until(lambda: client.state == "inactive")
            client.until(
                lambda: client.diagnostics and client.diagnostics[-1].status[0].level == b"\2"
            )
            assert "no data received" in client.diagnostics[-1].status[0].message
            sends.set()
            client.until(lambda: client.state == "active")
        finally:
            over.set()
            sends.set()
            thread.join()


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_nothing_is_left_behind(run: Any, client: Client, plugged: Any, by: int) -> None:
    port, simulator = plugged()
    scans, before = (
        client.listen("scan", LaserScan, reliable=False),
        list_shared_memory(os.getpid()),
    )
    process = run(str(port), "-s", "ldrobot-stl27l")
    client.until(lambda: scans)
    threads, own = os.listdir(f"/proc/{process.pid}/task"), list_shared_memory(process.pid) - before
    assert own
    assert str(process.pid) in holders(port)
    code, complaints = end_node(process, by)
    assert (code, complaints) == (0, "")
    assert not any(Path(f"/proc/{thread}").exists() for thread in threads)
    # The client receives at these ports.
    ports = {name for name in list_shared_memory(os.getpid()) if "_port" in name}
    assert not [name for name in own - ports if Path(name).exists()]
    assert set(holders(port)) <= {str(simulator)}


def list_shared_memory(pid: int) -> set[str]:
    """Return the shared memory files of a process."""
    return set(
        re.findall(r"/dev/shm/fast\w+", Path(f"/proc/{pid}/maps").read_text(encoding="utf-8"))
    )


def holders(port: Path) -> list[str]:
    """Return the processes that have a port open."""
    found = []
    for pid in filter(str.isdecimal, os.listdir("/proc")):
        with contextlib.suppress(OSError):
            opened = {
                os.path.realpath(f"/proc/{pid}/fd/{number}")
                for number in os.listdir(f"/proc/{pid}/fd")
            }
            found += [pid] * (os.path.realpath(port) in opened)
    return found
