"""Tests of the device information that sensors report, as text and in Python."""

from __future__ import annotations

from pathlib import Path

import lidarspec as ls
from lidarspec.detect.doctor import examine
from lidarspec.detect.identification import read_info
from lidarspec.framing.results import Found
from tests.cli.running import ran
from tests.made_captures import frame, pcap


def test_texts_bytes_and_numbers_with_units_are_formatted() -> None:
    helios = ls.sensor("robosense-helios16p")
    difop = helios.parse(helios.example("difop"))
    difop.serial_number, difop.top_firmware = b"\x11\x22\x33\x44\x55\x66", b"v1.2\0"
    found = read_info(helios, [Found("difop", 0, helios.build("difop", difop))])
    assert found == {"serial": "112233445566", "firmware": "v1.2"}
    puck = ls.sensor("velodyne-vlp16")
    position = puck.parse(puck.example("position"))
    told = read_info(puck, [Found("position", 0, puck.build("position", position))])["temperature"]
    assert told.endswith(" degC")


def test_device_and_doctor_report_the_last_values(tmp_path: Path) -> None:
    helios = ls.sensor("robosense-helios16p")
    difop = helios.parse(helios.example("difop"))
    serials = []
    for serial in (b"\x01\x02\x03\x04\x05\x06", b"\x11\x22\x33\x44\x55\x66"):
        difop.serial_number = serial
        serials.append(helios.build("difop", difop))
    path = tmp_path / "a.pcap"
    path.write_bytes(pcap(*map(frame, (serials[0], *ls.simulate(helios, 20), serials[1]))))
    with ls.open(path, helios) as device:
        assert device.info == {}
        for _ in device.scans():
            pass
        assert device.info["serial"] == "112233445566"
    assert any("serial 112233445566" in finding.text for finding in examine(path, helios))


def test_show_prints_path_and_unit() -> None:
    assert (
        "reports temperature (position.top_board_temperature, degC)"
        in ran("show", "velodyne-vlp16").stdout
    )
