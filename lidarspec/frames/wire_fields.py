"""Find the fields of one frame with their offsets, even if it is invalid or truncated.

`examine` finds the layout, as far as the bytes determine it. `ExaminedFrame.fields` yields the
fields.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lidarspec.frames.layout import FrameChecksum, Layout, Leaf
from lidarspec.frames.layout_tree import HeaderWalk, UnknownSelectorError, walk_layout
from lidarspec.frames.measured_size import FOUND, MeasuredSize
from lidarspec.frames.parts import PartKind, Region
from lidarspec.spec import tree
from lidarspec.spec.bits import BitField


@dataclass(frozen=True)
class WireField:
    """A field in the bytes of a frame, or one element of a field in an array.

    Attributes:
        path: the path with indices, such as "points[1].intensity".
        block: the path of the bit block that contains the field; if there is none, the path of the
            field.
        info: the description of the field; its path is empty for a constant without a name.
        start: the offset of the first byte of the field, or of its bit block.
        end: the offset after the last byte of the field, or of its bit block.
        bits: the bits of the field in the block; None if the field is not in a bit block.
        raw: the raw value; None if it is truncated.
    """

    path: str
    block: str
    info: tree.FieldInfo
    start: int
    end: int
    bits: BitField | None
    raw: Any

    @property
    def first_byte(self) -> int:
        """The offset of the first byte that contains bits of the field."""
        if self.bits is None:
            return self.start
        return self.start + min(segment.byte for segment in self.bits.segments)


@dataclass(frozen=True)
class ExaminedChecksum:
    """A checksum in the bytes of a frame.

    `prefix` is the path of the part that contains the checksum; "" if it is not in a part.
    """

    checksum: FrameChecksum
    prefix: str
    start: int
    stored: int
    computed: int

    @property
    def path(self) -> str:
        """The path of the field that contains the checksum, or of the first such field."""
        return f"{self.prefix}.{self.checksum.leaves[0].info.path}".strip(".")

    @property
    def offset(self) -> int:
        """The offset of the first byte of the checksum."""
        return self.start + self.checksum.leaves[0].byte_span[0]

    @property
    def end(self) -> int:
        """The offset after the last byte of the struct with the checksum."""
        return self.start + self.checksum.end

    @property
    def is_right(self) -> bool:
        """Whether the stored checksum is correct, or states that there is no checksum."""
        return self.stored == self.computed or self.stored in self.checksum.absent


@dataclass(frozen=True)
class ExaminedParts:
    """The parts of a frame at one path.

    If `is_whole` is False, the last part is invalid.
    """

    parts: list[ExaminedFrame]
    is_whole: bool


@dataclass(frozen=True, eq=False)
class ExaminedFrame:
    """A frame or a part, with as much of its layout as the bytes determine.

    Attributes:
        root: the tree of the frame type.
        known: the layout, or the `HeaderWalk` with the layout up to the error in `failure`.
        failure: the error that prevented a layout; None if there is a layout.
        start: the offset of a part in the frame; 0 for a frame.
        prefix: the path of a part in the frame; "" for a frame.
        is_bounded: for a part, whether more bytes of the frame follow `data`.
    """

    root: tree.Node
    data: bytes
    known: Layout | HeaderWalk
    failure: Exception | None
    limit: int
    start: int = 0
    prefix: str = ""
    is_bounded: bool = False
    _parts: dict[str, ExaminedParts] = field(default_factory=dict)

    @property
    def layout(self) -> Layout | None:
        """The layout; None if the bytes do not determine it."""
        if isinstance(self.known, Layout):
            return self.known
        return None

    def fields(self) -> Iterator[WireField]:
        """Yield the fields in wire order.

        If the last field is truncated, its `raw` is None.
        """
        cursor = _Cursor(self)
        yield from cursor.visit(self.root, "", self.prefix)

    def checksums(self) -> Iterator[ExaminedChecksum]:
        """Yield the checksums of complete structs, inner checksums first."""
        rows = np.frombuffer(self.data, np.uint8).reshape(1, -1)
        for checksum in self.known.checksums:
            if checksum.end <= len(self.data):
                stored = int(checksum.load_stored(rows)[0])
                computed = int(checksum.compute(rows)[0])
                yield ExaminedChecksum(checksum, self.prefix, self.start, stored, computed)
        axes = [*self.known.regions]
        if isinstance(self.known, HeaderWalk):
            axes += [axis for axis in self.known.open_regions if axis not in axes]
        for axis in axes:
            for part in self.list_parts_of(axis):
                yield from part.checksums()

    def region(self, axis: str) -> Region | None:
        """Return the region of the parts at a path; None if it is not known."""
        if axis in self.known.regions:
            return self.known.regions[axis]
        if isinstance(self.known, HeaderWalk):
            return self.known.open_regions.get(axis)
        return None

    def list_parts_of(self, axis: str) -> list[ExaminedFrame]:
        """Return the parts of a sequence, up to the first invalid part."""
        return self._get_parts(axis).parts

    def find_broken_part(self, axis: str) -> ExaminedFrame | None:
        """Return the invalid part of a sequence of parts; None if all parts are valid."""
        examined = self._get_parts(axis)
        if examined.is_whole:
            return None
        return examined.parts[-1]

    def _get_parts(self, axis: str) -> ExaminedParts:
        if axis not in self._parts:
            self._parts[axis] = _examine_parts(self, axis)
        return self._parts[axis]


def examine(
    root: tree.Node,
    data: bytes,
    limit: int,
    given: Mapping[str, int] | None = None,
    start: int = 0,
    prefix: str = "",
    is_bounded: bool = False,
) -> ExaminedFrame:
    """Find the layout of one frame, as far as its bytes determine it.

    Args:
        limit: the maximum size of a frame, in bytes.
        given: for a part, the values of fields of the outer frame, by path.
        start, prefix, is_bounded: for a part, see `ExaminedFrame`.
    """

    def read(leaf: Leaf | MeasuredSize, walk: HeaderWalk) -> int:
        value = leaf.read_first(data)
        if value is None:
            raise UnknownSelectorError(leaf)
        walk.values = {**walk.values, leaf.info.path: value}
        return value

    walk = HeaderWalk({}, limit, given or {}, read)
    try:
        layout = walk_layout(walk, root)
    except Exception as failure:  # an expression of the struct may raise anything
        return ExaminedFrame(root, data, walk, failure, limit, start, prefix, is_bounded)
    return ExaminedFrame(root, data, layout, None, limit, start, prefix, is_bounded)


def _examine_parts(around: ExaminedFrame, axis: str) -> ExaminedParts:
    region = around.region(axis)
    assert region is not None
    data = np.frombuffer(around.data, np.uint8)
    walked = region.walk(data, np.zeros(1, np.intp))
    pieces = [piece for pieces in walked.rounds for piece in pieces]
    parts = list[ExaminedFrame]()
    for index, piece in enumerate(pieces):
        start = int(piece.offsets[0])
        stop = start + piece.layout.size
        parts.append(
            _examine_part(around, region, axis, index, region.kinds[piece.kind], start, stop)
        )
    end = region.start + int(walked.sizes[0])
    is_whole = bool(walked.status[0] == FOUND) and region.size in (None, end - region.start)
    if not is_whole:
        kind = _choose_kind(region, around.data[end:])
        stop = len(around.data)
        if region.rule.within is not None:
            stop = min(stop, region.start + region.rule.within)
        parts.append(_examine_part(around, region, axis, len(parts), kind, end, stop))
    return ExaminedParts(parts, is_whole)


def _examine_part(
    around: ExaminedFrame,
    region: Region,
    axis: str,
    index: int,
    kind: PartKind,
    start: int,
    end: int,
) -> ExaminedFrame:
    prefix = f"{around.prefix}.{axis}[{index}]".strip(".")
    is_bounded = around.is_bounded or end < len(around.data)
    return examine(
        kind.node.root,
        around.data[start:end],
        around.limit,
        region.given,
        around.start + start,
        prefix,
        is_bounded,
    )


def _choose_kind(region: Region, data: bytes) -> PartKind:
    """Return the first kind of parts with matching constants, else the last kind."""
    for kind in region.kinds:
        known = [
            data[offset] & mask == value
            for offset, (mask, value) in kind.prefix.items()
            if offset < len(data)
        ]
        if all(known):
            return kind
    return region.kinds[-1]


class _Cursor:
    """Iterates over the fields of one frame."""

    def __init__(self, examined: ExaminedFrame) -> None:
        self._examined = examined
        self._known = examined.known
        self._data = examined.data
        self._offset = 0
        self._empty_elements = 0
        self._is_over = False

    def visit(self, node: tree.Node, path: str, shown: str) -> Iterator[WireField]:
        """Yield the fields of a node.

        Args:
            path: the path of the node without indices.
            shown: the path of the node with indices.
        """
        if self._is_over:
            return
        match node:
            case tree.ChecksummedStruct():
                yield from self.visit(node.body, path, shown)
            case tree.Struct():
                for child in node.members:
                    name = child.name or tree.UNNAMED
                    below = f"{node.path}.{child.name}".strip(".")
                    yield from self.visit(child, below, f"{shown}.{name}".strip("."))
            case tree.Repeat():
                yield from self._iter_array(node, path, shown)
            case tree.PartSequence():
                yield from self._iter_parts(node)
            case tree.When() | tree.Select():
                branch = self._known.branches.get(node)
                if branch is None:
                    self._is_over = True
                else:
                    yield from self.visit(branch, path, shown)
            case tree.Number():
                yield self._take_value(node.info, shown, node.size, _make_number_decoder(node))
            case tree.Blob():
                yield from self._iter_blob(node, path, shown)
            case tree.Block():
                yield from self._iter_block(node, shown)

    def _iter_array(self, node: tree.Repeat, path: str, shown: str) -> Iterator[WireField]:
        count = node.count if isinstance(node.count, int) else self._known.lengths.get(node.axis)
        if count is None:
            self._is_over = True
            return
        for index in range(count):
            start = self._offset
            yield from self.visit(node.element, path, f"{shown}[{index}]")
            if self._offset == start:
                self._empty_elements += 1
            if self._is_over or self._empty_elements > self._examined.limit:
                self._is_over = True
                return

    def _iter_parts(self, node: tree.PartSequence) -> Iterator[WireField]:
        region = self._examined.region(node.axis)
        if region is not None:
            for part in self._examined.list_parts_of(node.axis):
                yield from part.fields()
        if region is None or region.size is None or region.start + region.size > len(self._data):
            self._is_over = True
        else:
            self._offset = region.start + region.size

    def _iter_blob(self, node: tree.Blob, path: str, shown: str) -> Iterator[WireField]:
        if node.const is not None and not node.name:
            info = tree.FieldInfo("", kind="bytes", const=node.const)
            yield self._take_value(info, shown, len(node.const), bytes)
        elif path not in self._known.leaves:
            self._is_over = True
        else:
            size = self._known.leaves[path].size
            terminator = b"" if node.ending is None else node.ending.terminator
            # The terminator is shown with the bytes that it ends.
            yield self._take_value(
                node.info,
                shown,
                size + len(terminator),
                lambda data: _decode_bytes(node.info, data[:size]),
            )

    def _iter_block(self, node: tree.Block, shown: str) -> Iterator[WireField]:
        start = self._examined.start + self._offset
        block = self._take(node.size)
        for part in node.parts:
            keys = [f"[{key}]" if isinstance(key, int) else f".{key}" for key in part.bits.keys]
            path = (shown + "".join(keys)).strip(".")
            raw: Any = None
            if block is not None:
                raw = part.bits.value(block)
                raw = bool(raw) if part.bits.flag else raw
            yield WireField(path, shown, part.info, start, start + node.size, part.bits, raw)
            if block is None:
                return

    def _take_value(self, info: tree.FieldInfo, shown: str, size: int, decode: Any) -> WireField:
        start = self._examined.start + self._offset
        data = self._take(size)
        raw = None if data is None else decode(data)
        return WireField(shown, shown, info, start, start + size, None, raw)

    def _take(self, size: int) -> bytes | None:
        """Return the next bytes, and move to their end.

        If they are not complete, the method returns None, and does not move.
        """
        end = self._offset + size
        if end > len(self._data):
            self._is_over = True
            return None
        data = self._data[self._offset : end]
        self._offset = end
        return data


def _decode_bytes(info: tree.FieldInfo, data: bytes) -> Any:
    """Return the value of a field; if its adapter fails, return the bytes."""
    if info.adapter is None:
        return data
    try:
        return info.adapter.decode(data)
    except Exception:  # a function of a plugin may raise anything
        return data


def _make_number_decoder(node: tree.Number) -> Any:
    """Return a function that decodes the bytes of a number."""
    if node.kind == "float":
        order = "<" if node.order == "little" else ">"
        code = struct.Struct(order + {2: "e", 4: "f", 8: "d"}[node.size])
        return lambda data: code.unpack(data)[0]
    return lambda data: int.from_bytes(data, node.order, signed=node.kind == "int")
