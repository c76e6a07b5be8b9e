"""The sensor's own clock: read from packets as integer nanoseconds, and made to run on where it starts again."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.columns import Batch, Fields
from lidarspec.columns.graph import Node, Untraceable, evaluate, fields_beside, sample_of, trace
from lidarspec.errors import SpecError
from lidarspec.spec.description import Spec
from lidarspec.spec.fields import factor
from lidarspec.spec.tree import FieldInfo, exact
from lidarspec.wire.arrays import alike
from lidarspec.wire.frame_table import Rows, Table
from lidarspec.wire.schema import Schema

Times = NDArray[np.int64]

#: no clock reads more nanoseconds than this (285 years): damaged readings must not overflow.
_FURTHEST = 9 * 10**18
#: readings of a term of a clock that are remembered.
_REMEMBERED = 64


class Unwrapper:
    """A clock that starts again at `wraps_at` seconds, made to run on; exact over any number of wraps.

    The shorter way round decides between forward and backward, so late packets go back in time. Where the host's
    times say that more than most of a turn has passed, they decide how many turns it was.
    """

    def __init__(self, wraps_at: float | None) -> None:
        self._turn = _turn(wraps_at) if wraps_at else 0
        self._last: tuple[int, int, int] | None = None

    def push(self, ns: Times, host: Times) -> Times:
        """The readings of the next packets, (n,), as times that run on from those before."""
        if not self._turn or not len(ns):
            return ns
        raw, time, at = self._last or (int(ns[0]), int(ns[0]), int(host[0]))
        half = self._turn // 2
        steps = _steps(ns, raw)
        over = np.flatnonzero((steps < -half) | (steps >= self._turn - half))
        if not len(over) and alike(host) == 0:
            times = ns if time == raw else ns + (time - raw)
            self._last = (ns.item(-1), times.item(-1), 0)
            return times
        if len(over):
            steps[over] = (steps[over] + half) % self._turn - half
        if self._turn >= 10**9 and int(host.max()) - min(int(host.min()), at or int(host.max())) > self._turn * 3 // 4:
            before = np.concatenate([[at], host[:-1]])
            passed = np.where((host > 0) & (before > 0), host - before, 0)
            late = passed > self._turn * 3 // 4
            if late.any():
                steps += np.where(late, (passed - steps + half) // self._turn, 0) * self._turn
        steps[0] += time
        times = np.cumsum(steps)
        self._last = (int(ns[-1]), int(times[-1]), int(host[-1]))
        return times


def clock_ns(sensor: Spec, batch: Batch) -> Times:
    """The sensor's own clock in each packet, (n,) int64 nanoseconds, as it stands on the wire."""
    assert sensor.clock is not None
    source = sensor.clock.source
    if callable(source):
        known = _reading(source, batch.table.schema)(batch)
        if known is not None:
            return known
        terms = source(Fields(batch))
        columns = terms if isinstance(terms, tuple | list) else (terms,)
        return sum((_nanoseconds(np.asarray(column), len(batch)) for column in columns), np.zeros(len(batch), np.int64))
    total: Times | None = None
    for path, step, zero, furthest in _terms((source,) if isinstance(source, str) else tuple(source), batch.table.schema, sensor.id):
        raw = batch.table.raw(path)
        if furthest and raw.dtype.kind in "ui":
            part = _within(raw, furthest)
            part *= step
            if zero:
                part += zero
        else:
            part = _nanoseconds(raw.astype(np.float64) * float(step / 10**9) + float(zero / 10**9), len(batch))
        total = part if total is None else np.add(total, part, out=total)
    return np.zeros(len(batch), np.int64) if total is None else total


@lru_cache(maxsize=256)
def _turn(seconds: float) -> int:
    """So many seconds in nanoseconds, as the number is written."""
    return int(exact(seconds) * 10**9)


class _Reading:
    """A function of header fields that gives a clock, taken apart: each term is computed again only where its fields change.

    Most of a clock is a date, which is the same in thousands of packets, and takes dozens of operations to read.
    """

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._function = function
        self._terms: list[_Term] | None = None
        self._is_tried = False

    def __call__(self, batch: Batch) -> Times | None:
        """The clock in each packet, (n,); None where only the function itself can tell."""
        table = batch.table
        if not self._is_tried and isinstance(table, Rows):
            self._is_tried, self._terms = True, self._apart(batch, table)
        if self._terms is None:
            return None
        total = np.zeros(len(table), np.int64)
        for term in self._terms:
            total += term(table)
        return total

    def _apart(self, batch: Batch, table: Rows) -> list[_Term] | None:
        try:
            traced, _ = trace(self._function, sample_of(batch, table.groups[0]))
            terms = traced if isinstance(traced, tuple | list) else (traced,)
            return [_Term(term.node, fields_beside(term.node, table.schema)) for term in terms]
        except Exception:  # the function itself says so, if anything is wrong
            return None


class _Term:
    """A part of a clock, and the fields that it depends on.

    Raises:
        Untraceable: if these are no plain fields of the header.
    """

    def __init__(self, node: Node, fields: tuple[FieldInfo, ...]) -> None:
        if any(info.axes or info.optional for info in fields):
            raise Untraceable("not every packet has the fields of a clock once")
        self._node, self._fields = node, fields
        self._known: dict[tuple[Any, ...], Times] = {}

    def __call__(self, table: Table) -> Times:
        """Its nanoseconds, (n,) or (1,)."""
        columns = [table.raw(info.path) for info in self._fields]
        if self._node.kind == "field":
            return self._computed(columns)
        changes = np.zeros(len(table), np.bool_)
        for column in columns:
            changes[1:] |= column[1:] != column[:-1]
        starts = np.flatnonzero(changes)
        if not len(starts):
            return self._once([column[:1] for column in columns])
        if 2 * len(starts) > len(table):
            return self._computed(columns)
        starts = np.concatenate([[0], starts])
        values = self._computed([column[starts] for column in columns])
        return np.repeat(values, np.diff(starts, append=len(table)))

    def _once(self, columns: list[NDArray[Any]]) -> Times:
        """Its nanoseconds in one packet, (1,), which a later one with equal readings shares."""
        key = tuple(column.item(0) for column in columns)
        found = self._known.get(key)
        if found is None:
            found = self._computed(columns)
            if len(self._known) >= _REMEMBERED:
                self._known.clear()
            self._known[key] = found
        return found

    def _computed(self, columns: list[NDArray[Any]]) -> Times:
        found = {}
        for info, column in zip(self._fields, columns, strict=True):
            found[info.path] = info.physical(column.astype(np.float64))
        return _nanoseconds(evaluate(self._node, {}, lambda node: found.get(node.path)), len(columns[0]))


@lru_cache(maxsize=256)
def _reading(function: Callable[[Any], Any], schema: Schema) -> _Reading:
    return _Reading(function)


@lru_cache(maxsize=256)
def _terms(paths: tuple[str, ...], schema: Schema, sensor: str) -> list[tuple[str, Any, Any, int]]:
    """The fields that add up to a clock: path, nanoseconds in one step and at zero, furthest reading (0 where these are fractions)."""
    found = []
    for path in paths:
        info = schema.fields.get(path)
        scaling = _scaling(info.unit, info.scale, info.offset) if info else None
        if info is None or scaling is None or info.axes:
            raise SpecError("a clock is a field of the header with a unit of time", path=path, sensor=sensor)
        step, zero = scaling
        whole = isinstance(step, int) and isinstance(zero, int)
        found.append((path, step, zero, _FURTHEST // len(paths) // max(step, 1) if whole else 0))
    return found


def _scaling(unit: str, scale: float, offset: float) -> tuple[Any, Any] | None:
    """Nanoseconds in one step of a field and at its zero: integers where both are whole, else fractions; None if it is no time."""
    per_unit = factor(unit, "s")
    if per_unit is None:
        return None
    step, zero = (exact(part) * per_unit * 10**9 for part in (scale, offset))
    if step.denominator == 1 and zero.denominator == 1 and step < 2**62:
        return int(step), int(zero)
    return step, zero


def _steps(values: NDArray[np.int64], before: int) -> NDArray[np.int64]:
    """Differences from one to the next, (n,), the first one to `before`."""
    steps = np.empty(len(values), np.int64)
    steps[0] = values[0] - before
    np.subtract(values[1:], values[:-1], out=steps[1:])
    return steps


def _within(raw: NDArray[Any], furthest: int) -> Times:
    if raw.dtype.itemsize * 8 - (raw.dtype.kind == "i") < furthest.bit_length():
        return raw.astype(np.int64)
    if len(raw) and int(raw.max()) <= furthest and (raw.dtype.kind == "u" or int(raw.min()) >= -furthest):
        return raw.astype(np.int64)
    edges = np.iinfo(raw.dtype)
    return np.asarray(np.clip(raw, max(int(edges.min), -furthest), min(int(edges.max), furthest)), np.int64)


def _nanoseconds(seconds: Any, number: int) -> Times:
    flat = np.broadcast_to(np.asarray(seconds, np.float64).reshape(-1), (number,)) if np.size(seconds) in (1, number) else None
    if flat is None:
        raise SpecError("a clock gives one time for each packet")
    return np.rint(np.clip(np.nan_to_num(flat), -9e9, 9e9) * 1e9).astype(np.int64)
