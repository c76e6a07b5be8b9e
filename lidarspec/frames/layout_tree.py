"""Compute the layouts of a frame type: the offset of each field, for each variant of the header.

A layout may depend on header fields, such as a count, and on sizes that are found by reading the
content (`lidarspec.frames.measured_size`). Both are called *selectors* here. `find_layout` returns
the layout for given values of the selectors.

`HeaderTree` is a decision tree that caches layouts. An inner node is a selector, a branch is a
value of the selector, and an end node is a `Layout`, or a `LayoutRefusal` with the reason why there
is no layout.
"""

from __future__ import annotations

import bisect
import contextlib
import functools
import math
import operator
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.frames.arrays import group_by_value
from lidarspec.frames.compilability import NotCompilableError, check_compilable
from lidarspec.frames.layout import (
    Condition,
    Derivation,
    FrameChecksum,
    Layout,
    LayoutRefusal,
    Leaf,
)
from lidarspec.frames.measured_size import MeasuredSize, TextSize
from lidarspec.frames.parts import CONSTANT, FAILED, PartKind, PartRule, PartsSize, Region
from lidarspec.frames.schema import PathMapping, make_schema, without_indices
from lidarspec.spec import tree
from lidarspec.spec.bits import BitField, whole_bytes
from lidarspec.spec.description import Frame


class UnknownSelectorError(Exception):
    """The layout depends on a selector whose value is not known yet."""

    def __init__(self, leaf: Leaf | MeasuredSize) -> None:
        self.leaf = leaf
        super().__init__(leaf.info.path)


class InvalidLengthError(Exception):
    """The lengths in the header are invalid.

    The frame would be longer than the maximum of the frame type, or have no bytes.

    Attributes:
        path: the path of the field, struct or array that makes the frame too long, or that is not
            valid; "" if the frame would have no bytes.
        number: the invalid count or length; None if only the sum of the lengths is invalid.
    """

    def __init__(self, path: str, number: int | None = None) -> None:
        self.path = path
        self.number = number
        super().__init__(path)


class InvalidCaseError(InvalidLengthError):
    """The header selects a case that no valid frame has (construct's `Error`).

    Frames with such a header are rejected like frames with invalid lengths.
    """


class UnknownPartError(Exception):
    """The constants of a part match no kind of parts."""


class CutOffError(Exception):
    """The input ends before the end of a frame."""


def find_layout(
    root: tree.Node, values: Mapping[str, int], limit: int, given: Mapping[str, int] | None = None
) -> Layout:
    """Return the layout of the frames with these values of the selectors.

    Args:
        values: the raw values of the selectors, by path.
        limit: the maximum size of a frame, in bytes.
        given: for parts, the raw values of fields of the outer frame, by path.

    Raises:
        UnknownSelectorError: if the layout depends on a selector that is not in `values`.
        InvalidLengthError: if the frame would be longer than `limit`, or have no bytes.
        InvalidCaseError: if the header selects a case that no valid frame has.
        UnknownPartError: if the constants of a part match no kind of parts.
        NotCompilableError: if only construct can parse the struct.
        Exception: any error of a formula with these values.
    """
    return walk_layout(HeaderWalk(values, limit, given or {}), root)


def walk_layout(walk: HeaderWalk, root: tree.Node) -> Layout:
    """Complete a walk through the tree, and return the layout."""
    walk.visit(root, "")
    if not walk.cursor:
        raise InvalidLengthError("")
    return walk.layout()


def find_fixed_constants(root: tree.Node, limit: int) -> dict[int, tuple[int, int]]:
    """Return the constants at offsets that do not depend on header fields.

    The constants are given as (mask, value) by offset.
    """
    walk = HeaderWalk({}, limit)
    # If an expression of the struct fails, the constants before it are still known.
    with contextlib.suppress(Exception):
        walk.visit(root, "")
    return walk.constants


def _raise_unknown(leaf: Leaf | MeasuredSize, _: HeaderWalk) -> int:
    raise UnknownSelectorError(leaf)


ValueRequest = Callable[[Leaf | MeasuredSize, "HeaderWalk"], int]


@dataclass
class HeaderWalk:
    """A walk through the tree of a frame type, for given values of header fields."""

    values: Mapping[str, int]
    limit: int
    given: Mapping[str, int] = field(default_factory=dict)
    #: A function that returns the value of a field that is not in `values`. The function may
    #: replace `values`.
    request: ValueRequest = _raise_unknown
    #: The size of the frame in bytes if the frame is complete; None if more bytes may follow.
    frame_size: int | None = None
    #: The offset of the next node of the tree.
    cursor: int = 0
    leaves: dict[str, Leaf] = field(default_factory=dict)
    constants: dict[int, tuple[int, int]] = field(default_factory=dict)
    checksums: list[FrameChecksum] = field(default_factory=list)
    places: dict[str, tuple[int, int]] = field(default_factory=dict)
    branches: dict[tree.Node, tree.Node] = field(default_factory=dict)
    lengths: dict[str, int] = field(default_factory=dict)
    regions: dict[str, Region] = field(default_factory=dict)
    #: The regions with parts whose total size is not known yet, by their axis.
    open_regions: dict[str, Region] = field(default_factory=dict)
    #: The conditions that values have to meet, each once.
    conditions: dict[tree.FieldInfo | tree.Check, Condition] = field(default_factory=dict)
    #: The values without bytes of their own, by path.
    derived: dict[str, Leaf | Derivation] = field(default_factory=dict)
    #: The offset of each node, by path. For a node in arrays, it is that of the first element.
    starts: dict[str, int] = field(default_factory=dict)
    #: The number of elements without bytes in all arrays.
    empty: int = 0
    #: The fields before the cursor, for formulas; None for a field that the frame does not have.
    parts: dict[str, Leaf | MeasuredSize | None] = field(default_factory=dict)

    def layout(self) -> Layout:
        """Return the layout that the walk found."""
        held = self._find_size_bits()
        self.request = _raise_unknown  # the layout is known, so no other field may be requested
        checksums = tuple(_order_checksums(self.checksums))
        following = tuple(self._iter_following())
        leaves = PathMapping(self.leaves, Leaf.element)
        found = (
            self.cursor,
            leaves,
            self.constants,
            checksums,
            self.places,
            self.branches,
            following,
            self.lengths,
            self.regions,
        )
        derived = PathMapping(self.derived, lambda each, path, indices: each.element(path, indices))
        return Layout(*found, held, tuple(self.conditions.values()), derived)

    def read(self, path: str) -> int | None:
        """Return the raw value of a field; None if frames with this header lack it.

        Raises:
            UnknownSelectorError: if the walk does not have the value of the field.
        """
        if path.startswith("_."):
            return self.given[path[2:]]
        if path not in self.parts and "[" in path:
            return self._read_element(path)
        part = self.parts[path]
        if part is None:
            return None
        if isinstance(part, MeasuredSize) and part.known is not None:
            return part.known
        if path not in self.values:
            return self.request(part, self)
        return self.values[path]

    def _read_element(self, path: str) -> int:
        """Return the value of one element of an array, given its path with indices."""
        base, indices = without_indices(path)
        if base in self.leaves:
            leaf = self.leaves[base].element(path, indices)
        else:
            leaf = None
        if leaf is None:
            raise IndexError(f"{path} does not exist")
        if path in self.values:
            return self.values[path]
        return self.request(leaf, self)

    def visit(
        self, node: tree.Node, path: str, shape: tuple[int, ...] = (), strides: tuple[int, ...] = ()
    ) -> None:
        """Add a node of the tree at the cursor, and move the cursor to its end.

        Args:
            shape: the lengths of the arrays that contain the node.
            strides: the strides of these arrays.
        """
        start = self.starts[path] = self.cursor
        match node:
            case tree.Struct():
                self._add_struct(node, path, shape, strides)
            case tree.ChecksummedStruct():
                self.visit(node.body, path, shape, strides)
                self._add_checksum(node, start)
            case tree.Number() | tree.Blob() | tree.Block():
                self._add_field(node, path, shape, strides)
            case tree.Repeat():
                self._add_array(node, path, shape, strides)
            case tree.PartSequence():
                self._add_parts(node, path)
            case tree.When():
                self.branches[node] = (
                    node.then if self._evaluate(node.condition) else node.otherwise
                )
                self.visit(self.branches[node], path, shape, strides)
            case tree.Select():
                self.branches[node] = dict(node.cases).get(self._evaluate(node.key), node.default)
                self.visit(self.branches[node], path, shape, strides)
            case tree.Check() if 0 not in shape:
                self.conditions[node] = Condition.of(node)
            case tree.Never():
                raise InvalidCaseError(path)
            case tree.Derived():
                self._add_derived(node, path, shape, strides)
            case tree.Opaque():
                raise NotCompilableError(node.info.path, node.reason)
        if self.cursor > self.limit:
            raise InvalidLengthError(path)
        if self.frame_size is not None and self.cursor > self.frame_size:
            raise CutOffError(path)
        if path and not shape:
            self.places[path] = (start, self.cursor)

    def _add_struct(
        self, node: tree.Struct, path: str, shape: tuple[int, ...], strides: tuple[int, ...]
    ) -> None:
        for member in node.members:
            if member.name:
                below = f"{node.path}.{member.name}".strip(".")
            else:
                below = ""
            self.visit(member, below, shape, strides)
            self.parts.setdefault(below, None)

    def _add_array(
        self, node: tree.Repeat, path: str, shape: tuple[int, ...], strides: tuple[int, ...]
    ) -> None:
        count = self._evaluate_count(node.count, path)
        start = self.cursor
        self.lengths[node.axis] = 0 if 0 in shape else count
        if count:
            self.visit(node.element, path, (*shape, count), (*strides, 0))
        else:
            self._add_empty_array(node.element, path, (*shape, count), (*strides, 0))
        size = self.cursor - start
        depth = len(strides)
        self.empty += 0 if size else math.prod(shape) * count
        if start + size * count > self.limit or self.empty > self.limit:
            raise InvalidLengthError(path)
        for leaves in (self.leaves, self.derived):
            _set_stride(leaves, node.axis, depth, size)
        for offset in [offset for offset in self.constants if offset >= start]:
            byte = self.constants.pop(offset)
            self.constants.update({offset + size * index: byte for index in range(count)})
        self.cursor = start + size * count

    def _add_derived(
        self, node: tree.Derived, path: str, shape: tuple[int, ...], strides: tuple[int, ...]
    ) -> None:
        """Add a value without bytes of its own, such as a `Computed`."""
        info = node.info
        match node.kind:
            case "computed":
                self.derived[path] = Derivation(info, shape, (), node.formula, node.constant)
            case "offset":
                self.derived[path] = Derivation(info, shape, strides, start=self.cursor)
            case "size":
                size = self.cursor - self.starts[node.part]
                self.derived[path] = Derivation(info, shape, (), start=size)
            case "bytes":
                start = self.starts[node.part]
                size = self.cursor - start
                place = (*shape, size), (*strides, 1)
                self.derived[path] = Leaf(info, start, *place, size, np.dtype("u1"))
                self.lengths[info.axes[-1]] = 0 if 0 in shape else size
            case "peeked":
                self._add_peeked_fields(node, path, shape, strides)

    def _add_peeked_fields(
        self, node: tree.Derived, path: str, shape: tuple[int, ...], strides: tuple[int, ...]
    ) -> None:
        """Add fields at the cursor without moving the cursor."""
        start = self.cursor
        leaves = self.leaves
        self.leaves = {}
        assert node.node is not None
        self.visit(node.node, path, shape, strides)
        self.derived |= self.leaves
        self.leaves = leaves
        self.cursor = start

    def _add_parts(self, node: tree.PartSequence, path: str) -> None:
        """Add a sequence of parts."""
        given = {ref.path: int(self._evaluate(ref) or 0) for ref in node.outer}
        rule = PartRule(
            *(
                None if formula is None else self._evaluate_count(formula, path)
                for formula in (node.count, node.size, node.within)
            )
        )
        region = Region(
            node,
            find_kinds(node, tuple(given.items()), self.limit),
            self.cursor,
            rule,
            self.limit,
            given,
            rule.within,
        )
        self.parts[node.total.path] = PartsSize(node.total, region)
        self.open_regions[node.axis] = region
        if rule.within is not None:
            size = rule.within
        else:
            size = int(self._evaluate(tree.Ref(node.total.path, node.total)))
        if size == -FAILED:
            raise ValueError(f"an expression in the parts {path} raises an exception")
        if size < 0:
            raise UnknownPartError(path) if size == -CONSTANT else InvalidLengthError(path)
        self.regions[node.axis] = region = replace(region, size=size)
        self.parts[node.total.path] = PartsSize(node.total, region)
        self.cursor += size

    def _add_empty_array(
        self, node: tree.Node, path: str, shape: tuple[int, ...], strides: tuple[int, ...]
    ) -> None:
        """Add the fields of an array without elements; it has no bytes or constants."""
        start = self.cursor
        constants = dict(self.constants)
        try:
            self.visit(node, path, shape, strides)
        except UnknownSelectorError:
            raise
        except Exception:
            pass  # construct never parses this element, so its expressions may fail
        finally:
            self.cursor = start
            self.constants = constants

    def _add_field(
        self,
        node: tree.Number | tree.Blob | tree.Block,
        path: str,
        shape: tuple[int, ...],
        strides: tuple[int, ...],
    ) -> None:
        match node:
            case tree.Number(info, size, _, order):
                if size in (1, 2, 4, 8) and info.dtype is not None:
                    wire = info.dtype.newbyteorder("<" if order == "little" else ">")
                    elements: tuple[BitField, ...] = ()
                else:
                    wire = None
                    elements = (whole_bytes(size, order, signed=node.kind == "int"),)
                self._add_leaf(Leaf(info, self.cursor, shape, strides, size, wire, elements))
                if info.const is not None:
                    self._add_constant(node.encode(info.const))
            case tree.Blob():
                if node.ending is not None:
                    measured = TextSize(node.ending.size, node.ending, self.cursor, self.limit)
                    self.parts[node.ending.size.path] = measured
                size = self._evaluate_count(node.size, path)
                if node.name:
                    self._add_leaf(
                        Leaf(
                            node.info,
                            self.cursor,
                            (*shape, size),
                            (*strides, 1),
                            size,
                            np.dtype("u1"),
                        )
                    )
                self._add_constant(node.const or b"")
                if node.ending is not None:
                    self.cursor += size
                    size = len(node.ending.terminator)
                    self._add_constant(node.ending.terminator)
            case tree.Block():
                size = node.size
                self._add_block(node, path, shape, strides)
        self.cursor += size

    def _add_block(
        self, node: tree.Block, path: str, shape: tuple[int, ...], strides: tuple[int, ...]
    ) -> None:
        groups: dict[str, list[BitField]] = {}
        infos: dict[str, tree.FieldInfo] = {}
        for part in node.parts:
            names = ".".join(name for name in (path, *part.names) if name)
            groups.setdefault(names, []).append(part.bits)
            infos[names] = part.info
        for name, elements in groups.items():
            info = infos[name]
            inside = len(info.axes) > len(shape)
            if name:
                own = (*shape, len(elements)) if inside else shape
                self._add_leaf(
                    Leaf(info, self.cursor, own, strides, node.size, elements=tuple(elements))
                )
            if info.const is not None:
                for element in elements:
                    self._add_bit_constant(element, int(info.const))

    def _add_constant(self, data: bytes) -> None:
        self.constants.update(
            {self.cursor + index: (0xFF, byte) for index, byte in enumerate(data)}
        )

    def _add_bit_constant(self, element: BitField, value: int) -> None:
        for part in element.segments:
            mask, bits = self.constants.get(self.cursor + part.byte, (0, 0))
            byte = bits | (value >> part.target << part.low) & part.mask
            self.constants[self.cursor + part.byte] = (mask | part.mask, byte)

    def _add_leaf(self, leaf: Leaf) -> None:
        is_partial = leaf.info.adapter is not None and leaf.info.adapter.is_partial
        if leaf.info.allowed is not None or is_partial:
            self.conditions[leaf.info] = Condition.of(leaf.info)
        self.leaves[leaf.info.path] = self.parts[leaf.info.path] = leaf
        is_in_block = len(leaf.shape) > len(leaf.strides)
        if leaf.shape and (leaf.info.kind == "bytes" or is_in_block):
            self.lengths[leaf.info.axes[-1]] = 0 if 0 in leaf.shape[:-1] else leaf.shape[-1]

    def _add_checksum(self, node: tree.ChecksummedStruct, start: int) -> None:
        leaves = tuple(self.leaves[path] for path in node.fields)
        if node.over is not None:
            spans = [(self.places[node.over[0]][0], self.places[node.over[1]][1])]
        else:
            held = sorted(leaf.byte_span for leaf in leaves)
            edges = [start, *(edge for span in held for edge in span), self.cursor]
            spans = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]
        self.checksums.append(
            FrameChecksum(leaves, tuple(spans), node.algorithm, node.absent, self.cursor)
        )

    def _find_size_bits(self) -> dict[int, tuple[int, int]]:
        """Return the bits that the fields with `SizeOf` must have.

        The bits are given as (mask, value) by offset.
        """
        rows = np.zeros((2, self.cursor), np.uint8)
        held_leaves = [leaf for leaf in self.leaves.values() if leaf.info.is_enforced]
        for leaf in held_leaves:
            (low, high), rebuilt = leaf.info.limits, leaf.info.rebuilt
            if rebuilt is not None:
                value = operator.index(tree.evaluate(rebuilt, self._read_known))
                if not low <= value <= high:
                    raise InvalidLengthError(leaf.info.path, value)
                leaf.store(
                    rows,
                    np.array([value, -1 if low else high], leaf.info.dtype).reshape(
                        2, *(1 for _ in leaf.shape)
                    ),
                )
        offsets = np.flatnonzero(rows[1]).tolist() if held_leaves else []
        return {offset: (int(rows[1, offset]), int(rows[0, offset])) for offset in offsets}

    def _iter_following(self) -> Iterator[tuple[Leaf, int]]:
        """Yield the fields whose values the header implies, each with its value."""
        for leaf in self.leaves.values():
            if leaf.info.rebuilt is not None and not leaf.info.is_enforced and not leaf.shape:
                # construct evaluates other fields when a frame is built.
                with contextlib.suppress(Exception):
                    yield leaf, operator.index(tree.evaluate(leaf.info.rebuilt, self._read_known))

    def _read_known(self, path: str) -> int | None:
        part = self.parts[path]
        if isinstance(part, Leaf) and isinstance(part.info.const, int) and path not in self.values:
            return part.info.const
        return self.read(path)

    def _evaluate(self, formula: tree.Formula) -> Any:
        return tree.evaluate(formula, self.read)

    def _evaluate_count(self, formula: tree.Formula, path: str) -> int:
        count = operator.index(self._evaluate(formula))
        if not 0 <= count <= self.limit:
            raise InvalidLengthError(path, count)
        return count


def _set_stride(leaves: dict[str, Any], axis: str, depth: int, size: int) -> None:
    """Set the stride of an array in all leaves that the array contains."""
    for path, leaf in leaves.items():
        is_constant = isinstance(leaf, Derivation) and not leaf.strides[depth:]
        if axis in leaf.info.axes and not is_constant:
            strides = (*leaf.strides[:depth], size, *leaf.strides[depth + 1 :])
            leaves[path] = replace(leaf, strides=strides)


def _order_checksums(checksums: list[FrameChecksum]) -> Iterator[FrameChecksum]:
    """Yield checksums in the order in which they can be computed."""
    left = list(checksums)
    while left:
        free = (
            checksum
            for checksum in left
            if not any(checksum.covers(other) for other in left if other is not checksum)
        )
        left.remove(first := next(free, left[0]))
        yield first


#: The maximum number of cached headers, so that random input does not fill the memory.
MAX_CACHED_HEADERS = 4096

#: Up to this number of distinct values, a search for each value is faster than sorting.
MAX_SEARCHED_VALUES = 4


@dataclass(eq=False)
class HeaderNode:
    """A node of a `HeaderTree`, which has a selector or a result.

    Attributes:
        values: the raw values of the selectors above this node, by path.
        parent: the parent node; None for the root.
        leaf: the selector of this node; None if it is not known yet, or if the node has a result.
        before: all fields before the selector, by path.
        constants: the constants before the selector, or before the end of a truncated frame.
        least: the known minimum size of a frame with these values, in bytes; 0 if not known.
        value_classes: maps the values of the selector that have the same layout to one value; None
            if the selector is not known yet, or is a measured size.
        result: the layout or the refusal; None if not known yet.
    """

    values: Mapping[str, int] = field(default_factory=dict)
    parent: HeaderNode | None = None
    leaf: Leaf | MeasuredSize | None = None
    before: Mapping[str, Leaf] = field(default_factory=dict)
    constants: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    least: int = 0
    value_classes: _ValueClasses | None = None
    children: dict[int, HeaderNode] = field(default_factory=dict)
    result: Layout | LayoutRefusal | None = None

    def find_representative(self, value: int) -> int:
        """Return the representative of all values with the same layout as `value`."""
        if self.value_classes is None:
            return value
        return self.value_classes.to_representative(value)

    def child(self, value: int) -> HeaderNode:
        """Return the child node for a value; add the node if it is missing."""
        if value not in self.children:
            assert self.leaf is not None
            self.children[value] = HeaderNode({**self.values, self.leaf.info.path: value}, self)
        return self.children[value]


#: A function that reads the field of a node in candidates. It returns the indices of the candidates
#: that have the field (None if all have it), and the values.
Reader = Callable[[HeaderNode, NDArray[np.intp]], tuple[NDArray[np.intp] | None, NDArray[Any]]]
Group = tuple[Layout | LayoutRefusal, NDArray[np.intp]]


@dataclass(frozen=True)
class _ValueClasses:
    """Maps each value of a header field to a value with the same layout.

    Attributes:
        limits: the lowest and the highest value of the field.
        monotonic_from: the value from which on a larger value never makes the frame shorter; None
            if unknown.
    """

    # Random bytes in place of a header can contain billions of lengths or keys. The tree stays
    # small, because it has one branch for all values with the same result.
    limits: tuple[int, int]
    low: int
    high: int
    keys: frozenset[int] = frozenset()  # if not empty, all other values are mapped to `other`
    other: int = 0
    monotonic_from: int | None = None

    @classmethod
    def of(cls, info: tree.FieldInfo, root: tree.Node, limit: int) -> _ValueClasses:
        """Group the values of a header field by their effect on the layout."""
        (low, high), nodes = info.limits, list(tree.nodes(root))
        asking = [
            (node, formula)
            for node in nodes
            for formula in tree.formulas(node)
            if _depends_on(formula, info)
        ]
        if any(
            own.rebuilt is not None and not own.is_enforced and _depends_on(own.rebuilt, info)
            for node in nodes
            for own in tree.infos(node)
        ):
            return cls(info.limits, low, high)
        if all(
            isinstance(node, tree.Select) and isinstance(formula, tree.Ref)
            for node, formula in asking
        ):
            keys = frozenset(
                key
                for node, _ in asking
                if isinstance(node, tree.Select)
                for key, _ in node.cases
                if low <= key <= high
            )
            other = next((value for value in range(low, high + 1) if value not in keys), None)
            if other is None:
                return cls(info.limits, low, high)
            return cls(info.limits, low, high, keys, other)
        if high - low < 1 << 62 and all(
            _is_size_formula(node, formula) for node, formula in asking
        ):
            values = range(low, high + 1)
            spans = []
            for _, formula in asking:
                count = functools.partial(_evaluate_with, formula)
                spans.append(
                    (
                        bisect.bisect_left(values, 0, key=count) - 1,
                        bisect.bisect_right(values, limit, key=count),
                    )
                )
            firsts, lasts = zip(*spans, strict=True)
            # The refusal of a frame with too many parts depends on the parts, not only on their
            # number.
            if any(isinstance(node, tree.PartSequence) for node, _ in asking):
                monotonic_from = None
            else:
                monotonic_from = max(firsts) + low + 1
            return cls(
                info.limits,
                max(min(firsts) + low, low),
                min(max(lasts) + low, high),
                monotonic_from=monotonic_from,
            )
        return cls(info.limits, low, high)

    def limit_to(self, value: int) -> _ValueClasses:
        """Let `value`, for which there is no layout, represent all larger values.

        Returns the classes unchanged if a larger value may make the frame shorter.
        """
        if self.monotonic_from is not None and self.monotonic_from <= value < self.high:
            return replace(self, high=value)
        return self

    def to_representative(self, value: int) -> int:
        """Return the value that represents all values with the same layout."""
        if self.keys:
            if value in self.keys:
                return value
            return self.other
        return min(max(value, self.low), self.high)

    def to_representatives(self, values: NDArray[Any]) -> NDArray[Any]:
        """Replace each value by its representative; keep the shape and the dtype."""
        if (self.low, self.high) == self.limits and not self.keys:
            return values
        if self.keys:
            return np.where(
                np.isin(values, np.array(list(self.keys), values.dtype)),
                values,
                values.dtype.type(self.other),
            )
        return np.asarray(np.clip(values, self.low, self.high))


def _depends_on(formula: tree.Formula, info: tree.FieldInfo) -> bool:
    """Return whether a formula depends on a field."""
    return any(ref.path == info.path for ref in tree.refs(formula))


def _is_size_formula(node: tree.Node, formula: tree.Formula) -> bool:
    """Return whether a formula of a node counts bytes, elements or parts."""
    is_number = isinstance(node, tree.Repeat | tree.Blob) or (
        isinstance(node, tree.PartSequence) and formula is node.count
    )
    return is_number and _is_increasing(formula)


def _is_increasing(formula: tree.Formula) -> bool:
    """Return whether a formula never decreases while its only field increases."""
    match formula:
        case tree.Ref() | tree.Op("+", (int(), tree.Ref())):
            return True
        case tree.Op("+" | "-" | "*" | "//" | ">>" as symbol, (first, int() as second)):
            return _is_increasing(first) and (second > 0 or symbol in "+-")
    return False


def _evaluate_with(formula: tree.Formula, value: int) -> int:
    """Return the value of a formula with a single field, given the value of the field."""
    return int(tree.evaluate(formula, lambda _: value))


class _CandidateSet:
    """The candidates that `HeaderTree.classify` groups.

    A candidate is an offset in a buffer at which a frame may start.

    Attributes:
        refuted: the indices of the candidates with a wrong constant, among the candidates that have
            no layout because the header is incomplete or the frame would be too long.
    """

    def __init__(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None,
        limit: int,
    ) -> None:
        self._buffer = buffer
        self._offsets = offsets
        self.stops = stops
        self._limit = limit
        self.refuted: list[NDArray[np.intp]] = []

    def get_longest_bytes(self, which: NDArray[np.intp]) -> bytes | memoryview:
        """Return up to `limit` bytes of the candidate that has the most bytes."""
        first = which.item(0)
        if self.stops is not None and len(which) > 1:
            first = which.item((self.stops[which] - self._offsets[which]).argmax())
        start = self._offsets.item(first)
        return self._buffer.data[
            start : min(
                start + self._limit,
                len(self._buffer) if self.stops is None else self.stops.item(first),
            )
        ]

    def read(
        self, node: HeaderNode, which: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp] | None, NDArray[Any]]:
        """Read the field of a node in the candidates that contain it.

        Returns:
            The indices of the candidates with the field (None for all candidates), and the values
            of the field.
        """
        assert node.leaf is not None
        there, values = node.leaf.read(
            self._buffer, self._offsets[which], None if self.stops is None else self.stops[which]
        )
        if there is not None:
            self.add_refuted(node, np.delete(which, there))
        return there, values

    def add_refuted(self, node: HeaderNode, which: NDArray[np.intp]) -> None:
        """Add the candidates with a wrong constant to `refuted`."""
        if node.constants:
            self.refuted.append(which[self.have_wrong_constants(node.constants, which)])

    def have_wrong_constants(
        self, constants: Mapping[int, tuple[int, int]], which: NDArray[np.intp]
    ) -> NDArray[np.bool_]:
        """Return whether each candidate has a wrong constant in its available bytes, (n,)."""
        if len(which) == 1:  # the usual case for random headers, which differ
            data = self.get_longest_bytes(which)
            return np.array([_is_refuted(constants, data)])
        offsets = self._offsets[which]
        stops = len(self._buffer) if self.stops is None else self.stops[which]
        wrong = np.zeros(len(which), np.bool_)
        for offset, (mask, value) in constants.items() if len(which) else ():
            there = offsets + offset < stops
            wrong[there] |= self._buffer[offsets[there] + offset] & mask != value
        return wrong


def _is_refuted(constants: Mapping[int, tuple[int, int]], data: bytes | memoryview) -> bool:
    """Return whether a constant in the available bytes is wrong."""
    return any(
        offset < len(data) and data[offset] & mask != value
        for offset, (mask, value) in constants.items()
    )


class HeaderTree:
    """All layouts of one frame type or kind of parts.

    Attributes:
        limit: the maximum size of a frame, in bytes.
    """

    def __init__(self, root: tree.Node, limit: int, given: Mapping[str, int] | None = None) -> None:
        self.root = root
        self.limit = limit
        self._given = given or {}
        self._root = HeaderNode()
        self._size = 0
        self._value_classes: dict[str, _ValueClasses] = {}

    @functools.cached_property
    def _prefix(self) -> dict[int, tuple[int, int]]:
        return find_fixed_constants(self.root, self.limit)

    def classify(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None = None,
    ) -> list[Group]:
        """Group the candidates at `offsets` by layout.

        Candidates with an incomplete header are left out.

        Args:
            stops: the end offset of each candidate; None if more bytes may follow.

        Returns:
            Pairs of a layout or refusal and the indices of its candidates.
        """
        candidates = _CandidateSet(buffer, offsets, stops, self.limit)
        groups: list[Group] = []
        for result, which in self.group_by_layout(len(offsets), candidates.read, candidates):
            groups.append((result, which))
            if isinstance(result, LayoutRefusal) and result.constants:
                wrong = candidates.have_wrong_constants(result.constants, which)
                groups[-1] = result, which[~wrong]
                candidates.refuted.append(which[wrong])
        return groups + [
            (LayoutRefusal(has_wrong_constant=True), which)
            for which in candidates.refuted
            if len(which)
        ]

    def group_by_layout(
        self, number: int, read: Reader, candidates: _CandidateSet | None = None
    ) -> list[Group]:
        """Group candidates by layout, given a function that reads their fields.

        Args:
            number: the number of candidates.
            read: the function, which reads the field of a node in some candidates.
            candidates: the candidates in a buffer; None if there is no buffer.
        """
        self._limit_cache()
        groups: list[Group] = []
        stack = [(self._root, np.arange(number))] if number else []
        while stack:
            node, which = stack.pop()
            if len(which) == 1 and candidates is not None:
                node = self._find_end(
                    candidates.get_longest_bytes(which),
                    node,
                    is_whole_frame=candidates.stops is not None,
                )
            elif node.leaf is None and node.result is None:
                data: bytes | memoryview = (
                    b"" if candidates is None else candidates.get_longest_bytes(which)
                )
                self._explore(
                    node,
                    data,
                    is_whole_frame=candidates is not None and candidates.stops is not None,
                )
            if node.result is not None:
                groups.append((node.result, which))
                continue
            if candidates is not None and (len(which) == 1 or node.leaf is None):
                candidates.add_refuted(node, which)
                continue
            there, values = read(node, which)
            which = which if there is None else which[there]
            if node.value_classes is not None:
                values = node.value_classes.to_representatives(values)
            if not len(which):
                continue
            if np.count_nonzero(values == values[0]) == len(values):
                stack.append((node.child(values.item(0)), which))
            else:
                stack += [
                    (node.child(value), which[rows])
                    for value, rows in group_by_value(values, MAX_SEARCHED_VALUES)
                ]
        return groups

    def find_fixed_fields(self) -> tuple[tuple[Leaf, ...], dict[int, tuple[int, int]]]:
        """Return the fields and constants at offsets that depend on no header field."""
        self._explore(self._root)
        if isinstance(self._root.result, Layout):
            leaves = self._root.result.leaves
        else:
            leaves = self._root.before
        return tuple(leaves.values()), find_fixed_constants(self.root, self.limit)

    def find_common_layout(self, rows: NDArray[np.uint8]) -> Layout | None:
        """Return the common layout of rows of bytes; None if their layouts differ."""
        node = self._root
        while node.result is None:
            if node.leaf is None:
                self._explore(node, rows[0].tobytes())
            leaf = node.leaf
            if leaf is None:
                break
            if isinstance(leaf, Leaf) and leaf.offset + leaf.size > rows.shape[1]:
                return None
            values = leaf.load(rows)
            if node.value_classes is not None:
                values = node.value_classes.to_representatives(values)
            if np.count_nonzero(values == values[0]) < len(rows) or (
                isinstance(leaf, MeasuredSize) and values[0] < 0
            ):
                return None
            node = node.child(values.item(0))
        if isinstance(node.result, Layout):
            return node.result
        return None

    def find_node(
        self, frame: bytes, *, since: HeaderNode | None = None, is_whole_frame: bool = False
    ) -> HeaderNode:
        """Return the node that the available bytes of a frame determine.

        The node has no result if more bytes are needed.

        Args:
            since: the node that was returned for fewer bytes of this frame, to continue from.
            is_whole_frame: whether no bytes of the frame follow.
        """
        if since is None:
            self._limit_cache()
        return self._find_end(frame, since or self._root, is_whole_frame=is_whole_frame)

    def _limit_cache(self) -> None:
        """Remove all nodes if there are too many."""
        if self._size > MAX_CACHED_HEADERS:
            self._root = HeaderNode()
            self._size = 0

    def layout(self, frame: bytes) -> Layout | LayoutRefusal | None:
        """Return the layout of one frame; None if its header is incomplete."""
        return self._find_end(frame, self._root).result

    def layout_for(self, read: Callable[[Leaf | MeasuredSize], int]) -> Layout:
        """Return the layout for the values of the selectors, which `read` returns."""
        self._limit_cache()
        node = self._root
        while node.result is None:
            if node.leaf is None:
                self._explore(node)
            else:
                node = node.child(node.find_representative(read(node.leaf)))
        if isinstance(node.result, Layout):
            return node.result
        return find_layout(self.root, node.values, self.limit, self._given)  # raises the error

    def _find_end(
        self, data: bytes | memoryview, node: HeaderNode, *, is_whole_frame: bool = False
    ) -> HeaderNode:
        """Follow a header down the tree from a node, and return the last node."""
        while node.leaf is not None:
            value = node.leaf.read_first(data)
            if value is None:
                return node
            node = node.child(node.find_representative(value))
        if node.result is not None:
            return node
        return self._explore(node, data, is_whole_frame=is_whole_frame)

    def _explore(
        self, node: HeaderNode, data: bytes | memoryview = b"", *, is_whole_frame: bool = False
    ) -> HeaderNode:
        """Add the nodes of a header to the tree, and return the last node."""

        def read_selector(leaf: Leaf | MeasuredSize, walk: HeaderWalk) -> int:
            nonlocal node
            node.leaf = leaf
            node.before = dict(walk.leaves)
            node.value_classes = self._get_value_classes(leaf)
            node.constants = self._select_new_constants(walk)
            value = leaf.read_first(data)
            if value is None:
                raise UnknownSelectorError(leaf)
            node = node.child(node.find_representative(value))
            self._size += 1
            walk.values = node.values
            return node.values[leaf.info.path]

        if is_whole_frame and len(data) < node.least:
            return node
        self._size += not node.least  # a node with a known size was counted before
        walk = HeaderWalk(
            node.values,
            self.limit,
            self._given,
            read_selector,
            len(data) if is_whole_frame else None,
        )
        try:
            node.result = walk_layout(walk, self.root)
        except UnknownSelectorError:
            pass
        except CutOffError:
            node.constants = self._select_new_constants(walk)
            node.least = walk.cursor
        except InvalidLengthError:
            node.result = LayoutRefusal(constants=self._select_new_constants(walk))
        except UnknownPartError:
            node.result = LayoutRefusal(has_wrong_constant=True)
        except SpecError:
            raise
        except Exception as error:
            node.result = LayoutRefusal(PluginError.of(error, "struct"))
        parent = node.parent
        if (
            parent is not None
            and parent.value_classes is not None
            and isinstance(node.result, LayoutRefusal)
            and not node.result.error
        ):
            parent.value_classes = parent.value_classes.limit_to([*node.values.values()][-1])
        return node

    def _select_new_constants(self, walk: HeaderWalk) -> dict[int, tuple[int, int]]:
        """Return the constants of a walk, except those at fixed offsets."""
        # The candidates that a search finds have the constants at fixed offsets.
        return {
            offset: bits
            for offset, bits in walk.constants.items()
            if self._prefix.get(offset) != bits
        }

    def _get_value_classes(self, leaf: Leaf | MeasuredSize) -> _ValueClasses | None:
        if not isinstance(leaf, Leaf):
            return None  # the size is only known after a search
        if leaf.info.path not in self._value_classes:
            self._value_classes[leaf.info.path] = _ValueClasses.of(leaf.info, self.root, self.limit)
        return self._value_classes[leaf.info.path]


@functools.lru_cache(maxsize=256)
def find_kinds(
    node: tree.PartSequence, given: tuple[tuple[str, int], ...], limit: int
) -> tuple[PartKind, ...]:
    """Return the possible kinds of parts, given the values of fields of the outer frame."""
    values = dict(given)
    return tuple(
        PartKind(kind, HeaderTree(kind.root, limit, values), find_fixed_constants(kind.root, limit))
        for kind in node.kinds
    )


@functools.lru_cache(maxsize=2048)
def frame_layouts(frame: Frame) -> HeaderTree | NotCompilableError:
    """Return the layouts of a frame type, or the error if it cannot be compiled."""
    try:
        check_compilable(frame.tree)
        endings = make_schema(frame.tree).endings
        if frame.wire is not None and endings:
            raise NotCompilableError(
                next(iter(endings)),
                "a frame type with `wire` cannot have a field that extends to a terminator",
            )
        return HeaderTree(frame.tree, frame.max_struct_bytes)
    except NotCompilableError as reason:
        return reason
