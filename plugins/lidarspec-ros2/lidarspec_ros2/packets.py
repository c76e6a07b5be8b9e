"""Packets over a topic: what arrives from a sensor is published, and what is published is a source,
`ros2:/TOPIC`.

So a node decodes again what another one published, or `ros2 bag play` plays, with the times at
which it arrived then.
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
from lidarspec.transports.robotics_logs import raw_chunk

#: packets that wait for a reader: some seconds of the fastest sensors.
WAITING = 5000
_NUMBER = itertools.count()


class PacketLog:
    """Hands what arrives on to a topic, in the place of a recording.

    Attributes:
        publish: what takes each chunk.
    """

    error = None

    def __init__(self) -> None:
        self.publish: Callable[[Chunk], None] | None = None

    def write(self, chunk: Chunk, direction: Literal["in", "out"] = "in") -> None:
        """Hand it on."""
        if direction == "in" and self.publish is not None:
            self.publish(chunk)

    def event(self, name: str, at: int | None = None, **details: Any) -> None:
        """The diagnostics say it."""

    def close(self) -> None:
        """There is nothing to close."""


class PacketTransport(LiveTransport):
    """The packets of a topic, in a context of ROS of its own.

    Args:
        label: how the user called it.
        topic: its name.
        datagrams: whether each packet is one.
    """

    def __init__(self, label: str, topic: str, *, datagrams: bool) -> None:
        self.label, self.datagrams, self._chunks = label, datagrams, list[Chunk]()
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(
            f"lidarspec_source_{os.getpid()}_{next(_NUMBER)}", context=self._context
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        qos = QoSProfile(depth=WAITING, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._node.create_subscription(
            UInt8MultiArray, topic, lambda message: self._chunks.append(raw_chunk(message)), qos
        )

    def read(self, timeout: float) -> list[Chunk]:
        """Return the packets that have come."""
        number = -1
        while number < len(self._chunks) < WAITING:
            number = len(self._chunks)
            self._executor.spin_once(timeout_sec=0.0 if number else timeout)
        chunks, self._chunks = self._chunks, []
        return chunks

    def reopen(self) -> None:
        """A topic does not go away."""

    def write(self, data: bytes) -> None:
        raise SourceError(f"cannot send to {self.label}: it is a topic of packets")

    def close(self) -> None:
        self.closed = True
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)
