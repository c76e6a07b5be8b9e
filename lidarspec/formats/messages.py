"""Serialize scans, packets and IMU samples as ROS messages, for logs and topics.

A scan is a sensor_msgs/PointCloud2, and for planar sensors a sensor_msgs/LaserScan on an even grid
of angles. Points have PCL's layout: x y z intensity time as float32, ring as uint16, then the
additional columns. A column that the sensor lacks is omitted.
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
#: the numbers of types in PointField; other types are written as float64.
FIELD_TYPES = {"i1": 1, "u1": 2, "b1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_SECOND = 1_000_000_000


class RosMessage(NamedTuple):
    """A serialized message: its type, its time in ns, its bytes."""

    kind: str
    at: int
    data: memoryview


class RosMessages:
    """Makes messages.

    Args:
        release: the release with the message definitions, as rosbags names it: "ROS1_NOETIC".

    Attributes:
        types: the definitions.

    Methods raise a UsageError for a stamp that no message can contain.
    """

    def __init__(self, release: str) -> None:
        typesys = import_library("rosbags.typesys", "ros")
        self.types = typesys.get_typestore(typesys.Stores[release])
        if release.startswith("ROS1"):
            self._serialized = self.types.serialize_ros1
        else:
            self._serialized = self.types.serialize_cdr
        self._counts = release.startswith("ROS1")

    def raw(self, packet: Chunk, *, datagram: bool = True) -> RosMessage:
        """Return a raw packet as a message, which `transports.robotics_logs` reads again.

        Args:
            datagram: whether it is a datagram, not a piece of a stream.
        """
        at = packet.at or 0
        size = len(packet.data)
        types = self.types.types
        dimension = types["std_msgs/msg/MultiArrayDimension"](
            label=DATAGRAM if datagram else STREAM, size=size, stride=size
        )
        layout = types["std_msgs/msg/MultiArrayLayout"](dim=[dimension], data_offset=STAMP.size)
        return self._message(
            RAW, at, layout=layout, data=np.frombuffer(STAMP.pack(at) + packet.data, np.uint8)
        )

    def cloud(self, scan: Scan, at: int, *, every_point: bool, number: int = 0) -> RosMessage:
        """Return the points of a scan.

        Organized points have the sensor's rows, with several returns side by side. Others, and
        valid points alone, have one row.

        Args:
            at: its stamp, ns.
            every_point: also points without a valid return.
            number: of the scan, for messages of ROS 1.
        """
        cloud = scan.points
        points = make_records(cloud, every_point=every_point)
        fields = [
            (name, offset, FIELD_TYPES[kind])
            for name, offset, kind in describe_fields(cloud, points)
        ]
        points = points.view(
            np.dtype((np.void, points.itemsize))
        )  # copied as a whole, because a copy of records skips the padding between fields
        if every_point and cloud.shape and len(cloud):
            points = to_image(points, cloud)
        height, width = np.atleast_2d(points).shape
        field = self.types.types["sensor_msgs/msg/PointField"]
        return self._message(
            CLOUD,
            at,
            header=self._header(number, at, scan.frame_id),
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
        """Return a planar scan on a grid of angles; arguments as for `cloud`."""
        names = self.types.types[SCAN].__dataclass_fields__
        values = {name: getattr(planar, name) for name in names if hasattr(planar, name)}
        if scan.points.intensity is None:
            values["intensities"] = np.empty(0, np.float32)
        return self._message(SCAN, at, **values, header=self._header(number, at, scan.frame_id))

    def imu(self, samples: ImuSamples, index: int, at: int, frame_id: str) -> RosMessage:
        """Return one IMU sample, by REP-145.

        The first covariance is -1 for a quantity that is not measured, and 0 for one with unknown
        error.
        """
        vector = self.types.types["geometry_msgs/msg/Vector3"]
        values: dict[str, Any] = {}
        for name in ("angular_velocity", "linear_acceleration"):
            measured = getattr(samples, name)[index]
            is_finite = bool(np.isfinite(measured).all())
            values |= {
                name: vector(*np.where(is_finite, measured, 0.0).tolist()),
                f"{name}_covariance": _covariance(is_known=is_finite),
            }
        upright = self.types.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        turned = {"orientation": upright, "orientation_covariance": _covariance(is_known=False)}
        return self._message(IMU, at, header=self._header(0, at, frame_id), **turned, **values)

    def _message(self, name: str, at: int, **values: Any) -> RosMessage:
        return RosMessage(name, at, self._serialized(self.types.types[name](**values), name))

    def _header(self, number: int, stamp_ns: int, frame_id: str) -> Any:
        counted = {"seq": number} if self._counts else {}
        return self.types.types["std_msgs/msg/Header"](
            **counted, stamp=self._time(stamp_ns), frame_id=frame_id
        )

    def _time(self, at: int) -> Any:
        if not 0 <= at < _SECOND << 31:
            raise UsageError(
                f"stamp of a scan or packet is {at} ns: ROS supports the years 1970 to 2038"
            )
        return self.types.types["builtin_interfaces/msg/Time"](*divmod(at, _SECOND))


def _covariance(*, is_known: bool) -> NDArray[np.float64]:
    values = np.zeros(9)
    values[0] = 0.0 if is_known else -1.0
    return values


def describe_fields(cloud: PointCloud, points: NDArray[Any]) -> list[tuple[str, int, str]]:
    """Return name, offset and type ("f4") of each field of a cloud's records.

    Columns that the cloud lacks are omitted.
    """
    lacking = {
        name
        for name in ("intensity", "ring", "time")
        if not cloud.has_column(name) or getattr(cloud, name) is None
    }
    return [
        (name, place[1], place[0].str[1:])
        for name, place in (points.dtype.fields or {}).items()
        if name not in lacking
    ]


def make_records(cloud: PointCloud, *, every_point: bool) -> NDArray[Any]:
    """Return the points to write in PCL's layout, in types that messages support."""
    points = cloud.to_structured()
    if not every_point:
        points = np.compress(cloud.valid, points)  # ten times as fast as an index
    kinds = {name: points.dtype[name] for name in points.dtype.names or ()}
    if all(kind.str[1:] in FIELD_TYPES for kind in kinds.values()):
        return points
    known = [
        (name, kind if kind.str[1:] in FIELD_TYPES else np.dtype(np.float64))
        for name, kind in kinds.items()
    ]
    return points.astype(np.dtype(known, align=True))
