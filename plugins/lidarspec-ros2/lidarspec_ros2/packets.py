"""Publish received packets on a topic, and read the packets of a topic.

The SOURCE `ros2:/TOPIC` reads the packets of a topic. A node can therefore decode packets that
another node or `ros2 bag play` publishes, with their original arrival times.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from typing import Any, Literal

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import UInt8MultiArray

from lidarspec.errors import SourceError
from lidarspec.transports.protocol import Chunk, LiveTransport
from lidarspec.transports.robotics_logs import read_chunk

MAX_WAITING_PACKETS = 5000  # some seconds of the fastest sensors
_NODE_NUMBERS = itertools.count()


class PacketLog:
    """A `TrafficLog` that publishes received packets instead of recording them.

    Attributes:
        publish: the function that publishes a chunk.
    """

    error = None

    def __init__(self) -> None:
        self.publish: Callable[[Chunk], None] | None = None

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Publish a received chunk; sent data is ignored."""
        if direction == "in" and self.publish is not None:
            self.publish(chunk)

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """Ignore an event, because the diagnostics report events."""

    def close(self) -> None:
        """Do nothing, because no file is open."""


class PacketTransport(LiveTransport):
    """Reads the packets of a topic, in a separate ROS context.

    Args:
        label: the source as the user wrote it.
        datagrams: whether each packet is a datagram.
    """

    def __init__(self, label: str, topic: str, *, datagrams: bool) -> None:
        self.label = label
        self.datagrams = datagrams
        self._chunks = list[Chunk]()
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(
            f"lidarspec_source_{os.getpid()}_{next(_NODE_NUMBERS)}", context=self._context
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        qos = QoSProfile(depth=MAX_WAITING_PACKETS, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._node.create_subscription(
            UInt8MultiArray, topic, lambda message: self._chunks.append(read_chunk(message)), qos
        )

    def read(self, timeout: float) -> list[Chunk]:
        """Return the received packets, after at most `timeout` seconds."""
        count = -1
        while count < len(self._chunks) < MAX_WAITING_PACKETS:
            count = len(self._chunks)
            self._executor.spin_once(timeout_sec=0.0 if count else timeout)
        chunks = self._chunks
        self._chunks = []
        return chunks

    def reopen(self) -> None:
        """Do nothing, because a topic does not disappear."""

    def write(self, data: bytes) -> None:
        raise SourceError(
            f"cannot send to {self.label}: it is a ROS topic, from which packets can only be read"
        )

    def close(self) -> None:
        self.closed = True
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)
