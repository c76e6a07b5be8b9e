"""Tests that `parse` by layouts returns the same Container as construct."""

from __future__ import annotations

import random
from typing import Any

import construct
import numpy as np
import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    BytesInteger,
    Const,
    Enum,
    Float32l,
    Int8ub,
    Int16sb,
    Int16ub,
    Int16ul,
    Int24ul,
    Struct,
    Switch,
    this,
)

import lidarspec as ls
from lidarspec import Sensor, SpecError
from lidarspec.frames import layout_tree
from lidarspec.frames.layout import Layout
from lidarspec.frames.layout_tree import HeaderTree, frame_layouts
from lidarspec.frames.parse import unpack
from lidarspec.spec import Checksum, Checksummed, Frame
from lidarspec.spec.syntax import to_public
from tests.engine import against_construct
from tests.engine.engines import is_compiled
from tests.representatives import each_sensor, each_shape, load_sensor
from tests.shapes import SHAPES

#: Examples of each frame type; long frames of real sensors take construct its time.
SHAPE_EXAMPLES = 3
REPRESENTATIVE_EXAMPLES = 1
#: Bytes at the start of a frame that are damaged one by one.
SHAPE_DAMAGED_BYTES = 15
REPRESENTATIVE_DAMAGED_BYTES = 4


def compiled_frames(sensor: Sensor) -> list[str]:
    """Return the names of the frame types that have layouts."""
    return [name for name, frame in sensor.frames.items() if is_compiled(frame)]


def same(one: Any, other: Any) -> None:
    """Fail unless values, types and order are equal; compare NaNs by their bits."""
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert list(one) == list(other)
        for name in one:
            same(one[name], other[name])
    elif isinstance(one, list):
        assert len(one) == len(other)
        for left, right in zip(one, other, strict=True):
            same(left, right)
    elif isinstance(one, float) and one != one:
        assert getattr(one, "raw", b"") == getattr(other, "raw", b"")
    else:
        assert one == other


def unpack_by_layout(frame: Frame, data: bytes) -> Any:
    """Return the frame that its layout reads; None if construct has to read it."""
    layouts = frame_layouts(frame)
    assert isinstance(layouts, HeaderTree)
    layout = layouts.layout(data)
    return (
        unpack(frame.tree, layout, data)
        if isinstance(layout, Layout) and layout.is_valid(data)
        else None
    )


@each_shape
def test_frames_unpack_to_what_construct_parses(name: str) -> None:
    sensor = load_sensor(name)
    for frame in compiled_frames(sensor):
        for seed in range(SHAPE_EXAMPLES if name in SHAPES else REPRESENTATIVE_EXAMPLES):
            data = sensor.example(frame, seed=seed)
            found = unpack_by_layout(sensor.frames[frame], data)
            assert found is not None, "left to construct"
            same(found, to_public(sensor.frames[frame].prepared.parse(data)))


@each_shape
def test_damaged_frames_are_left_to_construct(name: str) -> None:
    sensor = load_sensor(name)
    for frame in compiled_frames(sensor):
        data = sensor.example(frame)
        count = SHAPE_DAMAGED_BYTES if name in SHAPES else REPRESENTATIVE_DAMAGED_BYTES
        for offset in range(min(len(data), count)):
            damaged = data[:offset] + bytes([data[offset] ^ 0x41]) + data[offset + 1 :]
            found = unpack_by_layout(sensor.frames[frame], damaged)
            try:
                expected = to_public(sensor.frames[frame].prepared.parse(damaged))
            except construct.ConstructError:
                assert found is None
            else:
                if found is not None:
                    same(found, expected)


TRIPLE = Struct(
    "a" / BytesInteger(3, signed=True),
    "b" / Const(b"\x07"),
    "c" / Bytes(2),
    "d" / BitStruct("x" / BitsInteger(3), "y" / BitsInteger(5)),
)

#: arrays of every kind, written out and as loops, and loops in loops.
ARRAYS = {
    "written out": Array(6, TRIPLE),
    "a loop": Array(30, TRIPLE),
    "loops in loops": Array(3, Struct("rows" / Array(4, Array(5, Int24ul)), "end" / Int8ub)),
    "numbers": Array(40, Int16sb),
    "few numbers": Array(3, Int16ul),
    "numbers in a loop": Array(20, Struct("low" / Array(4, Int16sb), "high" / Array(40, Int8ub))),
    "floats": Array(40, Float32l),
    "bytes": Array(40, Bytes(3)),
    "blocks": Array(40, BitStruct("p" / BitsInteger(2), "q" / Array(3, BitsInteger(2)))),
    "constants": Array(40, Const(5, Int8ub)),
    "constants in structs": Array(40, Struct("mark" / Const(b"ab"))),
    "none": Array(0, TRIPLE),
    "labels": Array(40, Enum(Int8ub, idle=1, busy=2)),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_arrays_of_all_kinds(name: str) -> None:
    frame = Frame(
        Struct("head" / Const(b"\x5a"), "inside" / ARRAYS[name], "tail" / Int16ul),
        max_length=1 << 20,
    )
    size = frame.prepared.sizeof()
    layouts = frame_layouts(frame)
    assert isinstance(layouts, HeaderTree)
    layout = layouts.layout(bytes(size))
    assert isinstance(layout, Layout)
    rows = np.frombuffer(random.Random(name).randbytes(3 * size), np.uint8).reshape(3, size).copy()
    layout.complete_rows(rows)
    for data in map(np.ndarray.tobytes, rows):
        found = unpack_by_layout(frame, data)
        assert found is not None
        same(found, to_public(frame.prepared.parse(data)))
        assert unpack_by_layout(frame, data + b"\0") is None
        assert unpack_by_layout(frame, data[:-1]) is None


def test_headers_lead_to_their_own_layout_also_after_some_were_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(layout_tree, "MAX_CACHED_HEADERS", 20)
    kinds = Switch(this.kind, {1: Int8ub, 2: Int16ub}, default=Int24ul)
    rows = Array(this.count, Int16ul)
    struct = Struct(
        "head" / Const(b"\x5a"),
        "kind" / Int8ub,
        "count" / Int8ub,
        "rows" / rows,
        "more" / kinds,
        "end" / Int8ub,
    )
    frame = Frame(struct, max_length=700)
    for count in [*range(60), *range(60), 3, 3]:
        for kind in range(4):
            data = bytes([0x5A, kind, count]) + random.Random(count).randbytes(
                2 * count + {1: 1, 2: 2}.get(kind, 3) + 1
            )
            same(unpack_by_layout(frame, data), to_public(frame.prepared.parse(data)))
            assert unpack_by_layout(frame, data[:-1]) is None
            assert unpack_by_layout(frame, b"\x5b" + data[1:]) is None
    assert unpack_by_layout(frame, b"\x5a\x02") is None
    assert unpack_by_layout(frame, b"") is None


def test_units_are_those_that_build_takes() -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    data = sensor.build("data", sensor.parse(sensor.example("data")), speed=3600, start_angle=32427)
    found = sensor.parse(data, units=True)
    assert (found.speed, found.start_angle, found.header) == (
        3600,
        pytest.approx(324.27),
        b"\x54\x2c",
    )
    raw = sensor.parse(data)
    assert [point.distance for point in found.points] == pytest.approx(
        [point.distance / 1000 for point in raw.points]
    )
    assert [point.intensity for point in found.points] == [point.intensity for point in raw.points]
    assert sensor.build("data", found, units=True) == data
    broken = data[:-1] + bytes([data[-1] ^ 1])
    assert sensor.parse(broken, verify=False, units=True).start_angle == pytest.approx(324.27)


@each_sensor
def test_a_parsed_frame_builds_the_same_bytes(name: str) -> None:
    """P7: raw and in units, reserved bits and padding included."""
    sensor = load_sensor(name)
    for frame in sensor.frames:
        for seed in range(SHAPE_EXAMPLES if name in SHAPES else 1):
            data = sensor.example(frame, seed=seed)
            assert sensor.build(frame, sensor.parse(data, frame)) == data
            if name != "shape-numbers":  # its numbers are wider than a float holds
                assert (
                    sensor.build(frame, sensor.parse(data, frame, units=True), units=True) == data
                )


class Failing(Checksum):
    """A checksum with a bug."""

    width = 8

    def __call__(self, data: bytes | bytearray | memoryview) -> int:
        return 1 // 0

    def describe(self) -> str:
        return "a checksum with a bug"


def test_a_checksum_that_raises_is_the_plugins_fault() -> None:
    checksummed = Checksummed(Struct("x" / Int8ub, "sum" / Int8ub), "sum", Failing())
    sensor = against_construct.sensor(checksummed)
    for use in (lambda: sensor.parse(b"\1\2"), lambda: sensor.build("data", x=1)):
        with pytest.raises(SpecError, match="ZeroDivisionError") as error:
            use()
        assert (error.value.path, error.value.sensor) == ("data", sensor.id)
    assert len(sensor.parse(b"\1\2", frame="data", verify=False)) == 2


def test_a_complete_frame_with_trailing_bytes_is_named_by_its_own_type() -> None:
    sensor = load_sensor("shape-twins")
    for name in ("data", "info"):
        with pytest.raises(ls.WireError) as caught:
            sensor.parse(sensor.example(name) + b"\0")
        assert (caught.value.frame, caught.value.kind) == (name, "trailing bytes")


def test_a_frame_above_its_maximum_length_is_named_with_the_length() -> None:
    struct = Struct("count" / Int8ub, "ranges" / Array(this.count, Int16ub))
    sensor = against_construct.sensor(struct, max_length=20)
    with pytest.raises(ls.WireError, match="ranges: expected a frame of 1 to 20 bytes"):
        sensor.parse(b"\x0f" + bytes(30))
