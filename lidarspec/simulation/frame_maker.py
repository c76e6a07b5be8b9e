"""Frames made of physical values by path: everything else is 0, constants and checksums are in place.

This is `build` for many frames at once, and without asking for every field: what a sensor sends is declared by the values that
matter (a `sweep`, an answer to a command), and counts and options in the header decide the layout as they do for a decoder.

Valid frames with seeded random content, for tests, docs and the REPL.
"""

from __future__ import annotations

import functools
import random
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError, UnknownFrame, UsageError
from lidarspec.framing.frame_engine import CompiledCodec, InterpretedCodec, codec
from lidarspec.framing.plausibility import plausibility
from lidarspec.framing.results import VALID
from lidarspec.spec.construct_layer import Fault, random_value
from lidarspec.spec.description import Spec
from lidarspec.wire.build import build
from lidarspec.wire.frame_table import Group, Rows
from lidarspec.wire.layout import Layout, Leaf
from lidarspec.wire.layout_tree import TooLong, Unknown, layout_of

Values = Mapping[str, Any]


class FrameMaker:
    """Makes frames of one type of a sensor; layouts are kept from one call to the next.

    Raises:
        SpecError: where the frame type is not compiled.
    """

    def __init__(self, sensor: Spec, frame: str) -> None:
        engine = codec(sensor.frames[frame])
        if not isinstance(engine, CompiledCodec):
            raise SpecError(f"cannot be simulated, since it is not compiled: {engine.reason}", path=frame, sensor=sensor.id)
        self.sensor, self.engine = sensor, engine
        self._layouts: dict[tuple[int, ...], Layout] = {}
        self._asked: list[str] = []
        self._elsewhere = {
            path for other in sensor.frames.values() if other.data and sensor.frames[frame].data for path in codec(other).schema.fields
        }

    def table(self, frames: Sequence[Values]) -> Rows:
        """One frame for each mapping of field paths to physical values; arrays may be given as bytes, too.

        Raises:
            SpecError: where a value is given to a field that the frame does not have.
        """
        members: dict[int, tuple[Layout, list[int]]] = {}
        for index, values in enumerate(frames):
            layout = self._layout(values)
            members.setdefault(id(layout), (layout, []))[1].append(index)
        groups = [
            Group(layout, np.array(which, np.intp), self._rows(layout, [frames[i] for i in which])) for layout, which in members.values()
        ]
        return Rows(self.engine.schema, groups)

    def frame(self, values: Values) -> bytes:
        """One frame, sealed."""
        return sealed(self.table([values]))[0]

    def _layout(self, values: Values) -> Layout:
        """The layout that these values of header fields ask for."""
        known = self._layouts.get(tuple(self._raw(values, path) for path in self._asked))
        if known is None:
            asked: list[str] = []
            known = self._walked(values, asked)
            self._layouts = self._layouts if asked == self._asked else {}
            self._asked = asked
            self._layouts[tuple(self._raw(values, path) for path in asked)] = known
        return known

    def _walked(self, values: Values, asked: list[str]) -> Layout:
        frame, fields = self.engine.frame, self.engine.schema.fields
        try:
            while True:
                try:
                    return layout_of(frame.tree, {path: self._raw(values, path) for path in asked}, frame.max_length)
                except Unknown as unknown:
                    asked.append(unknown.leaf.info.path)
        except TooLong as error:
            left_out = [path for path in asked if path not in values and fields[path].const is None]
            given = ", ".join(f"{path} = {values[path]}" for path in asked if path in values)
            reason = f"with {given} there is no frame of at most {frame.max_length} bytes (max_length)"
            if left_out:
                reason = f"sweep has to give {left_out[0]!r}, which the length of the frame depends on"
            raise SpecError(reason, path=str(error), sensor=self.sensor.id) from None

    def _rows(self, layout: Layout, frames: Sequence[Values]) -> NDArray[np.uint8]:
        rows = np.zeros((len(frames), layout.size), np.uint8)
        for path in dict.fromkeys(path for values in frames for path in values):
            leaf = layout.leaves.get(path)
            if leaf is None and path in self._elsewhere:
                continue
            if leaf is None:
                raise SpecError("sweep gives a value to a field that the frame does not have", path=path, sensor=self.sensor.id)
            leaf.store(rows, _steps(leaf, [values.get(path, 0) for values in frames]))
        layout.seal(rows)
        return rows

    def _raw(self, values: Values, path: str) -> int:
        info = self.engine.schema.fields[path]
        if path in values:
            return int(info.raw(float(values[path])))
        return int(info.const) if isinstance(info.const, int) else 0


def sealed(table: Rows) -> list[bytes]:
    """The frames of a table in order, with constants and checksums in place."""
    frames = [b""] * len(table)
    for group in table.groups:
        group.layout.seal(group.rows)
        size, data = group.layout.size, group.rows.tobytes()
        for spot, place in enumerate(group.where.tolist()):
            frames[place] = data[spot * size : (spot + 1) * size]
    return frames


def _steps(leaf: Leaf, given: Sequence[Any]) -> NDArray[Any]:
    """Physical values as raw ones, with room for the arrays that the field is in; bytes fill up with zeros."""
    info = leaf.info
    if info.kind == "bytes":
        given = [_padded(value, leaf.shape[-1]) if isinstance(value, bytes) else value for value in given]
    values = np.array([np.asarray(value, np.float64) for value in given])
    values = values.reshape(*values.shape, *(1,) * (1 + len(leaf.shape) - values.ndim))
    return np.asarray(info.raw(values))


def _padded(value: bytes, size: int) -> list[int]:
    return list(value[:size].ljust(size, b"\0"))


#: random frames made at once, and how often, before a sensor's own `sweep` has to help.
BATCH, TRIES = 64, 40
#: field path -> what draws a raw value of it.
Drawn = Mapping[str, Callable[[random.Random], Any]]
NOTHING: Drawn = {}


def example(sensor: Spec, frame: str, *, seed: int = 0) -> bytes:
    """See `Sensor.example`."""
    if frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    return examples(sensor, frame, random.Random(f"{sensor.id} {frame} {seed}"))[0]


def examples(sensor: Spec, frame: str, source: random.Random, drawn: Drawn = NOTHING) -> list[bytes]:
    """Some valid frames of one random header, at least one: what `example` picks from, for tests that need many.

    Args:
        drawn: field path -> what draws its raw value, for what random values never make.
    """
    engine = codec(sensor.frames[frame])
    if not isinstance(engine, CompiledCodec):
        return [_interpreted(sensor, frame, engine, source, drawn)]
    for _ in range(TRIES):
        layout, chosen = engine.tree.choose(source, drawn)
        rows = np.frombuffer(source.randbytes(BATCH * layout.size), np.uint8).reshape(BATCH, layout.size).copy()
        for path, draw in drawn.items():
            if path in layout.leaves and path not in chosen:
                leaf = layout.leaves[path]
                count = BATCH * int(np.prod(leaf.shape, dtype=np.intp))
                leaf.store(rows, np.array([draw(source) for _ in range(count)]).reshape(BATCH, *leaf.shape))
        found = _plausible(sensor, frame, layout, _headed(rows, layout, chosen))
        if found:
            return found
    return [_swept(sensor, frame, engine, source)]


def _interpreted(sensor: Spec, frame: str, engine: InterpretedCodec, source: random.Random, drawn: Drawn) -> bytes:
    """A frame that construct alone can read."""
    for _ in range(BATCH * TRIES):
        try:
            data = build(sensor, frame, random_value(engine.frame.prepared, source, drawn), {})
        except (UsageError, Fault):  # what was drawn goes not together; something else may
            continue
        if engine.survey(np.frombuffer(data, np.uint8), np.zeros(1, np.intp)).status[0] == VALID:
            return data
    raise SpecError("no random frame is valid", path=frame, sensor=sensor.id)


def _headed(rows: NDArray[np.uint8], layout: Layout, chosen: dict[str, int]) -> NDArray[np.uint8]:
    """Random frames with the header values of their layout, constants and checksums set."""
    for path, value in chosen.items():
        layout.leaves[path].store(rows, value)
    layout.seal(rows)
    return rows


def _plausible(sensor: Spec, frame: str, layout: Layout, rows: NDArray[np.uint8]) -> list[bytes]:
    table = Rows(codec(sensor.frames[frame]).schema, [Group(layout, np.arange(len(rows)), rows)])
    if sensor.frames[frame].plausible is None:
        return [row.tobytes() for row in rows]
    errors: list[str] = []
    good = np.flatnonzero(plausibility(sensor.frames[frame], table, errors) == 0)
    if errors:
        raise SpecError(errors[0].strip().splitlines()[-1], path=f"{frame}.plausible", sensor=sensor.id)
    return [row.tobytes() for row in rows[good]]


def _swept(sensor: Spec, frame: str, engine: CompiledCodec, source: random.Random) -> bytes:
    """A frame around the values that the sensor's `sweep` declares, where random ones are never plausible."""
    sweep = sensor.simulation_of(frame).sweep
    if sweep is None:
        raise SpecError("no random frame passes `plausible`, and there is no `sweep` to start from", path=frame, sensor=sensor.id)
    for _ in range(TRIES):
        values = sweep(source.randrange(10_000))
        layout, chosen = engine.tree.choose(source, _stated(engine, values))
        rows = np.frombuffer(source.randbytes(layout.size), np.uint8).reshape(1, layout.size).copy()
        for path, value in values.items():
            leaf = layout.leaves.get(path)
            if leaf is not None and path not in chosen:
                leaf.store(rows, leaf.info.raw(np.asarray(value, np.float64)))
        found = _plausible(sensor, frame, layout, _headed(rows, layout, chosen))
        if found:
            return found[0]
    raise SpecError("neither random frames nor those along `sweep` pass `plausible`", path=frame, sensor=sensor.id)


def _stated(engine: CompiledCodec, values: Mapping[str, Any]) -> Drawn:
    """What gives the numbers of a sweep, raw, where a header asks for them."""
    fields = engine.schema.fields
    found: dict[str, Callable[[random.Random], Any]] = {}
    for path, value in values.items():
        if path in fields and np.ndim(value) == 0 and not isinstance(value, bytes):
            found[path] = functools.partial(_always, fields[path].raw(float(value)))
    return found


def _always(raw: int, _: random.Random) -> int:
    return raw
