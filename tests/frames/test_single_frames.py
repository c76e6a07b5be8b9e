"""Tests that the checksum function for one frame agrees with its algorithm."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from lidarspec.spec import Checksum, Crc, Fold15, Sum, WordXor, Xor
from lidarspec.spec.checksums import make_single


class Own(Checksum):
    """An algorithm of another author, without any attribute, and without a hash."""

    width = 8
    __hash__ = None  # type: ignore[assignment]

    def __call__(self, data: bytes | bytearray | memoryview) -> int:
        return len(data) & 0xFF

    def describe(self) -> str:
        return "its length"


def crc8(source: random.Random) -> Crc:
    return Crc(
        8,
        source.randrange(1, 256),
        source.randrange(256),
        source.random() < 0.5,
        source.random() < 0.5,
        source.randrange(256),
    )


KINDS: dict[str, Callable[[random.Random], Checksum]] = {
    "crc8": crc8,
    "crc16": lambda source: Crc(
        16, 0x1021, source.randrange(1 << 16), xorout=source.randrange(1 << 16)
    ),
    "crc32": lambda source: Crc(
        32, 0x04C11DB7, source.randrange(1 << 32), True, True, source.randrange(1 << 32)
    ),
    "other crc": lambda source: Crc(
        source.randrange(1, 65), 1, refin=source.random() < 0.5, refout=source.random() < 0.5
    ),
    "sum": lambda source: Sum(source.randrange(1, 65)),
    "word xor": lambda source: WordXor(
        source.randrange(12), tuple(source.choice((1, 2)) for _ in range(source.randrange(1, 5)))
    ),
    "others": lambda source: source.choice((Xor(), Fold15(), Own())),
}


@pytest.mark.parametrize("kind", KINDS)
def test_it_equals_the_algorithm(kind: str) -> None:
    source = random.Random(kind)
    for _ in range(60):
        algorithm = KINDS[kind](source)
        function = make_single(algorithm)
        for size in (*range(20), 47, 85, 301):
            data = source.randbytes(size)
            assert function(data) == algorithm(data), (algorithm, size)


def test_a_subclass_with_its_own_computation_is_used() -> None:
    class Longer(Crc):
        def __call__(self, data: bytes | bytearray | memoryview) -> int:
            return super().__call__(bytes(data) + b"\0")

    assert make_single(Longer(8, 0x4D))(b"abc") == Crc(8, 0x4D)(b"abc\0")
