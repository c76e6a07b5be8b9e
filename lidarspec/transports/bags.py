"""Robotics logs as transports: the packets that drivers record, in ROS 1 bags, ROS 2 bags and MCAP
files.

A driver publishes a packet as a message, or those of a scan as a list with the time of each.
Messages are known by what they hold, whoever named them: a type with a list of `packets`, or one
that is itself called a packet; and in each packet its bytes as `data` or `buf`, of which the first
`size` count where that is a field, and its `stamp`. Logs say how their messages are laid out; of
those that do not, as ROS 2 bags in SQLite of releases before Iron, the layout is the one of
`UNTOLD` that fills a message to its end.

Packets that lidarspec writes into logs, or its ROS 2 node publishes, are std_msgs/UInt8MultiArray,
the one message of every ROS that holds bytes and says nothing of them. The padding before the
bytes, as long as `data_offset` says, is the time of the arrival; the label says whether they are a
datagram.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from lidarspec.errors import LidarSpecError, SourceError
from lidarspec.libraries import import_library
from lidarspec.transports.protocol import Chunk, Transport

_RULE = "=" * 80
_LIST = f"std_msgs/Header header\nPacket[] packets\n{_RULE}\nMSG: {{package}}/Packet\n"
#: layouts of messages that a log does not tell; those with lengths, which are seldom right by
#: chance, come first.
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
#: fields that hold the bytes of a packet.
BYTES = ("data", "buf")
#: topics that a message names.
NAMED = 6
#: what lidarspec writes: the type, the time of arrival, int64 ns, and the label of the dimension of
#: datagrams and of a byte stream.
RAW = "std_msgs/msg/UInt8MultiArray"
STAMP = struct.Struct("<q")
DATAGRAM = "datagram"
STREAM = "stream"


class Log(NamedTuple):
    """A kind of log: what it is, the reader that rosbags has for it, and how messages are
    serialized.
    """

    what: str
    module: str
    reader: str
    form: str = "cdr"


#: logs by how they begin; those in several files are a folder with metadata.yaml.
LOGS = {
    b"#ROSBAG V": Log("a ROS 1 bag", "rosbags.rosbag1", "Reader", "ros1"),
    b"\x89MCAP0\r\n": Log(
        "an MCAP file, as ROS 2 bags are", "rosbags.rosbag2.storage_mcap", "McapReader"
    ),
    b"SQLite format 3\0": Log(
        "an SQLite database, as ROS 2 bags are", "rosbags.rosbag2.storage_sqlite3", "Sqlite3Reader"
    ),
}
FOLDER = Log("a ROS 2 bag", "rosbags.rosbag2", "Reader")


def log_of(path: str, head: bytes = b"") -> Log | None:
    """What kind of log a file is by its first bytes, or a folder by what is in it; None where it is
    none.
    """
    if os.path.isdir(path):
        if os.path.isfile(os.path.join(path, "metadata.yaml")):
            return FOLDER
        return None
    return next((log for beginning, log in LOGS.items() if head.startswith(beginning)), None)


class BagTransport(Transport):
    """The packets of a robotics log, in the order in which it has their messages.

    Each comes at its own stamp, else that of its message, else at the time of the log. The topics
    of a namespace are those of one sensor, its data and its status; where packets come from several
    namespaces, these are their senders.

    Args:
        sender: only the packets of this namespace, or this topic.
    """

    datagrams = True

    def __init__(self, path: str, log: Log, *, sender: str | None = None) -> None:
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
                heard = _ns(getattr(message, "header", None)) or at
                for packet in getattr(message, "packets", [message]) if message is not None else ():
                    data = next(getattr(packet, name) for name in BYTES if hasattr(packet, name))
                    yield Chunk(
                        data[: getattr(packet, "size", None)].tobytes(),
                        _ns(packet) or heard,
                        sender,
                    )

    def _streams(self, link: Any) -> bool:
        """Whether the packets of a connection are pieces of a byte stream."""
        if link.msgtype != RAW:
            return False
        first = next((self._message(link, raw) for _, _, raw in self._log.messages([link])), None)
        return first is not None and first.layout.dim[0].label == STREAM

    def write(self, data: bytes) -> None:
        raise SourceError(f"{self._path} is {self._kind.what}: nothing can be sent to it")

    def close(self) -> None:
        self._log.close()

    def _message(self, link: Any, raw: bytes) -> Any:
        """A message by the first layout that it fills, which is that of those behind it; None where
        there is none.
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
        """Whatever rosbags, and the libraries that it asks, raise of a damaged file."""
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
    """A packet out of a message of the node, as rosbags or rclpy have it."""
    data = bytes(message.data)
    padding = message.layout.data_offset
    return Chunk(data[padding:], STAMP.unpack_from(data)[0] if padding == STAMP.size else None)


def _namespace(topic: str) -> str:
    return topic.rpartition("/")[0] or "/"


def _ns(stamped: Any) -> int:
    """The stamp of a message, ns; 0 where it has none."""
    stamp = getattr(stamped, "stamp", None)
    return 0 if stamp is None else stamp.sec * 1_000_000_000 + stamp.nanosec


def _layouts(link: Any) -> list[Any]:
    """How the messages of a connection may be laid out, as stores of types; none where they hold no
    packets.
    """
    typesys = import_library("rosbags.typesys", "ros")
    if link.msgtype == RAW and "packets" in link.topic:
        return [typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)]
    is_told = link.msgdef.format.name == "MSG"
    if (
        is_told and "packet" not in (link.msgtype + link.msgdef.data).lower()
    ):  # nor need rosbags understand it
        return []
    package = link.msgtype.partition("/")[0]
    found = []
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
        found += [store] if _carries(store.fielddefs, link.msgtype) else []
    return found


def _carries(types: Mapping[str, Any], name: str) -> bool:
    """Whether messages of a type hold packets."""
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
    """What a field is an array of: the name of a type, or that of a number with its length; None
    where it is none.
    """
    if field is not None and field[0].name in ("ARRAY", "SEQUENCE"):
        return field[1][0][1]
    return None
