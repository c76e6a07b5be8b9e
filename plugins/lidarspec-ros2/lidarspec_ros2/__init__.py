"""A ROS 2 driver for every lidar that lidarspec knows: the verb `lidarspec ros2`, and the executable `lidarspec_node`.

A lifecycle node over a `Device`, as every verb has one. ROS is imported when the node starts, and not before. Modules in reading order:

* `command`: the verb and the executable; which ROS there is.
* `parameters`: the one table of parameters, and the values of one configuration.
* `node`: the lifecycle, services, and the thread that reads.
* `topics`: what is published.
* `diagnostics`: how the sensor is doing, as /diagnostics says it.
* `clock`: stamps in ROS's time, and the sensor's clock by the host's.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lidarspec.spec import hookimpl

if TYPE_CHECKING:
    import click


@hookimpl
def lidarspec_verbs() -> list[click.Command]:
    """The verb `ros2`."""
    from lidarspec_ros2.command import ros2

    return [ros2]
