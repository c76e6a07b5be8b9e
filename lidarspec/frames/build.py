"""Build one frame from values: check names, units and ranges, then encode it."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from construct import Container

from lidarspec.errors import (
    LidarSpecError,
    OutOfRange,
    UnknownField,
    UnknownFrame,
    UsageError,
    struct_error,
)
from lidarspec.frames.compilability import NotCompilableError
from lidarspec.frames.encode import encode, fill_counts, list_paths
from lidarspec.frames.field_paths import put_value, split_path
from lidarspec.frames.layout_tree import frame_layouts
from lidarspec.frames.plain import build_plain
from lidarspec.frames.schema import Schema, make_schema, without_indices
from lidarspec.frames.wire_coder import SPELLING, frame_coder
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.syntax import WireNaN
from lidarspec.spec.tree import FieldInfo, Node

#: A path with indices, such as "rows[3].value".
PATH = re.compile(r"\w+(\[\d+\])*(\.\w+(\[\d+\])*)*")


def build(
    sensor: SensorDescription,
    frame: str,
    value: Any,
    values: Mapping[str, Any],
    *,
    units: bool = False,
) -> bytes:
    """Return the bytes of one frame; constants, counts and checksums are computed.

    Args:
        value: the fields by name, for example a result of `parse`; None if `values` has all fields.
        values: further fields by path, such as "flags.valid"; they replace fields in `value`.
        units: whether the values are physical values instead of raw values. They are rounded to the
            resolution of the fields.

    Raises:
        UsageError: for a missing or unknown field, or a value that its field cannot represent.
    """
    if frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    if value is not None and not isinstance(value, Mapping):
        raise UsageError(
            f"{sensor.id} {frame}: expected fields by name, got {type(value).__name__}"
        )
    declared = sensor.frames[frame]
    place = f"{sensor.id} {frame}"
    checker = _ValueChecker(
        make_schema(declared.tree), list_paths(declared.tree), place, units=units
    )
    _check_paths(values, declared.tree, place)
    checked = checker.check(_merge_values(value or {}, values, place), "")
    layouts = frame_layouts(declared)
    if isinstance(layouts, NotCompilableError):
        fill_counts(checked, make_schema(declared.tree))
        return build_plain(declared, checked, place)
    try:
        struct = encode(layouts, checked, place)
    except LidarSpecError:
        raise
    except Exception as error:  # an expression or a checksum of the plugin
        raise struct_error(error, path=frame, sensor=sensor.id) from error
    if declared.wire is None:
        return struct
    data = frame_coder(declared).encode(struct, (value or {}).get(SPELLING))
    if data is None:
        raise UsageError(
            f"{place}: {declared.wire} cannot encode these values, because a number has too many"
            " digits or a text contains a separator"
        )
    return data


def _check_paths(values: Mapping[str, Any], root: Node, place: str) -> None:
    """Raise `UnknownField` for a path in `values` that the frame does not have."""
    known = list_paths(root)
    for path in values:
        if not path.isidentifier() and (
            not PATH.fullmatch(path) or without_indices(path)[0] not in known
        ):
            raise UnknownField(path, [name for name in known if name], place=place)


def _merge_values(
    value: Mapping[str, Any], values: Mapping[str, Any], place: str
) -> Mapping[str, Any]:
    """Return the fields of `value`; fields in `values` override them."""
    nested = {name: new for name, new in values.items() if not name.isidentifier()}
    merged: dict[str, Any] = {**value, **values}
    if not nested:
        return merged
    merged = copy.deepcopy({name: old for name, old in merged.items() if name not in nested})
    for name, new in nested.items():
        try:
            put_value(merged, split_path(name), new)
        except (AttributeError, TypeError, ValueError):
            raise UsageError(
                f"{place}: {name} cannot be set: the given values have no field of this name, or"
                " an array in the name has no index, as in points[0].distance"
            ) from None
    return merged


class _ValueChecker:
    """Checks the names and ranges of the caller's values, and converts them to raw values."""

    def __init__(self, table: Schema, paths: frozenset[str], place: str, *, units: bool) -> None:
        self._table = table
        self._paths = paths
        self._place = place
        self._units = units

    def check(self, value: Any, path: str, shown: str = "") -> Any:
        info = self._table.all_fields.get(path)
        if info is not None and info.kind == "other" and not (self._units and info.scaled):
            return value  # construct checks it when the frame is built
        if info is not None and info.adapter is not None:
            return value  # the adapter of the field encodes it
        if isinstance(value, Mapping):
            return self._check_mapping(value, path, shown)
        if info is not None and info.kind == "bytes" and isinstance(value, bytes | bytearray):
            return bytes(value)
        if isinstance(value, np.ndarray):
            value = value.tolist()
        if isinstance(value, list | tuple):
            elements = []
            for index, element in enumerate(value):
                elements.append(self.check(element, path, f"{shown}[{index}]"))
            if info is not None and info.kind == "bytes":
                return self._to_bytes(elements, shown)
            return elements
        if info is None or value is None:
            return value
        return self._to_raw_number(info, value, shown)

    def _check_mapping(self, value: Mapping[str, Any], path: str, shown: str) -> Container:
        checked = Container()
        for name, element in value.items():
            if name.startswith("_"):
                continue
            below = f"{path}.{name}" if path else name
            if below not in self._paths:
                raise UnknownField(
                    below, [known for known in self._paths if known], place=self._place
                )
            checked[name] = self.check(element, below, f"{shown}.{name}" if shown else name)
        return checked

    def _to_bytes(self, numbers: list[Any], shown: str) -> bytes | list[Any]:
        """Return a list of numbers as bytes; return a list of other values unchanged."""
        if not any(isinstance(part, int | str) for part in numbers):
            return numbers
        try:
            return bytes(numbers)
        except (TypeError, ValueError):
            raise UsageError(
                f"{self._place}: {shown} must be bytes or a list of numbers from 0 to 255, not"
                f" {numbers!r:.60}"
            ) from None

    def _to_raw_number(self, info: FieldInfo, value: Any, shown: str) -> Any:
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, str | WireNaN | bytes):
            return value
        if info.kind not in ("int", "float"):
            if self._units and info.scaled and isinstance(value, int | float):
                return info.raw(value)
            return value
        if info.kind == "float":
            raw = info.raw(value) if self._units else value
            if isinstance(raw, int):
                return raw
            return float(raw)
        if isinstance(value, float) and (
            not np.isfinite(value) or (not self._units and value != int(value))
        ):
            raise UsageError(
                f"{self._place}: {shown} = {value} is not a raw integer: pass units=True for"
                " physical values"
            )
        if self._units:
            raw = info.raw(value)
        else:
            raw = int(value)
        low, high = info.limits
        if not low <= raw <= high:
            shown_values = [
                info.physical(part) if self._units else part for part in (raw, low, high)
            ]
            raise OutOfRange(
                shown, *shown_values, unit=info.unit if self._units else "", place=self._place
            )
        return int(raw)
