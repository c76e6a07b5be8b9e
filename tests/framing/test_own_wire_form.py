"""Tests of an author's own wire form with only the three documented operations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from construct import Array, Int8ub, Int16ub, Struct, this

from lidarspec.spec import Decoded, Frame, NumberRun, Problem, TextRun
from tests.shapes import SHAPES


@dataclass(frozen=True)
class HexLines:
    """A colon, two digits for each byte, and a line end; linked from docs/how-to/wire-forms.md."""

    is_text = False

    def begins(self, texts: Sequence[Sequence[int | None]]) -> bytes:
        return b":"

    def find_end(self, data: bytes) -> int:
        return data.find(b"\n") + 1

    def decode(self, data: bytes, next_runs: object) -> Decoded:
        digits = data[1:-1]
        if len(digits) % 2 or digits.strip(b"0123456789abcdef"):
            return Decoded(b"", [], 1, Problem(1, "a byte has no two digits"))
        offsets = np.arange(1, len(data) - 1, 2)
        sizes = np.ones(len(offsets), int)
        return Decoded(bytes.fromhex(digits.decode()), [(offsets, sizes)], len(data) - 1)

    def encode(self, struct: bytes, runs: Sequence[TextRun | NumberRun]) -> bytes:
        return b":" + struct.hex().encode() + b"\n"

    def largest(self, size: int) -> int:
        return int(256**size - 1)


def test_frames_are_found_whatever_the_split() -> None:
    struct = Struct("count" / Int8ub, "ranges" / Array(this.count, Int16ub))
    frame = Frame(struct, data=True, max_length=600, wire=HexLines())
    sensor = replace(SHAPES["shape-text"], frames={"data": frame})
    data = sensor.build("data", ranges=[291, 278])
    assert data == b":0201230116\n"
    stream = b"noise :" + data + b":zz\n" + data
    for size in (1, 5, len(stream)):
        decoder = sensor.decoder()
        found = [
            item
            for start in range(0, len(stream), size)
            for item in decoder.feed(stream[start : start + size])
        ]
        found += decoder.finish()
        assert [(item.offset, item.data) for item in found] == [(7, data), (23, data)]
        assert not decoder.stats.plugin_errors
