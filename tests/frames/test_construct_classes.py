"""Tests of each class of construct in a small struct.

Values, bytes and columns must equal those of construct with the struct as written here. The tests
also list which structs are compiled.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import construct
import numpy as np
import pytest
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Byte,
    Bytes,
    BytesInteger,
    Check,
    Checksum,
    Compressed,
    Computed,
    Const,
    Construct,
    CString,
    Debugger,
    ExprAdapter,
    ExprSymmetricAdapter,
    FixedSized,
    FocusedSeq,
    GreedyBytes,
    GreedyRange,
    GreedyString,
    If,
    Index,
    Int8ub,
    Int16sb,
    Int16ub,
    Int64ub,
    Lazy,
    LazyArray,
    LazyBound,
    LazyStruct,
    NamedTuple,
    NullStripped,
    NullTerminated,
    Padded,
    PaddedString,
    Padding,
    PascalString,
    Peek,
    Prefixed,
    PrefixedArray,
    ProcessXor,
    RawCopy,
    Rebuffered,
    Rebuild,
    RepeatUntil,
    Sequence,
    Struct,
    Switch,
    Tell,
    Terminated,
    Transformed,
    VarInt,
    ZigZag,
    len_,
    obj_,
    this,
)

from lidarspec import Sensor, SpecError, UsageError, WireError
from lidarspec.explaining.explanation import explain
from lidarspec.spec import Checksummed, Fields, Polar, Scaled, Serial, Sum
from tests.engine.against_construct import at, has_all, sensor
from tests.engine.engines import interpreted_reason, is_compiled

MARK = b"\x5a\xa5"


def add(data: bytes) -> int:
    return sum(data) & 0xFF


def add_part(part: Any) -> int:
    return add(part.data)


def add_as_bytes(data: bytes) -> bytes:
    return bytes([add(data), 0])


def flip(data: bytes) -> bytes:
    return bytes(byte ^ 0x55 for byte in data)


def odd_or_even(found: Any) -> str:
    return "odd" if found.n % 2 else "even"


def join_dots(numbers: Any, context: Any) -> str:
    return ".".join(map(str, numbers))


def split_dots(text: str, context: Any) -> list[int]:
    return list(map(int, text.split(".")))


class Celsius(construct.Adapter):  # type: ignore[misc]
    """An adapter that an author declares."""

    def _decode(self, obj: Any, context: Any, path: str) -> Any:
        return obj - 40

    def _encode(self, obj: Any, context: Any, path: str) -> Any:
        return obj + 40


NODE = Struct("v" / Int8ub, "after" / If(this.v, LazyBound(lambda: NODE)))
BODY = Struct("a" / Int8ub, "b" / Int16ub)
TWO = Struct("x" / Int8ub, "y" / Int8ub)


@dataclasses.dataclass(frozen=True)
class Case:
    """A struct that begins with a constant of two bytes, and its bytes in some frames.

    The constant is not part of `members` and `frames`. `reason` is part of the reason why construct
    reads the frames; "" if they are compiled.
    """

    members: tuple[Construct, ...]
    frames: tuple[bytes, ...]
    reason: str = ""
    #: whether only datagrams can have such frames.
    is_rest: bool = False

    @property
    def struct(self) -> Construct:
        return Struct("mark" / Const(MARK), *self.members)


def case(*members: Construct, frames: str, reason: str = "", is_rest: bool = False) -> Case:
    """Return a case with frames in hexadecimal, separated by spaces."""
    return Case(members, tuple(map(bytes.fromhex, frames.split())), reason, is_rest)


COMPILED: dict[str, Case] = {
    "VarInt": case("a" / VarInt, "b" / Int8ub, frames="810102 0102"),
    "ZigZag": case("a" / ZigZag, "b" / Int8ub, frames="810102 0102"),
    "GreedyBytes": case("n" / Int8ub, "a" / GreedyBytes, frames="616263 61", is_rest=True),
    "GreedyString": case("a" / GreedyString("utf8"), frames="6162 c3a9", is_rest=True),
    "CString": case("a" / CString("utf8"), frames="616200 00 c3a900"),
    "CString of two bytes": case("a" / CString("utf_16_le"), frames="610062000000 0000"),
    "NullTerminated": case("a" / NullTerminated(GreedyBytes), "b" / Int8ub, frames="61620001 0002"),
    "NullTerminated by two bytes": case(
        "a" / NullTerminated(GreedyBytes, term=b"\r\n"), "b" / Int8ub, frames="61620d0a01 0d0a02"
    ),
    "texts with an end in elements": case(
        "k" / Int8ub,
        "r" / Array(this.k, Struct("a" / CString("ascii"), "n" / VarInt)),
        frames="02620005008202 00",
    ),
    "texts one after another": case(
        "k" / Int8ub,
        "a" / CString("ascii"),
        "n" / VarInt,
        "v" / If(this.k, CString("ascii")),
        "b" / Int8ub,
        frames="0162008202630003 0061000501",
    ),
    "ExprAdapter": case("a" / ExprAdapter(Int8ub, obj_ + 1, obj_ - 1), frames="01 ff"),
    "ExprAdapter to fractions": case(
        "a" / ExprAdapter(Int16ub, lambda raw, _: raw / 10, lambda value, _: round(value * 10)),
        frames="0102 ffff",
    ),
    "ExprAdapter that counts": case(
        "n" / ExprAdapter(Int8ub, obj_ - 1, obj_ + 1), "d" / Bytes(this.n), frames="036162 01"
    ),
    "ExprAdapter to texts": case(
        "a" / ExprAdapter(Byte[4], join_dots, split_dots), frames="0a000001 ffffffff"
    ),
    "ExprAdapter in elements": case(
        "a" / Array(2, ExprAdapter(Int8ub, obj_ * 2, obj_ // 2)), frames="0102"
    ),
    "ExprSymmetricAdapter": case("a" / ExprSymmetricAdapter(Int8ub, obj_ ^ 0xFF), frames="01"),
    "an adapter of numbers": case("a" / Celsius(Int8ub), frames="01 ff"),
    "an adapter of bits": case(
        "a" / BitStruct("x" / Celsius(BitsInteger(7)), "y" / BitsInteger(1)), frames="01 ff"
    ),
    "Mapping to numbers": case("a" / construct.Mapping(Int8ub, {100: 1, 200: 2}), frames="01 02"),
    "FlagsEnum of all bits": case(
        "a" / construct.FlagsEnum(Int8ub, **{f"b{bit}": 1 << bit for bit in range(8)}),
        frames="01 ff",
    ),
    "BytesInteger of 16 bytes": case("a" / BytesInteger(16), frames="00" * 15 + "01 " + "ff" * 16),
    "BytesInteger with a sign": case(
        "a" / BytesInteger(9, signed=True, swapped=True), frames="00" * 8 + "ff"
    ),
    "PaddedString": case(
        "a" / PaddedString(4, "ascii"), "b" / Int8ub, frames="6162000001 6162636401"
    ),
    "PascalString": case("a" / PascalString(Int8ub, "utf8"), "b" / Int8ub, frames="02c3a901 0001"),
    "two PascalStrings": case(
        "a" / PascalString(Int8ub, "ascii"),
        "b" / PascalString(Int16ub, "ascii"),
        frames="0161000262" + "63",
    ),
    "GreedyString behind its length": case(
        "a" / Prefixed(Int8ub, GreedyString("utf8")), frames="026162 00"
    ),
    "texts in elements": case("a" / Array(2, PaddedString(2, "ascii")), frames="61006263"),
    "NullStripped": case("a" / FixedSized(4, NullStripped(GreedyBytes)), frames="61620000"),
    "Sequence": case("a" / Sequence(Int8ub, Int16ub), frames="010203"),
    "FocusedSeq": case("a" / FocusedSeq("v", "k" / Const(b"K"), "v" / Int8ub), frames="4b01 4b02"),
    "FocusedSeq with unnamed parts": case(
        "a" / FocusedSeq("v", Const(b"<"), "v" / BODY, Const(2, Int16ub), Padding(1)),
        "b" / Int8ub,
        frames="3c01020300020004 3c01020300020904",
    ),
    "FocusedSeq of an array": case(
        "a" / FocusedSeq("v", Const(b"<"), "v" / Array(3, Int8ub)), frames="3c010203"
    ),
    "FocusedSeq with a count": case(
        "a"
        / FocusedSeq(
            "v", "m" / Const(b"M"), "n" / Rebuild(Int8ub, len_(this.v)), "v" / Array(this.n, TWO)
        ),
        "b" / Int8ub,
        frames="4d020102030405 4d0006",
    ),
    "Rebuild of the length of an array": case(
        "n" / Rebuild(Int8ub, len_(this.v)), "v" / Array(this.n, TWO), frames="0201020304 00"
    ),
    "Rebuild of the length of bytes": case(
        "n" / Rebuild(Int16ub, lambda scope: len(scope.d)),
        "x" / Int8ub,
        "d" / Bytes(this.n),
        frames="000209abcd 000000",
    ),
    "FocusedSeq behind its length": case(
        "a" / Prefixed(Int8ub, FocusedSeq("v", Const(b"K"), "v" / Int16ub)), frames="034b0102"
    ),
    "FocusedSeq under a condition": case(
        "k" / Int8ub,
        "a" / If(this.k, FocusedSeq("v", Const(b"K"), "v" / Int16ub)),
        frames="00 014b0102",
    ),
    "FocusedSeq in elements": case(
        "r" / Array(2, Struct("a" / FocusedSeq("v", Const(b"K"), "v" / Int8ub))),
        frames="4b014b02",
    ),
    "ProcessXor": case(
        "a" / FixedSized(2, ProcessXor(0x55, GreedyBytes)), "b" / Int8ub, frames="010203 aa5500"
    ),
    "ProcessXor of the bytes behind a length": case(
        "a" / Prefixed(Int8ub, ProcessXor(b"\1\2\3", GreedyBytes)),
        "b" / Int8ub,
        frames="040102030405 0005",
    ),
    "ProcessXor of a number": case(
        "a" / FixedSized(2, ProcessXor(b"\1\x80", Int16sb)), frames="0102 ffff"
    ),
    "ProcessXor of a struct": case(
        "a" / Prefixed(Int8ub, ProcessXor(0x55, TWO)), "b" / Int8ub, frames="02010203"
    ),
    "ProcessXor of nested structs": case(
        "a"
        / FixedSized(
            9,
            ProcessXor(
                b"\1\2\3", Struct("x" / Int16ub, "b" / BODY, "r" / Int8ub[2], "d" / GreedyBytes)
            ),
        ),
        "b" / Int8ub,
        frames="00010203040506070809 ffffffffffffffffffff",
    ),
    "ProcessXor in elements": case(
        "a" / Array(2, FixedSized(2, ProcessXor(b"\1\2", Int16ub))), frames="01020304"
    ),
    "ProcessXor of bytes in elements": case(
        "a" / Array(2, FixedSized(2, ProcessXor(b"\1\2", GreedyBytes))), frames="01020304"
    ),
    "If in elements": case(
        "r" / Array(2, Struct("k" / Int8ub, "v" / If(this.k, Int8ub))),
        "b" / Int8ub,
        frames="00010203 000001 01020304ff",
    ),
    "counts in elements": case(
        "n" / Int8ub,
        "r" / Array(this.n, Struct("n" / Int8ub, "v" / Array(this.n, Int16ub))),
        "b" / Int8ub,
        frames="02000100020a 0003 0102000100020b",
    ),
    "Switch in elements": case(
        "r" / Array(2, Struct("k" / Int8ub, "v" / Switch(this.k, {1: TWO, 2: Int8ub}))),
        frames="0101020201 0000",
    ),
    "texts in elements of an array": case(
        "r" / Array(2, Struct("t" / PascalString(Int8ub, "ascii"), "k" / Int8ub)),
        frames="0161010001 0000026162ff",
    ),
    "elements of elements that differ": case(
        "r"
        / Array(
            2,
            Struct(
                "n" / Int8ub,
                "s" / Array(this.n, Struct("k" / Int8ub, "v" / If(this.k > 1, Int16ub))),
                "z" / Int8ub,
            ),
        ),
        frames="020102000301000a 00010002",
    ),
    "elements that ask the frame": case(
        "n" / Int8ub,
        "r" / Array(2, Struct("k" / Int8ub, "v" / Bytes(this.k * this._.n))),
        frames="0201616200 00ff02",
    ),
    "scales in elements": case(
        "r" / Array(2, Struct("k" / Int8ub, "v" / If(this.k, Scaled(Int8ub, 0.5, "m")))),
        frames="000101 01050101",
    ),
    "elements under a condition": case(
        "k" / Int8ub,
        "r" / If(this.k, Array(2, Struct("n" / Int8ub, "v" / Bytes(this.n)))),
        "b" / Int8ub,
        frames="0001 0101610007",
    ),
    "PrefixedArray of elements that differ": case(
        "r" / PrefixedArray(Int8ub, Struct("n" / Int8ub, "v" / Bytes(this.n))),
        "b" / Int8ub,
        frames="020161000a 0001",
    ),
    "GreedyRange of elements that differ": case(
        "r" / Prefixed(Int8ub, GreedyRange(Struct("n" / Int8ub, "v" / Bytes(this.n)))),
        "b" / Int8ub,
        frames="030161000a 0001 020000ff",
    ),
    "Checksummed in an array": case(
        "r" / Array(2, Checksummed(TWO, field="y", algorithm=Sum())), frames="01010202"
    ),
    "Checksummed in elements that differ": case(
        "r"
        / Array(
            2,
            Checksummed(
                Struct("n" / Int8ub, "v" / Bytes(this.n), "s" / Int8ub), field="s", algorithm=Sum()
            ),
        ),
        frames="0161620000 00000000 0000010203",
    ),
    "RepeatUntil of structs": case(
        "a" / RepeatUntil(lambda one, found, context: one.x == 0, TWO),
        "b" / Int8ub,
        frames="0102000304 000405",
    ),
    "RepeatUntil by an expression": case(
        "k" / Int8ub,
        "a" / RepeatUntil(obj_.n == 0, Struct("n" / Int8ub, "v" / Bytes(this.n))),
        "b" / Int8ub,
        frames="0501610262630009 050009",
    ),
    "RepeatUntil by this": case("a" / RepeatUntil(this.x >= 3, TWO), frames="010200030304 0300"),
    "RepeatUntil by the frame": case(
        "k" / Int8ub,
        "a" / RepeatUntil(lambda one, found, context: one.x == context.k, TWO),
        frames="030102000303ff",
    ),
    "NamedTuple of a struct": case("a" / NamedTuple("P", "x y", TWO), frames="0102"),
    "NamedTuple of an array": case("a" / NamedTuple("P", "x y", Int8ub[2]), frames="0102"),
    "a Check without a name": case("a" / Int8ub, Check(this.a < 3), frames="01"),
    "a Check with docs": case("a" / Int8ub, Check(this.a < 3) * "docs", frames="01"),
    "Tell that nobody uses": case("t" / Tell, "a" / Int8ub, frames="01 02"),
    "Tell behind a count": case("n" / Int8ub, "d" / Bytes(this.n), "t" / Tell, frames="026162 00"),
    "Tell in elements": case("r" / Array(3, Struct("t" / Tell, "a" / Int16ub)), frames="00" * 6),
    "Tell that Computed uses": case(
        "n" / Int8ub,
        "s" / Tell,
        "d" / Bytes(this.n),
        "e" / Tell,
        "size" / Computed(this.e - this.s),
        "rest" / Bytes(3 - this.size),
        frames="0261624a 0000000a",
    ),
    "Computed of a field": case(
        "n" / Int8ub, "c" / Computed(this.n * 2 + 1), "d" / Bytes(this.c), frames="01616263 0061"
    ),
    "Computed number": case("n" / Int8ub, "c" / Computed(7), "d" / Bytes(this.c), frames="00" * 8),
    "Computed text": case("n" / Int8ub, "c" / Computed("v1"), frames="01"),
    "Computed fraction": case("n" / Int16sb, "c" / Computed(this.n / 10), frames="0101 ffff"),
    "Computed condition": case("n" / Int8ub, "c" / Computed(this.n > 3), frames="01 04"),
    "Computed in elements": case(
        "k" / Int8ub,
        "r" / Array(2, Struct("a" / Int8ub, "c" / Computed(this.a * this._.k))),
        frames="030102 000405",
    ),
    "Computed in a branch": case(
        "k" / Int8ub, "v" / If(this.k, Struct("c" / Computed(this._.k + 1))), frames="00 02"
    ),
    "Peek of a number": case("p" / Peek(Int8ub), "a" / Int16ub, frames="0102"),
    "Peek of a struct": case("p" / Peek(BODY), "a" / Array(3, Int8ub), frames="010203"),
    "Peek that chooses": case(
        "p" / Peek(Int8ub),
        "v" / Switch(this.p, {1: Struct("k" / Int8ub, "x" / Int16ub)}, Struct("k" / Int8ub)),
        frames="010203 04",
    ),
    "Peek in elements": case(
        "r" / Array(2, Struct("p" / Peek(Int8ub), "a" / Int16ub)), frames="01020304"
    ),
    "RawCopy": case("r" / RawCopy(BODY), "z" / Int8ub, frames="01020304"),
    "RawCopy of another size": case(
        "n" / Int8ub, "r" / RawCopy(Bytes(this.n)), "d" / Bytes(this.r.length), frames="0261620102"
    ),
    "RawCopy of fields around": case(
        "n" / Int8ub, "r" / RawCopy(Struct("d" / Bytes(this._.n))), frames="026162 00"
    ),
    "RawCopy in elements": case("a" / Array(2, Struct("r" / RawCopy(Int16ub))), frames="01020304"),
    "Checksum of RawCopy": case(
        "r" / RawCopy(BODY), "c" / Checksum(Int8ub, add, this.r.data), frames="01020306"
    ),
    "Checksum of the part": case(
        "r" / RawCopy(BODY), "c" / Checksum(Int8ub, add_part, this.r), frames="01020306"
    ),
    "Checksum by a lambda": case(
        "r" / RawCopy(BODY),
        "c" / Checksum(Int8ub, add, lambda found: found.r.data),
        frames="01020306",
    ),
    "Checksum of bytes": case(
        "r" / RawCopy(BODY),
        "c" / Checksum(Bytes(2), add_as_bytes, this.r.data),
        frames="0102030600",
    ),
    "Checksum behind a length": case(
        "r" / Prefixed(Int8ub, RawCopy(Struct("k" / Int8ub, "d" / GreedyBytes))),
        "c" / Checksum(Int8ub, add, this.r.data),
        frames="0301020306 010101",
    ),
    "Padding": case("a" / Int8ub, Padding(2), "b" / Int8ub, frames="01000002 01020304"),
    "named Padding": case("a" / Int8ub, "spare" / Padding(2), frames="010000 010203"),
    "Padding with docs": case("a" / Int8ub, Padding(2) * "docs", frames="010000 010203"),
    "two Paddings": case(Padding(1), "a" / Int8ub, Padding(1), frames="000100 010203"),
    "Padding of bits": case("a" / BitStruct("x" / BitsInteger(3), Padding(5)), frames="e0 ff"),
    "Padded": case("a" / Padded(4, Int16ub), "b" / Int8ub, frames="0102000003 0102030405"),
    "Padded struct": case("a" / Array(2, Padded(3, TWO)), frames="010200030400 010203040506"),
    "Lazy": case("a" / Lazy(Int16ub), frames="0102"),
    "LazyStruct": case("a" / LazyStruct("x" / Int16ub, "y" / Int8ub), frames="010203"),
    "LazyArray": case("a" / LazyArray(2, Int16ub), frames="01020304"),
    "LazyBound": case("a" / LazyBound(lambda: BODY), frames="010203"),
    "Debugger": case("a" / Debugger(Int16ub), frames="0102"),
    "Rebuffered": case("a" / Rebuffered(Int16ub), frames="0102"),
    "compiled by construct": case("a" / BODY.compile(), frames="010203"),
}

PLAIN: dict[str, Case] = {
    "Computed by Python": case(
        "n" / Int8ub, "c" / Computed(odd_or_even), frames="01 02", reason="a Python function"
    ),
    "Computed of an array": case(
        "n" / Int8ub,
        "a" / Array(this.n, Int8ub),
        "c" / Computed(len_(this.a)),
        frames="020102",
        reason="a Python function",
    ),
    "Peek beyond the frame": case(
        "a" / Int8ub, "p" / Peek(Int8ub), frames="01", reason="may read beyond the frame"
    ),
    "Checksum of something else": case(
        "a" / Int8ub,
        "c" / Checksum(Int8ub, lambda number: number + 1, this.a),
        frames="0102",
        reason="Checksum",
    ),
    "FocusedSeq of another field": case(
        "n" / Int8ub,
        "a" / FocusedSeq("v", "k" / Const(b"K"), "v" / Bytes(this._.n)),
        frames="014b01 004b",
        reason="PrefixedArray and FocusedSeq must be named",
    ),
    "FocusedSeq in an array": case(
        "a" / Array(2, FocusedSeq("v", "k" / Const(b"K"), "v" / Int8ub)),
        frames="4b014b02",
        reason="PrefixedArray and FocusedSeq must be named",
    ),
    "VarInt in an array": case(
        "a" / Array(2, VarInt),
        "b" / Int8ub,
        frames="8101020c 01020c",
        reason="size of each element depends on its content",
    ),
    "CString in an array": case(
        "a" / Array(2, CString("utf8")),
        frames="61620000 00c3a900",
        reason="size of each element depends on its content",
    ),
    "NullTerminated that keeps its end": case(
        "a" / NullTerminated(GreedyBytes, require=False),
        "b" / Int8ub,
        frames="61620001",
        reason="terminator",
    ),
    "ProcessXor of a text": case(
        "a" / Prefixed(Int8ub, ProcessXor(0x55, GreedyString("ascii"))),
        frames="020102 00",
        reason="transforms bytes",
    ),
    "ProcessXor by a field": case(
        "k" / Int8ub,
        "a" / FixedSized(2, ProcessXor(this.k, GreedyBytes)),
        frames="550102 000102",
        reason="transforms bytes",
    ),
    "Transformed by a function": case(
        "a" / Transformed(TWO, flip, 2, flip, 2),
        frames="0102",
        reason="each frame must have the same bit fields",
    ),
    "VarInt as a count": case(
        "n" / VarInt, "d" / Bytes(this.n), frames="026162 00", reason="not a number of fixed size"
    ),
    "VarInt as a length": case(
        "a" / Prefixed(VarInt, Bytes(2)), frames="026162", reason="cannot be a length"
    ),
    "LazyBound of itself": case("a" / NODE, frames="00 020100", reason="contains itself"),
    "RepeatUntil": case(
        "a" / RepeatUntil(obj_ == 0, Int8ub), "b" / Int8ub, frames="01020003 0003", reason="Parts"
    ),
    "RepeatUntil by the elements before": case(
        "a" / RepeatUntil(lambda one, found, context: len(found) == 2, TWO),
        frames="01020003",
        reason="Parts",
    ),
    "If in elements of elements": case(
        "r" / Array(2, Array(1, Struct("k" / Int8ub, "v" / If(this.k, Int8ub)))),
        frames="000102 0000",
        reason="declare the array as Parts(struct, count)",
    ),
    "Index": case("r" / Array(2, Struct("i" / Index, "a" / Int8ub)), frames="0102", reason="Index"),
    "GreedyRange": case(
        "a" / GreedyRange(Int16ub), frames="01020304 0102", reason="rest", is_rest=True
    ),
    "GreedyRange of texts": case(
        "a" / GreedyRange(PascalString(Int8ub, "ascii")),
        frames="0161026263",
        reason="rest",
        is_rest=True,
    ),
    "Terminated": case("a" / Int8ub, Terminated, frames="01", reason="Terminated", is_rest=True),
    "ProcessXor of the rest": case(
        "a" / ProcessXor(0x55, GreedyBytes), frames="0102", reason="transforms", is_rest=True
    ),
}

CASES = COMPILED | PLAIN


def of_links(made: Sensor, *links: Any) -> Sensor:
    """Return a sensor with another data link."""
    return dataclasses.replace(made, links={"data": links[0]})


def bare(value: Any) -> Any:
    """Return construct's value as dicts, lists and values; read lazy values."""
    if isinstance(value, construct.lib.containers.Container | construct.core.LazyContainer):
        return {name: bare(value[name]) for name in value if not name.startswith("_")}
    if callable(value):
        return bare(value())
    if isinstance(value, list):
        return [bare(part) for part in value]
    return value


def drop_unread(value: Any) -> Any:
    """Return a parsed value without None, construct's value for absent parts."""
    if isinstance(value, dict):
        return {name: drop_unread(part) for name, part in value.items() if part is not None}
    return value


@pytest.mark.parametrize("name", CASES)
def test_values_and_bytes_are_those_of_construct(name: str) -> None:
    one = CASES[name]
    ours = sensor(one.struct)
    for content in one.frames:
        data = MARK + content
        wanted = drop_unread(bare(one.struct.parse(data)))
        found = ours.parse(data)
        assert has_all(found, wanted), f"{found} {wanted}"
        assert ours.build("data", found) == data


@pytest.mark.parametrize("name", CASES)
def test_frames_are_found_in_datagrams_and_streams(name: str) -> None:
    one = CASES[name]
    frames = [MARK + content for content in one.frames]
    ours = sensor(one.struct)
    packets = ours.decode(frames)
    assert len(packets) == len(frames)
    if one.is_rest:
        with pytest.raises(SpecError, match="must be sent as a datagram"):
            of_links(ours, Serial(9600))
        assert len(ours.decode(b"".join(frames))) == 0
        return
    stream = of_links(ours, Serial(9600)).decode(b"\0" + b"\0\0".join(frames))
    assert len(stream) == len(frames)
    assert stream.stats.plugin_errors == 0


def assert_padded(found: Any, wanted: Any, path: str) -> None:
    """Fail unless a column has the value of construct, padded with zeros."""
    if isinstance(wanted, list) and isinstance(found, np.ndarray):
        for index, part in enumerate(wanted):
            assert_padded(found[index], part, path)
        assert not np.any(found[len(wanted) :]), path
    elif wanted is not None:
        assert found == wanted, path


@pytest.mark.parametrize("name", CASES)
def test_columns_are_those_of_construct(name: str) -> None:
    one = CASES[name]
    frames = [MARK + content for content in one.frames]
    packets = sensor(one.struct).decode(frames)
    parsed = [bare(one.struct.parse(data)) for data in frames]
    assert packets.table.schema.columns.keys() >= {"mark"}
    for path in packets.table.schema.columns:
        column = packets.table.raw(path)
        for row, wanted in zip(column, parsed, strict=True):
            assert_padded(row, at(wanted, path.split(".")), path)


@pytest.mark.parametrize("name", CASES)
def test_it_is_known_which_frames_are_compiled(name: str) -> None:
    frame = sensor(CASES[name].struct).frames["data"]
    assert is_compiled(frame) == (name in COMPILED)
    if name in PLAIN:
        assert CASES[name].reason in interpreted_reason(frame)


def test_derived_values_are_columns_in_points() -> None:
    def points(f: Fields) -> Polar:
        return Polar(range=f.r.c + f.r.t, azimuth=0)

    element = Struct("a" / Int8ub, "c" / Computed(this.a * 2 + this._.k), "t" / Tell)
    made = sensor(Struct("k" / Int8ub, "r" / Array(2, element)))
    ours = dataclasses.replace(made, points=points, range_limits=(0.1, 1000.0))
    cloud = ours.decode([bytes([10, 1, 2]), bytes([20, 3, 4])]).points()
    assert cloud.range.tolist() == [12 + 2, 14 + 3, 26 + 2, 28 + 3]


def test_build_ignores_derived_values_and_takes_edits() -> None:
    struct = Struct("r" / RawCopy(BODY), "c" / Checksum(Int8ub, add, this.r.data), "t" / Tell)
    ours = sensor(struct)
    found = ours.parse(b"\1\2\3\6")
    found.r.value.a = 2
    found.r.offset1 = found.t = 99
    assert ours.build("data", found) == b"\2\2\3\7"
    assert ours.build("data", r=dict(value=dict(a=1, b=2))) == b"\1\0\2\3"


def test_frames_that_construct_reads_take_edits_of_a_raw_copy() -> None:
    ours = sensor(Struct("r" / RawCopy(BODY), "text" / Array(1, CString("ascii"))))
    assert not is_compiled(ours.frames["data"])
    found = ours.parse(b"\1\2\3x\0")
    found.r.value.a = 9
    assert ours.build("data", found) == b"\x09\2\3x\0"
    assert ours.build("data", r=dict(data=b"\7\7\7"), text=["x"]) == b"\7\7\7x\0"


def test_branches_with_different_lengths_of_one_name_are_built_as_parsed() -> None:
    branches = {1: Struct("d" / GreedyBytes), 2: Struct("k" / Int16ub, "d" / GreedyBytes)}
    content = Struct("kind" / Int8ub, "v" / Switch(this.kind, branches))
    ours = sensor(Struct("a" / Prefixed(Int8ub, content)))
    for data in (b"\3\1ab", b"\5\2\0\0ab"):
        assert ours.build("data", ours.parse(data)) == data


def test_a_nested_field_may_have_a_name_that_points_reserves() -> None:
    part = Struct("state" / Int8ub, "on" / Int8ub)
    ours = dataclasses.replace(
        sensor(Struct("a" / Array(2, part))),
        points=lambda f: Polar(range=f.a.state + f.a.on, azimuth=0),
    )
    assert ours.decode([b"\1\2\3\4"]).points().range.tolist() == [3, 7]
    with pytest.raises(SpecError, match="'state'"):
        sensor(part)


def test_a_recoded_struct_is_explained_as_one_field() -> None:
    data = MARK + b"\1\2"
    explained = explain(data, sensor(CASES["Transformed by a function"].struct))
    assert [field.raw for field in explained.fields.values()][-2:] == [0x54, 0x57]


def test_a_wrong_checksum_of_construct_is_counted_as_one() -> None:
    for function, reads in (
        (add, this.r.data),
        (add, lambda found: found.r.data[:]),
    ):
        struct = Struct("r" / RawCopy(BODY), "c" / Checksum(Int8ub, function, reads))
        ours = sensor(struct)
        assert ours.build("data", r=dict(value=dict(a=1, b=2))) == b"\1\0\2\3"
        assert ours.decode([b"\1\0\2\4"]).stats.bad_checksum == 1
        with pytest.raises(WireError, match=r"c.* checksum 0x4, expected 0x3|c.* checksum 0x04"):
            ours.parse(b"\1\0\2\4")
        assert ours.parse(b"\1\0\2\4", verify=False).c == 4


def test_bytes_that_cannot_be_decompressed_are_no_frame() -> None:
    ours = sensor(Struct("k" / Int8ub, "a" / Prefixed(Int8ub, Compressed(GreedyBytes, "zlib"))))
    data = ours.build("data", k=1, a=b"abc")
    assert ours.build("data", ours.parse(data)) == data
    with pytest.raises(
        WireError, match="a at byte 2: value bytes that cannot be decompressed, expected bytes"
    ):
        ours.parse(b"\1\2ab")
    assert ours.decode([b"\1\2ab", data]).stats.implausible == 1


def test_a_text_that_is_none_makes_the_frame_implausible() -> None:
    ours = sensor(Struct("k" / Int8ub, "a" / PaddedString(2, "ascii")))
    packets = ours.decode([b"\1ab", b"\1a\xff", b"\2c\0"])
    assert packets.stats.implausible == 1
    assert packets.table.raw("a").tolist() == ["ab", "c"]
    with pytest.raises(WireError):
        ours.parse(b"\1a\xff")


def test_edited_texts_and_numbers_are_encoded() -> None:
    ours = sensor(
        Struct(
            "t" / PascalString(Int8ub, "ascii"),
            "p" / PaddedString(3, "ascii"),
            "n" / ExprAdapter(Int8ub, obj_ * 2, obj_ // 2),
        )
    )
    assert ours.build("data", t="abc", p="x", n=8) == b"\3abcx\0\0\4"
    for values in (dict(t="\xe9"), dict(p="wxyz"), dict(n=1000), dict(n="x")):
        with pytest.raises(UsageError):
            ours.build("data", dict(t="", p="", n=0) | values)


def test_adapters_are_applied_in_points() -> None:
    ours = dataclasses.replace(
        sensor(Struct("a" / Array(2, ExprAdapter(Int8ub, obj_ / 2, lambda obj, _: int(obj * 2))))),
        points=lambda f: Polar(range=f.a, azimuth=0),
    )
    assert ours.decode([b"\1\2", b"\3\4"]).points().range.tolist() == [0.5, 1, 1.5, 2]


REFUSED: dict[str, tuple[Callable[[], Construct], str]] = {
    "Union": (lambda: construct.Union(0, "x" / Int16ub, "y" / Bytes(2)), "declare a single field"),
    "Seek": (lambda: construct.Seek(4), "outside the frame"),
    "Pointer": (lambda: construct.Pointer(1, Byte), "outside the frame"),
    "Flag": (lambda: construct.Flag, "use a BitStruct"),
    "FlagsEnum": (lambda: construct.FlagsEnum(Byte, a=1), "FlagsEnum loses undeclared bits"),
    "an adapter that loses bits": (
        lambda: ExprAdapter(Byte, obj_ & 0x7F, obj_ & 0x7F),
        "ExprAdapter changes 128 to 0",
    ),
    "Optional": (lambda: construct.Optional(Byte), "use If or Switch"),
    "Slicing": (lambda: construct.Slicing(Byte[3], 3, 0, 1), "use the Array without Slicing"),
    "FocusedSeq of two": (lambda: FocusedSeq("v", "k" / Byte, "v" / Byte), "loses 'k'"),
    "ProcessXor before others": (
        lambda: Struct("x" / ProcessXor(1, GreedyBytes), "y" / Byte),
        "ProcessXor has no end in a stream",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused_says_what_to_write(name: str) -> None:
    make, reason = REFUSED[name]
    with pytest.raises(SpecError, match=reason):
        sensor(Struct("a" / make()))


def test_the_count_of_an_array_in_a_focused_sequence_may_be_a_part_of_a_number() -> None:
    count = "n" / Rebuild(Int8ub, len_(this.v))
    for length, data in ((this.n & 0x7F, b"\x82\1\2"), (lambda c: min(c.n, 5), b"\6\1\2\3\4\5")):
        ours = sensor(Struct("a" / FocusedSeq("v", count, "v" / Array(length, Int8ub))))
        assert ours.parse(data).a == list(data[1:])


@pytest.mark.parametrize("limit", [5, 2**63, 2**64 - 1])
def test_the_end_of_an_array_may_be_a_wide_number(limit: int) -> None:
    element = Struct("id" / Int64ub, "size" / Int8ub, "rest" / Bytes(this.size))
    ours = sensor(Struct("a" / RepeatUntil(obj_.id >= limit, element)))
    data = bytes(9) + limit.to_bytes(8, "big") + b"\1x"
    assert [part.id for part in ours.parse(data).a] == [0, limit]
    assert len(ours.decode([data])) == 1


def test_an_end_that_fails_is_an_error_of_the_plugin() -> None:
    element = Struct("x" / Int8ub, "y" / Int8ub, "z" / If(this.x, Int8ub))
    ours = sensor(Struct("a" / RepeatUntil(lambda e, found, c: e.x // e.y == 2, element)))
    assert len(ours.parse(b"\0\1\4\2\7").a) == 2
    assert ours.decode([b"\1\0\1"]).stats.plugin_errors == 1
