"""Tests of listings: nested parts, bit fields, damage, differences and colours."""

from __future__ import annotations

import re

import pytest

import lidarspec as ls
from lidarspec import explain
from lidarspec.explaining.formatting import TextSpan, draw_bits
from lidarspec.explaining.listing import fold, join_text, list_differences, list_parents
from tests.cli.running import EXAMPLE, process, ran, run_json
from tests.representatives import load_sensor

STL = ls.sensor("ldrobot-stl27l")
M1C1 = bytes.fromhex("aa55 00 02 0105 0106 0000 2c2b0a 38570a".replace(" ", ""))
DAMAGED = EXAMPLE[:-1] + b"\x51"


def lines(sensor: str, data: bytes, frame: str | None = None) -> list[str]:
    return str(explain(data, load_sensor(sensor), frame)).splitlines()


def test_parts_are_indented() -> None:
    data = ls.sensor("robosense-m1").example("data", seed=1)
    found = [
        re.sub(r"^([0-9a-f]{4})  .{23}  ", r"\1 ", line).split("  ")[0:3]
        for line in lines("robosense-m1", data)
    ]
    assert ["0020 blocks[0]"] in found
    heads = [line for line in lines("robosense-m1", data) if line.endswith("blocks[1]")]
    assert heads == [f"004f  {'':23}  blocks[1]"]
    assert list_parents("a[0].b.c") == ["a[0]", "a[0].b"]


def test_bit_fields_are_drawn_in_the_first_element_and_on_request_in_all() -> None:
    found = explain(M1C1, ls.sensor("cspc-m1c1-mini"), "data")
    listed = [join_text(line) for line in found.lines()]
    told = {" ".join(line.split()) for line in listed}
    assert (
        "000a .. 001010.. 00001010 distance 0.650 m (byte 2 bits 7-0, byte 1 bits 7-2); 0: no"
        " return" in told
    )
    assert "000a ......00 .. .. exposure unknown code (0)" in told
    assert not any(line.startswith("000d  ..") for line in listed)
    assert sum(join_text(line).startswith("000d") for line in found.lines(every=True)) == 4


def test_a_picture_has_dots_for_other_bits() -> None:
    assert draw_bits(b"\xa5\xff\x81", b"\xf0\x00\xff") == "1010.... .. 10000001"


def test_differences_are_listed_by_field_and_bit() -> None:
    other = STL.build("data", {**STL.parse(EXAMPLE), "end_angle": 0x82BF})
    first, second = explain(EXAMPLE, STL), explain(other, STL)
    found = first.differences(second)
    assert [part.path for part in found] == ["end_angle", "crc"]
    assert [join_text(line) for line in list_differences(found, (47, 47))][:3] == [
        "002a  end_angle  334.70 deg -> 334.71 deg (+0.01 deg)",
        "      - be 82        .......0 ..",
        "      + bf 82        .......1 ..",
    ]
    assert (
        join_text(list(list_differences(first.differences(first), (47, 47)))[-1])
        == "47 bytes; the frames are identical"
    )


def test_fields_of_one_frame_only_are_listed_together() -> None:
    sensor = ls.sensor("cspc-m1c1-mini")
    samples = [dict(distance=1000, intensity=9, exposure=2)] * 3
    head = dict(mt=dict(m=0, start=0), fsa=dict(angle=64), lsa=dict(angle=640))
    parts = [
        explain(sensor.build("data", **head, samples=samples[:count]), sensor) for count in (1, 3)
    ]
    shown = [
        join_text(line)
        for line in list_differences(
            parts[0].differences(parts[1]), (len(parts[0].data), len(parts[1].data))
        )
    ]
    assert "      samples[1].distance to samples[2].exposure  only in the second frame" in shown


@pytest.mark.parametrize(
    "name",
    ["shape-count", "shape-bits", "shape-nibbles", "shape-twins", "shape-choices", "shape-scales"],
)
def test_differences_count_every_bit_of_frames_of_one_layout(name: str) -> None:
    sensor = load_sensor(name)
    for frame in sensor.frames:
        data = sensor.example(frame, seed=3)
        other = data[:-1] + bytes([data[-1] ^ 0x41])
        first = explain(data, sensor, frame)
        second = explain(other, sensor, frame)
        if second.rows[-1].values and [row.path for row in first.rows] == [
            row.path for row in second.rows
        ]:
            assert (
                sum(mask.bit_count() for part in first.differences(second) for mask in part.masks)
                == 2
            )


def test_the_verb_compares_with_another_frame_or_the_next() -> None:
    other = STL.build("data", {**STL.parse(EXAMPLE), "speed": 2153})
    said = ran("explain", EXAMPLE.hex(), "--diff", other.hex(), "-s", STL.id).stdout
    assert "0002  speed  2152 deg/s = 6.0 Hz -> 2153 deg/s = 6.0 Hz (+1 deg/s)" in said
    assert ran("explain", (EXAMPLE + other).hex(), "--diff", "next", "-s", STL.id).stdout == said
    listed = run_json("explain", EXAMPLE.hex(), "--diff", other.hex(), "-s", STL.id)["differences"]
    assert [part["path"] for part in listed] == ["speed", "crc"]
    assert (
        "no second data frame"
        in ran("explain", EXAMPLE.hex(), "--diff", "next", "-s", STL.id, code=2).stderr
    )


def test_damaged_frames_in_a_stream_are_explained_beside_the_others() -> None:
    frames = run_json("explain", (b"\x01" + DAMAGED + EXAMPLE + EXAMPLE[:9]).hex(), "-s", STL.id)[
        "frames"
    ]
    assert [(part["frame"], part["offset"], part["fault"] is None) for part in frames] == [
        ("", 0, True),
        ("data", 1, False),
        ("data", 48, True),
        ("data", 95, False),
    ]


def test_long_lines_are_folded_below_their_text() -> None:
    line = (
        TextSpan("0000  "),
        TextSpan("aa  "),
        TextSpan("name  "),
        TextSpan("some words that are too many for it"),
    )
    assert (
        join_text(fold(line, 44))
        == "0000  aa  name  some words that are too many\n                for it"
    )
    assert fold(line, 20) == line


@pytest.mark.slow
def test_colours_are_for_terminals_and_not_with_no_color() -> None:
    terminal = pytest.importorskip(
        "tests.view.terminal", reason="no pseudo-terminals on this system"
    )
    words = ("explain", DAMAGED.hex(), "-s", STL.id)
    assert b"\x1b[" not in process(*words).stdout
    shown = {}
    for colour in ("", "1"):
        with terminal.Terminal(*words, columns=120, lines=60, NO_COLOR=colour) as window:
            assert window.wait_until_end() == 4
            shown[colour] = window.raw
    assert re.search(r"\x1b\[[0-9;]*3[1-7]m", shown[""])
    assert not re.search(r"\x1b\[[0-9;]*3[1-7]m", shown["1"])
