"""Tests of wire tables: offsets and formulas agree with the compiled layout."""

from __future__ import annotations

import re

import pytest
from construct import Bytes, BytesInteger, Enum, If, Int8ul, Struct, this

import lidarspec as ls
from lidarspec.frames.layout import Layout
from lidarspec.frames.wire_table import INDICES, SizeFormula, WireRow, frame_size, wire_table
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.spec import Frame
from tests.representatives import each_sensor, each_shape, load_sensor
from tests.shapes import SHAPES

#: Types of rows that stand for no field.
NO_FIELDS = ("array", "parts", "check", "invalid frame")


def evaluate_formula(formula: str, names: dict[str, object]) -> int:
    return int(eval(formula, {"__builtins__": {}}, names))


@each_shape
def test_offsets_are_those_of_the_layout(name: str) -> None:
    sensor = load_sensor(name)
    for frame in sensor.frames:
        engine = get_codec(sensor.frames[frame])
        if isinstance(engine, CompiledCodec):
            assert_offsets_are_those_of_the_layout(sensor, frame, engine)


def assert_offsets_are_those_of_the_layout(
    sensor: ls.Sensor, frame: str, engine: CompiledCodec
) -> None:
    data = sensor.example(frame, seed=2)
    layout = engine.tree.layout(data)
    assert isinstance(layout, Layout)
    values = dict(sensor.parse(data, frame))
    size = frame_size(sensor.frames[frame])
    if "(" not in size.replace("*(", ""):
        assert evaluate_formula(size, values) == len(data)
    checked = 0
    for row in wire_table(sensor.frames[frame]):
        leaf = layout.leaves.get(re.sub(r"\[\w\]", "", row.field))
        if (
            leaf is None
            or row.type == "array"
            or "size(" in row.offset
            or "?" in row.offset
            or 0 in leaf.shape
        ):
            continue
        names = {**values, **dict.fromkeys(INDICES, 0)}
        origin = evaluate_formula(row.offset, names)
        assert origin == leaf.offset, row
        for index, stride in zip(INDICES, leaf.strides, strict=False):
            if f"[{index}]" in row.field:
                assert evaluate_formula(row.offset, {**names, index: 1}) == origin + stride, row
        checked += 1
    assert checked


@each_sensor
def test_every_field_has_a_row(name: str) -> None:
    for frame in load_sensor(name).frames.values():
        engine = get_codec(frame)
        if not isinstance(engine, CompiledCodec):
            continue
        rows = {
            re.sub(r"\[\w\]", "", row.field)
            for row in wire_table(frame)
            if row.type not in NO_FIELDS
        }
        assert rows - {"(constant)"} == set(engine.schema.all_fields)


def test_rows_tell_type_unit_and_meaning() -> None:
    rows = {row.field: row for row in wire_table(ls.sensor("robosense-m1").frames["data"])}
    assert rows["blocks[i].channels[j].azimuth"] == WireRow(
        "38 + 47*i + 9*j",
        "2",
        "uint16 be",
        "blocks[i].channels[j].azimuth",
        "0.01 deg - 327.68",
        "",
    )
    assert rows["magic"].meaning == "always 55 aa 5a a5"
    assert rows["seconds"].type == "uint48 be"
    rows = {row.field: row for row in wire_table(ls.sensor("cspc-m1c1-mini").frames["data"])}
    assert rows["samples[i].distance"].type == "byte 2 bits 7-0, byte 1 bits 7-2"
    assert rows["samples"].size == "3*lsn"


def test_a_part_begins_where_the_one_before_it_ends() -> None:
    rows = {row.field: row for row in wire_table(SHAPES["shape-segments"].frames["data"])}
    chain = (
        "the first part has first_size bytes; next_size in each part is the size of the next part"
        ", or 0 in the last part"
    )
    assert rows["segments"] == WireRow("9", "size(segments)", "parts", "segments", "", chain)
    assert rows["segments[i].time"].offset == "4 + at(segments[i])"
    assert rows["crc"].offset == "9 + size(segments)"


def test_optional_fields_are_marked() -> None:
    rows = [
        row
        for row in wire_table(SHAPES["shape-options"].frames["data"])
        if row.field.startswith(("extension", "extra"))
    ]
    assert [(row.field, row.meaning) for row in rows] == [
        ("extension.serial", "if options.extended == 1"),
        ("extension.trim", "if options.extended == 1"),
        ("extra.rpm", "if options.kind == 1"),
        ("extra.rpm", "if options.kind == 2"),
        ("extra.volts", "if options.kind == 2"),
    ]
    assert (
        frame_size(SHAPES["shape-options"].frames["data"])
        == "9 + size(extension) + size(extra) + 2*(rows * columns)"
    )


def test_a_length_that_follows_from_another_says_from_which() -> None:
    frame = SHAPES["shape-sized"].frames["data"]
    rows = {row.field: row for row in wire_table(frame)}
    assert rows["length"].meaning == "= size + 5; all bytes before the sum"
    assert rows["samples"].meaning == "(size - 2) // 3 elements of 3"
    assert frame_size(frame) == "9 + 3*((size - 2) // 3)"


def test_text_has_no_size_of_its_own() -> None:
    rows = {row.field: row for row in wire_table(SHAPES["shape-text"].frames["data"])}
    assert (rows["angle"].offset, rows["angle"].size, rows["angle"].type) == (
        "2",
        "varies",
        "text up to ','",
    )
    assert rows["strength"].offset == "2 + size(angle) + size(distance)"


@pytest.mark.parametrize(
    ("extent", "factor", "text"),
    [
        (SizeFormula(3), 4, "12"),
        (SizeFormula(3), "i", "3*i"),
        (SizeFormula(1), "n", "n"),
        (SizeFormula(2), "a * b", "2*(a * b)"),
        (SizeFormula(1, ("n",)), "i", "(1 + n)*i"),
    ],
)
def test_extents_multiply(extent: SizeFormula, factor: int | str, text: str) -> None:
    assert str(extent.times(factor)) == text


def test_an_empty_struct_has_no_rows() -> None:
    assert wire_table(Frame(Struct(), max_length=1)) == ()


def test_wide_integers_are_bytes_and_conditions_have_names() -> None:
    struct = Struct(
        "kind" / Enum(Int8ul, plain=1),
        "more" / If(this.kind == "plain", Int8ul),
        "wide" / BytesInteger(10),
    )
    rows = {row.field: row for row in wire_table(Frame(struct, max_length=12))}
    assert rows["more"].meaning == "if kind == 'plain'"
    assert (rows["wide"].offset, rows["wide"].size, rows["wide"].type) == (
        "1 + size(more)",
        "10",
        "uint80 be",
    )


def test_python_lengths_are_shown_as_source() -> None:
    struct = Struct(
        "a" / Int8ul,
        "inner" / Struct("x" / Bytes(this._.a / 2), "y" / Bytes(lambda c: 1 if c.x else 2)),
    )
    assert [row.size for row in wire_table(Frame(struct, max_length=600))] == ["1", "a / 2", "?"]
