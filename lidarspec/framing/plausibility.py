"""Check many candidates at once by constants, checksums and plausibility.

Each check is applied to the candidates that have passed the previous checks.

The `plausible` function of a frame type is traced once, and split into conditions at its "and"
operators. A condition on one or two adjacent bytes becomes a lookup table. A function that cannot
be traced is called with the columns of the candidates.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.expressions.columns import Batch, Fields
from lidarspec.expressions.graph import (
    Expression,
    TracedColumn,
    evaluate_expressions,
    make_sample,
    split_condition,
    trace,
)
from lidarspec.frames.arrays import take_rows
from lidarspec.frames.frame_table import CompiledTable, LayoutRows, Table
from lidarspec.frames.layout import (
    Bytes2D,
    FrameChecksum,
    FrameTest,
    Layout,
    Leaf,
    Sums,
    find_passing,
    gather_rows,
    match_constants,
    merge_constants,
    sort_constants,
    view_elements,
)
from lidarspec.frames.parts import Region
from lidarspec.frames.schema import Schema
from lidarspec.framing.results import CHECKSUM, CONSTANT, IMPLAUSIBLE, LENGTH, PLUGIN, VALID
from lidarspec.spec.description import Frame
from lidarspec.spec.tree import FieldInfo

#: The maximum number of allowed values that bits are compared with. If more values are allowed, a
#: table is used.
MAX_COMPARED_VALUES = 2

#: The status of a frame for each status of its parts: `parts.FOUND`, `CUT_OFF`, `LENGTH`,
#: `CONSTANT`, `FAILED`.
STATUS_BY_PARTS = np.array([VALID, LENGTH, LENGTH, CONSTANT, PLUGIN], np.uint8)

#: A condition for the frames of one layout: a function that returns whether each frame, given as a
#: row of bytes, meets the condition.
Check = Callable[[Bytes2D], NDArray[np.bool_]]


class CandidateChecker:
    """Checks candidates of one layout.

    Args:
        prefix: the constants that the search has already compared, as (mask, value) by offset.
        struct_checks: the conditions of the struct on the values of its fields.
        plausibility_checks: the conditions of the plausibility function; None if the function has
            to be called.

    Attributes:
        checks: all conditions that can be checked without calling the plausibility function.
        is_complete: whether `checks` contains all conditions of the plausibility function, so that
            the function need not be called.
    """

    def __init__(
        self,
        frame: Frame,
        schema: Schema,
        layout: Layout,
        prefix: Mapping[int, tuple[int, int]],
        struct_checks: list[Check],
        plausibility_checks: list[Check] | None,
    ) -> None:
        self._frame = frame
        self._schema = schema
        self._layout = layout
        self._struct_checks = struct_checks
        self._plausibility_checks = plausibility_checks
        self.checks = [*struct_checks, *(plausibility_checks or ())]
        self.is_complete = plausibility_checks is not None or frame.plausible is None
        self._constants = merge_constants(
            sort_constants(
                {
                    offset: bits
                    for offset, bits in layout.constants.items()
                    if prefix.get(offset) != bits
                }
            )
        )
        self._held = merge_constants(sort_constants(layout.held))

    def __call__(
        self, rows: Bytes2D, errors: list[PluginError], sums: Sums | None = None
    ) -> NDArray[np.uint8]:
        """Return the status of each candidate, (n,).

        Args:
            rows: the complete candidates, (n, size).
            errors: the list to which errors of the plugin are added.
        """
        status = np.zeros(len(rows), np.uint8)
        self.check_constants(status, rows)
        _check_valid_parts(self._layout, status, rows, errors, sums)
        for checksum in self._layout.checksums:
            _check_valid(status, rows, functools.partial(check_checksum, checksum, errors, sums))
        if np.count_nonzero(status) == len(status):
            return status
        self._check(status, rows, self._struct_checks)
        if self._plausibility_checks is not None:
            self._check(status, rows, self._plausibility_checks)
        elif self._frame.plausible is not None:
            _check_valid(status, rows, lambda some: self._call_plausible(some, errors))
        return status

    def check_constants(self, status: NDArray[np.uint8], rows: Bytes2D) -> None:
        """Set the status of candidates that have a wrong constant or a wrong length.

        Args:
            status: the status of each candidate, `VALID` before the call.
        """
        held = match_constants(self._constants, rows) if len(rows) else None
        if held is not None:
            status[~held] = CONSTANT
        held = match_constants(self._held, rows) if len(rows) else None
        if held is not None:
            status[~held & (status == VALID)] = LENGTH

    def _check(self, status: NDArray[np.uint8], rows: Bytes2D, checks: list[Check]) -> None:
        for check in checks:
            held = check(rows)
            if np.count_nonzero(held) < len(held):
                status[~held & (status == VALID)] = IMPLAUSIBLE

    def _call_plausible(self, rows: Bytes2D, errors: list[PluginError]) -> NDArray[np.uint8]:
        return check_plausibility(
            self._frame,
            CompiledTable(self._schema, [LayoutRows(self._layout, np.arange(len(rows)), rows)]),
            errors,
        )


def _check_valid(
    status: NDArray[np.uint8], rows: Bytes2D, check: Callable[[Bytes2D], NDArray[np.uint8]]
) -> None:
    """Check the candidates that are valid so far, and set their status."""
    if not np.count_nonzero(status):
        status[:] = check(rows)
        return
    left = np.flatnonzero(status == VALID)
    if len(left):
        status[left] = check(take_rows(rows, left))


def _check_valid_parts(
    layout: Layout,
    status: NDArray[np.uint8],
    rows: Bytes2D,
    errors: list[PluginError],
    sums: Sums | None,
) -> None:
    """Check the parts of the valid candidates, and set the status of these candidates."""
    for region in layout.regions.values():
        if not region.is_measured or region.has_checks:
            _check_valid(status, rows, functools.partial(_check_parts, region, errors, sums))


def _check_parts(
    region: Region, errors: list[PluginError], sums: Sums | None, rows: Bytes2D
) -> NDArray[np.uint8]:
    """Check the parts of each frame, and return the status of each frame, (n,)."""
    buffer, walked = region.find_parts(rows)
    status = STATUS_BY_PARTS[walked.status]
    errors += walked.errors
    for piece in (piece for pieces in walked.rounds for piece in pieces):
        parts = gather_rows(buffer, piece.offsets, piece.layout.size)
        verdicts = np.zeros(len(parts), np.uint8)
        _check_valid_parts(piece.layout, verdicts, parts, errors, sums)
        for checksum in piece.layout.checksums:
            _check_valid(verdicts, parts, functools.partial(check_checksum, checksum, errors, sums))
        if piece.layout.conditions:
            verdicts[(verdicts == VALID) & ~piece.layout.meet_conditions(parts)] = IMPLAUSIBLE
        bad = (verdicts != VALID) & (status[piece.owners] == VALID)
        status[piece.owners[bad]] = verdicts[bad]
    return status


def check_checksum(
    checksum: FrameChecksum, errors: list[PluginError], sums: Sums | None, rows: Bytes2D
) -> NDArray[np.uint8]:
    """Check one checksum of each frame, and return the status of each frame, (n,).

    The status is `VALID`, `CHECKSUM` if the checksum is wrong, or `PLUGIN` if the plugin failed.
    """
    try:
        wrong = ~checksum.are_valid(rows, sums)
        return np.multiply(wrong.view(np.uint8), np.uint8(CHECKSUM))
    except Exception as error:
        errors.append(PluginError.of(error, "checksum"))
        return np.full(len(rows), PLUGIN, np.uint8)


def check_plausibility(frame: Frame, table: Table, errors: list[PluginError]) -> NDArray[np.uint8]:
    """Call `plausible` for frames, and return the status of each frame, (n,).

    The status is `VALID`, `IMPLAUSIBLE`, or `PLUGIN` if the function failed.

    Args:
        table: the frames. They must have one layout, because arrays of different lengths would be
            padded, and the function would see the padding.
    """
    assert frame.plausible is not None
    batch = Batch(table, np.zeros(len(table), np.bool_))
    try:
        with np.errstate(all="ignore"):
            answer = frame.plausible(Fields(batch))
        if np.ndim(answer):
            array = np.broadcast_to(np.asarray(answer), (len(table), *np.shape(answer)[1:]))
        else:
            array = np.full(len(table), answer)
        holds = array.reshape(len(array), math.prod(array.shape[1:])).astype(np.bool_).all(axis=1)
        return np.where(holds, VALID, IMPLAUSIBLE).astype(np.uint8)
    except Exception as error:
        errors.append(PluginError.of(error, "plausible", function=frame.plausible))
        return np.full(len(table), PLUGIN, np.uint8)


class StructConditions:
    """The conditions of a frame type, from its plausibility function and its struct.

    Args:
        plausible: the plausibility function, see `Frame`; None without one.
        layout: any layout of the frame, used to trace the function.
    """

    def __init__(
        self, plausible: Callable[[Any], Any] | None, schema: Schema, layout: Layout
    ) -> None:
        self._conditions = [] if plausible is None else _trace_conditions(plausible, schema, layout)
        self._tables: dict[tuple[Any, ...], _LookupTable] = {}

    def make_struct_conditions(self, layout: Layout) -> list[Check]:
        """Return the checks for the conditions of the struct, for frames of one layout."""
        every = (
            (
                condition,
                {
                    info.path: leaf
                    for info in condition.fields
                    if (leaf := layout.leaves.get(info.path))
                },
            )
            for condition in layout.conditions
        )
        return [self._check(condition, leaves) for condition, leaves in every]

    def make_checks(self, layout: Layout) -> list[Check] | None:
        """Return the checks that replace the plausibility function, for one layout.

        Returns None if the function has to be called.
        """
        if self._conditions is None:
            return None
        leaves = [
            {info.path: leaf for info in part.fields if (leaf := layout.leaves.get(info.path))}
            for part in self._conditions
        ]
        if any(
            part.fields[0].axes and all(0 in leaf.shape for leaf in own.values())
            for part, own in zip(self._conditions, leaves, strict=True)
        ):
            # a test on an empty array holds, and so does any combination with it
            return []
        checks = list[Check]()
        together = list[Expression]()
        for part, own in zip(self._conditions, leaves, strict=True):
            check = self._check(part, own)
            if isinstance(check, LookupCondition) or part.fields[0].axes:
                checks.append(check)
            else:
                together.append(part)
        if together:
            every = ConditionGroup(tuple(together))
            own = {path: leaf for part in leaves for path, leaf in part.items()}
            checks.append(functools.partial(find_passing, every, own))
        return checks

    def _check(self, part: FrameTest, leaves: Mapping[str, Leaf]) -> Check:
        places = {(leaf.shape, leaf.strides) for leaf in leaves.values()}
        first, last = _find_window(leaves.values())
        if (
            last - first > 2
            or any(leaf.info.kind == "bytes" for leaf in leaves.values())
            or len(places) > 1
            or any(len(shape) != len(strides) for shape, strides in places)
        ):
            return functools.partial(find_passing, part, leaves)  # too many bytes for a table
        key = (
            part,
            *(
                (path, leaf.offset - first, leaf.wire, leaf.elements)
                for path, leaf in leaves.items()
            ),
        )
        if key not in self._tables:
            single = {
                path: replace(leaf.shift(first), shape=(), strides=())
                for path, leaf in leaves.items()
            }
            self._tables[key] = _make_table(part, single, last - first)
        shape, strides = places.pop() if places else ((), ())
        return LookupCondition(self._tables[key], first, shape, strides)


@dataclass(frozen=True, eq=False)
class ConditionGroup:
    """Conditions on fields outside of arrays; common subexpressions are computed once."""

    parts: tuple[Expression, ...]

    @functools.cached_property
    def fields(self) -> tuple[FieldInfo, ...]:
        """The fields in the conditions, each once."""
        every = {info.path: info for part in self.parts for info in part.fields}
        return tuple(every.values())

    def values(self, raw: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
        """Return whether all conditions are true for each frame; see `Expression.values`."""
        return functools.reduce(np.bitwise_and, evaluate_expressions(self.parts, raw))


@dataclass(frozen=True, eq=False)
class _LookupTable:
    """The values of one or two bytes for which a condition is true.

    Two bytes are read as one integer.

    Attributes:
        limits: the first and the last allowed value, if all values between them are allowed;
            else None.
        bits: a mask, and the one or two allowed values of the masked bits; else None.
        listed: for each value, whether it is allowed.
    """

    dtype: np.dtype[Any]
    limits: tuple[int, int] | None
    listed: NDArray[np.bool_]
    bits: tuple[int, tuple[int, ...]] | None = None

    def holds(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        """Return whether the condition is true for each of the values."""
        if self.limits is not None:
            low, high = map(values.dtype.type, self.limits)
            # Values below the limits wrap to large values.
            return np.asarray(values - low <= high - low if low else values <= high)
        if self.bits is not None:
            mask, allowed = self.bits
            left = values & values.dtype.type(mask)
            held = left == allowed[0]
            for value in allowed[1:]:
                held |= left == value
            return np.asarray(held)
        if values.itemsize > 1:
            return self.listed.take(values)
        return np.frombuffer(values.tobytes().translate(self.listed.tobytes()), np.bool_).reshape(
            values.shape
        )


@dataclass(frozen=True, eq=False)
class LookupCondition:
    """A condition on one or two bytes, which is evaluated by a table lookup.

    Attributes:
        offset: the offset of the first byte.
        shape: the lengths of the arrays that contain the bytes.
        strides: the strides of these arrays.
    """

    table: _LookupTable
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def __call__(self, rows: Bytes2D) -> NDArray[np.bool_]:
        """Return whether the condition is true in each frame, (n,)."""
        if not len(rows):
            return np.empty(0, np.bool_)
        held = self._test_elements(rows)
        if not self.shape:
            return held
        if held.all():
            return np.ones(len(held), np.bool_)
        return np.asarray(held.all(axis=tuple(range(1, held.ndim))))

    def holds_within(self, rows: Bytes2D, lengths: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return whether the condition is true in each frame, (n,).

        Args:
            rows: the frames, (n, size), padded to one size.
            lengths: the length of the outermost array in each frame, (n,).
        """
        held = self._test_elements(rows)
        if not self.shape:
            return held
        held = np.asarray(held.reshape(*held.shape[:2], math.prod(held.shape[2:])).all(axis=2))
        held |= np.arange(held.shape[1]) >= lengths[:, None]
        return np.asarray(held.all(axis=1))

    def _test_elements(self, rows: Bytes2D) -> NDArray[np.bool_]:
        """Return whether the condition is true for each element, (n, *shape)."""
        view = view_elements(rows, self.table.dtype, self.offset, self.shape, self.strides)
        if view.itemsize == 1:
            values = view
        else:
            values = view.astype(self.table.dtype.newbyteorder("="))
        return self.table.holds(values)


def _make_table(part: FrameTest, leaves: Mapping[str, Leaf], size: int) -> _LookupTable:
    """Return the table of a condition on one or two bytes."""
    for dtype in map(np.dtype, ("<u2", ">u2") if size == 2 else ("u1",)):
        # The blocks keep the memory small.
        blocks = np.split(np.arange(1 << 8 * dtype.itemsize, dtype=dtype), 16)
        listed = np.concatenate(
            [
                find_passing(part, leaves, codes.view(np.uint8).reshape(len(codes), -1))
                for codes in blocks
            ]
        )
        true = np.flatnonzero(listed)
        if len(true) and true[-1] - true[0] == len(true) - 1:
            return _LookupTable(dtype, (int(true[0]), int(true[-1])), listed)
    return _LookupTable(dtype, None, listed, _find_bits(listed))


def _find_bits(listed: NDArray[np.bool_]) -> tuple[int, tuple[int, ...]] | None:
    """Return the bits on which a condition depends, and the values that make it true.

    Returns:
        A mask of the bits, and the values of the masked bits that make the condition true. None if
        there are no such values, or more than `MAX_COMPARED_VALUES`.
    """
    values = np.arange(len(listed))
    mask = sum(
        bit
        for bit in map(int, 1 << np.arange(16))
        if bit < len(listed) and (listed != listed[values ^ bit]).any()
    )
    allowed = np.unique(values[listed] & mask).tolist()
    if 0 < len(allowed) <= MAX_COMPARED_VALUES:
        return (mask, tuple(allowed))
    return None


def _find_window(leaves: Iterable[Leaf]) -> tuple[int, int]:
    """Return the start and the end of the byte range that contains the fields."""
    spans = [leaf.byte_span for leaf in leaves]
    if spans:
        return (min(start for start, _ in spans), max(stop for _, stop in spans))
    return (0, 0)


def _trace_conditions(
    plausible: Callable[[Any], Any], schema: Schema, layout: Layout
) -> list[Expression] | None:
    blank = LayoutRows(layout, np.zeros(1, np.intp), np.zeros((1, layout.size), np.uint8))
    try:
        answer, _ = trace(
            plausible,
            make_sample(Batch(CompiledTable(schema, [blank]), np.zeros(1, np.bool_)), blank),
        )
        if not isinstance(answer, TracedColumn):
            return None
        return [Expression.of(node, schema) for node in split_condition(answer.node)]
    except Exception:  # calling the function reports the error for each frame
        return None
