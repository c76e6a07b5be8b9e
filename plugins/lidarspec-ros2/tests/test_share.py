"""Tests that ROS's own tools find the installed distribution, and of its pages."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from ament_index_python.packages import get_package_prefix, get_package_share_directory
from client import PATIENCE, Client, message
from sensor_msgs.msg import LaserScan, PointCloud2

import lidarspec as ls
from lidarspec_ros2.parameters import NAMED
from tests.docs import pages

DRIVERS, HOW_TO, NODES = (
    "reference/ros2-drivers.md",
    "how-to/ros2.md",
    ("/front/lidar", "/back/lidar"),
)


@pytest.fixture(autouse=True)
def _prefix(monkeypatch: pytest.MonkeyPatch) -> None:
    """Add this environment to the package prefixes, as the page instructs."""
    monkeypatch.setenv("AMENT_PREFIX_PATH", sys.prefix)


def share(*parts: str) -> Path:
    return Path(get_package_share_directory("lidarspec_ros2"), *parts)


def files() -> dict[str, Any]:
    """Return the parameter files by name, parsed from YAML."""
    (mine,) = [block.text for block in pages.blocks(HOW_TO) if block.title == "mine.yaml"]
    return {
        "mine": yaml.safe_load(mine),
        "two_lidars": yaml.safe_load(share("config", "two_lidars.yaml").read_text()),
    }


def test_the_files_of_parameters_name_parameters_and_installed_sensors() -> None:
    for file in files().values():
        assert tuple(file) == NODES
        for node in file.values():
            assert set(node["ros__parameters"]) <= set(NAMED)
            assert ls.sensor(node["ros__parameters"]["sensor"])


@pytest.mark.parametrize(
    ("name", "topic", "kind"), [("front", "scan", LaserScan), ("back", "points", PointCloud2)]
)
def test_a_node_of_the_launch_file_has_its_parameters_from_the_file(
    client: Client, name: str, topic: str, kind: Any
) -> None:
    # The launch command searches here.
    program = Path(get_package_prefix("lidarspec_ros2"), "lib", "lidarspec_ros2", "lidarspec_node")
    config = share("config", "two_lidars.yaml")
    words = [
        "--ros-args",
        "-r",
        f"__ns:=/{name}",
        "-r",
        "__node:=lidar",
        "--params-file",
        str(config),
    ]
    # The node sends this topic with reliable delivery.
    received = client.listen(f"/{name}/{topic}", kind, reliable=name == "back")
    with subprocess.Popen([program, *words]) as node:
        client.until(lambda: received)
        node.terminate()
    got = message(received[0], f"sensor_msgs/msg/{kind.__name__}")
    assert got.header.frame_id == f"{name}_laser"
    assert len(got.ranges) == 720 if name == "front" else got.height > 1


def test_the_launch_file_starts_both() -> None:
    pytest.importorskip(
        "launch_ros", reason="there is no wheel of launch: the file is run where ROS is sourced"
    )
    from launch.launch_description_sources import PythonLaunchDescriptionSource

    from launch import LaunchContext

    context = LaunchContext()
    description = PythonLaunchDescriptionSource(
        str(share("launch", "two_lidars.launch.py"))
    ).get_launch_description(context)
    argument, *nodes = description.entities
    argument.execute(context)
    for node in nodes:
        node._perform_substitutions(context)
    assert [node.node_name for node in nodes] == list(NODES)


def test_the_transforms_of_the_page_are_those_of_the_frames_in_the_files() -> None:
    (block,) = [block for block in pages.blocks(HOW_TO) if block.language == "xml"]
    links = {
        lidar.get("name")
        for lidar in ElementTree.fromstring(block.text).iter("{http://www.ros.org/wiki/xacro}lidar")
    }
    for file in files().values():
        assert {node["ros__parameters"]["frame_id"] for node in file.values()} == links


def test_the_page_of_vendors_parameters_names_topics_parameters_and_services_of_the_node() -> None:
    topics = {"scan", "points", "imu", "packets", "/diagnostics"}
    services = ls.sensor("hesai-xt32").commands
    text = (pages.DOCS / DRIVERS).read_text(encoding="utf-8").partition("\n## ")[2]
    pairs = re.findall(r"^\| (.+) \| (.+) \|$", text, re.MULTILINE)
    assert len(pairs) > 25
    for theirs, ours in pairs:
        names = re.findall(r"`([\w./]+)`", re.split("[:;]", ours)[0])
        assert set(names) <= {*NAMED, *topics, "tf"}, theirs
        assert set(re.findall(r"`~/send/(\w+)`", ours)) <= set(services), theirs


def commands() -> list[list[str]]:
    """Return the arguments of the page's commands that start a node."""
    text = "\n".join(block.text for block in pages.blocks(HOW_TO) if block.language == "console")
    return [line.split() for line in re.findall(r"^\$ lidarspec ros2 (.+)$", text, re.MULTILINE)]


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_commands_on_the_page_start_a_node(
    run: Callable[..., Any], client: Client, tmp_path: Path, words: list[str]
) -> None:
    place = words.index("--ros-args") if "--ros-args" in words else len(words)
    source, *others = words[:place]
    simulated = "sim:ldrobot-stl27l" if source.startswith("/dev/") else source
    if source.endswith(".lsr"):
        subprocess.run(
            [
                sys.executable,
                "-m",
                "lidarspec",
                "sim",
                "ldrobot-stl27l",
                "--to",
                source,
                "-t",
                "5s",
            ],
            check=True,
            cwd=tmp_path,
        )
    node = run(simulated, *others, ros=words[place + 1 :])
    if "publish_tf:=true" in words and importlib.util.find_spec("tf2_msgs") is None:
        assert "publish_tf requires tf2_msgs" in node.communicate(timeout=PATIENCE)[1]
    else:
        client.until(
            lambda: any(
                status.message == "streaming"
                for array in client.diagnostics
                for status in array.status
            )
        )
