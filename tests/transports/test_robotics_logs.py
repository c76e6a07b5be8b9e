"""Tests that packets in robotics logs are read with their bytes and times."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import SourceError
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import Datagram, make_datagram_record
from lidarspec.captures.records import make_capture_head
from lidarspec.formats import write
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.protocol import Chunk
from tests.cli.running import ran

typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")
rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="rosbags is not installed")
rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="rosbags is not installed")

START = 1_700_000_000_000_000_000
STEP = 1_327_104
#: messages as their packages document them: the list, and the packet in it; or the packet alone.
LIST = "std_msgs/Header header\n{1}[] packets\n" + "=" * 80 + "\nMSG: {0}/{1}\n"
STAMPED = LIST + "builtin_interfaces/Time stamp\n"
LAYOUTS = {
    "velodyne_msgs/msg/VelodyneScan": f"{STAMPED}uint8[1206] data".format(
        "velodyne_msgs", "VelodynePacket"
    ),
    "pandar_msgs/msg/PandarScan": f"{STAMPED}uint8[1500] data\nuint32 size".format(
        "pandar_msgs", "PandarPacket"
    ),
    "nebula_msgs/msg/NebulaPackets": f"{STAMPED}uint8[] data".format("nebula_msgs", "NebulaPacket"),
    "hesai_ros_driver/msg/UdpFrame": f"{LIST}uint8[] data\nuint32 size".format(
        "hesai_ros_driver", "UdpPacket"
    ),
    "rslidar_msgs/msg/rslidarScan": f"{STAMPED}uint8[1248] data".format(
        "rslidar_msgs", "rslidarPacket"
    ),
    "rslidar_msg/msg/RslidarPacket": (
        "std_msgs/Header header\nuint8 is_difop\nuint8 is_frame_begin\nuint8[] data"
    ),
    "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf",
}
KINDS = ["bag", "folder", "mcap", "db3", "untold"]


def packets(number: int, name: str = "velodyne-vlp16", start: int = 0) -> list[bytes]:
    return ls.simulate(ls.sensor(name), number, start=start)


def write_log(path: Path, kind: str, topics: dict[str, tuple[str, Sequence[bytes]]]) -> Path:
    """Write a log with rosbags; return its path.

    Args:
        path: the folder of the log.
        kind: one of `KINDS`.
        topics: topic -> the type of its messages, and the packets. If a message contains a list of
            packets, the list has ten.
    """
    is_1 = kind == "bag"
    store = typesys.get_typestore(
        typesys.Stores.ROS1_NOETIC if is_1 else typesys.Stores.ROS2_HUMBLE
    )
    plugin = (
        rosbag2.StoragePlugin.MCAP if kind in ("folder", "mcap") else rosbag2.StoragePlugin.SQLITE3
    )
    log = (
        rosbag1.Writer(path / "log.bag")
        if is_1
        else rosbag2.Writer(path / "log", version=8, storage_plugin=plugin)
    )
    with log:
        for topic, (msgtype, data) in topics.items():
            if msgtype not in store.types:
                store.register(typesys.get_types_from_msg(LAYOUTS[msgtype], msgtype))
            link = log.add_connection(topic, msgtype, typestore=store)
            for at, message in messages(store, msgtype, data):
                log.write(
                    link,
                    at,
                    store.serialize_ros1(message, msgtype)
                    if is_1
                    else store.serialize_cdr(message, msgtype),
                )
    if kind == "untold":
        with sqlite3.connect(path / "log" / "log.db3") as database:
            database.execute("drop table message_definitions")
            database.execute("update schema set schema_version = 3")
        database.close()
    names = {
        "bag": "log.bag",
        "folder": "log",
        "mcap": "log/log.mcap",
        "db3": "log/log.db3",
        "untold": "log/log.db3",
    }
    return path / names[kind]


def messages(store: Any, msgtype: str, data: Sequence[bytes]) -> Iterator[tuple[int, Any]]:
    kind = store.types[msgtype]
    lists = "packets" in kind.__dataclass_fields__
    each = 10 if lists else 1
    for first in range(0, len(data), each):
        stamps = [START + STEP * number for number in range(first, min(first + each, len(data)))]
        items = zip(data[first : first + each], stamps, strict=True)
        if not lists:
            yield stamps[0], make_message(store, msgtype, *next(items))
            continue
        (*_, (element, _)) = dict(store.fielddefs[msgtype][1])["packets"]
        yield (
            stamps[-1],
            kind(
                header=header(store, stamps[-1]),
                packets=[make_message(store, element[1], *item) for item in items],
            ),
        )


def make_message(store: Any, name: str, data: bytes, at: int) -> Any:
    values: dict[str, Any] = {
        "stamp": time(store, at),
        "header": header(store, at),
        "size": len(data),
        "is_difop": 0,
        "is_frame_begin": 0,
    }
    fixed = {
        "velodyne_msgs/msg/VelodynePacket": 1206,
        "rslidar_msgs/msg/rslidarPacket": 1248,
        "pandar_msgs/msg/PandarPacket": 1500,
    }.get(name, len(data))
    values["data"] = values["buf"] = np.frombuffer(data.ljust(fixed, b"\0"), np.uint8)
    kind = store.types[name]
    return kind(
        **{field: values[field] for field in kind.__dataclass_fields__ if field != "__msgtype__"}
    )


def time(store: Any, at: int) -> Any:
    return store.types["builtin_interfaces/msg/Time"](*divmod(at, 10**9))


def header(store: Any, at: int) -> Any:
    kind = store.types["std_msgs/msg/Header"]
    return kind(
        **({"seq": 1} if "seq" in kind.__dataclass_fields__ else {}),
        stamp=time(store, at),
        frame_id="x",
    )


def read(source: Path | str) -> list[Chunk]:
    with contextlib.closing(open_transport(source)) as opened:
        assert opened.datagrams
        return list(opened.chunks())


#: every layout in one kind of log and every kind of log with one layout; the other pairs are slow.
PAIRS = [
    pytest.param(
        kind, msgtype, marks=() if kind == "mcap" or "Velodyne" in msgtype else pytest.mark.slow
    )
    for kind in KINDS
    for msgtype in LAYOUTS
]


@pytest.mark.parametrize(("kind", "msgtype"), PAIRS)
def test_recorded_packets_read_back_equal(tmp_path: Path, kind: str, msgtype: str) -> None:
    sent = packets(
        25, "robosense-rs16" if msgtype == "rslidar_msgs/msg/rslidarScan" else "velodyne-vlp16"
    )
    chunks = read(write_log(tmp_path, kind, {"/lidar/packets": (msgtype, sent)}))
    assert [chunk.data for chunk in chunks] == sent
    assert {chunk.sender for chunk in chunks} == {None}
    stamps = [START + STEP * number for number in range(25)]
    if msgtype == "hesai_ros_driver/msg/UdpFrame":  # whose packets have no stamps of their own
        stamps = [stamps[min(number // 10 * 10 + 9, 24)] for number in range(25)]
    assert [chunk.at for chunk in chunks] == stamps


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bag", "folder"])
def test_a_log_is_converted_as_a_capture_is(tmp_path: Path, kind: str) -> None:
    sent = packets(30)
    (tmp_path / "raw.bin").write_bytes(b"".join(sent))
    path = write_log(
        tmp_path, kind, {"/velodyne_packets": ("velodyne_msgs/msg/VelodyneScan", sent)}
    )
    for source in (path, tmp_path / "raw.bin"):
        ran("convert", source, tmp_path / f"{source.stem}.csv", "-s", "velodyne-vlp16")
    assert (tmp_path / "log.csv").read_bytes() == (tmp_path / "raw.csv").read_bytes()
    assert "velodyne-vlp16" in ran("detect", path).output
    ran("record", path, "-o", tmp_path / "out.pcap", "-s", "velodyne-vlp16")
    assert [chunk.data for chunk in read(tmp_path / "out.pcap")] == sent


def test_packets_of_several_sensors_are_chosen_by_namespace_or_topic(tmp_path: Path) -> None:
    sent, other = packets(20), packets(20, start=1000)
    scan = "velodyne_msgs/msg/VelodyneScan"
    path = write_log(
        tmp_path, "mcap", {"/front/packets": (scan, sent), "/rear/packets": (scan, other)}
    )
    assert {chunk.sender for chunk in read(path)} == {("/front", 0), ("/rear", 0)}
    said = ran("convert", path, tmp_path / "out.csv", "-s", "velodyne-vlp16", code=2).stderr
    assert "/front and /rear both send frames of velodyne-vlp16" in said
    assert f"{path}?src=/front" in said
    for asked in ("/rear", "/rear/packets"):
        assert [chunk.data for chunk in read(f"{path}?src={asked}")] == other
    with contextlib.closing(open_transport(f"{path}?src=/left")) as opened:
        assert list(opened.chunks()) == []
        assert opened.warnings == [
            f"{path} is an MCAP file (ROS 2 bag) without packets of /left:"
            f" the topic /front/packets has the type {scan};"
            f" the topic /rear/packets has the type {scan}"
        ]


def test_topics_of_one_namespace_are_one_sensor(tmp_path: Path) -> None:
    sent = packets(20)
    kind = "ouster_sensor_msgs/msg/PacketMsg"
    path = write_log(
        tmp_path,
        "db3",
        {"/ouster/lidar_packets": (kind, sent), "/ouster/imu_packets": (kind, [b"imu"] * 20)},
    )
    chunks = read(path)
    assert {chunk.sender for chunk in chunks} == {None}
    assert [chunk.data for chunk in chunks if chunk.data != b"imu"] == sent
    assert len(read(f"{path}?src=/ouster/imu_packets")) == 20


def test_a_log_of_points_says_that_it_has_no_packets(tmp_path: Path) -> None:
    sensor = ls.sensor("velodyne-vlp16")
    write(tmp_path / "a.bag", sensor.scans(packets(20)))
    said = ran(
        "convert", tmp_path / "a.bag", tmp_path / "out.csv", "-s", "velodyne-vlp16", code=4
    ).stderr
    assert (
        "a.bag is a ROS 1 bag without packets: the topic /points has the type"
        " sensor_msgs/msg/PointCloud2" in said
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("inputs", [10, pytest.param(100, marks=pytest.mark.slow)])
def test_a_damaged_log_is_a_source_error(tmp_path: Path, kind: str, inputs: int) -> None:
    path = write_log(tmp_path, kind, {"/p": ("nebula_msgs/msg/NebulaPackets", packets(50))})
    target = next(iter(path.glob("*.mcap"))) if path.is_dir() else path
    whole, random = target.read_bytes(), np.random.default_rng(1)
    for number in range(inputs):
        data = bytearray(whole[: random.integers(20, len(whole))] if number % 2 else whole)
        for place in random.integers(16, len(data), 20 * (number % 3)):
            data[place] ^= 1 << random.integers(8)
        target.write_bytes(data)
        with contextlib.suppress(SourceError):
            read(path)


@pytest.mark.parametrize("suffix", ["mcap", "bag", "db3"])
def test_damage_in_a_log_of_our_own_packets_is_a_source_error(tmp_path: Path, suffix: str) -> None:
    """Opening such a log reads its first message, which says whether it holds datagrams."""
    source = tmp_path / "it.pcap"
    ends = ("192.168.1.201", 2368), ("192.168.1.77", 2368)
    records = [
        make_datagram_record(Datagram(data, START + STEP * number, *ends))
        for number, data in enumerate(packets(20))
    ]
    source.write_bytes(make_capture_head(ETHERNET) + b"".join(records))
    log = tmp_path / f"out.{suffix}"
    ran("convert", "--packets", source, log, "-s", "velodyne-vlp16")
    whole = log.read_bytes()
    random = np.random.default_rng(2)
    failed = 0
    for _ in range(40):
        data = bytearray(whole)
        for offset in random.integers(16, len(data), 400):
            data[offset] = random.integers(256)
        log.write_bytes(data)
        try:
            read(log)
        except SourceError:
            failed += 1
    assert failed


def test_packets_are_the_same_through_every_container(tmp_path: Path) -> None:
    sent = packets(40)
    source = tmp_path / "it.pcap"
    ends = ("192.168.1.201", 2368), ("192.168.1.77", 2368)
    records = [
        make_datagram_record(Datagram(data, START + STEP * number, *ends))
        for number, data in enumerate(sent)
    ]
    source.write_bytes(make_capture_head(ETHERNET) + b"".join(records))
    for suffix in ("mcap", "bag", "rosbag2", "db3", "lsr", "pcap"):
        target = tmp_path / f"out.{suffix}"
        words = ("record",) if suffix in ("lsr", "pcap") else ("convert", "--packets")
        ran(*words, source, *(["-o"] if len(words) == 1 else []), target, "-s", "velodyne-vlp16")
        assert [(chunk.data, chunk.at) for chunk in read(target)] == [
            (data, START + STEP * number) for number, data in enumerate(sent)
        ]
        # Packets of a log are taken over from log to log.
        source = target if suffix in ("mcap", "lsr") else source
    ran("convert", tmp_path / "out.mcap", tmp_path / "mcap.csv", "-s", "velodyne-vlp16")
    ran("convert", tmp_path / "it.pcap", tmp_path / "pcap.csv", "-s", "velodyne-vlp16")
    assert (tmp_path / "mcap.csv").read_bytes() == (tmp_path / "pcap.csv").read_bytes()


def test_packets_have_no_place_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "it.bin").write_bytes(ls.sensor("ldrobot-stl27l").example("data"))
    said = ran(
        "convert",
        tmp_path / "it.bin",
        tmp_path / "out.mcap",
        "--packets",
        "-s",
        "ldrobot-stl27l",
        code=2,
    ).stderr
    assert "it.bin is a byte stream" in said
    assert (
        "can be read only once: record it first"
        in ran("convert", "-", "o.mcap", "--packets", "-s", "velodyne-vlp16", code=2).stderr
    )
    path = write_log(tmp_path, "mcap", {"/p": ("nebula_msgs/msg/NebulaPackets", packets(20))})
    said = ran(
        "convert", path, tmp_path / "out.csv", "--packets", "-s", "velodyne-vlp16", code=2
    ).stderr
    assert (
        "out.csv: .csv does not support --packets; these formats do: .mcap, .bag, .rosbag2, .db3"
        in said
    )
    assert not list(tmp_path.glob("out.*"))
