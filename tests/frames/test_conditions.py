"""Tests that every engine enforces a struct's conditions as construct does."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Check,
    Enum,
    Error,
    ExprValidator,
    Float32b,
    If,
    Int8sb,
    Int8ub,
    Int16ub,
    Int32ub,
    Mapping,
    NoneOf,
    OneOf,
    Struct,
    Switch,
    this,
)

from lidarspec import UsageError, WireError
from lidarspec.spec import Frame, Parts, Simulation
from tests.by_construct import reader
from tests.engine.against_construct import BACKENDS, agree, sensor
from tests.engine.engines import interpreted_reason, is_compiled

FIRST_BYTES = (0, 1, 5, 6, 10, 20, 51, 255)
ANY = [
    bytes([first, second, third])
    for first in FIRST_BYTES
    for second in (0, 1, 2, 9, 128, 255)
    for third in (0, 3, 200)
]
CONDITIONS: dict[str, Any] = {
    "one of": Struct("a" / OneOf(Int8ub, [5, 10, 255]), "b" / Int16ub),
    "none of": Struct("a" / NoneOf(Int8sb, [5, -1]), "b" / NoneOf(Int16ub, range(0x200, 0x300))),
    "a function": Struct(
        "a" / ExprValidator(Int8ub, lambda value, _: value % 3 == 0), "b" / Int16ub
    ),
    "a named one": Struct(
        "a" / OneOf(Enum(Int8ub, low=5, high=10), ["high", "low"]), "b" / Int16ub
    ),
    "bits": Struct(
        "a" / BitStruct("x" / OneOf(BitsInteger(3), [0, 4]), "y" / BitsInteger(5)),
        "b" / Array(2, Int8ub),
    ),
    "elements": Struct(
        "a" / Int8ub,
        "v" / Array(2, Struct("b" / Int8ub, "ok" / Check((this.b <= this._.a) & (this.b != 3)))),
    ),
    "no elements": Struct(
        "a" / Int8ub, "b" / Int16ub, "v" / Array(this.a * 0, Struct("ok" / Check(this._.a < 20)))
    ),
    "a branch": Struct(
        "a" / Int8ub, "b" / Int16ub, "v" / If(this.a > 50, Struct("ok" / Check(this._.b < 512)))
    ),
    "an element": Struct("a" / Int8ub, "v" / Array(2, Int8ub), "ok" / Check(this.v[1] < this.a)),
    "errors": Struct(
        "a" / Int8ub,
        "v"
        / Switch(
            this.a,
            {5: Struct("d" / Int16ub), 10: Struct("b" / Int8ub, "c" / Int8ub)},
            default=Error,
        ),
    ),
}


@pytest.mark.parametrize("name", CONDITIONS)
def test_frames_are_judged_as_construct_judges_them(name: str) -> None:
    ours = sensor(CONDITIONS[name])
    assert is_compiled(ours.frames["data"])
    assert 3 <= agree(CONDITIONS[name], ANY) < len(ANY) or name == "no elements"
    assert all(ours.parse(ours.example("data", seed=seed)) for seed in range(5))


def test_a_case_that_is_an_error_is_named() -> None:
    ours = sensor(CONDITIONS["errors"])
    with pytest.raises(WireError, match=r"v: the fields before it select an invalid case"):
        ours.parse(b"\7\1\2")
    with pytest.raises(UsageError, match=r"v: these values select an invalid case"):
        ours.build("data", a=7, v={"d": 1})


@pytest.mark.parametrize("backend", BACKENDS)
def test_forbidden_values_are_counted_shown_and_not_built(backend: str) -> None:
    ours = sensor(Struct("a" / OneOf(Int8ub, [1, 2]), "b" / Int8ub, "ok" / Check(this.b < 9)))
    packets = reader(ours, backend).decode(b"\1\2\3\4\2\x09\2\3")
    assert packets["b"].tolist() == [2, 3]
    assert (packets.stats.implausible, packets.stats.bytes_skipped) == (4, 4)
    assert ours.parse(b"\3\x09", verify=False).a == 3
    with pytest.raises(WireError) as fault:
        ours.parse(b"\3\4")
    assert (fault.value.path, fault.value.offset) == ("a", 0)
    with pytest.raises(WireError) as fault:
        ours.parse(b"\1\x09")
    assert fault.value.path == "ok"
    for values in (dict(a=3, b=1), dict(a=1, b=9)):
        with pytest.raises(UsageError, match=r"a: |ok: "):
            ours.build("data", **values)


def test_an_example_along_the_sweep_has_values_that_are_allowed() -> None:
    frame = Frame(
        Struct("a" / OneOf(Int32ub, [7, 9]), "b" / Int32ub),
        data=True,
        plausible=lambda f: f.b == 1000,
    )
    ours = replace(
        sensor(frame.struct), frames={"data": frame}, simulation=Simulation(lambda i: {"b": 1000})
    )
    assert {ours.parse(ours.example("data", seed=seed)).a for seed in range(20)} == {7, 9}


def test_a_mapping_is_names_of_all_values_that_there_are() -> None:
    ours = sensor(
        Struct("a" / Mapping(Int8ub, {"low": 5, "high": 255}), "b" / Array(this.a == "low", Int8ub))
    )
    assert is_compiled(ours.frames["data"])
    assert [ours.parse(data).a.name for data in (b"\5\7", b"\xff")] == ["low", "high"]
    assert [ours.build("data", a=name, b=[7] * (name == "low")) for name in ("low", "high")] == [
        b"\5\7",
        b"\xff",
    ]
    assert ours.decode([b"\5\7", b"\xff", b"\6"])["a"].tolist() == [5, 255]
    with pytest.raises(WireError) as fault:
        ours.parse(b"\6")
    assert (fault.value.path, fault.value.offset) == ("a", 0)


def test_parts_meet_their_own_conditions() -> None:
    part = Struct("kind" / OneOf(Int8ub, [1, 2]), "value" / Int8ub, "ok" / Check(this.value != 7))
    ours = sensor(Struct("count" / OneOf(Int8ub, [1, 2]), "parts" / Parts(part, this.count)))
    good, wrong = b"\2\1\5\2\6", [b"\2\3\5\2\6", b"\2\1\7\2\6"]
    assert [len(ours.decode([data])) for data in (good, *wrong)] == [1, 0, 0]
    assert ours.parse(good).parts[1].value == 6
    for data in wrong:
        with pytest.raises(WireError, match=r"parts\[0\]"):
            ours.parse(data)


@pytest.mark.parametrize(
    "check",
    [
        Check(lambda found: found.a > 3 and found.b),
        Check(this.f < 1.5),
        Check(this.v == 3),
        Check(this.a % this.b == 0),
    ],
)
def test_unsupported_conditions_get_a_suggestion(check: Any) -> None:
    struct = Struct(
        "a" / Int32ub, "b" / Int8ub, "f" / Float32b, "v" / Array(2, Int8ub), "ok" / check
    )
    frame = sensor(struct).frames["data"]
    assert not is_compiled(frame)
    assert "plausible=lambda f: ..." in interpreted_reason(frame)
