"""Commands from values: what an argument may go into, and what it may be."""

from __future__ import annotations

import re

import pytest
from construct import Array, Bytes, Int8ul, Struct

from lidarspec import SpecError, UsageError
from lidarspec.spec import Command, Frame
from tests.broken import sound


@pytest.mark.parametrize(
    ("path", "what"),
    [("s[1].x", "in an array"), ("s.x", "in an array"), ("v", "in an array"), ("key", "bytes"), ("nothing", "no field"), ("t", "no field")],
)
def test_an_argument_that_goes_into_no_number_is_the_authors_fault(path: str, what: str) -> None:
    fields = {"key": Bytes(3), "v": Array(2, Int8ul), "s": Array(2, Struct("x" / Int8ul)), "t": Struct("u" / Int8ul)}
    order = Frame(Struct(*(name / con for name, con in fields.items())), direction="out")
    frames = {"data": sound.frame(), "order": order}
    values = {"key": b"abc", "v": [1, 2], "s": [{"x": 1}] * 2, "t.u": 1}
    wrong = sound.sensor(frames=frames, commands={"start": Command("order", values, args={"rate": (path, 0, 9)})})
    reason = rf"commands.start.args.rate: .*one number, and '{re.escape(path)}' is {what}"
    with pytest.raises(SpecError, match=reason):
        wrong.command("start", rate=3)
    right = sound.sensor(frames=frames, commands={"start": Command("order", values, args={"rate": ("t.u", 0, 9)})})
    assert right.command("start", rate=3) == b"abc\1\2\1\1\3"
    for odd in ("3", b"3", [3], None):
        with pytest.raises(UsageError, match="broken-one start: rate is a number, not"):
            right.command("start", rate=odd)
