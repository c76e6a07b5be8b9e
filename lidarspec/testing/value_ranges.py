"""Ranges of valid values, from which `lidarspec.testing.strategies` draws random frames.

A header is the values of the fields on which the layout of a frame depends, such as counts. For
each header there are ranges of the other fields. The range of a field contains the values that are
valid in one example frame, the base. Values of several fields may be invalid together;
`LayoutRanges.repair` leaves such values out, so that the values of the base remain.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import itertools
import random
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import LidarSpecError, SpecError
from lidarspec.frames.build import build
from lidarspec.frames.layout import Layout, Leaf
from lidarspec.frames.layout_tree import UnknownSelectorError, find_layout
from lidarspec.frames.parse import parse
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.framing.example_frames import draw_frame, draw_row, return_raw, valid_mask
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.results import VALID
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.tree import formulas, nodes, refs

#: Number of tries to find a valid frame with a given header; there may be none.
TRIES = 5
#: Raw values of a field in one frame, (1, *shape of its arrays).
Values = NDArray[Any]
#: Maximum total bytes of the frames that are tried at a time.
BATCH_BYTES = 1 << 22


class LayoutRanges:
    """The valid values of the fields of frames with one header.

    Args:
        header: raw values of the fields that the layout depends on, by path.
        base: a valid struct of the layout, (size,).

    Attributes:
        free: the fields to draw: all fields except header fields, constants, lengths and checksums.
    """

    def __init__(
        self,
        sensor: Sensor,
        frame: str,
        layout: Layout,
        header: Mapping[str, int],
        base: NDArray[np.uint8],
    ) -> None:
        self._sensor = sensor
        self._frame = frame
        self._header = header
        self._base = base.reshape(1, -1)
        self.layout = layout
        decided = {*header, *(leaf.info.path for leaf, _ in layout.following)}
        for checksum in layout.checksums:
            decided.update(leaf.info.path for leaf in checksum.leaves)
        self.free = [
            leaf
            for path, leaf in layout.leaves.items()
            if path not in decided and leaf.info.const is None and 0 not in leaf.shape
        ]

    def make_struct(self, values: Mapping[str, Values], fixed: Container[str]) -> bytes | None:
        """Return the bytes of a valid struct with these values.

        Values that are invalid together are replaced by values of `base`. Returns None if no struct
        with the values of the `fixed` fields is found.

        Args:
            values: the raw values of fields in `free`, by path.
            fixed: the paths of the fields whose values must not be replaced.
        """
        row = self._make_rows([values])
        if self._check_rows(row)[0]:
            return row.tobytes()
        kept = {path: value for path, value in values.items() if path in fixed}
        if kept and not self._check_rows(self._make_rows([kept]))[0]:
            others = self._rebase(kept)
            return None if others is None else others.make_struct(values, ())
        return self._make_rows([self.repair(values, kept)]).tobytes()

    def _rebase(self, values: Mapping[str, Values]) -> LayoutRanges | None:
        """Return ranges with a `base` that has these values; None if no base is found."""
        fixed = {path: functools.partial(return_raw, raw) for path, raw in self._header.items()}
        for path, value in values.items():
            elements = itertools.cycle(value.flat)
            fixed[path] = functools.partial(_return_next, elements)
        with contextlib.suppress(SpecError):
            layout, row = draw_row(self._sensor, self._frame, random.Random(0), fixed)
            return LayoutRanges(self._sensor, self._frame, layout, self._header, row)
        return None

    def repair(
        self, values: Mapping[str, Values], fixed: Mapping[str, Values]
    ) -> Mapping[str, Values]:
        """Return the fixed values, and those of `values` that are valid together with them.

        Values that would make the struct invalid are left out. In an array, elements of `base`
        replace the invalid elements.

        Args:
            values: the raw values of fields in `free`, by path.
            fixed: the raw values that are always part of the result, by path.
        """
        kept = dict(fixed)
        for leaf in self.free:
            path = leaf.info.path
            if path not in values or path in kept:
                continue
            if self._check_rows(self._make_rows([{**kept, path: values[path]}]))[0]:
                kept[path] = values[path]
            elif leaf.shape:
                mixed = self._replace_invalid_elements(kept, leaf, values[path])
                if self._check_rows(self._make_rows([{**kept, path: mixed}]))[0]:
                    kept[path] = mixed
        return kept

    def _replace_invalid_elements(
        self, kept: Mapping[str, Values], leaf: Leaf, values: Values
    ) -> Values:
        """Return an array in which the elements of `base` replace invalid elements.

        Args:
            kept: the values of other fields, by path.
        """
        base = leaf.load(self._base)
        mixed = base.copy()
        tried = []
        for index in range(values.size):
            trial = base.copy()
            trial.flat[index] = values.flat[index]
            tried.append({**kept, leaf.info.path: trial})
        for index, is_valid in enumerate(self._iter_validity(tried)):
            if is_valid:
                mixed.flat[index] = values.flat[index]
        return mixed

    @functools.cached_property
    def ranges(self) -> Mapping[str, tuple[int, int]]:
        """The lowest and highest raw value of the integer and bytes fields in `free`, by path."""
        if not self._has_rules:
            return {
                leaf.info.path: _find_limits(leaf)
                for leaf in self.free
                if leaf.info.kind in ("int", "bytes")
            }
        bounded = [
            leaf
            for leaf in self.free
            if leaf.info.kind in ("int", "bytes") and leaf.info.allowed is None
        ]
        # A small value may only be valid together with small values of other fields, and a large
        # value with large values. Therefore two bases are varied: the first base, and a base with
        # small values.
        ends = [self._find_ranges(bounded)]
        if self._shrink_base(bounded):
            ends.append(self._find_ranges(bounded))
        ranges = {}
        for leaf in bounded:
            own = [limits[leaf.info.path] for limits in ends]
            ranges[leaf.info.path] = min(low for low, _ in own), max(high for _, high in own)
        return ranges

    def _find_ranges(self, leaves: Sequence[Leaf]) -> dict[str, tuple[int, int]]:
        """Return the range of each field, found by varying this field alone in `base`."""
        starts = {leaf.info.path: int(leaf.load(self._base).flat[0]) for leaf in leaves}
        lowest = {
            leaf.info.path: (starts[leaf.info.path], _find_limits(leaf)[0]) for leaf in leaves
        }
        highest = {
            leaf.info.path: (starts[leaf.info.path], _find_limits(leaf)[1]) for leaf in leaves
        }
        low = find_nearest_valid_values(lowest, self._check_values)
        high = find_nearest_valid_values(highest, self._check_values)
        return {path: (low[path], high[path]) for path in starts}

    def _shrink_base(self, leaves: Sequence[Leaf]) -> bool:
        """Move each field of `base` towards 0; return whether a value has changed."""
        before = self._base.copy()
        for leaf in leaves:
            path = leaf.info.path
            start = int(leaf.load(self._base).flat[0])
            end = find_nearest_valid_values({path: (start, 0)}, self._check_values)[path]
            (is_valid,) = self._check_values([(path, end)])
            if is_valid:
                values = np.broadcast_to(np.array(end, leaf.info.dtype), (1, *leaf.shape))
                self._base = self._make_rows([{path: values}])
        return bool((self._base != before).any())

    @property
    def _has_rules(self) -> bool:
        """Whether the struct or the sensor rejects some values of fields."""
        declared = self._sensor.frames[self._frame]
        return bool(
            declared.plausible is not None or declared.wire is not None or self.layout.conditions
        )

    def _check_values(self, values: Sequence[tuple[str, int]]) -> list[bool]:
        """Return for each (path, value) whether `base` with this value is valid."""
        tried = []
        for path, value in values:
            leaf = self.layout.leaves[path]
            full = np.broadcast_to(np.array(value, leaf.info.dtype), (1, *leaf.shape))
            tried.append({path: full})
        return list(self._iter_validity(tried))

    def _iter_validity(self, tried: list[dict[str, Values]]) -> Iterator[bool]:
        """Yield for each set of values whether `base` with these values is valid."""
        step = max(BATCH_BYTES // self.layout.size, 1)
        for start in range(0, len(tried), step):
            yield from self._check_rows(self._make_rows(tried[start : start + step])).tolist()

    def _make_rows(self, values: list[Any]) -> NDArray[np.uint8]:
        """Return a copy of `base` for each set of values, with valid checksums, (n, size)."""
        rows = np.repeat(self._base, len(values), 0)
        for index, own in enumerate(values):
            for path, raw in own.items():
                self.layout.leaves[path].store(rows[index : index + 1], raw)
        for path, number in self._header.items():
            self.layout.leaves[path].store(rows, number)
        self.layout.complete_rows(rows)
        return rows

    def _check_rows(self, rows: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Return for each row whether it is valid, (n,)."""
        return _are_valid(self._sensor, self._frame, self.layout, rows)


def _return_next(values: Iterator[Any], _: random.Random) -> Any:
    """Return the next value, instead of a random value."""
    return next(values)


def find_nearest_valid_values(
    wanted: Mapping[str, tuple[int, int]],
    are_valid: Callable[[Sequence[tuple[str, int]]], Sequence[bool]],
) -> dict[str, int]:
    """Return for each field the valid value nearest to a wanted value.

    Args:
        wanted: the path of each field -> (a valid value, the wanted value).
        are_valid: a function that returns for each (path, value) whether the value is valid.
    """
    valid = {path: start for path, (start, _) in wanted.items()}
    refused: dict[str, int] = {}
    ends = [(path, end) for path, (start, end) in wanted.items() if start != end]
    for (path, end), is_valid in zip(ends, are_valid(ends), strict=True):
        if is_valid:
            valid[path] = end
        else:
            refused[path] = end
    while True:
        middles = [
            (path, (valid[path] + end) // 2)
            for path, end in refused.items()
            if abs(end - valid[path]) > 1
        ]
        if not middles:
            return valid
        for (path, middle), is_valid in zip(middles, are_valid(middles), strict=True):
            if is_valid:
                valid[path] = middle
            else:
                refused[path] = middle


#: Number of random frames whose headers are collected.
KNOWN_HEADERS = 16
KNOWN_FRAMES = 4
#: Number of tries for each frame without layouts.
MAX_WALKS = 300
#: Number of random frames without layouts that are tried to see if they are often valid.
SINGLE_WALKS = 10


@functools.lru_cache(maxsize=4096)
def find_ranges(
    sensor: Sensor, frame: str, header: tuple[tuple[str, int], ...]
) -> LayoutRanges | None:
    """Return the ranges of the fields in frames with these header values.

    Returns None if no valid frame with these values is found.

    Args:
        frame: a frame type that is compiled and has no parts.
        header: path and raw value of each field that the layout depends on.
    """
    values = dict(header)
    layout = _find_layout(sensor, frame, values)
    rows = np.zeros((1, layout.size), np.uint8)
    frame_coder(sensor.frames[frame]).make_encodable(rows, layout)
    for leaf in layout.leaves.values():
        if leaf.info.initial:
            leaf.store(rows, leaf.info.initial)
    for path, value in header:
        layout.leaves[path].store(rows, value)
    layout.complete_rows(rows)
    if _are_valid(sensor, frame, layout, rows)[0]:
        return LayoutRanges(sensor, frame, layout, values, rows[0])
    fixed = {path: functools.partial(return_raw, value) for path, value in header}
    with contextlib.suppress(SpecError):
        layout, row = draw_row(sensor, frame, random.Random(0), fixed, tries=TRIES)
        return LayoutRanges(sensor, frame, layout, values, row)
    return None


@functools.lru_cache(maxsize=1024)
def find_headers(sensor: Sensor, frame: str) -> list[tuple[tuple[str, int], ...]]:
    """Return the distinct headers of a few random frames, in order of frame length.

    Raises:
        SpecError: if no random frame is plausible.
    """
    sizes: dict[tuple[tuple[str, int], ...], int] = {}
    for seed in range(KNOWN_HEADERS):
        layout, row = draw_row(sensor, frame, random.Random(seed))
        sizes[_find_header(sensor, frame, row.tobytes())] = layout.size
    return sorted(sizes, key=lambda header: (sizes[header], header))


def _find_header(sensor: Sensor, frame: str, struct: bytes) -> tuple[tuple[str, int], ...]:
    """Return (path, value) of each field that determines the layout of a struct."""
    values: dict[str, int] = {}
    while True:
        try:
            _find_layout(sensor, frame, values)
        except UnknownSelectorError as unknown:
            leaf = unknown.leaf
            if isinstance(leaf, Leaf):
                values[leaf.info.path] = leaf.read_scalar(struct)
        else:
            return tuple(values.items())


def _find_layout(sensor: Sensor, frame: str, header: Mapping[str, int]) -> Layout:
    declared = sensor.frames[frame]
    return find_layout(declared.tree, header, declared.max_struct_bytes)


def _are_valid(
    sensor: Sensor, frame: str, layout: Layout, rows: NDArray[np.uint8]
) -> NDArray[np.bool_]:
    """Return for each struct whether it is valid and can be encoded, (n,)."""
    mask = valid_mask(sensor, frame, layout, rows)
    declared = sensor.frames[frame]
    if declared.wire is not None:
        encode = frame_coder(declared).encode
        for index in np.flatnonzero(mask):
            mask[index] = encode(rows[index].tobytes()) is not None
    return mask


@functools.lru_cache(maxsize=1024)
def find_valid_frames(sensor: Sensor, frame: str) -> list[bytes]:
    """Return a few valid frames of a type that is not compiled, the shortest first."""
    frames: set[bytes] = set()
    with contextlib.suppress(SpecError):
        for seed in range(KNOWN_FRAMES):
            frames.add(draw_frame(sensor, frame, random.Random(seed), {}, tries=MAX_WALKS))
    return sorted(frames, key=lambda data: (len(data), data))


@functools.lru_cache(maxsize=1024)
def is_often_valid(sensor: Sensor, frame: str) -> bool:
    """Return whether random values often make a valid frame of a type."""
    return any(_is_random_frame_valid(sensor, frame, seed) for seed in range(SINGLE_WALKS))


def _is_random_frame_valid(sensor: Sensor, frame: str, seed: int) -> bool:
    """Return whether one frame of random values is valid."""
    try:
        draw_frame(sensor, frame, random.Random(seed), {}, tries=1)
    except SpecError:
        return False
    return True


@functools.lru_cache(maxsize=1024)
def find_value_ranges(sensor: Sensor, frame: str) -> Mapping[str, tuple[int, int]]:
    """Return the lowest and highest valid raw value of integer fields of a frame.

    Fields with a single valid value, and fields that decide which fields follow, are left out.
    """
    if sensor.frames[frame].plausible is None:
        return {}
    examples = find_valid_frames(sensor, frame)
    if not examples:
        return {}
    engine = get_codec(sensor.frames[frame])
    base = parse(sensor, examples[0], frame=frame)
    rules = [formula for node in nodes(engine.frame.tree) for formula in formulas(node)]
    deciding = {ref.path for rule in rules for ref in refs(rule)}
    bounded = {
        path: (info, values[0])
        for path, info in engine.schema.all_fields.items()
        if info.kind == "int"
        and info.const is None
        and info.rebuilt is None
        and path not in deciding
        and (values := list(_iter_values_at(base, path.split("."))))
    }

    def are_valid(tried: Sequence[tuple[str, int]]) -> list[bool]:
        return [_can_build(sensor, frame, _with_value(base, path, value)) for path, value in tried]

    lowest = {path: (raw, info.limits[0]) for path, (info, raw) in bounded.items()}
    highest = {path: (raw, info.limits[1]) for path, (info, raw) in bounded.items()}
    low = find_nearest_valid_values(lowest, are_valid)
    high = find_nearest_valid_values(highest, are_valid)
    return {path: (low[path], high[path]) for path in bounded if low[path] < high[path]}


def _iter_values_at(parsed: Any, names: Sequence[str]) -> Iterator[int]:
    """Yield the integers of a field of a parsed frame, in all elements of its arrays."""
    if isinstance(parsed, list):
        for element in parsed:
            yield from _iter_values_at(element, names)
    elif names and isinstance(parsed, dict):
        yield from _iter_values_at(parsed.get(names[0]), names[1:])
    elif not names and isinstance(parsed, int | str):
        yield int(parsed)


def _with_value(parsed: Any, path: str, value: int) -> Any:
    """Return a copy of a parsed frame with a value in all elements of a field."""
    changed = copy.deepcopy(parsed)
    *parents, name = path.split(".")
    for holder in _iter_holders(changed, parents):
        if name in holder:
            is_array = isinstance(holder[name], list)
            holder[name] = [value] * len(holder[name]) if is_array else value
    return changed


def _iter_holders(parsed: Any, names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yield each struct at a path of a parsed frame, one for each array element."""
    if isinstance(parsed, list):
        for element in parsed:
            yield from _iter_holders(element, names)
    elif isinstance(parsed, dict) and names:
        yield from _iter_holders(parsed.get(names[0]), names[1:])
    elif isinstance(parsed, dict):
        yield parsed


def _can_build(sensor: Sensor, frame: str, values: Any) -> bool:
    """Return whether values build a valid frame."""
    try:
        data = build(sensor, frame, values, {})
    except LidarSpecError:
        return False
    engine = get_codec(sensor.frames[frame])
    status = engine.survey(np.frombuffer(data, np.uint8), np.zeros(1, np.intp)).status
    return bool(status[0] == VALID)


def _find_limits(leaf: Leaf) -> tuple[int, int]:
    if leaf.info.kind == "bytes":
        return 0, 255
    return leaf.info.limits
