"""Tests of parameters on the command line, compared with ROS's own parser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import rclpy

from lidarspec_ros2.ros_arguments import read_parameters

FILE = """
/**:
  ros__parameters: {source: "udp://", sensor: of-all}
/front/lidar:
  ros__parameters: {sensor: of-front}
back:
  lidar:
    ros__parameters: {sensor: of-back, options: [answer=data]}
/*/camera:
  ros__parameters: {sensor: of-cameras}
lidar:
  ros__parameters: {sensor: of-lidar}
"""


def read_by_ros(words: list[str]) -> dict[str, Any]:
    """Return the parameters that rclpy gives to a node with these words."""
    context = rclpy.Context()
    rclpy.init(args=words, context=context)
    try:
        node = rclpy.create_node(
            "lidar", context=context, automatically_declare_parameters_from_overrides=True
        )
        values = {
            name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()
        }
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
    return {
        name: value for name, value in values.items() if name in ("source", "sensor", "options")
    }


@pytest.mark.parametrize(
    "words",
    [
        ["-p", "sensor:=acme-x1", "--param", "source:=/dev/ttyUSB0"],
        ["--params-file", "FILE"],
        ["--params-file", "FILE", "-r", "__ns:=/front"],
        ["--params-file", "FILE", "-r", "__ns:=/back"],
        ["--params-file", "FILE", "-r", "__ns:=/left/side"],
        ["--params-file", "FILE", "-r", "__ns:=/left", "--remap", "__node:=camera"],
        ["--params-file", "FILE", "-p", "sensor:=later"],
        ["-p", "sensor:=earlier", "--params-file", "FILE"],
        ["-p", "lidar:sensor:=earlier", "-p", "sensor:=later"],
        ["-p", "lidar:sensor:=earlier", "--params-file", "FILE", "-p", "source:=ros2:/packets"],
        ["-p", "lidar:sensor:=mine", "-p", "camera:source:=another"],
        ["-p", "options:=[answer=data]"],
        [],
    ],
    ids=" ".join,
)
def test_parameters_are_those_that_ros_reads(tmp_path: Path, words: list[str]) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text(FILE, encoding="utf-8")
    arguments = ["--ros-args", *(str(file) if word == "FILE" else word for word in words)]
    assert read_parameters(arguments, "lidar") == read_by_ros(arguments)


@pytest.mark.parametrize("content", [None, "sensor: [", "- a list", "\xff"])
def test_a_file_that_ros_refuses_is_ignored(tmp_path: Path, content: str | None) -> None:
    file = tmp_path / "parameters.yaml"
    if content is not None:
        file.write_bytes(content.encode("latin-1"))
    words = ["--ros-args", "--params-file", str(file), "-p", "source:=udp://", "-p", "sensor:=["]
    assert read_parameters(words, "lidar") == {"source": "udp://"}


def test_other_arguments_are_ignored() -> None:
    words = [
        "-p",
        "sensor:=before",
        "--ros-args",
        "-p",
        "source:=udp://",
        "--",
        "-p",
        "sensor:=after",
    ]
    assert read_parameters(words, "lidar") == {"source": "udp://"}
