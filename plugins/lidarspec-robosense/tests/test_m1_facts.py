"""Tests of the facts that an RS-LiDAR-M1 reports in DIFOP, and of its temperature."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
import lidarspec_robosense
from lidarspec.detect.identification import read_info
from lidarspec.framing.results import Found

M1 = ls.sensor("robosense-m1")
NOTES = Path(lidarspec_robosense.__file__).parent / "notes" / "robosense-m1.md"
MODES = {
    "return_mode": 0,
    "time_sync_mode": 2,
    "time_sync_status": 1,
    "pl_firmware": bytes([0, 1, 2, 3, 4]),
    "ps_firmware": bytes([5, 6, 7, 8, 9]),
}
POWER = {
    "serial_number": bytes([1, 2, 3, 4, 5, 6]),
    "currents": [70_000, 3],
    "voltages": [1200, 500],
}


def report(frame: str, **values: Any) -> dict[str, str]:
    """Return the facts in a DIFOP packet with these values."""
    packet = M1.parse(M1.example(frame), frame)
    packet.seconds = 1000
    packet.microseconds = 0
    for name, value in {**MODES, **values}.items():
        packet[name] = value
    return read_info(M1, [Found(frame, 0, M1.build(frame, packet))])


@pytest.mark.parametrize("frame", ["difop", "difop_fov"])
def test_difop_of_rs_driver_reports_modes_and_power(frame: str) -> None:
    facts = report(frame, **POWER)
    assert facts["serial"] == "010203040506"
    assert facts["firmware"] == "0001020304"
    assert facts["ps_firmware"] == "0506070809"
    assert facts["return_mode"] == "dual"
    assert facts["sync_mode"] == "PTP"
    assert facts["sync_status"] == "locked"
    assert facts["voltages"].startswith("1200, 500 ")
    assert facts["currents"].startswith("70000, 3 ")


def test_difop_of_the_guide_reports_voltage_and_faults() -> None:
    facts = report("difop_guide", battery_voltage=1234, faults=0)
    assert facts["return_mode"] == "dual"
    assert facts["battery_voltage"].startswith("1234 ")
    assert facts["faults"] == "none"
    assert report("difop_guide", faults=5)["faults"].startswith("code 0x05")


@pytest.mark.parametrize(
    # the byte 0x22 of the M1P guide's capture is -46 degC by its formula and 34 degC as signed byte
    ("firmware", "byte", "celsius"),
    [("current", 0x22, -46), ("2021", 0x22, 34), ("current", 0xB0, 96), ("2021", 0xB0, -80)],
)
def test_the_firmware_decides_the_temperature(firmware: str, byte: int, celsius: int) -> None:
    value = M1.parse(M1.example("data"))
    value.mems_tmp = byte
    packet = M1.build("data", value)
    sensor = M1.configure(firmware=firmware)
    assert sensor.decode([packet])["mems_tmp"].tolist() == [celsius]
    assert read_info(sensor, [Found("data", 0, packet)])["temperature"] == f"{celsius} degC"
    assert "temperature" not in read_info(M1, [Found("data", 0, packet)])


def test_the_load_of_the_network() -> None:
    """The rate is that of 630 packets a frame, 10 frames a second."""
    packets = ls.simulate(M1, 1500)
    data = [packet for packet in packets if len(packet) == 1210]
    times_ns = M1.decode(data).time_ns
    rate_hz = 1e9 * (len(data) - 1) / np.ptp(times_ns)
    assert rate_hz == pytest.approx(6300, rel=1e-3)
    assert rate_hz * 1210 * 8 == pytest.approx(61e6, rel=1e-3)  # bits a second
    assert len(M1.example("difop")) == 256


@pytest.mark.parametrize(
    "sentence",
    [
        "| address of the sensor | 192.168.1.200 |",
        "| address of the host | 192.168.1.102 |",
        "| points (MSOP) | UDP port 6699 |",
        "| device information (DIFOP) | UDP port 7788 |",
        "mask 255.255.255.0",
        "about 61 Mbit/s with single returns and twice as much with dual returns",
        "6 300 and 12 600 packets a second",
        "The guide prints at least 58.2 and 116.4 Mbit/s",
        "Clocks are synchronised by GPS (PPS), PTP or gPTP.",
    ],
)
def test_the_page_has_the_network(sentence: str) -> None:
    assert sentence in " ".join(NOTES.read_text(encoding="utf-8").split())
