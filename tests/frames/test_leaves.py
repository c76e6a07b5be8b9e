"""Tests of leaves: storing a value in a field changes no other field."""

from __future__ import annotations

import random

import numpy as np
import pytest
from construct import Array, BitsInteger, Bitwise, Const, Struct

from lidarspec.frames.layout import Layout, Leaf
from lidarspec.framing.example_frames import make_random_header
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.spec import Frame
from tests.shapes import SHAPES

ROWS = 3
#: No shape has an array within a bit block.
PACKED = Frame(
    Struct("start" / Const(b"\xaa"), "ranges" / Bitwise(Array(4, BitsInteger(10)))), data=True
)


def layouts() -> list[tuple[str, Layout]]:
    """Return a layout of each suitable frame type of the shapes.

    The header alone determines the layout. One more layout has an array in a bit block.
    """
    packed = get_codec(PACKED)
    assert isinstance(packed, CompiledCodec)
    found = [("packed", make_random_header(packed, random.Random(1))[0])]
    for sensor in SHAPES.values():
        for name, frame in sensor.frames.items():
            engine = get_codec(frame)
            if isinstance(engine, CompiledCodec) and not engine.schema.has_measured_sizes:
                layout, _ = make_random_header(engine, random.Random(f"{sensor.id} {name}"))
                found.append((f"{sensor.id} {name}", layout))
    return found


def numbers_of(leaf: Leaf, source: np.random.Generator) -> np.ndarray:
    """Return random raw values that fit an integer field, (ROWS, *shape)."""
    bits = min(leaf.info.bits, 62)
    is_signed = leaf.info.dtype is not None and leaf.info.dtype.kind == "i"
    lowest = -(1 << bits - 1) if is_signed else 0
    return source.integers(lowest, lowest + (1 << bits), (ROWS, *leaf.shape))


@pytest.mark.parametrize(
    ("name", "layout"), layouts(), ids=lambda value: value if isinstance(value, str) else ""
)
def test_stored_values_load_back_and_no_other_field_changes(name: str, layout: Layout) -> None:
    source = np.random.default_rng(len(name))
    rows = source.integers(0, 256, (ROWS, layout.size), np.uint8)
    leaves = {path: leaf for path, leaf in layout.leaves.items() if leaf.info.kind == "int"}
    for path, leaf in leaves.items():
        before = {other: same.load(rows) for other, same in leaves.items() if other != path}
        numbers = numbers_of(leaf, source)
        leaf.store(rows, numbers)
        np.testing.assert_array_equal(leaf.load(rows), numbers)
        for other, values in before.items():
            np.testing.assert_array_equal(leaves[other].load(rows), values)
