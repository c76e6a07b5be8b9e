"""Tests of finding the damage of a frame: a flipped bit, a lost or inserted byte."""

from __future__ import annotations

import re

import pytest
from construct import Array, Const, Int8ul, Struct

import lidarspec as ls
from lidarspec import explain
from lidarspec.explaining.damage_search import FrameChange, describe_damage, find_changes
from lidarspec.spec import Frame
from tests.cli.running import EXAMPLE
from tests.shapes import SHAPES

STL = ls.sensor("ldrobot-stl27l")
STL_FRAME = STL.frames["data"]
#: Shapes with short frames: every byte of a frame is tried in every place.
SHORT_SHAPES = [
    name
    for name, sensor in SHAPES.items()
    if "data" in sensor.frames and sensor.frames["data"].max_length <= 60
]


def make_bit_flip(offset: int, bit: int) -> FrameChange:
    return FrameChange("flipped bit", offset, bit)


def test_the_flipped_bit_of_a_damaged_frame_is_found() -> None:
    data = STL.example("data", seed=4)
    for flip in (
        make_bit_flip(0, 3),
        make_bit_flip(7, 6),
        make_bit_flip(20, 0),
        make_bit_flip(46, 1),
    ):
        damaged = flip.repair(data)
        assert flip in find_changes(STL_FRAME, damaged)
        for change in find_changes(STL_FRAME, damaged):
            STL.parse(change.repair(damaged))


@pytest.mark.parametrize("offset", [0, 1, 7, 20, 46])
def test_a_lost_and_an_inserted_byte_are_found(offset: int) -> None:
    data = STL.example("data", seed=4)
    lost, more = data[:offset] + data[offset + 1 :], data[:offset] + b"\x9b" + data[offset:]
    for damaged in (lost, more):
        found = find_changes(STL_FRAME, damaged)
        assert data in {change.repair(damaged) for change in found}
        for change in found:
            STL.parse(change.repair(damaged))
    assert {change.kind for change in find_changes(STL_FRAME, lost)} == {"lost byte"}
    assert {change.kind for change in find_changes(STL_FRAME, more)} == {"inserted byte"}


def test_a_lost_byte_and_an_inserted_byte_are_reported() -> None:
    assert explain(EXAMPLE[1:], STL, "data").notes == (
        "one lost byte explains the damage: 0x54 before byte 0, in header",
    )
    (note,) = explain(EXAMPLE[:20] + EXAMPLE[21:], STL).notes
    assert re.fullmatch(
        r"one lost byte explains the damage; \d+ offsets are possible",
        note,
    )
    assert "byte 20, 0x9b" in " ".join(explain(EXAMPLE[:20] + b"\x9b" + EXAMPLE[20:], STL).notes)
    assert explain(EXAMPLE[:20] + EXAMPLE[23:], STL).notes == ()
    assert explain(EXAMPLE + b"abc", STL).notes == ()


def test_possible_offsets_are_counted_once() -> None:
    """Any value of a lost byte is possible in a struct without a checksum."""
    frame = Frame(Struct("header" / Const(b"\xaa"), "bytes" / Array(5, Int8ul)), data=True)
    (note,) = describe_damage(frame, bytes.fromhex("aa 01 02 03 04"), lambda _: {})
    assert note == "one lost byte explains the damage; 6 offsets are possible"


@pytest.mark.parametrize("name", SHORT_SHAPES)
def test_a_suggested_repair_makes_the_frame_valid(name: str) -> None:
    sensor = SHAPES[name]
    data = sensor.example("data")
    middle = len(data) // 2
    without = data[:middle] + data[middle + 1 :]
    inserted = data[:middle] + b"\x9b" + data[middle:]
    for damaged in (make_bit_flip(middle, 2).repair(data), without, inserted):
        for change in find_changes(sensor.frames["data"], damaged):
            sensor.parse(change.repair(damaged), "data")


def test_a_flipped_bit_is_reported_with_its_field() -> None:
    notes = explain(make_bit_flip(46, 0).repair(EXAMPLE), STL).notes
    assert "a flipped bit explains the damage: byte 46 bit 0, crc 81, sent as 80" in notes
    assert (
        "a flipped bit explains the damage:"
        " byte 15 bit 7, points[3].distance 0.213 m, sent as 0.085 m" in notes
    )
    assert explain(EXAMPLE[:20], STL).notes == ()


def test_damage_by_any_single_bit_is_summarized() -> None:
    sensor = ls.sensor("cspc-m1c1-mini")
    data = max((sensor.example("data", seed=seed) for seed in range(9)), key=len)
    (note,) = explain(make_bit_flip(20, 2).repair(data), sensor, "data").notes
    assert re.fullmatch(
        r"one flipped bit explains the damage; \d+ offsets are possible",
        note,
    )
