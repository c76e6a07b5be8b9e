"""Tests of texts and numbers whose end is found by reading them."""

from __future__ import annotations

from typing import Any

import pytest
from construct import CString, GreedyBytes, Int8ub, NullTerminated, PaddedString, Struct, VarInt

from lidarspec import UsageError, WireError
from lidarspec.errors import MissingField
from lidarspec.spec import Sensor
from tests.engine.against_construct import sensor
from tests.engine.engines import is_compiled

LONGEST = 6000


def make_sensor(text: Any) -> Sensor:
    ours = sensor(Struct("text" / text, "after" / Int8ub), max_length=LONGEST)
    assert is_compiled(ours.frames["data"])
    return ours


@pytest.mark.parametrize("term", [b"\0", b"\r\n"])
@pytest.mark.parametrize("length", [0, 1, 31, 32, 33, 63, 64, 65, 287, 288, 289, 5000])
def test_the_end_is_found_in_texts_of_any_length(term: bytes, length: int) -> None:
    """The search advances in steps; these lengths end at the border of a step."""
    ours = make_sensor(NullTerminated(GreedyBytes, term=term))
    lengths = [length - length % len(term), 0, 2]
    frames = [b"x" * length + term + b"\7" for length in lengths]
    packets = ours.decode(frames)
    assert packets.count("text").tolist() == lengths
    assert packets["after"].tolist() == [7, 7, 7]
    assert [ours.build("data", ours.parse(data)) for data in frames] == frames


def test_a_text_without_an_end_is_incomplete_or_too_long() -> None:
    ours = make_sensor(CString("ascii"))
    with pytest.raises(WireError, match="cut off"):
        ours.parse(b"abc")
    stats = ours.decode([b"abc", b"x" * (LONGEST + 9)]).stats
    assert (stats.frames, stats.bad_length) == ({}, 2)


@pytest.mark.parametrize(
    ("text", "data", "said"),
    [
        (CString("utf8"), b"\xff\0\1", "text at byte 0: value ff, expected text utf8"),
        (PaddedString(2, "utf8"), b"\xff\0\1", "text at byte 0: value ff 00, expected text utf8"),
        (VarInt, b"\x80\0\1", "text at byte 0: value 80 00, expected VarInt in its shortest form"),
        (VarInt, b"\xff" * 10 + b"\1\1", "expected VarInt in its shortest form"),
    ],
)
def test_a_value_that_cannot_be_decoded_is_named(text: Any, data: bytes, said: str) -> None:
    ours = make_sensor(text)
    for verify in (True, False):
        with pytest.raises(WireError, match=said):
            ours.parse(data, frame="data", verify=verify)
    assert ours.decode([data]).stats.implausible == 1


def test_values_that_cannot_be_built_are_refused() -> None:
    text, number = make_sensor(CString("ascii")), make_sensor(VarInt)
    with pytest.raises(UsageError, match=r"text: expected bytes without 00, got b'a\\x00b'"):
        text.build("data", text="a\0b", after=1)
    with pytest.raises(MissingField, match="'text'"):
        text.build("data", after=1)
    with pytest.raises(UsageError, match="more than 64 bits"):
        number.build("data", text=1 << 64, after=1)
    assert number.build("data", text=300, after=1) == b"\xac\2\1"
