"""Tests of `info`: the content of each kind of file, on one screen."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import Datagram, make_datagram_record
from lidarspec.captures.records import make_capture_head
from lidarspec.explaining import file_contents as looking
from lidarspec.recording.recorders import Recorder
from lidarspec.simulation.simulator import simulate
from lidarspec.transports.protocol import Chunk
from tests.cli.running import ran, run_json
from tests.made_captures import SIMPLE, frame, interface, packet, pcap, section

START, STEP = 1_700_000_000 * 10**9, 1_327_104


@pytest.fixture(scope="module")
def frames() -> list[bytes]:
    """Return three revolutions of a VLP-16 and some more packets, with one lost."""
    packets = simulate(ls.sensor("velodyne-vlp16"), 300)
    return packets[:150] + packets[151:]


@pytest.mark.slow
def test_a_capture_of_two_sensors_with_one_lost_packet(frames: list[bytes], tmp_path: Path) -> None:
    path, senders = tmp_path / "drive.pcap", [("10.0.0.1", 2368), ("10.0.0.2", 2368)]
    datagrams = [
        Datagram(data, START + number * STEP, sender, ("255.255.255.255", 2368))
        for number, data in enumerate(frames)
        for sender in senders[: 1 + (number < 200)]
    ]
    path.write_bytes(make_capture_head(ETHERNET) + b"".join(map(make_datagram_record, datagrams)))
    told = run_json("info", path)
    assert (told["kind"], told["size"], told["whole"]) == ("a capture", os.path.getsize(path), True)
    assert (told["packets"], told["bytes"], told["first_ns"]) == (499, 499 * 1206, START)
    assert told["seconds"] == pytest.approx(298 * STEP * 1e-9)
    assert [flow["packets"] for flow in told["flows"]] == [299, 200]
    assert told["flows"][0]["sender"] == "10.0.0.1:2368"
    for content, sender, lost in zip(told["contents"], senders, (1, 1), strict=True):
        assert content["sensors"] == ["velodyne-vlp16"]
        assert content["share"] == 1
        assert content["command"] == f"lidarspec view '{path}?src={sender[0]}' -s velodyne-vlp16"
        assert content["reading"]["loss_rate"] == pytest.approx(
            lost / (content["reading"]["packets"] + lost)
        )
        assert content["reading"]["speed_hz"] == pytest.approx(10, abs=0.1)
    text = ran("info", path).stdout
    assert "2023-11-14T22:13:20.000Z to 2023-11-14T22:13:20.395Z, 0.395 s" in text
    assert "sensor    velodyne-vlp16: 100.0% of the bytes are in valid frames" in text
    assert max(len(line) for line in text.replace(str(path), "drive.pcap").splitlines()) <= 80


@pytest.mark.slow
def test_of_a_long_recording_the_beginning_and_the_end_are_read(tmp_path: Path) -> None:
    path = tmp_path / "long.lsr"
    number, data = looking.MAX_BEGINNING_BYTES // 60_000 * 3, bytes(60_000)
    with Recorder(path, "ldrobot-stl27l", "/dev/ttyUSB0") as recorder:
        for place in range(number):
            recorder.wait_for_room()
            recorder.write(Chunk(data, START + place * 10**8))
    told = run_json("info", path)
    assert told["kind"] == "a recording"
    assert not told["whole"]
    assert told["bytes"] < os.path.getsize(path) / 2
    assert told["seconds"] == pytest.approx((number - 1) * 0.1)
    assert told["recorded"]["source"] == "/dev/ttyUSB0"
    assert told["contents"][0]["sensors"] == ["ldrobot-stl27l"]
    text = ran("info", path).stdout
    assert "named in the file" in text
    assert "only the beginning of this long file was counted" in text


@pytest.mark.slow
def test_a_capture_of_a_byte_stream_is_called_so(tmp_path: Path) -> None:
    ran("sim", "ldrobot-stl27l", "--to", tmp_path / "line.pcap", "-t", "1s")
    told = run_json("info", tmp_path / "line.pcap")
    assert (told["kind"], told["packets"]) == ("a capture of a byte stream", 1800)
    assert told["contents"][0]["sensors"] == ["ldrobot-stl27l"]


def test_the_longest_label_gives_the_width_of_the_column(tmp_path: Path) -> None:
    path = tmp_path / "a.pcap"
    sensor = ls.sensor("velodyne-vlp16")
    packets = [sensor.example("position"), *simulate(sensor, 20)]
    path.write_bytes(pcap(*map(frame, packets)))
    _, *lines = ran("info", path).stdout.splitlines()
    labels = [line[: len("  temperature")].strip() for line in lines]
    assert "temperature" in labels
    assert {"time", "from", "sensor", "clock", "next"} < set(labels)
    for line in lines:
        assert line[len("  temperature") :].startswith("  ")
        assert len(line) <= 80 or str(path) in line


def test_a_file_without_times_and_one_without_sensor(tmp_path: Path) -> None:
    raw, noise, empty = tmp_path / "raw.bin", tmp_path / "noise.bin", tmp_path / "empty.bin"
    raw.write_bytes(b"".join(simulate(ls.sensor("ldrobot-stl27l"), 100)))
    noise.write_bytes(bytes(range(256)) * 4)
    empty.write_bytes(b"")
    told = run_json("info", raw)
    assert (told["kind"], told["first_ns"], told["flows"][0]["sender"]) == (
        "raw bytes",
        None,
        None,
    )
    assert "no arrival times" in ran("info", raw).stdout
    assert "no installed sensor matches" in ran("info", noise, code=4).stdout
    ran("info", empty, code=4)


@pytest.mark.parametrize("name", ["empty.bin", "empty.lsr", "empty.pcap", "empty.hex"])
def test_of_an_empty_file_the_reason_is_printed(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.touch()
    assert ran("info", path, code=4).stderr == f"{path} contains no bytes\n"


def test_a_capture_without_times_has_no_date(tmp_path: Path) -> None:
    path = tmp_path / "simple.pcapng"
    frames = simulate(ls.sensor("velodyne-vlp16"), 9)
    packets = [packet(frame(data), kind=SIMPLE) for data in frames]
    path.write_bytes(b"".join([section(), interface(), *packets]))
    assert run_json("info", path)["first_ns"] is None
    text = ran("info", path).stdout
    assert "9 packets" in text
    assert "no arrival times" in text
