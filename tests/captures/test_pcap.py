"""Tests of reading captures: file formats, pipes, paths and real files.

`test_ip.py` tests the content of the frames.
"""

from __future__ import annotations

import io
import os
import struct
import threading
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest

from lidarspec.captures.pcap import CaptureReader, CaptureStats, Datagram
from lidarspec.captures.records import is_capture
from lidarspec.errors import SourceError
from tests import made_captures as made

FRAME = made.frame(b"one")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("magic", "unit"), [(0xA1B2C3D4, 1000), (0xA1B23C4D, 1)])
def test_pcap_of_either_order_and_unit(order: str, magic: int, unit: int) -> None:
    capture = (
        made.pcap_head(order, magic=magic)
        + made.record(FRAME, order)
        + made.record(made.frame(b""), order)
    )
    at = made.SECONDS * 10**9 + made.FRACTION * unit
    datagrams, stats = made.read(capture)
    assert datagrams == [
        Datagram(b"one", at, made.SOURCE, made.DESTINATION),
        Datagram(b"", at, made.SOURCE, made.DESTINATION),
    ]
    assert stats == CaptureStats(packets=2, datagrams=2)
    assert is_capture(capture)


def test_link_type_beside_frame_check_sequence_length() -> None:
    assert made.payloads(made.pcap(FRAME + b"\xfc\xc5\x01\x02", link=0x2400_0001))[0] == [b"one"]


@pytest.mark.parametrize("kind", [made.ENHANCED, made.OBSOLETE, made.SIMPLE])
@pytest.mark.parametrize("order", ["<", ">"])
def test_pcapng_packet_blocks(order: str, kind: int) -> None:
    ticks = 1_700_000_000_123_456
    capture = (
        made.section(order)
        + made.interface(order)
        + made.packet(FRAME, order, kind=kind, ticks=ticks)
    )
    at = 0 if kind == made.SIMPLE else ticks * 1000
    assert made.read(capture) == (
        [Datagram(b"one", at, made.SOURCE, made.DESTINATION)],
        CaptureStats(packets=1, datagrams=1),
    )
    assert is_capture(capture)


def test_sections_of_both_orders_forget_the_interfaces_before() -> None:
    first = made.section("<") + made.interface("<", link=101) + made.packet(FRAME[14:], "<")
    second = (
        made.section(">")
        + made.interface(">")
        + made.interface(">", link=101)
        + made.packet(FRAME[14:], ">", number=1)
    )
    third = made.section("<") + made.packet(FRAME, "<")
    assert made.payloads(first + second + third) == (
        [b"one", b"one"],
        CaptureStats(packets=2, datagrams=2, malformed=1),
    )


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (b"", 3_000_000_007_000),
        (made.option(9, b"\x09"), 3_000_000_007),
        (made.option(9, b"\x00"), 3_000_000_007 * 10**9),
        (made.option(9, b"\x94"), (3_000_000_007 * 10**9) >> 20),
        (made.option(9, b"\xff"), 0),
        (made.option(2, b"eth0!") + made.option(9, b"\x09"), 3_000_000_007),
        (made.option(9, b"\x09") + made.option(14, struct.pack("<q", 5)), 8_000_000_007),
        (made.option(9, b"\x09") + made.option(14, struct.pack("<q", -5)), -1_999_999_993),
        (made.option(9, b"\x09\x00") + made.option(14, b"\x05"), 3_000_000_007_000),
        (struct.pack("<HHq", 14, 0xFFFF, 5), 3_000_000_007_000),
        (struct.pack("<HHI", 14, 8, 5), 3_000_000_007_000),
        (struct.pack("<HH", 9, 1), 3_000_000_007_000),
    ],
    ids=[
        "none",
        "ns",
        "s",
        "2^-20",
        "2^-127",
        "after a name",
        "offset",
        "offset back",
        "wrong sizes",
        "size beyond the block",
        "offset cut",
        "resolution cut",
    ],
)
def test_time_options(options: bytes, expected: int) -> None:
    capture = (
        made.section() + made.interface(options=options) + made.packet(FRAME, ticks=3_000_000_007)
    )
    assert [datagram.at for datagram in made.read(capture)[0]] == [expected]


def test_simple_packets_are_cut_at_the_snap_length_of_the_first_interface() -> None:
    head = made.section() + made.interface(snap_length=len(FRAME))
    padded = made.packet(FRAME + bytes(9), kind=made.SIMPLE)
    block = struct.pack("<I", len(FRAME) + 1) + FRAME[:-1] + bytes(-(len(FRAME) - 1) % 4)
    assert made.payloads(head + padded)[0] == [b"one"]
    assert (
        made.payloads(
            made.section() + made.interface(snap_length=len(FRAME) - 1) + made.block(3, block)
        )[1].snapped
        == 1
    )


def test_packets_of_a_pipe_come_as_soon_as_they_are_whole() -> None:
    reading, writing = os.pipe()
    with open(reading, "rb") as source, open(writing, "wb", 0) as sink:
        sink.write(made.pcap(FRAME))
        reader = iter(CaptureReader(source))
        assert next(reader).data == b"one"
        sink.write(made.record(made.frame(b"two")) + b"tail")
        assert next(reader).data == b"two"
        sink.close()
        assert not list(reader)


def test_input_that_trickles_in_is_read_whole() -> None:
    reading, writing = os.pipe()
    capture = made.pcap(FRAME, made.frame(b"two"))

    def trickle() -> None:
        with open(writing, "wb", 0) as sink:
            for byte in capture:
                sink.write(bytes([byte]))

    thread = threading.Thread(target=trickle)
    thread.start()
    with open(reading, "rb", 0) as source:
        assert list(CaptureReader(source)) == made.read(capture)[0]
    thread.join()


def test_iterators_share_one_pass() -> None:
    reader = CaptureReader(io.BytesIO(made.pcap(FRAME, made.frame(b"two"))))
    assert [next(iter(reader)).data, next(iter(reader)).data] == [b"one", b"two"]
    assert not list(reader)


def test_paths(tmp_path: Path) -> None:
    path = tmp_path / "one.pcap"
    path.write_bytes(made.pcap(FRAME, FRAME))
    assert len(list(CaptureReader(path))) == 2
    with CaptureReader(str(path)) as reader:
        next(iter(reader))
    with pytest.raises(SourceError, match=r"absent\.pcap"):
        CaptureReader(tmp_path / "absent.pcap")
    with pytest.raises(SourceError):
        CaptureReader(tmp_path)
    path.write_bytes(b"text")
    with pytest.raises(SourceError, match=r"one\.pcap.*74 65 78 74"):
        CaptureReader(path)


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="needs a file whose reading fails")
def test_failing_reads_are_source_errors() -> None:
    with pytest.raises(SourceError, match="Input/output error"):
        CaptureReader("/proc/self/mem")


REAL = {
    "velodyne/hdl32e/sample_velodyne_hdl32.pcap": {(1206, 2368): 500},
    "velodyne/vlp16_old_firmware/vlp-16-test-90deg-1-50-frames.pcap": {
        (1206, 2368): 1902,
        (512, 8308): 367,
    },
    "velodyne/vlp16_dual/packets.derived.pcap": {(1206, 2368): 603},
    "robosense/helios16p/packets.derived.pcap": {(1248, 2368): 751},
    "hesai/40p/packets.derived.pcap": {(1262, 2368): 1439},
    "hesai/40p_20hz/lidar_20Hz.pcapng": {(1266, 2369): 200},
    "hesai/xt32/packets.derived.pcap": {(1080, 2368): 2000},
    "hesai/qt64/packets.derived.pcap": {(1072, 2368): 1200},
    "ouster/OS-0-32-U1_v2.2.0_1024x10.pcap": {(8448, 7502): 64, (48, 7503): 10},
    "ouster/OS-1-128_v2.3.0_1024x10_lb_n3.pcap": {(8448, 7502): 192, (48, 7503): 30},
    "ouster/OS-2-32-U0_v2.0.0_1024x10.pcap": {(6464, 7502): 64},
    "ouster/fragments/same_ports.pcap": {(48, 7502): 2, (12608, 7502): 1, (16640, 7502): 1},
}


@pytest.mark.parametrize("name", REAL)
def test_real_capture(name: str) -> None:
    path = made.CAPTURES / name
    if not path.exists():
        pytest.skip(f"no capture {name} in {made.CAPTURES} (set LIDARSPEC_CAPTURES)")
    with CaptureReader(path) as reader:
        datagrams = list(reader)
    assert (
        Counter((len(datagram.data), datagram.destination[1]) for datagram in datagrams)
        == REAL[name]
    )
    fragments = 21 if "fragments" in name else 0
    packets = len(datagrams) + (fragments - 2 if fragments else 0)
    assert reader.stats == CaptureStats(
        packets=packets, datagrams=len(datagrams), fragments=fragments
    )
    assert all(0 <= later.at - earlier.at < 1e9 for earlier, later in pairwise(datagrams))
