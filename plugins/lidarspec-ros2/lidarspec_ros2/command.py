"""The verb `lidarspec ros2` and the executable `lidarspec_node`: the node in a separate process.

If there are several ROS installations, the node uses the installation that Python imports. A
sourced installation is in PYTHONPATH, and is therefore found before the wheels of the extra `ros2`.
"""

from __future__ import annotations

import contextlib
import importlib
import signal
import sys
import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import click

from lidarspec.cli.failures import report
from lidarspec.cli.options import sensor_words
from lidarspec.errors import UsageError
from lidarspec.known_sensors import install_command

if TYPE_CHECKING:
    from rclpy.executors import Executor

    from lidarspec.sensor_operations import Sensor
    from lidarspec_ros2.node import LidarNode
    from lidarspec_ros2.shared_memory import SharedMemory


#: Seconds between two checks for a signal.
SIGNAL_CHECK_S = 0.1


class _RosCommand(click.Command):
    """A verb that leaves --ros-args and all following words to ROS."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        index = args.index("--ros-args") if "--ros-args" in args else len(args)
        ctx.meta["ros_args"] = args[index:]
        return super().parse_args(ctx, args[:index])

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        return [*super().collect_usage_pieces(ctx), "[--ros-args ...]"]


@click.command(cls=_RosCommand)
@click.argument("source", metavar="SOURCE")
@sensor_words
@click.pass_context
def ros2(
    ctx: click.Context,
    source: str,
    sensor_id: str | None,
    options: Sequence[str],
    calibration: str | None,
) -> None:
    """Run a ROS 2 node that publishes the scans of a sensor.

    The node runs until it is interrupted or the file ends. It is configured and activated when it
    starts. Options after --ros-args are those of ROS: parameters (-p frame_id:=front), a parameter
    file (--params-file), names (-r __node:=front, -r scan:=front/scan). The reference lists the
    parameters of the node.
    """
    parameters = {
        "source": source,
        "sensor": sensor_id,
        "options": list(options),
        "calibration": calibration,
        "autostart": True,
    }
    run({name: value for name, value in parameters.items() if value}, ctx.meta["ros_args"])


def main() -> None:
    """Run the executable: the node with all settings from ROS's arguments."""
    try:
        run({}, sys.argv[1:])
    except Exception as error:
        sys.exit(report(error, "ros2"))


def import_ros() -> None:
    """Import ROS, to check that it is installed.

    Raises:
        UsageError: if ROS is not installed; the message explains how to install it.
    """
    try:
        importlib.import_module("rclpy")
    except ImportError as error:
        text = f"ROS 2 not found ({error})"
        raise UsageError(
            f"{text}: run its setup script, such as `. /opt/ros/jazzy/setup.bash`, or run:"
            f" {install_command('lidarspec-ros2', extra='ros2')}"
        ) from None


def run(given: Mapping[str, Any], ros_args: Sequence[str]) -> None:
    """Run the node until it is interrupted or its input ends.

    Args:
        ros_args: the words of the command line that are for ROS.

    Raises:
        LidarSpecError: if ROS is missing, a parameter is invalid, or the sensor cannot be read.
    """
    import_ros()
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    from lidarspec_ros2.node import LidarNode
    from lidarspec_ros2.shared_memory import use_profile

    signals = list[int]()
    nodes = list[LidarNode]()

    def handle_signal(number: int, frame: object) -> None:
        """Record the signal, for which `_serve` waits.

        If a node waits for its sensor, also interrupt this wait.
        """
        signals.append(number)
        if any(node.opening for node in nodes):
            raise KeyboardInterrupt

    previous = {
        number: signal.signal(number, handle_signal) for number in (signal.SIGINT, signal.SIGTERM)
    }
    rclpy.init(
        args=["lidarspec_node", *ros_args], signal_handler_options=rclpy.SignalHandlerOptions.NO
    )
    try:
        memory = _find_shared_memory(given, ros_args)
        with use_profile(memory):
            nodes.append(LidarNode(given, max_cloud_bytes=memory.max_cloud_bytes))
        _log_shared_memory(nodes[0], memory)
        executor = SingleThreadedExecutor()
        executor.add_node(nodes[0])
        _serve(nodes[0], executor, signals)
    finally:
        rclpy.try_shutdown()
        for number, handler in previous.items():
            signal.signal(number, handler)


def _find_shared_memory(given: Mapping[str, Any], ros_args: Sequence[str]) -> SharedMemory:
    """Return the settings of shared memory for the sensor that the parameters name."""
    from rclpy.utilities import get_rmw_implementation_identifier

    from lidarspec.transports.open_url import live_address
    from lidarspec_ros2.parameters import NAMED, NODE_NAME, Settings
    from lidarspec_ros2.ros_arguments import read_parameters
    from lidarspec_ros2.shared_memory import choose_shared_memory

    values = {name: parameter.default for name, parameter in NAMED.items()}
    for name, value in [*read_parameters(ros_args, NODE_NAME).items(), *given.items()]:
        if name in NAMED and isinstance(value, type(values[name])):  # ROS refuses all other types
            values[name] = value
    address = live_address(str(values["source"]))
    is_serial = address is not None and address.scheme == "serial"

    def find_sensor() -> Sensor | None:
        return Settings(values).find_known_sensor()

    rmw = get_rmw_implementation_identifier()
    return choose_shared_memory(rmw, find_sensor, is_serial=is_serial)


def _log_shared_memory(node: LidarNode, memory: SharedMemory) -> None:
    """Log how the node uses shared memory."""
    if memory.notice:
        node.get_logger().info(memory.notice)
    if memory.warning:
        node.get_logger().warning(memory.warning)


def _serve(node: LidarNode, executor: Executor, signals: Sequence[int]) -> None:
    """Run the node until it ends or a signal arrives, and then close it.

    Raises:
        Exception: the failure of the node, if the node starts automatically.
    """
    serving = threading.Thread(target=executor.spin, name="executor")
    try:
        with contextlib.suppress(KeyboardInterrupt):
            if node.autostarts and not signals:
                node.start()
            serving.start()
            # A signal that arrives just before the wait does not end it, so the wait is short.
            while not signals and not node.ended.wait(SIGNAL_CHECK_S):
                pass
    finally:
        executor.shutdown()
        if serving.ident is not None:
            serving.join()
        node.close()
        node.destroy_node()
    if node.autostarts and node.failure is not None:
        raise node.failure
