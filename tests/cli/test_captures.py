"""Tests of warnings about captures: damage, unread packets, several senders."""

from __future__ import annotations

import io
import shutil
import sqlite3
import subprocess
import tarfile
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import Datagram, make_datagram_record
from lidarspec.captures.records import make_capture_head
from lidarspec.recording.format import Record, Recording
from lidarspec.simulation.simulator import simulate
from tests import made_captures as made
from tests.cli.running import process, ran

M1 = "robosense-m1"


def records(number: int, *sources: tuple[str, int]) -> list[bytes]:
    """Return the records of a sensor's packets, from these senders in turn."""
    packets = simulate(ls.sensor(M1), number)
    ends = sources or (made.SOURCE,)
    return [
        make_datagram_record(
            Datagram(data, 10**18 + index * 158_730, ends[index % len(ends)], made.DESTINATION)
        )
        for index, data in enumerate(packets)
    ]


def capture(path: Path, *records: bytes, link: int = ETHERNET) -> Path:
    path.write_bytes(make_capture_head(link) + b"".join(records))
    return path


@pytest.mark.parametrize(
    "verb", ["convert", pytest.param("read", marks=pytest.mark.slow), "stats", "plot"]
)
def test_a_damaged_capture_is_read_with_a_warning(verb: str, tmp_path: Path) -> None:
    some = records(1300)
    some[700] = some[700][:10] + b"\x7f" + some[700][11:]
    path = capture(tmp_path / "it.pcap", *some)
    target = {
        "convert": [tmp_path / "out.csv"],
        "plot": ["-o", tmp_path / "out.svg", "--scan", 9],
    }.get(verb, [])
    done = ran(
        verb, path, *target, "-s", M1, *(["--packets", "--json"] if verb == "read" else []), code=1
    )
    assert f"{path} is corrupt in 1 place: {len(some[700])} bytes were not read" in done.stderr
    if verb == "read":
        assert done.stdout.count("\n") == 1299


TCP = made.ethernet(made.ipv4(bytes(40), protocol=6))
ARP = made.ethernet(bytes(28), ethertype=0x0806)


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (("convert", "{path}", "{target}.csv", "-s", M1), 4),
        (("convert", "{path}", "{target}.csv"), 4),
        (("read", "{path}", "-s", M1), 4),
        (("stats", "{path}", "-s", M1), 4),
        (("view", "{path}", "-s", M1), 4),
        (("view", "{path}"), 4),
        (("plot", "{path}", "-s", M1, "-o", "{target}.svg"), 4),
        (("detect", "{path}"), 4),
        (("doctor", "{path}"), 1),
        (("parse", "{path}", "-s", M1), 4),
        (("explain", "{path}"), 4),
        (("crc", "{path}"), 4),
        (("new", "acme-x1", "--into", "{target}", "--from-capture", "{path}"), 4),
        (("record", "{path}", "-o", "{target}.lsr"), 4),
        (("replay", "{path}", "--to", "{target}.lsr"), 4),
    ],
    ids=lambda value: value[0] + str(len(value)) if isinstance(value, tuple) else "",
)
def test_every_verb_describes_a_capture_without_datagrams(
    words: tuple[str, ...], code: int, tmp_path: Path
) -> None:
    path = capture(tmp_path / "tcp.pcap", *(made.record(each) for each in (TCP, ARP, TCP)))
    done = ran(*(word.format(path=path, target=tmp_path / "out") for word in words), code=code)
    said = f"{path}: 3 of 3 packets are not UDP over IP and were not read: 2 TCP, 1 ARP"
    output = done.stdout + done.stderr
    assert output.count(said) == 1, output
    assert "contains no bytes" not in output
    assert "no data received" not in output


@pytest.mark.parametrize(
    ("verb", "code"), [("read", 4), ("info", 4), ("detect", 4), ("stats", 4), ("view", 4)]
)
def test_an_unsupported_link_layer_is_named_with_a_way_to_read_it(
    verb: str, code: int, tmp_path: Path
) -> None:
    packets = [b"\xff\x03\x00\x21" + made.ipv4(made.udp(bytes(1210)))] * 3
    path = capture(tmp_path / "ppp.pcap", *map(made.record, packets), link=9)
    words = (verb, path) if verb in ("info", "detect") else (verb, path, "-s", M1)
    done = ran(*words, code=code)
    output = done.stdout + done.stderr
    message = f"{path}: 3 of 3 packets have an unsupported link layer and were not read: 3 PPP"
    assert output.count(message) == 1, output
    assert output.count("editcap -C BYTES -T rawip") == 1
    assert "contains no bytes" not in output


def test_a_few_packets_of_an_unsupported_link_layer_are_named_too(tmp_path: Path) -> None:
    tagged = made.record(made.ethernet(bytes(4) + made.ipv4(made.udp(b"x")), ethertype=0x8847))
    path = capture(tmp_path / "some.pcap", *records(2), tagged)
    assert "1 of 3 packets have an unsupported link layer" in ran("read", path, "-s", M1).stderr


@pytest.mark.skipif(shutil.which("editcap") is None, reason="editcap is not installed")
@pytest.mark.parametrize(
    ("header", "link"),
    [(4, 9), (22, ETHERNET), (18, ETHERNET), (32, 105), (34, 105)],
    ids=["PPP", "PPPoE", "MPLS", "802.11", "802.11 QoS"],
)
def test_editcap_makes_raw_ip_of_unsupported_link_layers(
    header: int, link: int, tmp_path: Path
) -> None:
    packets = [bytes(header) + made.ipv4(made.udp(data)) for data in simulate(ls.sensor(M1), 2)]
    path = capture(tmp_path / "link.pcap", *map(made.record, packets), link=link)
    raw = tmp_path / "raw.pcap"
    subprocess.run(["editcap", "-C", str(header), "-T", "rawip", path, raw], check=True)
    done = ran("read", raw, "-s", M1, "--packets", "--json")
    assert done.stdout.count("\n") == 2


def test_other_packets_are_reported_if_they_are_the_majority(tmp_path: Path) -> None:
    some, empty = records(2), capture(tmp_path / "empty.pcap")
    background = capture(tmp_path / "some.pcap", *some, *(made.record(ARP) for _ in range(2)))
    assert "packets" not in ran("parse", background, "-s", M1).stderr
    mostly = capture(tmp_path / "mostly.pcap", *some, *(made.record(ARP) for _ in range(3)))
    assert (
        "3 of 5 packets are not UDP over IP and were not read: 3 ARP"
        in ran("parse", mostly, "-s", M1).stderr
    )
    assert f"{empty} is a capture without packets" in ran("parse", empty, "-s", M1, code=4).stderr
    cut = capture(
        tmp_path / "cut.pcap",
        *(made.record(made.frame(bytes(400))[:90], original=442) for _ in range(3)),
    )
    assert (
        f"{cut}: 3 packets were truncated by the snap length of the capture"
        in ran("view", cut, "-s", M1, code=4).stderr
    )


@pytest.mark.slow
def test_senders_of_one_address_are_separated_by_port(tmp_path: Path) -> None:
    path = capture(tmp_path / "two.pcap", *records(40, ("10.0.0.1", 40001), ("10.0.0.1", 40002)))
    recording = tmp_path / "two.lsr"
    ran("record", path, "-o", recording)
    for source in (path, recording):
        said = ran("convert", source, tmp_path / "out.csv", "-s", M1, code=2).stderr
        assert (
            "10.0.0.1:40001 and 10.0.0.1:40002" in said
            or "10.0.0.1:40002 and 10.0.0.1:40001" in said
        )
        found = [f"{source} from 10.0.0.1:4000{number}" for number in (1, 2)]
        assert all(each in ran("detect", source).output for each in found)
        doctor = ran("doctor", source, code=1).output
        assert f"10.0.0.1:40001 and 10.0.0.1:40002 all send frames of {M1}" in doctor
        assert f"lidarspec view '{source}?src=10.0.0.1:40001' -s {M1}" in doctor
        assert (
            ran(
                "read", f"{source}?src=10.0.0.1:40002", "-s", M1, "--packets", "--json"
            ).stdout.count("\n")
            == 20
        )
    assert (
        "the datagrams of 2 senders"
        in ran("replay", recording, "--to", "udp://127.0.0.1:9", "--speed", "max").stderr
    )


@pytest.mark.slow
def test_a_sensor_that_sends_from_several_ports_to_several_is_one_sender(tmp_path: Path) -> None:
    data = records(20, ("10.0.0.1", 6699))
    status = [
        make_datagram_record(Datagram(b"status", 10**18, ("10.0.0.1", 7788), ("10.0.0.2", 7788)))
        for _ in range(20)
    ]
    path = capture(
        tmp_path / "one.pcap", *(each for pair in zip(data, status, strict=True) for each in pair)
    )
    assert "10.0.0.1" not in ran("detect", path).output
    assert "choose" not in ran("doctor", path).output
    ran("convert", path, tmp_path / "out.csv", "-s", M1)


def container(name: str, path: Path) -> Path:
    """Write a log file of another program with readable content."""
    held = path.with_name("held.pcap")
    packets = capture(held, *records(3)).read_bytes()
    if name == "SQLite":
        with sqlite3.connect(path) as bag:
            bag.execute("create table messages (data blob)")
            bag.execute("insert into messages values (?)", (packets,))
        bag.close()
    elif name == "tar":
        with tarfile.open(path, "w") as tar:
            tar.add(held)
    elif name == "NumPy":
        with path.open("wb") as file:
            np.save(file, np.arange(3))
    else:
        begun = {
            "ROS 1 bag": b"#ROSBAG V2.0\n",
            "MCAP": b"\x89MCAP0\r\n",
            "point cloud": b"# .PCD v0.7\n",
        }
        path.write_bytes(begun[name] + packets)
    return path


@pytest.mark.parametrize("name", ["SQLite", "tar", "NumPy", "ROS 1 bag", "MCAP", "point cloud"])
def test_unsupported_kinds_of_files_are_named(name: str, tmp_path: Path) -> None:
    if name in ("SQLite", "ROS 1 bag", "MCAP"):  # which is looked into for packets
        pytest.importorskip("rosbags")
    path = container(name, tmp_path / "other.bin")
    said = ran("convert", path, tmp_path / "out.csv", "-s", M1, code=3).stderr
    assert f"{path} is " in said
    assert name in said
    assert "cannot be read" in said or "expected a capture" in said
    ran("detect", path, code=3)
    if name == "tar":
        assert f"next: tar -xf {path}" in said


@pytest.mark.slow
def test_standard_input_is_no_way_around_it(tmp_path: Path) -> None:
    packed = container("tar", tmp_path / "other.tar").read_bytes()
    for words in (("convert", "-", tmp_path / "out.csv"), ("parse", "-")):
        done = process(*words, "-s", M1, given=packed)
        assert (done.returncode, b"standard input is a tar archive" in done.stderr) == (3, True)


def read_records(path: Path) -> list[Record]:
    with Recording(path) as recording:
        return list(recording)


@pytest.mark.slow
def test_captures_and_recordings_on_standard_input_are_read_as_from_files(tmp_path: Path) -> None:
    number = 6
    path, recording, copy = (
        capture(tmp_path / "it.pcap", *records(number)),
        tmp_path / "it.lsr",
        tmp_path / "copy.lsr",
    )
    blocks = tmp_path / "it.pcapng"
    blocks.write_bytes(
        made.section()
        + made.interface()
        + b"".join(made.packet(made.frame(each)) for each in simulate(ls.sensor(M1), number))
    )
    ran("record", path, "-o", recording, "-s", M1)
    for file in (path, blocks, recording):
        held = file.read_bytes()
        for words in (
            ("read", "-", "--packets", "--json"),
            ("parse", "-", "--json"),
            ("explain", "-", "--json"),
        ):
            named = [str(file) if word == "-" else word for word in words]
            assert ran(*words, "-s", M1, given=held).stdout == ran(*named, "-s", M1).stdout.replace(
                str(file), "-"
            ), words
        ran("record", "-", "-o", copy, "--force", given=held)
        ran("record", file, "-o", recording, "--force") if file != recording else None
        assert read_records(copy) == read_records(recording)
        said = ran("replay", "-", "--to", tmp_path / "played.lsr", "--force", given=held).stderr
        assert f"{number} chunks" in said
        assert [each.data for each in read_records(tmp_path / "played.lsr")] == [
            each.data for each in read_records(recording)
        ]
    assert "only once" in ran("replay", "-", "--loop", given=held, code=2).stderr
    done = process("read", "-", "--packets", "--json", "-s", M1, given=path.read_bytes())
    assert done.stdout.decode() == ran("read", path, "--packets", "--json", "-s", M1).stdout


def test_truncated_standard_input_is_reported(tmp_path: Path) -> None:
    path = capture(tmp_path / "it.pcap", *records(3))
    assert (
        "standard input is truncated in its last record"
        in ran("read", "-", "--packets", "-s", M1, given=path.read_bytes()[:-5]).stderr
    )


def test_bytes_that_only_begin_a_little_like_an_archive_are_bytes(tmp_path: Path) -> None:
    path = tmp_path / "it.bin"
    for begun in (
        b"\x1f\x8b",
        b"PK",
        b"BZh9",
        b"\x1f\x8b\x08\xff",
        b"#",
        io.DEFAULT_BUFFER_SIZE * b"\0",
    ):
        path.write_bytes(begun + bytes(8))
        assert ran("record", path, "-o", tmp_path / "it.lsr", "--force").stderr
