"""Calculate the stamps of messages in ROS's time.

The stamps are calculated from the times of the sensor's clock, or from arrival times.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarspec.packets.clock_estimate import DeviceClock
from lidarspec.transports.host_clock import HostClock
from lidarspec_ros2.parameters import Settings

Times = NDArray[np.int64]


def describe_jump(clock: DeviceClock) -> str:
    """Return a warning if the sensor's clock has recently been changed; otherwise ""."""
    if clock.jump is None:
        return ""
    return f"the sensor's clock was changed by {clock.jump.change_ns / 1e9:+.3f} s"


class MessageStamps:
    """The stamps of one sensor's messages, in ROS's time.

    Args:
        wall: the host's clock, for a live sensor; None if a recording is played.
    """

    def __init__(self, wall: HostClock | None) -> None:
        self.clock = DeviceClock()
        self._wall = wall
        self._wall_step_ns = 0

    def update_conversion(self, device_ns: Times, host_ns: Times) -> None:
        """Update the conversion of the sensor's clock to the host's clock.

        Args:
            device_ns: the time of each packet by the sensor's clock, ns.
            host_ns: the arrival time of each packet, ns; packets whose arrival time is 0 are
                ignored.
        """
        is_known = host_ns > 0
        self.clock.observe(device_ns[is_known], host_ns[is_known])
        step = None if self._wall is None else self._wall.find_step()
        if step is not None:
            self._wall_step_ns = step

    def stamp_scan(self, device_ns: int, host_ns: int, settings: Settings) -> int:
        """Return the stamp of a scan, ns. Call this once for each scan, in order.

        Args:
            device_ns: the time of the scan's first point by the sensor's clock, ns.
            host_ns: the arrival time of the packet with this point, ns.
        """
        return self._choose_stamp(
            device_ns, self.clock.stamp(device_ns, host_ns), host_ns, settings
        )

    def stamp_sample(self, time_ns: int, settings: Settings, *, by_clock: bool) -> int:
        """Return the stamp of an IMU sample, ns.

        Args:
            time_ns: the time of the sample by the sensor's clock, or its arrival time.
            by_clock: whether `time_ns` is by the sensor's clock.
        """
        host_ns = time_ns
        if by_clock:
            host_ns += self.clock.offset_ns
        return self._choose_stamp(time_ns, host_ns, host_ns, settings)

    def _choose_stamp(
        self, device_ns: int, converted_ns: int, arrival_ns: int, settings: Settings
    ) -> int:
        """Return the stamp that the parameters select, ns.

        Args:
            device_ns: the sensor's time.
            converted_ns: the sensor's time converted to the host's clock.
            arrival_ns: the arrival time.
        """
        if not settings["use_device_time"]:
            stamp = arrival_ns + self._wall_step_ns
        elif settings["device_time_is_ros_time"]:
            stamp = device_ns
        else:
            stamp = converted_ns + self._wall_step_ns
        offset: float = settings["time_offset"]
        return stamp + round(offset * 1e9)
