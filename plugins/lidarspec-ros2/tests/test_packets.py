"""Tests that published packets can be decoded again, from a topic and from a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from client import GRID, STORE, Client, format_parameters, message
from rosbags.rosbag2 import Writer
from sensor_msgs.msg import LaserScan
from std_msgs.msg import UInt8MultiArray

import lidarspec as ls
from lidarspec.formats.messages import SCAN
from lidarspec.transports.robotics_logs import RAW, read_chunk


def test_a_node_decodes_packets_of_another_node(run: Any, client: Client) -> None:
    first, again = client.listen("scan", LaserScan), client.listen("again", LaserScan)
    client.diagnostics.clear()
    grid = format_parameters(qos="reliable", **GRID)
    run(
        "ros2:/packets",
        "-s",
        "ldrobot-stl27l",
        ros=["-r", "__node:=again", "-r", "scan:=again", *grid],
    )
    client.until(lambda: client.diagnostics)  # it listens
    run(
        "sim:ldrobot-stl27l?seed=5",
        "-s",
        "ldrobot-stl27l",
        ros=[*grid, *format_parameters(publish_packets=True)],
    )

    def shared() -> set[tuple[float, ...]]:
        """Return the scans that both nodes published; a busy computer may lose packets."""
        one, other = (
            {tuple(message(data, SCAN).ranges) for data in scans} for scans in (first, again)
        )
        return one & other

    client.until(lambda: len(shared()) > 5)


@pytest.mark.parametrize("sensor", ["ldrobot-stl27l", "velodyne-vlp16"])
def test_a_bag_with_packets_is_a_source(
    run: Any, client: Client, tmp_path: Path, sensor: str
) -> None:
    packets = client.listen("packets", UInt8MultiArray)
    run(f"sim:{sensor}", "-s", sensor, ros=format_parameters(publish_packets=True, qos="reliable"))
    client.until(lambda: len(packets) > 500)
    chunks = [read_chunk(message(data, RAW)) for data in packets]
    with Writer(tmp_path / "bag", version=8) as bag:
        connection = bag.add_connection("/lidar/packets", RAW, typestore=STORE)
        for data, chunk in zip(packets, chunks, strict=True):
            assert chunk.at is not None
            bag.write(connection, chunk.at, data)
    with ls.open(tmp_path / "bag", sensor) as device:
        found = list(device.packets())
    data = b"".join(chunk.data for chunk in chunks)
    wanted = ls.sensor(sensor).decode(
        data if sensor == "ldrobot-stl27l" else [chunk.data for chunk in chunks]
    )
    assert sum(map(len, found)) == len(wanted) > 100
    np.testing.assert_array_equal(np.concatenate([batch.raw for batch in found]), wanted.raw)
    assert set(np.concatenate([batch.host_ns for batch in found])) <= {chunk.at for chunk in chunks}
