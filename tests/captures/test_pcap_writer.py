"""Tests of writing captures: their bytes, refused input, and failing disks."""

from __future__ import annotations

import os
import random
import struct
import sys
from pathlib import Path

import pytest

from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import CaptureReader, CaptureStats, Datagram, make_datagram_record
from lidarspec.captures.records import make_capture_head
from lidarspec.errors import SourceError, UsageError
from lidarspec.recording.recorders import open_recorder
from lidarspec.spec import Chunk
from tests import made_captures as made

DATAGRAM = Datagram(b"\x12\x34\x56", 1_700_000_000_123_456_789, made.SOURCE, made.DESTINATION)


def chunk(datagram: Datagram) -> Chunk:
    return Chunk(datagram.data, datagram.at, datagram.source, datagram.destination)


def test_writer_bytes() -> None:
    assert (make_capture_head(ETHERNET) + make_datagram_record(DATAGRAM)).hex(" ") == (
        # pcap header
        "4d 3c b2 a1 02 00 04 00 00 00 00 00 00 00 00 00 00 00 04 00 01 00 00 00 "
        # time 1700000000 s, 123456789 ns; 45 bytes
        "00 f1 53 65 15 cd 5b 07 2d 00 00 00 2d 00 00 00 "
        "02 00 00 00 00 01 02 00 00 00 00 02 08 00 "  # Ethernet
        "45 00 00 1f 00 00 40 00 40 11 b6 aa c0 a8 01 c9 c0 a8 01 0a "  # IPv4
        "09 40 1a 2b 00 0b 00 00 12 34 56"  # UDP
    )


def test_written_datagrams_come_back_with_right_checksums() -> None:
    draw = random.Random(1)
    written = []
    for size in [0, 1, 1248, 65_507, *(draw.randrange(100) for _ in range(300))]:
        source, destination = (
            (".".join(str(draw.randrange(256)) for _ in range(4)), draw.randrange(1 << 16))
            for _ in range(2)
        )
        written.append(
            Datagram(draw.randbytes(size), draw.randrange(10**9 << 32), source, destination)
        )
    records = list(map(make_datagram_record, written))
    for record in records:
        total = sum(struct.unpack_from(">10H", record, 16 + 14))
        assert (total & 0xFFFF) + (total >> 16) == 0xFFFF
    assert made.read(make_capture_head(ETHERNET) + b"".join(records)) == (
        written,
        CaptureStats(packets=len(written), datagrams=len(written)),
    )


def test_ipv6_is_written_with_its_checksum() -> None:
    draw = random.Random(2)
    some = [(draw.randrange(99), "::1") for _ in range(99)]
    for size, destination in [
        (0, "::"),
        (3, "ff02::1"),
        (1248, "10.0.0.1"),
        (65_527, "0.0.0.0"),
        *some,
    ]:
        datagram = Datagram(draw.randbytes(size), 10**18, ("fe80::1:2", 2368), (destination, 6699))
        record = make_datagram_record(datagram)
        ((read,), _) = made.read(make_capture_head(ETHERNET) + record)
        assert (read.data, read.at, read.source, read.destination[1]) == (
            datagram.data,
            datagram.at,
            datagram.source,
            6699,
        )
        assert read.destination[0] in (destination, "::", "::ffff:a00:1", "::ffff:10.0.0.1")
        packet = record[16 + 14 :]
        words = packet[8:40] + struct.pack(">II", size + 8, 17) + packet[40:] + bytes(size % 2)
        total = sum(struct.unpack(f">{len(words) // 2}H", words))
        assert (total & 0xFFFF) + (total >> 16) in (0xFFFF, 0x1FFFE), "the checksum is right"


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (Datagram(bytes(65_508), 0, made.SOURCE, made.DESTINATION), "65508 bytes"),
        (Datagram(bytes(65_528), 0, ("fe80::1", 1), ("::", 1)), "65528 bytes"),
        (Datagram(b"", 0, made.SOURCE, ("sensor.local", 1)), "sensor.local"),
        (Datagram(b"", 0, made.SOURCE, ("10.0.0.1", 65_536)), "65536"),
        (Datagram(b"", -1, made.SOURCE, made.DESTINATION), "-1 ns"),
        (Datagram(b"", 10**9 << 32, made.SOURCE, made.DESTINATION), "2106"),
    ],
)
def test_writer_refuses_too_large_packets(datagram: Datagram, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "it.pcap"
    with open_recorder(path, datagrams=True) as writer:
        with pytest.raises(UsageError, match=reason):
            writer.write(chunk(datagram))
        writer.write(chunk(DATAGRAM))
    assert made.read(path.read_bytes())[0] == [DATAGRAM]


BIG = Datagram(bytes(1000), 0, made.SOURCE, made.DESTINATION)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on the size of files")
@pytest.mark.parametrize("room", [0, 500, 1057])
def test_full_disk_leaves_whole_records_and_one_clear_error(tmp_path: Path, room: int) -> None:
    import resource

    path = tmp_path / "full.pcap"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (24 + 2 * 1058 + room, before[1]))
    try:
        writer = open_recorder(path, datagrams=True)
        for _ in range(100):
            writer.write(chunk(BIG))
        with pytest.raises(SourceError, match="complete up to byte 2140"):
            writer.sync()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    writer.write(chunk(DATAGRAM))
    writer.close()
    assert writer.dropped
    assert path.stat().st_size == 24 + 2 * 1058
    assert made.read(path.read_bytes()) == ([BIG, BIG], CaptureStats(packets=2, datagrams=2))


@pytest.mark.skipif(sys.platform == "win32", reason="needs a named pipe")
def test_a_partial_write_ends_writing_to_a_pipe(tmp_path: Path) -> None:
    path = tmp_path / "pipe.pcap"
    os.mkfifo(path)
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb", 0) as reading:
        writer = open_recorder(path, datagrams=True, overwrite=True)
        for _ in range(100):
            writer.write(chunk(BIG))
        os.set_blocking(reading.fileno(), True)
        assert len(reading.read(500) or b"") == 500
    with pytest.raises(SourceError, match="Broken pipe"):
        writer.sync()
    before = writer.dropped
    writer.write(chunk(DATAGRAM))
    assert writer.dropped == before + 1
    writer.close()


def test_real_capture_written_again_reads_the_same() -> None:
    path = made.CAPTURES / "velodyne/hdl32e/sample_velodyne_hdl32.pcap"
    if not path.exists():
        pytest.skip(f"no capture {path.name} in {made.CAPTURES} (set LIDARSPEC_CAPTURES)")
    datagrams = list(CaptureReader(path))
    assert (
        made.read(make_capture_head(ETHERNET) + b"".join(map(make_datagram_record, datagrams)))[0]
        == datagrams
    )
