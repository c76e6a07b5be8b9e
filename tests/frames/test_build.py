"""Tests of building commands from values: field names and permitted values."""

from __future__ import annotations

import re
from typing import Any

import pytest
from construct import Array, Bytes, Int8ub, Int8ul, Int32ub, Struct, this

from lidarspec import Sensor, SpecError, UsageError
from lidarspec.errors import UnknownField
from lidarspec.spec import Address, Command, Count, Frame, Parts, Text
from tests.broken import sound
from tests.engine import against_construct

FIELDS = {
    "key": Bytes(3),
    "v": Array(2, Int8ul),
    "s": Array(2, Struct("x" / Int8ul)),
    "t": Struct("u" / Int8ul, "w" / Int32ub),
}
ORDER = Frame(Struct(*(name / con for name, con in FIELDS.items())), direction="out")
VALUES = {"key": b"abc", "v": [1, 2], "s": [{"x": 1}] * 2, "t.u": 1, "t.w": 0}


def make_command_sensor(**args: Any) -> Sensor:
    """Return a sensor with a command that has these arguments."""
    return sound.sensor(
        frames={"data": sound.frame(), "order": ORDER},
        commands={"start": Command("order", VALUES, args=args)},
    )


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (("s.x", 0, 9), "'s.x'"),
        (("v", 0, 9), "'v'"),
        (("key", 0, 9), "'key'"),
        (("nothing", 0, 9), "'nothing'"),
        (("t", 0, 9), "'t'"),
        (("v[2]", 0, 9), "2 elements"),
        (("t.u[0]", 0, 9), "the field is inside 0 arrays"),
        (("t.u", Text(3)), "'t.u'"),
    ],
)
def test_an_argument_that_cannot_stand_in_its_field_is_the_authors_fault(
    wrong: Any, named: str
) -> None:
    with pytest.raises(SpecError, match=named) as error:
        make_command_sensor(rate=wrong).command("start", rate=3)
    assert error.value.path == "commands.start.args.rate"


def test_numbers_texts_addresses_and_bytes_go_to_their_places() -> None:
    assert (
        make_command_sensor(rate=("t.u", 0, 9)).command("start", rate=3) == b"abc\1\2\1\1\3\0\0\0\0"
    )
    assert (
        make_command_sensor(a=("v[1]", 0, 9), b=("s[0].x", 0, 9)).command("start", a=7, b=8)
        == b"abc\1\7\x08\1\1\0\0\0\0"
    )
    assert make_command_sensor(name=("key", Text(3))).command("start", name="x")[:3] == b"x\0\0"
    assert make_command_sensor(name=("key", Text(3, b" "))).command("start", name="x")[:3] == b"x  "
    assert make_command_sensor(key=("key", bytes)).command("start", key=b"\1\2\3")[:3] == b"\1\2\3"
    assert make_command_sensor(host=("t.w", Address())).command("start", host="192.168.1.10")[
        -4:
    ] == bytes([192, 168, 1, 10])
    assert VALUES["v"] == [1, 2]


@pytest.mark.parametrize(
    ("kind", "wrong_values"),
    [
        (("t.u", 0, 9), ["3", b"3", [3], None]),
        (("key", Text(8)), ["four", b"abc", 3, "\u00e4"]),
        (("t.w", Address()), ["somewhere", "1.2.3", "::1", 3]),
        (("key", bytes), ["abc", b"ab", 3]),
    ],
)
def test_an_invalid_argument_is_refused(kind: Any, wrong_values: list[Any]) -> None:
    sensor = make_command_sensor(rate=kind)
    for value in wrong_values:
        with pytest.raises(UsageError, match="start: rate"):
            sensor.command("start", rate=value)


def test_arguments_of_no_kind_are_refused_when_they_are_declared() -> None:
    for wrong in [("v",), ("v", 1), ("v", str), (3, 0, 9), ("v", "0", "9")]:
        with pytest.raises(SpecError, match=re.escape(repr(wrong))):
            make_command_sensor(rate=wrong)
    for bits, first in [(0, 0), (8, 256), (8, -1)]:
        with pytest.raises(SpecError, match="Count"):
            Count(bits, first)


def test_a_settings_list_of_parts_takes_arguments_too() -> None:
    setting = Struct("key" / Int8ul, "size" / Int8ul, "value" / Bytes(this.size))
    struct = Struct("number" / Int8ul, "settings" / Parts(setting, count=this.number))
    frames = {"data": sound.frame(), "order": Frame(struct, direction="out", max_length=99)}
    values = {"settings": [{"key": 4, "value": b"\1"}, {"key": 6}]}
    command = Command(
        "order",
        values,
        args={"host": ("settings[1].value", Address()), "name": ("settings[0].value", Text(9))},
    )
    sensor = sound.sensor(frames=frames, commands={"start": command})
    assert (
        sensor.command("start", host="10.0.0.1", name="on").hex(" ")
        == "02 04 02 6f 6e 06 04 0a 00 00 01"
    )


def test_a_path_replaces_a_field_of_a_nested_struct() -> None:
    sensor = make_command_sensor()
    parsed = sensor.parse(b"abc\1\2\1\1\3\0\0\0\0", frame="order")
    data = sensor.build("order", parsed, **{"t.u": 9, "s[1].x": 8, "v[0]": 7, "key": b"xyz"})
    assert data == b"xyz\7\2\1\x08\x09\0\0\0\0"
    assert (parsed.t.u, parsed.s[1].x, parsed.v[0]) == (3, 1, 1)
    assert sensor.build("order", {**parsed, "t": {"u": 0}}, **{"t.w": 1})[7:] == b"\0\0\0\0\1"
    with pytest.raises(UsageError, match=r"t\.nothing"):
        sensor.build("order", parsed, **{"t.nothing": 1})


def test_a_path_that_the_frame_does_not_have_is_refused() -> None:
    ours = against_construct.sensor(
        Struct(
            "flags" / Struct("n" / Int8ub, "v" / Int8ub),
            "numbers" / Array(2, Int8ub),
            "rows" / Array(2, Struct("x" / Int8ub)),
        )
    )
    value = {"flags": {"n": 1, "v": 2}, "numbers": [3, 4], "rows": [{"x": 5}, {"x": 6}]}
    assert ours.build("data", value, **{"rows[1].x": 9}) == bytes([1, 2, 3, 4, 5, 9])
    for path in ("flags.n.q", "numbers.q", "flags v", "flags..n", ""):
        with pytest.raises(UnknownField):
            ours.build("data", value, **{path: 7})
    with pytest.raises(UsageError, match=r"rows\.x cannot be set"):
        ours.build("data", value, **{"rows.x": 7})
