"""The checksum of one frame as a function made for its algorithm: what the checksums of a batch are too heavy for.

Algorithms of which nothing better is known are called as they are. What is made here gives the same.

One frame to the Container that construct would give, by code made from its layout: what `parse` uses where it can.

For each layout a function is written once: size, constants and checksums compared, one `struct.unpack` for all numbers, bits by
mask and shift, containers and lists around them in the order of the struct. Where anything is not as it should be it
returns None; construct then parses the frame again and says what.

A Container is made empty and filled by name, which takes half the time of ``Container(name=value)``. Short arrays are
written out element by element, long ones are loops over `struct.iter_unpack`.

Which generated code parses a frame: found by the bytes of the header fields that its layout depends on.
"""

from __future__ import annotations

import binascii
import functools
import math
import struct
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import construct
from construct import Array, Bytes, BytesInteger, Construct, Container, FormatField, ListContainer, Struct

from lidarspec.spec.bits import BitField, probe
from lidarspec.spec.checksums import Checksum, Crc, Sum, WordXor, Xor
from lidarspec.spec.construct_layer import WireNaN
from lidarspec.spec.fields import Checksummed
from lidarspec.wire.layout import Layout, Leaf, Seal
from lidarspec.wire.layout_tree import HeaderTree
from lidarspec.wire.schema import FieldInfo, axis_path, peeled

Single = Callable[[bytes], int]


def single(algorithm: Checksum) -> Single:
    """A function from bytes to their checksum."""
    if type(algorithm) is Crc:
        return _crc(algorithm)
    if type(algorithm) is Xor:
        return _xor
    if type(algorithm) is Sum:
        mask = (1 << algorithm.width) - 1
        return lambda data: sum(data) & mask
    if type(algorithm) is WordXor:
        return _word_xor(algorithm)
    return algorithm


@functools.lru_cache(maxsize=256)
def _crc(algorithm: Crc) -> Single:
    init, xorout = algorithm.init, algorithm.xorout
    if (algorithm.width, algorithm.poly, algorithm.refin, algorithm.refout) == (16, 0x1021, False, False):
        return lambda data: binascii.crc_hqx(data, init) ^ xorout
    if (algorithm.width, algorithm.poly, algorithm.refin, algorithm.refout) == (32, 0x04C11DB7, True, True):
        start, end = int(f"{init:032b}"[::-1], 2) ^ 0xFFFFFFFF, xorout ^ 0xFFFFFFFF
        return lambda data: zlib.crc32(data, start) ^ end
    if algorithm.width != 8:
        return algorithm
    # One byte more changes the register by a table, whichever bit comes first; `refout` and `xorout` apply at the end.
    plain = Crc(8, algorithm.poly, refin=algorithm.refin, refout=algorithm.refin)
    table = tuple(plain(bytes([byte])) for byte in range(256))
    first = int(f"{init:08b}"[::-1], 2) if algorithm.refin else init
    mirrored = algorithm.refin != algorithm.refout
    leaving = bytes((int(f"{value:08b}"[::-1], 2) if mirrored else value) ^ xorout for value in range(256))

    def crc8(data: bytes, table: tuple[int, ...] = table) -> int:
        register = first
        for byte in data:
            register = table[register ^ byte]
        return leaving[register]

    return crc8


def _xor(data: bytes) -> int:
    value = int.from_bytes(data, "little")
    for power in _powers(8, len(data)):
        value ^= value >> power
    return value & 0xFF


def _word_xor(algorithm: WordXor) -> Single:
    """Groups of words are XORed as a whole, whatever their sizes, and only their XOR is taken apart."""
    head, groups = algorithm.head, algorithm.groups
    size = sum(groups)
    starts = [8 * sum(groups[:number]) for number in range(len(groups))]
    head_powers = _powers(16, head + 1 >> 1)
    words = [(start, (1 << 8 * width) - 1) for start, width in zip(starts, groups, strict=True)]

    def word_xor(data: bytes) -> int:
        found = int.from_bytes(data[:head], "little")
        for power in head_powers:
            found ^= found >> power
        found &= 0xFFFF
        value = int.from_bytes(data[head:], "little")
        for power in _powers(8 * size, -((head - len(data)) // size)):
            value ^= value >> power
        for start, mask in words:
            found ^= value >> start & mask
        return found

    return word_xor


@functools.lru_cache(maxsize=4096)
def _powers(bits: int, count: int) -> tuple[int, ...]:
    """By how much an integer is shifted and XORed onto itself until its lowest part is the XOR of so many parts."""
    return tuple(bits << power for power in reversed(range(max(count - 1, 0).bit_length())))


Unpack = Callable[[bytes], Any]

#: format codes of unsigned numbers by size.
_CODES = {1: "B", 2: "H", 4: "I", 8: "Q"}
#: the most lines that an array is written out in, element by element; code has to stay small.
_WRITTEN_OUT = 200


class Unsupported(Exception):
    """A part of the struct that has to be left to construct."""


def unpacker(con: Construct, layout: Layout) -> Unpack | None:
    """A function from bytes to the Container of a sound frame of this layout, else to None; None where construct has to parse it."""
    try:
        writer = min((_Writer(con, layout, order) for order in "<>"), key=lambda one: one.conversions)
    except Unsupported:
        return None
    exec(writer.text, writer.names)  # made here, of field names and numbers
    found: Unpack = writer.names["parse"]
    return found


class _Scope:
    """Values that are unpacked together and the lines that use them: the frame, or one element of an array that is a loop."""

    def __init__(self, name: str) -> None:
        self.name, self.format = name, ""
        self.values: list[str] = []
        self.lines: list[str] = []

    def take(self, code: str, count: int = 1) -> list[str]:
        """Add a format code, and the names of the values that it gives."""
        self.format += code
        self.values += [f"{self.name}_{len(self.values) + index}" for index in range(count)]
        return self.values[len(self.values) - count :]

    def one(self, code: str) -> str:
        """Add a format code that gives one value, and its name."""
        return self.take(code)[0]

    @property
    def target(self) -> str:
        """What the tuple of values is assigned to."""
        return f"{', '.join(self.values)}," if self.values else "_"


class _Writer:
    """Writes the function for a struct with numbers of one byte order read directly; `conversions` counts all others."""

    def __init__(self, con: Construct, layout: Layout, order: str) -> None:
        self._layout, self._order, self._variables, self.conversions = layout, order, 0, 0
        self.names: dict[str, Any] = {"C": Container, "L": ListContainer, "int_": int.from_bytes}
        scope = _Scope("v")
        result = self._value(con, FieldInfo(""), scope)
        checks = [f"    if {check}: return None" for check in self._checks()]
        unpack = f"    {scope.target} = {self._named(struct.Struct(order + scope.format).unpack)}(data)"
        lines = ["def parse(data):", *checks, unpack, *(f"    {line}" for line in scope.lines), f"    return {result}"]
        self.text = "\n".join(lines)

    def _checks(self) -> Iterator[str]:
        """Conditions under which the frame is none of this layout, or not sound."""
        yield f"len(data) != {self._layout.size}"
        start, run = 0, b""
        for spot, (mask, value) in sorted(self._layout.constants.items()):
            if mask != 0xFF:
                yield f"data[{spot}] & {mask} != {value}"
                continue
            if run and spot == start + len(run):
                run += bytes([value])
                continue
            if run:
                yield f"data[{start}:{start + len(run)}] != {run!r}"
            start, run = spot, bytes([value])
        if run:
            yield f"data[{start}:{start + len(run)}] != {run!r}"
        yield from map(self._unsealed, self._layout.seals)

    def _unsealed(self, seal: Seal) -> str:
        leaf = seal.leaves[0]
        if len(seal.leaves) > 1 or (leaf.wire is None and leaf.info.kind != "bytes"):
            return f"not {self._named(seal.sound)}(data)"
        big = seal.algorithm.order == "big" if leaf.wire is None or leaf.info.kind == "bytes" else leaf.wire.str[0] == ">"
        place = f"data[{leaf.offset}:{leaf.offset + leaf.size}]"
        stored = f"data[{leaf.offset}]" if leaf.size == 1 else f"int_({place}, {'big' if big else 'little'!r})"
        covered = " + ".join(f"data[{start}:{end}]" for start, end in seal.spans) or "b''"
        wrong = f"{self._named(single(seal.algorithm))}({covered}) != {stored}"
        return f"{wrong} and {stored} not in {seal.absent!r}" if seal.absent else wrong

    def _value(self, con: Construct, info: FieldInfo, scope: _Scope) -> str:
        """The expression of a construct at a place, its bytes and lines added to the scope."""
        labels = _labels(con)
        inner, info = peeled(con, info)
        if info.const is not None and not isinstance(inner, Struct | Array):
            scope.take(f"{inner.sizeof()}x", 0)
            return self._labelled(labels, self._named(info.const))
        if isinstance(inner, construct.IfThenElse | construct.Switch):
            return self._value(self._layout.branches[inner], FieldInfo(info.path, info.axes), scope)
        if isinstance(inner, Checksummed):
            return self._value(inner.subcon, FieldInfo(info.path, info.axes), scope)
        if isinstance(inner, Struct):
            return self._struct(inner, info, scope)
        if isinstance(inner, Array):
            return self._array(inner, info, scope)
        if inner is construct.Pass:
            return "None"
        if isinstance(inner, construct.Transformed):
            return self._block(inner, scope)
        return self._labelled(labels, self._scalar(inner, info, scope))

    def _struct(self, con: Struct, info: FieldInfo, scope: _Scope) -> str:
        found = self._variable(scope, "C()")
        for child in con.subcons:
            path = info.path if child.name is None else f"{info.path}.{child.name}" if info.path else child.name
            text = self._value(child, FieldInfo(path, info.axes), scope)
            if child.name is not None:
                scope.lines.append(f"{found}[{child.name!r}] = {text}")
        return found

    def _array(self, con: Array, info: FieldInfo, scope: _Scope) -> str:
        axis = axis_path(info)
        number = con.count if isinstance(con.count, int) else self._layout.lengths[axis]
        if number == 0:
            return "L()"
        info = FieldInfo(info.path, (*info.axes, axis))
        self._variables += 1
        element = _Scope(f"e{self._variables}")
        text = self._value(con.subcon, info, element)
        if number * (len(element.lines) + 1) <= _WRITTEN_OUT:
            return _list(self._value(con.subcon, info, scope) for _ in range(number))
        size = struct.calcsize(self._order + element.format)
        whole = scope.one(f"{size * number}s")
        if [text] == element.values:
            return f"L({self._named(struct.Struct(self._order + element.format * number).unpack)}({whole}))"
        elements = f"{self._named(struct.Struct(self._order + element.format).iter_unpack)}({whole})" if size else f"range({number})"
        found = self._variable(scope, "L()")
        loop = f"for {element.target} in {elements}:"
        scope.lines += [loop, *(f"    {line}" for line in element.lines), f"    {found}.append({text})"]
        return found

    def _scalar(self, con: Construct, info: FieldInfo, scope: _Scope) -> str:
        if isinstance(con, FormatField):
            order, code = con.fmtstr[0], con.fmtstr[-1]
            if code in "efd":
                return f"{self._named(_floating(con.fmtstr))}({scope.one(f'{con.length}s')})"
            if con.length == 1 or order == self._order:
                return scope.one(_CODES[con.length] if code.isupper() else _CODES[con.length].lower())
            big = order == ">" or (order == "=" and sys.byteorder == "big")
            return self._integer(scope.one(f"{con.length}s"), big=big, signed=code.islower())
        if isinstance(con, BytesInteger) and isinstance(con.length, int) and isinstance(con.swapped, bool):
            return self._integer(scope.one(f"{con.length}s"), big=not con.swapped, signed=bool(con.signed))
        if isinstance(con, Bytes):
            return scope.one(f"{con.length if isinstance(con.length, int) else self._layout.lengths[axis_path(info)]}s")
        raise Unsupported

    def _integer(self, raw: str, *, big: bool, signed: bool) -> str:
        self.conversions += 1
        return f"int_({raw}, {'big' if big else 'little'!r}{', signed=True' if signed else ''})"

    def _block(self, con: Construct, scope: _Scope) -> str:
        size = int(con.sizeof())
        return self._bits(con.subcon, (), _probed(con), scope, scope.take("B" * size, size))

    def _bits(self, con: Construct, keys: tuple[str | int, ...], bits: Mapping[Any, BitField], scope: _Scope, block: list[str]) -> str:
        labels = _labels(con)
        inner, info = peeled(con, FieldInfo(""))
        while isinstance(inner, construct.Transformed | construct.Restreamed):
            inner, info = peeled(inner.subcon, info)
        if isinstance(inner, Struct):
            found = self._variable(scope, "C()")
            for child in inner.subcons:
                text = self._bits(child, (*keys, child.name), bits, scope, block)
                scope.lines.append(f"{found}[{child.name!r}] = {text}")
            return found
        if isinstance(inner, Array) and isinstance(inner.count, int):
            return _list(self._bits(inner.subcon, (*keys, index), bits, scope, block) for index in range(inner.count))
        if info.const is not None:
            return self._labelled(labels, self._named(info.const))
        if keys not in bits or inner is construct.Flag:
            raise Unsupported
        return self._labelled(labels, self._joined(bits[keys], block))

    def _joined(self, field: BitField, block: list[str]) -> str:
        """The expression of a value from the bits of several bytes: looked up by byte, which is quicker than a mask and a shift."""
        parts = []
        for segment in field.segments:
            text, name = block[segment.byte], f"b{segment.mask}_{segment.low}_{segment.target}"
            if segment.mask == 0xFF:
                parts.append(f"{text} * {1 << segment.target}" if segment.target else text)
                continue
            self.names[name] = _looked_up(segment.mask, segment.low, segment.target)
            parts.append(f"{name}[{text}]")
        text = " + ".join(parts)
        if field.signed:
            sign = 1 << (field.width - 1)
            return f"(({text} ^ {sign}) - {sign})"
        return text

    def _labelled(self, labels: construct.Enum | None, text: str) -> str:
        return text if labels is None else f"{self._named(_Labels(labels))}[{text}]"

    def _variable(self, scope: _Scope, value: str) -> str:
        self._variables += 1
        scope.lines.append(f"x{self._variables} = {value}")
        return f"x{self._variables}"

    def _named(self, value: Any) -> str:
        if isinstance(value, int | bytes):
            return repr(value)
        name = f"c{len(self.names)}"
        self.names[name] = value
        return name


class _Labels(dict[int, Any]):
    """What an Enum makes of a number; construct makes a new one each time, and they are all alike."""

    def __init__(self, labels: construct.Enum) -> None:
        super().__init__({value: labels._decode(value, None, None) for value in map(int, labels.ksymapping)})
        self._labels = labels

    def __missing__(self, value: int) -> Any:
        return self._labels._decode(value, None, None)


@functools.cache
def _looked_up(mask: int, low: int, target: int) -> tuple[int, ...]:
    """What each byte adds to a value by a run of its bits."""
    return tuple((byte & mask) >> low << target for byte in range(256))


@functools.lru_cache(maxsize=1024)
def _probed(con: Construct) -> dict[tuple[str | int, ...], BitField]:
    return {field.keys: field for field in probe(con, int(con.sizeof())) or ()}


def _list(elements: Iterable[str]) -> str:
    return f"L(({''.join(f'{element}, ' for element in elements)}))"


def _labels(con: Construct) -> construct.Enum | None:
    while isinstance(con, construct.Subconstruct):
        if isinstance(con, construct.Enum):
            return con
        if isinstance(con, construct.Transformed | Array | Checksummed):
            return None
        con = con.subcon
    return None


def _floating(fmtstr: str) -> Callable[[bytes], float]:
    reader = struct.Struct(fmtstr).unpack

    def read(raw: bytes) -> float:
        value: float = reader(raw)[0]
        return WireNaN(raw) if math.isnan(value) else value

    return read


#: headers whose functions are remembered; frames that are all different must not fill the memory.
_REMEMBERED = 4096


def frame_parser(con: Construct, tree: HeaderTree) -> Unpack:
    """A function from the bytes of a whole, sound frame to its Container; it gives None where construct has to look at them."""
    root: Unpack | _Branch | None = None
    known = 0
    start = b""
    while tree.prefix.get(len(start), (0, 0))[0] == 0xFF:
        start += bytes([tree.prefix[len(start)][1]])

    def learned(frame: bytes) -> Unpack:
        nonlocal root, known
        if not frame.startswith(start):
            return _nothing
        layout = tree.layout(frame)
        if not isinstance(layout, Layout):
            return _nothing
        found: Unpack = layout.notes.get(unpacker) or layout.notes.setdefault(unpacker, unpacker(con, layout) or _nothing)
        if known >= _REMEMBERED:
            root, known = None, 0
        known += 1
        leaves = tree.asked(frame)
        if not leaves:
            root = found
            return found
        root = node = root if isinstance(root, _Branch) else _Branch(leaves[0])
        for leaf in leaves[1:]:
            node = node.setdefault(frame[node.start : node.end], _Branch(leaf))
        node[frame[node.start : node.end]] = found
        return found

    def parse(frame: bytes) -> Any:
        node = root
        while isinstance(node, _Branch):
            node = node.get(frame[node.start : node.end])
        return (node or learned(frame))(frame)

    return parse


class _Branch(dict[bytes, Any]):
    """What follows, by the bytes of a header field: another field, or the function for the frame."""

    def __init__(self, leaf: Leaf) -> None:
        super().__init__()
        self.start, self.end = leaf.offset, leaf.offset + leaf.size


def _nothing(frame: bytes) -> None:
    """Leaves the frame to construct."""
