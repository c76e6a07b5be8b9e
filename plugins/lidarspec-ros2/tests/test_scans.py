"""Tests that a subscriber receives the values that the library computes."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from client import GRID, Client, format_parameters, message
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu, LaserScan, PointCloud2
from std_msgs.msg import Header, UInt8MultiArray

import lidarspec as ls
from lidarspec import simulate
from lidarspec.formats.messages import CLOUD, SCAN, RosMessages
from lidarspec.packets.imu import ImuSamples
from lidarspec.recording.recorders import Recorder
from lidarspec.scans.beams import PlanarScans
from lidarspec.transports.protocol import Chunk
from lidarspec.transports.robotics_logs import RAW, read_chunk

MESSAGES = RosMessages("ROS2_HUMBLE")
WHOLE, STAMP = 6, 1_700_000_000_123_456_789
#: bytes between fields that a message of ours has at the most: three before each number behind a
#: text.
PADDING = 64
#: seconds of the long test.
SOAK = float(os.environ.get("LIDARSPEC_SOAK", "600"))


def record(packets: list[bytes], path: Path, sensor: str) -> Path:
    """Write the messages of the topic of packets to a recording; return its path."""
    with Recorder(path, sensor) as recorder:
        for packet in packets:
            recorder.write(read_chunk(message(packet, RAW)))
    return path


def make_expected_messages(path: Path, sensor: str, kind: str) -> list[Any]:
    """Return the library's messages of the complete scans of a recording."""
    planes, found = PlanarScans(GRID["beams"], (GRID["angle_min"], GRID["angle_max"])), []
    with ls.open(path, sensor) as device:
        for scan in device.scans():
            if scan.whole and kind == CLOUD:
                found.append(
                    MESSAGES.cloud(scan, 0, every_point=scan.points.shape is not None).data
                )
            elif scan.whole and (planar := planes.project(scan)) is not None:
                found.append(MESSAGES.laserscan(scan, planar, 0).data)
    return [without_stamp(message(bytes(data), kind)) for data in found]


def without_stamp(content: Any) -> dict[str, Any]:
    """Return the values of a message without its stamp."""
    return {**dataclasses.asdict(content), "header": content.header.frame_id}


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return all(
        np.array_equal(value, other[name], equal_nan=False)
        for name, value in one.items()
        if name != "fields"
    ) and str(one.get("fields")) == str(other.get("fields"))


@pytest.mark.parametrize(
    ("sensor", "topic", "kind", "message_class"),
    [("ldrobot-stl27l", "scan", SCAN, LaserScan), ("robosense-m1", "points", CLOUD, PointCloud2)],
)
def test_messages_equal_those_of_the_library(
    run: Callable[..., Any],
    client: Client,
    tmp_path: Path,
    sensor: str,
    topic: str,
    kind: str,
    message_class: Any,
) -> None:
    packets = client.listen("packets", UInt8MultiArray)
    received = client.listen(topic, message_class)
    # At a quarter of the sensor's rate, a busy computer does not lose packets of its own.
    run(
        f"sim:{sensor}?loss=0.0005&seed=3&rate=0.25",
        "-s",
        sensor,
        ros=format_parameters(publish_packets=True, qos="reliable", **GRID),
    )
    client.until(lambda: len(received) > WHOLE)
    number = len(received)
    client.until(lambda: len(received) > number)  # whose packets have come
    wanted = make_expected_messages(record(packets, tmp_path / "packets.lsr", sensor), sensor, kind)
    found = [without_stamp(message(data, kind)) for data in received[:number]]
    begin = next(index for index, content in enumerate(found) if same(content, wanted[0]))
    assert number - begin >= WHOLE - 2
    for content, one in zip(found[begin:], wanted, strict=False):
        assert same(content, one)
    assert (
        len(
            {
                np.asarray(content["ranges" if kind == SCAN else "data"]).tobytes()
                for content in wanted
            }
        )
        > 1
    )


def test_imu_messages_equal_those_of_the_library(
    run: Callable[..., Any], client: Client, tmp_path: Path
) -> None:
    packets = client.listen("packets", UInt8MultiArray)
    received = client.listen("imu", Imu)
    # A quarter of the sensor's rate: this process cannot take 2,000 packets a second on every
    # computer.
    source = "sim:livox-mid360?shake=0.5&seed=3&rate=0.25"
    run(
        source,
        "-s",
        "livox-mid360",
        ros=format_parameters(publish_packets=True, qos="reliable", frame_id="head"),
    )
    client.until(lambda: packets)  # the topic may be found later than that of the IMU
    first = len(received)
    client.until(lambda: len(received) > first + 400)
    with ls.open(
        record(packets, tmp_path / "packets.lsr", "livox-mid360"), "livox-mid360"
    ) as device:
        wanted = [
            row
            for felt in device.imu()
            for row in np.concatenate(
                [felt.angular_velocity, felt.linear_acceleration], axis=1
            ).tolist()
        ]
    read = [deserialize_message(data, Imu) for data in received[first : first + 400]]
    found = [
        [
            getattr(part, axis)
            for part in (one.angular_velocity, one.linear_acceleration)
            for axis in "xyz"
        ]
        for one in read
    ]
    # On a busy computer, either side may have lost some.
    shared = [row for row in found if row in wanted]
    assert shared == [row for row in wanted if row in found]
    assert (len(shared) > 100, {one.header.frame_id for one in read}) == (True, {"head"})


@pytest.mark.parametrize(
    ("sensor", "every_point"),
    [("robosense-m1", True), ("robosense-m1", False), ("ldrobot-stl27l", False)],
)
def test_bytes_are_those_of_ros_itself(sensor: str, every_point: bool) -> None:
    """Compare with rclpy's bytes of a message that it read, or that its classes hold."""
    spec, planes = ls.sensor(sensor), PlanarScans()
    scan = next(scan for scan in spec.scans(simulate(spec, 2000)) if scan.whole)
    made = [(MESSAGES.cloud(scan, STAMP, every_point=every_point), PointCloud2)]
    if (planar := planes.project(scan)) is not None:
        made.append((MESSAGES.laserscan(scan, planar, STAMP), LaserScan))
        values = {
            name: getattr(planar, name)
            for name in LaserScan.get_fields_and_field_types()
            if name != "header"
        }
        by_ros = LaserScan(header=header(scan.frame_id), **values)
        assert alike(bytes(made[1][0].data), serialize_message(by_ros))
    felt = ImuSamples(
        np.array([STAMP]), np.array([[0.1, -0.2, np.nan]]), np.array([[0.0, 0.5, 9.81]])
    )
    made.append((MESSAGES.imu(felt, 0, STAMP, "imu"), Imu))
    made.append((MESSAGES.raw(Chunk(b"\x54\x2c\xff", STAMP), datagram=True), UInt8MultiArray))
    for known, message_class in made:
        read = deserialize_message(bytes(known.data), message_class)
        assert alike(bytes(known.data), serialize_message(read))


def test_imu_messages_follow_rep_145() -> None:
    felt = ImuSamples(
        np.array([STAMP]), np.array([[0.1, -0.2, np.nan]]), np.array([[0.0, 0.5, 9.81]])
    )
    read = deserialize_message(bytes(MESSAGES.imu(felt, 0, STAMP, "imu").data), Imu)
    assert (read.header, read.orientation_covariance[0]) == (header("imu"), -1)
    assert (read.angular_velocity_covariance[0], read.linear_acceleration_covariance[0]) == (-1, 0)
    assert (read.linear_acceleration.x, read.linear_acceleration.y, read.linear_acceleration.z) == (
        0.0,
        0.5,
        9.81,
    )


def alike(ours: bytes, theirs: bytes) -> bool:
    """Return whether messages have equal bytes, ignoring padding.

    ROS does not initialise the padding between fields; ours is 0.
    """
    one, other = (np.frombuffer(data, np.uint8) for data in (ours, theirs))
    return (
        len(ours) == len(theirs) and not one[one != other].any() and (one != other).sum() < PADDING
    )


def header(frame_id: str) -> Header:
    return Header(stamp=Time(sec=STAMP // 10**9, nanosec=STAMP % 10**9), frame_id=frame_id)


@pytest.mark.soak
@pytest.mark.parametrize(
    ("sensor", "topic", "message_class"),
    [("ldrobot-stl27l", "scan", LaserScan), ("robosense-m1", "points", PointCloud2)],
)
@pytest.mark.parametrize("qos", ["reliable", "best_effort"])
def test_no_scan_is_lost_in_ten_minutes(
    run: Callable[..., Any], client: Client, sensor: str, topic: str, message_class: Any, qos: str
) -> None:
    """Only reliable topics must be complete; losses of the others are printed."""
    received = [0]

    def note(data: bytes) -> None:
        received[0] += 1

    def counted(seconds: float) -> tuple[int, int]:
        """Return the numbers of sent and received scans, when no more arrive."""
        assert client.change("activate")
        end = time.monotonic() + seconds
        client.until(lambda: time.monotonic() > end, patience=2 * seconds)
        assert client.change("deactivate")
        client.diagnostics.clear()
        client.until(lambda: len(client.diagnostics) > 2)
        said = {entry.key: entry.value for entry in client.diagnostics[-1].status[0].values}
        return int(said[f"{topic} sent"]), received[0]

    client.listen(topic, message_class, reliable=qos == "reliable", take=note)
    run(
        ros=format_parameters(source=f"sim:{sensor}", sensor=sensor, qos=qos, autostart=False),
        executable="lidarspec_node",
    )
    assert client.change("configure")
    (sent, came), (all_sent, all_came) = counted(3.0), counted(SOAK)
    print(f"{sensor}, {qos}: {all_came - came} of {all_sent - sent} came")
    assert all_sent - sent > 9.5 * SOAK
    assert all_came - came == all_sent - sent or qos == "best_effort"
