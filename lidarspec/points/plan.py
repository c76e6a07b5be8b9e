"""The plan of a sensor's points: `points` traced once for a layout, and programs for the columns that are asked for.

`Plan` knows how points become coordinates (DESIGN 3.1) and hands the arithmetic to `Program`. Plans are kept with the
layout that they are for, so a stream of packets traces nothing again.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.columns import Batch, aligned
from lidarspec.columns.graph import Node, Term, Traced, Untraceable, chosen, is_full, only_field, terms, trace
from lidarspec.points.numba_kernels.kernels import Kernel, available
from lidarspec.points.numba_kernels.source import written
from lidarspec.points.numba_kernels.writer import is_number
from lidarspec.points.numpy_plan.program import Program
from lidarspec.points.numpy_plan.windows import possible
from lidarspec.points.plain import columns_of
from lidarspec.spec.results import Polar
from lidarspec.wire.frame_table import Group, Rows
from lidarspec.wire.layout import Layout

PointsFunction = Callable[[Any], Any]

#: points of a job that earn loading Numba with a kernel compiled before, and with one to be compiled; about a second's worth each.
WARM, COLD = 1 << 26, 1 << 28
#: a count that nothing brings up to them.
NEVER = -(1 << 62)


class Plan:
    """How the points of frames of one layout are made.

    Attributes:
        tape: what `points` computes.
        shape: of the points of a packet, one length for each axis in `axes`.
        result: what `points` returned, traced.
        kernels: those that were asked for, by the names of their columns.

    Raises:
        Untraceable: where only plain evaluation can do it; the text says why.
    """

    def __init__(self, function: PointsFunction, sample: Batch, layout: Layout) -> None:
        result, self.tape = trace(function, sample)
        for node in self.tape.nodes:
            if node.kind == "field" and sample.table.schema.fields[node.path].kind == "float":
                raise Untraceable(f"{node.path} is a floating-point field, which may hold any number")
        if not isinstance(result, Polar):
            raise Untraceable(f"{type(result).__name__} points are evaluated plainly")
        self.result, self.layout = result, layout
        parts = {f.name: getattr(result, f.name) for f in dataclasses.fields(result) if f.name not in ("nominal", "origin")}
        parts |= dict(zip(("ox", "oy", "oz"), result.origin, strict=True))
        samples = {name: _sample(value) for name, value in parts.items()}
        columns = columns_of(
            dataclasses.replace(result, **{n: samples[n] for n in samples if n[0] != "o"}, origin=tuple(samples[f"o{a}"] for a in "xyz")),
            sample,
        )
        arrays, self.axes, _ = aligned(tuple(columns.values()), sample)
        self.shape = np.broadcast_shapes((2,) + (1,) * len(self.axes), *(array.shape for array in arrays))[1:]
        self.parts = {name: value.node if isinstance(value, Traced) else value for name, value in parts.items() if value is not None}
        self._programs: dict[tuple[str, ...], Program] = {}
        self.kernels: dict[tuple[str, ...], Kernel] = {}
        self._own: bool | None = None
        self._varying = {name for name, count in sample.table.schema.arrays.items() if not isinstance(count, int)}
        if 0 in self.shape:
            raise Untraceable("packets without points")
        if not isinstance(result.range, Traced) or not is_full(result.range.node, self.width):
            raise Untraceable("not every point has a range of its own")
        self._expressions = self._coordinates()

    @cached_property
    def width(self) -> int:
        """Points of a packet."""
        return int(np.prod(self.shape, dtype=np.intp))

    @cached_property
    def level(self) -> bool:
        """Whether all points lie in the horizontal plane through the sensor."""
        return all(_is_zero(value) for value in (self.result.elevation, self.result.origin[2]))

    @cached_property
    def eager(self) -> list[Node]:
        """What has to be computed for every batch: whatever remembers something between batches, and what that needs."""
        wanted = {node.number for node in self.tape.nodes if node.kind in ("shift", "latest", "state")}
        wanted |= {node.number for node, _ in self.tape.steps} | {node.number for node in self.positive}
        for node in reversed(self.tape.nodes):
            if node.number in wanted:
                wanted |= {arg.number for arg in node.args if isinstance(arg, Node)}
        return [node for node in self.tape.nodes if node.number in wanted]

    def program(self, names: tuple[str, ...], tables: dict[Any, NDArray[Any]]) -> Program:
        """The program for these columns."""
        if names not in self._programs:
            made = Program(self.layout, self.shape, tables)
            for name in names:
                made.want(name, self._expressions[name], "double" if name == "azimuth" else "single")
            self._programs[names] = made
        return self._programs[names]

    def kernel(self, names: tuple[str, ...], function: PointsFunction) -> Kernel:
        """The kernel for these columns; one for this layout alone, or one that serves all where there have been several."""
        if names not in self.kernels:
            if self._own is None:
                self._own = not self._varying or _OWN.setdefault(function, self.layout.size) == self.layout.size
            tables, varying = tables_of(function), set[str]() if self._own else self._varying
            origin = [self.parts[f"o{axis}"] for axis in "xyz"]
            known = all(is_number(value, self.layout.leaves) for value in (*self._directed, *origin))
            wanted = {name: self._expressions[name] for name in names}
            text = written(self.layout, self.shape, wanted, tables, varying, together=not known)
            self.kernels[names] = Kernel(text, self.width)
        return self.kernels[names]

    def describe(self) -> list[str]:
        """The plan in lines: the shape, what is computed for each packet, and the calls for each chunk."""
        names = tuple(name for name in ("x", "y", "z", "intensity") if name in self._expressions and not (name == "z" and self.level))
        program = Program(self.layout, self.shape, tables := dict[Any, NDArray[Any]]())
        for name in names:
            program.want(name, self._expressions[name], "single")
        axes = " x ".join(f"{axis} {length}" for axis, length in zip(self.axes, self.shape, strict=True))
        lines = [f"{self.width} points a packet{': ' if axes else ''}{axes}"]
        plainly = [node for node in self.tape.nodes if node in program.low or node in self.eager]
        lines.append(f"for each packet or block, plainly: {len(plainly)} values")
        lines += [f"  {node.kind} {node.path}".rstrip() for node in plainly if node.kind != "call"]
        lines.append(f"for each chunk of {program.chunk} packets, {len(tables)} tables:")
        made = {register: name for name, register in program.outputs.items()}
        for step in program.steps:
            kind = program.kinds[step.output]
            lines.append(f"  r{step.output:<3} {kind:<7} {step.text}{f'  -> {made[step.output]}' if step.output in made else ''}")
        return lines

    def _coordinates(self) -> dict[str, Any]:
        """The columns that programs make, as expressions."""
        result = self.result
        measured, self.positive = result.range, list[Node]()
        distance = self._return(measured)
        shown = np.where(measured == 0, np.inf, np.where(measured < 0, np.nan, measured))
        if isinstance(result.invalid, Traced) or np.any(result.invalid):
            distance, shown = (np.where(result.invalid, np.nan, value) for value in (distance, shown))
        level = _product(distance, np.cos(result.elevation))
        x, y = _product(level, np.cos(result.azimuth)), _product(level, np.sin(result.azimuth))
        z = distance * np.sin(result.elevation)
        found = {name: value if _is_zero(o) else value + o for name, value, o in zip("xyz", (x, y, z), result.origin, strict=True)}
        found |= {"range": shown, "azimuth": result.azimuth}
        if result.intensity is not None:
            found["intensity"] = result.intensity
        return {name: value.node if isinstance(value, Traced) else value for name, value in found.items()}

    def _return(self, measured: Traced) -> Any:
        """The distance of a return, nan where there is none; where a low value only scales it, that value has to be positive."""
        node = measured.node
        if only_field(node) is None and node.kind == "call" and node.function is np.multiply:
            for full, low in (node.args, node.args[::-1]):
                if is_full(full, self.width) and only_field(full) is not None and isinstance(low, Node) and not is_full(low, self.width):
                    self.positive.append(low)
                    return _return(Traced(full, self.tape)) * Traced(low, self.tape)
        return _return(measured)

    def safe(self, values: Callable[[Node], NDArray[Any]]) -> bool:
        """Whether all directions are numbers where everything that they are made of is: then a nan marks all coordinates alike."""
        return self._may_be_safe and all(np.isfinite(values(low)).all() for low in self._low_directions)

    @cached_property
    def _may_be_safe(self) -> bool:
        """Whether everything in the directions is a number but for what is known of a batch only."""
        fixed = all(isinstance(part, Traced) or np.isfinite(part).all() for part in (self.result.azimuth, self.result.elevation))
        return fixed and all(np.isfinite(term.row).all() and (term.full is None or self._finite(term.full)) for term in self._directions)

    @cached_property
    def _low_directions(self) -> list[Node]:
        return [term.low for term in self._directions if term.low is not None]

    @cached_property
    def _directions(self) -> list[Term]:
        return [term for node in self._directed for term in terms(node, self.width)]

    @property
    def _directed(self) -> list[Node]:
        return [part.node for part in (self.result.azimuth, self.result.elevation) if isinstance(part, Traced)]

    def _finite(self, node: Node) -> bool:
        """Whether an expression is a number for every value that its field can have."""
        options = chosen(node, self.width)
        if options is not None:
            return all(self._finite(option) if isinstance(option, Node) else bool(np.isfinite(option)) for option in options[1:])
        values = possible(node, self.layout.leaves)
        return values is not None and bool(np.isfinite(values).all())


def _sample(value: Any) -> Any:
    return value.node.sample if isinstance(value, Traced) else value


def _return(measured: Any) -> Any:
    return np.where((measured > 0) & (measured < np.inf), measured, np.nan)


def _product(first: Any, second: Any) -> Any:
    return first if not isinstance(second, Traced) and np.size(second) == 1 and np.all(second == 1) else first * second


def _is_zero(value: Any) -> bool:
    return not isinstance(value, Traced) and bool(np.all(np.asarray(value) == 0))


#: tables by what they are of, shared by the plans of a `points` function.
_TABLES: WeakKeyDictionary[PointsFunction, dict[Any, NDArray[Any]]] = WeakKeyDictionary()
#: the size of the frames that were the first to get a kernel.
_OWN: WeakKeyDictionary[PointsFunction, int] = WeakKeyDictionary()
#: points made so far, by the names of their columns.
_MADE: WeakKeyDictionary[PointsFunction, dict[tuple[str, ...], int]] = WeakKeyDictionary()


def plan_for(function: PointsFunction, batch: Batch, group: Group) -> Plan | Untraceable:
    """The plan for frames of a group's layout, or why there is none; kept with the layout."""
    if function not in group.layout.notes:
        group.layout.notes[function] = _planned(function, batch, group)
    found: Plan | Untraceable = group.layout.notes[function]
    return found


def _planned(function: PointsFunction, batch: Batch, group: Group) -> Plan | Untraceable:
    """A new plan, traced with the first frame of the group, twice."""
    table = Rows(batch.table.schema, [Group(group.layout, np.arange(2), np.ascontiguousarray(group.rows[[0, 0]]))])
    place = group.where[[0, 0]]
    state = {name: (frames, which[place]) for name, (frames, which) in batch.state.items()}
    try:
        return Plan(function, Batch(table, np.zeros(2, np.bool_), state, batch.defaults), group.layout)
    except Untraceable as reason:
        return reason


def worth_compiling(function: PointsFunction, names: tuple[str, ...], plan: Plan, frames: int) -> bool:
    """Whether so many points of a `points` function were asked for, these frames included, that its kernel pays."""
    made = _MADE.setdefault(function, {})
    made[names] = made.get(names, 0) + frames * plan.width
    if made[names] < WARM:
        return False
    if not available():
        made[names] = NEVER
        return False
    try:
        kernel = plan.kernel(names, function)
        if made[names] < COLD and not kernel.is_compiled:
            return False
        kernel.compile()
    except Exception:  # whatever is wrong with Numba or its cache here, NumPy does without
        made[names] = NEVER
        return False
    return True


def tables_of(function: PointsFunction) -> dict[Any, NDArray[Any]]:
    """The tables that the plans of a `points` function share."""
    return _TABLES.setdefault(function, {})
