"""Tests that a time in a capture is found without reading the packets before it."""

from __future__ import annotations

import contextlib
import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
import lidarspec.captures.records
from lidarspec.captures.bulk import CaptureBatches
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import UNKNOWN_ENDPOINT, Datagram, StreamReader, make_datagram_frame
from lidarspec.captures.records import WRITINGS
from lidarspec.explaining import file_contents as contents
from lidarspec.scans import selection
from lidarspec.transports.files import CaptureTransport, open_file
from tests import made_captures as made

START = 1_700_000_000_000_000_000
STEP = 10_000_000
NUMBER = 2000
#: bytes before the time that is looked for that a reader may read: fewer than usual, so that the
#: captures can be short.
NEAR = 1 << 18
#: of a capture of a byte stream.
USER0 = 147
SENT = Datagram(bytes(1000), 0, ("192.168.1.201", 2368), UNKNOWN_ENDPOINT)


@pytest.fixture(autouse=True)
def _near(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lidarspec.captures.records, "NEAR_BYTES", NEAR)
    monkeypatch.setattr(CaptureBatches, "max_buffer_bytes", NEAR)
    monkeypatch.setattr(contents, "MAX_BEGINNING_BYTES", 4 * NEAR)


def write_records(
    path: Path, *, first: int = 0, number: int = NUMBER, link: int = ETHERNET, head: bool = True
) -> Path:
    """Write records of 1000 bytes to a capture, one every `STEP`; return its path.

    The records are datagrams, or pieces of a byte stream, depending on `link`.
    """
    writing = WRITINGS[path.suffix]
    with path.open("ab") as file:
        file.write(writing.head(link) if head else b"")
        for count in range(first, first + number):
            data = count.to_bytes(4, "big") * 250
            packet = make_datagram_frame(replace(SENT, data=data)) if link == ETHERNET else data
            file.write(writing.record(packet, START + count * STEP))
    return path


def open_capture(path: Path) -> CaptureTransport:
    found = open_file(str(path))
    assert isinstance(found, CaptureTransport)
    return found


def rest(source: CaptureTransport, to: int, *, in_batches: bool) -> list[int]:
    """Return the times of the remaining packets after a few packets and a seek."""
    if not in_batches:
        chunks = source.chunks()
        assert not next(chunks).gap
        assert source.skip_until(to)
        left = list(chunks)
        assert [chunk.gap for chunk in left[:3]] == [True, False, False]
        assert all(
            int.from_bytes(chunk.data[:4], "big") * STEP == (chunk.at or 0) - START
            for chunk in left
        )
        return [chunk.at or 0 for chunk in left]
    batches = source.batches()
    assert not next(batches).gap
    assert source.skip_until(to)
    parts = list(batches)
    assert [batch.gap for batch in parts] == [True, *[False] * (len(parts) - 1)]
    assert all(
        batch.data(0)[:4] == ((int(batch.at[0]) - START) // STEP).to_bytes(4, "big")
        for batch in parts
    )
    return np.concatenate([batch.at for batch in parts]).tolist()


@pytest.mark.parametrize("in_batches", [False, True])
@pytest.mark.parametrize("name", ["drive.pcap", "drive.pcapng"])
@pytest.mark.parametrize("link", [ETHERNET, USER0])
@pytest.mark.parametrize("number", [NUMBER * 3 // 4, 10 * NUMBER])
def test_seeking_reads_everything_after_a_time_and_little_before(
    tmp_path: Path, name: str, link: int, number: int, in_batches: bool
) -> None:
    with contextlib.closing(open_capture(write_records(tmp_path / name, link=link))) as source:
        times = rest(source, START + number * STEP, in_batches=in_batches)
        assert not source.warnings
        assert not source.skip_until(START)
    assert times[0] <= START + min(number, NUMBER - 1) * STEP
    assert times == list(range(times[0], START + NUMBER * STEP, STEP))
    assert len(times) * 1000 < max(NUMBER - number, 0) * 1000 + NEAR + (1 << 16)


def test_damage_on_the_way_is_no_hindrance(tmp_path: Path) -> None:
    path = write_records(tmp_path / "drive.pcap")
    data = bytearray(path.read_bytes())
    for place in range(len(data) // 4, len(data) * 3 // 4, 5000):
        data[place : place + 8] = bytes(byte ^ 0xFF for byte in data[place : place + 8])
    path.write_bytes(data)
    with contextlib.closing(open_capture(path)) as source:
        times = rest(source, START + 1900 * STEP, in_batches=True)
    assert START + NUMBER // 2 * STEP < times[0] <= START + 1900 * STEP
    assert times[-1] == START + (NUMBER - 1) * STEP


def test_damage_that_was_passed_over_is_not_counted(tmp_path: Path) -> None:
    path = write_records(tmp_path / "drive.pcapng")
    data, size = (
        bytearray(path.read_bytes()),
        len(WRITINGS[".pcapng"].record(make_datagram_frame(SENT), START)),
    )
    place = len(WRITINGS[".pcapng"].head(ETHERNET)) + 50 * size
    data[place + 4 : place + 8] = (2 * size).to_bytes(4, "little")  # a block as long as two
    path.write_bytes(data)
    with contextlib.closing(open_capture(path)) as source:
        rest(source, START + 1700 * STEP, in_batches=True)
        assert not source.warnings
        assert source.unread == 0


def test_seeking_never_goes_back(tmp_path: Path) -> None:
    with contextlib.closing(open_capture(write_records(tmp_path / "drive.pcap"))) as source:
        batches = source.batches()
        next(batches)
        assert source.skip_until(START + NUMBER * 3 // 4 * STEP)
        seen = [next(batches)]
        assert not source.skip_until(START + NUMBER // 6 * STEP)
        times = np.concatenate([batch.at for batch in (*seen, *batches)])
    assert (np.diff(times) == STEP).all()
    assert times[-1] == START + (NUMBER - 1) * STEP


def test_no_seek_with_other_time_bases(tmp_path: Path) -> None:
    """The interface of the second section has another clock than the first."""
    path = write_records(tmp_path / "drive.pcapng", number=NUMBER * 2 // 3)
    ticks = made.interface(options=made.option(9, bytes([6])))
    packet = make_datagram_frame(SENT)
    end = START + NUMBER * STEP
    path.write_bytes(
        path.read_bytes()
        + made.section()
        + ticks
        + made.packet(packet, ticks=end // 1000) * (NUMBER // 2)
    )
    with contextlib.closing(open_capture(path)) as source:
        batches = source.batches()
        next(batches)
        assert source.skip_until(end)
        times = np.concatenate([batch.at for batch in batches])
    assert times[0] < START + NUMBER * 2 // 3 * STEP
    assert np.count_nonzero(times == end) == NUMBER // 2


def test_a_packed_capture_is_read_from_its_beginning(tmp_path: Path) -> None:
    path = tmp_path / "drive.pcap.gz"
    path.write_bytes(gzip.compress(write_records(tmp_path / "drive.pcap").read_bytes(), 1))
    with contextlib.closing(open_capture(path)) as source:
        batches = source.batches()
        number = len(next(batches))
        assert not source.skip_until(START + NUMBER * 2 // 3 * STEP)
        assert number + sum(map(len, batches)) == NUMBER


def test_the_duration_of_a_long_capture_is_known_without_reading_it(tmp_path: Path) -> None:
    path = write_records(tmp_path / "long.pcap")
    assert path.stat().st_size > contents.MAX_BEGINNING_BYTES
    assert contents.measure_duration(path) == pytest.approx((NUMBER - 1) * STEP * 1e-9)


#: datagrams of the simulated sensor a second.
RATE = 754


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a capture of four seconds of a simulated sensor."""
    path = tmp_path_factory.mktemp("captured") / "drive.pcap"
    with path.open("wb") as file:
        file.write(WRITINGS[".pcap"].head(ETHERNET))
        for number, data in enumerate(ls.simulate(ls.sensor("velodyne-vlp16"), 4 * RATE)):
            frame = make_datagram_frame(replace(SENT, data=data))
            file.write(WRITINGS[".pcap"].record(frame, START + number * 1_000_000_000 // RATE))
    return path


def test_a_slice_of_a_capture_has_the_scans_that_reading_all_of_it_gives(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("LEAD_S", "MIN_SKIP_S"):
        monkeypatch.setattr(selection, name, 0.5)
    packed = tmp_path / "drive.pcap.gz"
    packed.write_bytes(gzip.compress(drive.read_bytes(), 1))  # a reader cannot seek in it
    found, read = [], []
    for source in (drive, packed):
        with ls.open(source, "velodyne-vlp16") as device:
            scans = device.scans(select=selection.Selection(times=(3.0, 3.5)))
            found.append(
                [
                    (scan.host_ns, scan.complete, len(scan), float(scan.points.range.sum()))
                    for scan in scans
                ]
            )
            read.append(device.stats.bytes_in)
    assert len(found[0]) >= 4
    assert found[0] == found[1]
    assert read[0] < read[1] / 2


def test_no_scan_continues_across_a_seek(drive: Path) -> None:
    with ls.open(drive, "velodyne-vlp16") as device:
        scans = device.scans()
        next(scans)
        assert device.skip_until(START + 35 * 10**8)
        left = list(scans)
        assert device.stats.lost == 0
    gap = int(np.diff([scan.host_ns for scan in left]).argmax())
    assert left[gap + 1].host_ns - left[gap].host_ns > 10**9
    pieces = [place for place, scan in enumerate(left) if not scan.complete]
    assert pieces == [gap, gap + 1, len(left) - 1]
    assert all(scan.points.time.max() < 0.2 for scan in left)


def test_no_frame_continues_across_a_seek(tmp_path: Path) -> None:
    """The pieces of a byte stream can end within a frame."""
    sensor, path = ls.sensor("ldrobot-stl27l"), tmp_path / "stream.pcap"
    data = b"".join(ls.simulate(sensor, 40_000))
    with path.open("wb") as file:
        file.write(WRITINGS[".pcap"].head(USER0))
        for number, place in enumerate(range(0, len(data), 1000)):
            file.write(WRITINGS[".pcap"].record(data[place : place + 1000], START + number * STEP))
    with ls.open(path, sensor) as device:
        packets = device.packets()
        next(packets)
        assert device.skip_until(START + 1700 * STEP)
        number = sum(map(len, packets))
        stats = device.stats
    assert stats.lost <= 1  # the one that is torn
    assert 0 < number < 40_000
    # Two halves of frames meet there; the first may look like the beginning of a frame.
    assert stats.bad_checksum <= 1
    assert stats.bytes_skipped < 2 * 47
    assert stats.pending == 0


def test_a_stream_reader_seeks_as_well(tmp_path: Path) -> None:
    with write_records(tmp_path / "stream.pcap", link=USER0).open("rb") as file:
        reader = StreamReader(file)
        assert not reader.skip_until(START)  # nothing was read
        next(iter(reader))
        assert reader.skip_until(START + 1700 * STEP)
        assert next(iter(reader)).at > START + NUMBER // 2 * STEP
