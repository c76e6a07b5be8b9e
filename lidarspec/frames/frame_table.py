"""Frames of one type as columns of raw values, in stream order.

Two kinds with one behaviour: `Rows` loads fields from bytes by their layout, `Records` collects
them from what construct parsed. Arrays of variable length are padded to the longest with zeros;
`counts` has the lengths.

Parts, which are frames within a frame, are a table of their own, without padding, with the row of
their frame for each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.frames.arrays import counted, deep, is_counted, repeated
from lidarspec.frames.layout import Bytes2D, Layout, Leaf, rows_at
from lidarspec.frames.schema import Schema, schema, without_indices
from lidarspec.spec.syntax import leaves, member

if TYPE_CHECKING:
    from lidarspec.frames.parts import Walked


class Table(Protocol):
    """The raw columns of n frames of one type."""

    schema: Schema

    def __len__(self) -> int: ...
    def raw(self, path: str) -> NDArray[Any]:
        """Return raw values, shape (n, *lengths of its axes), in native byte order.

        The value is 0 if a frame lacks the field or element.
        """

    def present(self, path: str) -> NDArray[np.bool_] | None:
        """Return which frames have the field, (n,), or which elements have it.

        Elements are given if not all elements of a frame have the field. Returns None if all have
        it.
        """

    def counts(self, axis: str) -> NDArray[np.intp]:
        """The length of an array in each frame, (n,)."""

    def length(self, axis: str) -> int:
        """The longest length of an array."""

    @property
    def sizes(self) -> NDArray[np.intp]:
        """The bytes of each frame, (n,)."""

    def frame(self, index: int) -> bytes:
        """The bytes of one frame."""

    def take(self, which: NDArray[np.intp]) -> Table:
        """A table of the frames that indices pick, in their order."""

    def parts(self, axis: str, kind: str = "") -> tuple[Table, NDArray[np.intp]]:
        """The parts of one kind, in stream order, and the frame that each is in, (k,)."""


@dataclass(frozen=True, eq=False)
class Group:
    """Frames of one layout: where they stand in the table, and their bytes, one frame a row."""

    layout: Layout
    where: NDArray[np.intp]
    rows: Bytes2D


class Rows:
    """A `Table` of frames whose layout is compiled."""

    def __init__(self, schema: Schema, groups: Sequence[Group]) -> None:
        self.schema = schema
        self.groups = [group for group in groups if len(group.where)]
        self._length = sum(len(group.where) for group in self.groups)
        self._order: NDArray[np.intp] | slice | None = None
        self._walks: dict[str, list[tuple[Group, NDArray[np.uint8], Walked]]] = {}

    def __len__(self) -> int:
        return self._length

    def raw(self, path: str) -> NDArray[Any]:
        info = self.schema.fields[path]
        assert info.dtype is not None
        if "[" in path:
            around = self.schema.fields[without_indices(path)[0]].axes
        else:
            around = info.axes
        if len(self.groups) == 1:
            only = self.groups[0].layout.leaves.get(path)
        else:
            only = None
        if (
            only is not None and 0 not in only.shape
        ):  # arrays in an empty one have no length, whatever their count says
            values = _loaded(only, around, self.groups[0].rows)
            if self._order is None:
                self._order = _order(self.groups[0].where)
            if not isinstance(self._order, slice):
                values = values[self._order]
            return values.astype(info.dtype, copy=False)
        lengths = [self.length(axis) for axis in info.axes]
        column = np.zeros((len(self), *lengths), info.dtype)
        for group in self.groups:
            leaf = group.layout.leaves.get(path)
            if leaf is not None and 0 not in leaf.shape:
                values = _loaded(leaf, around, group.rows)
                corner: Any = (group.where, *(slice(0, length) for length in values.shape[1:]))
                column[corner] = values
        return column

    def present(self, path: str) -> NDArray[np.bool_] | None:
        if not self.schema.fields[path].optional:
            return None
        there = np.zeros(len(self), np.bool_)
        for group in self.groups:
            is_empty = any(
                group.layout.lengths.get(axis) == 0 for axis in self.schema.fields[path].axes
            )
            there[group.where] = is_empty or path in group.layout.leaves
        return there

    def counts(self, axis: str) -> NDArray[np.intp]:
        found = np.zeros(len(self), np.intp)
        for group in self.groups:
            found[group.where] = group.layout.lengths.get(axis, 0)
        return found

    def length(self, axis: str) -> int:
        """The longest length of an array."""
        declared = self.schema.arrays.get(axis)
        if isinstance(declared, int):
            return declared
        return max((group.layout.lengths.get(axis, 0) for group in self.groups), default=0)

    @property
    def sizes(self) -> NDArray[np.intp]:
        if len(self.groups) == 1:
            return repeated(self.groups[0].layout.size, len(self))
        found = np.empty(len(self), np.intp)
        for group in self.groups:
            found[group.where] = group.layout.size
        return found

    def frame(self, index: int) -> bytes:
        for group in self.groups:
            spot = np.flatnonzero(group.where == index)
            if len(spot):
                return bytes(group.rows[spot[0]].tobytes())
        raise IndexError(index)

    def take(self, which: NDArray[np.intp]) -> Rows:
        if (
            len(self.groups) == 1
            and len(which)
            and which[-1] - which[0] == len(which) - 1
            and ascends(which)
        ):
            only = self.groups[0]
            if ascends(only.where):
                return Rows(
                    self.schema,
                    [Group(only.layout, counted(len(which)), only.rows[which[0] : which[-1] + 1])],
                )
        place = np.full(len(self), -1, np.intp)
        place[which] = np.arange(len(which))
        groups = []
        for group in self.groups:
            there = place[group.where]
            kept = there >= 0
            groups.append(Group(group.layout, there[kept], group.rows[kept]))
        return Rows(self.schema, groups)

    def walks(self, axis: str) -> list[tuple[Group, NDArray[np.uint8], Walked]]:
        """Return the groups that have these parts, with buffer and walked parts.

        The result is cached.
        """
        if axis not in self._walks:  # the clock, the points and each kind of parts ask for them
            regions = ((group, group.layout.regions.get(axis)) for group in self.groups)
            self._walks[axis] = [
                (group, *region.in_rows(group.rows))
                for group, region in regions
                if region is not None
            ]
        return self._walks[axis]

    def parts(self, axis: str, kind: str = "") -> tuple[Rows, NDArray[np.intp]]:
        node = self.schema.parts[axis]
        wanted = next(number for number, one in enumerate(node.kinds) if one.name == kind)
        found = list[_Piece]()
        for group, buffer, walked in self.walks(axis):
            rounds = (piece for pieces in walked.rounds for piece in pieces if piece.kind == wanted)
            found += [
                _Piece(buffer, piece.layout, piece.spots, group.where[piece.owners])
                for piece in rounds
            ]
        counts = np.zeros(len(self), np.intp)
        for piece in found:
            counts[piece.frames] += 1
        ranks = list[NDArray[np.intp]]()
        following = np.cumsum(counts) - counts
        for piece in found:  # round after round: in each a frame has one part at most
            ranks.append(following[piece.frames])
            following[piece.frames] += 1
        return Rows(schema(node.kinds[wanted].root), _by_layout(found, ranks)), np.repeat(
            np.arange(len(self)), counts
        )

    @staticmethod
    def joined(tables: Sequence[Rows]) -> Rows:
        """Several tables of one frame type, one after another."""
        alone = [table.groups[0] for table in tables if len(table.groups) == 1]
        if (
            len(alone) == len(tables)
            and len({id(group.layout) for group in alone}) == 1
            and all(ascends(group.where) for group in alone)
        ):
            rows = _stacked([group.rows for group in alone])
            return Rows(tables[0].schema, [Group(alone[0].layout, counted(len(rows)), rows)])
        found: dict[int, list[Group]] = {}
        start = 0
        for table in tables:
            for group in table.groups:
                found.setdefault(id(group.layout), []).append(
                    Group(group.layout, group.where + start, group.rows)
                )
            start += len(table)
        return Rows(tables[0].schema, [_merged(groups) for groups in found.values()])


def _loaded(leaf: Leaf, around: Sequence[str], rows: Bytes2D) -> NDArray[Any]:
    """Return raw values without the axes of which only one element is requested.

    Args:
        around: the arrays that the field is in.
    """
    values = leaf.load(rows)
    if len(around) == len(leaf.info.axes):
        return values
    return values.reshape(
        len(rows),
        *(
            length
            for axis, length in zip(around, leaf.shape, strict=False)
            if axis in leaf.info.axes
        ),
    )


@dataclass(frozen=True, eq=False)
class _Piece:
    """Parts of one layout that were found in one round.

    `spots` are their offsets in the buffer, `frames` the frames that they are in, (k,).
    """

    buffer: NDArray[np.uint8]
    layout: Layout
    spots: NDArray[np.intp]
    frames: NDArray[np.intp]


def _by_layout(pieces: Sequence[_Piece], ranks: Sequence[NDArray[np.intp]]) -> list[Group]:
    """Return parts as groups, with their rows in stream order.

    Args:
        ranks: the positions of the parts of each piece in that order.
    """
    members: dict[int, dict[int, list[tuple[_Piece, NDArray[np.intp]]]]] = {}
    for piece, own in zip(pieces, ranks, strict=True):
        members.setdefault(id(piece.layout), {}).setdefault(id(piece.buffer), []).append(
            (piece, own)
        )
    return [
        _merged([_gathered(parts) for parts in buffers.values()]) for buffers in members.values()
    ]


def _gathered(parts: Sequence[tuple[_Piece, NDArray[np.intp]]]) -> Group:
    """Parts of one layout in one buffer as a group."""
    where, spots = (
        np.concatenate(arrays)
        for arrays in zip(*((own, piece.spots) for piece, own in parts), strict=True)
    )
    order, (first, _) = np.empty(len(where), np.intp), parts[0]
    if len(where) and where.max() == len(where) - 1:  # these are all: no need to sort
        order[where] = np.arange(len(where))
    else:
        order = np.argsort(where)
    return Group(
        first.layout,
        where[order],
        rows_at(first.buffer, spots[order], first.layout.size, gathered=False),
    )


def _merged(groups: list[Group]) -> Group:
    if len(groups) == 1:
        return groups[0]
    return Group(
        groups[0].layout,
        np.concatenate([g.where for g in groups]),
        _stacked([g.rows for g in groups]),
    )


def _stacked(parts: list[Bytes2D]) -> Bytes2D:
    """Rows under one another; no copy where they stand so in memory already."""
    base = parts[0].base
    width = parts[0].shape[1]
    spots = [_address(part) for part in parts]
    follow = (
        spot + part.size == after
        for spot, part, after in zip(spots, parts, spots[1:], strict=False)
    )
    if (
        not isinstance(base, np.ndarray)
        or not base.flags.c_contiguous
        or any(part.base is not base for part in parts)
        or not all(follow)
    ):
        return np.concatenate(parts)
    count = sum(map(len, parts))
    return np.ndarray(
        (count, width),
        np.uint8,
        base.data.cast("B") if base.ndim else base,
        spots[0] - _address(base),
    )


def _address(array: NDArray[Any]) -> int:
    return int(array.__array_interface__["data"][0])


def _order(where: NDArray[np.intp]) -> NDArray[np.intp] | slice:
    """What puts the rows of the only group into stream order: nothing, where they are in it."""
    if ascends(where):
        return slice(None)
    return np.argsort(where)


def ascends(where: NDArray[np.intp]) -> bool:
    """Whether frames stand in the table in the order of their rows."""
    return is_counted(where) or bool(
        np.count_nonzero(where[1:] > where[:-1]) == max(len(where) - 1, 0)
    )


class Records:
    """A `Table` of frames that construct parsed.

    It is used for structs that do not compile, and as the second engine in tests.
    """

    def __init__(self, schema: Schema, parsed: Sequence[Any], frames: Sequence[bytes]) -> None:
        self.schema = schema
        self._parsed = list(parsed)
        self._frames = list(frames)

    def __len__(self) -> int:
        return len(self._parsed)

    def raw(self, path: str) -> NDArray[Any]:
        info, (base, indices) = self.schema.fields[path], without_indices(path)
        if indices:
            return self._element(self.raw(base), base, indices)[0]
        found = [_values(parsed, path.split("."), len(info.axes)) for parsed in self._parsed]
        lengths = [self.length(axis) for axis in info.axes]
        if info.dtype is not None:
            dtype = info.dtype
        else:
            dtype = _common_type(found, path)
        column = np.zeros((len(self), *lengths), dtype)
        try:
            for index, value in enumerate(found):
                _put(column, index, value)
        except (IndexError, TypeError, ValueError):
            raise SpecError(
                "its branches give values of different shapes, and a column has one", path=path
            ) from None
        return column

    def present(self, path: str) -> NDArray[np.bool_] | None:
        if not self.schema.fields[path].optional:
            return None
        axes, (base, indices) = self.schema.fields[path].axes, without_indices(path)
        if indices:
            known = self.present(base)
            elements, inside = self._element(
                self.raw(base) if known is None or known.ndim == 1 else known, base, indices
            )
            if known is None:
                return inside
            return inside & known if known.ndim == 1 else deep(inside, elements.ndim - 1) & elements
        there = [_there(_values(parsed, path.split("."), len(axes))) for parsed in self._parsed]
        if not any(isinstance(one, list) for one in there):
            return np.array(there, np.bool_)
        column = np.zeros((len(self), *map(self.length, axes)), np.bool_)
        for index, one in enumerate(there):
            _put(column, index, one)
        return column

    def _element(
        self, column: NDArray[Any], path: str, indices: Mapping[str, int]
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Some element of a field's arrays, and which frames have it, (n,)."""
        inside = np.ones(len(self), np.bool_)
        axes = self.schema.fields[path].axes
        for axis in sorted(indices, key=axes.index, reverse=True):
            place = 1 + axes.index(axis)
            counts = self.counts(axis)
            spots = indices[axis] + (counts if indices[axis] < 0 else 0)
            inside &= (spots >= 0) & (spots < counts)
            if not column.shape[place]:
                return (
                    np.zeros((*column.shape[:place], *column.shape[place + 1 :]), column.dtype),
                    inside,
                )
            spots = np.broadcast_to(np.clip(spots, 0, column.shape[place] - 1), len(self))
            column = np.take_along_axis(column, deep(spots, column.ndim - 1), place).squeeze(place)
        return np.where(deep(inside, column.ndim - 1), column, 0).astype(column.dtype), inside

    def counts(self, axis: str) -> NDArray[np.intp]:
        lengths = self._lengths(axis)
        if any(len(found) > 1 for found in lengths):
            raise SpecError(
                "its length differs within one frame, and a column has one for each frame",
                path=axis,
            )
        return np.array([max(found, default=0) for found in lengths], np.intp)

    def length(self, axis: str) -> int:
        """The longest length of an array."""
        declared = self.schema.arrays.get(axis)
        if isinstance(declared, int):
            return declared
        return max((max(found, default=0) for found in self._lengths(axis)), default=0)

    def _lengths(self, axis: str) -> list[set[int]]:
        brackets = axis.count("[]")
        names = axis.removesuffix("[]" * brackets).split(".")
        return [_counts(parsed, names, brackets) for parsed in self._parsed]

    @property
    def sizes(self) -> NDArray[np.intp]:
        return np.array([len(frame) for frame in self._frames], np.intp)

    def frame(self, index: int) -> bytes:
        return self._frames[index]

    def take(self, which: NDArray[np.intp]) -> Records:
        return Records(
            self.schema, [self._parsed[i] for i in which], [self._frames[i] for i in which]
        )

    def parts(self, axis: str, kind: str = "") -> tuple[Records, NDArray[np.intp]]:
        node = self.schema.parts[axis]
        found = list[tuple[int, Any, bytes]]()
        for index, (parsed, frame) in enumerate(zip(self._parsed, self._frames, strict=True)):
            pieces = member(parsed, axis, None)
            if pieces is not None:
                spans = zip(pieces, pieces.spans, strict=True)
                found += [
                    (index, part, frame[start:end])
                    for part, (name, start, end) in spans
                    if name == kind
                ]
        own = next(one for one in node.kinds if one.name == kind)
        frames = np.array([index for index, _, _ in found], np.intp)
        return (
            Records(
                schema(own.root), [part for _, part, _ in found], [data for _, _, data in found]
            ),
            frames,
        )

    @staticmethod
    def joined(tables: Sequence[Records]) -> Records:
        """Several tables of one frame type, one after another."""
        parsed = [item for table in tables for item in table._parsed]
        return Records(
            tables[0].schema, parsed, [frame for table in tables for frame in table._frames]
        )


def _values(parsed: Any, names: list[str], axes: int) -> Any:
    """The value, or nested lists of values, under a path; None where a branch leaves it out."""
    if isinstance(parsed, list):
        return _elements(parsed, names, axes)
    for index, name in enumerate(names):
        if not isinstance(parsed, dict) or name not in parsed or parsed[name] is None:
            return None
        parsed = parsed[name]
        if isinstance(parsed, list):
            return _elements(parsed, names[index + 1 :], axes)
    if isinstance(parsed, bytes):
        return list(parsed)
    if not isinstance(parsed, dict):
        return next(iter(leaves(parsed)))[1]
    return None


def _elements(parsed: list[Any], names: list[str], axes: int) -> list[Any] | None:
    found = [_values(element, names, axes) for element in parsed]
    if found and all(part is None for part in found):
        return None
    return found


def _there(value: Any) -> Any:
    """Whether there is a value; lists of that where some elements have one and others not."""
    if not isinstance(value, list):
        return value is not None
    found = [_there(part) for part in value]
    if all(part is True for part in found):
        return True
    return found


def _put(column: NDArray[Any], index: int, value: Any) -> None:
    """Copy a value or nested lists to an index of a padded array.

    Lists may differ in length.
    """
    if isinstance(value, list) and column.ndim > 2:
        for place, part in enumerate(value):
            _put(column[index], place, part)
    elif isinstance(value, list):
        column[index, : len(value)] = [0 if part is None else part for part in value]
    elif column.ndim == 1 or isinstance(value, bool):
        column[index] = 0 if value is None else value
    elif value is not None:
        raise ValueError("a value where another frame has an array")


def _counts(value: Any, names: list[str], brackets: int) -> set[int]:
    """Return the lengths of an array under a path in one parsed frame.

    If the array is in another array, the lengths of all its instances are returned.
    """
    if isinstance(value, list) and (names or brackets):
        below = brackets if names else brackets - 1
        return {length for part in value for length in _counts(part, names, below)}
    if names:
        if isinstance(value, dict):
            found = value.get(names[0])
        else:
            found = None
        if found is None:
            return set()
        return _counts(found, names[1:], brackets)
    if isinstance(value, list | bytes):
        return {len(value)}
    return set()


def _numbers(value: Any) -> Iterator[Any]:
    """The values in lists of them."""
    if isinstance(value, list):
        for part in value:
            yield from _numbers(part)
    elif value is not None:
        yield value


def _common_type(found: list[Any], path: str) -> np.dtype[Any]:
    """The type of a column of which the spec does not say one."""
    values = list(_numbers(found))
    if not all(isinstance(value, int | float) for value in values):
        raise SpecError(
            "its values are no numbers, and a column holds numbers: declare a text as bytes",
            path=path,
        )
    if any(isinstance(value, float) for value in values):
        return np.dtype(np.float64)
    for kind in (np.int64, np.uint64):
        if (
            np.iinfo(kind).min <= min(values, default=0)
            and max(values, default=0) <= np.iinfo(kind).max
        ):
            return np.dtype(kind)
    raise SpecError("its numbers are wider than the 64 bits that a column holds", path=path)
