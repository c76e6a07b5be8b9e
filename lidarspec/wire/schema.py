"""The fields of a frame type as a table, read off its tree without any bytes.

Path, axes, type, unit and text of each field; where it stands is `layout`'s business, since that can depend on the
header. Both engines (compiled and interpreted) make their columns by this table, so that they agree on types.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from lidarspec.errors import SpecError, UnknownField
from lidarspec.spec.tree import (
    Blob,
    Block,
    FieldInfo,
    Formula,
    Node,
    Number,
    Op,
    Opaque,
    Parts,
    Repeat,
    Select,
    Struct,
    When,
    children,
    nodes,
)


@dataclass(frozen=True, eq=False)
class Schema:
    """All fields of a frame type, in the order of the wire, and the arrays they are in.

    `arrays`: path -> declared count; a number where every frame has so many elements, else a formula of header fields, or None.
    `parts`: frames within the frame, by path, which are tables of their own; `inside`: their fields, by path from the top.
    """

    fields: Mapping[str, FieldInfo]
    arrays: Mapping[str, Formula | None]
    parts: Mapping[str, Parts] = field(default_factory=dict)
    inside: Mapping[str, FieldInfo] = field(default_factory=dict)

    @cached_property
    def all_fields(self) -> Mapping[str, FieldInfo]:
        """The fields of the frame and of the parts in it."""
        return {**self.fields, **self.inside} if self.inside else self.fields

    @cached_property
    def chain(self) -> tuple[str, ...]:
        """The axes of the deepest nesting of arrays; the first one of equally deep ones."""
        return max((info.axes for info in self.fields.values() if info.kind != "bytes"), key=len, default=())

    @cached_property
    def named(self) -> Mapping[str, FieldInfo]:
        """The fields of the frame and of its parts, as scans and clocks name them: those of a kind behind its name, "tags.points.angle"."""
        found = dict(self.fields)
        for axis, node in self.parts.items():
            for kind in node.kinds:
                before = f"{axis}.{kind.name}".rstrip(".")
                found |= {f"{before}.{path}": info for path, info in schema(kind.root).named.items()}
        return found

    def within(self, path: str) -> tuple[str, str, str] | None:
        """The parts that a path leads into: their axis, their kind, and the path in these; None where it leads into none.

        Raises:
            UnknownField: for parts of several kinds without one of them.
        """
        for axis, node in self.parts.items():
            if path == axis or path.startswith(f"{axis}."):
                names, rest = [kind.name for kind in node.kinds], path[len(axis) + 1 :]
                if names == [""]:
                    return axis, "", rest
                kind, _, below = rest.partition(".")
                if kind not in names:
                    raise UnknownField(path, [f"{axis}.{name}" for name in names])
                return axis, kind, below
        return None

    @cached_property
    def places(self) -> Mapping[str, int]:
        """How many arrays each array stands in, by its path."""
        return {axis: index for info in self.fields.values() for index, axis in enumerate(info.axes)}

    def axis(self, name: str) -> str:
        """The path of an array, by it or by its last part.

        Raises:
            SpecError: where there is none of that name, or several.
        """
        found = [axis for axis in self.places if axis == name] or [axis for axis in self.places if axis.rpartition(".")[2] == name]
        if len(found) != 1:
            reason = f"several arrays are called {name!r}" if found else f"there is no array {name!r} in the frame"
            raise SpecError(f"{reason}; there are {', '.join(found or self.places) or 'none'}", rule="LS214")
        return found[0]

    def depth(self) -> int:
        """How many arrays are nested at most."""
        return len(self.chain)


@lru_cache(maxsize=4096)
def schema(root: Node) -> Schema:
    """The table of fields of a frame's tree."""
    fields: dict[str, FieldInfo] = {}
    arrays: dict[str, Formula | None] = {}
    _walk(root, fields, arrays, optional=False)
    structs = {node.path: node.docs for node in nodes(root) if isinstance(node, Struct) and node.docs}
    parts = {node.axis: node for node in nodes(root) if isinstance(node, Parts)}
    inside: dict[str, FieldInfo] = {}
    for node in parts.values():
        for kind in node.kinds:
            _walk(kind.element, inside, {}, optional=False)
    own, theirs = (
        {path: replace(info, docs=info.docs or _docs_around(path, structs)) for path, info in found.items()} for found in (fields, inside)
    )
    return Schema(own, arrays, {axis: node for axis, node in parts.items() if not node.total.axes}, theirs)


def _docs_around(path: str, structs: Mapping[str, str]) -> str:
    """What the author says of the innermost struct around a field of which nothing is said."""
    while path and structs:
        path = path.rpartition(".")[0]
        if path in structs:
            return structs[path]
    return ""


def _walk(node: Node, fields: dict[str, FieldInfo], arrays: dict[str, Formula | None], *, optional: bool) -> None:
    match node:
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
        case Parts():
            return
    for child in children(node):
        _walk(child, fields, arrays, optional=optional or isinstance(node, When | Select))


def _block(node: Block, fields: dict[str, FieldInfo], arrays: dict[str, Formula | None], *, optional: bool) -> None:
    infos = {part.info.path: part.info for part in node.parts if part.info.name and (node.name or part.names)}
    for path, info in infos.items():
        indices = [part.indices for part in node.parts if part.info.path == path]
        inner = info.axes[len(info.axes) - len(indices[0]) :]
        for depth, axis in enumerate(inner):
            _count(arrays, axis, 1 + max(index[depth] for index in indices), optional=optional)
        _add(fields, info)


def _add(fields: dict[str, FieldInfo], info: FieldInfo) -> None:
    known = fields.get(info.path)
    fields[info.path] = info if known is None else _merged(known, info)


def _count(arrays: dict[str, Formula | None], axis: str, count: Formula | None, *, optional: bool) -> None:
    """Note the declared count of an array; one that several branches declare is a number only where all say it."""
    if optional and isinstance(count, int):
        count = Op("+", (count, 0))  # it has so many where it is there at all, which is not in every frame
    known = arrays.setdefault(axis, count)
    if isinstance(known, int) and known != count:
        arrays[axis] = None if isinstance(count, int) else count


def _merged(known: FieldInfo, other: FieldInfo) -> FieldInfo:
    """One column for a field that several branches declare."""
    kinds = {known.kind, other.kind}
    if known.axes != other.axes or "other" in kinds or kinds > {"bytes"} or known.dtype is None or other.dtype is None:
        return replace(known, dtype=None, kind="other")
    dtype = np.promote_types(known.dtype, other.dtype)
    bits = known.bits if (known.bits, known.dtype) == (other.bits, other.dtype) else 0 if known.kind == "bytes" else 8 * dtype.itemsize
    const = known.const if known.const == other.const else None
    labels = known.labels if known.labels == other.labels else {}
    return replace(known, dtype=dtype, kind="float" if dtype.kind == "f" else known.kind, bits=bits, const=const, labels=labels)
