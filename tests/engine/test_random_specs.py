"""Tests that random specs give construct's values, compiled and interpreted."""

from __future__ import annotations

import contextlib
import importlib.util
import io
from collections.abc import Sequence
from random import Random
from typing import Any

import construct
import pytest
from construct import Construct

from lidarspec import Sensor, SpecError
from tests.by_construct import reader
from tests.engine.against_construct import BACKENDS, agree, clouds_agree, parse_by_construct, sensor
from tests.engine.engines import is_compiled
from tests.engine.random_specs import COUNT_OF_ARRAY, make_struct, spec

LONGEST = 150
#: The compiled back end, if it is installed.
JIT = ("jit",) if importlib.util.find_spec("numba") else ()


def frames(ours: Sensor, struct: Construct, number: int) -> list[bytes]:
    """Return inputs for a spec: its examples, damaged ones, and random valid bytes."""
    source, found = Random(number), [b""]
    for seed in range(4):
        try:
            example = ours.example("data", seed=seed)
        except SpecError:
            break
        found += [example, example[:-1], example + b"\0"]
        for _ in range(3):
            damaged = bytearray(example or b"\0")
            damaged[source.randrange(len(damaged))] = source.choice(
                (0, 1, 2, 7, 255, source.randrange(256))
            )
            found.append(bytes(damaged))
    for _ in range(12):
        stream = io.BytesIO(
            bytes(source.choice((0, 1, 2, 7, source.randrange(256))) for _ in range(LONGEST + 10))
        )
        try:
            struct.parse_stream(stream)
        except construct.ConstructError:
            continue
        found.append(stream.getvalue()[: stream.tell()])
    return found


def declare_sensor(struct: Construct) -> Sensor | None:
    """Return a sensor of a spec; None if it is refused because a name has several units."""
    try:
        return sensor(struct, max_length=LONGEST)
    except SpecError as error:
        if "different scales" not in error.reason:
            raise
        return None


def try_spec(
    number: int,
    *,
    interpreted: bool = False,
    adapted: bool = False,
    backends: Sequence[str] = ("numpy", "construct"),
) -> None:
    """Test a spec; add its text to the error of a failure."""
    text = spec(number, interpreted=interpreted, adapted=adapted)
    struct = make_struct(text)
    with contextlib.suppress(construct.SizeofError, KeyError):
        if struct.sizeof() == 0:
            return
    ours = declare_sensor(struct)
    if ours is None:
        return
    try:
        some = frames(ours, struct, number)
        kept = "Rebuild" not in text.replace(COUNT_OF_ARRAY, "")
        agree(struct, some, max_length=LONGEST, kept=kept, has_hidden_fields=adapted)
        if is_compiled(ours.frames["data"]):
            clouds_agree(struct, some, max_length=LONGEST, backends=backends)
    except BaseException as error:
        error.add_note(text)
        raise


def numbers(quick: int, whole: int) -> list[Any]:
    """Return the numbers of specs, of which the first few are in the quick tier."""
    return [
        pytest.param(number, marks=() if number < quick else pytest.mark.slow)
        for number in range(whole)
    ]


@pytest.mark.parametrize("number", numbers(12, 35))
def test_random_structs_parse_as_by_construct(number: int) -> None:
    try_spec(number)


@pytest.mark.parametrize("number", numbers(5, 15))
def test_structs_without_layouts_parse_as_by_construct(number: int) -> None:
    try_spec(number, interpreted=True)


@pytest.mark.parametrize("number", numbers(8, 40))
def test_structs_with_adapted_parts_parse_as_by_construct(number: int) -> None:
    try_spec(number, adapted=True)


@pytest.mark.soak
@pytest.mark.parametrize("block", range(20))
def test_many_more_structs_parse_as_by_construct(block: int) -> None:
    for number in range(100 * block, 100 * block + 100):
        try_spec(number, backends=("numpy", "construct", *JIT))
        try_spec(number, interpreted=True)
        try_spec(number, adapted=True)


def test_most_random_specs_are_compiled_and_have_frames() -> None:
    """Without this, the tests above might test little."""
    structs = [
        struct
        for struct in (make_struct(spec(number)) for number in range(65))
        if declare_sensor(struct) is not None
    ]
    sensors = [sensor(struct, max_length=LONGEST) for struct in structs]
    assert sum(is_compiled(one.frames["data"]) for one in sensors) > 50
    valid = [
        sum(parse_by_construct(struct, data) is not None for data in frames(one, struct, 0))
        for one, struct in zip(sensors, structs, strict=True)
    ]
    assert sum(number > 5 for number in valid) > 50


@pytest.mark.parametrize(
    "part",
    [
        "FlagsEnum(Int8ub, a=1, b=2)",
        "Slicing(Array(3, Int8ub), 3, 0, 1)",
        "Flag",
    ],
)
def test_structs_that_lose_bits_are_refused(part: str) -> None:
    with pytest.raises(SpecError):
        sensor(make_struct(f'Struct("a" / Int8ub, "b" / {part})'))


@pytest.mark.parametrize(
    "text",
    [
        'Struct("a" / Array(0, Int8ub))',
        'Struct("a" / Array(0, Struct("n" / Int8ub, "x" / Bytes(this.n))))',
        "Struct()",
    ],
)
def test_a_frame_without_a_byte_is_never_found(text: str) -> None:
    ours = sensor(make_struct(text))
    for backend in BACKENDS:
        assert len(reader(ours, backend).decode([b"", b"\0"])) == 0


def test_constants_of_missing_elements_are_not_checked() -> None:
    element = (
        'Struct(Const(b"M"), "x" / Switch(this._.n, {7: Struct("y" / Int8ub)},'
        " default=Array(this._.n % 4, Const(5, Int16ul))))"
    )
    ours = sensor(make_struct(f'Struct("n" / Int8ub, "a" / Array(0, {element}), "z" / Int16ub)'))
    for backend in BACKENDS:
        assert len(reader(ours, backend).decode([b"\x01\x02\x03", b"\x07M\x03"])) == 2
