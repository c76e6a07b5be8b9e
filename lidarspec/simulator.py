"""Frames that a sensor would send from a scene, made from its own spec: no inverse of `points` is written anywhere.

The sensor's `sweep` says what is not measured (angles, counters, time). The packets are filled with that, `points` says
where the beams go, the scene says how far, and the ranges go back through the scale of the fields that they come from.
Where direction depends on range this is repeated; a beam that finds no fixed point is a no-return.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.access import Fields
from lidarspec.codecs import CompiledCodec, codec
from lidarspec.columns import Batch, Column, aligned
from lidarspec.errors import SpecError, UsageError
from lidarspec.geometry import Polar
from lidarspec.layout import Layout, Leaf
from lidarspec.points import points_function
from lidarspec.scenes import Room, Scene
from lidarspec.spec import Sensor
from lidarspec.tables import Group, Rows
from lidarspec.units import factor
from lidarspec.walk import walk

#: how often ranges are measured again while directions still move.
ROUNDS = 16
#: raw value that a range field is given to see which points answer to it.
PROBE = 100
#: packets simulated beyond those asked for, since directions may depend on the next packet.
AHEAD = 1


def simulate(sensor: Sensor, packets: int, *, start: int = 0, scene: Scene | None = None) -> list[bytes]:
    """The data frames numbered `start` to ``start + packets`` of a sensor standing in a scene.

    Raises:
        UsageError: where the sensor declares no `sweep`.
        SpecError: where its ranges cannot be traced back to fields.
    """
    frame = sensor.data_frame
    sweep = sensor.frames[frame].sweep or sensor.sweep
    if sweep is None:
        raise UsageError(f"{sensor.id} declares no sweep for {frame!r} frames, and cannot be simulated")
    engine = codec(sensor.frames[frame])
    if not isinstance(engine, CompiledCodec):
        raise SpecError(f"cannot be simulated, since it is not compiled: {engine.reason}", path=frame, sensor=sensor.id)
    table = _swept(sensor, engine, [sweep(start + index) for index in range(packets + AHEAD)])
    _Measurement(sensor, frame, table).fill(scene or Room())
    for group in table.groups:
        group.layout.seal(group.rows)
    frames = [b""] * len(table)
    for group in table.groups:
        for place, row in zip(group.where.tolist(), group.rows, strict=True):
            frames[place] = row.tobytes()
    return frames[:packets]


def opening(sensor: Sensor) -> bytes:
    """What the sensor sends before its data frames: the frame that they come after; empty where they need none."""
    after = sensor.frames[sensor.data_frame].after
    return b"" if after is None else sensor.example(after)


def _swept(sensor: Sensor, engine: CompiledCodec, sweeps: Sequence[Mapping[str, Any]]) -> Rows:
    """Frames that hold what the sweep says, everything else 0, constants in place."""
    layouts: dict[tuple[int, ...], Layout] = {}
    asked: list[str] = []
    groups: dict[int, tuple[Layout, list[int]]] = {}
    for index, values in enumerate(sweeps):
        known = layouts.get(tuple(_raw(engine, values, path) for path in asked)) if layouts else None
        if known is None:
            asked = []
            known = walk(engine.frame.prepared, functools.partial(_asked, engine, values, asked), engine.frame.max_length).layout()
            layouts[tuple(_raw(engine, values, path) for path in asked)] = known
        groups.setdefault(id(known), (known, []))[1].append(index)
    made = []
    for layout, members in groups.values():
        rows = np.zeros((len(members), layout.size), np.uint8)
        for path in sorted({path for index in members for path in sweeps[index]}):
            leaf = layout.leaves.get(path)
            if leaf is None and _elsewhere(sensor, path):
                continue
            if leaf is None:
                raise SpecError("sweep gives a value to a field that the frame does not have", path=path, sensor=sensor.id)
            leaf.store(rows, _steps(leaf, np.array([np.asarray(sweeps[index][path], np.float64) for index in members])))
        layout.seal(rows)
        made.append(Group(layout, np.array(members, np.intp), rows))
    return Rows(engine.schema, made)


def _elsewhere(sensor: Sensor, path: str) -> bool:
    """Whether the field is one that some data frames of the sensor have, though not in this form."""
    return any(frame.data and path in codec(frame).schema.fields for frame in sensor.frames.values())


def _asked(engine: CompiledCodec, values: Mapping[str, Any], asked: list[str], leaf: Leaf) -> int:
    if leaf.info.path not in asked:
        asked.append(leaf.info.path)
    return _raw(engine, values, leaf.info.path)


def _raw(engine: CompiledCodec, values: Mapping[str, Any], path: str) -> int:
    info = engine.schema.fields[path]
    if path in values:
        return round((float(values[path]) - info.offset) / info.scale)
    return int(info.const) if isinstance(info.const, int) else 0


def _steps(leaf: Leaf, values: NDArray[np.float64]) -> NDArray[Any]:
    """Physical values as raw ones, with room for the arrays that the field is in."""
    info = leaf.info
    values = values.reshape(*values.shape, *(1,) * (1 + len(leaf.shape) - values.ndim))
    raw = (values - info.offset) / info.scale
    return raw if info.kind == "float" else np.rint(raw).astype(np.int64)


@dataclass(frozen=True, eq=False)
class _Target:
    """A field that ranges come from, and the index of the innermost axes of the points that belongs to it.

    Attributes:
        step, zero: metres of one raw step, a number or (n, ...), and metres of raw 0.
    """

    path: str
    inner: tuple[int, ...]
    step: Any
    zero: float = 0.0


class _Measurement:
    """The ranges of a table of frames, measured in a scene and written into their fields."""

    def __init__(self, sensor: Sensor, frame: str, table: Rows) -> None:
        self._sensor, self._table = sensor, table
        self._points = points_function(sensor, frame)
        self._intensity = ""

    def fill(self, scene: Scene) -> None:
        """Measure until nothing moves any more."""
        targets = self._targets()
        stored = [self._physical(target.path) for target in targets]
        for attempt in range(ROUNDS):
            beams = self._beams()
            measured = [_raw_ranges(self._sensor, self._leaf(t.path), t, _part(scene.measure(*beams), t.inner)) for t in targets]
            moved = [~np.isclose(new, old) for new, old in zip(measured, stored, strict=True)]
            if not any(mask.any() for mask in moved):
                break
            last = attempt >= ROUNDS - 2
            stored = [np.where(mask & last, 0, new) for mask, new in zip(moved, measured, strict=True)]
            for target, values in zip(targets, stored, strict=True):
                self._store(target.path, values)
            if last:
                break
        if self._intensity:
            self._store(self._intensity, np.where(stored[0] > 0, 40 + stored[0] % 160, 0))

    def _targets(self) -> list[_Target]:
        """The fields in metres that the ranges of the points answer to."""
        found: list[_Target] = []
        for path, info in self._table.schema.fields.items():
            if factor(info.unit, "m") is None or not self._table.groups or path not in self._table.groups[0].layout.leaves:
                continue
            before = self._table.raw(path)
            self._store(path, np.array(PROBE))
            answer = self._evaluate()[0]
            expected = PROBE * info.scale + info.offset
            for inner in self._inner(answer):
                if np.isclose(_part(answer, inner), expected).any():
                    found.append(_Target(path, inner, info.scale, info.offset))
            self._store(path, before)
        found = found or self._proportional()
        if not found:
            raise SpecError(
                "no field in metres makes the range of a point: the sensor has to give `encode`", path="points", sensor=self._sensor.id
            )
        return found

    def _inner(self, answer: NDArray[Any]) -> list[tuple[int, ...]]:
        """The indices of the axes of the points that are further in than those of the fields."""
        extra = answer.ndim - 1 - self._table.schema.depth()
        return list(np.ndindex(*answer.shape[answer.ndim - extra :])) if extra > 0 else [()]

    def _proportional(self) -> list[_Target]:
        """The elements of arrays without a unit of their own to which the ranges are in proportion: the header has the unit."""
        found = []
        for path, info in self._table.schema.fields.items():
            if info.unit or info.kind != "int" or not info.axes or not self._table.groups:
                continue
            before, answers = self._table.raw(path), []
            for probe in (PROBE, 2 * PROBE):
                self._store(path, np.array(probe))
                answers.append(self._evaluate()[0])
            self._store(path, before)
            for inner in self._inner(answers[0]):
                once, twice = (_part(answer, inner) for answer in answers)
                if ((once > 0) & np.isclose(twice, 2 * once)).any():
                    found.append(_Target(path, inner, once / PROBE))
        return found

    def _evaluate(self) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Range, azimuth and elevation with all axes of the points."""
        number = len(self._table)
        state = {name: (None, np.full(number, -1, np.intp)) for name in self._sensor.state}
        batch = Batch(self._table, np.zeros(number, np.bool_), state, self._sensor.state)
        with np.errstate(all="ignore"):
            polar = self._points(Fields(batch))
            if not isinstance(polar, Polar) or not isinstance(polar.range, Column):
                raise SpecError("only polar points can be simulated without `encode`", path="points", sensor=self._sensor.id)
            if isinstance(polar.intensity, Column):
                self._intensity = polar.intensity.source
            arrays = aligned((polar.range, polar.azimuth, polar.elevation), batch)[0]
        full = np.broadcast_arrays(np.zeros((number,) + (1,) * (arrays[0].ndim - 1)), *arrays)
        return full[1], full[2], full[3]

    def _beams(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        _, azimuth, elevation = self._evaluate()
        return np.nan_to_num(azimuth.astype(np.float64)), np.nan_to_num(elevation.astype(np.float64))

    def _leaf(self, path: str) -> Leaf:
        return self._table.groups[0].layout.leaves[path]

    def _physical(self, path: str) -> NDArray[np.float64]:
        return self._table.raw(path).astype(np.float64)

    def _store(self, path: str, values: NDArray[Any]) -> None:
        """Write raw values, (n, ...) or one for all, into every frame that has the field."""
        for group in self._table.groups:
            leaf = group.layout.leaves.get(path)
            if leaf is None:
                continue
            own = values if values.ndim == 0 else values[group.where]
            if own.ndim:
                own = own.reshape(own.shape[: 1 + len(leaf.shape)])[(slice(None), *(slice(0, length) for length in leaf.shape))]
            leaf.store(group.rows, own)


def _part(array: NDArray[Any], inner: tuple[int, ...]) -> NDArray[Any]:
    corner: Any = (..., *inner)
    return np.asarray(array[corner])


def _raw_ranges(sensor: Sensor, leaf: Leaf, target: _Target, metres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ranges as raw values of their field; 0 where the sensor or the field does not reach."""
    near, far = sensor.range_limits
    with np.errstate(all="ignore"):
        raw = np.rint((np.nan_to_num(metres, posinf=0) - target.zero) / target.step)
    top = float((1 << leaf.info.bits) - 1) if leaf.info.kind == "int" else np.inf
    return np.where((metres >= near) & (metres <= far) & (raw > 0) & (raw <= top), raw, 0)
