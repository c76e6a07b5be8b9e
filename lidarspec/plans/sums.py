"""Sums and angles as steps of a program: what is low as one matrix product, angles reduced to half a turn before they become float32."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.tracing import Node
from lidarspec.plans.expressions import Term, chosen, split_level, terms
from lidarspec.plans.products import TURN, Angles, Product, multiplied, reduced
from lidarspec.plans.registers import Number, Read, Run, deep
from lidarspec.plans.rotations import Rotation, Turns
from lidarspec.plans.windows import possible

if TYPE_CHECKING:
    from lidarspec.plans.program import Program


class Sums:
    """The sums and angles of a program; each method adds steps to it and gives the register of their result."""

    def __init__(self, program: Program) -> None:
        self._program = program
        self._around: dict[Node, Angles | None] = {}
        self._rotations: dict[Node, Rotation | None] = {}

    def direction(self, node: Node) -> int:
        """A cosine or sine; where all points of a packet or block have the same or nearly so, it is computed once for them."""
        value, function = node.args[0], node.function
        angles = self._angles(value)
        if angles is not None and angles.all_alike:
            name = f"{function.__name__} of each block"
            return self._program.repeated(name, "single", lambda run: function(_shared_by(angles, run)))
        rotation = self._rotation(value)
        if rotation is not None:
            return self._turned(function, rotation, self._program.once(("wide", value), lambda: self._wide(rotation)))
        angle = self._program.once(("angle", value), lambda: self._angle(value))
        return self._program.call(function.__name__, "single", function, Read(angle))

    def _rotation(self, value: Node) -> Rotation | None:
        if value not in self._rotations:
            angles = self._angles(value)
            self._rotations[value] = None if angles is None else Rotation.of(angles)
        return self._rotations[value]

    def _wide(self, rotation: Rotation) -> int:
        """The angles of those packets or blocks whose points are too far apart for one rotation, within half a turn."""

        def run(execution: Run, out: NDArray[Any]) -> None:
            if rotation not in execution.prepared:
                execution.prepared[rotation] = rotation.turns(execution)
            turns: Turns = execution.prepared[rotation]
            turns.move(execution.start, execution.stop)
            if turns.some_wide:
                out.reshape(-1, rotation.inner)[turns.wide] = turns.angles()

        return self._program.step("angles of what is wide", "single", run)

    def _turned(self, function: Any, rotation: Rotation, wide: int) -> int:
        """Cosines or sines of angles that are turned a little from the one in their middle: a matrix product of series."""
        read, which = Read(wide), 0 if function is np.cos else 1

        def run(execution: Run, out: NDArray[Any]) -> None:
            turns: Turns = execution.prepared[rotation]
            rows = out.reshape(-1, rotation.inner)
            if not turns.all_wide:
                multiplied(turns.left[which], rotation.rows[which], rows)
            if turns.some_wide:
                rows[turns.wide] = function(read(execution).reshape(-1, rotation.inner)[turns.wide])

        return self._program.step(f"{function.__name__} by {len(rotation.rows[0])} products", "single", run, read)

    def _angle(self, value: Node) -> int:
        """An angle in float32, reduced to half a turn either way before it loses precision."""
        near = self._near(value)
        if near is not None:
            return near
        angle, turns = self._program.double(value), self._program.register("double")
        read = Read(angle)

        def run(execution: Run, out: NDArray[Any]) -> None:
            radians, whole = read(execution), execution.views[turns]
            np.multiply(radians, 1 / TURN, out=whole)
            np.rint(whole, out=whole)
            np.multiply(whole, TURN, out=whole)
            np.subtract(radians, whole, out=whole)
            np.copyto(out, whole, casting="same_kind")

        return self._program.step("reduce to half a turn", "single", run, read, Read(turns))

    def _near(self, value: Node) -> int | None:
        """The same for angles that lie around one of their packet or block: most of them need no reduction; None for others."""
        angles = self._angles(value)
        if angles is None:
            return None
        read = Read(self._added(angles.around.rows, place := -1 - len(self._program.steps), angles.left, self._parts(value)[1]))

        def run(execution: Run, out: NDArray[Any]) -> None:
            radians, (numbers, far) = read(execution), execution.prepared[place]
            spots = np.flatnonzero(far[_rows(execution, numbers)])
            if len(spots):
                rows = radians.reshape(-1, angles.around.inner)
                rows[spots] = reduced(rows[spots])
            np.copyto(out, radians, casting="same_kind")

        return self._program.step("reduce what is far from half a turn", "single", run, read)

    def _angles(self, value: Node) -> Angles | None:
        """Angles that lie around one of their packet or block; None where they do not, or nobody knows."""
        if value not in self._around:
            flat, full = self._parts(value)
            product, ranges = self._product(flat, full), [self._range(part) for part in full]
            more = float(sum(low for low, _ in ranges)), float(sum(high for _, high in ranges))
            found = self._around[value] = None if product is None else Angles.of(product, more)
            self._program.low += [] if found is None else found.nodes
        return self._around[value]

    def sum(self, node: Node) -> int | None:
        """A sum: one matrix product for what is low, and what is full added to it."""
        flat, full = self._parts(node)
        product = self._product(flat, full)
        if product is None:
            return None
        self._program.low += product.nodes
        return self._added(product.rows, -1 - len(self._program.steps), lambda run: (product.left(run),), full)

    def _parts(self, node: Node) -> tuple[list[Term], list[Term]]:
        parts = terms(node, self._program.width)
        return [part for part in parts if part.full is None], [part for part in parts if part.full is not None]

    def _product(self, flat: list[Term], full: list[Term]) -> Product | None:
        """What is low in a sum; None where its axes cross, or there is nothing."""
        level = split_level(flat, len(self._program.shape))
        return None if level is None or not flat or any(part.row.ndim for part in full) else Product.of(flat, self._program.shape, level)

    def _added(self, rows: NDArray[Any], place: int, left: Callable[[Run], tuple[Any, ...]], full: list[Term]) -> int:
        """A matrix product of numbers, made for the batch at its first chunk, and rows; what is full is added to it."""
        inner = rows.shape[1]

        def run(execution: Run, out: NDArray[Any]) -> None:
            if place not in execution.prepared:
                execution.prepared[place] = left(execution)
            numbers = execution.prepared[place][0]
            multiplied(numbers[:, _rows(execution, numbers)].T, rows, out.reshape(-1, inner))

        found = self._program.step(f"sum of {len(rows)} products", "double", run)
        for part in full:
            found = self._plus(found, part)
        return found

    def _plus(self, sum_: int, part: Term) -> int:
        """A sum and what is full."""
        assert part.full is not None
        factor, options = float(part.row), chosen(part.full, self._program.width)
        if options is None:
            return self._program.call("add", "double", np.add, Read(sum_), Read(self._scaled(part.full, factor)))
        condition, *values = options
        first, second = (Read(self._scaled(value, factor)) if isinstance(value, Node) else Number(value * factor) for value in values)
        self._program.low.append(condition)
        shape, depth = self._program.shape, len(self._program.shape)

        def run(execution: Run, out: NDArray[Any]) -> None:
            flags = execution.part(execution.values(condition)).astype(np.bool_)
            if flags.all() or not flags.any():
                np.add(sum_read(execution), (first if flags.any() else second)(execution), out=out)
                return
            either = (np.asarray(read(execution)) for read in (first, second))
            added = np.where(deep(flags, depth), *(array.reshape(-1, *shape) if array.ndim else array for array in either))
            np.add(sum_read(execution), added.reshape(-1), out=out)

        sum_read = Read(sum_)
        return self._program.step("add one of two", "double", run, sum_read, first, second)

    def _scaled(self, node: Node, factor: float) -> int:
        """What is full times a number, in float64; the number is part of the table where there is one."""
        found = self._program.field(node, "double", factor)
        if found is not None:
            return found
        read = Read(self._program.double(node))
        if factor == 1:
            return read.register
        return self._program.step(f"times {factor:.6g}", "double", lambda run, out: np.multiply(read(run), factor, out=out), read)

    def _range(self, part: Term) -> tuple[float, float]:
        """The least and the most of what is full in a sum; infinite where it is not known."""
        assert part.full is not None
        options = chosen(part.full, self._program.width)
        values = np.concatenate([self._every(value) for value in ((part.full,) if options is None else options[1:])])
        found = np.outer(values, part.row.reshape(-1))
        return float(found.min()), float(found.max())

    def _every(self, value: Any) -> NDArray[Any]:
        """All values that an expression of one field can have."""
        if not isinstance(value, Node):
            return np.array([value])
        values = possible(value, self._program.layout.leaves)
        return np.array([np.inf]) if values is None else values


def _rows(run: Run, numbers: NDArray[Any]) -> slice:
    """The columns of a left side that belong to the chunk: one for each packet, or several."""
    each = numbers.shape[1] // len(run.rows)
    return slice(run.start * each, run.stop * each)


def _shared_by(angles: Angles, run: Run) -> NDArray[np.float32]:
    """The angle that all points of each packet or block have."""
    if angles not in run.prepared:
        run.prepared[angles] = angles.left(run)[0][0].astype(np.float32)
    found: NDArray[np.float32] = run.prepared[angles]
    return found
