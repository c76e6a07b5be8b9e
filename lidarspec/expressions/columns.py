"""Columns: the operands of `points`, `plausible` and clock functions.

The argument of a function is ``f``, the `Fields` of a `Batch` of packets. Each attribute of ``f``
is a `Column`, which is an array with one axis for the packets and one axis for each level of arrays
in the struct.

Each axis has the name of its array, so arithmetic aligns columns by name. A plain array is aligned
by its length, if exactly one array of the frame has this length.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from lidarspec.errors import SpecError, UnknownField
from lidarspec.frames.arrays import add_axes
from lidarspec.frames.frame_table import CompiledTable, LayoutRows, Table
from lidarspec.frames.schema import without_indices
from lidarspec.spec.tree import FieldInfo, Ref
from lidarspec.spec.vocabulary import ELEMENTWISE, AlongAxis, row_numbers

BITWISE = {np.bitwise_and, np.bitwise_or, np.bitwise_xor, np.invert}

#: Messages for operations that columns do not support.
NO_TRUTH = (
    "a column has one value per packet, so it is neither true nor false: use & | ~ instead of"
    " `and`, `or`, `not`, write a < f.x < b as (a < f.x) & (f.x < b), and use np.where instead of"
    " `if`"
)
NO_BITS = (
    "& | ~ require conditions, but a field is float64: put each comparison in parentheses, as in"
    " (f.a < 1) & (f.b < 2); to read single bits, declare them in a BitStruct"
)
NO_TEXT = (
    "a column consists of numbers and cannot be combined with {!r}; in a field of bytes, each byte"
    " is a number, such as 65 for b'A'"
)

Carry = dict[int, NDArray[np.float64]]

#: The key of `Batch.state` for the frames that contain the packets, if the packets are parts.
AROUND = "^"


@dataclass(eq=False)
class Batch:
    """The packets that a set of columns belongs to.

    Attributes:
        table: the raw columns of the packets.
        breaks: (n,) True if packets or bytes were lost before the packet.
        state: for each other frame type, a table of its frames, and an array (n,) with the row of
            the last frame before each packet; -1 for a packet before the first frame.
        defaults: the declared defaults of state columns, by frame type and path.
        carry: the values from the previous batch that each call of `previous` or `last` needs:
            number of the call in the function, from 0 -> values.
        functions_of_carry: for each call of `previous` or `last` so far, a function that returns
            the values for `carry` of the next batch. The argument of the function is the index of
            the packet with which the next batch begins.
        nominal: whether a declared default of a state column was used.
    """

    table: Table
    breaks: NDArray[np.bool_]
    state: Mapping[str, tuple[Table | None, NDArray[np.intp]]] = field(default_factory=dict)
    defaults: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    carry: Carry = field(default_factory=dict)
    nominal: bool = False
    functions_of_carry: list[Callable[[int], NDArray[np.float64]]] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.table)

    def carry_over(self, ready: int) -> Carry:
        """Return the values that the next batch needs, as its `carry`.

        Args:
            ready: the index of the packet with which the next batch begins.
        """
        return {slot: carry(ready) for slot, carry in enumerate(self.functions_of_carry)}

    def of(self, group: LayoutRows) -> Batch:
        """Return a batch with only the packets of a group, without `carry`."""
        table = CompiledTable(
            self.table.schema, [LayoutRows(group.layout, np.arange(len(group.where)), group.rows)]
        )
        state = {name: (frames, which[group.where]) for name, (frames, which) in self.state.items()}
        return Batch(table, self.breaks[group.where], state, self.defaults, nominal=self.nominal)


class Column(NDArrayOperatorsMixin):
    """Numbers of a batch of packets; NumPy's functions can be applied to it.

    Attributes:
        array: the numbers, (n or 1, ...), with one axis for each level of arrays in the struct. The
            axis of an array that does not contain the field has length 1.
        axes: the names of the axes after the first; None for an axis of length 1. A name with "?"
            is not the axis of a field: "name?" was given by `along`, "?name" was guessed for a
            plain array.
        ready: how many packets, counted from the start of the batch, have final values. The values
            of all later packets depend on the next batch.
        source: the path of the field, if the column is an unchanged field, else "".
        frame: the frame type that contains the field; "" if it is the type of the packets.
    """

    #: A column cannot be iterated.
    __iter__ = None

    def __init__(
        self,
        array: NDArray[Any],
        axes: tuple[str | None, ...],
        batch: Batch,
        *,
        ready: int | None = None,
        source: str = "",
        frame: str = "",
    ) -> None:
        self.array = array
        self.axes = axes
        self.batch = batch
        self.source = source
        self.frame = frame
        self.ready = len(batch) if ready is None else ready

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the array."""
        return self.array.shape

    @property
    def known_values(self) -> NDArray[Any]:
        """All values of the column.

        A `graph.TracedColumn` has only the values of sample packets.
        """
        return self.array

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        if dtype is None:
            return self.array
        return self.array.astype(dtype)

    def __bool__(self) -> bool:
        raise SpecError(NO_TRUTH, rule="LS213")

    def __getitem__(self, index: int) -> Column:
        """Return one element of an array field for each packet; nan if it is missing."""
        if not self.source or not isinstance(index, int):
            raise SpecError(
                "only a field can be indexed, and each index is one integer, as in"
                " f.columns[0].timestamp"
            )
        return _read_column(self.batch, self.frame, f"{self.source}[{index}]")

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if kwargs.get("out") is not None:
            raise SpecError("a column cannot be changed in place: write a new expression")
        if method != "__call__":
            return getattr(ufunc, method)(*(np.asarray(value) for value in inputs), **kwargs)
        return self.apply_function(
            (lambda *arrays: ufunc(*arrays, **kwargs)) if kwargs else ufunc, *inputs
        )

    def __array_function__(
        self, function: Callable[..., Any], types: Any, args: Any, kwargs: Any
    ) -> Any:
        if function in ELEMENTWISE:
            return self.apply_function(lambda *arrays: function(*arrays, **kwargs), *args)
        plain = [np.asarray(value) if isinstance(value, Column) else value for value in args]
        return function(*plain, **kwargs)

    def apply_function(self, function: Callable[..., Any], *values: Any) -> Column:
        """Apply a function to the values, after aligning the values by their axes."""
        arrays, axes, ready = align(values, self.batch)
        try:
            array = call_aligned(function, arrays)
        except TypeError:
            if function in BITWISE:
                raise SpecError(NO_BITS, rule="LS213") from None
            texts = [value for value in values if isinstance(value, bytes | str)]
            if texts:
                raise SpecError(NO_TEXT.format(texts[0])) from None
            raise
        except ValueError:
            broadcast_shape({str(place): array for place, array in enumerate(arrays, 1)}, axes)
            raise
        names = (*axes, *(f"<{index}>" for index in range(len(axes), array.ndim - 1)))
        return Column(array, names, self.batch, ready=ready)

    def on(self, *axes: str) -> Column:
        """Return the same values along other arrays of the frame.

        Each axis of the column becomes the axis of one array. If an array is longer than the axis,
        the missing elements are nan.

        Args:
            axes: the paths or the last names of the arrays. If these are more arrays than the
                column has axes, the innermost arrays are used.

        Raises:
            SpecError: if the column has more axes than `axes`, or if an array is unknown.
        """
        schema = self.batch.table.schema
        own = [index for index, name in enumerate(self.axes) if name is not None]
        if len(axes) < len(own):
            raise SpecError(
                f"the column varies along {len(own)} nested arrays: .on(...) requires at least"
                f" {len(own)} arrays, got {', '.join(axes)}"
            )
        names = {schema.array_depths[axis]: axis for axis in map(schema.axis, axes)}
        places = sorted(names)[len(axes) - len(own) :]
        array = self.array
        for index, place in zip(own, places, strict=True):
            array = _pad_to_extent(array, 1 + index, self.batch.table, names[place])
        lengths = dict(zip(places, (array.shape[1 + index] for index in own), strict=True))
        depth = max(schema.depth(), len(self.axes), *(place + 1 for place in names))
        array = array.reshape(len(array), *(lengths.get(place, 1) for place in range(depth)))
        return Column(
            array,
            tuple(names[place] if place in lengths else None for place in range(depth)),
            self.batch,
            ready=self.ready,
        )

    @property
    def index(self) -> AlongAxis:
        """0, 1, 2 ... along the innermost array of the column.

        Raises:
            SpecError: if the column is not in an array.
        """
        schema = self.batch.table.schema
        names = [str(name).strip("?") for name in self.axes if name is not None]
        # The column contains one element of an array in all packets.
        if not names and not self.frame and self.source in schema.fields:
            names = list(schema.fields[self.source].axes)
        if not names:
            raise SpecError("`index` exists only for a field inside an array")
        return AlongAxis(
            (names[-1],), np.arange(self.array.shape[1 + schema.array_depths[names[-1]]])
        )

    def steps(self) -> AlongAxis | NDArray[np.intp]:
        """Return the numbers 0, 1, 2 ... below the largest value in the whole column.

        If the column is the length of an array, the numbers are the indices of this array.
        """
        schema = self.batch.table.schema
        most = int(np.nanmax(self.array, initial=0))
        counted = [
            axis
            for axis, count in schema.arrays.items()
            if isinstance(count, Ref) and count.path == self.source and not self.frame
        ]
        if len(counted) == 1:
            axis = counted[0]
        elif schema.deepest_axes:
            axis = schema.deepest_axes[-1]
        else:
            axis = None
        if axis is None:
            return np.arange(most)
        return AlongAxis((axis,), np.arange(_find_extent(self.batch.table, axis, most)))

    def gather(self, table: NDArray[np.float64]) -> Column:
        """Return the rows of a table that the values of the column select by index.

        The k numbers of a row become the elements along an array of the frame with k elements.

        Args:
            table: (m + 1, k). The last row is nan, and is selected by values outside of 0 to m - 1.
        """
        own = [place for place, name in enumerate(self.axes) if name is not None]
        depth = max(len(self.axes), self.batch.table.schema.depth())
        place = _find_axis(
            table.shape[1:], [None] * depth, [1] * depth, self.batch.table, without=own
        )
        rows = table.take(
            row_numbers(add_axes(self.array, depth).squeeze(1 + place), len(table)), axis=0
        )
        axes = [*self.axes, *(None,) * (depth - len(self.axes))]
        axes[place] = f"?{self.batch.table.schema.deepest_axes[place]}"
        return Column(np.moveaxis(rows, -1, 1 + place), tuple(axes), self.batch, ready=self.ready)

    def running(self) -> Column:
        """Return the cumulative sum along the innermost array of the column."""
        place = max([place for place, name in enumerate(self.axes) if name is not None], default=0)
        return Column(
            np.cumsum(self.array, axis=1 + place, dtype=np.float64),
            self.axes,
            self.batch,
            ready=self.ready,
        )

    def shift(self, step: int) -> Column:
        """Return for each element the value `step` elements later in stream order.

        A negative step returns earlier values. A value is nan if packets were lost between both
        elements, or if the other element does not exist.
        """
        row = FlatColumn(self)
        size = abs(step)
        slot = len(self.batch.functions_of_carry)
        carried = self.batch.carry.get(slot, np.empty(0))
        if len(carried):
            values = np.concatenate([carried, row.values])
        else:
            values = row.values
        edges = row.edges + len(carried)
        shifted = np.empty(len(values))
        ahead = max(step, 0)
        behind = max(-step, 0)
        inside = max(len(values) - size, 0)
        shifted[behind : behind + inside] = values[ahead : ahead + inside]
        shifted[:behind] = shifted[behind + inside :] = np.nan
        for edge in edges.tolist() if size else ():
            shifted[max(edge - ahead, 0) : edge + behind] = np.nan
        ready = self.ready
        if step > 0:
            certain = row.starts[ready] - step
            ready = min(
                ready,
                int(np.searchsorted(row.starts, certain, side="right")) - 1 if certain >= 0 else 0,
            )
        self.batch.functions_of_carry.append(
            lambda upto: _take_connected_tail(
                values, edges, len(carried) + row.starts[upto], 0 if step > 0 else size
            )
        )
        return Column(
            row.unflatten(shifted[len(carried) :]), self.axes, self.batch, ready=max(ready, 0)
        )

    def latest(self, where: Any = None) -> Column:
        """Return for each element the latest value so far for which `where` is true.

        The result is nan before the first such value.

        Args:
            where: a condition that aligns with the column; by default, whether the value is finite.
        """
        (values, flags), axes, ready = align(
            (self, np.isfinite(self) if where is None else where), self.batch
        )
        shape = np.broadcast_shapes(values.shape, flags.shape)
        both = [
            Column(np.broadcast_to(array, shape), axes, self.batch, ready=ready)
            for array in (values, flags)
        ]
        row, known = (FlatColumn(column) for column in both)
        slot = len(self.batch.functions_of_carry)
        carried = self.batch.carry.get(slot, np.full(1, np.nan))
        numbers = np.concatenate([carried, row.values])
        starts = np.concatenate([[0], 1 + np.flatnonzero(known.values > 0)])
        latest = np.repeat(numbers[starts], np.diff(starts, append=len(numbers)))
        self.batch.functions_of_carry.append(lambda upto: latest[: 1 + row.starts[upto]][-1:])
        return Column(row.unflatten(latest[1:]), axes, self.batch, ready=ready)


class FlatColumn:
    """The values of a column in stream order, without padding.

    Attributes:
        values: (k,) float64.
        starts: (n + 1,) the index of the first value of each packet; the last element is k.
        edges: the indices of the values that follow a loss, ascending.
    """

    def __init__(self, column: Column) -> None:
        self._shape = (len(column.batch), *column.shape[1:])
        if column.array.shape == self._shape:
            full = column.array
        else:
            full = np.broadcast_to(column.array, self._shape)
        flat = full.reshape(self._shape[0], math.prod(self._shape[1:]))
        self._mask = make_value_mask(column.axes, self._shape, column.batch)
        self.values = np.asarray(
            (flat if self._mask is None else flat[self._mask]).reshape(-1), np.float64
        )
        if self._mask is None:
            self.starts = np.arange(len(flat) + 1, dtype=np.intp) * flat.shape[1]
        else:
            self.starts = np.concatenate([[0], np.cumsum(self._mask.sum(axis=1))]).astype(np.intp)
        self.edges = self.starts[np.flatnonzero(column.batch.breaks)]

    def unflatten(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values in the shape of the column, padded with nan.

        Args:
            values: (k,) in stream order.
        """
        if self._mask is None:
            return values.reshape(self._shape)
        full = np.full(self._mask.shape, np.nan)
        full[self._mask] = values
        return full.reshape(self._shape)


def make_value_mask(
    axes: tuple[str | None, ...], shape: tuple[int, ...], batch: Batch
) -> NDArray[np.bool_] | None:
    """Return a mask that is False for the padding of arrays of variable length.

    The mask has the shape (n, number of elements in a packet). It is None if there is no padding.
    """
    mask: NDArray[np.bool_] | None = None
    for index, axis in enumerate(axes):
        name = (axis or "<").strip("?")
        if name.startswith("<") or isinstance(batch.table.schema.arrays.get(name), int):
            continue
        counts = batch.table.counts(name)
        if len(counts) and int(counts.min()) == shape[1 + index]:
            continue
        inside = np.arange(shape[1 + index]) < counts[:, None]
        inside = inside.reshape(
            len(counts), *(shape[1 + i] if i == index else 1 for i in range(len(axes)))
        )
        mask = inside if mask is None else mask & inside
    if mask is None:
        return None
    return np.broadcast_to(mask, shape).reshape(shape[0], math.prod(shape[1:]))


def align(
    values: tuple[Any, ...], batch: Batch
) -> tuple[list[NDArray[Any]], tuple[str | None, ...], int]:
    """Align columns and other arrays, so that they broadcast.

    Returns:
        The arrays, the names of their common axes, and the smallest `ready` of the columns.

    Raises:
        SpecError: if the values belong to different arrays of the frame.
    """
    columns = [value for value in values if isinstance(value, Column)]
    if (
        columns
        and all(column.axes == columns[0].axes for column in columns)
        and _are_columns_or_numbers(values)
    ):
        arrays = [
            value.array if isinstance(value, Column) else np.asarray(value) for value in values
        ]
        return arrays, columns[0].axes, min([column.ready for column in columns])
    schema = batch.table.schema
    named = {
        at: {schema.array_depths[axis]: axis for axis in map(schema.axis, v.axes)}
        for at, v in enumerate(values)
        if isinstance(v, AlongAxis)
    }
    depth = max(
        [len(column.axes) for column in columns]
        + [place + 1 for places in named.values() for place in places],
        default=0,
    )
    axes = list[str | None]([None] * depth)
    lengths = [1] * depth
    for column in columns:
        for place, name in enumerate(column.axes):
            axes[place], lengths[place] = (
                _merge_axis_names(axes[place], name),
                max(lengths[place], column.array.shape[1 + place]),
            )
    for at, places in named.items():
        for place, axis in places.items():
            length = _count_elements(values[at], axis)
            axes[place], lengths[place] = (
                _merge_axis_names(axes[place], f"{axis}?" if length != 1 else None),
                max(lengths[place], length),
            )
    arrays = []
    for at, value in enumerate(values):
        if isinstance(value, Column):
            arrays.append(add_axes(value.array, depth))
        elif at in named:
            names = tuple(
                named[at].get(place, "").rpartition(".")[2]
                for place in range(min(named[at]), depth)
            )
            arrays.append(value.align(names))
        else:
            arrays.append(_reshape_to_axes(np.asarray(value), axes, lengths, batch.table))
    if not len(batch):
        # A column of variable length is empty, but a table of the plugin is not.
        arrays = _cut_to_shortest(arrays)
    return arrays, tuple(axes), min((column.ready for column in columns), default=len(batch))


def _cut_to_shortest(arrays: list[NDArray[Any]]) -> list[NDArray[Any]]:
    """Cut the arrays to their shortest length along each axis; keep axes of length 1."""
    reversed_shapes = [array.shape[::-1] for array in arrays]
    shortest = [
        min((length for length in lengths if length != 1), default=1)
        for lengths in itertools.zip_longest(*reversed_shapes, fillvalue=1)
    ]
    return [
        array[tuple(slice(shortest[place]) for place in reversed(range(array.ndim)))]
        for array in arrays
    ]


def _merge_axis_names(first: str | None, name: str | None) -> str | None:
    """Return the name of an axis that two values share; None if it has no name.

    Args:
        first: the name of the axis of one value; None if it has no name.
        name: the name of the axis of the other value; None if it has no name.

    Raises:
        SpecError: if the names belong to different arrays, and neither name was guessed (a guessed
            name begins with "?", see `Column`).
    """
    if first is None or name is None:
        return first or name
    if (
        first.strip("?") != name.strip("?")
        and not first.startswith("?")
        and not name.startswith("?")
    ):
        raise SpecError(
            f"values along the arrays {first.strip('?')!r} and {name.strip('?')!r} cannot be"
            " combined: move one value to the array of the other with .on(...)"
        )
    return min(first, name, key=lambda axis: (axis.startswith("?"), axis.endswith("?")))


def _count_elements(value: AlongAxis, axis: str) -> int:
    """Return the number of elements along an array."""
    return int(
        value.array.shape[
            [name.rpartition(".")[2] for name in value.axes].index(axis.rpartition(".")[2])
        ]
    )


def _reshape_to_axes(
    array: NDArray[Any], axes: list[str | None], lengths: Sequence[int], table: Table
) -> NDArray[Any]:
    """Reshape a plain array to the given axes, and name axes that have no name.

    Args:
        axes: the names of the axes, which are changed in place.

    Raises:
        SpecError: if the length of the array fits several arrays of the frame, or none.
    """
    depth = len(lengths)
    if array.size == 1:
        return array
    if array.ndim < depth:
        array = array.reshape(
            *array.shape,
            *(1,) * (depth - array.ndim - _find_axis(array.shape, axes, lengths, table)),
        )
    for place in range(max(depth - array.ndim, 0), depth):
        if array.shape[place - depth] != 1 and axes[place] is None:
            chain = table.schema.deepest_axes
            if array.ndim > depth:
                guess = ""
            else:
                guess = "?"  # with an axis for the packets it was made of columns
            axes[place] = f"{guess}{chain[place] if place < len(chain) else f'<{place}>'}"
    return array


def _find_axis(
    shape: tuple[int, ...],
    axes: Sequence[str | None],
    lengths: Sequence[int],
    table: Table,
    without: Sequence[int] = (),
) -> int:
    """Return the index in `axes` at which the axes of a plain array begin.

    Args:
        shape: the lengths of the plain array.
        axes: the names of the axes of the columns.
        lengths: the lengths of the axes of the columns.
        without: indices in `axes` that are not compared with arrays of the frame.
    """
    wanted = [(place, length) for place, length in enumerate(shape) if length != 1]
    there = {
        (place, length): (axes[place] or "").strip("?") for place, length in enumerate(lengths)
    }
    texts = {info.path for info in table.schema.fields.values() if info.kind == "bytes"}
    whole = {
        (place, table.length(axis)): axis
        for axis, place in table.schema.array_depths.items()
        if axis not in texts and place not in without
    }
    for known in (there, whole):
        positions = [
            [(first + place, length) for place, length in wanted]
            for first in range(len(lengths) - len(shape) + 1)
        ]
        found = {
            first: [known[position] for position in some]
            for first, some in enumerate(positions)
            if all(position in known for position in some)
        }
        fixed = {
            first: names
            for first, names in found.items()
            if all(isinstance(table.schema.arrays.get(name, 0), int) for name in names)
        }
        # An array of variable length that happens to fit must not change the spec's meaning.
        found = fixed or found
        # The number of axes determines the position.
        if len(found) == 1 or (len(shape) > 1 and len(lengths) - len(shape) in found):
            return max(found)
        if found:
            names = [" x ".join(names) for names in found.values()]
            reason = (
                f"match several arrays of the frame, {' and '.join(names)}: choose the array, for"
                f" example with along({found[max(found)][-1]!r}, ...)"
            )
            break
    else:
        arrays = ", ".join(f"{axis} {length}" for (_, length), axis in whole.items())
        if arrays:
            reason = f"match no array of the frame; the arrays have the lengths {arrays}"
        else:
            reason = "match no array, because the frame has no arrays"
    raise SpecError(f"{' x '.join(map(str, shape))} values {reason}", rule="LS214")


def align_points(
    parts: Mapping[str, Any], batch: Batch
) -> tuple[list[NDArray[Any]], tuple[str | None, ...], int, tuple[int, ...]]:
    """Align the coordinates and other columns that `points` returns.

    Returns:
        The arrays, the names of their axes, the number of packets for which all columns are known,
        and the common shape of the arrays, (n, ...).

    Raises:
        SpecError: if coordinates belong to different arrays of the frame or have different lengths,
            or if the points vary along an array of which no value uses a field.
    """
    anchor = Column(
        np.zeros((1,) * (1 + batch.table.schema.depth())),
        (None,) * batch.table.schema.depth(),
        batch,
    )
    (_, *arrays), axes, ready = align((anchor, *parts.values()), batch)
    named = dict(zip(parts, arrays, strict=True))
    shape = broadcast_shape(
        {"": np.empty((len(batch), *(1,) * len(axes)), np.bool_), **named}, axes
    )
    stray = next((name.strip("?") for name in axes if name is not None and "?" in name), None)
    if stray is not None or len(shape) > 1 + len(axes):
        if stray is not None:
            array = f"the array {stray!r}"
        else:
            array = "an array"
        raise SpecError(
            f"the points vary along {array}, but no value uses a field of this array"
            f" ({_describe_lengths(named, axes)}): if the values are plain numbers, name their"
            " array with along(...)",
            rule="LS214",
        )
    return arrays, axes, ready, shape


def _find_extent(table: Table, axis: str, length: int) -> int:
    """Return how many values along an array of the frame are used.

    Args:
        axis: the path of the array.
        length: the number of values, which may exceed the length of the array.
    """
    # The array does not exist in a packet with an empty outer array. Values that are longer than
    # the array are then cut. In all other cases, they cause an error when arrays are aligned.
    if any((table.counts(other) == 0).any() for other in table.schema.outer(axis)):
        return min(length, table.length(axis))
    return length


def _pad_to_extent(array: NDArray[Any], place: int, table: Table, axis: str) -> NDArray[Any]:
    """Extend an array with nan, or cut it, to the length of an array of the frame.

    Args:
        place: the index of the axis to change.
        axis: the name of the array of the frame.
    """
    length = array.shape[place]
    missing = table.length(axis) - length
    if missing > 0:
        gaps = [(0, missing * (place == other)) for other in range(array.ndim)]
        return np.pad(array.astype(np.float64), gaps, constant_values=np.nan)
    if missing:
        return array.take(range(_find_extent(table, axis, length)), axis=place)
    return array


def broadcast_shape(
    arrays: Mapping[str, NDArray[Any]], axes: tuple[str | None, ...]
) -> tuple[int, ...]:
    """Return the shape that arrays broadcast to.

    Args:
        arrays: the arrays by name. An array named "" is not listed in the error message.
        axes: the names of their axes after the first.

    Raises:
        SpecError: if the arrays have different lengths.
    """
    try:
        return np.broadcast_shapes(*(array.shape for array in arrays.values()))
    except ValueError:
        raise SpecError(
            f"the arrays of the points have different lengths: {_describe_lengths(arrays, axes)}",
            rule="LS214",
        ) from None


def _describe_lengths(arrays: Mapping[str, NDArray[Any]], axes: tuple[str | None, ...]) -> str:
    """Return a list of the lengths of arrays, such as "range: samples 3, azimuth: samples 4"."""
    names = ("packets", *((name or "").strip("?") for name in axes))
    texts = []
    for what, array in arrays.items():
        own = [
            f"{name} {size}".strip()
            for name, size in zip(reversed(names), reversed(array.shape), strict=False)
            if size != 1
        ]
        extra = [str(size) for size in array.shape[: max(array.ndim - len(names), 0)]]
        texts += [f"{what}: {' x '.join(extra + own[::-1])}"] if what and (own or extra) else []
    return ", ".join(texts)


def _are_columns_or_numbers(values: tuple[Any, ...]) -> bool:
    return all(isinstance(value, Column | int | float) for value in values)


def call_aligned(function: Callable[..., Any], arrays: Sequence[Any]) -> NDArray[Any]:
    """Return the result of a function of aligned arrays, in their broadcast shape."""
    return np.asarray(remainder(*arrays) if function is np.remainder else function(*arrays))


def remainder(values: Any, full: Any) -> NDArray[Any]:
    """Return the same values as ``np.remainder``, faster for nearly all angles."""
    if np.ndim(full) or not full > 0 or np.ndim(values) == 0 or values.dtype != np.float64:
        return np.asarray(np.remainder(values, full))
    turns = np.subtract(values < 0, values >= full, dtype=np.int8)
    rest: NDArray[np.float64] = values + full * turns
    inside = (rest >= 0) & (rest < full)
    if not inside.all():
        rest[~inside] = np.remainder(values[~inside], full)
    return rest


def _take_connected_tail(
    values: NDArray[np.float64], edges: NDArray[np.intp], end: int, size: int
) -> NDArray[np.float64]:
    """Return the last values before index `end`, beginning after the last loss.

    Args:
        edges: the indices of the first values after losses.
        size: the maximum number of values to return.
    """
    if end == 0 or size == 0:
        return np.empty(0)
    lost = edges[edges < end]
    return values[max(end - size, int(lost[-1]) if len(lost) else 0, 0) : end].copy()


def field_column(
    info: FieldInfo,
    table: Table,
    depth: int,
    batch: Batch,
    which: NDArray[np.intp] | None = None,
    frame: str = "",
) -> Column:
    """Return a field in its unit as a column with `depth` array axes.

    Args:
        which: the row of `table` for each packet; None if the packets are the rows.
        frame: the frame type of `table`; "" if it is the type of the packets.
    """
    array = field_array(info, table, depth)
    if which is not None:
        array = array[which]
    axes = list[str | None]([None] * (array.ndim - 1))
    for name in info.axes:
        place = table.schema.array_depths[name]
        axes[place] = _name_axis(name, array.shape[1 + place], table, known=which is None)
    return Column(array, tuple(axes), batch, source=info.path, frame=frame)


def field_array(info: FieldInfo, table: Table, depth: int, *, raw: bool = False) -> NDArray[Any]:
    """Return a field in its unit, (n, ...), with one axis for each array level.

    Axes of arrays that do not contain the field have length 1.

    Args:
        depth: the minimum number of axes after the first.
        raw: whether to return the integers of the frames, in the dtype of the field.
    """
    if raw:
        array = table.raw(info.path)
    else:
        array = load_physical(info, table)
    places = [table.schema.array_depths[axis] for axis in info.axes]
    if places and places[-1] >= len(places):  # an element of an array with nested arrays
        lengths = dict(zip(places, array.shape[1:], strict=True))
        array = array.reshape(
            len(array), *(lengths.get(place, 1) for place in range(places[-1] + 1))
        )
    return add_axes(array, depth)


def _name_axis(name: str, length: int, table: Table, *, known: bool) -> str | None:
    """Return `name`; None if the array has exactly one element in every packet.

    Args:
        known: whether `table` has the lengths of the array in the packets.
    """
    if length != 1 or (
        known
        and not isinstance(table.schema.arrays.get(name), int)
        and not table.counts(name).all()
    ):
        return name
    return None


def load_physical(info: FieldInfo, table: Table) -> NDArray[np.float64]:
    """Return a field in its unit, float64, (n, *lengths); nan if a frame lacks the field."""
    array = table.raw(info.path)
    if array.dtype == object:
        raise SpecError(
            "the values of this field are not numbers; for text, declare the field as Bytes(...)",
            path=info.path,
        )
    with np.errstate(invalid="ignore"):  # a signalling nan is a nan
        array = array.astype(np.float64)
    if info.scaled:
        array *= info.scale
        array += info.offset
    there = table.present(info.path)
    if there is not None:
        array = np.where(add_axes(there, array.ndim - 1), array, np.nan)
    return array


class Fields:
    """The fields of a batch of packets as attributes, which are columns.

    ``f.points.distance`` is a field, and ``f.state.difop.vertical`` is a field of another frame
    type. If the packets are parts of a frame, ``f.frame.counter`` is a field of that frame.

    Args:
        prefix: the names of the enclosing structs, each followed by a dot.
        frame: the frame type that contains the fields; "" if it is the type of the packets.
    """

    def __init__(self, batch: Batch, prefix: str = "", frame: str = "") -> None:
        self._batch = batch
        self._prefix = prefix
        self._frame = frame

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name == "state" and not self._prefix and not self._frame:
            return _States(self._batch)
        if name == "frame" and not self._prefix and not self._frame and AROUND in self._batch.state:
            return Fields(self._batch, frame=AROUND)
        path = f"{self._prefix}{name}"
        paths = _list_paths(self._batch, self._frame)
        base = without_indices(path)[0]
        if base in paths:
            return _read_column(self._batch, self._frame, path)
        if any(other.startswith(f"{base}.") for other in paths):
            return Fields(self._batch, f"{path}.", self._frame)
        axis = base.rpartition(".")[0]
        if name == "index" and not self._frame and axis in self._batch.table.schema.arrays:
            return AlongAxis((axis,), np.arange(self._batch.table.length(axis)))
        raise UnknownField(
            path,
            paths,
            place=(
                "frame" if self._frame == AROUND else f"state.{self._frame}" if self._frame else ""
            ),
        )

    def __getitem__(self, index: int) -> Fields:
        """Return one element of an array of structs; a negative index counts from the end."""
        if not self._prefix or not isinstance(index, int):
            raise SpecError(
                "only an array can be indexed, and each index is one integer, as in"
                " f.columns[0].timestamp or f.distances[-1]"
            )
        return Fields(self._batch, f"{self._prefix.removesuffix('.')}[{index}].", self._frame)

    @property
    def _is_of_other_frames(self) -> bool:
        """Whether the fields belong to frames other than the packets."""
        return bool(self._frame)


def _list_paths(batch: Batch, frame: str) -> Iterable[str]:
    """Return the paths of the fields of one frame type.

    Args:
        frame: the name of the frame type; "" for the type of the packets.
    """
    if not frame:
        return batch.table.schema.columns
    table, _ = batch.state[frame]
    return {*batch.defaults.get(frame, {}), *(table.schema.columns if table is not None else ())}


class _States:
    """The fields of ``f.state``: for each packet, the last frame of each other type."""

    def __init__(self, batch: Batch) -> None:
        self._batch = batch

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name not in self._batch.state:
            raise UnknownField(name, self._batch.state, place="state")
        return Fields(self._batch, frame=name)


def _read_column(batch: Batch, frame: str, path: str) -> Column:
    """Return a field of a batch as a column."""
    depth = batch.table.schema.depth()
    table, which = batch.state[frame] if frame else (batch.table, np.zeros(0, np.intp))
    if (
        table is not None
        and path not in table.schema.columns
        and without_indices(path)[0] in table.schema.columns
    ):
        raise SpecError("the array has no element with this index", path=path)
    if not frame:
        return field_column(batch.table.schema.columns[path], batch.table, depth, batch)
    defaults = batch.defaults.get(frame, {})
    missing = which < 0
    if not missing.any() and table is not None:
        same = len(which) == 0 or int(which.min()) == int(which.max())
        return field_column(
            table.schema.columns[path], table, depth, batch, which[:1] if same else which, frame
        )
    base, indices = without_indices(path)
    if base not in defaults:
        raise SpecError(
            f"the value is unknown: no {frame} frame has arrived yet, and no default is declared",
            path=f"state.{frame}.{path}",
        )
    batch.nominal = True
    default = np.asarray(defaults[base], np.float64)[tuple(indices.values())]
    names = tuple(path if length != 1 else None for length in default.shape)
    spare = (1,) * max(depth - default.ndim, 0)
    array = default.reshape(1, *default.shape, *spare)
    if table is not None and not missing.all():
        known = field_column(
            table.schema.columns[path], table, depth, batch, np.maximum(which, 0)
        ).array
        array = np.where(missing.reshape(-1, *(1,) * (known.ndim - 1)), array, known)
    return Column(array, (*names, *(None,) * len(spare)), batch, source=path, frame=frame)
