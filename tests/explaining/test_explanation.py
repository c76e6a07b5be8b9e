"""Tests that explanations name every byte once and agree with the engine.

The frames are whole, damaged and truncated.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import re

import numpy as np
import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Const,
    Enum,
    IfThenElse,
    Int8ul,
    Int16ub,
    Int16ul,
    Nibble,
    Struct,
    this,
)

import lidarspec as ls
from lidarspec import Sensor, WireError
from lidarspec.errors import UnknownFrame
from lidarspec.explaining.explanation import Explanation, explain
from lidarspec.explaining.formatting import hexdump
from lidarspec.spec import Checksummed, Frame, Polar, Scaled, Simulation, Sum, Xor, tree
from tests.representatives import each_sensor, each_shape, load_sensor
from tests.shapes import SHAPES

EXAMPLE = bytes.fromhex(
    "542c6808ab7ee000e4dc00e2d900e5d500e3d300e4d000e9cd00e4ca00e2c700e9c500e5c200e5c000e5be823a1a50"
)
#: At about so many bytes frames are cut; the search for the damage takes its time.
CUTS = 40
#: Shapes whose frames are cut at many bytes, or at each if they are short.
CUT_AT_MANY_BYTES = ("shape-count", "shape-bits")
#: Representatives whose frames are cut in the middle, as those of the other shapes.
CUT_IN_THE_MIDDLE = ("ldrobot-stl27l", "cspc-m1c1-mini")

#: Sensors whose points follow from earlier frames.
WITHOUT_POINTS = (
    "shape-weak",
    "shape-text",
    "shape-modes",
    "shape-tags",
    "shape-joined",
    "slamtec-rplidar-a1",
    "sick-multiscan136",
)


@functools.cache
def explain_example(name: str, frame: str, seed: int = 0) -> Explanation:
    """Return the explanation of an example of a frame type."""
    sensor = load_sensor(name)
    return explain(sensor.example(frame, seed=seed), sensor, frame)


def bytes_of_rows(explanation: Explanation) -> bytes:
    """Return the bytes of all rows; fail unless each row begins where the one before ends."""
    end = 0
    for row in explanation.rows:
        assert row.offset == end
        end += len(row.data)
    return b"".join(row.data for row in explanation.rows)


@each_shape
def test_every_byte_is_named_once(name: str) -> None:
    for frame in load_sensor(name).frames:
        found = explain_example(name, frame)
        assert bytes_of_rows(found) == found.data
        assert found.fault is None
        assert all(row.matches_spec and row.path for row in found.rows)
        json.dumps(found.to_dict(), allow_nan=False)


@pytest.mark.parametrize("name", [*SHAPES, *CUT_IN_THE_MIDDLE])
def test_a_truncated_frame_is_explained_as_far_as_it_goes(name: str) -> None:
    sensor = load_sensor(name)
    for frame in sensor.frames:
        whole = explain_example(name, frame)
        data = whole.data
        for end in (
            range(0, len(data), 1 + len(data) // CUTS)
            if name in CUT_AT_MANY_BYTES
            else (len(data) // 2,)
        ):
            found = explain(data[:end], sensor, frame)
            assert bytes_of_rows(found) == data[:end]
            assert found.fault is not None
            assert not found.rows[-1].matches_spec
            for row, same in zip(found.rows[:-2], whole.rows, strict=False):
                assert (row.offset, row.data, row.path, row.values) == (
                    same.offset,
                    same.data,
                    same.path,
                    same.values,
                )


@each_sensor
def test_the_values_are_those_that_parse_gives(name: str) -> None:
    sensor = load_sensor(name)
    for frame in sensor.frames:
        explanation = explain_example(name, frame)
        parsed = sensor.parse(explanation.data, frame)
        values = [value for row in explanation.rows for value in row.values]
        for value in values:
            expected = parsed
            for key in re.findall(r"\w+", value.path):
                expected = expected[int(key)] if key.isdigit() else expected[key]
            is_nan = value.raw != value.raw and expected != expected
            assert value.raw == expected or is_nan
        nodes = tree.nodes(sensor.frames[frame].tree)
        without_bytes = sum(isinstance(node, tree.Derived) for node in nodes)
        assert len(values) == leaf_count(parsed) - without_bytes


@each_shape
def test_pictures_show_every_bit_of_a_block_once(name: str) -> None:
    for frame in load_sensor(name).frames:
        for row in explain_example(name, frame).rows:
            shown = bytearray(len(row.data))
            for value in row.values:
                assert value.masks or value.raw == b""
                for index, mask in enumerate(value.masks, value.start - row.offset):
                    assert not shown[index] & mask
                    shown[index] |= mask
            is_mark = row.path in ("(start)", "(end)")
            assert shown == (b"\0" if is_mark else b"\xff") * len(row.data)


def test_an_explanation_has_fields_by_path_and_a_verdict() -> None:
    whole = explain(EXAMPLE, ls.sensor("ldrobot-stl27l"))
    assert (whole.frame, whole.verdict) == ("data", "valid")
    assert whole.fields["points[3].distance"].physical == pytest.approx(0.213)
    assert list(whole.fields)[-1] == "crc"
    damaged = explain(EXAMPLE[:-1] + b"\x51", ls.sensor("ldrobot-stl27l"))
    assert damaged.fault is not None
    assert damaged.verdict == damaged.fault.reason
    assert "checksum" in damaged.verdict
    assert [difference.path for difference in whole.differences(damaged)] == ["crc"]


def leaf_count(parsed: object) -> int:
    if isinstance(parsed, dict):
        return sum(map(leaf_count, parsed.values()))
    if isinstance(parsed, list):
        return sum(map(leaf_count, parsed))
    return parsed is not None


@each_sensor
def test_points_are_those_of_the_cloud(name: str) -> None:
    sensor = load_sensor(name)
    frame = sensor.data_frame
    for seed in range(4):  # the count of a random frame may be 0
        found = explain_example(name, frame, seed=seed)
        if any(row.points for row in found.rows):
            break
    # a point is listed at several rows if its range and its intensity stand in arrays of their own
    points = list({id(point): point for row in found.rows for point in row.points}.values())
    if sensor.frames[frame].after or not points:
        assert name in WITHOUT_POINTS
        return
    cloud = sensor.decode([found.data] * sensor.frames[frame].confirm).points()[: len(points)]
    listed = np.nan_to_num(np.array([[point.x, point.y, point.z] for point in points]))
    decoded = np.nan_to_num(cloud.xyz.astype(float))
    assert len(listed) == len(decoded)
    order = np.lexsort(np.round(listed.T, 3)), np.lexsort(np.round(decoded.T, 3))
    distances = np.abs(listed[order[0]] - decoded[order[1]]).max(axis=1)
    assert (distances < 1e-5 * (1 + np.abs(decoded).max())).all()


def test_points_are_in_the_rows_of_their_fields() -> None:
    sensor = ls.sensor("robosense-m1")
    data = bytearray(sensor.example("data", seed=1))
    values = sensor.parse(bytes(data))
    channel = values.blocks[24].channels[3]
    channel.radius, channel.elevation, channel.azimuth = 2000, 32768, 32768 + 9000
    row = next(
        row
        for row in explain(sensor.build("data", values), sensor).rows
        if row.path == "blocks[24].channels[3]"
    )
    (point,) = row.points
    assert (round(point.x, 4), round(point.y, 4), round(point.z, 4)) == (0, 10, 0)
    assert point.azimuth_deg == pytest.approx(90)


def test_text_is_as_the_conventions_say() -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    values = sensor.parse(EXAMPLE)
    values.speed, values.start_angle, values.end_angle = 3600, 0, 220
    values.points[0].distance, values.points[0].intensity = 1000, 200
    values.points[1].distance = 0
    lines = str(explain(sensor.build("data", values), sensor)).splitlines()
    assert lines[1] == "0002  10 0e     speed        3600 deg/s = 10.0 Hz"
    assert (
        lines[3]
        == "0006  e8 03 c8  points[0]    1.000 m, intensity 200, at 0.00 deg -> x 1.000 y 0.000"
    )
    assert (
        lines[4] == "0009  00 00 e2  points[1]    0.000 m, intensity 226, at -0.20 deg -> no return"
    )
    assert lines[-2] == "002c  3a 1a     timestamp    6.714 s; restarts from 0 after 30 s"
    assert re.fullmatch(
        r"002e  (..)        crc          0x\1 ok \(CRC-8 poly 0x4d over 46 bytes\)", lines[-1]
    )


def test_a_wrong_checksum_shows_the_computed_one_and_gives_no_points() -> None:
    found = explain(EXAMPLE[:-1] + b"\x51", ls.sensor("ldrobot-stl27l"))
    assert found.rows[-1].meaning == "0x51 wrong, expected 0x50 (CRC-8 poly 0x4d over 46 bytes)"
    assert [row.matches_spec for row in found.rows] == [True] * (len(found.rows) - 1) + [False]
    assert not any(row.points for row in found.rows)


def test_a_wrong_constant_is_reported() -> None:
    found = explain(b"\x54\x2d" + EXAMPLE[2:], ls.sensor("ldrobot-stl27l"))
    assert found.rows[0].remarks == ("wrong: 54 2d, expected 54 2c",)
    assert not found.rows[0].matches_spec


def test_trailing_bytes_are_reported_and_points_remain() -> None:
    found = explain(EXAMPLE + b"abc", ls.sensor("ldrobot-stl27l"))
    assert (found.rows[-1].data, found.rows[-1].meaning) == (b"abc", "after the end of the frame")
    assert sum(len(row.points) for row in found.rows) == 12


def test_checksums_of_every_kind_are_judged() -> None:
    said = {}
    for sensor in ("shape-nested", "shape-nibbles", "shape-middle", "shape-numbers"):
        rows = explain(SHAPES[sensor].example("data", seed=5), SHAPES[sensor]).rows
        said[sensor] = [row.remarks[0].partition(" ")[2] for row in rows if row.remarks]
    assert said["shape-nested"] == [
        "ok (8-bit sum over 4 bytes)",
        "ok (CRC-32 poly 0x04c11db7 init 0xffffffff xorout 0xffffffff reflected over 11 bytes)",
    ]
    assert said["shape-nibbles"] == ["ok (XOR-8 over 12 bytes)"]
    assert said["shape-middle"] == [
        "ok (XOR-16 of 1+2-byte words after a head of 4 bytes over 16 bytes)"
    ]
    values = SHAPES["shape-numbers"].parse(SHAPES["shape-numbers"].example("data", seed=5))
    row = explain(
        SHAPES["shape-numbers"].build("data", values, crc=0), SHAPES["shape-numbers"]
    ).rows[-1]
    assert row.remarks == (
        "0x0000 means no checksum (CRC-16 poly 0x1021 init 0xffff over 55 bytes)",
    )
    assert row.matches_spec


def test_bit_fields_show_their_bits() -> None:
    sensor = ls.sensor("cspc-m1c1-mini")
    data = bytes.fromhex("aa55 00 02 01 05 01 06 0000 2c2b0a 38570a".replace(" ", ""))
    rows = {row.path: row for row in explain(data, sensor, "data").rows}
    values = {value.name: (value.raw, value.bits) for value in rows["samples[1]"].values}
    assert values == {
        "distance": (0x0A5738 >> 10, "byte 2 bits 7-0, byte 1 bits 7-2"),
        "intensity": (0x0A5738 >> 2 & 0xFF, "byte 1 bits 1-0, byte 0 bits 7-2"),
        "exposure": (0x0A5738 & 3, "byte 0 bits 1-0"),
    }
    assert (
        "angle 10.00 deg (byte 1 bits 7-0, byte 0 bits 7-1), check 1 (byte 0 bit 0)"
        in rows["fsa"].meaning
    )


def variant(*fields: object) -> Sensor:
    """Return the sensor of a shape with another struct."""
    struct = Checksummed(Struct(*fields), field="check", algorithm=Xor())
    frame = Frame(struct, data=True, max_length=9)
    return dataclasses.replace(
        SHAPES["shape-count"],
        frames={"data": frame},
        points=lambda f: Polar(range=f.far, azimuth=0),
    )


def test_renamed_and_reordered_fields_are_followed() -> None:
    first = variant(
        "sync" / Const(b"\x01\x02"),
        "far" / Scaled(Int16ul, 0.01, "m"),
        "mode" / Enum(Int8ul, slow=1),
        "check" / Int8ul,
    )
    other = variant(
        "pace" / Enum(Int8ul, slow=1),
        "check" / Int8ul,
        "sync" / Const(b"\x01\x02"),
        "far" / Scaled(Int16ub, 0.01, "m"),
    )
    before = explain(first.build("data", far=4660, mode=1), first)
    after = explain(other.build("data", far=4660, pace=1), other)
    assert [(row.offset, row.path, row.data.hex()) for row in before.rows] == [
        (0, "sync", "0102"),
        (2, "far", "3412"),
        (4, "mode", "01"),
        (5, "check", "24"),
    ]
    assert [(row.offset, row.path, row.data.hex()) for row in after.rows] == [
        (0, "pace", "01"),
        (1, "check", "24"),
        (2, "sync", "0102"),
        (4, "far", "1234"),
    ]
    assert [str(row.values[0]) for row in (before.rows[1], before.rows[2], after.rows[0])] == [
        "46.60 m",
        "slow (1)",
        "slow (1)",
    ]


def test_constants_without_a_name_and_documented_elements_keep_their_places() -> None:
    sensor = variant(
        Const(b"\x77"),
        "far" / Scaled(Int16ul, 0.01, "m"),
        "pairs" / Array(2, Struct("a" / Int8ul) * "one"),
        "check" / Int8ul,
    )
    found = explain(sensor.build("data", far=1, pairs=[{"a": 3}, {"a": 4}]), sensor)
    assert [(row.offset, row.path) for row in found.rows] == [
        (0, "(constant)"),
        (1, "far"),
        (3, "pairs[0]"),
        (4, "pairs[1]"),
        (5, "check"),
    ]


def test_bit_blocks_in_arrays_of_arrays_have_rows_of_their_own_and_groups_give_their_text() -> None:
    grid = Array(2, Array(2, BitStruct("high" / Nibble, "low" / Nibble)))
    sensor = variant(
        "far" / Int8ul,
        "grid" / grid,
        "group" / Struct("a" / Int8ul * "its own", "b" / Int8ul) * "both",
        "check" / Int8ul,
    )
    found = explain(bytes([1, 0x12, 0x34, 0x56, 0x78, 5, 6, 2 ^ 0x12 ^ 0x34 ^ 0x56 ^ 0x78]), sensor)
    assert found.verdict == "valid"
    assert [row.path for row in found.rows[1:5]] == [
        "grid[0][0]",
        "grid[0][1]",
        "grid[1][0]",
        "grid[1][1]",
    ]
    assert [(value.raw, value.bits) for value in found.rows[4].values] == [
        (7, "byte 0 bits 7-4"),
        (8, "byte 0 bits 3-0"),
    ]
    assert [found.fields[path].docs for path in ("group.a", "group.b")] == ["its own", "both"]


def test_a_bit_block_that_decides_on_its_bits_is_explained_without_them() -> None:
    block = BitStruct(
        "kind" / Nibble, "value" / IfThenElse(this.kind == 1, Nibble, BitsInteger(4, signed=True))
    )
    sensor = variant("far" / Int8ul, "block" / block, "check" / Int8ul)
    found = explain(bytes([1, 0x2F, 1 ^ 0x2F]), sensor, "data")
    assert [(row.offset, row.path) for row in found.rows[:2]] == [(0, "far"), (1, "block")]
    assert [(value.path, value.raw, value.bits) for value in found.rows[1].values] == [
        ("block.kind", 2, ""),
        ("block.value", -1, ""),
    ]


def test_a_checksum_within_a_frame_is_judged_over_its_own_bytes() -> None:
    inner = Checksummed(
        Struct("far" / Scaled(Int16ul, 0.01, "m"), "sum" / Int8ul), field="sum", algorithm=Sum(8)
    )
    sensor = variant("sync" / Const(b"\x01\x02"), "far" / Int8ul, "inner" / inner, "check" / Int8ul)
    rows = {
        row.path: row
        for row in explain(sensor.build("data", far=1, inner={"far": 0x1234}), sensor).rows
    }
    assert rows["inner.sum"].remarks == ("0x46 ok (8-bit sum over 2 bytes)",)
    assert rows["check"].remarks[0].endswith("ok (XOR-8 over 6 bytes)")


def test_look_ahead_and_implausible_frames_are_noted() -> None:
    ahead = explain(SHAPES["shape-ahead"].example("data"), SHAPES["shape-ahead"])
    assert any("the direction is unknown" in row.meaning for row in ahead.rows)
    values = ls.sensor("ldrobot-stl27l").parse(EXAMPLE)
    values.start_angle = 36001
    found = explain(ls.sensor("ldrobot-stl27l").build("data", values), ls.sensor("ldrobot-stl27l"))
    assert found.notes == ("the values are not plausible, so decoders skip this frame",)


def test_bytes_that_begin_like_no_frame_are_refused() -> None:
    with pytest.raises(WireError, match="robosense-m1"):
        explain(b"hello, world", ls.sensor("robosense-m1"))
    with pytest.raises(UnknownFrame, match="'data'"):
        explain(b"", ls.sensor("robosense-m1"), "dat")


def fault(data: bytes) -> WireError:
    with pytest.raises(WireError) as caught:
        ls.sensor("ldrobot-stl27l").parse(data)
    return caught.value


@pytest.mark.parametrize(
    ("data", "lines"),
    [
        (
            "542c100e0000e803c8e903",
            ["  0000  54 2c 10 0e 00 00 e8 03  c8 e9 03", " " * 42 + "^^ points[1].intensity"],
        ),
        ("542d100e", ["  0000  54 2d 10 0e", "        ^^^^^ header"]),
        ("54", ["  0000  54", "        ^^ header"]),
        (
            EXAMPLE[:8].hex(),
            ["  0000  54 2c 68 08 ab 7e e0 00", " " * 33 + "^^ points[0].intensity"],
        ),
        (
            EXAMPLE[:16].hex(),
            [
                "  0000  54 2c 68 08 ab 7e e0 00  e4 dc 00 e2 d9 00 e5 d5",
                " " * 54 + "^^ points[3].distance",
            ],
        ),
        (
            (EXAMPLE[:-1] + b"\0").hex(),
            [
                "  0000  54 2c 68 08 ab 7e e0 00  e4 dc 00 e2 d9 00 e5 d5",
                "  0010  00 e3 d3 00 e4 d0 00 e9  cd 00 e4 ca 00 e2 c7 00",
                "  0020  e9 c5 00 e5 c2 00 e5 c0  00 e5 be 82 3a 1a 00",
                " " * 51 + "^^ crc",
            ],
        ),
    ],
)
def test_hexdumps_mark_the_place(data: str, lines: list[str]) -> None:
    assert hexdump(fault(bytes.fromhex(data))).splitlines() == lines


def test_hexdumps_of_long_frames_show_the_lines_before_the_place() -> None:
    error = WireError("here", offset=100, path="x", data=bytes(range(200)))
    assert [line[:8].strip() for line in hexdump(error).splitlines()] == [
        "...",
        "0040",
        "0050",
        "0060",
        "",
    ]
    assert hexdump(WireError("nothing")) == ""


def test_numbers_are_shown_with_the_steps_of_their_scale() -> None:
    found = explain(SHAPES["shape-numbers"].example("data", seed=3), SHAPES["shape-numbers"])
    serial = next(value for row in found.rows for value in row.values if value.name == "serial")
    assert str(serial) == str(serial.raw)
    assert not any(
        math.isinf(value.physical)
        for row in found.rows
        for value in row.values
        if value.name == "serial"
    )


@pytest.mark.parametrize(
    ("scale", "offset", "shown"),
    [
        (1 / 64, 0, "300.02"),
        (1 / 16, 0, "1200.0625"),
        (0.25, 0, "4800.25"),
        (0.01, 0, "192.01"),
        (0.01, -327.68, "-135.67"),
        (0.001, 0, "19.201"),
        (0.00025, 0, "4.80025"),
        (360 / 65536, 0, "105.474"),
        (1 / 3, 0, "6400.3"),
        (1, 273.15, "19474.15"),
        (100, 0, "1920100"),
        (1e-9, 0, "0.000019201"),
        (2**-32, 0, "0.0000044706"),
    ],
)
def test_a_value_has_the_decimals_that_its_steps_need(
    scale: float, offset: float, shown: str
) -> None:
    """Two neighbouring raw values are shown as different texts.

    `build` converts the shown text to the same raw value.
    """
    shape = SHAPES["shape-numbers"]
    frame = Frame(
        Struct("magic" / Const(b"\xf0\x0d"), "x" / Scaled(Int16ul, scale, "u", offset)),
        data=True,
        max_length=4,
    )
    sensor = dataclasses.replace(
        shape,
        frames={"data": frame},
        points=lambda f: Polar(f.x, 0),
        sequence=None,
        clock=None,
        simulation=Simulation(),
    )

    def said(raw: int) -> str:
        row = explain(sensor.build("data", x=raw), sensor).rows[-1]
        return str(row.values[0]).split()[0]

    assert said(19_201) == shown
    assert said(19_202) != shown
    assert sensor.parse(sensor.build("data", x=float(shown), units=True)).x == 19_201


def test_no_bytes_at_all_are_explained() -> None:
    listing = str(explain(b"", ls.sensor("ldrobot-stl27l")))
    assert "header" in listing
