"""Tests of parts selected by a named value: every engine agrees with construct."""

from __future__ import annotations

import random
import re
from typing import Any

import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    Construct,
    Enum,
    GreedyBytes,
    If,
    IfThenElse,
    Int8ub,
    Int16ub,
    Int24ub,
    Int32ub,
    NullTerminated,
    Rebuild,
    Struct,
    Switch,
    this,
)

from lidarspec import SpecError
from lidarspec.exports import list_frames
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.spec import Scaled
from lidarspec.spec.tree import Select, nodes
from tests.by_construct import reader
from tests.engine.against_construct import BACKENDS, agree, sensor
from tests.engine.engines import is_compiled

KIND = Enum(Int8ub, idle=1, busy=2, lost=7)
FLAGS = BitStruct("low" / BitsInteger(5), "kind" / Enum(BitsInteger(3), idle=1, busy=2))

CHOICES: dict[str, Any] = {
    "names": Struct(
        "kind" / KIND,
        "body" / Switch(this.kind, {"idle": Int8ub, "busy": Int16ub}, default=Int32ub),
    ),
    "numbers": Struct(
        "kind" / KIND,
        "body" / Switch(this.kind, {1: Int8ub, 2: Int16ub, 3: Int16ub}, default=Int32ub),
    ),
    "names and numbers": Struct(
        "kind" / KIND,
        "body" / Switch(this.kind, {2: Int8ub, "busy": Int16ub, 3: Int24ub}, default=Int32ub),
    ),
    "no default": Struct("kind" / KIND, "body" / Switch(this.kind, {"idle": Struct("a" / Int8ub)})),
    "a condition": Struct("kind" / KIND, "body" / IfThenElse(this.kind == "busy", Int8ub, Int16ub)),
    "a function": Struct(
        "kind" / KIND, "body" / If(lambda found: found.kind in ("idle", "lost"), Int8ub)
    ),
    "its number": Struct("kind" / KIND, "body" / Array(lambda found: int(found.kind) % 4, Int8ub)),
    "bits": Struct(
        "flags" / FLAGS,
        "body" / Switch(this.flags.kind, {"idle": Int8ub, "busy": Int16ub}, default=Int32ub),
    ),
    "an array": Struct(
        "kind" / KIND,
        "rows"
        / Array(
            2, Struct("x" / Int8ub, "y" / Switch(this._.kind, {"busy": Int16ub}, default=Int8ub))
        ),
    ),
    "further out": Struct(
        "head" / Struct("kind" / KIND),
        "body" / Struct("x" / Switch(this._.head.kind, {"lost": Int8ub})),
    ),
    "a constant": Struct(
        "kind" / Const("busy", KIND), "body" / Switch(this.kind, {"busy": Int16ub}, default=Int8ub)
    ),
    "a constant inside": Struct(
        "x" / Int8ub,
        "kind" / Enum(Const(2, Int8ub), idle=1, busy=2),
        "y" / If(this.kind == "busy", Int8ub),
    ),
    "constant bits": Struct(
        "x" / Int8ub,
        "f"
        / BitStruct("low" / BitsInteger(4), "kind" / Const("b", Enum(BitsInteger(4), a=1, b=2))),
    ),
}


#: Python functions that decide on the value of a field, and numbers that have names.
UNTRACED = {"a function", "its number", "numbers"}


@pytest.mark.parametrize("name", CHOICES)
def test_named_values_choose_as_in_construct(name: str) -> None:
    struct, source = CHOICES[name], random.Random(name)
    ours = sensor(struct)
    assert is_compiled(ours.frames["data"]) == (name not in UNTRACED)
    frames = {
        bytes([head, *source.randbytes(size)])
        for head in (*range(10), 0x21, 0x22, 255)
        for size in range(1, 6)
    }
    examples = {ours.example("data", seed=seed) for seed in range(20)}
    assert agree(struct, sorted(frames | examples)) > len(examples) / 2


def test_headers_that_mean_the_same_have_one_layout() -> None:
    """Headers with lengths that are too long share one layout, and so do unknown keys.

    Otherwise each header in noise would need a new layout, because it has a new length and key.
    """
    body = Switch(
        this.key,
        {5: Int8ub, 70_000: Int16ub},
        default=Struct("data" / Bytes(this._.length * 2 - 3)),
    )
    ours = sensor(
        Struct(
            "length" / Int32ub,
            "key" / Int32ub,
            "body" / body,
            "tail" / Array(this.length + 1, Int16ub),
        ),
        max_length=100,
    )
    engine, source = get_codec(ours.frames["data"]), random.Random(1)
    assert isinstance(engine, CompiledCodec)
    found = set[object]()
    for number in range(3000):
        length = source.choice((number % 60, source.randrange(1 << 32)))
        key = source.choice((5, 70_000, number, source.randrange(1 << 32)))
        layout = engine.tree.layout(length.to_bytes(4) + key.to_bytes(4))
        size = 10 + 2 * length + {5: 1, 70_000: 2}.get(key, 2 * length - 3)
        is_frame = size <= 100 and (length > 1 or key in (5, 70_000))
        assert getattr(layout, "size", None) == (size if is_frame else None), (length, key)
        found.add(layout)
    assert len(found) < 200, "frames of each length for three kinds of keys, and the refused"


def test_a_number_is_built_as_its_name_is() -> None:
    ours = sensor(CHOICES["names"])
    assert [ours.build("data", kind=kind, body=3) for kind in (1, "idle", 2, 4)] == [
        b"\1\3",
        b"\1\3",
        b"\2\0\3",
        b"\4\0\0\0\3",
    ]


@pytest.mark.parametrize("inside", [False, True])
def test_default_values_are_not_required_when_parsing(inside: bool) -> None:
    """`Rebuild` applies to building only; parsing accepts and keeps any value.

    This holds for single frames and both decoders.
    """
    length = "length" / Rebuild(Int8ub, this._.size + 1 if inside else this.size + 1)
    head = "head" / Struct(length) if inside else length
    ours = sensor(Struct("size" / Int8ub, head, "data" / Array(this.size, Int8ub)))
    right, wrong = b"\2\3\7\7", b"\2\x09\7\7"
    assert ours.build("data", ours.parse(right)) == ours.build("data", ours.parse(wrong)) == right
    for backend in BACKENDS:
        found = reader(ours, backend).decode([right, wrong])
        assert found["head.length" if inside else "length"].tolist() == [3, 9]
    assert [
        ours.parse(data).head.length if inside else ours.parse(data).length
        for data in (right, wrong)
    ] == [3, 9]


def test_examples_are_of_every_name() -> None:
    ours = sensor(CHOICES["names"])
    assert {len(ours.example("data", seed=seed)) for seed in range(40)} == {2, 3, 5}


def test_plain_examples_use_the_number_of_a_named_constant() -> None:
    rows = Array(lambda found: int(found.kind) % 4, Int8ub)
    ours = sensor(
        Struct(
            "kind" / Const("busy", KIND),
            "rows" / rows,
            "text" / Array(1, NullTerminated(GreedyBytes)),
        )
    )
    assert {len(ours.parse(ours.example("data", seed=seed)).rows) for seed in range(5)} == {2}


def test_a_constant_is_one_of_the_names() -> None:
    with pytest.raises(SpecError, match="bsuy"):
        get_codec(sensor(Struct("kind" / Const("bsuy", KIND))).frames["data"])


def test_one_field_has_one_unit() -> None:
    """Otherwise the column would have the unit of the first branch."""
    fine, coarse = Scaled(Int16ub, 0.001, "m"), Scaled(Int16ub, 0.002, "m")
    for other in (
        coarse,
        Scaled(Int16ub, 0.001, "deg"),
        Scaled(Int16ub, 0.001, "m", offset=1),
        Int16ub,
    ):
        rows = [Array(2, Struct("far" / part)) for part in (fine, other)]
        with pytest.raises(SpecError, match=r"rows\.far"):
            sensor(
                Struct(
                    "kind" / KIND, "rows" / Switch(this.kind, {"idle": rows[0], "busy": rows[1]})
                )
            )
    kept = sensor(
        Struct(
            "kind" / KIND,
            "far" / Switch(this.kind, {"idle": fine, "busy": Scaled(Int32ub, 0.001, "m")}),
        )
    )
    assert kept.decode([b"\1\0\5", b"\2\0\1\0\0"])["far"].tolist() == [0.005, 65.536]


def test_exports_omit_unreachable_branches() -> None:
    (found,) = [
        node
        for node in nodes(list_frames(sensor(CHOICES["names and numbers"]))[0].root)
        if isinstance(node, Select)
    ]
    assert [key for key, _ in found.cases] == [2, 3]


@pytest.mark.parametrize(
    ("body", "advice"),
    [
        (If(this.kind == 2, Int8ub), "kind == 2 is never true,.* write kind == 'busy'"),
        (If(lambda found: found.kind == 2, Int8ub), "write kind == 'busy'"),
        (IfThenElse(this.kind != 1, Int8ub, Int16ub), "is always true,.* write kind != 'idle'"),
        (If((this.x > 3) | (this.kind == 2), Int8ub), "write kind == 'busy'"),
        (Switch(this.kind, {2: Int8ub}), "the case 2 is never selected,.* write 'busy'"),
    ],
)
def test_a_number_that_has_a_name_is_reported(body: Construct, advice: str) -> None:
    struct = Struct("kind" / KIND, "x" / Int8ub, "body" / body)
    ours = sensor(struct)
    for data in (b"\1\2", b"\2\3", b"\2\x07\1", b"\1\2\3", b"\4\0\1\2"):
        agree(struct, [data])
    codec = get_codec(ours.frames["data"])
    assert not codec.is_compiled
    assert re.search(advice, codec.reason), codec.reason


def test_a_number_without_a_name_selects_its_case() -> None:
    assert is_compiled(
        sensor(Struct("kind" / KIND, "x" / If(this.kind == 9, Int8ub))).frames["data"]
    )
