"""Functions that `points` functions can call, in addition to NumPy's ufuncs.

The functions accept NumPy arrays and the columns that the engine passes to `points`. They take lost
packets into account only for columns.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from lidarspec.errors import SpecError

Array = Any

#: Steps between blocks may be larger than the step at the highest speed by this factor. In captures
#: of rotating sensors, steps at a constant speed vary by 5 %.
STEP_TOLERANCE = 1.25
#: The NumPy functions that work element by element, so that their results keep the axes. All other
#: functions get plain arrays.
ELEMENTWISE = {np.where, np.clip, np.nan_to_num, np.round, np.isclose, np.real_if_close}


class AlongAxis(NDArrayOperatorsMixin):
    """Numbers for the elements of an array of the frame, the same in all packets.

    Attributes:
        axes: the names of the arrays; each is a whole path, or the last name of a path.
        array: the numbers, with an axis for each array of the frame.
    """

    def __init__(self, axes: tuple[str, ...], array: NDArray[Any]) -> None:
        self.axes = axes
        self.array = array

    def __len__(self) -> int:
        return len(self.array)

    def __getitem__(self, which: Any) -> Any:
        """Return an element, or the elements of a slice, as plain numbers."""
        return self.array[which]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        if dtype is None:
            return self.array
        return self.array.astype(dtype)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if method != "__call__" or kwargs.get("out") is not None:
            return getattr(ufunc, method)(*map(np.asarray, inputs), **kwargs)
        return self.apply_function(
            (lambda *arrays: ufunc(*arrays, **kwargs)) if kwargs else ufunc, *inputs
        )

    def __array_function__(
        self, function: Callable[..., Any], types: Any, args: Any, kwargs: Any
    ) -> Any:
        if function in ELEMENTWISE:
            return self.apply_function(
                (lambda *arrays: function(*arrays, **kwargs)) if kwargs else function, *args
            )
        return function(
            *(np.asarray(value) if isinstance(value, AlongAxis) else value for value in args),
            **kwargs,
        )

    def apply_function(self, function: Callable[..., Any], *values: Any) -> Any:
        """Align the values by the names of their arrays, and apply a function to them."""
        for value in values:
            if hasattr(value, "apply_function") and not isinstance(value, AlongAxis):
                return value.apply_function(function, *values)
        axes: dict[str, str] = {}
        for name in (
            name for value in values if isinstance(value, AlongAxis) for name in value.axes
        ):
            axes.setdefault(name.rpartition(".")[2], name)
        arrays = [
            value.align(tuple(axes)) if isinstance(value, AlongAxis) else np.asarray(value)
            for value in values
        ]
        array = np.asarray(function(*arrays))
        if array.ndim != len(axes):
            raise SpecError(
                f"cannot combine an array of shape {array.shape} with numbers along"
                f" {', '.join(axes)}: name the axis of the array with along(...)"
            )
        return AlongAxis(tuple(axes.values()), array)

    def align(self, names: tuple[str, ...]) -> NDArray[Any]:
        """Return the numbers with one axis for each name.

        Args:
            names: for each axis of the result, the last name in the path of its array.
        """
        own = [name.rpartition(".")[2] for name in self.axes]
        ordered = self.array.transpose([own.index(name) for name in names if name in own])
        lengths = iter(ordered.shape)
        return ordered.reshape([next(lengths) if name in own else 1 for name in names])


def along(axis: str | tuple[str, ...], values: Array) -> Any:
    """Return numbers for the elements of an array: ``along("pixels", ELEVATIONS)``.

    Args:
        axis: the name of an array of the frame, or the names of several nested arrays, outermost
            first.
        values: one number for each element, with an axis for each array.

    Returns:
        Numbers that are aligned with columns by the name of the array.

    Raises:
        SpecError: if the number of axes of `values` differs from the number of names.
    """
    axes = (axis,) if isinstance(axis, str) else tuple(axis)
    array = np.asarray(values)
    if array.ndim != len(axes):
        raise SpecError(
            f"along({axis!r}, ...) requires an array with one axis per name, got shape"
            f" {array.shape}"
        )
    return AlongAxis(axes, array)


def spread(start: Array, end: Array, count: Array, *, full: float) -> Array:
    """Return evenly spaced angles from start to end, both included, for each packet.

    Args:
        start: the first angle of each packet, (n, 1), in the unit of `full`.
        end: the last angle of each packet, (n, 1). If it is below the start, it is in the next
            turn.
        count: the number of points of each packet, a number or a column (n, 1). If it is 1, the
            result is `start`.
        full: the size of a whole turn, in the unit of the angles.

    Returns:
        float64, shape (n, count), not wrapped, so that the angles of a packet increase. If `count`
        is a column, its largest value is the length, and values beyond the count of a packet have
        no meaning.

    Raises:
        SpecError: if start and end differ by whole turns in all packets, so that all points of a
            packet would have the same angle. The reason is usually that `full` is in the wrong
            unit.
    """
    turn = end - start
    _refuse_whole_turns(turn, full)
    if isinstance(count, int | np.integer):
        return start + wrap(turn, full) * (steps(count) / max(int(count) - 1, 1))
    return start + wrap(turn, full) / np.maximum(count - 1, 1) * steps(count)


def steps(count: Array) -> Array:
    """Return the index of each sample of a packet: 0, 1, 2 ...

    For example, ``steps(f.count) / RATE`` gives the times of the samples.

    Args:
        count: the number of samples of each packet, as a number or a column. It has to be the
            length of the innermost array.

    Returns:
        Integers, shape (count,). If `count` is a column, its largest value in the batch is the
        length.
    """
    if hasattr(count, "steps"):
        return count.steps()
    return np.arange(int(np.max(count, initial=0)))


def wrap(a: Array, full: float) -> Array:
    """Return angles modulo a whole turn, in [0, full).

    Args:
        a: the angles.
        full: a whole turn in the unit of `a`.

    Returns:
        float64, the shape of `a`.
    """
    turned = np.mod(a, full)
    return np.where(turned >= full, 0.0, turned)


def following(a: Array, step: int = 1) -> Array:
    """Return for each value the value `step` places later in the stream.

    The later value may be in another packet. Places that only fill up a packet with fewer values
    than the longest packet are skipped.

    Returns:
        float64, the shape of `a`; nan if packets or bytes were lost between the two values, and at
        the end of the stream.
    """
    return _shift(a, step)


def previous(a: Array, step: int = 1) -> Array:
    """Return for each value the value `step` places earlier in the stream.

    The earlier value may be in another packet. Places that only fill up a packet with fewer values
    than the longest packet are skipped.

    Returns:
        float64, the shape of `a`; nan if packets or bytes were lost between the two values, and at
        the start of the stream.
    """
    return _shift(a, -step)


def last(a: Array, where: Array | None = None) -> Array:
    """Return for each value the latest value so far for which `where` is true.

    Args:
        a: the values.
        where: a condition of the shape of `a`; by default whether `a` is not nan.

    Returns:
        float64, the shape of `a`; nan before the first such value.
    """
    if hasattr(a, "latest"):
        return a.latest(where)
    if where is not None and hasattr(where, "latest"):
        return (where * 0 + a).latest(where)
    values = np.asarray(a, np.float64)
    if where is None:
        known = ~np.isnan(values)
    else:
        known = np.broadcast_to(where, values.shape)
    spots = np.maximum.accumulate(np.where(known.ravel(), np.arange(values.size), -1))
    return np.where(spots >= 0, values.ravel()[spots], np.nan).reshape(values.shape)


def between_blocks(
    azimuth: Array, ahead: Array, *, fastest: Array, repeat: bool = True, full: float = 360.0
) -> Array:
    """Return the angle that a rotor turns from each block to the next.

    A step of at least 1.25 times `fastest` results from lost packets or a masked sector. Such a
    step is invalid and is replaced by the previous valid step in the stream.

    Args:
        azimuth: the azimuth of each block, in the unit of `full`.
        ahead: the azimuth of the next block, for example ``following(azimuth)``. If consecutive
            blocks can have the same azimuth, pass the next different azimuth.
        fastest: the angle from block to block at the highest speed of the sensor, in the unit of
            `full`. Valid steps may be up to 25 % larger, because encoder readings vary.
        repeat: False to replace invalid steps by nan.
        full: a whole turn in the unit of `azimuth`.

    Returns:
        float64, the shape of `azimuth`; nan before the first valid step. Steps are measured in the
        shorter direction, so they are negative if the readings jitter.
    """
    step = ahead - azimuth
    step = step - full * np.rint(step / full)
    good = np.where(np.abs(step) < fastest * STEP_TOLERANCE, step, np.nan)
    if repeat:
        return last(good)
    return good


def stack(*columns: Array) -> Array:
    """Return columns side by side on a new innermost axis.

    k columns of shape (n, b) become one column of shape (n, b, k). Columns of different shapes are
    broadcast first.
    """
    return _apply(stack_arrays, *columns)


def stack_arrays(*arrays: Any) -> Any:
    """Do for arrays what `stack` does for columns."""
    return np.stack(np.broadcast_arrays(*arrays), axis=-1)


def running(a: Array) -> Array:
    """Return the running (cumulative) sum of values along the innermost array.

    Returns:
        float64, the shape of `a`.
    """
    if hasattr(a, "running"):
        return a.running()
    return np.cumsum(np.asarray(a, np.float64), axis=-1)


def take(table: Array, index: Array) -> Array:
    """Return the entries of a table at `index`; nan if an index is out of range.

    Args:
        table: (m,), a number for each index; or (m, k), a row for each index. A row has k numbers,
            one for each element of the innermost array.
        index: the indices.

    Returns:
        float64, the shape of `index`. For a table of rows, an index (n, 16, 1) gives a result (n,
        16, k).
    """
    entries = np.asarray(table, np.float64)
    if entries.ndim == 1:
        return _apply(TableLookup(entries), index)
    rows = np.concatenate([entries, np.full((1, entries.shape[1]), np.nan)])
    if hasattr(index, "gather"):
        return index.gather(rows)
    return rows[row_numbers(np.asarray(index), len(rows))]


def row_numbers(index: NDArray[Any], rows: int) -> NDArray[np.intp]:
    """Return the row of a table for each index, in the shape of `index`.

    An index that is out of range gives the last row, which contains nan.
    """
    return np.where((index >= 0) & (index < rows - 1), index, rows - 1).astype(np.intp)


class TableLookup:
    """Looks up entries of a table, (m,); nan for an index that is out of range."""

    def __init__(self, entries: Any) -> None:
        self.entries = entries
        self.__name__ = "take"

    def __call__(self, index: Any) -> Any:
        inside = (index >= 0) & (index < len(self.entries))
        if len(self.entries):
            entries = self.entries[np.where(inside, index, 0).astype(np.intp)]
        else:
            entries = np.zeros(np.shape(index))
        return np.where(inside, entries, np.nan)


def _refuse_whole_turns(turn: Array, full: float) -> None:
    angles = np.asarray(turn.known_values if hasattr(turn, "known_values") else turn, np.float64)
    moved = angles[angles != 0]
    if moved.size and not np.mod(moved, full).any():
        reason = (
            "spread(start, end): all points would have the same angle, because each end differs"
            f" from its start by a multiple of a revolution ({full:g})"
        )
        raise SpecError(
            f"{reason}. Pass one revolution in the unit of the angles as full=, for example 360"
            " for degrees. If the result is the index of each sample, use steps(count) instead",
            rule="LS215",
        )


def _shift(a: Array, step: int) -> Array:
    if hasattr(a, "shift"):
        return a.shift(step)
    values = np.asarray(a, np.float64)
    flat = np.full(values.size, np.nan)
    if abs(step) < values.size:
        flat[max(-step, 0) : values.size - max(step, 0)] = values.ravel()[
            max(step, 0) : values.size - max(-step, 0)
        ]
    return flat.reshape(values.shape)


def _apply(function: Callable[..., Any], *values: Array) -> Array:
    """Apply `function` to arrays; if a value is a column, the column applies it."""
    for value in values:
        if hasattr(value, "apply_function"):
            return value.apply_function(function, *values)
    return function(*(np.asarray(value) for value in values))
