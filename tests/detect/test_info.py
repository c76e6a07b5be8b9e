"""Tests of the device information that sensors report, as text and in Python."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec import SpecError
from lidarspec.detect.doctor import examine
from lidarspec.detect.identification import read_info
from lidarspec.framing.results import Found
from lidarspec.spec import Reported
from tests.cli.running import ran
from tests.made_captures import frame, pcap
from tests.packets.test_returns import make_packet
from tests.shapes import SHAPES


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


def test_all_digits_of_numbers_are_formatted() -> None:
    numbers = dataclasses.replace(
        SHAPES["shape-numbers"], info={"serial": "data.serial", "angle": "data.azimuth"}
    )
    data = numbers.parse(numbers.example("data"))
    data.serial, data.azimuth = 9007199254740993, 0.123456789
    found = read_info(numbers, [Found("data", 0, numbers.build("data", data))])
    assert found == {"serial": "9007199254740993", "angle": "0.123456789 rad"}


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


def test_a_fact_is_in_the_frames_where_its_condition_holds(tmp_path: Path) -> None:
    reported = Reported(
        "data.number", where=lambda f: f.second == 1, text=lambda number: f"number {number}"
    )
    pairs = dataclasses.replace(
        SHAPES["shape-pairs"], info={"last_second": reported, "number": "data.number"}
    )
    packets = [make_packet(index) for index in range(7)]
    path = tmp_path / "a.pcap"
    path.write_bytes(pcap(*(frame(packet) for packet in packets)))
    with ls.open(path, pairs) as device:
        for _ in device.scans():
            pass
        assert device.info == {"last_second": "number 6", "number": "7"}
    found = [Found("data", index, packet) for index, packet in enumerate(packets)]
    assert read_info(pairs, found) == device.info
    assert "last_second" not in read_info(pairs, found[:1])


def test_names_of_facts_are_checked() -> None:
    with pytest.raises(SpecError):
        dataclasses.replace(SHAPES["shape-pairs"], info={"Serial number": "data.number"})
    with pytest.raises(SpecError):
        dataclasses.replace(SHAPES["shape-pairs"], info={"serial": Reported("nothing.number")})
