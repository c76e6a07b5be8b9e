"""Make valid frames with seeded random content, for tests, docs and the REPL.

A random header determines a layout, and the rest of the frame is filled with random bytes. Frames
that are not plausible are replaced by other random frames. If none is plausible, the values of some
fields, such as counters and times, come from the `sweep` that the plugin declares for simulations.
"""

from __future__ import annotations

import contextlib
import functools
import math
import random
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import (
    LidarSpecError,
    PluginError,
    SpecError,
    UnknownFrame,
    UsageError,
    struct_error,
)
from lidarspec.frames.build import build
from lidarspec.frames.frame_table import CompiledTable, LayoutRows
from lidarspec.frames.layout import Layout, Leaf
from lidarspec.frames.layout_tree import InvalidLengthError, UnknownSelectorError, find_layout
from lidarspec.frames.measured_size import MeasuredSize
from lidarspec.frames.schema import make_schema
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.plausibility import check_plausibility
from lidarspec.framing.results import VALID
from lidarspec.spec.description import Frame
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.syntax import Fault, get_member, random_value
from lidarspec.spec.tree import Node, Ref, Select, nodes, refs

#: The number of attempts with random frames, for a sensor without a `sweep` and for a sensor with
#: one. If no random frame is plausible, the `sweep` is used.
MAX_TRIES = 40
MAX_TRIES_BEFORE_SWEEP = 8
#: The first attempt makes one random frame. Each further attempt makes `BATCH_GROWTH` times as many
#: frames as the previous one, at most `LARGEST_BATCH`.
BATCH_GROWTH = 4
LARGEST_BATCH = 64
#: The maximum size of a batch in bytes, unless it has only one frame.
BATCH_BYTES = 1 << 22
#: The number of random headers that are tried.
MAX_HEADERS = 400
#: Numbers up to these limits are drawn more often, because most counts and keys are low.
LOW_NUMBERS = (8, 40)
#: The probability of drawing a label or the key of a switch for a header field, and the maximum
#: number of labels and keys to draw from.
NAMED_SHARE = 0.7
MAX_NAMED_VALUES = 16
#: The rule of `lidarspec check` for a frame type without an example.
NO_EXAMPLE = "LS301"
#: Functions that draw the raw values of certain fields, by path.
Drawn = Mapping[str, Callable[[random.Random], Any]]
NOTHING: Drawn = {}


def example(sensor: SensorDescription, frame: str, *, seed: int = 0) -> bytes:
    """Return the bytes of a valid frame with seeded random content.

    Raises:
        UnknownFrame: if the sensor has no such frame type.
    """
    if frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    return random_frame(sensor, frame, random.Random(f"{sensor.id} {frame} {seed}"))


def random_frame(
    sensor: SensorDescription, frame: str, source: random.Random, drawn: Drawn = NOTHING
) -> bytes:
    """Return a valid frame with a random header and random content.

    Args:
        source: the generator of random numbers.
        drawn: functions that draw the raw values of certain fields, by path.
    """
    engine = get_codec(sensor.frames[frame])
    if not engine.is_compiled or engine.schema.has_measured_sizes:
        return draw_frame(sensor, frame, source, drawn)
    _, row = draw_row(sensor, frame, source, drawn)
    data = frame_coder(engine.frame).encode(row.tobytes())
    assert data is not None  # `draw_row` has checked it
    return data


def draw_row(
    sensor: SensorDescription,
    frame: str,
    source: random.Random,
    drawn: Drawn = NOTHING,
    tries: int = MAX_TRIES,
) -> tuple[Layout, NDArray[np.uint8]]:
    """Make a valid random frame; return its layout and its struct bytes, (size,).

    Args:
        frame: the name of a frame type with layouts and without parts.
        source, drawn: see `random_frame`.
        tries: the maximum number of attempts.

    Raises:
        SpecError: if no attempt results in a plausible frame.
    """
    engine = get_codec(sensor.frames[frame])
    random_tries = tries
    if sensor.simulation_of(frame).sweep is not None:
        random_tries = min(tries, MAX_TRIES_BEFORE_SWEEP)
    for attempt in range(random_tries):
        layout, chosen = make_random_header(engine, source, drawn)
        number = min(
            BATCH_GROWTH**attempt, LARGEST_BATCH, max(BATCH_BYTES // max(layout.size, 1), 1)
        )
        rows = _make_random_rows(engine, layout, number, source)
        _store_drawn(layout, rows, chosen, drawn, source)
        rows = _fill_headers(rows, layout, chosen)
        rows = rows[valid_mask(sensor, frame, layout, rows)]
        row = _find_encodable(sensor, frame, rows)
        if row is not None:
            return layout, row
    return _draw_from_sweep(sensor, frame, engine, source, drawn, tries)


def make_random_header(
    engine: Codec, source: random.Random, drawn: Drawn = NOTHING
) -> tuple[Layout, dict[str, int]]:
    """Return the layout of a random header, and the raw values of its fields by path.

    Raises:
        SpecError: if hundreds of random headers have no layout.
    """
    keys = sorted(iter_switch_keys(engine.frame.tree))
    for _ in range(MAX_HEADERS):
        with contextlib.suppress(
            InvalidLengthError, ArithmeticError, LookupError, TypeError, ValueError
        ):
            return _draw_header(engine.frame, source, drawn, keys)
    raise SpecError("no example found: no random header leads to a frame within max_length")


def _draw_header(
    frame: Frame, source: random.Random, drawn: Drawn, keys: list[int]
) -> tuple[Layout, dict[str, int]]:
    values: dict[str, int] = {}
    while True:
        try:
            return find_layout(frame.tree, values, frame.max_struct_bytes), values
        except UnknownSelectorError as unknown:
            if isinstance(unknown.leaf, MeasuredSize):
                raise SpecError(
                    "no example can be made, because the size of this field depends on its content",
                    path=unknown.leaf.info.path,
                ) from None
            own = drawn.get(unknown.leaf.info.path)
            if own:
                values[unknown.leaf.info.path] = own(source)
            else:
                values[unknown.leaf.info.path] = _draw_value(source, unknown.leaf, keys)


def iter_switch_keys(root: Node) -> Iterator[int]:
    """Yield the integer keys of all `Select` nodes, except for keys that have a label."""
    for node in nodes(root):
        if isinstance(node, Select):
            labels = node.key.info.labels if isinstance(node.key, Ref) else ()
            yield from (key for key, _ in node.cases if isinstance(key, int) and key not in labels)


def _draw_value(source: random.Random, leaf: Leaf, keys: list[int]) -> int:
    if leaf.info.const is not None:
        return int(leaf.info.const)
    if leaf.info.allowed:
        return source.choice(leaf.info.allowed)
    top = (1 << leaf.info.bits) - 1
    candidates = [source.randint(0, min(top, limit)) for limit in (top, *LOW_NUMBERS)]
    if source.random() < NAMED_SHARE:
        named = [key for key in (*leaf.info.labels, *keys) if key <= top]
        candidates += named[:MAX_NAMED_VALUES]
    value = source.choice(candidates)
    is_negative = (
        leaf.info.dtype is not None
        and leaf.info.dtype.kind == "i"
        and value >> (leaf.info.bits - 1)
    )
    if is_negative:
        return value - (1 << leaf.info.bits)
    return value


#: The characters of texts in examples.
LETTERS = b"abcdefghijklmnopqrstuvwxyz"


def _make_random_rows(
    engine: Codec, layout: Layout, number: int, source: random.Random
) -> NDArray[np.uint8]:
    """Return the bytes of random structs with allowed values, (number, size)."""
    rows = (
        np.frombuffer(source.randbytes(number * layout.size), np.uint8)
        .reshape(number, layout.size)
        .copy()
    )
    frame_coder(engine.frame).make_encodable(rows, layout)
    for leaf in layout.leaves.values():
        adapter = leaf.info.adapter
        if adapter is not None and adapter.is_partial and leaf.info.kind == "bytes":
            letters = source.choices(LETTERS, k=number * math.prod(leaf.shape))
            leaf.store(rows, np.array(letters, np.uint8).reshape(number, *leaf.shape))
        if leaf.info.allowed:
            values = source.choices(leaf.info.allowed, k=number * math.prod(leaf.shape))
            leaf.store(rows, np.array(values).reshape(number, *leaf.shape))
    return rows


def draw_frame(
    sensor: SensorDescription,
    frame: str,
    source: random.Random,
    drawn: Drawn,
    tries: int = LARGEST_BATCH * MAX_TRIES,
) -> bytes:
    """Draw the values of a frame one by one, and return a valid frame.

    Raises:
        SpecError: if all attempts result in invalid frames.
    """
    engine = get_codec(sensor.frames[frame])
    for _ in range(tries):
        try:
            values = random_value(engine.frame.prepared, source, drawn)
            data = build(sensor, frame, _remove_lengths(values, engine.frame.tree), {})
        except (UsageError, Fault):
            continue  # these values do not fit together; other values may
        except LidarSpecError:
            raise
        except Exception as error:
            raise struct_error(error, path=frame, sensor=sensor.id) from error
        rows = np.frombuffer(data, np.uint8)
        stops = np.array([len(data)])
        if engine.survey(rows, np.zeros(1, np.intp), stops).status[0] == VALID:
            return data
    raise SpecError(
        "no example found: all random frames are invalid",
        path=frame,
        sensor=sensor.id,
        rule=NO_EXAMPLE,
    )


def _remove_lengths(values: Any, root: Node) -> Any:
    """Return the values of a frame without the counts and lengths that `build` fills in."""
    for node in make_schema(root).parts.values():
        # The count of an array was drawn together with the array.
        count = None if node.is_array else node.count
        rules = (count, node.size, node.within)
        asked = [ref.path for rule in rules if rule is not None for ref in refs(rule)[:1]]
        # A condition or a case may leave out all parts.
        parts = get_member(values, node.axis, None) or []
        for kind, part in ((kind, part) for part in parts for kind in node.kinds):
            own = () if kind.following is None else refs(kind.following)[:1]
            for path in (ref.path for ref in own):
                _remove_field(part, path)
            _remove_lengths(part, kind.root)
        for path in asked:
            _remove_field(values, path)
    return values


def _remove_field(values: Any, path: str) -> None:
    """Remove a field from nested mappings, if they have it."""
    *parents, name = path.split(".")
    if parents:
        values = get_member(values, ".".join(parents), {})
    values.pop(name, None)


def _fill_headers(
    rows: NDArray[np.uint8], layout: Layout, chosen: dict[str, int]
) -> NDArray[np.uint8]:
    """Write header values, constants and checksums into frames, and return the frames."""
    for path, value in chosen.items():
        leaf = layout.column(path)
        assert isinstance(leaf, Leaf)
        leaf.store(rows, value)
    layout.complete_rows(rows)
    return rows


def valid_mask(
    sensor: SensorDescription, frame: str, layout: Layout, rows: NDArray[np.uint8]
) -> NDArray[np.bool_]:
    """Return whether each struct has only allowed and plausible values, (n,).

    Args:
        rows: the bytes of structs with correct constants and checksums, (n, size).

    Raises:
        SpecError: if `plausible` raises.
    """
    declared = sensor.frames[frame]
    if layout.conditions:
        mask = layout.meet_conditions(rows)
    else:
        mask = np.ones(len(rows), np.bool_)
    if declared.plausible is None:
        return mask
    rows = rows[mask]
    table = CompiledTable(
        get_codec(declared).schema, [LayoutRows(layout, np.arange(len(rows)), rows)]
    )
    errors: list[PluginError] = []
    mask[mask] = check_plausibility(declared, table, errors) == 0
    if errors:
        raise SpecError(
            errors[0].reason, path=f"{frame}.plausible", sensor=sensor.id, rule=errors[0].rule
        )
    return mask


def _find_encodable(
    sensor: SensorDescription, frame: str, rows: NDArray[np.uint8]
) -> NDArray[np.uint8] | None:
    """Return the first row of struct bytes that the wire form can encode, or None."""
    encode = frame_coder(sensor.frames[frame]).encode
    return next((row for row in rows if encode(row.tobytes()) is not None), None)


def _draw_from_sweep(
    sensor: SensorDescription,
    frame: str,
    engine: Codec,
    source: random.Random,
    drawn: Drawn,
    tries: int,
) -> tuple[Layout, NDArray[np.uint8]]:
    """Return a layout and a row of struct bytes with values of the sensor's `sweep`."""
    sweep = sensor.simulation_of(frame).sweep
    if sweep is None:
        raise SpecError(
            "no example found: `plausible` rejects all random frames, and no `sweep` is declared",
            path=frame,
            sensor=sensor.id,
            rule=NO_EXAMPLE,
        )
    for _ in range(tries):
        values = sweep(source.randrange(10_000))
        layout, chosen = make_random_header(
            engine, source, {**_make_sweep_draws(engine, values), **drawn}
        )
        rows = _make_random_rows(engine, layout, 1, source)
        for path, value in values.items():
            leaf = layout.leaves.get(path)
            if leaf is not None and path not in chosen:
                _store_swept(leaf, rows, value)
        _store_drawn(layout, rows, chosen, drawn, source)
        rows = _fill_headers(rows, layout, chosen)
        rows = rows[valid_mask(sensor, frame, layout, rows)]
        row = _find_encodable(sensor, frame, rows)
        if row is not None:
            return layout, row
    raise SpecError(
        "no example found: `plausible` rejects all random frames and all frames of `sweep`",
        path=frame,
        sensor=sensor.id,
        rule=NO_EXAMPLE,
    )


def _store_swept(leaf: Leaf, rows: NDArray[np.uint8], value: Any) -> None:
    """Write a value of a sweep into a field, if value and field have the same length."""
    raw = leaf.raw([value])[(slice(None), *map(slice, leaf.shape))]
    if all(length in (1, room) for length, room in zip(raw.shape[1:], leaf.shape, strict=False)):
        leaf.store(rows, raw)


def _store_drawn(
    layout: Layout,
    rows: NDArray[np.uint8],
    chosen: Mapping[str, int],
    drawn: Drawn,
    source: random.Random,
) -> None:
    """Write drawn values into all fields that do not determine the layout."""
    for path, draw in drawn.items():
        if path in layout.leaves and path not in chosen:
            leaf = layout.leaves[path]
            count = len(rows) * math.prod(leaf.shape)
            leaf.store(
                rows, np.array([draw(source) for _ in range(count)]).reshape(len(rows), *leaf.shape)
            )


def _make_sweep_draws(engine: Codec, values: Mapping[str, Any]) -> Drawn:
    """Return functions that return the raw values of a sweep, by path.

    Args:
        values: the values of the sweep in units, by path.
    """
    fields = engine.schema.fields
    draws: dict[str, Callable[[random.Random], Any]] = {}
    for path, value in values.items():
        if path in fields and np.ndim(value) == 0 and not isinstance(value, bytes):
            draws[path] = functools.partial(return_raw, fields[path].raw(float(value)))
    return draws


def return_raw(raw: int, _: random.Random) -> int:
    """Return `raw`; this is used as a function that draws a value."""
    return raw
