"""Tests that exports refuse unsupported specs with the right reason.

They also cover Python code in specs that exports can translate.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from construct import Array, Bytes, Const, Int8ub, Int16ub, Struct, Switch, this

from lidarspec import Sensor, UsageError
from lidarspec.exports import ExportError, UnknownExport, export, list_frames
from lidarspec.spec import Checksum, Checksummed, Frame
from lidarspec.spec.tree import Op, Ref, Repeat, nodes
from tests.exports.oddities import SENSOR
from tests.shapes.calibration import BARE


class Own(Checksum):
    """A checksum algorithm of a plugin."""

    width = 8

    def __call__(self, data: Any) -> int:
        return len(data) & 0xFF

    def describe(self) -> str:
        return "length"


def with_frame(*fields: Any, algorithm: Checksum | None = None) -> Sensor:
    """Return a sensor with one frame of these fields."""
    struct: Any = Struct("magic" / Const(b"\xf0\x09"), "a" / Int8ub, *fields)
    if algorithm is not None:
        struct = Checksummed(struct, field="a", algorithm=algorithm)
    return dataclasses.replace(SENSOR, frames={"data": Frame(struct, data=True, max_length=600)})


@pytest.mark.parametrize("kind", ["c", "wireshark"])
@pytest.mark.parametrize(
    ("sensor", "reason"),
    [
        (
            with_frame("x" / Bytes(lambda c: 1 if c.a else 2)),
            "x: a Python function branches on the values",
        ),
        (with_frame("x" / Bytes(lambda c: {0: 1}[c.a])), "x: a Python function"),
        (with_frame("x" / Bytes(this.a / 2)), "x: the result of an expression with '/'"),
        (
            with_frame("l" / Array(2, Int8ub), "x" / Bytes(this.l[1])),
            "l[1]: the layout depends on this array element",
        ),
        (with_frame("x" / Bytes(this.later)), "x: an expression uses 'later'"),
        (with_frame("x" / Switch(this.a, {"word": Int8ub})), "a has no value named 'word'"),
        (with_frame(algorithm=Own()), "the checksum Own is Python code"),
        (BARE, "has no frames until it is configured"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_refused_with_the_reason(kind: str, sensor: Sensor, reason: str) -> None:
    with pytest.raises(ExportError) as caught:
        export(sensor, kind)
    assert reason in str(caught.value)
    assert isinstance(caught.value, UsageError)


def test_c_has_no_place_for_elements_that_differ_in_size_and_no_number_for_all_products() -> None:
    chain = with_frame("parts" / Array(3, Struct("n" / Int8ub, "data" / Bytes(this.n))))
    with pytest.raises(ExportError, match="parts: the export to C does not support"):
        export(chain, "c")
    assert "parts" in export(chain, "wireshark")
    wide = with_frame(
        *(f"f{number}" / Int16ub for number in range(4)),
        "x" / Bytes(this.f0 * this.f1 * this.f2 * this.f3),
    )
    with pytest.raises(ExportError, match="may exceed 64 bits"):
        export(wide, "c")


def test_a_function_that_only_calculates_is_written_down() -> None:
    counted = with_frame("list" / Array(lambda context: 2 * context.a - 1, Int8ub))
    (found,) = [node for node in nodes(list_frames(counted)[0].root) if isinstance(node, Repeat)]
    assert isinstance(found.count, Op)
    inner, one = found.count.args
    assert (found.count.symbol, one) == ("-", 1)
    assert isinstance(inner, Op)
    assert [arg.path if isinstance(arg, Ref) else arg for arg in inner.args] == [2, "a"]


def test_an_unknown_kind_gets_a_suggestion() -> None:
    with pytest.raises(UnknownExport, match="'wireshark'"):
        export(SENSOR, "wiresark")
