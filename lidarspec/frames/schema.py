"""The fields of a frame type as a table, read off its tree without any bytes.

Path, axes, type, unit and text of each field; where it stands is `layout`'s business, since that
can depend on the header. Both engines (compiled and interpreted) make their columns by this table,
so that they agree on types.
"""

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
    FieldInfo,
    Formula,
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

#: of a path, the index of an element of an array: "columns[0].timestamp".
_INDEX = re.compile(r"\[(-?\d+)\]")

_Field = TypeVar("_Field")


@lru_cache(maxsize=1024)
def without_indices(path: str) -> tuple[str, dict[str, int]]:
    """Return a path without its indices, and these by the paths of their arrays.

    For "a[0].b" the result is "a.b", {"a": 0}.
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
    """A mapping from paths to values of fields, also of elements of arrays.

    An element is a field by itself: "columns[0].timestamp".

    Args:
        known: by the paths of the fields.
        element: of what a field has, its new path and the indices of some of its arrays, what that
            element has; None where there is none.
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
    """All fields of a frame type, in the order of the wire, and the arrays they are in.

    `arrays`: path -> declared count; a number where every frame has so many elements, else a
    formula of header fields, or None. `parts`: frames within the frame, by path, which are tables
    of their own; `inside`: their fields, by path from the top. `derived`: values without bytes of
    their own.
    """

    fields: Mapping[str, FieldInfo]
    arrays: Mapping[str, Formula | None]
    parts: Mapping[str, PartSequence] = field(default_factory=dict)
    inside: Mapping[str, FieldInfo] = field(default_factory=dict)
    derived: Mapping[str, FieldInfo] = field(default_factory=dict)
    #: arrays whose length follows from different formulas in different branches.
    branched: frozenset[str] = frozenset()

    @cached_property
    def columns(self) -> Mapping[str, FieldInfo]:
        """The values of the frame, as columns have them: its fields, with their adapters applied,
        and the values derived from them.
        """
        every = {**self.fields, **self.derived}
        adapted = {
            path: _adapt(info)
            for path, info in every.items()
            if info.adapter is not None and info.adapter.has_columns
        }
        if not self.derived and not adapted:
            return self.fields
        return PathMapping(every | adapted, functools.partial(_element, self.arrays))

    @cached_property
    def all_fields(self) -> Mapping[str, FieldInfo]:
        """The fields of the frame and of the parts in it."""
        if self.inside:
            return {**self.fields, **self.inside}
        return self.fields

    @cached_property
    def counting_fields(self) -> Mapping[str, str | None]:
        """The field that each array takes its length from, by the path of the array."""
        return {
            axis: None if count is None else counting_field(count, self.fields)
            for axis, count in self.arrays.items()
        }

    @cached_property
    def chain(self) -> tuple[str, ...]:
        """The axes of the deepest nesting of arrays; the first one of equally deep ones."""
        return max(
            (info.axes for info in self.fields.values() if info.kind != "bytes"),
            key=len,
            default=(),
        )

    @cached_property
    def scan_names(self) -> Mapping[str, FieldInfo]:
        """The fields of the frame and its parts, by the names that scans and clocks use.

        A field of a kind follows the name of the kind: "tags.points.angle".
        """
        names = dict(self.fields)
        for axis, node in self.parts.items():
            for kind in node.kinds:
                before = f"{axis}.{kind.name}".rstrip(".")
                names |= {
                    f"{before}.{path}": info
                    for path, info in make_schema(kind.root).scan_names.items()
                }
        return names

    def within(self, path: str) -> tuple[str, str, str] | None:
        """Return the axis, the kind and the remaining path of a path into parts.

        Returns None if the path leads into no parts.

        Raises:
            UnknownField: for parts of several kinds without one of them.
        """
        for axis, node in self.parts.items():
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
    def places(self) -> Mapping[str, int]:
        """The number of arrays around each array, by its path."""
        return {
            axis: index for info in self.fields.values() for index, axis in enumerate(info.axes)
        }

    def axis(self, name: str) -> str:
        """Return the path of an array, by it or by its last part.

        Raises:
            SpecError: where there is none of that name, or several.
        """
        found = [axis for axis in self.places if axis == name] or [
            axis for axis in self.places if axis.rpartition(".")[2] == name
        ]
        if len(found) != 1:
            if found:
                reason = f"the frame has several arrays named {name!r}"
            else:
                reason = f"the frame has no array {name!r}"
            raise SpecError(
                f"{reason}; expected one of {', '.join(found or self.places) or 'none'}",
                rule="LS214",
            )
        return found[0]

    def outer(self, axis: str) -> list[str]:
        """Return the arrays that an array is in."""
        return [other for other in self.arrays if axis.startswith((f"{other}.", f"{other}["))]

    def depth(self) -> int:
        """Return the largest number of nested arrays."""
        return len(self.chain)


def _adapt(info: FieldInfo) -> FieldInfo:
    """Return a field with the type of the values that its adapter makes."""
    assert info.adapter is not None
    dtype = info.adapter.dtype
    kinds = {"i": "int", "f": "float"}
    axes = info.axes[:-1] if info.kind == "bytes" else info.axes
    return replace(
        info,
        axes=axes,
        dtype=None if dtype.hasobject else dtype,
        kind=kinds.get(dtype.kind, "other"),
        bits=8 * dtype.itemsize,
    )


def counting_field(formula: Formula, fields: Mapping[str, FieldInfo]) -> str | None:
    """Return the path of the field that a count or length follows from; None if there is none."""
    asked = refs(formula)
    return next((ref.path for ref in asked if ref.path in fields and "[" not in ref.path), None)


@lru_cache(maxsize=4096)
def make_schema(root: Node) -> Schema:
    """Return the table of fields of a frame's tree."""
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
        PathMapping(_with_docs(fields, structs), functools.partial(_element, arrays)),
        arrays,
        {axis: node for axis, node in parts.items() if not node.total.axes},
        _with_docs(inside, structs),
        derived,
        _find_branched(root),
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


def _with_docs(fields: dict[str, FieldInfo], structs: dict[str, str]) -> dict[str, FieldInfo]:
    """Return the fields, and for those without docs the docs of the struct around them."""
    for path, info in fields.items():
        docs = "" if info.docs else _docs_around(path, structs)
        if docs:
            fields[path] = replace(info, docs=docs)
    return fields


def _element(
    arrays: Mapping[str, Formula | None], info: FieldInfo, path: str, indices: Mapping[str, int]
) -> FieldInfo | None:
    """Return an element of a field, None if it never exists.

    The element is optional if the header determines the number of elements.
    """
    element = get_element(info, path, indices)
    counts = [(arrays.get(axis), index) for axis, index in indices.items()]
    if element is None or any(
        isinstance(count, int) and not -count <= index < count for count, index in counts
    ):
        return None
    if all(isinstance(count, int) for count, _ in counts):
        return element
    return replace(element, optional=True)


def _docs_around(path: str, structs: Mapping[str, str]) -> str:
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
            _add(derived, node.info)
        case Repeat():
            _count(arrays, node.axis, node.count, optional=optional)
        case Blob() if node.name:
            _count(arrays, node.info.axes[-1], node.size, optional=optional)
            _add(fields, node.info)
        case Opaque() if node.name and not node.inside:
            if node.info.kind == "bytes":
                _count(arrays, node.info.axes[-1], node.size, optional=optional)
            _add(fields, node.info)
        case Number():
            _add(fields, node.info)
        case Block():
            _block(node, fields, arrays, optional=optional)
        case PartSequence():
            return
    for child in children(node):
        is_optional = optional or isinstance(node, When | Select)
        _walk(child, fields, arrays, derived, optional=is_optional)


def _block(
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
            _count(arrays, axis, 1 + max(index[depth] for index in indices), optional=optional)
        _add(fields, info)


def _add(fields: dict[str, FieldInfo], info: FieldInfo) -> None:
    known = fields.get(info.path)
    fields[info.path] = info if known is None else _merge_fields(known, info)


def _count(
    arrays: dict[str, Formula | None], axis: str, count: Formula | None, *, optional: bool
) -> None:
    """Store the declared count of an array.

    If several branches declare the array, the count is a number only if all of them agree.
    """
    if optional and isinstance(count, int):
        count = Op(
            "+", (count, 0)
        )  # it has so many where it is there at all, which is not in every frame
    known = arrays.setdefault(axis, count)
    if isinstance(known, int) and known != count:
        arrays[axis] = None if isinstance(count, int) else count


def _merge_fields(first: FieldInfo, other: FieldInfo) -> FieldInfo:
    """One column for a field that several branches declare."""
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
