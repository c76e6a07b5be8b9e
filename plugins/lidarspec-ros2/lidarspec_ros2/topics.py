"""Publish the messages of a sensor on its topics.

Messages are published as bytes, in the same encoding as in log files.
"""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from typing import Any

from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu, LaserScan, PointCloud2
from std_msgs.msg import UInt8MultiArray

from lidarspec.errors import UsageError
from lidarspec.formats.messages import CLOUD, IMU, SCAN, RosMessage, RosMessages
from lidarspec.framing.results import Counters
from lidarspec.packets.imu import ImuSamples
from lidarspec.packets.packets import Packets
from lidarspec.packets.stream import ImuStream
from lidarspec.points.mount import Mount
from lidarspec.scans.scan import Scan
from lidarspec.scans.selection import ScanSelector
from lidarspec.sensor_operations import Sensor
from lidarspec.transports.host_clock import HostClock
from lidarspec.transports.protocol import Chunk
from lidarspec.transports.robotics_logs import RAW
from lidarspec_ros2.clock import MessageStamps
from lidarspec_ros2.parameters import Settings
from lidarspec_ros2.shared_memory import format_megabytes

#: Kind of message -> topic, class, and number of messages kept for slow subscribers. Scans are kept
#: for five seconds, because Fast DDS requests lost messages only every three seconds, and a busy
#: computer loses parts of large clouds.
TOPICS = {
    CLOUD: ("points", PointCloud2, 50),
    SCAN: ("scan", LaserScan, 50),
    IMU: ("imu", Imu, 200),
    RAW: ("packets", UInt8MultiArray, 2000),
}
#: QoS settings that users can change with parameters such as `qos_overrides./scan.publisher.depth`.
_QOS_OVERRIDES = QoSOverridingOptions.with_default_policies()


class Topics:
    """The topics of one sensor.

    Args:
        is_file: whether a file is played. The stamps of its scans are then published on /clock if
            `use_sim_time` is set.
        max_cloud_bytes: the largest cloud that reaches subscribers with the reliability "best
            effort", in bytes; None if unknown.

    Attributes:
        sent: the number of published messages, by topic.
        planar_scan_fault: the reason why the requested planar scan cannot be made; "" if it can.
        latency_s: seconds from the arrival of the last packets of a scan to its publication.

    Raises:
        UsageError: if the transform cannot be published because a package is missing.
    """

    def __init__(
        self,
        node: LifecycleNode,
        settings: Settings,
        sensor: Sensor,
        *,
        is_file: bool,
        max_cloud_bytes: int | None = None,
    ) -> None:
        self._max_cloud_bytes = max_cloud_bytes
        self._node = node
        self._sensor = sensor
        self.stamps = MessageStamps(None if is_file else HostClock())
        self._messages = RosMessages("ROS2_HUMBLE")
        self._reliability = (
            ReliabilityPolicy.RELIABLE
            if settings["qos"] == "reliable"
            else ReliabilityPolicy.BEST_EFFORT
        )
        self._publishers: dict[str, Any] = {}
        self.sent = Counter[str]()
        self._publishing = threading.Lock()
        self._plain_publishers = list[Any]()
        self.active = False
        self.latency_s = 0.0
        self.planar_scan_fault = ""
        self._arrival_ns = 0
        self.use_settings(settings)
        self._get_publisher(CLOUD)
        if settings["publish_packets"]:
            self._get_publisher(RAW)
        self._is_imu_by_clock = ImuStream(sensor, Counters()).waiting is not None
        if sensor.imu_frames:
            self._get_publisher(IMU)
        if settings["publish_tf"]:
            self._publish_transform(settings)
        self._clock_publisher = (
            self._make_plain_publisher(Clock, "/clock", 10)
            if is_file and node.get_parameter("use_sim_time").value
            else None
        )

    def use_settings(self, settings: Settings) -> None:
        """Apply the parameters to all later messages."""
        self._settings = settings
        self._planar_scans = settings.make_planar_scans()
        self._selector = ScanSelector(settings.make_selection())

    def update_conversion(self, packets: Packets) -> None:
        """Update the conversion of the sensor's clock with the times of packets."""
        self._arrival_ns = int(packets.host_ns[0]) or self._arrival_ns
        self.stamps.update_conversion(packets.time_ns, packets.host_ns)

    def publish(self, scan: Scan) -> None:
        """Publish a scan on the topics with subscribers."""
        selected = self._selector.select(scan)
        assert selected is not None  # nothing is selected by number or time
        stamp = self._calculate_stamp(scan)
        settings = self._settings
        if self._has_subscribers(CLOUD):
            organised = settings["organized"] and selected.points.shape is not None
            self._send(self._messages.cloud(selected, stamp, every_point=organised))
        try:
            planar = self._planar_scans.project(selected)
            self.planar_scan_fault = ""
        except UsageError as error:  # a ring that the sensor lacks: it is set at run time
            planar = None
            self.planar_scan_fault = str(error)
        if planar is not None and self._has_subscribers(SCAN):
            self._send(
                self._messages.laserscan(
                    selected,
                    settings.narrow_range_limits(planar),
                    stamp + planar.stamp_ns - scan.stamp_ns,
                )
            )
        self.latency_s = (time.time_ns() - self._arrival_ns) / 1e9
        if self._clock_publisher is not None and self.active:
            self._clock_publisher.publish(Clock(clock=Time(nanoseconds=stamp).to_msg()))

    def publish_imu(self, samples: ImuSamples) -> None:
        """Publish samples of the IMU."""
        if not len(samples) or not self._has_subscribers(IMU):
            return
        for index in range(len(samples)):
            stamp = self.stamps.stamp_sample(
                int(samples.time_ns[index]), self._settings, by_clock=self._is_imu_by_clock
            )
            self._send(self._messages.imu(samples, index, stamp, self._settings["frame_id"]))

    def publish_packet(self, chunk: Chunk) -> None:
        """Publish a received packet."""
        if self._has_subscribers(RAW):
            self._send(self._messages.raw(chunk, datagram=self._sensor.datagrams))

    def set_active(self, *, active: bool) -> None:
        """Start to publish if `active`, otherwise stop."""
        with self._publishing:
            self.active = active
            for publisher in self._publishers.values():
                (publisher.on_activate if active else publisher.on_deactivate)(None)

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        for publisher in self._plain_publishers:
            self._node.destroy_publisher(publisher)

    def _calculate_stamp(self, scan: Scan) -> int:
        """Return the time of the first point in ROS's time, ns."""
        if not scan.host_ns:  # a file without arrival times
            return int(self._node.get_clock().now().nanoseconds)
        return self.stamps.stamp_scan(scan.stamp_ns, scan.host_ns, self._settings)

    def _get_publisher(self, kind: str) -> Any:
        """Return the publisher of a kind of messages, created on first use."""
        if kind not in self._publishers:
            topic, message, depth = TOPICS[kind]
            qos = QoSProfile(depth=depth, reliability=self._reliability)
            publisher = self._node.create_lifecycle_publisher(
                message, topic, qos, qos_overriding_options=_QOS_OVERRIDES
            )
            with self._publishing:
                self._publishers[kind] = publisher
                if self.active:
                    publisher.on_activate(None)
        return self._publishers[kind]

    def _make_plain_publisher(self, message: Any, topic: str, qos: Any) -> Any:
        """Return a new publisher that is independent of the lifecycle."""
        self._plain_publishers.append(self._node.create_publisher(message, topic, qos))
        return self._plain_publishers[-1]

    def _publish_transform(self, settings: Settings) -> None:
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError as error:
            raise UsageError(
                f"publish_tf requires tf2_msgs, which is not installed ({error}): install it, or"
                " use static_transform_publisher"
            ) from None
        qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        stamp = self._node.get_clock().now().to_msg()
        self._make_plain_publisher(TFMessage, "/tf_static", qos).publish(
            TFMessage(transforms=[make_transform(settings, stamp)])
        )

    def _has_subscribers(self, kind: str) -> bool:
        return self.active and self._get_publisher(kind).get_subscription_count() > 0

    def _send(self, message: RosMessage) -> None:
        publisher = self._get_publisher(message.kind)
        data = bytes(message.data)
        if message.kind == CLOUD:
            self._warn_of_large_cloud(len(data))
        # Packets come from a thread of their own, transitions from another one.
        with self._publishing:
            if self.active:
                publisher.publish(data)
                self.sent[TOPICS[message.kind][0]] += 1

    def _warn_of_large_cloud(self, size: int) -> None:
        """Warn once if a cloud is too large for the chosen shared memory."""
        limit = self._max_cloud_bytes
        is_reliable = self._reliability == ReliabilityPolicy.RELIABLE
        if limit is None or size <= limit or is_reliable:
            return
        self._max_cloud_bytes = None
        self._node.get_logger().warning(
            f"clouds of {format_megabytes(size)} may be lost, because the shared memory was made"
            f" for clouds of up to {format_megabytes(limit)}; start the node with the parameter"
            " sensor, so that it knows the size of the clouds, or set qos:=reliable"
        )


def make_transform(settings: Settings, stamp: Any) -> TransformStamped:
    """Return the transform from the parent frame to the frame of the points."""
    mount = settings.find_mount() or Mount()
    roll, pitch, yaw = (
        math.radians(angle) / 2
        for angle in (mount.roll_deg + 180.0 * mount.inverted, mount.pitch_deg, mount.yaw_deg)
    )
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(half), math.cos(half)) for half in (roll, pitch, yaw))
    rotation = Quaternion(
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
        w=cr * cp * cy + sr * sp * sy,
    )
    stamped = TransformStamped(child_frame_id=settings["frame_id"])
    stamped.header.stamp = stamp
    stamped.header.frame_id = settings["parent_frame"]
    stamped.transform = Transform(
        translation=Vector3(x=mount.x, y=mount.y, z=mount.z), rotation=rotation
    )
    return stamped
