"""Read packets from robotics logs: ROS 1 bags, ROS 2 bags and MCAP files.

A driver publishes a packet, or a list of the packets of a scan, as a message. This module assumes
that a message type contains packets if the type has a field `packets`, or if the name of the type
contains "packet". The bytes are in the field `data` or `buf` of a packet. A packet may also have
the fields `size` (number of bytes) and `stamp`.

Some logs contain no definitions of their messages. Their messages are read with the definition in
`FALLBACK_DEFINITIONS` that matches the length of the message.

lidarspec writes packets as std_msgs/UInt8MultiArray, because every ROS release has this message
type. The first `data_offset` bytes of the data are the arrival time. The label of the array's
dimension is `DATAGRAM` or `STREAM`.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from lidarspec.errors import LidarSpecError, SourceError
from lidarspec.optional_libraries import import_library
from lidarspec.transports.protocol import Chunk, Transport

_RULE = "=" * 80
_LIST = f"std_msgs/Header header\nPacket[] packets\n{_RULE}\nMSG: {{package}}/Packet\n"
#: message definitions to try if a log has none. Definitions with lengths come first, because they
#: rarely match by coincidence.
FALLBACK_DEFINITIONS = (
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[] data",
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[] data\nuint32 size",
    f"{_LIST}uint8[] data\nuint32 size",
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size",
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[1206] data",
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[1248] data",
    "std_msgs/Header header\nuint8 is_info\nuint8 is_first\nuint8[] data",
    "uint8[] buf",
)
#: names of the field with the bytes of a packet.
DATA_FIELDS = ("data", "buf")
#: maximum number of topics in a warning.
MAX_LISTED_TOPICS = 6
#: message type of packets that lidarspec writes. The next constants are the encoding of the arrival
#: time (int64, ns), and the labels of the array's dimension for datagrams and for a byte stream.
RAW = "std_msgs/msg/UInt8MultiArray"
STAMP = struct.Struct("<q")
DATAGRAM = "datagram"
STREAM = "stream"


class LogKind(NamedTuple):
    """A kind of log, such as a ROS 1 bag.

    Attributes:
        form: the serialization format of the messages, "cdr" or "ros1".
    """

    description: str
    module: str
    reader: str
    form: str = "cdr"


#: first bytes of a file -> kind of log.
LOGS = {
    b"#ROSBAG V": LogKind("a ROS 1 bag", "rosbags.rosbag1", "Reader", "ros1"),
    b"\x89MCAP0\r\n": LogKind(
        "an MCAP file (ROS 2 bag)", "rosbags.rosbag2.storage_mcap", "McapReader"
    ),
    b"SQLite format 3\0": LogKind(
        "an SQLite database (ROS 2 bag)", "rosbags.rosbag2.storage_sqlite3", "Sqlite3Reader"
    ),
}
#: kind of log that is a folder with metadata.yaml.
FOLDER = LogKind("a ROS 2 bag", "rosbags.rosbag2", "Reader")


def find_log_kind(path: str, head: bytes = b"") -> LogKind | None:
    """Return the kind of a log; None if the file or folder is not a log."""
    if os.path.isdir(path):
        if os.path.isfile(os.path.join(path, "metadata.yaml")):
            return FOLDER
        return None
    return next((log for beginning, log in LOGS.items() if head.startswith(beginning)), None)


class BagTransport(Transport):
    """Reads the packets of a robotics log, in the order of its messages.

    The time of a packet is the first of these times that exists: the stamp of the packet, the stamp
    of its message, the time of logging. If several namespaces have packets, the `sender` of each
    chunk is its namespace.

    Args:
        sender: yield only the packets of this namespace or topic; None for all.
    """

    datagrams = True

    def __init__(self, path: str, log: LogKind, *, sender: str | None = None) -> None:
        self._path = path
        self._kind = log
        self.warnings: list[str] = []
        reader = getattr(import_library(log.module, "ros"), log.reader)
        with self._convert_failures(), ExitStack() as undo:
            self._log = reader(Path(path))
            self._log.open()
            undo.callback(self._log.close)
            self._type_stores = {
                link.id: stores
                for link in self._log.connections
                if (stores := _make_type_stores(link))
            }
            with_packets = [link for link in self._log.connections if link.id in self._type_stores]
            self._links = [
                link
                for link in with_packets
                if sender in (None, link.topic, _get_namespace(link.topic))
            ]
            self.datagrams = not any(self._is_stream(link) for link in self._links)
            self.foreign = sum(link.msgcount for link in with_packets) - sum(
                link.msgcount for link in self._links
            )
            undo.pop_all()
        if not self._links:
            topics = (
                "; ".join(
                    f"the topic {link.topic} has the type {link.msgtype}"
                    for link in (with_packets or self._log.connections)[:MAX_LISTED_TOPICS]
                )
                or "the log is empty"
            )
            self.warnings.append(
                f"{path} is {log.description} without packets{f' of {sender}' if sender else ''}:"
                f" {topics}"
            )

    def chunks(self) -> Iterator[Chunk]:
        namespaces = {_get_namespace(link.topic) for link in self._links}
        with self._convert_failures():
            for link, log_time_ns, raw in self._log.messages(self._links) if self._links else ():
                if len(namespaces) > 1:
                    sender = (_get_namespace(link.topic), 0)
                else:
                    sender = None
                message = self._deserialize(link, raw)
                if link.msgtype == RAW:
                    yield read_chunk(message)
                    continue
                message_ns = _read_stamp(getattr(message, "header", None)) or log_time_ns
                for packet in getattr(message, "packets", [message]) if message is not None else ():
                    data = next(
                        getattr(packet, name) for name in DATA_FIELDS if hasattr(packet, name)
                    )
                    yield Chunk(
                        data[: getattr(packet, "size", None)].tobytes(),
                        _read_stamp(packet) or message_ns,
                        sender,
                    )

    def _is_stream(self, link: Any) -> bool:
        """Return whether the packets of a topic are portions of a byte stream."""
        if link.msgtype != RAW:
            return False
        first = next(
            (self._deserialize(link, raw) for _, _, raw in self._log.messages([link])), None
        )
        return first is not None and first.layout.dim[0].label == STREAM

    def write(self, data: bytes) -> None:
        raise SourceError(f"{self._path} is {self._kind.description}, so nothing can be sent to it")

    def close(self) -> None:
        self._log.close()

    def _deserialize(self, link: Any, raw: bytes) -> Any:
        """Return a message; None if no definition fits it."""
        stores = self._type_stores[link.id]
        for store in stores:
            try:
                message = getattr(store, f"deserialize_{self._kind.form}")(raw, link.msgtype)
            except import_library("rosbags.serde", "ros").SerdeError:
                if len(stores) == 1:
                    raise
                continue
            # An empty list of packets fits every definition.
            if not hasattr(message, "packets") or len(message.packets):
                self._type_stores[link.id] = [store]
            return message
        self._type_stores[link.id] = []
        return None

    @contextmanager
    def _convert_failures(self) -> Iterator[None]:
        """Convert all exceptions to SourceError: a damaged file can cause any exception."""
        try:
            yield
        except LidarSpecError:
            raise
        except Exception as error:
            raise SourceError(
                f"{self._path} is {self._kind.description}, but cannot be read:"
                f" {error or type(error).__name__}"
            ) from error


def read_chunk(message: Any) -> Chunk:
    """Return the chunk in a message that lidarspec wrote.

    The chunk is a datagram or a portion of a byte stream, with its arrival time.

    Args:
        message: a std_msgs/UInt8MultiArray of rosbags or rclpy.
    """
    data = bytes(message.data)
    padding = message.layout.data_offset
    return Chunk(data[padding:], STAMP.unpack_from(data)[0] if padding == STAMP.size else None)


def _get_namespace(topic: str) -> str:
    return topic.rpartition("/")[0] or "/"


def _read_stamp(stamped: Any) -> int:
    """Return the stamp of a message in ns; 0 if it has none."""
    stamp = getattr(stamped, "stamp", None)
    return 0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec


def _make_type_stores(link: Any) -> list[Any]:
    """Return a type store for each possible definition of a connection's messages."""
    typesys = import_library("rosbags.typesys", "ros")
    if link.msgtype == RAW and "packets" in link.topic:
        return [typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)]
    is_defined = link.msgdef.format.name == "MSG"
    # Definitions of other messages are not parsed, because rosbags may not support them.
    if is_defined and "packet" not in (link.msgtype + link.msgdef.data).lower():
        return []
    package = link.msgtype.partition("/")[0]
    stores = []
    for text in (link.msgdef.data,) if is_defined else FALLBACK_DEFINITIONS:
        store = typesys.get_typestore(
            typesys.Stores.EMPTY if is_defined else typesys.Stores.ROS2_HUMBLE
        )
        if link.msgtype in store.types:
            break
        store.register(
            typesys.get_types_from_msg(
                text if is_defined else text.format(package=package), link.msgtype
            )
        )
        if _has_packets(store.fielddefs, link.msgtype):
            stores.append(store)
    return stores


def _has_packets(types: Mapping[str, Any], name: str) -> bool:
    """Return whether messages of a type contain packets."""
    fields = dict(types[name][1])
    packet_type: Any = None
    if "packets" in fields:
        packet_type = _find_element_type(fields.get("packets"))
    elif "packet" in name.lower():
        packet_type = name
    packet_fields = dict(types[packet_type][1]) if packet_type in types else {}
    return any(
        _find_element_type(packet_fields.get(field_name)) == ("uint8", 0)
        for field_name in DATA_FIELDS
    )


def _find_element_type(field: Any) -> Any:
    """Return the element type of an array field; None for other fields."""
    if field is not None and field[0].name in ("ARRAY", "SEQUENCE"):
        return field[1][0][1]
    return None
