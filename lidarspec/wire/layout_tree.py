"""From a construct tree to a `Layout`: one walk with a cursor.

Where a count, an If or a Switch asks for the value of a header field, a `read` function supplies it: from the bytes
at hand, or chosen at will to make an example. So one walk gives the layout of one kind of header, and
`lidarspec.wire.layout_tree` keeps one per distinct header. What has no place that can be computed this way is refused with a
path and a reason (`NotCompilable`), and is then interpreted by construct.

Headers that nobody sent: drawn by chance for examples, and tried out before any frame arrives.

One layout per distinct header, found for a whole batch of candidates at once.

Counts, If and Switch make a frame's layout depend on some of its own header fields. The tree here asks for those
fields in the order in which the walk of the struct did: each node is one field, each branch one of its values, each
end a `Layout`, or the reason why there is none. Candidates are sorted through it in bulk, by value.
"""

from __future__ import annotations

import contextlib
import functools
import operator
import random
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import construct
import numpy as np
from construct import Array, Bytes, BytesInteger, Construct, FormatField, Struct
from construct.expr import BinExpr, UniExpr
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.spec.bits import BitField, probe
from lidarspec.spec.fields import Checksummed
from lidarspec.spec.rules import children
from lidarspec.wire.layout import Layout, Leaf, Seal
from lidarspec.wire.schema import FieldInfo, axis_path, fields_below, peeled


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


#: headers tried before any arrives.
TRIED = 64

Draw = Callable[[random.Random], int]


def choose(con: Construct, limit: int, source: random.Random, drawn: Mapping[str, Draw]) -> tuple[Layout, dict[str, int]]:
    """A layout of a header chosen at random, with the values of the fields it depends on, by path.

    Args:
        limit: the longest frame, in bytes.
        drawn: field path -> what draws its value in place of chance.

    Raises:
        SpecError: where hundreds of headers give no frame.
    """
    keys = sorted(_switch_keys(con))
    for _ in range(400):
        chosen: dict[str, int] = {}

        def read(leaf: Leaf, chosen: dict[str, int] = chosen) -> int:
            if leaf.info.path not in chosen:
                own = drawn.get(leaf.info.path)
                chosen[leaf.info.path] = own(source) if own else _some_value(source, leaf, keys)
            return chosen[leaf.info.path]

        try:
            return walk(con, read, limit).layout(), chosen
        except (TooLong, ArithmeticError, LookupError, TypeError, ValueError):
            continue
    raise SpecError("no header was found that gives a frame within its longest length")


def try_headers(con: Construct, limit: int) -> None:
    """Walk the struct for values at which its expressions may decide otherwise, so that what does not compile is known by now."""
    keys = sorted({*_switch_keys(con), *_compared(con)})
    pending: list[dict[str, int]] = [{}]
    for given in pending:
        asked: dict[str, list[int]] = {}

        def read(leaf: Leaf, given: dict[str, int] = given, asked: dict[str, list[int]] = asked) -> int:
            check_control(leaf)
            values = asked[leaf.info.path] = _edges(leaf, keys)
            return given.get(leaf.info.path, values[0])

        try:
            walk(con, read, limit)
        except (NotCompilable, SpecError):
            raise
        except Exception:
            pass  # a header that leads to no frame; the next one may
        for path, values in asked.items():
            if path not in given:
                further = [{**given, path: value} for value in values[1:]]
                pending += [one for one in further if one not in pending][: max(TRIED - len(pending), 0)]


def check_control(leaf: Leaf) -> None:
    """Raise `NotCompilable` if a layout cannot be made to depend on a field."""
    if leaf.shape or leaf.info.kind != "int":
        raise NotCompilable(leaf.info.path, "the layout depends on a field that is not one integer")


def _some_value(source: random.Random, leaf: Leaf, keys: list[int]) -> int:
    if leaf.info.const is not None:
        return int(leaf.info.const)
    top = (1 << leaf.info.bits) - 1
    kinds = [source.randint(0, top), source.randint(0, min(top, 8)), source.randint(0, min(top, 40))]
    named = [key for key in (*leaf.info.labels, *keys) if key <= top]
    value = source.choice(kinds + named[:16] * (1 if source.random() < 0.7 else 0))
    is_negative = leaf.info.dtype is not None and leaf.info.dtype.kind == "i" and value >> (leaf.info.bits - 1)
    return value - (1 << leaf.info.bits) if is_negative else value


def _switch_keys(con: Construct) -> Iterator[int]:
    if isinstance(con, construct.Switch):
        yield from (key for key in con.cases if isinstance(key, int))
    for child in children(con):
        yield from _switch_keys(child)


def _edges(leaf: Leaf, keys: list[int]) -> list[int]:
    """Values of a field at which a layout may change: a usual one first."""
    if leaf.info.const is not None:
        return [int(leaf.info.const)]
    low, high = leaf.info.limits
    return [value for value in dict.fromkeys((1, 0, *leaf.info.labels, *keys, 2, high, low)) if low <= value <= high]


def _compared(con: Construct) -> Iterator[int]:
    """The numbers in the expressions of a tree, and those beside them."""
    pending = [vars(con).get(name) for name in ("count", "length", "condfunc", "keyfunc")]
    while pending:
        part = pending.pop()
        if isinstance(part, BinExpr):
            pending += [part.lhs, part.rhs]
        elif isinstance(part, UniExpr):
            pending.append(part.operand)
        elif isinstance(part, int):
            yield from (part - 1, part, part + 1)
    for child in children(con):
        yield from _compared(child)


#: distinct headers remembered; garbage must not fill the memory with their layouts.
REMEMBERED = 4096

#: different values of a header field that are looked for one by one.
FEW = 4


@dataclass(frozen=True, eq=False)
class Refused:
    """A header that leads to no frame: too long, or an expression of the plugin failed (`error`: its traceback)."""

    error: str = ""


@dataclass(eq=False)
class _Node:
    leaf: Leaf | None = None
    children: dict[int, _Node] = field(default_factory=dict)
    result: Layout | Refused | None = None


class _Short(Unread):
    """The sample ends before a field that the layout depends on."""

    def __init__(self, leaf: Leaf) -> None:
        self.leaf = leaf


_NONE = np.empty(0, np.intp)
Group = tuple[Layout | Refused, NDArray[np.intp]]


def rows_at(buffer: NDArray[np.uint8], offsets: NDArray[np.intp], size: int, *, gathered: bool = True) -> NDArray[np.uint8]:
    """As many bytes from each of these offsets, one a row; no copy where they stand back to back.

    Args:
        gathered: C-contiguous; else no copy either where they stand at one distance, and each row is contiguous by itself.
    """
    count = len(offsets)
    if not count or not size:
        return np.zeros((count, size), np.uint8)
    if size == 1:
        return buffer.take(offsets).reshape(count, 1)
    first, step = offsets.item(0), offsets.item(1) - offsets.item(0) if count > 1 else size
    even = offsets.item(-1) - first == (count - 1) * step
    if even and count > 2:
        even = np.count_nonzero(offsets[1:] - offsets[:-1] == step) == count - 1
    if even and step == size:
        return buffer[first : first + count * size].reshape(count, size)
    if even and step > size and not gathered:
        return np.ndarray((count, size), np.uint8, buffer.data, first, (step, 1))
    windows: NDArray[Any] = np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer.data, 0, (1,))
    return windows[offsets].view(np.uint8).reshape(count, size)


class HeaderTree:
    """All layouts of one frame type.

    Raises:
        NotCompilable: where some part of the struct has no computable place, whatever the header.
    """

    def __init__(self, con: Construct, limit: int) -> None:
        self._con, self._limit = con, limit
        self._root, self._size = _Node(), 0
        self.prefix = self._prefix()
        try_headers(con, limit)

    def classify(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp]) -> tuple[list[Group], NDArray[np.intp]]:
        """The candidates at `offsets`, sorted by layout.

        Returns:
            (layout or refusal, indices into `offsets`) for each kind; and the indices of those whose header is not
            all there.
        """
        if self._size > REMEMBERED:
            self._root, self._size = _Node(), 0
        if isinstance(self._root.result, Layout) and len(offsets):
            return [(self._root.result, np.arange(len(offsets)))], _NONE
        groups: list[Group] = []
        short: list[NDArray[np.intp]] = []
        stack = [(self._root, np.arange(len(offsets)))] if len(offsets) else []
        while stack:
            node, which = stack.pop()
            if node.result is None and node.leaf is None:
                self._explore(buffer[offsets[which[0]] : offsets[which[0]] + self._limit])
            if node.result is not None:
                groups.append((node.result, which))
            elif node.leaf is not None:
                self._branch(node, node.leaf, buffer, offsets, which, stack, short)
        return groups, np.concatenate(short) if short else _NONE

    def common(self, rows: NDArray[np.uint8]) -> Layout | None:
        """The layout of candidates, one a row, if they have one and the fields that decide it are the same in all; else None."""
        first = rows[0].tobytes()
        layout = self.layout(first)
        if not isinstance(layout, Layout):
            return None
        same = (np.count_nonzero(leaf.load(rows) == leaf.scalar(first)) == len(rows) for leaf in self.asked(first))
        return layout if all(same) else None

    def layout(self, frame: bytes) -> Layout | Refused | None:
        """The layout of one frame, or None where its header is not all there."""
        node: _Node | None = self._root
        while node is not None and node.leaf is not None and node.leaf.offset + node.leaf.size <= len(frame):
            node = node.children.get(node.leaf.scalar(frame))
        if node is not None and node.result is not None:
            return node.result
        groups, _ = self.classify(np.frombuffer(frame, np.uint8), np.zeros(1, np.intp))
        return groups[0][0] if groups else None

    def asked(self, frame: bytes) -> list[Leaf]:
        """The fields that decided the layout of this frame, in the order in which they were asked for."""
        found, node = [], self._root
        while node.leaf is not None:
            found.append(node.leaf)
            node = node.children[node.leaf.scalar(frame)]
        return found

    def choose(
        self, source: random.Random, drawn: Mapping[str, Callable[[random.Random], int]] | None = None
    ) -> tuple[Layout, dict[str, int]]:
        """A layout of a header chosen at random, with the values of the fields it depends on, by path; see `choose`."""
        return choose(self._con, self._limit, source, drawn or {})

    def _branch(
        self,
        node: _Node,
        leaf: Leaf,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        which: NDArray[np.intp],
        stack: list[tuple[_Node, NDArray[np.intp]]],
        short: list[NDArray[np.intp]],
    ) -> None:
        there = offsets[which] + leaf.offset + leaf.size <= len(buffer)
        if not there.all():
            short.append(which[~there])
            which = which[there]
        if not len(which):
            return
        values = leaf.at(leaf.offset).load(rows_at(buffer, offsets[which] + leaf.offset, leaf.size))
        if np.count_nonzero(values == values[0]) == len(values):
            stack.append((node.children.setdefault(values.item(0), _Node()), which))
            return
        few = _few(values)
        if few is not None:
            stack.extend((node.children.setdefault(value, _Node()), which[values == value]) for value in few)
            return
        order = np.argsort(values, kind="stable")
        values = values[order]
        edges = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
        which = which[order]
        for start, stop in pairwise(edges):
            stack.append((node.children.setdefault(int(values[start]), _Node()), which[start:stop]))

    def _explore(self, sample: NDArray[np.uint8]) -> None:
        """Walk the struct along one sample, and add what the walk asked for and found to the tree."""
        trail: list[tuple[Leaf, int]] = []

        def read(leaf: Leaf) -> int:
            check_control(leaf)
            if leaf.offset + leaf.size > len(sample):
                raise _Short(leaf)
            value = int(leaf.at(leaf.offset).load(sample[None, leaf.offset : leaf.offset + leaf.size].copy())[0])
            trail.append((leaf, value))
            return value

        result: Layout | Refused | None = None
        missing: Leaf | None = None
        try:
            result = walk(self._con, read, self._limit).layout()
        except _Short as short:
            missing = short.leaf
        except TooLong:
            result = Refused()
        except SpecError:
            raise
        except Exception:
            result = Refused(traceback.format_exc())
        node = self._root
        for leaf, value in trail:
            node.leaf = leaf
            node = node.children.setdefault(value, _Node())
        node.leaf, node.result = missing, result
        self._size += 1

    def _prefix(self) -> dict[int, tuple[int, int]]:
        """The constants whose place depends on no header field."""
        state = Walk(_stop, self._limit)
        try:
            state.run(self._con)
        except (NotCompilable, SpecError):
            raise
        except Exception:
            pass  # a field of the header was asked for, or it leads to no frame, which `classify` says
        return dict(state.constants)


def _few(values: NDArray[Any]) -> list[int] | None:
    """The values in ascending order, if they are few different ones, which are found one by one sooner than sorted."""
    found, left = list[int](), values
    while len(left) and len(found) < FEW:
        found.append(left.item(0))
        left = left[left != left[0]]
    return None if len(left) else sorted(found)


class _Stop(Unread):
    """A field of the header was asked for."""


def _stop(leaf: Leaf) -> int:
    check_control(leaf)
    raise _Stop


def check_compilable(con: Construct) -> None:
    """Raise `NotCompilable` if any branch of a tree holds a construct without a computable place."""
    _check(con, "")


_PLAIN: tuple[Any, ...] = (
    construct.FormatField,
    construct.Bytes,
    construct.BytesInteger,
    construct.Transformed,
    construct.Struct,
    construct.Array,
    construct.Const,
    construct.Renamed,
    construct.Enum,
    construct.Default,
    construct.Rebuild,
    construct.IfThenElse,
    construct.Switch,
    type(construct.Pass),
)


def _check(con: Construct, path: str) -> None:
    if isinstance(con, construct.Renamed):
        path = f"{path}.{con.name}" if path else str(con.name)
    if not isinstance(con, _PLAIN) and type(con).__module__ != "lidarspec.spec.fields":
        raise NotCompilable(path, f"{type(con).__name__} has no fixed place")
    if not isinstance(con, construct.Transformed):
        for child in children(con):
            _check(child, path)
