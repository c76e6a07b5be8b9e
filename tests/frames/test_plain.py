"""Tests of frames that only construct can read.

They cover raw numbers, unchecked parsing, errors with an offset, and complete bytes. Each frame
ends with a text up to a terminator, so that it has no layout.
"""

from __future__ import annotations

from typing import Any

import pytest
from construct import (
    Array,
    Bytes,
    Check,
    Const,
    Construct,
    Enum,
    Float32l,
    GreedyBytes,
    GreedyRange,
    If,
    Int8ub,
    Int16ub,
    Int32ub,
    NullTerminated,
    Prefixed,
    Struct,
    Switch,
    this,
)

from lidarspec import Sensor, UsageError, WireError
from lidarspec.explaining.explanation import explain
from tests.engine.against_construct import sensor
from tests.engine.engines import is_compiled

MARK = 0x5A


def plain_sensor(*members: Construct, max_length: int = 64) -> Sensor:
    """Return a sensor with these members between a constant and a text."""
    mark = "mark" / Const(MARK, Int8ub)
    text = "text" / NullTerminated(GreedyBytes, require=False)
    made = sensor(Struct(mark, *members, text), max_length=max_length)
    assert not is_compiled(made.frames["data"])
    return made


def test_a_signalling_nan_is_built_as_it_was_parsed() -> None:
    ours = plain_sensor("value" / Float32l)
    data = bytes([MARK]) + bytes.fromhex("0100a07f") + b"x\0"
    assert ours.build("data", ours.parse(data)) == data


def test_a_wrong_constant_is_reported_and_can_be_parsed_unchecked() -> None:
    ours = plain_sensor()
    with pytest.raises(WireError) as raised:
        ours.parse(b"\x5bx\0", frame="data")
    fault = raised.value
    assert (fault.path, fault.offset, fault.expected, fault.got) == ("mark", 0, "0x5a", "0x5b")
    assert ours.parse(b"\x5bx\0", frame="data", verify=False).mark == 0x5B


def test_a_frame_that_fails_its_check_is_read_unchecked_and_explained() -> None:
    ours = plain_sensor("a" / Int8ub, "valid" / Check(lambda found: found.a in (1, 2)))
    data = bytes([MARK, 9]) + b"x\0"
    with pytest.raises(WireError, match="valid"):
        ours.parse(data, frame="data")
    assert ours.parse(data, frame="data", verify=False).a == 9
    assert explain(data, ours).fields["a"].raw == 9


@pytest.mark.parametrize("kind", [1, "short"])
def test_a_case_is_found_by_number_and_by_name(kind: Any) -> None:
    ours = plain_sensor(
        "kind" / Enum(Int8ub, short=1, long=2),
        "value" / Switch(this.kind, {"short": Int8ub, "long": Int16ub}),
    )
    data = bytes([MARK, 1, 7]) + b"x\0"
    assert ours.parse(data).value == 7
    assert ours.build("data", kind=kind, value=7, text=b"x", mark=MARK) == data


def test_an_error_names_the_element() -> None:
    ours = plain_sensor("count" / Int8ub, "rows" / Array(this.count, Struct("x" / Int16ub)))
    with pytest.raises(WireError) as raised:
        ours.parse(bytes([MARK, 2, 0, 1, 0]), frame="data")
    assert raised.value.path == "rows[1].x"
    with pytest.raises(UsageError, match=r"rows\[1\]\.x"):
        ours.build("data", mark=MARK, rows=[{"x": 1}, {"x": -1}], text=b"", count=2)
    with pytest.raises(UsageError, match="rows"):
        ours.build("data", mark=MARK, rows=7, text=b"", count=2)


def test_a_count_of_elements_without_a_byte_is_bounded_by_the_frame() -> None:
    ours = plain_sensor(
        "count" / Int32ub, "rows" / Array(this.count, Struct("x" / If(this._.count == 0, Int8ub)))
    )
    with pytest.raises(WireError, match="count"):
        ours.parse(bytes([MARK]) + b"\xff\xff\xff\xffx\0", frame="data")


def test_a_length_that_no_frame_has_is_invalid_at_once() -> None:
    ours = plain_sensor("size" / Int8ub, "content" / Bytes(this.size - 1))
    for size in (0, 200):
        decoder = ours.decoder(stream=True)
        decoder.feed(bytes([MARK, size, 0, 0]))
        assert decoder.stats.bad_length == 1
        assert decoder.stats.pending == 0
    with pytest.raises(UsageError, match="content"):
        ours.build("data", mark=MARK, size=2, content=["x"], text=b"")


def test_a_greedy_element_that_fails_is_an_error_and_not_left_out() -> None:
    row = Struct("mark" / Const(b"R"), "size" / Int8ub, "content" / Bytes(this.size))
    ours = plain_sensor("rows" / Prefixed(Int8ub, GreedyRange(row)))
    whole = bytes([MARK, 6]) + b"R\1aR\1b" + b"x\0"
    assert ours.build("data", ours.parse(whole)) == whole
    damaged = bytes([MARK, 6]) + b"R\1aX\1b" + b"x\0"
    with pytest.raises(WireError, match=r"rows\[1\]"):
        ours.parse(damaged, frame="data")
