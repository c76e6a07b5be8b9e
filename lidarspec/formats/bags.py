"""Write robotics logs: ROS messages in an MCAP file, ROS 1 bag or ROS 2 bag.

The topic /points has each scan as sensor_msgs/PointCloud2. For planar sensors, /scan has each scan
as sensor_msgs/LaserScan. On request, /packets has the raw packets.
"""

from __future__ import annotations

import heapq
import tempfile
from collections.abc import Iterable, Iterator
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from lidarspec.formats.messages import CLOUD, SCAN, RosMessage, RosMessages
from lidarspec.optional_libraries import import_library
from lidarspec.scans.beams import PlanarScans
from lidarspec.scans.scan import Scan
from lidarspec.transports.protocol import Chunk, Format
from lidarspec.transports.robotics_logs import RAW

#: The topic of each message type.
TOPICS = {CLOUD: "/points", SCAN: "/scan", RAW: "/packets"}
#: The size of a chunk of an MCAP file. Readers load a whole chunk, so it contains about one scan.
CHUNK_BYTES = 1 << 20


class LogMessages:
    """The messages of one log, which are made from scans and raw packets.

    Args:
        release: the ROS release of the message definitions, e.g. "ROS1_NOETIC".

    Attributes:
        units: the units of the additional columns of the scans so far, by name.
    """

    def __init__(self, release: str) -> None:
        self._messages = RosMessages(release)
        self._planes = PlanarScans()
        self.types = self._messages.types
        self.units = dict[str, str]()

    def iter_messages(
        self, scans: Iterable[Scan], packets: Iterable[Chunk], *, every_point: bool
    ) -> Iterator[RosMessage]:
        """Yield the messages of scans and packets in the order of time.

        If the scans or the packets are not in this order, neither are the messages.

        Raises:
            UsageError: for a stamp that no message can contain.
        """
        return heapq.merge(
            self._iter_scan_messages(scans, every_point=every_point),
            map(self._messages.raw, packets),
            key=attrgetter("at"),
        )

    def _iter_scan_messages(
        self, scans: Iterable[Scan], *, every_point: bool
    ) -> Iterator[RosMessage]:
        for number, scan in enumerate(scans):
            self.units |= {name: unit for name, unit in scan.points.units.items() if unit}
            yield self._messages.cloud(scan, scan.stamp_ns, every_point=every_point, number=number)
            if (planar := self._planes.project(scan)) is not None:
                yield self._messages.laserscan(
                    scan, planar, planar.stamp_ns, number=number
                )._replace(at=scan.stamp_ns)


def write_mcap(
    path: Path, scans: Iterable[Scan], packets: Iterable[Chunk] = (), *, every_point: bool
) -> None:
    """Write an MCAP file with ROS 2 messages."""
    mcap = import_library("mcap.writer", "ros")
    log_messages = LogMessages("ROS2_HUMBLE")
    channels = dict[str, int]()
    with path.open("wb") as file:
        log = mcap.Writer(file, chunk_size=CHUNK_BYTES, compression=mcap.CompressionType.NONE)
        log.start(profile="ros2", library="lidarspec")
        for kind, at, data in log_messages.iter_messages(scans, packets, every_point=every_point):
            if kind not in channels:
                text, _ = log_messages.types.generate_msgdef(kind, ros_version=2)
                channels[kind] = log.register_channel(
                    TOPICS[kind], "cdr", log.register_schema(kind, "ros2msg", text.encode())
                )
            log.add_message(channels[kind], log_time=at, publish_time=at, data=data)
        if log_messages.units:
            log.add_metadata("units", log_messages.units)
        log.finish()


def write_ros1(
    path: Path, scans: Iterable[Scan], packets: Iterable[Chunk] = (), *, every_point: bool
) -> None:
    """Write a ROS 1 bag, as `rosbag record` does."""
    log_messages = LogMessages("ROS1_NOETIC")
    _record(
        import_library("rosbags.rosbag1", "ros").Writer(path),
        log_messages,
        log_messages.iter_messages(scans, packets, every_point=every_point),
    )


def write_ros2(
    path: Path,
    scans: Iterable[Scan],
    packets: Iterable[Chunk] = (),
    *,
    storage: str,
    every_point: bool,
) -> None:
    """Write a ROS 2 bag of metadata version 8, which releases since Foxy can read.

    Args:
        path: the folder or file.
        storage: "mcap" writes a folder with metadata.yaml and an MCAP file. "sqlite3" writes a
            single database file, which `ros2 bag` can also read.
    """
    import sqlite3  # only needed here

    rosbag2 = import_library("rosbags.rosbag2", "ros")
    with tempfile.TemporaryDirectory(prefix=".", dir=path.parent) as folder:
        bag = Path(folder) / "scans"
        log = rosbag2.Writer(bag, version=8, storage_plugin=rosbag2.StoragePlugin[storage.upper()])
        try:
            log_messages = LogMessages("ROS2_HUMBLE")
            _record(
                log,
                log_messages,
                log_messages.iter_messages(scans, packets, every_point=every_point),
            )
        except sqlite3.Error as error:
            raise OSError(str(error)) from None
        (bag if storage == "mcap" else bag / "scans.db3").rename(path)


def _record(log: Any, log_messages: LogMessages, messages: Iterable[RosMessage]) -> None:
    """Write messages to a log.

    Args:
        log: a log writer of the library rosbags.
    """
    connections = dict[str, Any]()
    with log:
        for kind, at, data in messages:
            if kind not in connections:
                connections[kind] = log.add_connection(
                    TOPICS[kind], kind, typestore=log_messages.types
                )
            log.write(connections[kind], at, data)
        for name, unit in log_messages.units.items() if hasattr(log, "set_custom_data") else ():
            log.set_custom_data(f"unit of {name}", unit)


#: The features of these formats.
_HOLDS = ("scans", "organized", "beams", "frame-id", "packets")
MCAP = Format(".mcap", "an MCAP file with ROS 2 messages", write_mcap, _HOLDS)
BAG = Format(".bag", "a ROS 1 bag", write_ros1, _HOLDS)
ROSBAG2 = Format(
    ".rosbag2",
    "a ROS 2 bag: a folder with an MCAP file",
    partial(write_ros2, storage="mcap"),
    _HOLDS,
)
DB3 = Format(".db3", "a ROS 2 bag: an SQLite file", partial(write_ros2, storage="sqlite3"), _HOLDS)
