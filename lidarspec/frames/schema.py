"""List the fields of a frame type from its tree."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np

from lidarspec.errors import SpecError, UnknownField
from lidarspec.spec.tree import (
    Blob,
    Block,
    Derived,
    Ending,
    FieldInfo,
    Formula,
    Kind,
    Node,
    Number,
    Op,
    Opaque,
    PartSequence,
    Repeat,
    Select,
    Struct,
    When,
    children,
    get_element,
    nodes,
    refs,
)

#: The index of an array element in a path, such as "columns[0].timestamp".
_INDEX = re.compile(r"\[(-?\d+)\]")

_Field = TypeVar("_Field")


@lru_cache(maxsize=1024)
def without_indices(path: str) -> tuple[str, dict[str, int]]:
    """Return a path without its indices, and the indices by the path of their array.

    For "a[0].b" the result is ("a.b", {"a": 0}).
    """
    names = ""
    indices = dict[str, int]()
    for name, *numbers in (
        _INDEX.split(part)[:1] + _INDEX.findall(part) for part in path.split(".")
    ):
        names = f"{names}.{name}".lstrip(".")
        indices |= {names + "[]" * depth: int(number) for depth, number in enumerate(numbers)}
    return names, indices


class PathMapping(dict[str, _Field]):
    """A mapping from paths of fields to values, which also accepts paths of elements.

    The path of an element has an index: "columns[0].timestamp".

    Args:
        element: a function that returns the value of an element, or None if there is no such
            element.
    """

    def __init__(
        self,
        values: Mapping[str, _Field],
        element: Callable[[_Field, str, Mapping[str, int]], _Field | None],
    ) -> None:
        super().__init__(values)
        self._element = element
        self._elements = dict[str, _Field | None]()

    def __missing__(self, path: str) -> _Field:
        found: _Field | None = self.get(path)
        if found is None:
            raise KeyError(path)
        return found

    def __contains__(self, path: object) -> bool:
        return super().__contains__(path) or (isinstance(path, str) and self.get(path) is not None)

    def get(self, path: str, default: Any = None) -> Any:
        if "[" not in path:
            return super().get(path, default)
        if path not in self._elements:
            base, indices = without_indices(path)
            known = super().get(base)
            self._elements[path] = None if known is None else self._element(known, path, indices)
        element = self._elements[path]
        if element is None:
            return default
        return element


@dataclass(frozen=True, eq=False)
class Schema:
    """All fields of a frame type and their arrays, in wire order.

    Attributes:
        fields: the fields, by path.
        arrays: the declared length of each array, by path: a number if all frames have the same
            length, else a formula of header fields, or None if only construct can determine it.
        parts: the parts (frames within the frame), by path.
        inside: the fields of the parts, by their path in the frame.
        derived: the values without bytes of their own, by path.
    """

    fields: Mapping[str, FieldInfo]
    arrays: Mapping[str, Formula | None]
    parts: Mapping[str, PartSequence] = field(default_factory=dict)
    inside: Mapping[str, FieldInfo] = field(default_factory=dict)
    derived: Mapping[str, FieldInfo] = field(default_factory=dict)
    #: The arrays whose length has different formulas in different branches.
    branched: frozenset[str] = frozenset()
    #: The marks that end bytes of variable size, by the path of the bytes.
    endings: Mapping[str, Ending] = field(default_factory=dict)

    @cached_property
    def columns(self) -> Mapping[str, FieldInfo]:
        """The columns of a table by path: decoded fields and derived values."""
        every = {**self.fields, **self.derived}
        adapted = {
            path: _apply_adapter(info)
            for path, info in every.items()
            if info.adapter is not None and info.adapter.has_columns
        }
        if not self.derived and not adapted:
            return self.fields
        return PathMapping(every | adapted, functools.partial(_make_element, self.arrays))

    @cached_property
    def all_fields(self) -> Mapping[str, FieldInfo]:
        """The fields of the frame and of the parts in it."""
        if self.inside:
            return {**self.fields, **self.inside}
        return self.fields

    @cached_property
    def counting_fields(self) -> Mapping[str, str | None]:
        """For each array, by path, the path of the field that contains its length.

        The value is None if no field contains the length.
        """
        return {
            axis: None if count is None else find_count_field(count, self.fields)
            for axis, count in self.arrays.items()
        }

    @cached_property
    def deepest_axes(self) -> tuple[str, ...]:
        """The axes of the field that is inside the most arrays, outermost array first."""
        return max(
            (info.axes for info in self.fields.values() if info.kind != "bytes"),
            key=len,
            default=(),
        )

    @property
    def has_measured_sizes(self) -> bool:
        """Whether the layout depends on sizes that are found by reading the content."""
        return bool(self.parts or self.endings)

    @cached_property
    def separate_parts(self) -> Mapping[str, PartSequence]:
        """The sequences of parts that have tables of their own, by path.

        The other sequences of parts are arrays of the frame, whose elements differ in size.
        """
        return {axis: node for axis, node in self.parts.items() if not node.is_array}

    @cached_property
    def scan_names(self) -> Mapping[str, FieldInfo]:
        """The fields of the frame and its parts, by the names that scans and clocks use.

        The name is the path; for a field in a part, it begins with the path of the kind of parts.
        """
        names = dict(self.fields)
        for before, kind in self.part_kinds.items():
            names |= {
                f"{before}.{path}": info for path, info in make_schema(kind.root).scan_names.items()
            }
        return names

    @property
    def part_kinds(self) -> Mapping[str, Kind]:
        """The kinds of parts in `separate_parts`, by path, such as "tags.points"."""
        return {
            f"{axis}.{kind.name}".rstrip("."): kind
            for axis, node in self.separate_parts.items()
            for kind in node.kinds
        }

    def split_part_path(self, path: str) -> tuple[str, str, str] | None:
        """Split the path of a field in a part.

        Returns:
            The path of the sequence of parts, the name of the kind of parts, and the path in the
            part. None if the path is not in a sequence of parts with a table of its own.

        Raises:
            UnknownField: if the kinds of parts have names, and the path has none of them.
        """
        for axis, node in self.separate_parts.items():
            if path == axis or path.startswith(f"{axis}."):
                names = [kind.name for kind in node.kinds]
                rest = path[len(axis) + 1 :]
                if names == [""]:
                    return axis, "", rest
                kind, _, below = rest.partition(".")
                if kind not in names:
                    raise UnknownField(path, [f"{axis}.{name}" for name in names])
                return axis, kind, below
        return None

    @cached_property
    def array_depths(self) -> Mapping[str, int]:
        """The number of arrays that contain each array, by the path of the array."""
        return {
            axis: index for info in self.fields.values() for index, axis in enumerate(info.axes)
        }

    def axis(self, name: str) -> str:
        """Return the path of the array with this path or last name.

        Raises:
            SpecError: if no array has the name, or several have it.
        """
        found = [axis for axis in self.array_depths if axis == name] or [
            axis for axis in self.array_depths if axis.rpartition(".")[2] == name
        ]
        if len(found) != 1:
            if found:
                reason = f"the frame has several arrays named {name!r}"
            else:
                reason = f"the frame has no array {name!r}"
            raise SpecError(
                f"{reason}; expected one of {', '.join(found or self.array_depths) or 'none'}",
                rule="LS214",
            )
        return found[0]

    def find_sequence(self, path: str) -> str | None:
        """Return the path of the array of parts that contains a field, or None.

        This is a sequence of parts that has no table of its own (see `separate_parts`).
        """
        if not self.parts:
            return None
        base = without_indices(path)[0]
        for axis, node in self.parts.items():
            if node.is_array and (base == axis or base.startswith(f"{axis}.")):
                return axis
        return None

    def outer(self, axis: str) -> list[str]:
        """Return the paths of the arrays that contain an array."""
        return [other for other in self.arrays if axis.startswith((f"{other}.", f"{other}["))]

    def depth(self) -> int:
        """Return the maximum number of arrays that contain one field."""
        return len(self.deepest_axes)


def _apply_adapter(info: FieldInfo) -> FieldInfo:
    """Return a field with the type of its decoded values."""
    assert info.adapter is not None
    dtype = info.adapter.dtype
    if info.adapter.decode_bytes is not None:
        return info
    kinds = {"i": "int", "u": "int", "f": "float"}
    axes = info.axes[:-1] if info.kind == "bytes" else info.axes
    return replace(
        info,
        axes=axes,
        dtype=None if dtype.hasobject else dtype,
        kind=kinds.get(dtype.kind, "other"),
        bits=8 * dtype.itemsize,
    )


def find_count_field(formula: Formula, fields: Mapping[str, FieldInfo]) -> str | None:
    """Return the path of the first field in a count formula; None without fields."""
    asked = refs(formula)
    return next((ref.path for ref in asked if ref.path in fields and "[" not in ref.path), None)


@lru_cache(maxsize=4096)
def make_schema(root: Node) -> Schema:
    """Return the fields of a frame tree."""
    fields: dict[str, FieldInfo] = {}
    arrays: dict[str, Formula | None] = {}
    derived: dict[str, FieldInfo] = {}
    _walk(root, fields, arrays, derived, optional=False)
    structs = {
        node.path: node.docs for node in nodes(root) if isinstance(node, Struct) and node.docs
    }
    parts = {node.axis: node for node in nodes(root) if isinstance(node, PartSequence)}
    inside: dict[str, FieldInfo] = {}
    for node in parts.values():
        for kind in node.kinds:
            _walk(kind.element, inside, {}, {}, optional=False)
    return Schema(
        PathMapping(_add_struct_docs(fields, structs), functools.partial(_make_element, arrays)),
        arrays,
        {axis: node for axis, node in parts.items() if not node.total.axes},
        _add_struct_docs(inside, structs),
        derived,
        _find_branched(root),
        {
            node.info.path: node.ending
            for node in nodes(root)
            if isinstance(node, Blob) and node.ending is not None
        },
    )


def _find_branched(root: Node) -> frozenset[str]:
    """Return the arrays for which branches declare different lengths."""
    counts: dict[str, Formula] = {}
    found = set[str]()
    for node in nodes(root):
        if isinstance(node, Repeat):
            axis, count = node.axis, node.count
        elif isinstance(node, Blob) and node.name:
            axis, count = node.info.axes[-1], node.size
        else:
            continue
        if counts.setdefault(axis, count) != count:
            found.add(axis)
    return frozenset(found)


def _add_struct_docs(fields: dict[str, FieldInfo], structs: dict[str, str]) -> dict[str, FieldInfo]:
    """Add the docs of the struct to each field without docs, and return the fields."""
    for path, info in fields.items():
        docs = "" if info.docs else _find_struct_docs(path, structs)
        if docs:
            fields[path] = replace(info, docs=docs)
    return fields


def _make_element(
    arrays: Mapping[str, Formula | None], info: FieldInfo, path: str, indices: Mapping[str, int]
) -> FieldInfo | None:
    """Return the declaration of one element of a field; None if no frame has it."""
    element = get_element(info, path, indices)
    counts = [(arrays.get(axis), index) for axis, index in indices.items()]
    if element is None or any(
        isinstance(count, int) and not -count <= index < count for count, index in counts
    ):
        return None
    if all(isinstance(count, int) for count, _ in counts):
        return element
    return replace(element, optional=True)


def _find_struct_docs(path: str, structs: Mapping[str, str]) -> str:
    """Return the documentation of the innermost struct around an undocumented field."""
    while path and structs:
        path = path.rpartition(".")[0]
        if path in structs:
            return structs[path]
    return ""


def _walk(
    node: Node,
    fields: dict[str, FieldInfo],
    arrays: dict[str, Formula | None],
    derived: dict[str, FieldInfo],
    *,
    optional: bool,
) -> None:
    match node:
        case Derived(node=below) if below is not None:
            _walk(below, derived, arrays, derived, optional=optional)
        case Derived():
            if node.info.kind == "bytes":
                arrays.setdefault(node.info.axes[-1], None)
            _add_field(derived, node.info)
        case Repeat():
            _add_count(arrays, node.axis, node.count, optional=optional)
        case Blob() if node.name:
            _add_count(arrays, node.info.axes[-1], node.size, optional=optional)
            _add_field(fields, node.info)
        case Opaque() if node.name and not node.inside:
            if node.info.kind == "bytes":
                _add_count(arrays, node.info.axes[-1], node.size, optional=optional)
            _add_field(fields, node.info)
        case Number():
            _add_field(fields, node.info)
        case Block():
            _add_block(node, fields, arrays, optional=optional)
        case PartSequence():
            if node.is_array:
                _add_count(arrays, node.axis, node.count, optional=optional)
                _walk(node.kinds[0].element, fields, arrays, derived, optional=optional)
            return
    for child in children(node):
        is_optional = optional or isinstance(node, When | Select)
        _walk(child, fields, arrays, derived, optional=is_optional)


def _add_block(
    node: Block, fields: dict[str, FieldInfo], arrays: dict[str, Formula | None], *, optional: bool
) -> None:
    infos = {
        part.info.path: part.info
        for part in node.parts
        if part.info.name and (node.name or part.names)
    }
    for path, info in infos.items():
        indices = [part.indices for part in node.parts if part.info.path == path]
        inner = info.axes[len(info.axes) - len(indices[0]) :]
        for depth, axis in enumerate(inner):
            _add_count(arrays, axis, 1 + max(index[depth] for index in indices), optional=optional)
        _add_field(fields, info)


def _add_field(fields: dict[str, FieldInfo], info: FieldInfo) -> None:
    known = fields.get(info.path)
    fields[info.path] = info if known is None else _merge_fields(known, info)


def _add_count(
    arrays: dict[str, Formula | None], axis: str, count: Formula | None, *, optional: bool
) -> None:
    """Store the declared count of an array."""
    if optional and isinstance(count, int):
        count = Op("+", (count, 0))  # not a number, because only some frames have the array
    known = arrays.setdefault(axis, count)
    if isinstance(known, int) and known != count:
        arrays[axis] = None if isinstance(count, int) else count


def _merge_fields(first: FieldInfo, other: FieldInfo) -> FieldInfo:
    """Merge the declarations of a field in two branches into one field."""
    kinds = {first.kind, other.kind}
    if (
        first.axes != other.axes
        or "other" in kinds
        or kinds > {"bytes"}
        or first.dtype is None
        or other.dtype is None
    ):
        return replace(first, dtype=None, kind="other")
    dtype = np.promote_types(first.dtype, other.dtype)
    if (first.bits, first.dtype) == (other.bits, other.dtype):
        bits = first.bits
    elif first.kind == "bytes":
        bits = 0
    else:
        bits = 8 * dtype.itemsize
    const = first.const if first.const == other.const else None
    labels = first.labels if first.labels == other.labels else {}
    return replace(
        first,
        dtype=dtype,
        kind="float" if dtype.kind == "f" else first.kind,
        bits=bits,
        const=const,
        labels=labels,
    )
