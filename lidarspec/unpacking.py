"""One frame to the Container that construct would give, by code made from its layout: what `parse` uses where it can.

For each layout a function is written once: one `struct.unpack` for all numbers, bits by mask and shift, containers and lists
around them in the order of the struct. Constants and checksums are checked before; where anything is not as it should be,
construct parses the frame again and says what.
"""

from __future__ import annotations

import math
import struct
import sys
from collections.abc import Callable
from typing import Any

import construct
from construct import Array, Bytes, BytesInteger, Construct, Container, FormatField, ListContainer, Struct

from lidarspec.bits import BitField, probe
from lidarspec.construction import WireNaN
from lidarspec.fields import Checksummed
from lidarspec.layout import Layout
from lidarspec.schema import FieldInfo, axis_path, peeled

Unpack = Callable[[bytes], Any]

#: format codes of unsigned numbers by size.
_CODES = {1: "B", 2: "H", 4: "I", 8: "Q"}


class Unsupported(Exception):
    """A part of the struct that has to be left to construct."""


def unpacker(con: Construct, layout: Layout) -> Unpack | None:
    """A function from the bytes of a frame of this layout to its Container; None where construct has to parse it."""
    try:
        written = [_written(con, layout, order) for order in "<>"]
    except Unsupported:
        return None
    scope, writer, body = min(written, key=lambda one: one[2].count("int_("))
    names: dict[str, Any] = {
        **writer.names,
        "Container": Container,
        "ListContainer": ListContainer,
        "unpack": struct.Struct(writer.order + scope.format).unpack,
    }
    exec(f"def parse(data):\n    t = unpack(data)\n    return {body}", names)  # the text is made here, of field names and numbers
    found: Unpack = names["parse"]
    return found


def _written(con: Construct, layout: Layout, order: str) -> tuple[_Scope, _Writer, str]:
    """The expression of a frame, with numbers of this byte order read directly."""
    writer, scope = _Writer(layout, order), _Scope("t")
    return scope, writer, writer.value(con, FieldInfo(""), scope)


class _Scope:
    """A tuple of unpacked values: the frame, or one element of an array."""

    def __init__(self, name: str) -> None:
        self.name, self.format, self.count = name, "", 0

    def take(self, code: str, values: int = 1) -> str:
        """Add a format code, and the expression of the (first) value that it gives."""
        self.format += code
        self.count += values
        return f"{self.name}[{self.count - values}]"


class _Writer:
    """Writes expressions for the parts of a struct."""

    def __init__(self, layout: Layout, order: str) -> None:
        self._layout, self.order = layout, order
        self.names: dict[str, Any] = {"int_": int.from_bytes}

    def value(self, con: Construct, info: FieldInfo, scope: _Scope) -> str:
        """The expression of a construct at a place, its bytes added to the scope."""
        labels = _labels(con)
        inner, info = peeled(con, info)
        if info.const is not None and not isinstance(inner, Struct | Array):
            scope.take(f"{inner.sizeof()}x", 0)
            return self._named(info.const)
        if isinstance(inner, construct.IfThenElse | construct.Switch):
            return self.value(self._layout.branches[info.path], FieldInfo(info.path, info.axes), scope)
        if isinstance(inner, Checksummed):
            return self.value(inner.subcon, FieldInfo(info.path, info.axes), scope)
        if isinstance(inner, Struct):
            return self._struct(inner, info, scope)
        if isinstance(inner, Array):
            return self._array(inner, info, scope)
        if inner is construct.Pass:
            return "None"
        if isinstance(inner, construct.Transformed):
            return self._block(inner, info, scope)
        text = self._scalar(inner, info, scope)
        return text if labels is None else f"{self._named(_decoding(labels))}({text})"

    def _struct(self, con: Struct, info: FieldInfo, scope: _Scope) -> str:
        members = []
        for child in con.subcons:
            path = info.path if child.name is None else f"{info.path}.{child.name}" if info.path else child.name
            text = self.value(child, FieldInfo(path, info.axes), scope)
            if child.name is not None:
                members.append(f"{child.name}={text}")
        return f"Container({', '.join(members)})"

    def _array(self, con: Array, info: FieldInfo, scope: _Scope) -> str:
        axis = axis_path(info)
        number = con.count if isinstance(con.count, int) else self._length(axis)
        element = _Scope(f"e{len(info.axes)}")
        text = self.value(con.subcon, FieldInfo(info.path, (*info.axes, axis)), element)
        start = scope.count
        scope.take(element.format * number, element.count * number)
        part = f"{scope.name}[{start}:{scope.count}]"
        if element.count == 0:
            return f"ListContainer([{text} for _ in range({number})])"
        if text == f"{element.name}[0]" and element.count == 1:
            return f"ListContainer({part})"
        return f"ListContainer([{text} for {element.name} in zip(*[iter({part})] * {element.count})])"

    def _length(self, axis: str) -> int:
        for leaf in self._layout.leaves.values():
            if axis in leaf.info.axes:
                return leaf.shape[leaf.info.axes.index(axis)]
        raise Unsupported

    def _scalar(self, con: Construct, info: FieldInfo, scope: _Scope) -> str:
        if isinstance(con, FormatField):
            order, code = con.fmtstr[0], con.fmtstr[-1]
            if code in "efd":
                return f"{self._named(_floating(con.fmtstr))}({scope.take(f'{con.length}s')})"
            if con.length == 1 or order == self.order:
                return scope.take(_CODES[con.length] if code.isupper() else _CODES[con.length].lower())
            return _integer(
                scope.take(f"{con.length}s"), big=order == ">" or (order == "=" and sys.byteorder == "big"), signed=code.islower()
            )
        if isinstance(con, BytesInteger) and isinstance(con.length, int) and isinstance(con.swapped, bool):
            return _integer(scope.take(f"{con.length}s"), big=not con.swapped, signed=bool(con.signed))
        if isinstance(con, Bytes):
            return scope.take(f"{con.length if isinstance(con.length, int) else self._length(axis_path(info))}s")
        raise Unsupported

    def _block(self, con: Construct, info: FieldInfo, scope: _Scope) -> str:
        size = int(con.sizeof())
        first = scope.count
        scope.take("B" * size, size)
        bits = {field.keys: field for field in probe(con, size) or ()}
        return self._bits(con.subcon, (), bits, f"{scope.name}", first)

    def _bits(self, con: Construct, keys: tuple[str | int, ...], bits: dict[Any, BitField], name: str, first: int) -> str:
        labels = _labels(con)
        inner, info = peeled(con, FieldInfo(""))
        while isinstance(inner, construct.Transformed | construct.Restreamed):
            inner, info = peeled(inner.subcon, info)
        if isinstance(inner, Struct):
            members = [f"{child.name}={self._bits(child, (*keys, child.name), bits, name, first)}" for child in inner.subcons]
            return f"Container({', '.join(members)})"
        if isinstance(inner, Array) and isinstance(inner.count, int):
            return f"ListContainer([{', '.join(self._bits(inner.subcon, (*keys, i), bits, name, first) for i in range(inner.count))}])"
        if info.const is not None:
            return self._named(info.const)
        if keys not in bits or inner is construct.Flag:
            raise Unsupported
        text = " | ".join(f"({name}[{first + p.byte}] & {p.mask}) >> {p.low} << {p.target}" for p in bits[keys].segments)
        if bits[keys].signed:
            sign = 1 << (bits[keys].width - 1)
            text = f"(({text}) ^ {sign}) - {sign}"
        return f"({text})" if labels is None else f"{self._named(_decoding(labels))}({text})"

    def _named(self, value: Any) -> str:
        if isinstance(value, int | bytes):
            return repr(value)
        name = f"c{len(self.names)}"
        self.names[name] = value
        return name


def _integer(raw: str, *, big: bool, signed: bool) -> str:
    return f"int_({raw}, {'big' if big else 'little'!r}, signed={signed})"


def _labels(con: Construct) -> construct.Enum | None:
    while isinstance(con, construct.Subconstruct):
        if isinstance(con, construct.Enum):
            return con
        if isinstance(con, construct.Transformed | Array | Checksummed):
            return None
        con = con.subcon
    return None


def _decoding(labels: construct.Enum) -> Callable[[int], Any]:
    return lambda value: labels._decode(value, None, None)


def _floating(fmtstr: str) -> Callable[[bytes], float]:
    reader = struct.Struct(fmtstr).unpack

    def read(raw: bytes) -> float:
        value: float = reader(raw)[0]
        return WireNaN(raw) if math.isnan(value) else value

    return read
