"""Tests of exposure, versions, direction and speed of an M1C1_Mini (manual 1, 2.1.3 and 2.2)."""

from __future__ import annotations

import csv
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.detect.identification import read_info
from lidarspec.simulation.device import SimulatedDevice

SENSOR = ls.sensor("cspc-m1c1-mini")
SECOND = 1_000_000_000
STEP = SECOND // 20
HIGH, LOW = 1, 2


def build_packet(exposures: list[int], **mt: Any) -> bytes:
    """Return a packet with one sample for each exposure, 10 degrees apart."""
    return SENSOR.build(
        "data",
        mt={"m": 0, "start": 0, **mt},
        lsn=len(exposures),
        fsa={"angle": 10 * 64},
        lsa={"angle": 10 * 64 * len(exposures)},
        samples=[{"distance": 1000, "intensity": 9, "exposure": code} for code in exposures],
    )


def build_info(**values: Any) -> bytes:
    """Return the device information of the manual (2.2.2), changed by `values`."""
    facts = {
        "model": b"M1C1_Mini\0\0\0",
        "zero_angle": 12,
        "direction": 0,
        "correction": 1,
        "reserved": bytes(3),
        "revision": 4,
    }
    return SENSOR.build("info", {**facts, **values})


def test_the_exposure_is_a_column_of_the_points() -> None:
    cloud = SENSOR.decode(build_packet([HIGH, LOW, LOW])).points()
    assert cloud.extra["exposure"].tolist() == [HIGH, LOW, LOW]
    assert cloud.extra["exposure"].dtype.kind == "u"
    assert cloud.to_structured()["exposure"].tolist() == [HIGH, LOW, LOW]


@pytest.mark.parametrize(
    ("sample", "distance", "intensity", "exposure"),
    [
        ("ff ff ff", 16383, 255, 3),
        ("01 00 80", 8192, 0, HIGH),  # 80 * 64
        ("02 04 00", 1, 0, LOW),  # 04 >> 2
        ("fd 03 00", 0, 255, HIGH),  # 3 * 64 + (fd >> 2)
        ("92 a1 0f", 1000, 100, LOW),
    ],
)
def test_the_bits_of_a_sample(sample: str, distance: int, intensity: int, exposure: int) -> None:
    """Distance (14 bits, mm) and intensity (8 bits) by the formulas of 2.2.3."""
    low, second, high = bytes.fromhex(sample)
    assert distance == high * 64 + (second >> 2)
    assert intensity == (second & 0x03) * 64 + (low >> 2)
    samples = [{"distance": distance, "intensity": intensity, "exposure": exposure}]
    angle = {"angle": 0}
    packet = SENSOR.build("data", mt={"m": 0, "start": 0}, fsa=angle, lsa=angle, samples=samples)
    assert packet[10:] == bytes.fromhex(sample)
    assert SENSOR.decode(packet)["samples.distance"].tolist() == [[distance / 1000]]


def test_the_checksum_by_the_rule_of_the_manual() -> None:
    """CS is the XOR of all words but itself; the first byte of a sample is a word with 00."""
    packet = build_packet([HIGH, LOW, HIGH])
    words = [packet[place : place + 2] for place in (0, 2, 4, 6)]
    for place in range(10, len(packet), 3):
        words += [packet[place : place + 1] + b"\0", packet[place + 1 : place + 3]]
    checksum = 0
    for word in reversed(words):  # the order does not matter
        checksum ^= int.from_bytes(word, "little")
    assert SENSOR.parse(packet).cs == checksum
    changed = packet[:12] + bytes([packet[12] ^ 1]) + packet[13:]
    with pytest.raises(ls.WireError) as caught:
        SENSOR.parse(changed)
    assert caught.value.path == "cs"


def test_the_exposure_is_written_to_csv(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(build_packet([HIGH, LOW]))
    command = f"{sys.executable} -m lidarspec convert a.bin a.csv -s {SENSOR.id}"
    subprocess.run(shlex.split(command), check=True, capture_output=True, cwd=tmp_path)
    rows = list(csv.DictReader((tmp_path / "a.csv").read_text().splitlines()))
    assert [float(row["exposure"]) for row in rows] == [HIGH, LOW]


def test_three_versions_are_reported() -> None:
    ack = bytes.fromhex("A5 5A 50 07 03 00 00 00 00 00 00 AB")  # manual 2.1.3
    stopped = bytes.fromhex("A5 5A 55 07 00 00 00 00 00 00 00 AD")
    normal = build_packet([LOW])
    after_start = build_packet([LOW], m=7)
    start = build_packet([LOW], m=55, start=1)
    stream = ack + build_info() + start + after_start + normal + stopped
    assert read_info(SENSOR, SENSOR.split(stream)) == {
        "model": "M1C1_Mini",
        "firmware": "V3.0",
        "revision": "Rev 4",
        "customer_firmware": "7",
    }
    assert SENSOR.decode(stream)["frequency"].tolist() == [5.5, 0, 0]


def test_the_direction_turns_the_angles() -> None:
    packet = build_packet([LOW, LOW])
    forward = SENSOR.decode(build_info() + packet).points()
    backward = SENSOR.decode(build_info(direction=1) + packet).points()
    np.testing.assert_allclose(backward.azimuth, -forward.azimuth, atol=1e-6)
    assert forward.y[1] < 0 < backward.y[1]  # 20 degrees less a correction of 11: to the right
    housing = SENSOR.configure(zero="housing").decode(build_info(direction=1) + packet).points()
    np.testing.assert_allclose(housing.azimuth, backward.azimuth - np.deg2rad(12), atol=1e-6)


class Running:
    """A simulated sensor that runs in virtual time."""

    def __init__(self) -> None:
        self.device = SimulatedDevice(SENSOR, seed=1)
        self.device.start(0)
        self.now = 0

    def send(self, command: str) -> None:
        self.device.receive(SENSOR.command(command), self.now)

    def read(self, seconds: float) -> bytes:
        """Return the bytes that the sensor sends in the next `seconds`."""
        end = self.now + round(seconds * SECOND)
        data = b""
        while self.now < end:
            self.now += STEP
            data += b"".join(sent for _, sent in self.device.outgoing(self.now))
        return data


def measure(data: bytes) -> tuple[list[float], list[int]]:
    """Return the speed and the exposure of each whole revolution."""
    scans = [scan for scan in SENSOR.scans(data) if scan.complete]
    packets = SENSOR.decode(data)
    speeds = packets["frequency"][packets["mt.start"] == 1].tolist()
    exposures = [int(scan.points.extra["exposure"].max()) for scan in scans]
    return speeds, exposures


def test_a_simulated_sensor_is_silent_until_start_and_after_stop() -> None:
    running = Running()
    assert running.read(2.0) == b""
    running.send("start")
    assert SENSOR.scans(running.read(3.0))
    running.send("stop")
    running.read(0.1)  # its acknowledgement
    assert running.read(2.0) == b""
    assert (SENSOR.on_open, SENSOR.on_close) == (("start",), ("stop",))


def test_a_simulated_sensor_starts_with_high_exposure_which_follows_the_speed() -> None:
    running = Running()
    running.send("start")
    speeds, exposures = measure(running.read(3.0))
    assert set(speeds) == {5.5}
    assert exposures[:4] == [HIGH, HIGH, LOW, LOW]  # the first revolution counts as incomplete


@pytest.mark.parametrize("repeat", [1, 2])
def test_f1_and_f2_change_speed_and_exposure(repeat: int) -> None:
    running = Running()
    running.send("start")
    running.read(3.0)
    for _ in range(repeat):
        running.send("high_exposure")
    data = running.read(4.0)
    speeds, exposures = measure(data)
    first = speeds.index(7.0)
    assert speeds == [5.5] * first + [7.0] * (len(speeds) - first)
    assert exposures[-1] == HIGH
    low_turns = exposures.index(HIGH)
    assert exposures == [LOW] * low_turns + [HIGH] * (len(exposures) - low_turns)
    assert abs(low_turns - first - 3) <= 1  # the revolution at the beginning is not whole
    whole = [scan for scan in SENSOR.scans(data) if scan.complete]
    assert len(whole[-1]) == 299  # 5.5 * 380 points per second, at 7 Hz
    assert {len(scan) for scan in whole} == {380, 299}  # the speed changes between revolutions
    running.send("low_exposure")
    speeds, exposures = measure(running.read(4.0))
    assert speeds[-1] == 5.5
    assert (exposures[0], exposures[-1]) == (HIGH, LOW)


def test_a_command_before_start_is_remembered() -> None:
    running = Running()
    running.send("high_exposure")
    running.send("start")
    speeds, exposures = measure(running.read(3.0))
    assert set(speeds) == {7.0}
    assert set(exposures) == {HIGH}
