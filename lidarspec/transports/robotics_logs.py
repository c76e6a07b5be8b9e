"""Read packets from robotics logs: ROS 1 bags, ROS 2 bags and MCAP files.

A driver publishes a packet as a message, or the packets of a scan as a list with a time each.
Messages are recognised by content, not by name: a type with a list of `packets`, or a type with
"packet" in its name. Each packet has its bytes as `data` or `buf`, of which the first `size` are
used if there is such a field, and a `stamp`. Most logs contain the definitions of their messages.
For those that do not, such as ROS 2 bags in SQLite of releases before Iron, the definition in
`UNTOLD` that fills a message to its end is used.

Packets that lidarspec or its ROS 2 node writes are std_msgs/UInt8MultiArray, the only message of
every ROS release that contains plain bytes. The padding before the bytes, of `data_offset` bytes,
is the arrival time; the label is `DATAGRAM` or `STREAM`.
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
#: definitions to try if a log has none; those with lengths come first, because they rarely fit by
#: chance.
UNTOLD = (
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[] data",
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[] data\nuint32 size",
    f"{_LIST}uint8[] data\nuint32 size",
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[1500] data\nuint32 size",
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[1206] data",
    f"{_LIST}builtin_interfaces/Time stamp\nuint8[1248] data",
    "std_msgs/Header header\nuint8 is_info\nuint8 is_first\nuint8[] data",
    "uint8[] buf",
)
#: fields with the bytes of a packet.
BYTES = ("data", "buf")
#: maximum number of topics in a message.
NAMED = 6
#: packets written by lidarspec: the type, the arrival time as int64 ns, and the labels of the
#: dimension for datagrams and for a byte stream.
RAW = "std_msgs/msg/UInt8MultiArray"
STAMP = struct.Struct("<q")
DATAGRAM = "datagram"
STREAM = "stream"


class LogKind(NamedTuple):
    """A kind of log.

    Attributes:
        what: its name in messages.
        module, reader: the class of rosbags that reads it.
        form: the serialization of its messages.
    """

    what: str
    module: str
    reader: str
    form: str = "cdr"


#: first bytes -> kind of log; a log of several files is a folder with metadata.yaml.
LOGS = {
    b"#ROSBAG V": LogKind("a ROS 1 bag", "rosbags.rosbag1", "Reader", "ros1"),
    b"\x89MCAP0\r\n": LogKind(
        "an MCAP file, as ROS 2 bags are", "rosbags.rosbag2.storage_mcap", "McapReader"
    ),
    b"SQLite format 3\0": LogKind(
        "an SQLite database, as ROS 2 bags are", "rosbags.rosbag2.storage_sqlite3", "Sqlite3Reader"
    ),
}
FOLDER = LogKind("a ROS 2 bag", "rosbags.rosbag2", "Reader")


def find_log_kind(path: str, head: bytes = b"") -> LogKind | None:
    """Return the kind of a log by its first bytes or its folder, None for other files."""
    if os.path.isdir(path):
        if os.path.isfile(os.path.join(path, "metadata.yaml")):
            return FOLDER
        return None
    return next((log for beginning, log in LOGS.items() if head.startswith(beginning)), None)


class BagTransport(Transport):
    """The packets of a robotics log, in the order of its messages.

    The time of a packet is its own stamp, else that of its message, else that of the log. The
    topics of one namespace belong to one sensor. If several namespaces have packets, the namespace
    is the sender.

    Args:
        sender: yield only the packets of this namespace or topic.
    """

    datagrams = True

    def __init__(self, path: str, log: LogKind, *, sender: str | None = None) -> None:
        self._path = path
        self._kind = log
        self.warnings: list[str] = []
        reader = getattr(import_library(log.module, "ros"), log.reader)
        with self._failures(), ExitStack() as undo:
            self._log = reader(Path(path))
            self._log.open()
            undo.callback(self._log.close)
            self._layouts = {
                link.id: layouts for link in self._log.connections if (layouts := _layouts(link))
            }
            carrying = [link for link in self._log.connections if link.id in self._layouts]
            self._links = [
                link for link in carrying if sender in (None, link.topic, _namespace(link.topic))
            ]
            self.datagrams = not any(self._streams(link) for link in self._links)
            self.foreign = sum(link.msgcount for link in carrying) - sum(
                link.msgcount for link in self._links
            )
            undo.pop_all()
        if not self._links:
            named = (
                "; ".join(
                    f"{link.topic} has {link.msgtype}"
                    for link in (carrying or self._log.connections)[:NAMED]
                )
                or "it is empty"
            )
            self.warnings.append(
                f"{path} is {log.what} without packets{f' of {sender}' if sender else ''}: {named}"
            )

    def chunks(self) -> Iterator[Chunk]:
        namespaces = {_namespace(link.topic) for link in self._links}
        with self._failures():
            for link, at, raw in self._log.messages(self._links) if self._links else ():
                if len(namespaces) > 1:
                    sender = (_namespace(link.topic), 0)
                else:
                    sender = None
                message = self._message(link, raw)
                if link.msgtype == RAW:
                    yield raw_chunk(message)
                    continue
                message_ns = _ns(getattr(message, "header", None)) or at
                for packet in getattr(message, "packets", [message]) if message is not None else ():
                    data = next(getattr(packet, name) for name in BYTES if hasattr(packet, name))
                    yield Chunk(
                        data[: getattr(packet, "size", None)].tobytes(),
                        _ns(packet) or message_ns,
                        sender,
                    )

    def _streams(self, link: Any) -> bool:
        """Return whether the packets of a connection are pieces of a byte stream."""
        if link.msgtype != RAW:
            return False
        first = next((self._message(link, raw) for _, _, raw in self._log.messages([link])), None)
        return first is not None and first.layout.dim[0].label == STREAM

    def write(self, data: bytes) -> None:
        raise SourceError(f"{self._path} is {self._kind.what}: nothing can be sent to it")

    def close(self) -> None:
        self._log.close()

    def _message(self, link: Any, raw: bytes) -> Any:
        """Return a message by the first definition that fits, None if none fits.

        The following messages use the same definition.
        """
        layouts = self._layouts[link.id]
        for layout in layouts:
            try:
                message = getattr(layout, f"deserialize_{self._kind.form}")(raw, link.msgtype)
            except import_library("rosbags.serde", "ros").SerdeError:
                if len(layouts) == 1:
                    raise
                continue
            if len(getattr(message, "packets", "one")):
                self._layouts[link.id] = [layout]
            return message
        self._layouts[link.id] = []
        return None

    @contextmanager
    def _failures(self) -> Iterator[None]:
        """Raise SourceError for every exception that reading a damaged file causes."""
        try:
            yield
        except LidarSpecError:
            raise
        except Exception as error:
            raise SourceError(
                f"{self._path} is {self._kind.what}, and is not read:"
                f" {error or type(error).__name__}"
            ) from error


def raw_chunk(message: Any) -> Chunk:
    """Return the packet in a message of lidarspec, as rosbags or rclpy return it."""
    data = bytes(message.data)
    padding = message.layout.data_offset
    return Chunk(data[padding:], STAMP.unpack_from(data)[0] if padding == STAMP.size else None)


def _namespace(topic: str) -> str:
    return topic.rpartition("/")[0] or "/"


def _ns(stamped: Any) -> int:
    """Return the stamp of a message in ns, 0 if it has none."""
    stamp = getattr(stamped, "stamp", None)
    return 0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec


def _layouts(link: Any) -> list[Any]:
    """Return type stores with the possible definitions of a connection's messages.

    Returns:
        An empty list if the messages contain no packets.
    """
    typesys = import_library("rosbags.typesys", "ros")
    if link.msgtype == RAW and "packets" in link.topic:
        return [typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)]
    is_told = link.msgdef.format.name == "MSG"
    if (
        is_told and "packet" not in (link.msgtype + link.msgdef.data).lower()
    ):  # do not parse the definitions of other messages, which rosbags may not support
        return []
    package = link.msgtype.partition("/")[0]
    stores = []
    for text in (link.msgdef.data,) if is_told else UNTOLD:
        store = typesys.get_typestore(
            typesys.Stores.EMPTY if is_told else typesys.Stores.ROS2_HUMBLE
        )
        if link.msgtype in store.types:
            break
        store.register(
            typesys.get_types_from_msg(
                text if is_told else text.format(package=package), link.msgtype
            )
        )
        stores += [store] if _carries(store.fielddefs, link.msgtype) else []
    return stores


def _carries(types: Mapping[str, Any], name: str) -> bool:
    """Return whether messages of a type contain packets."""
    fields = dict(types[name][1])
    element: Any = (
        _element(fields.get("packets"))
        if "packets" in fields
        else name
        if "packet" in name.lower()
        else None
    )
    held = dict(types[element][1]) if element in types else {}
    return any(_element(held.get(name)) == ("uint8", 0) for name in BYTES)


def _element(field: Any) -> Any:
    """Return the element of an array field, None for other fields.

    Returns:
        The name of a type; or for numbers a tuple of their type and the length.
    """
    if field is not None and field[0].name in ("ARRAY", "SEQUENCE"):
        return field[1][0][1]
    return None
