"""Robotics logs: each scan as ROS's messages, in an MCAP file, a ROS 1 bag or a ROS 2 bag.

On /points stands each scan as sensor_msgs/PointCloud2, and on /scan, where the sensor has one plane, as sensor_msgs/LaserScan on an even
grid of angles. The stamps are those of the scans, in the frame "laser"; messages of them are in the log at these times. Points have PCL's
layout: x y z intensity time as float32, ring as uint16, then the further columns; a column that the sensor lacks is no field. What no
message can say, the units of further columns, stands in the log's metadata; ROS 1 bags have none. Where they are asked for, /packets has
what the sensor sent, so that the log can be read again as a source: each packet with the time of its arrival.
"""

from __future__ import annotations

import heapq
import tempfile
from collections.abc import Iterable, Iterator
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import UsageError, library
from lidarspec.formats.writing import picture
from lidarspec.points.cloud import PointCloud
from lidarspec.scans.scans import LaserScan, Scan
from lidarspec.transports.protocol import Chunk, Format

#: a packet as it was received, which `transports.bags` reads again: ROS has no message for it.
PACKET, LAYOUT = "lidarspec_msgs/msg/LidarPacket", "builtin_interfaces/Time stamp\nuint8[] data"
#: where messages are published, and the kinds of them.
POINTS, SCAN = "/points", "/scan"
TOPICS = {"sensor_msgs/msg/PointCloud2": POINTS, "sensor_msgs/msg/LaserScan": SCAN, PACKET: "/packets"}
#: the numbers by which PointField names types; anything else is written as float64.
FIELD_TYPES = {"i1": 1, "u1": 2, "b1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
#: bytes of a chunk of an MCAP file, which a reader holds at once: a scan or some.
CHUNK = 1 << 20
_SECOND = 1_000_000_000


class Message(NamedTuple):
    """A message as it stands in a log: its type, its time in ns, its bytes."""

    kind: str
    at: int
    data: memoryview


class Messages:
    """The messages of scans.

    Args:
        release: whose definitions they follow, as rosbags names them: "ROS1_NOETIC".

    Attributes:
        types: the definitions.
        units: of the further columns, by name, as far as scans have come.
    """

    def __init__(self, release: str) -> None:
        typesys = library("rosbags.typesys", "ros")
        self.types = typesys.get_typestore(typesys.Stores[release])
        self.types.register(typesys.get_types_from_msg(LAYOUT, PACKET))
        self.units: dict[str, str] = {}
        self._serialized = self.types.serialize_ros1 if release.startswith("ROS1") else self.types.serialize_cdr
        self._planes = Planes()

    def of(self, scans: Iterable[Scan], packets: Iterable[Chunk] = (), *, every_point: bool) -> Iterator[Message]:
        """The messages of each scan and packet, by their times as far as both are in order.

        Raises:
            UsageError: for a stamp that no message can hold.
        """
        return heapq.merge(self._of_scans(scans, every_point=every_point), self._of_packets(packets), key=attrgetter("at"))

    def _of_packets(self, packets: Iterable[Chunk]) -> Iterator[Message]:
        kind = self.types.types[PACKET]
        for packet in packets:
            at = packet.at or 0
            message = kind(stamp=self._time(at), data=np.frombuffer(packet.data, np.uint8))
            yield Message(PACKET, at, self._serialized(message, PACKET))

    def _of_scans(self, scans: Iterable[Scan], *, every_point: bool) -> Iterator[Message]:
        for number, scan in enumerate(scans):
            self.units |= {name: unit for name, unit in scan.points.units.items() if unit}
            header = self._header(number, scan.stamp_ns, scan.frame_id)
            for message in [self._cloud(scan.points, header, every_point=every_point), *self._laserscan(scan, header)]:
                kind = message.__msgtype__
                yield Message(kind, scan.stamp_ns, self._serialized(message, kind))

    def _header(self, number: int, stamp_ns: int, frame_id: str) -> Any:
        kind = self.types.types["std_msgs/msg/Header"]
        counted = {"seq": number} if "seq" in kind.__dataclass_fields__ else {}
        return kind(**counted, stamp=self._time(stamp_ns), frame_id=frame_id)

    def _time(self, at: int) -> Any:
        if not 0 <= at < _SECOND << 31:
            raise UsageError(f"a scan or packet at {at} ns: stamps of ROS hold the years 1970 to 2038")
        return self.types.types["builtin_interfaces/msg/Time"](*divmod(at, _SECOND))

    def _cloud(self, cloud: PointCloud, header: Any, *, every_point: bool) -> Any:
        """Organised points have a row for each row of the sensor, several returns side by side; of others, and valid ones, there is one."""
        points = records(cloud, every_point=every_point)
        if every_point and cloud.shape and len(cloud):
            points = picture(points, cloud)
        height, width = np.atleast_2d(points).shape
        field = self.types.types["sensor_msgs/msg/PointField"]
        return self.types.types["sensor_msgs/msg/PointCloud2"](
            header=header,
            height=height,
            width=width,
            fields=[field(name, offset, FIELD_TYPES[kind], 1) for name, offset, kind in fields_of(cloud, points)],
            is_bigendian=False,
            point_step=points.itemsize,
            row_step=points.itemsize * width,
            data=np.ascontiguousarray(points).view(np.uint8).reshape(-1),
            is_dense=not every_point or bool(cloud.valid.all()),
        )

    def _laserscan(self, scan: Scan, header: Any) -> Iterator[Any]:
        planar = self._planes.scan(scan)
        if planar is not None:
            kind = self.types.types["sensor_msgs/msg/LaserScan"]
            values = {name: getattr(planar, name) for name in kind.__dataclass_fields__ if hasattr(planar, name)}
            if scan.points.intensity is None:
                values["intensities"] = np.empty(0, np.float32)
            yield kind(**values, header=header)


class Planes:
    """Whether scans are of a sensor of one plane, which the first valid points show."""

    def __init__(self) -> None:
        self._is_flat: bool | None = None

    def scan(self, scan: Scan) -> LaserScan | None:
        """The scan on an even grid of angles; None of other sensors."""
        if self._is_flat is None and (valid := scan.points.valid).any():
            self._is_flat = not scan.points.elevation[valid].any()
        return scan.to_laserscan() if self._is_flat else None


def fields_of(cloud: PointCloud, points: NDArray[Any]) -> list[tuple[str, int, str]]:
    """Name, offset and type ("f4") of each field of the records of a cloud; a column that it lacks is none."""
    lacking = {name for name in ("intensity", "ring", "time") if not cloud.shows(name) or getattr(cloud, name) is None}
    return [(name, place[1], place[0].str[1:]) for name, place in (points.dtype.fields or {}).items() if name not in lacking]


def records(cloud: PointCloud, *, every_point: bool) -> NDArray[Any]:
    """The points that are written, in PCL's layout, all columns of types that messages have."""
    points = cloud.to_structured()
    if not every_point:
        points = np.compress(cloud.valid, points)  # ten times as quick as an index
    kinds = {name: points.dtype[name] for name in points.dtype.names or ()}
    if all(kind.str[1:] in FIELD_TYPES for kind in kinds.values()):
        return points
    known = [(name, kind if kind.str[1:] in FIELD_TYPES else np.dtype(np.float64)) for name, kind in kinds.items()]
    return points.astype(np.dtype(known, align=True))


def write_mcap(path: Path, scans: Iterable[Scan], packets: Iterable[Chunk] = (), *, every_point: bool) -> None:
    """Write an MCAP file as ROS 2 records it, which Foxglove, `ros2 bag` and PlotJuggler read."""
    mcap = library("mcap.writer", "ros")
    messages, channels = Messages("ROS2_HUMBLE"), dict[str, int]()
    with path.open("wb") as file:
        log = mcap.Writer(file, chunk_size=CHUNK, compression=mcap.CompressionType.NONE)
        log.start(profile="ros2", library="lidarspec")
        for kind, at, data in messages.of(scans, packets, every_point=every_point):
            if kind not in channels:
                text, _ = messages.types.generate_msgdef(kind, ros_version=2)
                channels[kind] = log.register_channel(TOPICS[kind], "cdr", log.register_schema(kind, "ros2msg", text.encode()))
            log.add_message(channels[kind], log_time=at, publish_time=at, data=data)
        if messages.units:
            log.add_metadata("units", messages.units)
        log.finish()


def write_ros1(path: Path, scans: Iterable[Scan], packets: Iterable[Chunk] = (), *, every_point: bool) -> None:
    """Write a bag as `rosbag record` does."""
    messages = Messages("ROS1_NOETIC")
    _record(library("rosbags.rosbag1", "ros").Writer(path), messages, messages.of(scans, packets, every_point=every_point))


def write_ros2(path: Path, scans: Iterable[Scan], packets: Iterable[Chunk] = (), *, storage: str, every_point: bool) -> None:
    """Write a ROS 2 bag of metadata version 8, which releases from Foxy on read.

    Args:
        storage: "mcap" for a folder with metadata.yaml and an MCAP file; "sqlite3" for a database file alone, as `ros2 bag` reads it, too.
    """
    import sqlite3  # which the whole module would otherwise wait for

    rosbag2 = library("rosbags.rosbag2", "ros")
    with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
        bag = Path(folder) / "scans"
        log = rosbag2.Writer(bag, version=8, storage_plugin=rosbag2.StoragePlugin[storage.upper()])
        try:
            messages = Messages("ROS2_HUMBLE")
            _record(log, messages, messages.of(scans, packets, every_point=every_point))
        except sqlite3.Error as error:
            raise OSError(str(error)) from None
        (bag if storage == "mcap" else bag / "scans.db3").rename(path)


def _record(log: Any, messages: Messages, every: Iterable[Message]) -> None:
    """Write messages by a writer of rosbags."""
    connections = dict[str, Any]()
    with log:
        for kind, at, data in every:
            if kind not in connections:
                connections[kind] = log.add_connection(TOPICS[kind], kind, typestore=messages.types)
            log.write(connections[kind], at, data)
        for name, unit in messages.units.items() if hasattr(log, "set_custom_data") else ():
            log.set_custom_data(f"unit of {name}", unit)


#: what messages have a place for.
_HOLDS = ("scans", "organized", "beams", "frame-id", "packets")
MCAP = Format(".mcap", "an MCAP file with ROS 2 messages", write_mcap, _HOLDS)
BAG = Format(".bag", "a ROS 1 bag", write_ros1, _HOLDS)
ROSBAG2 = Format(".rosbag2", "a ROS 2 bag: a folder with an MCAP file", partial(write_ros2, storage="mcap"), _HOLDS)
DB3 = Format(".db3", "a ROS 2 bag: an SQLite file", partial(write_ros2, storage="sqlite3"), _HOLDS)
