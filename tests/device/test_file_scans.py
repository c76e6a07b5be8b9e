"""Tests that the parts of a file give the same scans as one pass, bit for bit."""

from __future__ import annotations

import itertools
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
import lidarspec.captures.bulk
import lidarspec.device.device_input
import lidarspec.transports.files
from lidarspec.captures.pcap import USER_LINKS, Datagram, make_datagram_record
from lidarspec.captures.records import make_capture_head, make_packet_record
from lidarspec.device.file_scans import FileScans
from lidarspec.errors import UsageError
from lidarspec.packets.reorder import WINDOW
from tests.made_captures import DESTINATION, SOURCE, pcap_head
from tests.shapes import SHAPES

#: they differ in what they remember between packets: look-ahead, an IMU, text, streams of
#: datagrams, modes of a header.
NAMES = [
    "shape-headed",
    "shape-inertia",
    "shape-lines",
    "shape-tokens",
    "ldrobot-stl27l",
    "velodyne-vlp16",
]
#: the same in more forms: data in parts, calibration in other frames, messages of several
#: datagrams.
MORE = [
    "shape-joined",
    "cepton-vista",
    "hesai-jt16",
    "hesai-pandar40p",
    "hokuyo-urg04lx",
    "hokuyo-utm30lxew",
    "livox-mid360",
    "ouster-os1",
    "robosense-bpearl",
    "robosense-m1",
    "seyond-falcon",
    "sick-multiscan136",
    "ti-iwr6843",
    "velodyne-hdl64e-s3",
    "ydlidar-g4",
]
#: whose bytes are tried in a capture.
CAPTURED = {"ydlidar-g4"}


def write_frames(sensor: ls.Sensor, path: Path, *, most: int = 120_000, longest: int = 900) -> None:
    """Write a file with lost, duplicate, late and damaged frames.

    Frames of all other types and noise are between them.
    """
    chance, frames = random.Random(3), list[bytes]()
    others = [sensor.example(name) for name, frame in sensor.incoming.items() if not frame.data]
    if sensor.state:  # a calibration that is not the nominal one, and another each time
        others = [
            frame[:300] + chance.randbytes(600) + frame[900:] for frame in others for _ in range(5)
        ]
    for frame in itertools.chain.from_iterable(
        ls.simulate(sensor, 500, start=start) for start in itertools.count(0, 500)
    ):
        what = chance.random()
        if what < 0.01:
            continue
        if what < 0.02:
            frames.insert(max(len(frames) - 1, 0), frame)
        frames.append(frame if what < 0.995 else frame[:-3] + chance.randbytes(3))
        if others and len(frames) % 37 == 5:
            frames.append(others[len(frames) // 37 % len(others)])
        if len(frames) >= longest or sum(map(len, frames[-50:])) * len(frames) / 50 > most:
            break
    if sensor.datagrams or path.suffix == ".pcap":
        times = itertools.count(1_700_000_000 * 10**9, 1_000_000)
        record = (
            (lambda frame, at: make_datagram_record(Datagram(frame, at, SOURCE, DESTINATION)))
            if sensor.datagrams
            else make_packet_record
        )
        head = pcap_head() if sensor.datagrams else make_capture_head(USER_LINKS[0])
        path.write_bytes(head + b"".join(map(record, frames, times)))
    else:
        path.write_bytes(
            b"".join(
                frame + chance.randbytes(chance.randrange(90) * (chance.random() < 0.01))
                for frame in frames
            )
        )


def pickle_scan(scan: ls.Scan) -> list[object]:
    """Return all values of a scan as bytes."""
    columns = [
        (name, np.ascontiguousarray(column).tobytes())
        for name, column in scan.points.columns.items()
    ]
    felt = (
        []
        if scan.imu is None
        else [scan.imu.time_ns.tobytes(), scan.imu.angular_velocity.tobytes()]
    )
    return [columns, felt, scan.stamp_ns, scan.complete, scan.whole, repr(scan.rate_hz)]


@pytest.mark.parametrize(
    "name", [*NAMES, *(pytest.param(name, marks=pytest.mark.slow) for name in MORE)]
)
def test_pieces_have_the_scans_of_one_pass(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, size in (
        (lidarspec.captures.bulk.CaptureBatches, "max_buffer_bytes"),
        (lidarspec.transports.files, "BLOCK_BYTES"),
    ):
        monkeypatch.setattr(module, size, 1 << 13)
    monkeypatch.setattr(lidarspec.device.device_input, "BATCH_BYTES", 1 << 13)
    sensor = SHAPES[name] if name in SHAPES else ls.sensor(name)
    path = tmp_path / ("made.pcap" if sensor.datagrams or name in CAPTURED else "made.bin")
    write_frames(sensor, path)
    with ls.open(path, sensor) as device:
        longest = max(len(packets.table.frame(0)) for packets in device.packets())
    with ls.open(path, sensor) as device:
        whole = [pickle_scan(scan) for scan in device.scans()]
    bookmark, pieces, sizes = None, list[list[object]](), list[int]()
    while True:
        with FileScans(path, sensor, bookmark) as piece:
            number, following = piece.survey(path.stat().st_size // 6)
        with FileScans(path, sensor, bookmark) as piece:
            pieces += [
                pickle_scan(scan)
                for scan in itertools.islice(piece, None if following is None else number)
            ]
        if following is None:
            break
        bookmark = following
        sizes.append(len(bookmark))
    assert len(pieces) == len(whole)
    assert pieces == whole
    assert len(sizes) >= 2
    # At the start of a stream and behind a gap, packets wait to be put in order.
    assert max(sizes) < 60_000 + WINDOW * longest, sizes


@pytest.mark.slow
def test_another_process_continues_at_a_bookmark(tmp_path: Path) -> None:
    name, path, mark = "velodyne-vlp16", tmp_path / "made.pcap", tmp_path / "mark"
    sensor = ls.sensor(name)
    write_frames(sensor, path, most=9_000_000)
    with FileScans(path, sensor) as piece:
        number, bookmark = piece.survey(1)
    assert bookmark is not None
    mark.write_bytes(bookmark)
    with ls.open(path, sensor) as device:
        stamps = [scan.stamp_ns for scan in itertools.islice(device.scans(), number, None)]
    code = (
        "import sys, lidarspec as ls; from pathlib import Path; from lidarspec.device.file_scans"
        " import FileScans;print([s.stamp_ns for s in FileScans(sys.argv[1],"
        " ls.sensor(sys.argv[2]), Path(sys.argv[3]).read_bytes())])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, path, name, mark], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(stamps)


def test_a_file_that_cannot_be_sought_is_one_piece(tmp_path: Path) -> None:
    sensor, path = ls.sensor("ldrobot-stl27l"), tmp_path / "made.hex"
    path.write_text(b"".join(ls.simulate(sensor, 400)).hex())
    with FileScans(path, sensor) as piece:
        number, bookmark = piece.survey(1)
    with ls.open(path, sensor) as device:
        assert number == sum(1 for _ in device.scans())
    assert bookmark is None
    with pytest.raises(UsageError, match="is not a file"):
        FileScans("sim:ldrobot-stl27l", sensor)
