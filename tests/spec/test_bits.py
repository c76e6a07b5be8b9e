"""Tests of probing: which bits of a block make up its values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from lidarspec.spec.bits import BitField, Segment, probe


def test_bits_may_be_in_any_order_and_have_a_sign() -> None:
    def parse(block: bytes) -> Mapping[tuple[str | int, ...], Any]:
        angle = int.from_bytes(block, "big") >> 7 & 0x1FF
        return {
            ("swapped",): block[0] & 0xF0 | block[1] & 0x0F,
            ("angle",): angle - 0x200 if angle & 0x100 else angle,
            ("sign",): -(block[1] >> 3 & 1),
            ("valid",): bool(block[1] & 1),
        }

    assert probe(parse, 2) == [
        BitField(("swapped",), (Segment(0, 0xF0, 4, 4), Segment(1, 0x0F, 0, 0)), 8, False),
        BitField(("angle",), (Segment(0, 0xFF, 0, 1), Segment(1, 0x80, 7, 0)), 9, True),
        BitField(("sign",), (Segment(1, 0x08, 3, 0),), 1, True),
        BitField(("valid",), (Segment(1, 0x01, 0, 0),), 1, False, True),
    ]


@pytest.mark.parametrize(
    "compute",
    [
        pytest.param(lambda byte: (byte >> 4) * 10 + (byte & 0xF), id="decimal digits"),
        pytest.param(lambda byte: byte & byte << 1, id="an operation on bits"),
        pytest.param(lambda byte: byte + 1, id="an offset"),
        pytest.param(lambda byte: 2 * byte, id="a scale"),
        pytest.param(lambda byte: 0, id="a constant"),
        pytest.param(lambda byte: (byte & 1) * 3, id="a bit at two positions"),
        pytest.param(float, id="a float"),
    ],
)
def test_values_that_are_not_made_of_bits_are_refused(compute: Any) -> None:
    assert probe(lambda block: {("value",): compute(block[0])}, 1) is None


def test_a_large_block_is_parsed_a_few_times() -> None:
    count = 1600
    parsed = list[bytes]()

    def parse(block: bytes) -> Mapping[tuple[str | int, ...], Any]:
        parsed.append(block)
        word = int.from_bytes(block, "big")
        return {(index,): word >> 12 * (count - 1 - index) & 0xFFF for index in range(count)}

    fields = probe(parse, count * 3 // 2)
    assert fields is not None
    assert [field.width for field in fields] == [12] * count
    assert len(parsed) < 30
