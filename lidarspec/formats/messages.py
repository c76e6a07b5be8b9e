"""Serialize scans, packets and IMU samples as ROS messages, for logs and topics.

A scan becomes a sensor_msgs/PointCloud2. For planar sensors, it also becomes a
sensor_msgs/LaserScan with evenly spaced angles.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError
from lidarspec.formats.common import to_image
from lidarspec.optional_libraries import import_library
from lidarspec.packets.imu import ImuSamples
from lidarspec.points.cloud import PointCloud
from lidarspec.scans.laserscan import LaserScan
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Chunk
from lidarspec.transports.robotics_logs import DATAGRAM, RAW, STAMP, STREAM

CLOUD, SCAN, IMU = (f"sensor_msgs/msg/{name}" for name in ("PointCloud2", "LaserScan", "Imu"))
#: The number of each NumPy type in PointField. Values of other types are written as float64.
FIELD_TYPES = {"i1": 1, "u1": 2, "b1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_SECOND = 1_000_000_000


class RosMessage(NamedTuple):
    """A serialized message.

    Attributes:
        kind: the message type.
        at: the stamp or arrival time, ns since 1970.
        data: the bytes.
    """

    kind: str
    at: int
    data: memoryview


class RosMessages:
    """Makes ROS messages.

    The methods raise UsageError if the stamp is outside the range of ROS messages.

    Args:
        release: the ROS release of the message definitions, e.g. "ROS1_NOETIC".
    """

    def __init__(self, release: str) -> None:
        typesys = import_library("rosbags.typesys", "ros")
        self.types = typesys.get_typestore(typesys.Stores[release])
        if release.startswith("ROS1"):
            self._serialized = self.types.serialize_ros1
        else:
            self._serialized = self.types.serialize_cdr
        self._has_sequence = release.startswith("ROS1")

    def raw(self, packet: Chunk, *, datagram: bool = True) -> RosMessage:
        """Return a message with a raw packet, which `transports.robotics_logs` can read.

        Args:
            datagram: True if the packet is a datagram, False if it is a piece of a stream.
        """
        at = packet.at or 0
        size = len(packet.data)
        types = self.types.types
        dimension = types["std_msgs/msg/MultiArrayDimension"](
            label=DATAGRAM if datagram else STREAM, size=size, stride=size
        )
        layout = types["std_msgs/msg/MultiArrayLayout"](dim=[dimension], data_offset=STAMP.size)
        return self._serialize(
            RAW, at, layout=layout, data=np.frombuffer(STAMP.pack(at) + packet.data, np.uint8)
        )

    def cloud(self, scan: Scan, at: int, *, every_point: bool, number: int = 0) -> RosMessage:
        """Return a PointCloud2 message with the points of a scan.

        If all points of an organized scan are written, the cloud has a row for each ring.

        Args:
            at: the stamp of the message, ns.
            every_point: whether to include points without a valid return.
            number: the number of the scan, for the header of ROS 1 messages.
        """
        cloud = scan.points
        points = make_records(cloud, every_point=every_point)
        fields = [
            (name, offset, FIELD_TYPES[kind])
            for name, offset, kind in describe_fields(cloud, points)
        ]
        # A copy of records would omit the padding between fields, so they become plain bytes.
        points = points.view(np.dtype((np.void, points.itemsize)))
        if every_point and cloud.shape and len(cloud):
            points = to_image(points, cloud)
        height, width = np.atleast_2d(points).shape
        field = self.types.types["sensor_msgs/msg/PointField"]
        return self._serialize(
            CLOUD,
            at,
            header=self._make_header(number, at, scan.frame_id),
            height=height,
            width=width,
            fields=[field(name, offset, kind, 1) for name, offset, kind in fields],
            is_bigendian=False,
            point_step=points.itemsize,
            row_step=points.itemsize * width,
            data=np.ascontiguousarray(points).view(np.uint8).reshape(-1),
            is_dense=not every_point or bool(cloud.valid.all()),
        )

    def laserscan(self, scan: Scan, planar: LaserScan, at: int, *, number: int = 0) -> RosMessage:
        """Return a LaserScan message; the arguments are the same as for `cloud`."""
        names = self.types.types[SCAN].__dataclass_fields__
        values = {name: getattr(planar, name) for name in names if hasattr(planar, name)}
        if scan.points.intensity is None:
            values["intensities"] = np.empty(0, np.float32)
        return self._serialize(
            SCAN, at, **values, header=self._make_header(number, at, scan.frame_id)
        )

    def imu(self, samples: ImuSamples, index: int, at: int, frame_id: str) -> RosMessage:
        """Return an Imu message with one sample, as REP-145 specifies."""
        vector = self.types.types["geometry_msgs/msg/Vector3"]
        values: dict[str, Any] = {}
        for name in ("angular_velocity", "linear_acceleration"):
            measured = getattr(samples, name)[index]
            is_finite = bool(np.isfinite(measured).all())
            values |= {
                name: vector(*np.where(is_finite, measured, 0.0).tolist()),
                f"{name}_covariance": _make_covariance(is_known=is_finite),
            }
        values["orientation"] = self.types.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        values["orientation_covariance"] = _make_covariance(is_known=False)
        return self._serialize(IMU, at, header=self._make_header(0, at, frame_id), **values)

    def _serialize(self, name: str, at: int, **values: Any) -> RosMessage:
        return RosMessage(name, at, self._serialized(self.types.types[name](**values), name))

    def _make_header(self, number: int, stamp_ns: int, frame_id: str) -> Any:
        sequence = {"seq": number} if self._has_sequence else {}
        return self.types.types["std_msgs/msg/Header"](
            **sequence, stamp=self._make_time(stamp_ns), frame_id=frame_id
        )

    def _make_time(self, at: int) -> Any:
        if not 0 <= at < _SECOND << 31:
            raise UsageError(
                f"the stamp of a scan or packet is {at} ns, but ROS supports only the years 1970 to"
                " 2038"
            )
        return self.types.types["builtin_interfaces/msg/Time"](*divmod(at, _SECOND))


def _make_covariance(*, is_known: bool) -> NDArray[np.float64]:
    values = np.zeros(9)
    values[0] = 0.0 if is_known else -1.0
    return values


def describe_fields(cloud: PointCloud, points: NDArray[Any]) -> list[tuple[str, int, str]]:
    """Return (name, offset, type) of each field of a cloud's records.

    The offset is in bytes. The type is, for example, "f4".
    """
    lacking = {
        name
        for name in ("intensity", "ring", "time")
        if not cloud.is_selected(name) or getattr(cloud, name) is None
    }
    return [
        (name, field[1], field[0].str[1:])
        for name, field in (points.dtype.fields or {}).items()
        if name not in lacking
    ]


def make_records(cloud: PointCloud, *, every_point: bool) -> NDArray[Any]:
    """Return the points to write, with PCL's layout and types that messages support."""
    points = cloud.to_structured()
    if not every_point:
        points = np.compress(cloud.valid, points)  # ten times as fast as indexing
    kinds = {name: points.dtype[name] for name in points.dtype.names or ()}
    if all(kind.str[1:] in FIELD_TYPES for kind in kinds.values()):
        return points
    supported_types = [
        (name, kind if kind.str[1:] in FIELD_TYPES else np.dtype(np.float64))
        for name, kind in kinds.items()
    ]
    return points.astype(np.dtype(supported_types, align=True))
