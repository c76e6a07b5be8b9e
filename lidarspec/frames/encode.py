"""Encode one frame from the values of its fields, by its layout.

The values of the header fields select the layout, and each value is stored at its offset. Lengths,
constants and checksums are written last.
"""

from __future__ import annotations

import bisect
import contextlib
import functools
import itertools
import operator
from collections.abc import Mapping
from typing import Any

import numpy as np
from construct import Container
from numpy.typing import NDArray

from lidarspec.errors import MissingField, OutOfRange, UsageError
from lidarspec.frames.field_paths import split_path
from lidarspec.frames.layout import FrameChecksum, Layout, Leaf
from lidarspec.frames.layout_tree import InvalidCaseError, InvalidLengthError, find_kinds
from lidarspec.frames.measured_size import FOUND, MeasuredSize
from lidarspec.frames.parts import LayoutLookup
from lidarspec.frames.schema import Schema, find_count_field, make_schema
from lidarspec.spec.enum_values import find_code
from lidarspec.spec.syntax import WireNaN, get_member
from lidarspec.spec.tree import (
    Adapter,
    Blob,
    Block,
    ChecksummedStruct,
    FieldInfo,
    Formula,
    Kind,
    Node,
    Number,
    PartSequence,
    Read,
    Repeat,
    Select,
    Struct,
    When,
    evaluate,
    format_hex,
    format_values,
    nodes,
)

#: The largest value that is tried for a count field.
MAX_COUNT_TRIED = 65535


def encode(layouts: LayoutLookup, given: Container, place: str) -> bytes:
    """Return the bytes of a frame.

    Args:
        given: the raw values by name, nested as in the struct. Missing values are added to it.
        place: the names of sensor and frame, for messages.

    Raises:
        UsageError: for a missing value, or a value that its field cannot represent.
    """
    return _Encoder(layouts, given, place).encode()


class _Encoder:
    """Encodes one frame, or one part of a frame."""

    def __init__(
        self,
        layouts: LayoutLookup,
        given: Container,
        place: str,
        prefix: str = "",
        around: Mapping[str, int] | None = None,
    ) -> None:
        self._layouts = layouts
        self._given = given
        self._place = place
        #: The path of the part in the outer frame, for messages; "" for a frame.
        self._prefix = prefix
        #: For a part, the values of fields of the outer frame, by their path in it.
        self._around = around or {}
        self._schema = make_schema(layouts.root)
        #: The paths of the fields with checksums, which need not be given.
        self._checksums = set[str]()
        #: The sizes of texts and the total sizes of parts in bytes, by their paths in formulas.
        self._totals: dict[str, int] = {}
        #: The raw values of each field, element by element.
        self._columns: dict[str, list[Any]] = {}
        #: The index of the element that is being collected, by the axis of its array.
        self._indices: dict[str, int] = {}

    def encode(self) -> bytes:
        fill_counts(self._given, self._schema)
        parts = dict[str, list[bytes]]()
        for axis, node in self._schema.parts.items():
            if node.is_array and get_member(self._given, axis, None) is None:
                continue  # the header decides whether the frame has the array
            parts[axis] = self._encode_parts(node)
            self._totals[node.total.path] = sum(map(len, parts[axis]))
        self._measure_texts()
        layout = self._find_layout()
        for checksum in layout.checksums:
            for leaf in checksum.leaves:
                self._checksums.add(leaf.info.path)
        for axis in layout.regions:
            if axis not in parts:
                raise self._make_missing_error(axis)
        self._collect(self._layouts.root, self._given, "", self._prefix, layout)
        row = np.zeros((1, layout.size), np.uint8)
        for path, leaf in layout.leaves.items():
            if path in self._columns:
                self._store(row, leaf, self._columns[path])
        for axis, region in layout.regions.items():
            data = b"".join(parts[axis])
            row[0, region.start : region.start + len(data)] = np.frombuffer(data, np.uint8)
        layout.write_constants(row)
        for checksum in layout.checksums:
            if not self._is_absent(checksum, row):
                checksum.fill(row)
        self._check(layout, row, parts)
        return row.tobytes()

    def _measure_texts(self) -> None:
        """Find the sizes of the texts that end at an end mark or with the datagram."""
        for path, ending in self._schema.endings.items():
            if ending.size.axes:
                continue  # the text is in a part, whose own encoder measures it
            info = self._schema.fields[path]
            shown = self._make_shown_path(path)
            value = get_member(self._given, path, None)
            if value is None:
                value = self._find_implied(info)
            if value is None:
                continue  # the header decides whether the frame has the text
            if info.adapter is not None:
                value = self._encode_adapted(info.adapter, shown, value, 0)
            if not isinstance(value, bytes | bytearray | memoryview):
                raise self._make_value_error(shown, "bytes", value)
            data = bytes(value)
            if ending.find(data + ending.terminator) != len(data):
                expected = f"bytes without {ending.mark.hex(' ')}"
                raise self._make_value_error(shown, expected, value)
            self._totals[ending.size.path] = len(data)

    def _find_layout(self) -> Layout:
        """Return the layout that the values of the header fields select."""
        try:
            return self._layouts.layout_for(self._read_header)
        except InvalidCaseError as fault:
            raise UsageError(
                f"{self._place}: {fault}: these values select an invalid case (construct's Error)"
            ) from None
        except InvalidLengthError as fault:
            raise UsageError(
                f"{self._place}: {self._prefix or fault or 'the frame'}: the frame would be"
                f" longer than {self._layouts.limit} bytes with these values"
            ) from None

    def _read_header(self, leaf: Leaf | MeasuredSize) -> int:
        """Return the value of a field that the layout depends on."""
        path = leaf.info.path
        if isinstance(leaf, MeasuredSize) and path not in self._totals:
            raise self._make_missing_error(path.removesuffix(".size"))
        value = self.read(path)
        if value is None:
            raise self._make_missing_field_error(path)
        return int(value)

    def read(self, path: str) -> Any:
        """Return the value of a field for a formula (see `lidarspec.spec.tree.Read`)."""
        if path.startswith("_."):
            return self._around[path[2:]]
        if path in self._totals:
            return self._totals[path]
        value: Any = self._given
        names = ""
        for step in split_path(path):
            if isinstance(value, list) and not isinstance(step, int):
                value = value[self._indices[names]]
            if isinstance(step, int):
                value = value[step]
            else:
                names = f"{names}.{step}".lstrip(".")
                if isinstance(value, Mapping):
                    value = value.get(step)
                else:
                    value = None
        if isinstance(value, list) and names in self._indices:
            value = value[self._indices[names]]
        info = self._schema.columns[path]
        if value is None or (info.rebuilt is not None and not info.is_enforced):
            value = self._find_implied(info)
        if value is None:
            return None
        return to_raw(info, value)

    def _find_implied(self, info: FieldInfo) -> Any:
        """Return the constant, computed or default value of a field; None without one."""
        if info.const is not None:
            return info.const
        if info.rebuilt is not None and not info.is_enforced:
            return evaluate(info.rebuilt, self.read)
        return evaluate(info.default, self.read)

    def _encode_parts(self, node: PartSequence) -> list[bytes]:
        """Return the bytes of parts, and set the fields that count or measure them."""
        parts = get_member(self._given, node.axis, None)
        if parts is None:
            raise self._make_missing_error(node.axis)
        if not isinstance(parts, list) or not all(isinstance(part, dict) for part in parts):
            raise self._make_value_error(self._make_shown_path(node.axis), "a list of parts", parts)
        around = {}
        for ref in node.outer:
            value = self.read(ref.path)
            if value is not None:
                around[ref.path] = int(value)
        kinds = [find_kind(node, part) for part in parts]
        layouts = {
            kind.node: kind.layouts
            for kind in find_kinds(node, tuple(around.items()), self._layouts.limit)
        }
        encoded: list[bytes] = []
        following = 0
        # From the last to the first: in a chain, a part declares the size of the next part.
        for index in reversed(range(len(parts))):
            kind = kinds[index]
            part = parts[index]
            set_count(kind.following, part, following, make_schema(kind.root).fields, node.axis)
            prefix = self._make_shown_path(f"{node.axis}[{index}]")
            encoder = _Encoder(layouts[kind], part, self._place, prefix, around)
            encoded.insert(0, encoder.encode())
            following = len(encoded[0])
        total = sum(map(len, encoded))
        fields = self._schema.columns
        rules = ((node.count, len(encoded)), (node.size, following), (node.within, total))
        for formula, value in rules:
            if node.is_array and formula is not None:
                remove_computed_count(formula, self._given, fields)
            set_count(formula, self._given, value, fields, node.axis)
        return encoded

    def _collect(self, node: Node, value: Any, path: str, shown: str, layout: Layout) -> None:
        """Collect the values of all fields in a node.

        Args:
            value: the given value; None if it is missing.
            path: the path of the node without indices.
            shown: the path of the node with indices.
        """
        match node:
            case ChecksummedStruct():
                self._collect(node.body, value, path, shown, layout)
            case Struct():
                self._collect_struct(node, value, shown, layout)
            case Repeat():
                self._collect_array(node, value, path, shown, layout)
            case When() | Select():
                self._collect(layout.branches[node], value, path, shown, layout)
            case Block():
                self._collect_block(node, value, path, shown)
            case Number() | Blob() if path and node.name:
                self._add_value(node.info, path, shown, value, layout.leaves[path].size)

    def _collect_struct(self, node: Struct, value: Any, shown: str, layout: Layout) -> None:
        if value is None:
            value = {}
        if not isinstance(value, Mapping):
            raise self._make_value_error(shown, "a mapping of field names to values", value)
        for child in node.members:
            path = f"{node.path}.{child.name}".strip(".")
            below = f"{shown}.{child.name}".strip(".")
            self._collect(child, value.get(child.name), path, below, layout)

    def _collect_array(
        self, node: Repeat, value: Any, path: str, shown: str, layout: Layout
    ) -> None:
        if isinstance(node.count, int):
            count = node.count
        else:
            count = layout.lengths[node.axis]
        if value is None:
            value = node.default
        if value is None:
            if not count:
                return
            raise MissingField(shown, place=self._place)
        if not isinstance(value, list | tuple | bytes):
            raise self._make_value_error(shown, "a list of elements", value)
        if len(value) != count:
            raise UsageError(f"{self._place}: {shown}: expected {count} elements, got {len(value)}")
        for index, element in enumerate(value):
            self._indices[node.axis] = index
            self._collect(node.element, element, path, f"{shown}[{index}]", layout)
        self._indices.pop(node.axis, None)

    def _collect_block(self, node: Block, value: Any, path: str, shown: str) -> None:
        for part in node.parts:
            names = ".".join(name for name in (path, *part.names) if name)
            if not names:
                continue
            below = shown
            found = value
            for key in part.bits.keys:
                if isinstance(key, int):
                    below = f"{below}[{key}]"
                    found = self._get_element(found, key, below)
                else:
                    below = f"{below}.{key}".strip(".")
                    if found is not None and not isinstance(found, Mapping):
                        raise self._make_value_error(
                            below, "a mapping of field names to values", found
                        )
                    found = None if found is None else found.get(key)
            if part.bits.flag and found is not None:
                found = int(bool(found))
            self._add_value(part.info, names, below, found, 0)

    def _get_element(self, array: Any, index: int, shown: str) -> Any:
        """Return an element of an array of bit fields; None if the array is missing."""
        if array is None:
            return None
        if not isinstance(array, list | tuple | bytes):
            raise self._make_value_error(shown, "a list of elements", array)
        if index >= len(array):
            raise MissingField(shown, place=self._place)
        return array[index]

    def _add_value(self, info: FieldInfo, path: str, shown: str, value: Any, size: int) -> None:
        """Check one value of a field, and store it for encoding.

        Args:
            shown: the path with indices, for error messages.
            size: the size of the field in bytes.
        """
        column = self._columns.setdefault(path, [])
        if info.is_enforced and info.rebuilt is not None:
            column.append(0)  # written with the lengths of the layout
            return
        if value is None or info.rebuilt is not None:
            value = self._find_implied(info)
            if info.kind == "bytes" and isinstance(value, bytes) and len(value) == 1:
                value *= size  # a pattern byte fills the field
        if value is None:
            if path not in self._checksums:
                raise MissingField(shown, place=self._place)
            column.append(bytes(size) if info.kind == "bytes" else 0)
            return
        if info.const is not None and to_raw(info, value) != info.const:
            raise self._make_value_error(shown, format_hex(info.const), value)
        if info.adapter is not None:
            value = self._encode_adapted(info.adapter, shown, value, size)
        if info.kind == "bytes":
            column.append(self._to_bytes(shown, value, size))
        elif info.kind == "float":
            column.append(self._to_float(shown, value))
        else:
            column.append(self._to_integer(info, shown, value))

    def _encode_adapted(self, adapter: Adapter, shown: str, value: Any, size: int) -> Any:
        try:
            return adapter.encode(value, size)
        except Exception as error:  # the author's function may raise anything
            # The first line of an error of construct is the path.
            last_line = str(error).rpartition("\n")[2]
            reason = f"{type(error).__name__}: {last_line}"
            raise UsageError(
                f"{self._place}: {shown}: {value!r:.60} cannot be encoded: {reason}"
            ) from None

    def _to_bytes(self, shown: str, value: Any, size: int) -> bytes:
        if isinstance(value, int) and 0 <= value < 1 << 8 * size:
            value = value.to_bytes(size, "big")
        if not isinstance(value, bytes | bytearray):
            raise self._make_value_error(shown, f"{size} bytes", value)
        if len(value) != size:
            raise UsageError(f"{self._place}: {shown}: expected {size} bytes, got {len(value)}")
        return bytes(value)

    def _to_float(self, shown: str, value: Any) -> float:
        if not isinstance(value, int | float):
            raise self._make_value_error(shown, "a number", value)
        return value

    def _to_integer(self, info: FieldInfo, shown: str, value: Any) -> int:
        raw = value if info.adapter is not None else to_raw(info, value)
        if not isinstance(raw, int):
            if info.labels and isinstance(raw, str):
                raise self._make_value_error(
                    shown, f"one of {', '.join(info.labels.values())}", raw
                )
            raise self._make_value_error(shown, "an integer", raw)
        low, high = info.limits
        if not low <= raw <= high:
            raise OutOfRange(shown, raw, low, high, place=self._place)
        if info.allowed is not None and raw not in info.allowed:
            raise self._make_value_error(shown, format_values(info.allowed), raw)
        return raw

    def _store(self, row: NDArray[np.uint8], leaf: Leaf, column: list[Any]) -> None:
        """Write the values of a field into the bytes of the frame."""
        if not column:
            return
        if leaf.info.kind == "bytes":
            leaf.store(row, np.frombuffer(b"".join(column), np.uint8).reshape(1, *leaf.shape))
            return
        values = np.array(column, leaf.info.dtype).reshape(1, *leaf.shape)
        leaf.store(row, values)
        if leaf.info.kind == "float":
            self._check_floats(leaf, column, values)
            self._store_nan_bits(row, leaf, column)

    def _check_floats(self, leaf: Leaf, column: list[Any], values: NDArray[Any]) -> None:
        """Raise `OutOfRange` if a finite number became infinite."""
        wide = np.array(column, np.float64).reshape(values.shape)
        lost = np.isinf(values) & np.isfinite(wide)
        if lost.any():
            largest = float(np.finfo(values.dtype).max)
            number = float(wide[lost][0])
            raise OutOfRange(leaf.info.path, number, -largest, largest, place=self._place)

    def _store_nan_bits(self, row: NDArray[np.uint8], leaf: Leaf, column: list[Any]) -> None:
        """Write the original bits of each NaN that was parsed from a frame."""
        for value, offset in zip(column, leaf.offsets(), strict=True):
            if isinstance(value, WireNaN) and len(value.raw) == leaf.size:
                row[0, offset : offset + leaf.size] = np.frombuffer(value.raw, np.uint8)

    def _is_absent(self, checksum: FrameChecksum, row: NDArray[np.uint8]) -> bool:
        """Return whether the caller gave a value that means "no checksum"."""
        if not checksum.absent or any(
            get_member(self._given, leaf.info.path, None) is None for leaf in checksum.leaves
        ):
            return False
        return int(checksum.load_stored(row)[0]) in checksum.absent

    def _check(
        self, layout: Layout, row: NDArray[np.uint8], parts: Mapping[str, list[bytes]]
    ) -> None:
        """Check that the parts agree with the header, and that all conditions are true."""
        for axis, region in layout.regions.items():
            count = region.rule.count
            if count is not None and count != len(parts[axis]):
                raise UsageError(
                    f"{self._place}: {self._make_shown_path(axis)}: expected {count} parts, got"
                    f" {len(parts[axis])}"
                )
            _, walked = region.find_parts(row)
            if walked.status[0] != FOUND or walked.sizes[0] != region.size:
                raise UsageError(
                    f"{self._place}: {self._make_shown_path(axis)}:"
                    " the sizes of the parts differ from the sizes in the header"
                )
        for condition in layout.conditions:
            if not layout.meet_condition(condition, row)[0]:
                named = ", ".join(info.path for info in condition.fields)
                raise UsageError(
                    f"{self._place}: the values of {named} do not meet a condition of the struct:"
                    " `lidarspec show` lists the conditions"
                )

    def _make_shown_path(self, path: str) -> str:
        return f"{self._prefix}.{path}".strip(".")

    def _make_missing_field_error(self, path: str) -> UsageError:
        """Return the error for a missing field that the layout depends on."""
        for axis, counting in self._schema.counting_fields.items():
            if counting != path:
                continue
            array = get_member(self._given, axis, None)
            if array is None:
                return self._make_missing_error(axis)
            return self._make_value_error(self._make_shown_path(axis), "a list of elements", array)
        return self._make_missing_error(path)

    def _make_missing_error(self, path: str) -> MissingField:
        return MissingField(self._make_shown_path(path), place=self._place)

    def _make_value_error(self, shown: str, expected: str, found: object) -> UsageError:
        return UsageError(
            f"{self._place}: {shown or 'frame'}: expected {expected}, got {found!r:.60}"
        )


def to_raw(info: FieldInfo, value: Any) -> Any:
    """Return the raw value of a field."""
    if info.adapter is not None and info.kind == "int" and value is not None:
        return info.adapter.encode(value, 0)
    if isinstance(value, str):
        return find_code(info, value)
    if info.kind == "int" and isinstance(value, bytes) and len(value) == info.bits // 8 == 1:
        return value[0]
    return value


def fill_counts(given: Container, table: Schema) -> None:
    """Set the header fields that contain the lengths of arrays."""
    counted = set[str]()
    for axis, count in table.arrays.items():
        array = get_member(given, axis, None)
        path = table.counting_fields[axis]
        adapter = table.fields[axis].adapter if axis in table.fields else None
        if adapter is not None and array is not None:
            with contextlib.suppress(Exception):  # `_encode_adapted` raises the error
                array = adapter.encode(array, 0)
        if not isinstance(array, list | bytes) or path is None or path in counted:
            continue
        counted.add(path)
        if axis in table.branched and get_member(given, path, None) is not None:
            continue  # the branch, and so the formula of the length, is not known yet
        remove_computed_count(count, given, table.fields)
        set_count(count, given, len(array), table.fields, axis)


def remove_computed_count(
    formula: Formula | None, given: Container, fields: Mapping[str, FieldInfo]
) -> None:
    """Remove the count field of a formula from `given` if the field is enforced.

    An enforced field must contain the actual count, so a given value is not used.
    """
    path = None if formula is None else find_count_field(formula, fields)
    if path is not None and fields[path].is_enforced:
        holder, name = _find_holder(given, path)
        holder.pop(name, None)


def set_count(
    formula: Formula | None,
    given: Container,
    value: int,
    fields: Mapping[str, FieldInfo],
    axis: str,
) -> None:
    """Set the count field of a formula, if the field has no value yet.

    The formula then results in `value`.

    Args:
        axis: the path of the array or of the parts, for messages.
    """
    if formula is None:
        return
    path = find_count_field(formula, fields)
    if path is None:
        return
    holder, name = _find_holder(given, path)
    if isinstance(holder, dict) and holder.get(name) is None:
        read = functools.partial(read_given_value, given, fields)
        holder[name] = _find_count(formula, read, holder, name, value, fields[path], axis)


def _find_holder(values: Any, path: str) -> tuple[Any, str]:
    """Return the mapping that contains a field, and the name of the field in it."""
    *parents, last = path.split(".")
    for parent in parents:
        values = values.setdefault(parent, Container())
    return values, last


def _find_count(
    count: Formula,
    read: Read,
    holder: Container,
    field: str,
    length: int,
    info: FieldInfo,
    axis: str,
) -> int:
    """Return the value of a count field for which the formula results in `length`."""
    if info.kind == "int":
        top = int(info.limits[1])
    else:
        top = MAX_COUNT_TRIED

    def length_for(value: int) -> Any:
        holder[field] = value
        try:
            return evaluate(count, read)
        except Exception:  # an expression of the struct may divide by the value
            return -1

    tried = range(min(top, MAX_COUNT_TRIED) + 1)
    # Usually it is the length itself, or the length increases with it.
    if length <= top and length_for(length) == length:
        return length
    guess = bisect.bisect_left(tried, length, key=length_for)
    for value in itertools.chain((guess,), tried):
        if value <= top and length_for(value) == length:
            return value
    raise UsageError(f"{axis}: no value of {field} results in the length {length}")


def find_kind(node: PartSequence, part: Mapping[str, Any]) -> Kind:
    """Return the kind of part that fits the given values best.

    The first kind is returned if no kind fits.
    """
    # A kind fits if it has all given fields, and if the given values agree with its constants. Of
    # the kinds that fit, the one with the fewest missing values is the best.
    possible = list[tuple[int, Kind]]()
    for kind in node.kinds:
        fields = make_schema(kind.root)
        constants = [(info, part.get(path)) for path, info in fields.fields.items()]
        is_known = part.keys() <= {*list_paths(kind.root), *fields.parts}
        if is_known and all(
            value in (None, info.const, info.labels.get(info.const))
            for info, value in constants
            if info.const is not None
        ):
            names = {path.partition(".")[0] for path in fields.fields}
            possible.append((len(names - part.keys()), kind))
    if not possible:
        return node.kinds[0]
    return min(possible, key=operator.itemgetter(0))[1]


@functools.lru_cache(maxsize=1024)
def list_paths(root: Node) -> frozenset[str]:
    """Return the paths of all fields of a frame type, and of the structs around them."""
    table = make_schema(root)
    paths = {*table.all_fields, *table.arrays, *table.derived}
    for node in nodes(root):
        if isinstance(node, Struct):
            paths |= {f"{node.path}.{child.name}".strip(".") for child in node.members}
    split = [path.split(".") for path in paths]
    return frozenset(".".join(names[:depth]) for names in split for depth in range(len(names) + 1))


def read_given_value(given: Mapping[str, Any], fields: Mapping[str, FieldInfo], path: str) -> Any:
    """Return the given value of a field for a formula (see `spec.tree.Read`).

    Raises:
        LookupError: if the value is missing.
    """
    value: Any = given
    for step in split_path(path):
        value = value[step]
    if value is None:
        return None
    return to_raw(fields[path], value)
