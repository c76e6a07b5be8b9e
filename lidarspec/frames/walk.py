"""From a construct tree to a `Layout`: one walk with a cursor.

Where a count, an If or a Switch asks for the value of a header field, a `read` function supplies it: from the bytes
at hand, or chosen at will to make an example. So one walk gives the layout of one kind of header, and
`lidarspec.frames.headers` keeps one per distinct header. What has no place that can be computed this way is refused with a
path and a reason (`NotCompilable`), and is then interpreted by construct.
"""

from __future__ import annotations

import contextlib
import functools
import operator
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import construct
import numpy as np
from construct import Array, Bytes, BytesInteger, Construct, FormatField, Struct

from lidarspec.bits import BitField, probe
from lidarspec.errors import SpecError
from lidarspec.fields import Checksummed
from lidarspec.frames.layout import Layout, Leaf, Seal
from lidarspec.frames.schema import FieldInfo, axis_path, fields_below, peeled


class NotCompilable(Exception):
    """A part of a struct that has no computable place; attributes `path` and `reason`."""

    def __init__(self, path: str, reason: str) -> None:
        self.path, self.reason = path, reason
        super().__init__(f"{path}: {reason}" if path else reason)


class Unread(Exception):
    """The value of a field that the layout depends on is not there."""


class TooLong(Exception):
    """The header claims more than the longest length that the frame declares, or no byte at all."""


Read = Callable[[Leaf], int]


@dataclass
class Walk:
    """The state of one walk through a struct: how far it came, what it found, and the values that it asked for."""

    read: Read
    limit: int
    cursor: int = 0
    leaves: dict[str, Leaf] = field(default_factory=dict)
    constants: dict[int, tuple[int, int]] = field(default_factory=dict)
    seals: list[Seal] = field(default_factory=list)
    places: dict[str, tuple[int, int]] = field(default_factory=dict)
    branches: dict[Construct, Construct] = field(default_factory=dict)
    lengths: dict[str, int] = field(default_factory=dict)
    asked: dict[str, int] = field(default_factory=dict)
    rebuilt: list[tuple[Leaf, Scope]] = field(default_factory=list)

    def run(self, con: Construct) -> Walk:
        """Go through a prepared struct from here."""
        _visit(self, con, _Place(FieldInfo(""), Scope(self, None, "", element=False)))
        return self

    def layout(self) -> Layout:
        """What was found, as a value."""
        seals, following = tuple(self.seals), self._following()
        return Layout(self.cursor, self.leaves, self.constants, seals, self.places, self.branches, following, self.lengths)

    def value(self, leaf: Leaf) -> int:
        """The value of a field that the layout depends on."""
        if leaf.info.path not in self.asked:
            self.asked[leaf.info.path] = self.read(leaf)
        return self.asked[leaf.info.path]

    def _following(self) -> tuple[tuple[Leaf, int], ...]:
        """The values of `Rebuild` fields that follow from constants and from those that the layout depends on, and from no other."""
        found: list[tuple[Leaf, int]] = []
        self.read = _unasked
        for leaf, scope in self.rebuilt:
            with contextlib.suppress(Exception):  # of the others: construct evaluates them when a frame is built
                found.append((leaf, operator.index(leaf.info.rebuilt(scope))))
        return tuple(found)


@dataclass(frozen=True)
class _Place:
    """Where in the nesting of arrays the walk is."""

    info: FieldInfo
    scope: Scope
    shape: tuple[int, ...] = ()
    strides: tuple[int, ...] = ()


class Scope:
    """What an expression in a struct sees of the fields before it: ``this.count``, ``this._.header.mode``."""

    def __init__(self, walk: Walk, parent: Scope | None, path: str, *, element: bool) -> None:
        self._walk, self._parent, self._path, self._element = walk, parent, path, element
        self._names: dict[str | None, Leaf | Scope | None] = {}

    def __getitem__(self, name: str) -> Any:
        if name == "_":
            return self._parent
        if name == "_root":
            return self._parent["_root"] if self._parent else self
        if name not in self._names:
            raise NotCompilable(self._path, f"an expression asks for {name!r}, which is not a field before it")
        found = self._names[name]
        if isinstance(found, Leaf):
            if self._element:
                raise NotCompilable(found.info.path, "elements of one array differ in layout")
            return found.info.seen(self._walk.value(found))
        return found

    def __getattr__(self, name: str) -> Any:
        return self[name]

    def __len__(self) -> int:
        raise NotCompilable(self._path, "an expression asks for the length of an array")


def walk(con: Construct, read: Read, limit: int) -> Walk:
    """Go through a prepared struct; `read` gives the value of each field that its layout depends on.

    Raises:
        NotCompilable: where construct alone can tell what comes next.
        TooLong: where the frame would be longer than `limit`, or without a byte.
    """
    state = Walk(read, limit).run(con)
    if not state.cursor:
        raise TooLong("")
    return state


def _visit(state: Walk, con: Construct, place: _Place) -> None:
    start = state.cursor
    inner, info = peeled(con, place.info)
    place = replace(place, info=info)
    if isinstance(inner, construct.Transformed | construct.Restreamed | BytesInteger):
        _block(state, inner, place)
    elif isinstance(inner, Checksummed):
        _visit(state, inner.subcon, place)
        _seal(state, inner, place, start)
    elif isinstance(inner, Struct):
        _struct(state, inner, place)
    elif isinstance(inner, Array):
        _array(state, inner, place)
    elif isinstance(inner, construct.IfThenElse):
        state.branches[inner] = inner.thensubcon if _value(inner.condfunc, place) else inner.elsesubcon
        _visit(state, state.branches[inner], place)
    elif isinstance(inner, construct.Switch):
        state.branches[inner] = inner.cases.get(_value(inner.keyfunc, place), inner.default)
        _visit(state, state.branches[inner], place)
    elif inner is not construct.Pass:
        _field(state, inner, place)
    if state.cursor > state.limit:
        raise TooLong(info.path)
    if info.path and not place.shape:
        state.places[info.path] = (start, state.cursor)


def _struct(state: Walk, con: Struct, place: _Place) -> None:
    scope = Scope(state, place.scope, place.info.path, element=bool(place.shape))
    place.scope._names.setdefault(place.info.name, scope)
    for child in con.subcons:
        path = "" if child.name is None else f"{place.info.path}.{child.name}" if place.info.path else child.name
        _visit(state, child, _Place(FieldInfo(path, place.info.axes), scope, place.shape, place.strides))
        scope._names.setdefault(child.name, None)


def _array(state: Walk, con: Array, place: _Place) -> None:
    count = _count(con.count, place)
    axes = (*place.info.axes, axis_path(place.info))
    state.lengths[axes[-1]] = 0 if 0 in place.shape else count
    start = state.cursor
    element = replace(place, info=replace(place.info, axes=axes), shape=(*place.shape, count), strides=(*place.strides, 0))
    if count:
        _visit(state, con.subcon, element)
    else:
        _visit_none(state, con.subcon, element)
    size = state.cursor - start
    if start + max(size, 1) * count > state.limit:
        raise TooLong(place.info.path)
    for path, leaf in state.leaves.items():
        if leaf.info.axes[: len(axes)] == axes:
            depth = len(place.strides)
            strides = (*leaf.strides[:depth], size, *leaf.strides[depth + 1 :])
            state.leaves[path] = replace(leaf, strides=strides)
    spots = {spot: what for spot, what in state.constants.items() if spot >= start}
    for spot, what in spots.items():
        del state.constants[spot]
        state.constants.update({spot + size * index: what for index in range(count)})
    state.cursor = start + size * count


def _visit_none(state: Walk, con: Construct, place: _Place) -> None:
    """Go through an element that the array has none of, for its fields alone: nothing is asked of it."""
    start, constants = state.cursor, dict(state.constants)
    try:
        _visit(state, con, place)
    except Unread:
        raise
    except Exception:
        pass  # what construct never looks at cannot fail
    state.cursor, state.constants = start, constants


def _field(state: Walk, con: Construct, place: _Place) -> None:
    info = fields_below(con, place.info)[place.info.path] if place.info.path else place.info
    shape, strides = place.shape, place.strides
    if isinstance(con, FormatField):
        size, wire = con.length, info.dtype
        if wire is not None:
            wire = wire.newbyteorder(con.fmtstr[0] if con.fmtstr[0] in "<>" else "=")
    elif isinstance(con, Bytes):
        size, wire = _count(con.length, place), np.dtype("u1")
        shape, strides = (*shape, size), (*strides, 1)
    else:
        raise NotCompilable(place.info.path, f"{type(con).__name__} has no fixed place")
    if info.path:
        _add(state, Leaf(info, state.cursor, shape, strides, size, wire), place)
    if info.const is not None:
        for index, byte in enumerate(con.build(info.const)):
            state.constants[state.cursor + index] = (0xFF, byte)
    state.cursor += size


def _block(state: Walk, con: Construct, place: _Place) -> None:
    """A bit block: the bits of each field come from probing construct itself."""
    try:
        size = int(con.sizeof())
        found = _probed(con, size)
    except (construct.ConstructError, LookupError):
        found = None
    if found is None:
        raise NotCompilable(place.info.path, "a bit block whose values are not plain bits of it")
    infos = fields_below(con, place.info)
    groups: dict[str, list[BitField]] = {}
    for bits in found:
        names = [key for key in bits.keys if isinstance(key, str)]
        groups.setdefault(".".join(part for part in (place.info.path, *names) if part), []).append(bits)
    if place.info.path not in groups:
        scope = Scope(state, place.scope, place.info.path, element=bool(place.shape))
        place.scope._names[place.info.name] = scope
        place = replace(place, scope=scope)
    for path, elements in groups.items():
        info = infos[path] if path else place.info
        inside = len(info.axes) > len(place.shape)
        if len(info.axes) > len(place.shape) + 1:
            raise NotCompilable(path, "an array of arrays of bits")
        shape = (*place.shape, len(elements)) if inside else place.shape
        if path:
            _add(state, Leaf(info, state.cursor, shape, place.strides, size, elements=tuple(elements)), place)
        if info.const is not None:
            _bit_constant(state, elements, int(info.const))
    state.cursor += size


@functools.lru_cache(maxsize=4096)
def _probed(con: Construct, size: int) -> list[BitField] | None:
    return probe(con, size)


def _bit_constant(state: Walk, elements: list[BitField], value: int) -> None:
    for element in elements:
        for part in element.segments:
            spot = state.cursor + part.byte
            mask, known = state.constants.get(spot, (0, 0))
            state.constants[spot] = (mask | part.mask, known | (value >> part.target << part.low) & part.mask)


def _add(state: Walk, leaf: Leaf, place: _Place) -> None:
    state.leaves[leaf.info.path] = leaf
    if len(leaf.shape) > len(place.shape):  # bytes, or an array within a bit block
        state.lengths[leaf.info.axes[-1]] = 0 if 0 in place.shape else leaf.shape[-1]
    if leaf.info.rebuilt is not None and not leaf.shape:
        state.rebuilt.append((leaf, place.scope))
    place.scope._names[leaf.info.name] = leaf


def _seal(state: Walk, con: Checksummed, place: _Place, start: int) -> None:
    if place.shape:
        raise NotCompilable(place.info.path, "a checksum inside an array")
    if con.algorithm is None:
        raise SpecError("a checksum without algorithm, and no lidarspec_checksum hook supplies one", path=con.fields[0])
    prefix = f"{place.info.path}." if place.info.path else ""
    leaves = [state.leaves[prefix + name] for name in con.fields]
    if con.over is not None:
        spans = [(state.places[prefix + con.over[0]][0], state.places[prefix + con.over[-1]][1])]
    else:
        held = sorted(span for leaf in leaves for span in _held(leaf))
        edges = [start, *(edge for span in held for edge in span), state.cursor]
        spans = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]
    state.seals.append(Seal(tuple(leaves), tuple(spans), con.algorithm, tuple(sorted(con.absent))))


def _held(leaf: Leaf) -> list[tuple[int, int]]:
    """The bytes that hold any bit of a field."""
    if not leaf.elements:
        return [(leaf.offset, leaf.offset + leaf.size)]
    spots = [part.byte for element in leaf.elements for part in element.segments]
    return [(leaf.offset + min(spots), leaf.offset + max(spots) + 1)]


def _unasked(leaf: Leaf) -> int:
    if isinstance(leaf.info.const, int):
        return leaf.info.const
    raise NotCompilable(leaf.info.path, "the layout does not depend on it")


def _value(expression: Any, place: _Place) -> Any:
    return expression(place.scope) if callable(expression) else expression


def _count(expression: Any, place: _Place) -> int:
    count = operator.index(_value(expression, place))
    if count < 0:
        raise TooLong(place.info.path)
    return count
