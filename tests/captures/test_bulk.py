"""Tests that captures read in batches give the same datagrams as read singly.

They also cover the order, the counts and the sender of each datagram.
"""

from __future__ import annotations

import gc
import io
import os
import random
import re
import struct
import threading
import tracemalloc
import weakref
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.captures.bulk import CaptureBatches, CapturedDatagrams, StreamBatches
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import (
    USER_LINKS,
    CaptureReader,
    Datagram,
    StreamReader,
    make_datagram_record,
)
from lidarspec.captures.records import make_capture_head
from lidarspec.simulation.simulator import simulate
from lidarspec.transports.files import CaptureTransport, open_file
from lidarspec.transports.protocol import Chunk
from tests import made_captures as made
from tests.lines import turning
from tests.shapes import SHAPES

Read = tuple[list[tuple[bytes, int, tuple[str, int]]], object]


def one_by_one(file: BinaryIO | Path, kind: type[CaptureReader] = CaptureReader) -> Read:
    reader = kind(file)
    return [(datagram.data, datagram.at, datagram.source) for datagram in reader], reader.stats


def in_batches(file: BinaryIO | Path, kind: type[CaptureBatches] = CaptureBatches) -> Read:
    reader = kind(file)
    return [row for batch in reader.batches() for row in rows(batch)], reader.stats


def rows(batch: CapturedDatagrams) -> list[tuple[bytes, int, tuple[str, int]]]:
    return [
        (batch.data(i), int(batch.at[i]), batch.names[batch.senders[i]]) for i in range(len(batch))
    ]


def check(capture: bytes) -> Read:
    found = in_batches(io.BytesIO(capture))
    assert found == one_by_one(io.BytesIO(capture))
    return found


def frame(data: bytes, *, port: int = 2368, ident: int = 7, host: int = 201) -> bytes:
    """Return a frame of a stream; its packets differ in identification and checksums."""
    body = struct.pack(">HHHH", port, 6699, 8 + len(data), ident * 31 & 0xFFFF) + data
    head = struct.pack(">BBHHHBBH", 0x45, 0, 28 + len(data), ident, 0, 64, 17, 0xFFFF - ident)
    return made.ethernet(head + bytes([192, 168, 1, host, 192, 168, 1, 10]) + body)


def stream(count: int, size: int = 100, *, port: int = 2368, host: int = 201) -> list[bytes]:
    return [
        frame(bytes([index & 0xFF]) * size, port=port, ident=index & 0xFFFF, host=host)
        for index in range(count)
    ]


def fragments(data: bytes, ident: int) -> list[bytes]:
    body = made.udp(data)
    places = [
        (at, at // 8 | (0x2000 if at + 48 < len(body) else 0)) for at in range(0, len(body), 48)
    ]
    parts = [
        made.ethernet(made.ipv4(body[at : at + 48], ident=ident, place=place))
        for at, place in places
    ]
    return parts


def interleave(*streams: list[bytes], seed: int = 1) -> list[bytes]:
    """Return the streams interleaved, each in its own order."""
    draw = random.Random(seed)
    order = [index for index, each in enumerate(streams) for _ in each]
    draw.shuffle(order)
    turns = [iter(each) for each in streams]
    return [next(turns[index]) for index in order]


MIXED = interleave(
    stream(300),
    stream(80, 48, port=7503),
    stream(40, 100, host=202),
    [made.ethernet(b"arp", ethertype=0x0806)] * 5,
    [made.ethernet(made.ipv4(b"tcp", protocol=6))] * 5,
    [
        made.ethernet(
            struct.pack(">HH", 5, 0x0800) + made.ipv4(made.udp(b"tagged")), ethertype=0x8100
        )
    ]
    * 20,
    [made.ethernet(made.ipv6(made.udp(b"six")), ethertype=0x86DD)] * 20,
    [made.ethernet(made.ipv4(made.udp(b"options"), options=bytes(8)))] * 20,
    [frame(b"cut short")[:-3]] * 3,
    [frame(b"padded") + bytes(9)] * 20,
    [part for ident in range(6) for part in fragments(bytes([ident]) * 150, ident)],
)


def test_a_stream_comes_in_few_batches() -> None:
    capture = made.pcap(*stream(1000))
    found, _ = check(capture)
    assert len(found) == 1000
    assert len(list(CaptureBatches(io.BytesIO(capture)).batches())) < 10


@pytest.mark.parametrize("sizes", [[47], [47, 9, 130]], ids=["one size", "sizes"])
def test_a_byte_stream_in_batches_equals_single_packets(sizes: list[int]) -> None:
    packets = [bytes([index & 0xFF]) * sizes[index // 40 % len(sizes)] for index in range(900)]
    records = [
        made.record(data, seconds=made.SECONDS + index // 9) for index, data in enumerate(packets)
    ]
    # These records are truncated, and the file says so.
    records[300:305] = [made.record(bytes(47), original=90)] * 5
    capture = made.pcap_head(link=USER_LINKS[0], snap_length=47) + b"".join(records)
    found, stats = in_batches(io.BytesIO(capture), StreamBatches)
    assert (found, stats) == one_by_one(io.BytesIO(capture), StreamReader)
    assert [data for data, _, _ in found[:300]] == packets[:300]
    assert (len(found), getattr(stats, "snapped", None)) == (900, 5)
    batches = list(StreamBatches(io.BytesIO(capture)).batches())
    assert len(batches) < 10
    assert b"".join(batch.joined for batch in batches) == b"".join(data for data, _, _ in found)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("magic", [0xA1B2C3D4, 0xA1B23C4D])
def test_pcap_of_either_order_and_unit(order: str, magic: int) -> None:
    records = [
        made.record(each, order, seconds=made.SECONDS + index // 100)
        for index, each in enumerate(MIXED)
    ]
    found, stats = check(made.pcap_head(order, magic=magic) + b"".join(records))
    assert len(found) == 300 + 80 + 40 + 20 * 4 + 6
    assert getattr(stats, "snapped", None) == 0  # all kept as many bytes as the records say


OPTIONS = {
    "us": b"",
    "ns": made.option(9, b"\x09"),
    "s": made.option(9, b"\x00"),
    "2^-20": made.option(9, b"\x94"),
    "2^-127": made.option(9, b"\xff"),
    "offset": made.option(9, b"\x09") + made.option(14, struct.pack("<q", 5)),
    "far offset": made.option(14, struct.pack("<q", 1 << 62)),
}


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("kind", [made.ENHANCED, made.OBSOLETE, made.SIMPLE])
def test_pcapng_of_all_kinds_of_blocks_and_times(options: str, kind: int) -> None:
    ticks = [3_000_000_007 + index * 1_000_003 for index in range(len(MIXED))]
    ticks[50:60] = [(1 << 64) - 1 - index for index in range(10)]
    ticks[70:80] = [(1 << 62) + index for index in range(10)]
    packets = [
        made.packet(each, kind=kind, ticks=at) for each, at in zip(MIXED, ticks, strict=True)
    ]
    check(made.section() + made.interface(options=OPTIONS[options]) + b"".join(packets))


def test_sections_interfaces_and_damage_between_packets() -> None:
    packets = [made.packet(each, ticks=index) for index, each in enumerate(stream(400))]
    other = [
        made.packet(each[14:], ">", ticks=index, number=1) for index, each in enumerate(stream(200))
    ]
    packets[100:100] = [
        made.interface(link=101),
        made.packet(stream(1)[0][14:], number=1),
        made.packet(stream(1)[0], number=7),
    ]
    packets[200:200] = [
        made.block(0x0BAD, bytes(40)),
        made.block(6, bytes(8)),
        made.packet(stream(1)[0], captured=9999),
    ]
    packets[300] = packets[300][:-4] + struct.pack("<I", len(packets[300]) + 4)
    second = [made.section(">"), made.interface(">"), made.interface(">", link=101), *other]
    third = [made.section(), made.interface(options=made.option(9, b"\x09")), *packets[:50]]
    found, stats = check(b"".join([made.section(), made.interface(), *packets, *second, *third]))
    assert len(found) == 399 + 1 + 200 + 50
    assert getattr(stats, "malformed", None) == 4


def test_a_packet_before_its_interface_is_malformed_however_many_follow() -> None:
    packets = [made.packet(each, ticks=index) for index, each in enumerate(stream(60, 8))]
    found, stats = check(b"".join([made.section(), packets[0], made.interface(), *packets[1:]]))
    assert (len(found), getattr(stats, "malformed", None)) == (59, 1)


@pytest.mark.parametrize("link", [1, 101, 113, 276, 0, 12, 228, 108, 9, 147])
def test_link_layers(link: int) -> None:
    heads = {
        113: bytes(14) + b"\x08\x00",
        276: b"\x08\x00" + bytes(18),
        0: struct.pack("<I", 2),
        108: struct.pack(">I", 2),
        1: bytes(12) + b"\x08\x00",
    }
    frames = [heads.get(link, b"") + each[14:] for each in stream(200)]
    found, _ = check(made.pcap_head(link=link) + b"".join(map(made.record, frames)))
    assert len(found) == (0 if link in (9, 147) else 200)


def test_more_senders_than_are_remembered() -> None:
    capture = made.pcap(*interleave(*(stream(20, 60 + host % 7, host=host) for host in range(100))))
    found, _ = check(capture)
    assert len({source for _, _, source in found}) == 100


def test_an_ipv4_fragment_does_not_match_the_previous_kind() -> None:
    frames = stream(50, 104)
    frames[25] = frames[25][:20] + b"\x20\x00" + frames[25][22:]
    found, stats = check(made.pcap(*frames))
    assert len(found) == 49
    assert getattr(stats, "incomplete_fragments", None) == 1


def test_records_longer_than_the_first_buffer_and_files_longer_than_the_largest() -> None:
    long = [frame(bytes([index]) * 60_000) for index in range(3)]
    check(made.pcap(*stream(3), *long, *stream(2200, 1248), *long))
    block = made.block(0x0BAD, bytes(900_000))
    check(
        made.section()
        + made.interface()
        + b"".join(block + made.packet(each) for each in stream(4))
    )
    passed_over = made.block(0x0BAD, bytes(3_000_000))
    check(
        made.section()
        + made.interface()
        + b"".join(passed_over + made.packet(each) for each in stream(4))
    )


def parts(form: str, number: int) -> list[bytes]:
    """Return the records of a capture in which fragments interrupt a stream, after the head of the
    file.
    """
    frames = [*stream(number, 8), *fragments(bytes(60), 1), *stream(number, 8)]
    if form == "pcap":
        return [made.pcap_head(), *map(made.record, frames)]
    return [
        made.section(),
        made.interface(),
        *(made.packet(each, ticks=at) for at, each in enumerate(frames)),
    ]


FORMS = ["pcap", "pcapng"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("number", [3, pytest.param(12, marks=pytest.mark.slow)])
def test_truncated_at_every_byte(form: str, number: int) -> None:
    records = parts(form, number)
    capture = b"".join(records)
    ends = set(accumulate(map(len, records)))
    for length in range(4, len(capture)):
        _, stats = check(capture[:length])
        assert getattr(stats, "truncated_tail", None) == (length not in ends)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("inputs", [200, pytest.param(1000, marks=pytest.mark.slow)])
def test_mutations_give_the_same_as_one_by_one(form: str, inputs: int) -> None:
    draw = random.Random(16)
    capture = b"".join(parts(form, 10))
    outcomes = set()
    for _ in range(inputs):
        data = bytearray(capture)
        for _ in range(draw.randint(1, 5)):
            at = draw.randrange(4, len(data))
            edit = draw.randrange(4)
            if edit == 0:
                data[at] ^= 1 << draw.randrange(8)
            elif edit == 1:
                data[at : at + 4] = draw.choice(
                    [bytes(4), b"\xff" * 4, b"\0\0\0\x80", b"\x04\0\0\0"]
                )
            elif edit == 2:
                del data[at : at + draw.randint(1, 9)]
            else:
                data[at:at] = data[at : at + draw.randint(1, 90)]
        try:
            expected = one_by_one(io.BytesIO(bytes(data)))
        except ls.LidarSpecError:
            continue
        assert in_batches(io.BytesIO(bytes(data))) == expected
        outcomes.add((len(expected[0]), str(expected[1])))
    assert len(outcomes) > 50


class Pieces(io.RawIOBase):
    """A file that gives a few bytes at a time."""

    def __init__(self, data: bytes, seed: int) -> None:
        self._data, self._draw = memoryview(data), random.Random(seed)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: object) -> int:
        target = memoryview(buffer).cast("B")  # type: ignore[arg-type]
        size = min(len(target), len(self._data), self._draw.choice([1, 7, 150, 4000]))
        target[:size], self._data = self._data[:size], self._data[size:]
        return size


@pytest.mark.parametrize("seed", range(4))
def test_gaps_are_equal_for_every_way_of_reading(seed: int) -> None:
    capture = made.pcap(*MIXED)
    assert in_batches(Pieces(capture, seed)) == one_by_one(io.BytesIO(capture))  # type: ignore[arg-type]


def test_packets_of_a_pipe_come_as_soon_as_they_are_whole() -> None:
    reading, writing = os.pipe()
    with open(reading, "rb") as source, open(writing, "wb", 0) as sink:
        sink.write(made.section() + made.interface() + made.packet(frame(b"one")))
        batches = CaptureBatches(source).batches()
        assert rows(next(batches))[0][0] == b"one"
        sink.write(made.packet(frame(b"two")) + b"tail")
        assert rows(next(batches))[0][0] == b"two"
        sink.close()
        assert not list(batches)


@pytest.mark.parametrize(
    "path",
    sorted(made.CAPTURES.rglob("*.pcap*")) or [None],
    ids=lambda path: path and path.parent.name,
)
def test_real_captures(path: Path | None) -> None:
    if path is None:
        pytest.skip(f"no captures in {made.CAPTURES} (set LIDARSPEC_CAPTURES)")
    found = in_batches(path)
    assert found[0]
    assert found == one_by_one(path)


@pytest.fixture(scope="module")
def long_capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("captures") / "long.pcap"
    path.write_bytes(made.pcap_head() + b"".join(map(made.record, stream(4000, 1248))) * 6)
    return path


def address(batch: CapturedDatagrams) -> int:
    return int(batch.buffer.__array_interface__["data"][0])


def test_unreferenced_buffers_are_reused(
    long_capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CaptureBatches, "max_buffer_bytes", 1 << 21)
    places = [address(batch) for batch in CaptureBatches(long_capture).batches()]
    assert len(places) > 12
    assert len(set(places)) <= 3


def test_a_finished_reader_releases_its_buffers(long_capture: Path) -> None:
    gc.disable()
    try:
        reader = CaptureBatches(long_capture)
        assert sum(map(len, reader.batches())) > 1000
        done = weakref.ref(reader)
        del reader
        assert done() is None
    finally:
        gc.enable()


@pytest.mark.parametrize(
    "hold",
    [
        lambda batch: batch.buffer,
        lambda batch: batch.buffer[5:90],
        lambda batch: memoryview(batch.buffer),
    ],
)
def test_whoever_holds_a_view_of_a_buffer_keeps_it(
    hold: Callable[[CapturedDatagrams], object], long_capture: Path
) -> None:
    held, copies, places = [], [], []
    for batch in CaptureBatches(long_capture).batches():
        held.append(hold(batch))
        copies.append(np.array(held[-1], copy=True))
        places.append(address(batch))
        assert not batch.buffer.flags.writeable
    assert len(set(places)) == len(places)
    assert all(
        np.array_equal(np.asarray(view), copy) for view, copy in zip(held, copies, strict=True)
    )


def test_packets_of_a_file_stay_right_while_the_file_is_read_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CaptureBatches, "max_buffer_bytes", 1 << 21)
    from tests.captures.test_memory import SENSOR, write_repeated_capture

    path = tmp_path / "kept.pcap"
    write_repeated_capture(path, 12)
    with CaptureReader(path) as reader:
        data = [datagram.data for datagram in reader]
    with ls.open(path, SENSOR) as device:
        kept = list(device.packets())
    assert len(kept) > 3
    whole = ls.sensor(SENSOR).decode(data)
    assert np.array_equal(np.concatenate([packets.raw for packets in kept]), whole.raw)
    with ls.open(path, SENSOR) as device:
        scans = list(device.scans())
    assert np.array_equal(
        np.concatenate([scan.points.x for scan in scans]), whole.points().x, equal_nan=True
    )


def test_one_sender_of_several(tmp_path: Path) -> None:
    path = tmp_path / "two.pcap"
    path.write_bytes(
        made.pcap(*interleave(stream(50), stream(30, host=202), stream(20, port=9000)))
    )
    opened = open_file(str(path), sender="192.168.1.201")
    assert isinstance(opened, CaptureTransport)
    assert sum(map(len, opened.batches())) == 70
    assert opened.foreign == 30
    opened.close()
    batch = next(CaptureBatches(path).batches())
    assert dict(zip(batch.names, np.bincount(batch.senders).tolist(), strict=True)) == {
        ("192.168.1.201", 2368): 50,
        ("192.168.1.202", 2368): 30,
        ("192.168.1.201", 9000): 20,
    }


@pytest.mark.parametrize("other", [("10.0.0.2", 6699), ("10.0.0.1", 6700)], ids=["address", "port"])
def test_frames_of_two_senders_are_not_mixed(other: tuple[str, int], tmp_path: Path) -> None:
    path = tmp_path / "two.pcap"
    with path.open("wb") as file:
        file.write(make_capture_head(ETHERNET))
        for index, data in enumerate(simulate(ls.sensor("robosense-m1"), 40)):
            file.write(
                make_datagram_record(
                    Datagram(
                        data, index, other if index % 2 else ("10.0.0.1", 6699), made.DESTINATION
                    )
                )
            )
    one, two = ("10.0.0.1", "10.0.0.2") if other[1] == 6699 else ("10.0.0.1:6699", "10.0.0.1:6700")
    said = "({0} and {1}|{1} and {0}).*src=({0}|{1})".format(re.escape(one), re.escape(two))
    with ls.open(path, "robosense-m1") as device, pytest.raises(ls.UsageError, match=said):
        list(device.packets())
    with ls.open(f"{path}?src={two}", "robosense-m1") as device:
        assert sum(map(len, device.packets())) == 20
        assert device.stats.foreign == 20


@pytest.mark.parametrize("batch_bytes", [0, 1300])
def test_datagrams_of_other_devices_are_reported_once(batch_bytes: int, tmp_path: Path) -> None:
    sensor = ls.sensor("velodyne-vlp16")
    mine = [(data, ("10.0.0.1", 2368)) for data in simulate(sensor, 40)]
    others = [(data, ("10.0.0.2", 2368)) for data in simulate(ls.sensor("hesai-xt32"), 30)]
    sent = [mine[0], (b"\x00" * 48, ("10.0.0.3", 123)), *mine[1:], *others]
    capture, recording = tmp_path / "two.pcap", tmp_path / "two.lsr"
    records = [
        make_datagram_record(Datagram(data, index, sender, made.DESTINATION))
        for index, (data, sender) in enumerate(sent)
    ]
    capture.write_bytes(make_capture_head(ETHERNET) + b"".join(records))
    with ls.Recorder(recording, sensor) as recorder:
        for index, (data, sender) in enumerate(sent):
            recorder.write(Chunk(data, index, sender))
    for path in (capture, recording):
        with ls.open(path, sensor) as device:
            device.read_ahead(batch_bytes)
            assert sum(map(len, device.packets())) == 40
            assert [text for text in device.warnings if "other devices" in text] == [
                f"{path}: datagrams from other devices than 10.0.0.1, most of them from 10.0.0.2,"
                " contain no frames of velodyne-vlp16; next: repeat with"
                f" '{path}?src=10.0.0.1' to leave them out"
            ]
        with ls.open(f"{path}?src=10.0.0.1", sensor) as device:
            assert sum(map(len, device.packets())) == 40
            assert not any("other devices" in text for text in device.warnings)
            assert device.stats.bytes_skipped == 0


def test_a_calibration_of_another_address_is_not_mixed_in(tmp_path: Path) -> None:
    sensor, path = SHAPES["shape-datagrams"], tmp_path / "two.pcap"
    sent = [
        (turning(sensor, 1)[0], "10.0.0.1"),
        (sensor.build("info", elevation=[1, 2, 3]), "10.0.0.2"),
    ]
    data = [
        make_datagram_record(Datagram(frame, 0, (host, 7001), made.DESTINATION))
        for frame, host in sent
    ]
    path.write_bytes(make_capture_head(ETHERNET) + b"".join(data))
    with (
        ls.open(path, sensor) as device,
        pytest.raises(ls.UsageError, match=r"10\.0\.0\.1 and 10\.0\.0\.2 both send frames"),
    ):
        list(device.packets())
    with ls.open(f"{path}?src=10.0.0.1", sensor) as device:
        assert sum(map(len, device.packets())) == 1


HUGE = struct.pack("<I", 0x7FFFFFFC)
HOSTILE = {
    "pcapng of 12 bytes": b"\x0a\x0d\x0d\x0a" + HUGE + b"\x4d\x3c\x2b\x1a",
    "pcapng block": made.section() + made.interface() + struct.pack("<I", 6) + HUGE + bytes(4),
    "pcap record": made.pcap_head() + bytes(8) + HUGE + HUGE,
    "pcap record within the limit": made.pcap_head()
    + bytes(8)
    + struct.pack("<II", 1 << 18, 1 << 18),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_declared_lengths_allocate_no_memory(case: str, tmp_path: Path) -> None:
    path = tmp_path / "hostile"
    path.write_bytes(HOSTILE[case])
    assert peak_memory(path) < 400_000


def test_a_long_block_takes_bounded_memory() -> None:
    capture = made.section() + made.interface() + made.block(0x0BAD, bytes(40 << 20))
    assert peak_memory(io.BytesIO(capture)) < 24 << 20


@pytest.mark.slow
def test_many_senders_and_empty_records_take_bounded_memory() -> None:
    assert peak_memory(io.BytesIO(made.pcap_head() + bytes(16) * 60_000)) < 7 << 20
    assert (
        peak_memory(
            io.BytesIO(made.pcap(*(frame(b"", ident=index, port=index) for index in range(6_000))))
        )
        < 7 << 20
    )


def peak_memory(file: BinaryIO | Path) -> int:
    tracemalloc.start()
    try:
        for _ in CaptureBatches(file).batches():
            pass
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_trickling_input_is_read_whole() -> None:
    reading, writing = os.pipe()
    capture = made.pcap(*stream(4, 20))

    def trickle() -> None:
        with open(writing, "wb", 0) as sink:
            for byte in capture:
                sink.write(bytes([byte]))

    thread = threading.Thread(target=trickle)
    thread.start()
    with open(reading, "rb", 0) as source:
        assert in_batches(source) == one_by_one(io.BytesIO(capture))
    thread.join()


def test_a_section_among_blocks_of_its_own_length_is_seen() -> None:
    packets = [made.packet(each, ticks=at) for at, each in enumerate(stream(40))]
    options = bytes(len(packets[0]) - len(made.section()))
    section = made.block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1) + options)
    assert len(section) == len(packets[0])
    found, stats = check(
        made.section() + made.interface() + b"".join([*packets, section, *packets])
    )
    assert (len(found), getattr(stats, "malformed", None)) == (40, 40)
