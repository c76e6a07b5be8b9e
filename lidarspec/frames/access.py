"""The fields of a batch by attribute: what a `points` or `plausible` function is given as ``f``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError, UnknownField

if TYPE_CHECKING:  # plugins import Fields for their annotations, and that should cost little
    from lidarspec.frames.columns import Batch, Column
    from lidarspec.frames.schema import FieldInfo, Schema
    from lidarspec.frames.tables import Table


def field_column(info: FieldInfo, table: Table, depth: int, batch: Batch, which: NDArray[np.intp] | None = None) -> Column:
    """A field in its unit as a column of `depth` array axes; `which`: the frame of the table for each packet."""
    from lidarspec.frames.columns import Column

    array = field_array(info, table, depth)
    if which is not None:
        array = array[which]
    axes = [_axis(name, length, table, known=which is None) for name, length in zip(info.axes, array.shape[1:], strict=False)]
    return Column(array, (*axes, *(None,) * (array.ndim - 1 - len(axes))), batch, source=info.path)


def field_array(info: FieldInfo, table: Table, depth: int) -> NDArray[np.float64]:
    """A field in its unit, with `depth` array axes at least."""
    array = physical(info, table)
    return array.reshape(*array.shape, *(1,) * (depth + 1 - array.ndim))


def _axis(name: str, length: int, table: Table, *, known: bool) -> str | None:
    """The name of an axis; of length 1 it needs none, unless packets of the batch have no element at all."""
    if length != 1 or (known and not isinstance(table.schema.arrays.get(name), int) and not table.counts(name).all()):
        return name
    return None


def physical(info: FieldInfo, table: Table) -> NDArray[np.float64]:
    """A field in its unit: float64, shape (n, *lengths); nan where a frame lacks the field."""
    with np.errstate(invalid="ignore"):  # a signalling nan is a nan
        array = table.raw(info.path).astype(np.float64)
    if info.scaled:
        array *= info.scale
        array += info.offset
    there = table.present(info.path)
    if there is not None:
        array = np.where(there.reshape(*there.shape, *(1,) * (array.ndim - there.ndim)), array, np.nan)
    return array


class Fields:
    """The fields of a batch of packets by attribute, as `Column`s: ``f.points.distance``, ``f.state.difop.vertical``."""

    def __init__(self, batch: Batch, schema: Schema | None = None, prefix: str = "") -> None:
        self._batch, self._schema, self._prefix = batch, schema or batch.table.schema, prefix

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name == "state" and not self._prefix:
            return _States(self._batch)
        path = f"{self._prefix}{name}"
        info = self._schema.fields.get(path)
        if info is not None:
            return field_column(info, self._batch.table, self._schema.depth(), self._batch)
        if any(known.startswith(f"{path}.") for known in self._schema.fields):
            return Fields(self._batch, self._schema, f"{path}.")
        raise UnknownField(path, self._schema.fields)


#: among the paths of `Watched`: something else than fields was looked at.
UNKNOWN = ""


class Watched(Fields):
    """`Fields` that keep the paths of the fields that were looked at in `seen`."""

    def __init__(self, batch: Batch, seen: set[str], schema: Schema | None = None, prefix: str = "") -> None:
        super().__init__(batch, schema, prefix)
        self._seen = seen

    def __getattr__(self, name: str) -> Any:
        found = super().__getattr__(name)
        if isinstance(found, Fields):
            return Watched(self._batch, self._seen, self._schema, f"{self._prefix}{name}.")
        path = f"{self._prefix}{name}"
        self._seen.add(path if path in self._schema.fields else UNKNOWN)
        return found


class _States:
    """``f.state``: the frames of other types that were last before each packet."""

    def __init__(self, batch: Batch) -> None:
        self._batch = batch

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name not in self._batch.state:
            raise UnknownField(name, self._batch.state, place="state")
        return _State(self._batch, name, "")


class _State:
    """``f.state.difop``: the fields of one other frame type, or their declared defaults."""

    def __init__(self, batch: Batch, frame: str, prefix: str) -> None:
        self._batch, self._frame, self._prefix = batch, frame, prefix

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        path = f"{self._prefix}{name}"
        table, which = self._batch.state[self._frame]
        defaults = self._batch.defaults.get(self._frame, {})
        known = set(defaults) | (set(table.schema.fields) if table is not None else set())
        if path in known:
            return self._column(path, table, which, defaults)
        if any(other.startswith(f"{path}.") for other in known):
            return _State(self._batch, self._frame, f"{path}.")
        raise UnknownField(path, known, place=f"state.{self._frame}")

    def _column(self, path: str, table: Table | None, which: NDArray[np.intp], defaults: Mapping[str, Any]) -> Column:
        from lidarspec.frames.columns import Column

        batch, depth = self._batch, self._batch.table.schema.depth()
        missing = which < 0
        if not missing.any() and table is not None:
            same = len(which) == 0 or int(which.min()) == int(which.max())
            return field_column(table.schema.fields[path], table, depth, batch, which[:1] if same else which)
        if path not in defaults:
            raise SpecError(f"no {self._frame} frame has arrived yet, and no default is declared", path=f"state.{self._frame}.{path}")
        batch.nominal = True
        default = np.asarray(defaults[path], np.float64)
        names = tuple(path if length != 1 else None for length in default.shape)
        spare = (1,) * max(depth - default.ndim, 0)
        array = default.reshape(1, *default.shape, *spare)
        if table is not None and not missing.all():
            known = field_column(table.schema.fields[path], table, depth, batch, np.maximum(which, 0)).array
            array = np.where(missing.reshape(-1, *(1,) * (known.ndim - 1)), array, known)
        return Column(array, (*names, *(None,) * len(spare)), batch)
