"""Tests of byte strings in arrays and up to a terminator, and of varying elements.

They also cover the analysis of a struct at declaration.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from construct import (
    Aligned,
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Check,
    Computed,
    Const,
    CString,
    FixedSized,
    GreedyBytes,
    GreedyRange,
    Hex,
    HexDump,
    If,
    Int8sb,
    Int8ub,
    Int16ub,
    Int32ub,
    NullStripped,
    NullTerminated,
    Prefixed,
    PrefixedArray,
    Probe,
    RepeatUntil,
    Seek,
    Sequence,
    StopIf,
    Struct,
    Switch,
    Transformed,
    Union,
    len_,
    obj_,
    this,
)

from lidarspec import SpecError, UsageError, WireError, export
from lidarspec.testing.properties import PROPERTIES
from lidarspec.testing.sensor_under_test import SensorUnderTest
from tests.by_construct import reader
from tests.engine.against_construct import BACKENDS, agree, plain, sensor
from tests.engine.engines import (
    assert_damaged_input_reads_alike,
    assert_edge_values_read_alike,
    interpreted_reason,
    is_compiled,
)


def invert(data: bytes) -> bytes:
    return bytes(byte ^ 0xFF for byte in data)


TEXT = NullTerminated(GreedyBytes)
COUNTED = [
    bytes([count, *range(1, 1 + size)])
    for count in range(4)
    for size in range(0, 15, 1 + count % 2)
]

COMPILED: dict[str, Any] = {
    "counted": Array(this.k, Bytes(3)),
    "terminated": TEXT,
    "fixed": Array(2, Bytes(2)),
    "nested": Array(2, Array(this.k, Bytes(2))),
    "of a length": Array(2, Bytes(this.k)),
    "of a fixed size": FixedSized(3, GreedyBytes),
    "in a struct": Array(this.k, Struct("a" / Bytes(1), "b" / Array(2, Bytes(1)))),
    "empty elements": Array(this.k, Struct("x" / If(this._.k > 2, Int8ub))),
    "as many as an element says": Struct(
        "a" / Array(2, Int8ub), "b" / Array(this.a[0] % 4, Int8ub), "c" / Bytes(this.a[1] % 3)
    ),
    "as many as a byte says": Struct("a" / Bytes(2), "b" / Array(this.a[1] % 3, Int16ub)),
    "elements of several lengths": Array(this.k, Struct("n" / Int8ub, "x" / Bytes(this.n % 3))),
    "arrays of several lengths": Array(
        this.k, Struct("n" / Int8ub, "x" / Array(this.n % 3, Int16ub))
    ),
    "a part of some elements": Array(this.k, Struct("n" / Int8ub, "x" / If(this.n % 2, Int16ub))),
    "behind a condition": If(this.k == 3, Array(2, Struct("n" / Int8ub, "x" / Bytes(this.n)))),
    "behind a case": Switch(
        this.k, {3: Array(2, Struct("n" / Int8ub, "x" / Int8ub, "y" / If(this.n == 9, Int8ub)))}
    ),
}
INTERPRETED: dict[str, Any] = {
    "of what is not there": If(lambda found: found.y is None, Int8ub),
    "terminated ones": Array(this.k, TEXT),
    "prefixed": Array(this.k, Prefixed(Int8ub, GreedyBytes)),
    "parts where another case has an array": Switch(
        this.k,
        {
            1: Array(2, Struct("n" / Int8ub, "x" / Bytes(this.n % 3))),
            2: Array(3, Struct("n" / Int8ub, "x" / Bytes(1))),
        },
    ),
    "the length of an array": Struct(
        "a" / Array(this._.k, Struct("b" / Int8ub)), "c" / Array(len_(this.a), Int8ub)
    ),
}


#: structs that are held to all promises in the quick tier.
QUICK = (
    "counted",
    "nested",
    "in a struct",
    "as many as an element says",
    "terminated ones",
    "a part of some elements",
)

#: the promises that are about reading and building single frames, and frames in bulk.
HELD = {
    "examples_are_valid_and_repeat",
    "bytes_survive_parsing_and_building",
    "values_in_units_build_the_same_bytes",
    "a_truncated_frame_is_a_wire_error",
    "single_packets_equal_a_batch",
    "parse_decode_and_any_cutting_agree",
}


def frames() -> list[bytes]:
    """Return frames with counts, followed by numbers or by terminated texts."""
    return [
        *COUNTED,
        b"\x01ab\0",
        b"\x02\0abc\0",
        b"\x02abc\0x\0",
        b"\x03a\0\0ccc\0",
        b"\x03\0\0\0",
        b"\x00\0",
        b"\x01\0",
        b"\x02ab\0",
        b"\x07abc",
    ]


@pytest.mark.parametrize("name", [*COMPILED, *INTERPRETED])
def test_they_are_read_and_built_as_in_construct(name: str) -> None:
    struct = Struct(
        "k" / Int8ub, "y" / If(this.k > 2, Int8ub), "v" / {**COMPILED, **INTERPRETED}[name]
    )
    frame = sensor(struct).frames["data"]
    assert is_compiled(frame) == (name in COMPILED), interpreted_reason(frame)
    assert agree(struct, frames()) >= 3


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in [*COMPILED, *INTERPRETED]
    ],
)
def test_such_a_frame_keeps_every_promise(name: str) -> None:
    fields: Any = {**COMPILED, **INTERPRETED}[name]
    inner = Struct(
        "magic" / Const(b"\xf1\x5a"),
        "k" / Int8ub,
        "y" / If(this.k > 2, Int8ub),
        "v" / fields,
        "end" / Const(b"\xe1\x77"),
    )
    subject = SensorUnderTest(sensor(inner), 6)
    found = [
        finding
        for one in PROPERTIES
        if one.name in HELD and not one.lacks(subject)
        for finding in one.findings(subject)
    ]
    assert not found, found
    assert_edge_values_read_alike(subject.sensor, count=3)
    assert_damaged_input_reads_alike(subject.sensor, count=1)


def test_a_byte_string_accepts_numbers_only() -> None:
    ours = sensor(Struct("k" / Int8ub, "v" / Array(this.k, Bytes(2))))
    wanted = b"\x02abcd"
    for value in (
        [b"ab", b"cd"],
        [[97, 98], [99, 100]],
        np.array([[97, 98], [99, 100]], np.uint8),
        [b"ab", [99, 100]],
    ):
        assert ours.build("data", v=value) == wanted
    assert ours.build("data", v=[]) == b"\0"
    for wrong in ([[97, 300]], [[97, "b"]], [b"abc"]):
        with pytest.raises(UsageError, match="v"):
            ours.build("data", v=wrong)


@pytest.mark.parametrize("value", [None, 1.5])
def test_other_values_of_a_byte_string_are_usage_errors(value: Any) -> None:
    for part in (Array(this.k, Int8ub), Bytes(this.k), Bytes(2)):
        with pytest.raises(UsageError, match="v"):
            sensor(Struct("k" / Int8ub, "v" / part)).build("data", k=2, v=value)


def test_a_name_with_two_forms_has_columns_but_no_raw_dtype() -> None:
    forms = {1: Struct("x" / Int8ub), 2: Array(2, Struct("y" / Int8ub))}
    packets = sensor(Struct("k" / Int8ub, "v" / Switch(this.k, forms))).decode([b"\1\5", b"\2\6\7"])
    np.testing.assert_array_equal(packets["v.x"], [5, np.nan])
    np.testing.assert_array_equal(packets["v.y"], [[np.nan, np.nan], [6, 7]])
    with pytest.raises(SpecError, match="v: "):
        _ = packets.raw


def test_an_element_without_a_field_has_no_number_in_its_unit() -> None:
    ours = sensor(Struct("v" / Array(3, Struct("n" / Int8ub, "x" / If(this.n == 1, Int8ub)))))
    packets = ours.decode([b"\0\1\5\0", b"\1\7\1\7\1\7", b"\0\0\0"])
    np.testing.assert_array_equal(
        packets["v.x"], [[np.nan, 5, np.nan], [7, 7, 7], [np.nan, np.nan, np.nan]]
    )


def test_there_is_no_one_length_of_arrays_that_differ() -> None:
    ours = sensor(Struct("v" / Array(2, Struct("n" / Int8ub, "x" / Array(this.n, Int8ub)))))
    packets = ours.decode([b"\0\0", b"\1\5\2\6\7"])
    assert packets.raw["v"]["x"].tolist() == [[[0, 0], [0, 0]], [[5, 0], [6, 7]]]
    with pytest.raises(SpecError, match=r"v\.x: "):
        packets.count("v.x")


def test_a_column_of_text_is_refused_by_name() -> None:
    ours = sensor(Struct("a" / Int8ub, "v" / CString("ascii")))
    assert ours.parse(b"\1ab\0").v == "ab"
    assert ours.decode([b"\1ab\0"])["a"].tolist() == [1]
    with pytest.raises(SpecError, match="v: "):
        ours.decode([b"\1ab\0"])["v"]


def test_branches_without_a_common_column_are_refused() -> None:
    struct = Struct(
        "k" / Int8ub,
        "v" / Switch(this.k, {1: Int8ub, 2: Bytes(3)}),
        "w" / Switch(this.k, {1: Int8ub, 2: Struct("x" / Int8ub)}),
    )
    packets = sensor(struct).decode([b"\1\2\3", b"\2\3\4\5\6"])
    assert packets["k"].tolist() == [1, 2]
    with pytest.raises(SpecError, match="v: "):
        packets["v"]
    packets = sensor(Struct("k" / Int8ub, "w" / struct.w)).decode([b"\1\3", b"\2\6"])
    np.testing.assert_array_equal(packets["w.x"], [np.nan, 6])
    with pytest.raises(SpecError, match="w: "):
        _ = packets.raw


@pytest.mark.parametrize("backend", BACKENDS)
def test_invalid_lengths_are_plugin_errors_or_wire_errors(
    backend: str,
) -> None:
    for part in (Array(this.k / 2, Int8ub), Bytes(this.k / 2)):
        stats = reader(sensor(Struct("k" / Int8ub, "v" / part)), backend).decode([b"\2\1"]).stats
        assert (stats.plugin_errors, stats.bad_length) == (1, 0)
    for part in (Array(this.k, Int8ub), Bytes(this.k)):
        ours = sensor(Struct("k" / Int8sb, "v" / part))
        stats = reader(ours, backend).decode([b"\xff\1"]).stats
        assert (stats.plugin_errors, stats.bad_length) == (0, 1)
        with pytest.raises(WireError):
            ours.parse(b"\xff\1")


@pytest.mark.parametrize(
    ("part", "reason"),
    [
        (
            Computed(lambda found: int(found.a) + 1),
            "a Python function calculates the value from other fields",
        ),
        (
            BitStruct(
                "n" / BitsInteger(8),
                "x" / Switch(this.n, {77: BitsInteger(8)}, default=BitStruct("y" / BitsInteger(8))),
            ),
            "b",
        ),
        (BitStruct("wide" / BitsInteger(72)), "the field has 72 bits, and a column has at most 64"),
    ],
)
def test_the_reason_why_a_frame_is_not_compiled_is_true(part: Any, reason: str) -> None:
    frame = sensor(Struct("a" / Int8ub, "b" / part)).frames["data"]
    assert not is_compiled(frame)
    assert reason in interpreted_reason(frame)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_count_is_bounded_by_the_longest_frame_also_where_elements_have_no_bytes(
    backend: str,
) -> None:
    """Without this limit, ten bytes of noise cause four thousand million iterations."""
    empty = Array(this.n, Struct("x" / If(this._.k > 2, Int8ub)))
    # More elements than bytes, and they are bits.
    bits = BitStruct("low" / Array(24, BitsInteger(1)))
    ours = sensor(Struct("k" / Int8ub, "n" / Int32ub, "bits" / bits, "v" / empty), max_length=20)
    short, huge = b"\0\0\0\0\3\7\7\7", b"\0\xff\xff\xff\xff\7\7\7"
    stats = reader(ours, backend).decode([short, huge]).stats
    assert (stats.frames, stats.bad_length, stats.plugin_errors) == ({"data": 1}, 1, 0)
    assert len(ours.parse(short).v) == 3
    with pytest.raises(WireError, match=r"v: .*4294967295"):
        ours.parse(huge)


@pytest.mark.parametrize("backend", BACKENDS)
def test_elements_without_a_byte_are_bounded_together(backend: str) -> None:
    """The limit applies to all nested arrays together.

    Otherwise two bytes could cause a loop over eight million elements.
    """
    ours = sensor(
        Struct(
            "k" / Int8ub, "a" / Int8ub, "v" / Array(this.a, Array(this.a, Array(this.a, Struct())))
        ),
        max_length=60,
    )
    # 3 + 9 + 27 elements; too many.
    stats = reader(ours, backend).decode([b"\0\3", b"\0\xff", b"\0\x3c"]).stats
    assert (stats.frames, stats.bad_length, stats.plugin_errors) == ({"data": 1}, 2, 0)
    assert len(ours.parse(b"\0\3").v[2][2]) == 3
    with pytest.raises(WireError, match=r"v: .*60"):
        ours.parse(b"\0\x3c", verify=False)


@pytest.mark.parametrize("backend", BACKENDS)
def test_elements_within_a_bit_block_are_no_elements_without_a_byte(backend: str) -> None:
    block = BitStruct("x" / BitsInteger(8), "no" / Array(3, Struct()))
    assert (
        len(
            reader(sensor(Struct("v" / Array(20, block)), max_length=20), backend).decode(
                [bytes(20)]
            )
        )
        == 1
    )


def twice(found: Any) -> int:
    """Return twice the number; the branch makes construct compute it."""
    return found.n * 2 if found.n else 0


@pytest.mark.parametrize("part", [Array(this.n, Struct()), Array(this.n, Int8ub), Bytes(this.n)])
def test_plain_examples_have_consistent_counts(part: Any) -> None:
    ours = sensor(Struct("n" / Int32ub, "v" / part, "twice" / Computed(twice)), max_length=300)
    assert not is_compiled(ours.frames["data"])
    assert len({len(ours.parse(ours.example("data", seed=seed)).v) for seed in range(8)}) > 3


def test_a_count_is_bounded_by_the_size_of_a_frame_that_declares_no_longest_length() -> None:
    with pytest.raises(WireError, match=r"v: .*1000000000"):
        sensor(Struct("k" / Int8ub, "v" / Array(10**9, Struct())), max_length=0).parse(b"\0")


BOUNDED: dict[str, tuple[Any, bytes, Any]] = {
    "declare a length field": (Prefixed(Int8ub, GreedyRange(Int16ub)), b"\4\0\1\0\2", [1, 2]),
    "of none": (Prefixed(Int8ub, GreedyRange(Int16ub)), b"\0", []),
    "of a fixed size": (FixedSized(4, GreedyRange(Int16ub)), b"\0\1\0\2", [1, 2]),
    "of structs": (
        Prefixed(Int8ub, GreedyRange(Struct("n" / Int8ub, "x" / Bytes(this.n)))),
        b"\3\1a\0",
        [{"n": 1, "x": b"a"}, {"n": 0, "x": b""}],
    ),
    "behind a field": (
        Prefixed(Int8ub, Struct("a" / Int8ub, "r" / GreedyRange(Int8ub))),
        b"\3\7\5\6",
        {"a": 7, "r": [5, 6]},
    ),
    "a rest": (
        Prefixed(Int8ub, Struct("a" / Int8ub, "r" / GreedyBytes)),
        b"\3\7\5\6",
        {"a": 7, "r": b"\5\6"},
    ),
    "a text in its place": (FixedSized(4, NullStripped(GreedyBytes)), b"ab\0\0", b"ab"),
}


@pytest.mark.parametrize("name", BOUNDED)
def test_greedy_parts_with_an_end_are_read_and_built(name: str) -> None:
    part, data, wanted = BOUNDED[name]
    ours = sensor(Struct("k" / Int8ub, "v" / part))
    assert plain(ours.parse(b"\1" + data).v) == wanted
    assert ours.build("data", ours.parse(b"\1" + data)) == b"\1" + data
    assert ours.decode([b"\1" + data])["k"].tolist() == [1]
    for seed in range(4):
        example = ours.example("data", seed=seed)
        assert ours.build("data", ours.parse(example)) == example


def test_of_a_greedy_array_no_byte_is_dropped() -> None:
    with pytest.raises(WireError, match="v_size at byte 0: length 3, expected 2"):
        sensor(Struct("v" / Prefixed(Int8ub, GreedyRange(Int16ub)))).parse(b"\3\0\1\0")
    with pytest.raises(WireError, match=r"v\[0\]"):
        sensor(Struct("v" / Prefixed(Int8ub, GreedyRange(Struct())))).parse(b"\1\0")
    with pytest.raises(UsageError, match="v: "):
        sensor(Struct("v" / Prefixed(Int8ub, GreedyRange(Int16ub)))).build("data", v=5)


@pytest.mark.parametrize(
    ("part", "reason"),
    [
        (
            Prefixed(Int8ub, Struct("r" / GreedyBytes, "a" / Int8ub)),
            "r: GreedyBytes has no end in a stream",
        ),
        (Prefixed(Int8ub, GreedyRange(GreedyBytes)), "GreedyBytes has no end in a stream"),
        (
            Array(2, Aligned(4, Int8ub)),
            "a rebuilt frame loses the padding of Aligned: make Aligned a named member",
        ),
        (
            Array(2, FixedSized(4, Int8ub)),
            "the field 'rest' / GreedyBytes, or make FixedSized a named member",
        ),
        (
            Array(2, Prefixed(Int8ub, Int16ub)),
            "Prefixed loses bytes that its content does not read",
        ),
        (
            Union(0, "a" / Int16ub, "b" / Int8ub),
            "Union parses the same bytes as several fields, but builds one field",
        ),
        (
            Prefixed(Int8ub, NullStripped(GreedyBytes)),
            "Prefixed loses bytes that its content does not read",
        ),
    ],
)
def test_structs_without_an_end_or_that_drop_bytes_are_refused(part: Any, reason: str) -> None:
    with pytest.raises(SpecError, match=reason):
        sensor(Struct("k" / Int8ub, "v" / part))


def test_examples_pass_checks_of_the_whole_frame() -> None:
    checked = Struct("ok" / Check(this._.a < 200), "x" / Array(this._root.a % 3, Int8ub))
    double = Computed(lambda found: int(found.a) * 2)
    ours = sensor(Struct("a" / Int8ub, "v" / Array(2, checked), "twice" / double))
    examples = [ours.parse(ours.example("data", seed=seed)) for seed in range(9)]
    assert all(
        found.a < 200 and found.twice == 2 * found.a and len(found.v[1].x) == found.a % 3
        for found in examples
    )
    with pytest.raises(WireError, match=r"v\[0\].ok"):
        ours.parse(b"\xc8\0\0\0\0")


@pytest.mark.parametrize(
    ("part", "instead"),
    [
        (Probe(), "use lidarspec explain"),
        (StopIf(this.k == 0), "If(this.more, Struct"),
        (Seek(4), "declare the skipped bytes"),
    ],
)
def test_constructs_that_print_skip_or_stop_are_refused(part: Any, instead: str) -> None:
    with pytest.raises(SpecError) as caught:
        sensor(Struct("k" / Int8ub, part))
    assert instead in str(caught.value)
    for named in ("v" / part, "v" / Sequence(Int8ub, part)):
        with pytest.raises(SpecError, match=r"^v: ") as caught:
            sensor(Struct("k" / Int8ub, named))
        assert instead in str(caught.value)


@pytest.mark.parametrize(
    ("part", "instead"),
    [
        (RepeatUntil(obj_ == 0, Int8ub), "Array with a count"),
        (Transformed(Int16ub, invert, 2, invert, 2), "in `points`"),
        (Array(2, CString("ascii")), "use an array of structs"),
        (Computed(lambda found: int(found.k) * 2), "use an expression such as this"),
        (
            Array(2, Array(2, Struct("n" / Int8ub, "x" / Array(this.n, Int8ub)))),
            "Parts(struct, count)",
        ),
        (Array(2, PrefixedArray(Int8ub, Int8ub)), "named members of a Struct"),
    ],
)
def test_unsupported_constructs_get_a_suggestion(part: Any, instead: str) -> None:
    frame = sensor(Struct("k" / Int8ub, "v" / part)).frames["data"]
    assert not is_compiled(frame)
    assert instead in interpreted_reason(frame)


def test_a_text_in_a_part_of_fixed_size_has_examples() -> None:
    ours = sensor(Struct("k" / Int8ub, "v" / FixedSized(8, CString("ascii"))))
    assert len(ours.example("data")) == 9


def test_hex_fields_equal_plain_ones() -> None:
    ours = sensor(Struct("h" / Hex(Int16ub), "b" / HexDump(Bytes(2))))
    assert is_compiled(ours.frames["data"])
    assert plain(ours.parse(b"\1\2ab")) == {"h": 258, "b": b"ab"}
    assert ours.build("data", h=258, b=b"ab") == b"\1\2ab"
    assert ours.decode([b"\1\2ab"])["h"].tolist() == [258]


def test_an_element_selects_the_following_part() -> None:
    ours = sensor(Struct("sizes" / Array(2, Int8ub), "v" / Array(this.sizes[1], Int8ub)))
    frames = [ours.build("data", sizes=[9, len(v)], v=v) for v in ([], [5], [6, 7])]
    assert frames == [b"\x09\0", b"\x09\1\5", b"\x09\2\6\7"]
    assert ours.decode(frames)["v"].tolist() == [[0, 0], [5, 0], [6, 7]]
    with pytest.raises(WireError, match="byte 3 of 4"):
        ours.parse(b"\x09\2\6")
    with pytest.raises(UsageError, match=r"sizes\[1\]"):
        export(ours, "c")
    outside = sensor(Struct("sizes" / Array(2, Int8ub), "v" / Array(this.sizes[2], Int8ub)))
    assert outside.decode([b"\1\2\3"]).stats.plugin_errors == 1
