"""Tests of texts and numbers whose end is found by reading them."""

from __future__ import annotations

from typing import Any

import pytest
from construct import (
    Const,
    CString,
    Default,
    GreedyBytes,
    Int8ub,
    NullTerminated,
    PaddedString,
    Struct,
    VarInt,
    ZigZag,
)

from lidarspec import UsageError, WireError
from lidarspec.errors import MissingField
from lidarspec.frames.measured_size import TextSize
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
    """These lengths end at the border of the window that is searched in each frame."""
    ours = make_sensor(NullTerminated(GreedyBytes, term=term))
    lengths = [length - length % len(term), 0, 2]
    frames = [b"x" * length + term + b"\7" for length in lengths]
    packets = ours.decode(frames)
    assert packets.count("text").tolist() == lengths
    assert packets["after"].tolist() == [7, 7, 7]
    assert [ours.build("data", ours.parse(data)) for data in frames] == frames


def test_a_text_without_an_end_is_incomplete_or_too_long() -> None:
    ours = make_sensor(CString("ascii"))
    with pytest.raises(WireError, match="text is cut off"):
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
    with pytest.raises(UsageError, match=r"expected bytes, got 'ab'"):
        make_sensor(NullTerminated(GreedyBytes)).build("data", text="ab", after=1)
    with pytest.raises(UsageError, match="5 cannot be encoded: StringError: string encoding"):
        text.build("data", text=5, after=1)
    for wrong in (-1, 1 << 64):
        with pytest.raises(UsageError, match=f"{wrong} is outside 0 .. {2**64 - 1}"):
            number.build("data", text=wrong, after=1)
    assert number.build("data", text=300, after=1) == b"\xac\2\1"


@pytest.mark.parametrize(
    ("number", "value"),
    [
        (VarInt, 2**63 - 1),
        (VarInt, 2**63),
        (VarInt, 2**64 - 1),
        (ZigZag, 2**63 - 1),
        (ZigZag, -(2**63)),
    ],
)
def test_numbers_of_64_bits_are_exact(number: Any, value: int) -> None:
    ours = make_sensor(number)
    data = bytes(number.build(value)) + b"\1"
    assert ours.build("data", text=value, after=1) == data
    assert ours.parse(data).text == value
    assert ours.decode([data]).table.raw("text").tolist() == [value]


@pytest.mark.parametrize(
    ("text", "built"),
    [
        (Default(CString("ascii"), "hi"), b"hi\0\1"),
        (Default(VarInt, 300), b"\xac\2\1"),
        (Default(NullTerminated(GreedyBytes), b"zz"), b"zz\0\1"),
    ],
)
def test_a_missing_text_has_its_default(text: Any, built: bytes) -> None:
    assert make_sensor(text).build("data", after=1) == built


def test_noise_is_searched_a_few_times_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each byte could begin a frame with a text of 6000 bytes."""
    ours = sensor(
        Struct("mark" / Const(b"UU"), "text" / CString("ascii"), "after" / Int8ub),
        max_length=LONGEST,
    )
    searched = 0
    match = TextSize._match

    def count_and_match(size: TextSize, units: Any) -> Any:
        nonlocal searched
        searched += units.size
        return match(size, units)

    monkeypatch.setattr(TextSize, "_match", count_and_match)
    noise = b"U" * 200_000
    assert ours.decoder(stream=True).feed(noise) == []
    assert searched < 100 * len(noise)
