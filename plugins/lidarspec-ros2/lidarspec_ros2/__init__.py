"""ROS 2 driver for all lidars: the verb `lidarspec ros2`, and the executable `lidarspec_node`.

The driver is a lifecycle node that reads a `Device`, as every verb does. ROS is imported when the
node starts, not earlier. Modules in reading order:

* `command`: the verb and the executable, which find and import ROS.
* `parameters`: the table of parameters, and their values in one configuration.
* `ros_arguments`: reads the parameters on the command line before the node exists.
* `shared_memory`: enlarges the shared memory of Fast DDS for the clouds of the sensor.
* `node`: the lifecycle node, its services, and the thread that reads the sensor.
* `topics`: publishes messages.
* `packets`: publishes packets on a topic, and reads packets from a topic.
* `diagnostics`: the state of the sensor for /diagnostics.
* `clock`: stamps in ROS's time, and the conversion of the sensor's clock to the host's clock.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lidarspec.spec import hookimpl

if TYPE_CHECKING:
    import click

    from lidarspec.spec import Sensor, Transport


@hookimpl
def lidarspec_verbs() -> list[click.Command]:
    """Return the verb `ros2`."""
    from lidarspec_ros2.command import ros2

    return [ros2]


@hookimpl
def lidarspec_source(url: str, sensor: Sensor | None) -> Transport | None:
    """Return the transport for a URL ``ros2:/TOPIC``; None for any other URL."""
    scheme, _, topic = url.partition(":")
    if scheme != "ros2":
        return None
    from lidarspec_ros2.command import import_ros

    import_ros()
    from lidarspec_ros2.packets import PacketTransport

    return PacketTransport(url, topic, datagrams=sensor is None or sensor.datagrams)
