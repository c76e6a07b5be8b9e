"""Start two lidars: the nodes /front/lidar and /back/lidar, with parameters from one file.

ros2 launch lidarspec_ros2 two_lidars.launch.py config:=mine.yaml
"""

from pathlib import Path

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription

CONFIG = Path(__file__).resolve().parent.parent / "config" / "two_lidars.yaml"


def generate_launch_description() -> LaunchDescription:
    """Return a launch description with the argument `config` and both nodes."""
    config = DeclareLaunchArgument(
        "config",
        default_value=str(CONFIG),
        description="The parameters of /front/lidar and /back/lidar.",
    )
    nodes = [
        Node(
            package="lidarspec_ros2",
            executable="lidarspec_node",
            namespace=namespace,
            name="lidar",
            parameters=[LaunchConfiguration("config")],
            output="screen",
            respawn=True,
            respawn_delay=2.0,
        )
        for namespace in ("front", "back")
    ]
    return LaunchDescription([config, *nodes])
