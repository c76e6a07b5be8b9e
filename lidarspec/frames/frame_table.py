"""Tables: frames of one type as columns of raw values, in stream order.

`CompiledTable` loads fields from the bytes of frames. `ParsedTable` collects fields that construct
has parsed. Arrays of variable length are padded with zeros; `counts` returns their lengths. Each
kind of parts (frames within a frame) has a table of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.frames.arrays import add_axes, count_up, is_count_up, repeat
from lidarspec.frames.layout import Bytes2D, Derivation, Layout, Leaf, gather_rows
from lidarspec.frames.schema import Schema, make_schema, without_indices
from lidarspec.spec.syntax import get_member, iter_leaves

if TYPE_CHECKING:
    from lidarspec.frames.parts import FoundParts


#: The reason why an array inside the elements of an array has no single length per frame.
VARYING_LENGTH = "the inner arrays of one frame have different lengths, so they cannot be a column"


class Table(Protocol):
    """The raw columns of n frames of one type.

    The argument `path` is the path of a field, and `axis` is the path of an array.
    """

    schema: Schema

    def __len__(self) -> int: ...
    def raw(self, path: str) -> NDArray[Any]:
        """Return the raw values of a field in native byte order.

        The shape is (n, *lengths of the arrays). The value of a missing field or element is 0.
        """

    def present(self, path: str) -> NDArray[np.bool_] | None:
        """Return whether each frame has the field, (n,); None if all frames have it.

        If only some elements of a frame have the field, the result has one value for each element.
        """

    def counts(self, axis: str) -> NDArray[np.intp]:
        """Return the length of an array in each frame, (n,)."""

    def length(self, axis: str) -> int:
        """Return the maximum length of an array in the frames."""

    @property
    def sizes(self) -> NDArray[np.intp]:
        """The size of each frame in bytes, (n,)."""

    def frame(self, index: int) -> bytes:
        """Return the bytes of one frame."""

    def take(self, which: NDArray[np.intp]) -> Table:
        """Return a table of the frames at these indices, in this order."""

    def parts(self, axis: str, kind: str = "") -> tuple[Table, NDArray[np.intp]]:
        """Return the parts of one kind in stream order, and the row of each part's frame.

        Args:
            axis: the path of the sequence of parts.
        """


@dataclass(frozen=True, eq=False)
class LayoutRows:
    """Frames of one layout.

    Attributes:
        where: the indices of the frames in the table that contains them, (k,).
        rows: the bytes of the frames, one frame per row, (k, layout.size).
    """

    layout: Layout
    where: NDArray[np.intp]
    rows: Bytes2D

    @cached_property
    def is_in_order(self) -> bool:
        """Whether the frames are in stream order."""
        return is_ascending(self.where)

    @cached_property
    def stream_order(self) -> NDArray[np.intp] | slice:
        """The indices that sort the frames into stream order."""
        if self.is_in_order:
            return slice(None)
        return np.argsort(self.where)


class CompiledTable:
    """A `Table` of frames with layouts."""

    def __init__(self, schema: Schema, groups: Sequence[LayoutRows]) -> None:
        self.schema = schema
        self.groups = [group for group in groups if len(group.where)]
        self._length = sum(len(group.where) for group in self.groups)
        self._walks: dict[str, list[tuple[LayoutRows, NDArray[np.uint8], FoundParts]]] = {}
        self._arrays: dict[str, _Elements] = {}

    def __len__(self) -> int:
        return self._length

    def raw(self, path: str) -> NDArray[Any]:
        info = self.schema.columns[path]
        sequence = self.schema.find_sequence(path)
        if sequence is not None:
            return self._load_elements(sequence, path)
        dtype = info.dtype or np.dtype(object)  # a computed constant may be any object
        if len(self.groups) == 1:
            group = self.groups[0]
            leaf = group.layout.column(path)
            # The general path handles empty arrays: an array in an empty one has length 0,
            # whatever its declared length.
            if leaf is not None and 0 not in _find_outer_shape(leaf):
                values = self._load(leaf, path, group)[group.stream_order]
                return values.astype(dtype, copy=False)
        lengths = [self.length(axis) for axis in info.axes]
        column = np.full((len(self), *lengths), None if dtype.hasobject else 0, dtype)
        for group in self.groups:
            leaf = group.layout.column(path)
            if leaf is not None and 0 not in _find_outer_shape(leaf):
                values = self._load(leaf, path, group)
                corner: Any = (group.where, *(slice(0, length) for length in values.shape[1:]))
                column[corner] = values
        return column

    def _load(self, leaf: Leaf | Derivation, path: str, group: LayoutRows) -> NDArray[Any]:
        """Return the values of a field in the frames of a group."""
        values = group.layout.load(path, group.rows)
        if "[" in path:
            axes = self.schema.columns[without_indices(path)[0]].axes
            lengths = zip(axes, leaf.shape, strict=False)
            kept = [length for axis, length in lengths if axis in leaf.info.axes]
            values = values.reshape(len(values), *kept)
        adapter = leaf.info.adapter
        if adapter is not None and adapter.has_columns:
            return adapter.decode_column(values, is_bytes=leaf.info.kind == "bytes")
        return values

    def present(self, path: str) -> NDArray[np.bool_] | None:
        if not self.schema.columns[path].optional:
            return None
        sequence = self.schema.find_sequence(path)
        if sequence is not None:
            return self._find_present_elements(sequence, path)
        there = np.zeros(len(self), np.bool_)
        for group in self.groups:
            is_empty = any(
                group.layout.lengths.get(axis) == 0 for axis in self.schema.columns[path].axes
            )
            there[group.where] = is_empty or group.layout.column(path) is not None
        return there

    def counts(self, axis: str) -> NDArray[np.intp]:
        sequence = self.schema.find_sequence(axis)
        if sequence is not None:
            return self._count_elements(sequence, axis)
        counts = np.zeros(len(self), np.intp)
        for group in self.groups:
            counts[group.where] = group.layout.lengths.get(axis, 0)
        return counts

    def length(self, axis: str) -> int:
        """Return the maximum length of an array in the frames."""
        declared = self.schema.arrays.get(axis)
        if isinstance(declared, int):
            return declared
        sequence = self.schema.find_sequence(axis)
        if axis == sequence:
            return int(self.counts(axis).max(initial=0))
        if sequence is not None:
            return self._get_elements(sequence).table.length(axis[len(sequence) + 1 :])
        return max((group.layout.lengths.get(axis, 0) for group in self.groups), default=0)

    def _get_elements(self, axis: str) -> _Elements:
        """Return the elements of an array as `_Elements`."""
        if axis not in self._arrays:
            table, owners = self.parts(axis)
            counts = np.bincount(owners, minlength=len(self)).astype(np.intp)
            starts = np.cumsum(counts) - counts
            ranks = np.arange(len(owners)) - starts[owners]
            self._arrays[axis] = _Elements(table, owners, ranks, counts)
        return self._arrays[axis]

    def _load_elements(self, axis: str, path: str) -> NDArray[Any]:
        """Return the raw values of a field in an array with elements of different sizes."""
        base, indices = without_indices(path)
        if indices:
            return _take_element(self, self.raw(base), base, indices)[0]
        info = self.schema.columns[path]
        elements = self._get_elements(axis)
        dtype = info.dtype or np.dtype(object)
        lengths = [self.length(each) for each in info.axes]
        column = np.full((len(self), *lengths), None if dtype.hasobject else 0, dtype)
        elements.store(column, elements.table.raw(path[len(axis) + 1 :]))
        return column

    def _find_present_elements(self, axis: str, path: str) -> NDArray[np.bool_]:
        """Return whether frames or array elements have a field, (n,) or (n, *lengths)."""
        base, indices = without_indices(path)
        if indices:
            return _has_element(self, base, indices)
        elements = self._get_elements(axis)
        there = elements.table.present(path[len(axis) + 1 :])
        if there is None:
            there = np.ones(len(elements.table), np.bool_)
        has_array = np.zeros(len(self), np.bool_)
        for group in self.groups:
            has_array[group.where] = axis in group.layout.regions
        inner = tuple(range(1, there.ndim))
        is_whole = there.all(inner)
        is_lacking = ~there.any(inner)
        numbers = elements.counts
        whole: NDArray[np.bool_] = (
            np.bincount(elements.owners[is_whole], minlength=len(self)) == numbers
        )
        lacking = np.bincount(elements.owners[is_lacking], minlength=len(self)) == numbers
        whole &= has_array
        if np.all(whole | lacking):
            return whole
        axes = self.schema.columns[path].axes[: there.ndim]
        column = np.zeros((len(self), *map(self.length, axes)), np.bool_)
        elements.store(column, there)
        column[whole] = True
        return column

    def _count_elements(self, axis: str, path: str) -> NDArray[np.intp]:
        """Return the length of the array at `path` in each frame, (n,)."""
        elements = self._get_elements(axis)
        if path == axis:
            return elements.counts
        lengths = elements.table.counts(path[len(axis) + 1 :])
        counts = np.zeros(len(self), np.intp)
        counts[elements.owners] = lengths
        if np.any(counts[elements.owners] != lengths):
            raise SpecError(VARYING_LENGTH, path=path)
        return counts

    @property
    def sizes(self) -> NDArray[np.intp]:
        if len(self.groups) == 1:
            return repeat(self.groups[0].layout.size, len(self))
        sizes = np.empty(len(self), np.intp)
        for group in self.groups:
            sizes[group.where] = group.layout.size
        return sizes

    def frame(self, index: int) -> bytes:
        for group in self.groups:
            row = np.flatnonzero(group.where == index)
            if len(row):
                return bytes(group.rows[row[0]].tobytes())
        raise IndexError(index)

    def take(self, which: NDArray[np.intp]) -> CompiledTable:
        if (
            len(self.groups) == 1
            and len(which)
            and which[-1] - which[0] == len(which) - 1
            and is_ascending(which)
        ):
            only = self.groups[0]
            if only.is_in_order:
                return CompiledTable(
                    self.schema,
                    [
                        LayoutRows(
                            only.layout, count_up(len(which)), only.rows[which[0] : which[-1] + 1]
                        )
                    ],
                )
        new_index = np.full(len(self), -1, np.intp)
        new_index[which] = np.arange(len(which))
        groups = []
        for group in self.groups:
            indices = new_index[group.where]
            is_kept = indices >= 0
            groups.append(LayoutRows(group.layout, indices[is_kept], group.rows[is_kept]))
        return CompiledTable(self.schema, groups)

    def find_parts(self, axis: str) -> list[tuple[LayoutRows, NDArray[np.uint8], FoundParts]]:
        """Find the parts at a path in all frames.

        Returns:
            A tuple for each group of frames that has parts: the group, the buffer that contains
            these frames, and the parts.
        """
        if axis not in self._walks:
            regions = ((group, group.layout.regions.get(axis)) for group in self.groups)
            self._walks[axis] = [
                (group, *region.find_parts(group.rows))
                for group, region in regions
                if region is not None
            ]
        return self._walks[axis]

    def parts(self, axis: str, kind: str = "") -> tuple[CompiledTable, NDArray[np.intp]]:
        node = self.schema.parts[axis]
        wanted = next(number for number, one in enumerate(node.kinds) if one.name == kind)
        part_rows = list[_PartRows]()
        for group, buffer, walked in self.find_parts(axis):
            rounds = (piece for pieces in walked.rounds for piece in pieces if piece.kind == wanted)
            part_rows += [
                _PartRows(buffer, piece.layout, piece.offsets, group.where[piece.owners])
                for piece in rounds
            ]
        counts = np.zeros(len(self), np.intp)
        for piece in part_rows:
            counts[piece.frames] += 1
        ranks = list[NDArray[np.intp]]()
        following = np.cumsum(counts) - counts
        # The pieces are in the order of the rounds, and a frame has at most one part in each round.
        for piece in part_rows:
            ranks.append(following[piece.frames])
            following[piece.frames] += 1
        return CompiledTable(
            make_schema(node.kinds[wanted].root), _group_by_layout(part_rows, ranks)
        ), np.repeat(np.arange(len(self)), counts)

    @staticmethod
    def join(tables: Sequence[CompiledTable]) -> CompiledTable:
        """Return several tables of one frame type as one table, in this order."""
        alone = [table.groups[0] for table in tables if len(table.groups) == 1]
        if (
            len(alone) == len(tables)
            and len({id(group.layout) for group in alone}) == 1
            and all(group.is_in_order for group in alone)
        ):
            rows = _stack_rows([group.rows for group in alone])
            return CompiledTable(
                tables[0].schema, [LayoutRows(alone[0].layout, count_up(len(rows)), rows)]
            )
        groups_by_layout: dict[int, list[LayoutRows]] = {}
        start = 0
        for table in tables:
            for group in table.groups:
                groups_by_layout.setdefault(id(group.layout), []).append(
                    LayoutRows(group.layout, group.where + start, group.rows)
                )
            start += len(table)
        return CompiledTable(
            tables[0].schema, [_merge_groups(groups) for groups in groups_by_layout.values()]
        )


@dataclass(frozen=True, eq=False)
class _Elements:
    """The elements of an array, which may differ in size, as a table of parts.

    Attributes:
        table: the elements of all frames, in stream order.
        owners: the index of the frame that contains each element, (k,).
        ranks: the index of each element in its frame, (k,).
        counts: the number of elements in each frame, (n,).
    """

    table: CompiledTable
    owners: NDArray[np.intp]
    ranks: NDArray[np.intp]
    counts: NDArray[np.intp]

    def store(self, column: NDArray[Any], values: NDArray[Any]) -> None:
        """Store the values of the elements in a padded column."""
        inner = (slice(0, length) for length in values.shape[1:])
        corner: Any = (self.owners, self.ranks, *inner)
        column[corner] = values


@dataclass(frozen=True, eq=False)
class _PartRows:
    """Parts of one layout, in any frames.

    Attributes:
        buffer: the bytes that contain the parts.
        offsets: the offsets of the parts in the buffer, (k,).
        frames: the indices of the frames that contain the parts, (k,).
    """

    buffer: NDArray[np.uint8]
    layout: Layout
    offsets: NDArray[np.intp]
    frames: NDArray[np.intp]


def _group_by_layout(
    pieces: Sequence[_PartRows], ranks: Sequence[NDArray[np.intp]]
) -> list[LayoutRows]:
    """Group parts by layout, given the index of each part in the table of all parts."""
    members: dict[int, dict[int, list[tuple[_PartRows, NDArray[np.intp]]]]] = {}
    for piece, own in zip(pieces, ranks, strict=True):
        members.setdefault(id(piece.layout), {}).setdefault(id(piece.buffer), []).append(
            (piece, own)
        )
    return [
        _merge_groups([_gather_parts(parts) for parts in buffers.values()])
        for buffers in members.values()
    ]


def _gather_parts(parts: Sequence[tuple[_PartRows, NDArray[np.intp]]]) -> LayoutRows:
    """Return parts in stream order as `LayoutRows`."""
    where = np.concatenate([own for _, own in parts])
    offsets = np.concatenate([piece.offsets for piece, _ in parts])
    first, _ = parts[0]
    if len(where) and where.max() == len(where) - 1:
        # The group has all parts of the table, so `where` is a permutation and needs no sorting.
        order = np.empty(len(where), np.intp)
        order[where] = np.arange(len(where))
    else:
        order = np.argsort(where)
    return LayoutRows(
        first.layout,
        where[order],
        gather_rows(first.buffer, offsets[order], first.layout.size, gathered=False),
    )


def _merge_groups(groups: list[LayoutRows]) -> LayoutRows:
    """Return groups of one layout as one group."""
    if len(groups) == 1:
        return groups[0]
    return LayoutRows(
        groups[0].layout,
        np.concatenate([g.where for g in groups]),
        _stack_rows([g.rows for g in groups]),
    )


def _stack_rows(parts: list[Bytes2D]) -> Bytes2D:
    """Stack arrays of rows; nothing is copied if they follow one another in memory."""
    base = parts[0].base
    width = parts[0].shape[1]
    addresses = [_get_address(part) for part in parts]
    follow = (
        address + part.size == after
        for address, part, after in zip(addresses, parts, addresses[1:], strict=False)
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
        addresses[0] - _get_address(base),
    )


def _get_address(array: NDArray[Any]) -> int:
    return int(array.__array_interface__["data"][0])


def is_ascending(where: NDArray[np.intp]) -> bool:
    """Return whether indices ascend strictly."""
    return is_count_up(where) or bool(
        np.count_nonzero(where[1:] > where[:-1]) == max(len(where) - 1, 0)
    )


class ParsedTable:
    """A `Table` of frames that construct has parsed."""

    def __init__(self, schema: Schema, parsed: Sequence[Any], frames: Sequence[bytes]) -> None:
        self.schema = schema
        self._parsed = list(parsed)
        self._frames = list(frames)

    def __len__(self) -> int:
        return len(self._parsed)

    def raw(self, path: str) -> NDArray[Any]:
        info, (base, indices) = self.schema.columns[path], without_indices(path)
        if indices:
            return _take_element(self, self.raw(base), base, indices)[0]
        values = [
            _collect_values(parsed, path.split("."), len(info.axes)) for parsed in self._parsed
        ]
        if info.dtype is None and not _are_numbers(values):
            return _make_object_column(values)
        lengths = [self.length(axis) for axis in info.axes]
        if info.dtype is not None:
            dtype = info.dtype
        else:
            dtype = _find_common_dtype(values)
        column = np.zeros((len(self), *lengths), dtype)
        try:
            for index, value in enumerate(values):
                _copy_value(column, index, value)
        except (IndexError, OverflowError, TypeError, ValueError):
            if info.dtype is None:
                return _make_object_column(values)
            raise SpecError(
                "the shape of the values differs between the cases of an If or Switch, so the field"
                " cannot be a column",
                path=path,
            ) from None
        return column

    def present(self, path: str) -> NDArray[np.bool_] | None:
        if not self.schema.columns[path].optional:
            return None
        axes, (base, indices) = self.schema.columns[path].axes, without_indices(path)
        if indices:
            return _has_element(self, base, indices)
        there = [
            _find_present(_collect_values(parsed, path.split("."), len(axes)))
            for parsed in self._parsed
        ]
        if not any(isinstance(one, list) for one in there):
            return np.array(there, np.bool_)
        column = np.zeros((len(self), *map(self.length, axes)), np.bool_)
        for index, one in enumerate(there):
            _copy_value(column, index, one)
        return column

    def counts(self, axis: str) -> NDArray[np.intp]:
        lengths = self._find_lengths(axis)
        if any(len(frame_lengths) > 1 for frame_lengths in lengths):
            raise SpecError(VARYING_LENGTH, path=axis)
        return np.array([max(frame_lengths, default=0) for frame_lengths in lengths], np.intp)

    def length(self, axis: str) -> int:
        """Return the maximum length of an array in the frames."""
        declared = self.schema.arrays.get(axis)
        if isinstance(declared, int):
            return declared
        return max(
            (max(frame_lengths, default=0) for frame_lengths in self._find_lengths(axis)), default=0
        )

    def _find_lengths(self, axis: str) -> list[set[int]]:
        brackets = axis.count("[]")
        names = axis.removesuffix("[]" * brackets).split(".")
        return [_collect_lengths(parsed, names, brackets) for parsed in self._parsed]

    @property
    def sizes(self) -> NDArray[np.intp]:
        return np.array([len(frame) for frame in self._frames], np.intp)

    def frame(self, index: int) -> bytes:
        return self._frames[index]

    def take(self, which: NDArray[np.intp]) -> ParsedTable:
        return ParsedTable(
            self.schema, [self._parsed[i] for i in which], [self._frames[i] for i in which]
        )

    def parts(self, axis: str, kind: str = "") -> tuple[ParsedTable, NDArray[np.intp]]:
        node = self.schema.parts[axis]
        parts = list[tuple[int, Any, bytes]]()
        for index, (parsed, frame) in enumerate(zip(self._parsed, self._frames, strict=True)):
            pieces = get_member(parsed, axis, None)
            if pieces is not None:
                spans = zip(pieces, pieces.spans, strict=True)
                parts += [
                    (index, part, frame[start:end])
                    for part, (name, start, end) in spans
                    if name == kind
                ]
        own = next(one for one in node.kinds if one.name == kind)
        frames = np.array([index for index, _, _ in parts], np.intp)
        return (
            ParsedTable(
                make_schema(own.root),
                [part for _, part, _ in parts],
                [data for _, _, data in parts],
            ),
            frames,
        )

    @staticmethod
    def join(tables: Sequence[ParsedTable]) -> ParsedTable:
        """Return several tables of one frame type as one table, in this order."""
        parsed = [item for table in tables for item in table._parsed]
        return ParsedTable(
            tables[0].schema, parsed, [frame for table in tables for frame in table._frames]
        )


def _take_element(
    table: Table, column: NDArray[Any], path: str, indices: Mapping[str, int]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return one element of a field's arrays, and whether each frame has it, (n,).

    Args:
        column: the values of the whole field, (n, *lengths).
        path: the path of the field, without indices.
        indices: the index of the element, by the path of the array.
    """
    inside = np.ones(len(table), np.bool_)
    axes = table.schema.columns[path].axes
    for axis in sorted(indices, key=axes.index, reverse=True):
        place = 1 + axes.index(axis)
        counts = table.counts(axis)
        element_indices = indices[axis] + (counts if indices[axis] < 0 else 0)
        inside &= (element_indices >= 0) & (element_indices < counts)
        if not column.shape[place]:
            return (
                np.zeros((*column.shape[:place], *column.shape[place + 1 :]), column.dtype),
                inside,
            )
        element_indices = np.broadcast_to(
            np.clip(element_indices, 0, column.shape[place] - 1), len(table)
        )
        column = np.take_along_axis(
            column, add_axes(element_indices, column.ndim - 1), place
        ).squeeze(place)
    return np.where(add_axes(inside, column.ndim - 1), column, 0).astype(column.dtype), inside


def _has_element(table: Table, path: str, indices: Mapping[str, int]) -> NDArray[np.bool_]:
    """Return whether the element of a field at `indices` exists in each frame, (n,)."""
    base_present = table.present(path)
    is_of_frames = base_present is None or base_present.ndim == 1
    column = table.raw(path) if is_of_frames else base_present
    assert column is not None
    elements, inside = _take_element(table, column, path, indices)
    if base_present is None:
        return inside
    if is_of_frames:
        return inside & base_present
    there: NDArray[np.bool_] = add_axes(inside, elements.ndim - 1) & elements
    return there


def _collect_values(parsed: Any, names: list[str], axes: int) -> Any:
    """Return the value at a path of a parsed frame; None if the frame lacks it."""
    if isinstance(parsed, list):
        return _collect_elements(parsed, names, axes)
    for index, name in enumerate(names):
        if not isinstance(parsed, dict) or name not in parsed or parsed[name] is None:
            return None
        parsed = parsed[name]
        if isinstance(parsed, list):
            return _collect_elements(parsed, names[index + 1 :], axes)
    if isinstance(parsed, bytes):
        return list(parsed)
    if not isinstance(parsed, dict):
        return next(iter(iter_leaves(parsed)))[1]
    return None


def _collect_elements(parsed: list[Any], names: list[str], axes: int) -> list[Any] | None:
    values = [_collect_values(element, names, axes) for element in parsed]
    if values and all(part is None for part in values):
        return None
    return values


def _find_present(value: Any) -> Any:
    """Return whether a value is not None.

    For a list, return the results of its elements: True if all of them are True, else a list.
    """
    if not isinstance(value, list):
        return value is not None
    present = [_find_present(part) for part in value]
    if all(part is True for part in present):
        return True
    return present


def _copy_value(column: NDArray[Any], index: int, value: Any) -> None:
    """Copy a value or nested lists to an index of a padded array."""
    if isinstance(value, list) and column.ndim > 2:
        for place, part in enumerate(value):
            _copy_value(column[index], place, part)
    elif isinstance(value, list):
        column[index, : len(value)] = [0 if part is None else part for part in value]
    elif column.ndim == 1 or isinstance(value, bool):
        column[index] = 0 if value is None else value
    elif value is not None:
        raise ValueError("expected an array, because other frames have an array here")


def _collect_lengths(value: Any, names: list[str], brackets: int) -> set[int]:
    """Return the lengths that an array has in one parsed frame, each once.

    There are several if the array is in the elements of another array.

    Args:
        names: the names in the path from `value` to the array.
        brackets: the number of arrays that contain the array directly, without a struct between
            them: 2 for the innermost array of a field with three dimensions, ``names[][]``.
    """
    if isinstance(value, list) and (names or brackets):
        below = brackets if names else brackets - 1
        return {length for part in value for length in _collect_lengths(part, names, below)}
    if names:
        if isinstance(value, dict):
            element = value.get(names[0])
        else:
            element = None
        if element is None:
            return set()
        return _collect_lengths(element, names[1:], brackets)
    if isinstance(value, list | bytes):
        return {len(value)}
    return set()


def _iter_numbers(value: Any) -> Iterator[Any]:
    """Yield the values in nested lists, without None."""
    if isinstance(value, list):
        for part in value:
            yield from _iter_numbers(part)
    elif value is not None:
        yield value


def _are_numbers(found: list[Any]) -> bool:
    """Return whether all values are numbers that fit into 64 bits."""
    values = list(_iter_numbers(found))
    if not all(isinstance(value, int | float) for value in values):
        return False
    whole = [value for value in values if isinstance(value, int)]
    least = min(whole, default=0)
    most = max(whole, default=0)
    return any(
        np.iinfo(kind).min <= least and most <= np.iinfo(kind).max for kind in (np.int64, np.uint64)
    )


def _find_outer_shape(leaf: Leaf | Derivation) -> tuple[int, ...]:
    """Return the lengths of the arrays that contain a field."""
    if leaf.info.adapter is not None and leaf.info.kind == "bytes":
        return leaf.shape[:-1]
    return leaf.shape


def _make_object_column(values: list[Any]) -> NDArray[Any]:
    """Return an object array of any values, (n,)."""
    column = np.empty(len(values), object)
    column[:] = values
    return column


def _find_common_dtype(found: list[Any]) -> np.dtype[Any]:
    """Return the dtype for numbers of a field without a declared dtype."""
    values = list(_iter_numbers(found))
    if any(isinstance(value, float) for value in values):
        return np.dtype(np.float64)
    is_small = max(values, default=0) <= np.iinfo(np.int64).max
    return np.dtype(np.int64 if is_small else np.uint64)
