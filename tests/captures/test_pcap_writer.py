"""Writing captures: the bytes, what is refused, and files that take no more."""

from __future__ import annotations

import io
import os
import random
import struct
import sys
from pathlib import Path

import pytest

from lidarspec.captures.pcap import CaptureReader, CaptureStats, Datagram, PcapWriter
from lidarspec.errors import SourceError, UsageError
from tests import made_captures as made

DATAGRAM = Datagram(b"\x12\x34\x56", 1_700_000_000_123_456_789, made.SOURCE, made.DESTINATION)


def test_writer_bytes() -> None:
    file = io.BytesIO()
    PcapWriter(file).write(DATAGRAM)
    assert file.getvalue().hex(" ") == (
        "4d 3c b2 a1 02 00 04 00 00 00 00 00 00 00 00 00 00 00 04 00 01 00 00 00 "  # pcap header
        "00 f1 53 65 15 cd 5b 07 2d 00 00 00 2d 00 00 00 "  # time 1700000000 s, 123456789 ns; 45 bytes
        "02 00 00 00 00 01 02 00 00 00 00 02 08 00 "  # Ethernet
        "45 00 00 1f 00 00 40 00 40 11 b6 aa c0 a8 01 c9 c0 a8 01 0a "  # IPv4
        "09 40 1a 2b 00 0b 00 00 12 34 56"  # UDP
    )


def test_written_datagrams_come_back_with_right_checksums() -> None:
    draw = random.Random(1)
    written = []
    for size in [0, 1, 1248, 65_507, *(draw.randrange(100) for _ in range(300))]:
        source, destination = ((".".join(str(draw.randrange(256)) for _ in range(4)), draw.randrange(1 << 16)) for _ in range(2))
        written.append(Datagram(draw.randbytes(size), draw.randrange(10**9 << 32), source, destination))
    file = io.BytesIO()
    writer = PcapWriter(file)
    for datagram in written:
        at = file.tell()
        writer.write(datagram)
        total = sum(struct.unpack_from(">10H", file.getvalue(), at + 16 + 14))
        assert (total & 0xFFFF) + (total >> 16) == 0xFFFF
    assert made.read(file.getvalue()) == (written, CaptureStats(packets=len(written), datagrams=len(written)))


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (Datagram(bytes(65_508), 0, made.SOURCE, made.DESTINATION), "65508 bytes"),
        (Datagram(b"", 0, ("fe80::1", 1), made.DESTINATION), "fe80::1"),
        (Datagram(b"", 0, made.SOURCE, ("sensor.local", 1)), "sensor.local"),
        (Datagram(b"", 0, made.SOURCE, ("10.0.0.1", 65_536)), "65536"),
        (Datagram(b"", -1, made.SOURCE, made.DESTINATION), "-1 ns"),
        (Datagram(b"", 10**9 << 32, made.SOURCE, made.DESTINATION), "2106"),
    ],
)
def test_writer_refuses_what_no_record_can_hold(datagram: Datagram, reason: str) -> None:
    file = io.BytesIO()
    writer = PcapWriter(file)
    with pytest.raises(UsageError, match=reason):
        writer.write(datagram)
    writer.write(DATAGRAM)
    assert made.read(file.getvalue())[0] == [DATAGRAM]


BIG = Datagram(bytes(1000), 0, made.SOURCE, made.DESTINATION)


def write_many(writer: PcapWriter) -> None:
    for _ in range(100):
        writer.write(BIG)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on the size of files")
@pytest.mark.parametrize("buffering", [0, 256, 8192])
def test_full_disk_leaves_whole_records_and_one_clear_error(tmp_path: Path, buffering: int) -> None:
    import resource

    path = tmp_path / "full.pcap"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    with open(path, "wb", buffering) as file:
        file.write(b"before")
        resource.setrlimit(resource.RLIMIT_FSIZE, (6 + 24 + 2 * 1058 + 500, before[1]))
        try:
            writer = PcapWriter(file)
            with pytest.raises(SourceError, match="cannot write"):
                write_many(writer)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        if buffering < 1058:
            assert path.stat().st_size == 6 + 24 + 2 * 1058
            writer.write(DATAGRAM)
    datagrams, stats = made.read(path.read_bytes()[6:])
    assert datagrams == ([BIG, BIG, DATAGRAM] if buffering < 1058 else [BIG] * len(datagrams))
    assert stats == CaptureStats(packets=len(datagrams), datagrams=len(datagrams))


@pytest.mark.skipif(sys.platform == "win32", reason="needs a pipe that does not block")
def test_pipe_that_takes_half_a_record_takes_no_more() -> None:
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    with open(reading, "rb", 0), open(writing, "wb", 0) as sink:
        writer = PcapWriter(sink)
        with pytest.raises(SourceError, match="no more bytes"):
            write_many(writer)
        with pytest.raises(SourceError, match="half a record"):
            writer.write(DATAGRAM)


def test_real_capture_written_again_reads_the_same() -> None:
    path = made.CAPTURES / "velodyne/hdl32e/sample_velodyne_hdl32.pcap"
    if not path.exists():
        pytest.skip(f"no capture {path.name} in {made.CAPTURES} (set LIDARSPEC_CAPTURES)")
    datagrams = list(CaptureReader(path))
    file = io.BytesIO()
    writer = PcapWriter(file)
    for datagram in datagrams:
        writer.write(datagram)
    assert made.read(file.getvalue())[0] == datagrams
