"""Tests of computed lengths: set on building, and verified on parsing.

Both engines must agree. The tests also cover construct's prefixes, paddings and alignment.
"""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from construct import (
    Aligned,
    Array,
    BitsInteger,
    BitStruct,
    Const,
    CString,
    FixedSized,
    GreedyBytes,
    GreedyRange,
    If,
    Int8ub,
    Int16ub,
    Prefixed,
    PrefixedArray,
    Struct,
    Switch,
    VarInt,
    this,
)

import lidarspec as ls
from lidarspec import SpecError, UsageError, WireError
from lidarspec.framing.frame_engine import get_codec
from lidarspec.spec import Checksummed, Parts, SizeOf, Sum
from tests.by_construct import construct_frame
from tests.engine.against_construct import plain, sensor
from tests.engine.engines import is_compiled

POINT = Struct("d" / Int16ub, "q" / Int8ub)
TWO = [dict(d=1, q=2), dict(d=3, q=4)]
POINTS = "000102000304"
BODY = Struct("n" / Int8ub, "points" / Array(this.n, POINT))

#: by name: members behind a constant; values of a frame; its bytes from there on; what else is read
#: of it.
MEASURED: dict[str, tuple[list[Any], dict[str, Any], str, dict[str, Any]]] = {
    "a part": (
        ["length" / SizeOf(Int16ub, "v", 1), "v" / BODY],
        dict(v=dict(points=TWO)),
        f"0008 02{POINTS}",
        dict(length=8),
    ),
    "itself": (
        ["length" / SizeOf(Int16ub, plus=-4), "v" / Array(this.length // 3, POINT)],
        dict(v=TWO),
        f"0006 {POINTS}",
        dict(length=6),
    ),
    "beside it": (
        ["h" / Struct("length" / SizeOf(Int16ub, "_.v")), "v" / BODY],
        dict(v=dict(points=TWO)),
        f"0007 02{POINTS}",
        {},
    ),
    "within it": (
        ["length" / SizeOf(Int8ub, "v.points"), "v" / BODY],
        dict(v=dict(points=TWO)),
        f"06 02{POINTS}",
        dict(length=6),
    ),
    "in bits": (
        [
            "h" / BitStruct("k" / BitsInteger(4), "length" / SizeOf(BitsInteger(12), "_.v")),
            "v" / BODY,
        ],
        dict(h=dict(k=3), v=dict(points=TWO)),
        f"3007 02{POINTS}",
        {},
    ),
    "in elements": (
        ["v" / Array(2, Struct("length" / SizeOf(Int8ub), "p" / POINT))],
        dict(v=[dict(p=p) for p in TWO]),
        "04000102 04000304",
        {},
    ),
    "under a checksum": (
        [
            "v"
            / Checksummed(
                Struct("length" / SizeOf(Int8ub), "p" / POINT, "sum" / Int8ub),
                field="sum",
                algorithm=Sum(8),
            )
        ],
        dict(v=dict(p=TWO[0])),
        "05 000102 08",
        {},
    ),
    "of alternatives": (
        [
            "k" / Int8ub,
            "length" / SizeOf(Int8ub, "v"),
            "v" / Switch(this.k, {1: BODY}, Struct("z" / Int8ub)),
        ],
        dict(k=1, v=dict(points=TWO)),
        f"01 07 02{POINTS}",
        dict(length=7),
    ),
    "of what may not be there": (
        ["k" / Int8ub, "length" / SizeOf(Int8ub, "v"), "v" / If(this.k & 1, BODY)],
        dict(k=2, v=None),
        "02 00",
        dict(length=0),
    ),
    "of parts": (
        [
            "length" / SizeOf(Int16ub, "v"),
            "v"
            / Parts(
                Struct("size" / SizeOf(Int8ub), "points" / PrefixedArray(Int8ub, POINT)),
                within=this.length,
            ),
        ],
        dict(v=[dict(points=TWO), dict(points=[])]),
        f"000a 0802{POINTS} 0200",
        dict(length=10),
    ),
    "PrefixedArray": (
        ["v" / PrefixedArray(Int8ub, POINT)],
        dict(v=TWO),
        f"02 {POINTS}",
        dict(v_count=2),
    ),
    "Prefixed bytes": (
        ["v" / Prefixed(Int16ub, GreedyBytes, includelength=True)],
        dict(v=b"ab"),
        "0004 6162",
        dict(v_size=4),
    ),
    "Prefixed struct": (
        ["v" / Prefixed(Int8ub, BODY)],
        dict(v=dict(points=TWO)),
        f"07 02{POINTS}",
        dict(v_size=7),
    ),
    "Prefixed rest": (
        [
            "v"
            / Prefixed(
                Int8ub, Struct("n" / Int8ub, "points" / Array(this.n, POINT), "rest" / GreedyBytes)
            )
        ],
        dict(v=dict(points=TWO, rest=b"ab")),
        f"09 02{POINTS}6162",
        dict(v_size=9),
    ),
    "Prefixed range": (
        ["v" / Prefixed(Int8ub, GreedyRange(POINT))],
        dict(v=TWO),
        f"06 {POINTS}",
        dict(v_size=6),
    ),
    "Prefixed under a condition": (
        ["k" / Int8ub, "v" / If(this.k == 1, Prefixed(Int8ub, BODY))],
        dict(k=1, v=dict(points=TWO)),
        f"01 07 02{POINTS}",
        dict(v_size=7),
    ),
    "Prefixed that is not there": (
        ["k" / Int8ub, "v" / If(this.k == 1, Prefixed(Int8ub, BODY))],
        dict(k=2, v=None),
        "02",
        dict(v_size=None),
    ),
    "Aligned under a condition": (
        ["k" / Int8ub, "v" / If(this.k == 1, Aligned(4, BODY))],
        dict(k=1, v=dict(points=TWO)),
        f"01 02{POINTS} 00",
        dict(v_padding=b"\0"),
    ),
    "Prefixed PrefixedArray": (
        ["v" / Prefixed(Int8ub, PrefixedArray(Int8ub, POINT))],
        dict(v=TWO),
        f"07 02 {POINTS}",
        dict(v_size=7, v_count=2),
    ),
    "FixedSized": (
        ["v" / FixedSized(9, BODY)],
        dict(v=dict(points=TWO)),
        f"02{POINTS} 0000",
        dict(v_padding=b"\0\0"),
    ),
    "FixedSized by a field": (
        ["k" / Int8ub, "v" / FixedSized(this.k, Struct("p" / POINT, "rest" / GreedyBytes))],
        dict(k=4, v=dict(p=TWO[0], rest=b"a")),
        "04 000102 61",
        {},
    ),
    "Aligned": (
        ["v" / Aligned(4, PrefixedArray(Int8ub, POINT), pattern=b"\xee")],
        dict(v=TWO),
        f"02{POINTS} ee",
        dict(v_count=2, v_padding=b"\xee"),
    ),
    "of a text": (
        ["length" / SizeOf(Int16ub, "v"), "v" / CString("ascii")],
        dict(v="abc"),
        "0004 61626300",
        dict(length=4),
    ),
    "in elements that differ": (
        ["v" / Array(2, Struct("x" / Prefixed(Int8ub, GreedyBytes)))],
        dict(v=[dict(x=b"a"), dict(x=b"")]),
        "0161 00",
        {},
    ),
}
INTERPRETED: dict[str, tuple[list[Any], dict[str, Any], str, dict[str, Any]]] = {
    "of no fixed width": (
        ["v" / Prefixed(VarInt, GreedyBytes)],
        dict(v=bytes(130)),
        "8201" + "00" * 130,
        dict(v_size=130),
    ),
}
ALL = {**MEASURED, **INTERPRETED}


def make_sensor(name: str) -> Any:
    return sensor(Struct("magic" / Const(b"\xf1\x5a"), *ALL[name][0]), max_length=300)


@pytest.mark.parametrize("name", ALL)
def test_lengths_are_filled_in_and_round_trip(name: str) -> None:
    ours, (_, values, data, more) = make_sensor(name), ALL[name]
    assert is_compiled(ours.frames["data"]) is (name in MEASURED)
    built = ours.build("data", values)
    assert built == b"\xf1\x5a" + bytes.fromhex(data)
    parsed = plain(ours.parse(built))
    assert {key: parsed[key] for key in more} == more
    for seed in range(8):
        example = ours.example("data", seed=seed)
        assert ours.build("data", ours.parse(example)) == example


@pytest.mark.parametrize("name", MEASURED)
def test_frames_are_held_to_their_lengths_as_by_construct(name: str) -> None:
    ours, source = make_sensor(name), random.Random(name)
    codecs = get_codec(ours.frames["data"]), get_codec(construct_frame(ours.frames["data"]))
    refused = 0
    for seed in range(8):
        example = ours.example("data", seed=seed)
        for _ in range(12):
            data = bytearray(example)
            data[source.randrange(2, len(data))] ^= 1 << source.randrange(8)
            row = np.frombuffer(bytes(data) + bytes(40), np.uint8)
            found = [each.survey(row, np.zeros(1, np.intp)) for each in codecs]
            sizes = [int(one.sizes[0]) if one.status[0] == 0 else 0 for one in found]
            assert sizes[0] == sizes[1], data.hex()
            refused += not sizes[0]
    assert refused or name in (
        "PrefixedArray",
        "Prefixed bytes",
        "FixedSized",
        "FixedSized by a field",
        "Aligned",
        "Aligned under a condition",
    )


def test_a_wrong_length_shows_the_expected_one() -> None:
    ours = make_sensor("a part")
    with pytest.raises(WireError) as fault:
        ours.parse(bytes.fromhex(f"f15a 0009 02{POINTS}"))
    assert (fault.value.path, fault.value.offset, fault.value.expected, fault.value.got) == (
        "length",
        2,
        8,
        9,
    )
    assert "length       wrong: 9, expected 8" in str(
        ls.explain(bytes.fromhex(f"f15a 0009 02{POINTS}"), ours)
    )
    assert ours.parse(bytes.fromhex(f"f15a 0009 02{POINTS}"), verify=False).length == 9
    assert ours.build("data", length=77, v=dict(points=TWO))[2:4] == b"\0\x08"


def test_padding_is_kept_and_may_be_given() -> None:
    ours = make_sensor("FixedSized")
    data = bytes.fromhex(f"f15a 02{POINTS} abcd")
    assert ours.build("data", ours.parse(data)) == data
    assert ours.build("data", v=dict(points=TWO), v_padding=b"\xab\xcd") == data
    with pytest.raises(UsageError, match="v_padding"):
        ours.build("data", v=dict(points=TWO), v_padding=b"\xab")


def test_a_part_too_long_for_its_length_field_is_refused() -> None:
    ours = sensor(
        Struct("length" / SizeOf(Int8ub, "v"), "n" / Int16ub, "v" / Array(this.n, Int8ub)),
        max_length=1000,
    )
    with pytest.raises(UsageError, match="length"):
        ours.build("data", v=[0] * 300)
    with pytest.raises(WireError) as fault:
        ours.parse(bytes([44, 1, 44]) + bytes(300))
    assert (fault.value.path, fault.value.offset, fault.value.expected, fault.value.got) == (
        "length",
        0,
        300,
        44,
    )
    assert len(ours.decode([bytes([44, 1, 44]) + bytes(300)])) == 0


@pytest.mark.parametrize("part", ["w", "_.v", "v.w"])
def test_the_size_of_a_missing_part_is_a_mistake_in_the_spec(part: str) -> None:
    with pytest.raises(SpecError, match="SizeOf"):
        _ = sensor(Struct("length" / SizeOf(Int8ub, part), "v" / Int8ub)).frames["data"].tree
