"""Tests of recordings: truncated, damaged, interrupted, and on a full disk."""

from __future__ import annotations

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.errors import SourceError, UsageError, WireError
from lidarspec.recording import background_writer
from lidarspec.recording.format import (
    _HEAD,
    HEADER,
    MAGIC,
    MAX_DATA_BYTES,
    Header,
    Record,
    Recording,
    pack_record,
    read_header,
    size_at,
)
from lidarspec.recording.recorders import Recorder
from lidarspec.spec import Chunk
from lidarspec.transports.open_url import open_transport
from tests.evidence import capture
from tests.lines import until

STREAM, DATAGRAMS = "ldrobot-stl27l", "velodyne-hdl32e"
HDL32E = "velodyne/hdl32e/sample_velodyne_hdl32.pcap"
SENDER, RECEIVER = ("192.168.1.201", 2368), ("fe80::1%eth0", 65535)
CHUNKS = [
    Chunk(b"one", 1_700_000_000_000_000_000, SENDER, RECEIVER),
    Chunk(b"", 1, SENDER),
    Chunk(b"three" * 3, None, None, RECEIVER),
    Chunk(b"\xb5LS\x1e and \x89LSR", -5, gap=True),
]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "it.lsr"


def record(
    path: Path, chunks: list[Chunk], *, sensor: str | None = None, datagrams: bool | None = None
) -> Path:
    with Recorder(path, sensor, datagrams=datagrams) as recorder:
        for chunk in chunks:
            recorder.write(chunk)
    return path


def read(path: Path, *, salvage: bool = False) -> list[Record]:
    with Recording(path, salvage=salvage) as recording:
        return list(recording)


def as_records(chunks: list[Chunk], *, datagram: bool = True) -> list[Record]:
    return [
        Record("in", chunk.data, chunk.at, chunk.sender, chunk.receiver, datagram, chunk.gap)
        for chunk in chunks
    ]


def test_the_format_of_version_1_stays(path: Path) -> None:
    """Every later version must read this recording, computed by hand from the table."""
    header = bytes.fromhex("b54c531e 00 00 00 0200 0000000000000080") + b"{}"
    datagram = (
        bytes.fromhex("b54c531e 01 01 11 0200 15cd853dfe9c9717")  # a datagram, 17 bytes of address
        + b"\x0d192.168.1.200"
        + bytes.fromhex("2b1a 00 542c")  # port 6699, no receiver, two bytes of data
    )
    records = [body + zlib.crc32(body).to_bytes(4, "little") for body in (header, datagram)]
    path.write_bytes(b"\x89LSR\r\n\x1a\n" + b"".join(records))
    sender = ("192.168.1.200", 6699)
    assert read(path) == [
        Record("in", b"\x54\x2c", 1_700_000_000_123_456_789, sender, None, True, False)
    ]
    assert (
        pack_record(1, b"\x54\x2c", 1_700_000_000_123_456_789, flags=1, sender=sender)
        == (records[1])
    )


def test_written_records_are_read_back(path: Path) -> None:
    with Recorder(path, source="udp://:2368", datagrams=True) as recorder:
        for chunk in CHUNKS:
            recorder.write(chunk)
        recorder.write(Chunk(b"stop", 7), "out")
        recorder.event("disconnect", 9, reason="gone")
    found = read(path)
    assert found[:4] == as_records(CHUNKS)
    assert found[4] == Record("out", b"stop", 7, datagram=True)
    assert (found[5].direction, found[5].at, json.loads(found[5].data)) == (
        "event",
        9,
        {"event": "disconnect", "reason": "gone"},
    )
    assert (recorder.records, recorder.bytes, recorder.dropped) == (
        5,
        sum(len(chunk.data) for chunk in CHUNKS) + 4,
        0,
    )


def test_the_header_describes_the_source(path: Path) -> None:
    before = time.time_ns()
    sensor = ls.sensor(STREAM).configure(frame="vendor")
    with Recorder(path, sensor, "serial:///dev/ttyUSB0", baud=921600):
        pass
    with Recording(path) as recording:
        header = recording.header
    assert (header.sensor, header.options, header.source, header.baud) == (
        STREAM,
        {"frame": "vendor"},
        "serial:///dev/ttyUSB0",
        921600,
    )
    assert header.versions == {
        "lidarspec": ls.__version__,
        "lidarspec-ldrobot": header.versions["lidarspec-ldrobot"],
    }
    assert before <= header.wall_ns <= time.time_ns()
    assert not header.datagrams
    assert header.known_sensor(path.parent).options == {"frame": "vendor"}


def test_long_reads_become_several_records(path: Path) -> None:
    data = random.Random(1).randbytes(3 * MAX_DATA_BYTES + 1)
    found = read(record(path, [Chunk(data, 5, gap=True)]))
    assert [len(item.data) for item in found] == [MAX_DATA_BYTES, MAX_DATA_BYTES, MAX_DATA_BYTES, 1]
    assert b"".join(item.data for item in found) == data
    assert [item.gap for item in found] == [True, False, False, False]


def test_cut_at_every_byte_all_whole_records_come_back(path: Path) -> None:
    whole = record(path, CHUNKS, datagrams=True).read_bytes()
    ends = [0]
    with Recording(path) as recording:
        first = recording.offset
        ends = [first] + [recording.offset for _ in recording]
    assert ends[-1] == len(whole)
    cut = path.with_name("cut.lsr")
    for size in range(len(whole)):
        cut.write_bytes(whole[:size])
        if size < first:
            with pytest.raises((SourceError, WireError)):
                read(cut)
            continue
        number = sum(end <= size for end in ends) - 1
        with Recording(cut) as recording:
            assert list(recording) == as_records(CHUNKS[:number])
            assert (recording.leftover, recording.offset) == (size - ends[number], ends[number])


def test_one_damaged_byte_costs_one_record(path: Path) -> None:
    whole = record(path, CHUNKS, datagrams=True).read_bytes()
    with Recording(path) as recording:
        ends = [recording.offset] + [recording.offset for _ in recording]
    damaged = path.with_name("damaged.lsr")
    for place in range(ends[0], len(whole)):
        damaged.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        hit = sum(end <= place for end in ends) - 1
        with Recording(damaged) as recording:
            assert list(recording) == as_records(CHUNKS[:hit])
            assert recording.leftover == len(whole) - ends[hit]
        with Recording(damaged, salvage=True) as recording:
            assert list(recording) == as_records(CHUNKS[:hit] + CHUNKS[hit + 1 :])
            assert recording.leftover == ends[hit + 1] - ends[hit]


def test_records_behind_a_damaged_header_can_be_salvaged(path: Path) -> None:
    whole = bytearray(record(path, CHUNKS, datagrams=True).read_bytes())
    whole[40] ^= 1
    path.write_bytes(whole)
    with pytest.raises(WireError, match="header"):
        Recording(path)
    assert read(path, salvage=True) == as_records(CHUNKS)


def test_a_kind_of_record_from_the_future_is_passed_over(path: Path) -> None:
    record(path, CHUNKS, datagrams=True)
    with path.open("ab") as file:
        file.write(pack_record(9, b"what may come", 1) + pack_record(1, b"after", 2))
    assert [item.data for item in read(path)][-1] == b"after"
    path.write_bytes(MAGIC + pack_record(HEADER, b'{"version": 2}'))
    with pytest.raises(SourceError, match="format 2"):
        Recording(path)


@pytest.mark.parametrize("salvage", [False, True])
def test_hostile_files_cost_neither_memory_nor_exceptions(path: Path, *, salvage: bool) -> None:
    source = random.Random(3)
    header = MAGIC + pack_record(HEADER, b"{}")
    claims = _HEAD.pack(b"\xb5LS\x1e", 1, 0, 255, 65535, 0)
    # The address is longer than its field.
    checksummed = _HEAD.pack(b"\xb5LS\x1e", 1, 0, 4, 0, 0) + b"\x09\x00\x00\x00"
    checksummed += zlib.crc32(checksummed).to_bytes(4, "little")
    for tail in (
        claims,
        claims * 300,
        checksummed * 3,
        MAGIC,
        source.randbytes(100_000),
        b"\xb5" * 1000,
        b"\xb5LS\x1e" * 1000,
    ):
        path.write_bytes(header + tail)
        tracemalloc.start()
        with Recording(path, salvage=salvage) as recording:
            assert not list(recording)
            assert recording.leftover == len(tail)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 500_000


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[" * 60_000,
        b"[]",
        b'{"sensor": 1}',
        b'{"baud": true}',
        b'{"options": []}',
        b'{"datagrams": 1}',
        b"\xff",
    ],
    ids=["empty", "deep", "list", "sensor", "baud", "options", "datagrams", "bytes"],
)
def test_hostile_headers_are_refused(text: bytes) -> None:
    with pytest.raises(WireError, match="header"):
        read_header(text)


@pytest.mark.parametrize(
    "text",
    [
        '{"sensor": "./evil.py"}',
        '{"sensor": "a.py:x"}',
        '{"sensor": "' + STREAM + '", "options": {"calibration": "/etc/passwd"}}',
        "{}",
    ],
)
def test_a_header_opens_no_file(text: str) -> None:
    with pytest.raises(UsageError):
        read_header(text.encode()).known_sensor(Path())


def test_nothing_is_overwritten_without_permission(path: Path) -> None:
    path.write_bytes(b"precious")
    with pytest.raises(UsageError, match="already exists"):
        Recorder(path)
    assert path.read_bytes() == b"precious"


def test_an_old_file_stays_until_the_new_one_has_its_first_record(path: Path) -> None:
    path.write_bytes(b"precious")
    link = path.with_name("link.lsr")
    link.symlink_to(path)
    with Recorder(link, overwrite=True) as recorder:
        recorder.event("disconnect")
        recorder.sync()
        assert path.read_bytes() == b"precious"
    assert (path.read_bytes(), sorted(path.parent.iterdir())) == (b"precious", sorted([path, link]))
    with Recorder(link, overwrite=True) as recorder:
        recorder.write(Chunk(b"new"))
        recorder.sync()
        assert [item.data for item in read(path)] == [b"new"]
    assert link.is_symlink()
    assert sorted(path.parent.iterdir()) == sorted([path, link])


def test_an_old_file_survives_a_full_disk(path: Path) -> None:
    path.write_bytes(b"precious")
    with (
        file_size_limit(600),
        pytest.raises(SourceError, match="; the existing content is unchanged"),
        Recorder(path, overwrite=True) as recorder,
    ):
        recorder.write(Chunk(bytes(10_000)))
    assert (path.read_bytes(), list(path.parent.iterdir())) == (b"precious", [path])


def test_records_are_flushed_regularly_and_on_sync(path: Path) -> None:
    with Recorder(path) as recorder:
        recorder.write(Chunk(b"soon"))
        until(lambda: read(path))
        assert [item.data for item in read(path)] == [b"soon"]
        recorder.write(Chunk(b"now"))
        recorder.sync()
        assert [item.data for item in read(path)] == [b"soon", b"now"]


def test_several_threads_may_write(path: Path) -> None:
    with Recorder(path) as recorder:
        threads = [
            threading.Thread(target=lambda: [recorder.write(Chunk(b"x" * 99)) for _ in range(500)])
            for _ in range(8)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(read(path)) == recorder.records == 4000


WRITER = """
import os, sys
from lidarspec.spec import Chunk
from lidarspec.recording.recorders import Recorder

recorder = Recorder(sys.argv[1])
for number in range(10**9):
    recorder.write(Chunk(b"%d" % number + bytes(number % 1500), number))
    if number % 50 == 49:
        recorder.sync()
        os.write(1, b"%d\\n" % number)
"""


def kill_recorder(path: Path, after: float) -> int:
    """Kill a recorder; return the last number that it acknowledged."""
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        time.sleep(after)
        child.send_signal(signal.SIGKILL)
        lines = child.stdout.read().splitlines()
    return int(lines[-1]) if lines else 49


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
@pytest.mark.parametrize(
    "times", [1, pytest.param(5, marks=pytest.mark.slow), pytest.param(100, marks=pytest.mark.soak)]
)
def test_kill_9_loses_no_acknowledged_record(tmp_path: Path, times: int) -> None:
    source = random.Random(times)
    for attempt in range(times):
        path = tmp_path / f"{attempt}.lsr"
        last = kill_recorder(path, source.uniform(0, 0.1))
        with Recording(path) as recording:
            numbers = [item.at for item in recording]
            assert numbers == list(range(len(numbers)))
            assert len(numbers) > last
            assert recording.leftover <= MAX_DATA_BYTES


@contextlib.contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    resource = pytest.importorskip("resource", reason="needs a limit on the size of files")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def fill(path: Path) -> None:
    """Record more data than the disk can hold.

    The capture continues, one error is raised, and the file stays whole.
    """
    recorder = Recorder(path)
    for number in range(200):
        recorder.write(Chunk(bytes([number]) * 1000, number))
        time.sleep(0.001)
    with pytest.raises(SourceError, match=r"complete up to byte \d+"):
        recorder.sync()
    for number in range(10):
        recorder.write(Chunk(b"more", number))
    assert recorder.dropped >= 10
    recorder.close()
    with Recording(path) as recording:
        found = list(recording)
        assert recording.leftover == 0
    assert [item.at for item in found] == list(range(len(found)))
    assert all(item.data == bytes([item.at or 0]) * 1000 for item in found)
    assert 0 < len(found) < 200
    assert f"byte {path.stat().st_size}" in str(recorder.error)


def test_a_file_that_may_not_grow_is_whole_to_its_last_record(path: Path) -> None:
    with file_size_limit(100_777):
        fill(path)
    assert path.stat().st_size > 100_777 - 1100


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root may mount a small disk"
)
def test_a_full_disk_is_reported_once_and_the_file_is_intact(tmp_path: Path) -> None:
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=100k", "tmpfs", tmp_path],
        capture_output=True,
        check=False,
    )
    if made.returncode:
        pytest.skip(f"no disk can be mounted here: {made.stderr.decode().strip()}")
    try:
        fill(tmp_path / "full.lsr")
    finally:
        subprocess.run(["umount", "-l", tmp_path], check=True)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_a_recording_that_cannot_even_begin_says_so() -> None:
    with pytest.raises(SourceError, match=r"/dev/full: No space left"):
        Recorder("/dev/full", overwrite=True)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a named pipe")
def test_a_slow_disk_does_not_block_writers(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(background_writer, "MAX_WAITING_BYTES", 300_000)
    os.mkfifo(path)
    taken = bytearray()
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb", 0) as slow:
        recorder = Recorder(path, overwrite=True)
        for number in range(1000):
            recorder.write(Chunk(bytes(1000), number))
        assert recorder.dropped > 0
        assert recorder.records + recorder.dropped == 1000
        os.set_blocking(slow.fileno(), True)
        reader = threading.Thread(
            target=lambda: [taken.extend(block) for block in iter(lambda: slow.read(65536), b"")]
        )
        reader.start()
        recorder.sync()
        recorder.write(Chunk(b"again", 1000))
        recorder.close()
        reader.join()
    copy = path.with_name("copy.lsr")
    copy.write_bytes(taken)
    found = read(copy)
    events = [json.loads(item.data) for item in found if item.direction == "event"]
    assert {event["event"] for event in events} == {"dropped"}
    assert sum(event["records"] for event in events) == recorder.dropped
    assert found[-1].data == b"again"
    assert len(found) - len(events) == recorder.records


def frames(number: int) -> list[bytes]:
    return ls.simulate(ls.sensor(STREAM), number)


def test_a_recording_is_read_like_any_file(path: Path) -> None:
    one, two, three = frames(3)
    record(
        path,
        [Chunk(one + two[:20], 1_000), Chunk(two[20:], 2_000), Chunk(three, 3_000)],
        sensor=STREAM,
    )
    with ls.open(path) as device:
        assert device.sensor.id == STREAM
        batches = list(device.packets())
    raw = np.concatenate([packets.raw for packets in batches])
    assert raw.tobytes() == ls.sensor(STREAM).decode(one + two + three).raw.tobytes()
    arrivals = [at for packets in batches for at in packets.host_ns.tolist()]
    assert arrivals == [1_000, 2_000, 3_000]


@pytest.mark.parametrize("interruption", ["flag", "event"])
def test_no_frame_is_spliced_across_an_interruption(path: Path, interruption: str) -> None:
    one, two = frames(2)
    with Recorder(path, STREAM) as recorder:
        recorder.write(Chunk(one + two[:20], 1))
        if interruption == "event":
            recorder.event("disconnect")
        recorder.write(Chunk(two[20:] + one, 2, gap=interruption == "flag"))
    with ls.open(path) as device:
        assert sum(len(packets) for packets in device.packets()) == 2
        assert device.stats.bytes_skipped == len(two)
        assert device.stats.disconnects == (interruption == "event")


def test_recorded_commands_are_not_decoded(path: Path) -> None:
    one, two = frames(2)
    with Recorder(path, STREAM) as recorder:
        recorder.write(Chunk(one[:20], 1))
        recorder.write(Chunk(two, 2), "out")
        recorder.write(Chunk(one[20:], 3))
    with ls.open(path) as device:
        assert [len(packets) for packets in device.packets()] == [1]


def test_recorded_datagrams_decode_as_the_capture_does(path: Path) -> None:
    source = capture(HDL32E)
    with contextlib.closing(open_transport(source)) as opened:
        chunks = list(opened.chunks())
    record(path, chunks, sensor=DATAGRAMS)
    with ls.open(source, DATAGRAMS) as one, ls.open(path) as other:
        before, after = list(one.packets()), list(other.packets())
    assert sum(len(packets) for packets in before) == len(chunks)
    for column in ("raw", "time_ns"):
        expected, found = (
            np.concatenate([getattr(packets, column) for packets in batches])
            for batches in (before, after)
        )
        assert found.tobytes() == expected.tobytes()


def test_damage_of_a_recording_is_reported(path: Path) -> None:
    record(path, [Chunk(frame, 1) for frame in frames(3)], sensor=STREAM)
    with path.open("ab") as file:
        file.write(b"\xb5LS")
    with ls.open(path) as device:
        assert sum(len(packets) for packets in device.packets()) == 3
        assert device.warnings == [f"{path} is truncated in its last record: 3 bytes were not read"]


HESAI = "hesai-xt16"
ANGLES = "Channel,Elevation,Azimuth\n" + "".join(
    f"{channel},{16 - channel},0\n" for channel in range(1, 17)
)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (1, "calibration: 1 is not a file in"),
        ("1", "calibration: '1' is not a file in"),
        ("/dev/stdout", "is not a file in"),
        ("../angles.csv", "is not a file in"),
        ("link.csv", "is not a file in"),
        (
            ["angles.csv"],
            r"calibration: \['angles.csv'\] is not a file in",
        ),
        ("a\0b", "is not a file in"),
        ("here.csv", "is not a file in"),
    ],
)
def test_a_recording_opens_no_descriptor_and_no_file_elsewhere(
    path: Path, monkeypatch: pytest.MonkeyPatch, value: object, told: str
) -> None:
    folder, here = path.parent / "recordings", path.parent / "here"
    folder.mkdir()
    here.mkdir()
    for file in (path.parent / "angles.csv", here / "here.csv", here / "1"):
        file.write_text(ANGLES, encoding="utf-8")
    (folder / "link.csv").symlink_to(path.parent / "angles.csv")
    monkeypatch.chdir(here)
    with Recorder(folder / "a.lsr", ls.sensor(HESAI), "udp://") as recorder:
        recorder.write(Chunk(b"x", 1))
    data = (folder / "a.lsr").read_bytes()
    header = Header(sensor=HESAI, options={"calibration": value}, datagrams=True).to_json()
    (folder / "a.lsr").write_bytes(
        MAGIC + pack_record(0, header) + data[len(MAGIC) + size_at(data, len(MAGIC)) :]
    )
    with pytest.raises(
        UsageError, match=rf"a\.lsr: .*{told} .*Pass the options of .*-s {HESAI} -O "
    ):
        ls.open(folder / "a.lsr")


def test_a_file_beside_the_recording_is_taken(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (path.parent / "angles.csv").write_text(ANGLES, encoding="utf-8")
    monkeypatch.chdir(path.parent)
    with Recorder(path, ls.sensor(HESAI).configure(calibration="angles.csv"), "udp://") as recorder:
        recorder.write(Chunk(ls.sensor(HESAI).example("data"), 1))
    monkeypatch.chdir("/")
    with ls.open(path) as device:
        assert device.sensor.options["calibration"] == path.parent / "angles.csv"


NO_EVENTS = [
    b'{"event": ["disconnect"]}',
    b"[" * 60_000,
    b'{"event": {}}',
    b"[1]",
    b"3",
    b'"disconnect"',
    b"\xff",
    b"{}",
]


def test_an_invalid_event_is_damage_of_the_recording(path: Path) -> None:
    record(path, CHUNKS[:2])
    with path.open("ab") as file:
        file.write(b"".join(pack_record(3, event) for event in NO_EVENTS))
    with contextlib.closing(open_transport(path)) as opened:
        assert len(list(opened.chunks())) == 2
    assert opened.warnings == [f"{path}: {len(NO_EVENTS)} events without a name were ignored"]


KILLED = """
import os, sys
from lidarspec.recording.recorders import Recorder

recorder = Recorder(sys.argv[1], overwrite=True)
os.kill(os.getpid(), 9)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_files_of_a_killed_recorder_are_removed(path: Path) -> None:
    record(path, CHUNKS[:1])
    assert (
        subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False).returncode
        == -signal.SIGKILL
    )
    (left,) = (other for other in path.parent.iterdir() if other != path)
    assert read(path) == as_records(CHUNKS[:1], datagram=False)
    os.utime(left, (0, 0))
    with Recorder(path, overwrite=True) as recorder:
        recorder.write(CHUNKS[1])
    assert list(path.parent.iterdir()) == [path]
    assert read(path) == as_records(CHUNKS[1:2], datagram=False)
