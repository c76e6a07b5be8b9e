"""Tests that tshark opens our captures without warnings and shows their content."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

import lidarspec
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import CaptureStats, Datagram, StreamReader, make_datagram_frame
from lidarspec.captures.records import WRITINGS
from lidarspec.recording.recorders import FrameRecorder, open_recorder
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.protocol import Chunk
from tests.cli.running import ran
from tests.exports.sharks import columns, needs_tshark, tshark, write_dissector

SERIOUS = "_ws.malformed || _ws.expert || ip.checksum.status == 0 || udp.checksum.status == 0"
CHECKED = ("-o", "ip.check_checksum:TRUE", "-o", "udp.check_checksum:TRUE")


@needs_tshark
@pytest.mark.parametrize("suffix", WRITINGS)
def test_the_writer_s_captures(suffix: str, tmp_path: Path) -> None:
    draw, capture, writing = random.Random(1), tmp_path / f"it{suffix}", WRITINGS[suffix]
    sizes = [0, 1, 47, 1248, 65_507]
    with capture.open("wb") as file:
        file.write(writing.head(ETHERNET))
        for number, size in enumerate(sizes):
            at = 1_700_000_000_123_456_789 + number
            datagram = Datagram(
                draw.randbytes(size), at, ("192.0.2.1", 49_152 + number), ("192.0.2.2", 49_000)
            )
            file.write(writing.record(make_datagram_frame(datagram), at))
    fields = ["frame.time_epoch", "udp.length", "ip.src", "udp.dstport"]
    text = tshark(
        capture, "-T", "fields", *(option for name in fields for option in ("-e", name)), *CHECKED
    )
    times = [f"1700000000.{123_456_789 + number}" for number in range(len(sizes))]
    wanted = [
        [time, str(size + 8), "192.0.2.1", "49000"] for time, size in zip(times, sizes, strict=True)
    ]
    assert [line.split("\t") for line in text.splitlines()] == wanted
    assert not tshark(capture, "-Y", SERIOUS, *CHECKED)


@needs_tshark
@pytest.mark.parametrize(("name", "time"), [("velodyne-vlp16", "30ms"), ("ldrobot-stl27l", "20ms")])
def test_simulated_and_recorded_captures(name: str, time: str, tmp_path: Path) -> None:
    sensor, script = lidarspec.sensor(name), write_dissector(lidarspec.sensor(name), tmp_path)
    simulated, recorded, again = (
        tmp_path / "sim.pcap",
        tmp_path / "it.lsr",
        tmp_path / "again.pcapng",
    )
    ran("sim", name, "--to", simulated, "-t", time)
    ran("record", simulated, "-s", name, "-o", recorded)
    ran("record", recorded, "-o", again)
    for capture in (simulated, again):
        assert not tshark(capture, "-Y", SERIOUS, *CHECKED, scripts=[script])
        kinds = list(columns(capture, script, [f"{name.replace('-', '_')}.frame"]))
        assert kinds.count([[sensor.data_frame]]) > 10
        assert all(len(kind) == 1 for (kind,) in kinds)


def test_a_byte_stream_becomes_packets_of_frames_and_invalid_bytes(tmp_path: Path) -> None:
    sensor, capture = lidarspec.sensor("ldrobot-stl27l"), tmp_path / "it.pcap"
    frames = [sensor.example("data", seed=seed) for seed in range(4)]
    stream = b"\x01\x02" + frames[0] + frames[1] + b"\x54\x2c\x03" + frames[2] + frames[3][:30]
    for step in (1, 7, 1000):
        capture = capture.with_suffix(".pcapng" if step == 7 else ".pcap")
        with FrameRecorder(capture, sensor, overwrite=True) as out:
            for start in range(0, len(stream), step):
                out.write(Chunk(stream[start : start + step], 1000 + start))
            out.write(Chunk(b"never", 9), "out")
        with StreamReader(capture) as reader:
            packets = [packet.data for packet in reader]
        assert b"".join(packets) == stream
        assert [packet for packet in packets if packet in frames] == frames[:3]
        assert reader.stats == CaptureStats(packets=len(packets), datagrams=len(packets))
        opened = open_transport(capture)
        assert b"".join(chunk.data for chunk in opened.chunks()) == stream
        opened.close()


def test_a_long_gap_and_a_lost_line_are_kept(tmp_path: Path) -> None:
    sensor, capture = lidarspec.sensor("ldrobot-stl27l"), tmp_path / "it.pcap"
    frame = sensor.example("data")
    noise = bytes(200_000)
    with FrameRecorder(capture, sensor) as out:
        out.write(Chunk(noise + frame[:20], 1))
        out.write(Chunk(frame + frame, 2, gap=True))
    with StreamReader(capture) as reader:
        packets = [packet.data for packet in reader]
    assert b"".join(packets) == noise + frame[:20] + frame + frame
    assert packets[-2:] == [frame, frame]
    assert out.records == len(packets)
    assert out.bytes == sum(map(len, packets))


def test_a_byte_stream_without_a_sensor_has_no_frames(tmp_path: Path) -> None:
    with pytest.raises(lidarspec.UsageError, match="name the sensor"):
        open_recorder(tmp_path / "it.pcap", datagrams=False)
    assert isinstance(
        open_recorder(tmp_path / "it.pcap", "ldrobot-stl27l", datagrams=False), FrameRecorder
    )


def test_a_capture_of_a_byte_stream_is_read_like_the_stream(tmp_path: Path) -> None:
    raw, capture = tmp_path / "it.bin", tmp_path / "it.pcap"
    ran("sim", "ldrobot-stl27l", "--to", raw, "-t", "0.2s")
    ran("record", raw, "-s", "ldrobot-stl27l", "-o", capture)
    counted = []
    for path in (raw, capture):
        with lidarspec.open(path, "ldrobot-stl27l") as device:
            scans = list(device.scans())
            counted.append((len(scans), [len(scan) for scan in scans], device.stats.frames))
    assert counted[0] == counted[1]
    assert counted[0][2]["data"] > 100


def test_frames_of_a_captured_stream_have_the_times_of_their_packets(tmp_path: Path) -> None:
    capture = tmp_path / "it.pcap"
    ran("sim", "ldrobot-stl27l", "--to", capture, "-t", "0.2s")
    with StreamReader(capture) as reader:
        sent = [packet.at for packet in reader]
    assert len(set(sent)) > 10
    with lidarspec.open(capture, "ldrobot-stl27l") as device:
        assert np.concatenate([packets.host_ns for packets in device.packets()]).tolist() == sent
