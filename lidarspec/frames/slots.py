"""Frames of a wire form as rows of slots, and back: which slots a layout has, which layout a frame,
and where each slot stands in it.

A form (`lidarspec.spec.wire_forms`) reads slots in order, and nothing else; the layouts of the
struct say which come next. So the fields that decide a layout are read first, and then the rest of
the row, which has to end where the frame does.
"""

from __future__ import annotations

import bisect
import functools
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.frames.compilability import NotCompilable
from lidarspec.frames.layout import Bytes2D, Layout, Leaf, Refused
from lidarspec.frames.layout_tree import HeaderNode, HeaderTree, frame_layouts
from lidarspec.frames.parts import Measure
from lidarspec.spec.description import Frame
from lidarspec.spec.wire_forms import NONE, Reading, Slot, Unescaped, WireForm

Indices = NDArray[np.intp]
#: under which name a parsed frame keeps how it was written, where it would be built otherwise.
SPELLING = "_wire"
#: frames of one layout: it, or why there is none; their indices; their rows; and which end where
#: the frame does, (k,).
Read = tuple[Layout | Refused, Indices, Bytes2D, NDArray[np.bool_]]


@dataclass(frozen=True)
class Legible:
    """What can be read of one frame.

    Attributes:
        slots: that can be read, one by one.
        row: their bytes.
        stop: where in the frame the first slot stands that cannot be read, or what follows the last
            one.
        path, wanted: of that slot, and what should stand there, in words.
    """

    slots: tuple[Slot, ...]
    row: bytes
    stop: int
    path: str
    wanted: str


class _Heads:
    """What has been read of candidates so far: where each goes on (`at`), and the bytes that it
    began with, of all in a group as many.
    """

    def __init__(self, at: Indices) -> None:
        self.at, self._ends = at, np.zeros(len(at), np.intp)
        self._rows = np.empty((len(at), 0), np.uint8)

    def rows(self, which: Indices) -> Bytes2D:
        """The bytes that candidates of one group began with."""
        end = self._ends.item(which[0]) if len(which) else 0
        return self._rows[which, :end] if end else np.empty((len(which), 0), np.uint8)

    def add(self, which: Indices, rows: Bytes2D, at: Indices) -> None:
        """Go on behind further bytes of a group."""
        first = self._ends.item(which[0])
        end = first + rows.shape[1]
        if end > self._rows.shape[1]:
            self._rows = np.pad(self._rows, ((0, 0), (0, end - self._rows.shape[1])))
        self._rows[which, first:end] = rows
        self.at[which], self._ends[which] = at, end


class Recoder:
    """The frames of one type, which has a wire form.

    Raises:
        SpecError: for a struct whose fields have no computable place among the slots.
    """

    def __init__(self, frame: Frame, form: WireForm) -> None:
        self.form, self._limit = form, frame.max_length
        tree = frame_layouts(frame)
        if isinstance(tree, NotCompilable):
            raise SpecError(
                f"a wire form needs fields with computable places: {tree.reason}", path=tree.path
            )
        self.tree: HeaderTree = tree

    @functools.cached_property
    def prefix(self) -> dict[int, int]:
        """The bytes on the wire that all frames have at the same places: those of the texts before
        the first number.
        """
        leaves, constants = self.tree.first()
        slots = itertools.takewhile(
            lambda slot: slot[2].kind == "text",
            _elements(leaves, 0, max(constants, default=-1) + 1),
        )
        known = {spot: value for spot, (mask, value) in constants.items() if mask == 0xFF}
        begins = self.form.begins(
            [
                [known.get(spot) for spot in range(offset, offset + slot.size)]
                for _, offset, slot in slots
            ]
        )
        return {spot: byte for spot, byte in enumerate(begins) if byte is not None}

    @functools.cached_property
    def begins(self) -> bytes:
        """Those of them that all frames begin with."""
        return bytes(
            self.prefix[spot]
            for spot in itertools.takewhile(self.prefix.__contains__, itertools.count())
        )

    def reading(self, buffer: NDArray[np.uint8], starts: Indices) -> Reading:
        """Candidates at these places, ascending."""
        return self.form.read(buffer, starts, self._limit)

    def rows(self, reading: Reading, starts: Indices, sizes: Indices) -> Iterator[Read]:
        """Whole candidates by layout.

        Args:
            starts, sizes: of these, on the wire.
        """
        stops, heads = starts + sizes, _Heads(starts + len(self.form.start))
        for layout, which in self._classified(reading, heads, stops):
            if isinstance(layout, Refused):
                yield layout, which, np.empty((0, 0), np.uint8), np.zeros(len(which), np.bool_)
                continue
            head = heads.rows(which)
            rest = _between(tuple(layout.leaves.values()), head.shape[1], layout.size)
            rows, ends = reading.rows(heads.at[which], stops[which], rest)
            yield (
                layout,
                which,
                np.concatenate([head, rows], axis=1) if head.shape[1] else rows,
                ends == stops[which],
            )

    def _classified(
        self, reading: Reading, heads: _Heads, stops: Indices
    ) -> list[tuple[Layout | Refused, Indices]]:
        if isinstance(reading, Unescaped) and reading.numbers is None:
            return self.tree.classify(
                reading.values,
                reading.places.searchsorted(heads.at),
                reading.places.searchsorted(stops),
            )

        def read(node: HeaderNode, which: Indices) -> tuple[Indices, NDArray[Any]]:
            leaf = node.leaf
            if isinstance(leaf, Measure) or leaf is None:
                raise SpecError(
                    "parts are found by their bytes, and these frames are text",
                    path="" if leaf is None else leaf.info.path,
                )
            known = heads.rows(which)
            if (end := leaf.offset + leaf.size) > known.shape[1]:
                rows, ends = reading.rows(
                    heads.at[which],
                    stops[which],
                    _between(tuple(node.before.values()), known.shape[1], end),
                )
                heads.add(which, rows, ends)
                known = heads.rows(which)
            there = np.flatnonzero(heads.at[which] != NONE)
            return there, leaf.load(known[there])

        return self.tree.sorted(len(stops), read)

    def row(self, data: bytes) -> tuple[Layout, bytes] | None:
        """The layout and the row of one whole frame; None where it is none."""
        buffer, starts = np.frombuffer(data, np.uint8), np.zeros(1, np.intp)
        if not data.startswith(self.begins):
            return None
        reading = self.reading(buffer, starts)
        if reading.sizes[0] != len(data) or (reading.intact is not None and not reading.intact[0]):
            return None
        for layout, which, rows, right in self.rows(reading, starts, reading.sizes):
            if isinstance(layout, Layout) and len(which) and right[0]:
                return layout, rows[0].tobytes()
        return None

    def written(self, rows: Bytes2D, layout: Layout) -> list[bytes | None]:
        """Rows of a layout as frames on the wire; None for one that is no such frame, since a slot
        of it cannot be written.
        """
        frames = self.form.write(rows, slots(layout)) if len(rows) else []
        joined, sizes = (
            np.frombuffer(b"".join(frames), np.uint8),
            np.array([len(frame) for frame in frames], np.intp),
        )
        starts = np.cumsum(sizes) - sizes
        if not frames:
            return []
        right = np.zeros(len(frames), np.bool_)
        reading = self.reading(joined, starts)
        whole = np.flatnonzero(reading.sizes == sizes)
        again, ends = reading.rows(
            starts[whole] + len(self.form.start), (starts + sizes)[whole], slots(layout)
        )
        right[whole] = (ends == (starts + sizes)[whole]) & (again == rows[whole]).all(axis=1)
        return [frame if held else None for frame, held in zip(frames, right.tolist(), strict=True)]

    def legal(self, rows: Bytes2D, layout: Layout) -> None:
        """Make random rows such that they can be written: letters for text, and numbers that are
        not too large.
        """
        start = 0
        for slot in slots(layout):
            part = rows[:, start : (start := start + slot.size * slot.count)]
            if slot.kind == "text" and self.form.is_text:
                part[...] = part % 26 + ord("A")
            elif slot.kind != "text" and (most := self.form.largest(slot)) < 256**slot.size - 1:
                wide = (
                    (slot.numbers(part) % np.uint64(most + 1))
                    .astype(">u8")
                    .view(np.uint8)
                    .reshape(len(rows), slot.count, 8)
                )
                each = wide[:, :, 8 - slot.size :]
                part[...] = (each[:, :, ::-1] if slot.little else each).reshape(len(rows), -1)

    def places(self, data: bytes) -> tuple[bytes, list[int]]:
        """The row of one frame as far as it can be read, and where in the frame each byte of it
        begins, and the last one ends.

        What separates a slot from the next one belongs to it, the mark at the end to none.
        """
        if not data:
            return b"", [0]
        legible = self.legible(data)
        row = legible.row
        reading, start, _ = self._alone(data)
        size = reading.sizes.item(0)
        if isinstance(reading, Unescaped):
            inside = reading.places[
                (reading.places >= len(self.form.start))
                & (reading.places < (size if size > 0 else len(data)))
            ]
            row = (
                row
                if reading.numbers is not None
                else reading.values[reading.places.searchsorted(inside)].tobytes()
            )
            at = inside[: len(row)].tolist()
            has_mark = size > 0 and (self.form.start or reading.numbers is not None)
            follows = (
                inside[len(row)]
                if len(row) < len(inside)
                else size - 1
                if has_mark
                else at[-1] + 1
                if at
                else 0
            )
            return row, [*at, int(follows)]
        starts = reading.starts(start.item(0), _joined(legible.slots))
        at = np.repeat(starts, [slot.size for slot in legible.slots]).tolist()
        return row, [*at, legible.stop - (legible.stop == size)]

    def legible(self, data: bytes) -> Legible:
        """One frame as far as its slots can be read; which ones it has tells its header, if that is
        whole.
        """
        if not data:
            return Legible((), b"", 0, "", "a frame")
        reading, at, stop = self._alone(data)
        elements, row = list(_elements(*self._leaves(reading, np.zeros(1, np.intp), stop))), b""

        def read(number: int) -> tuple[Bytes2D, Indices]:
            return reading.rows(at, stop, _joined(slot for _, _, slot in elements[:number]))

        number = bisect.bisect_left(
            range(1, len(elements) + 1), True, key=lambda count: read(count)[1].item(0) == NONE
        )
        if number:
            rows, at = read(number)
            row = rows.tobytes()
        path, _, slot = elements[number] if number < len(elements) else ("", 0, None)
        seen = tuple(slot for _, _, slot in elements[:number])
        return Legible(
            seen, row, at.item(0), path, "the end of the frame" if slot is None else _in_words(slot)
        )

    def place(self, data: bytes, offset: int) -> int:
        """Where a byte of the row of one frame stands in it: where its slot begins; its end for one
        that cannot be read.
        """
        reading, at, stop = self._alone(data)
        before = [
            slot
            for _, first, slot in _elements(*self._leaves(reading, np.zeros(1, np.intp), stop))
            if first + slot.size <= offset
        ]
        found = reading.rows(at, stop, _joined(before))[1].item(0)
        return len(data) if found == NONE else found

    def _alone(self, data: bytes) -> tuple[Reading, Indices, Indices]:
        """One frame, where its slots begin, and where it ends."""
        reading = self.reading(np.frombuffer(data, np.uint8), np.zeros(1, np.intp))
        size = reading.sizes.item(0)
        return (
            reading,
            np.array([len(self.form.start)]),
            np.array([size if size > 0 else len(data)]),
        )

    def _leaves(
        self, reading: Reading, starts: Indices, stops: Indices
    ) -> tuple[Sequence[Leaf], int, int]:
        """The fields of one frame, as far as its header tells, and the bytes of the row that these
        are in.
        """
        for layout, _ in self._classified(reading, _Heads(starts + len(self.form.start)), stops):
            if isinstance(layout, Layout):
                return tuple(layout.leaves.values()), 0, layout.size
        leaves = self.tree.first()[0]
        return leaves, 0, max((leaf.offset + leaf.size for leaf in leaves), default=0)


def slots(layout: Layout) -> tuple[Slot, ...]:
    """What the rows of a layout consist of."""
    if slots not in layout.notes:
        layout.notes[slots] = _between(tuple(layout.leaves.values()), 0, layout.size)
    found: tuple[Slot, ...] = layout.notes[slots]
    return found


@functools.lru_cache(maxsize=1024)
def _between(leaves: tuple[Leaf, ...], first: int, end: int) -> tuple[Slot, ...]:
    """The slots of fields from one byte of the row to another, those of one kind as one."""
    return _joined(slot for _, _, slot in _elements(leaves, first, end))


def _joined(slots: Iterable[Slot]) -> tuple[Slot, ...]:
    """Slots one by one, those of one kind that follow one another as one."""
    return tuple(
        Slot(slot.kind, slot.size, sum(1 for _ in group), slot.little)
        for slot, group in itertools.groupby(slots)
    )


def _in_words(slot: Slot) -> str:
    return (
        f"{slot.size} characters of text"
        if slot.kind == "text"
        else f"a number of {slot.size} bytes"
    )


def slot_of(leaf: Leaf) -> Slot:
    """What one element of a field is; a block of bits is a number."""
    if leaf.info.kind == "bytes":
        return Slot("text", leaf.size)
    if leaf.wire is not None:
        return Slot(_KINDS[leaf.wire.kind], leaf.size, 1, leaf.wire.byteorder == "<")
    element = leaf.elements[0]
    order = element.run[0] if element.run is not None and element.is_whole else ""
    return Slot("int" if order and element.signed else "uint", leaf.size, 1, order == "<")


_KINDS: dict[str, Literal["uint", "int", "float"]] = {"u": "uint", "i": "int", "f": "float"}


def _elements(leaves: Sequence[Leaf], first: int, end: int) -> Iterator[tuple[str, int, Slot]]:
    """The slots from one byte of the row to another, one by one: path, place and kind; constants
    without a name and parts are text.
    """
    known = [slot_of(leaf) for leaf in leaves]
    for offset, index in _spots(leaves).tolist():
        if offset >= end:
            break
        if offset < first:
            continue
        if offset > first:
            yield "", first, Slot("text", offset - first)
        slot = known[index]
        yield leaves[index].info.path, offset, slot
        first = offset + slot.size
    if first < end:
        yield "", first, Slot("text", end - first)


def _spots(leaves: Sequence[Leaf]) -> NDArray[np.intp]:
    """Where each element of each field begins, ascending, and the index of its field, (k, 2); of
    fields in one block the first.
    """
    found = [np.empty((0, 2), np.intp)]
    for index, leaf in enumerate(leaves):
        depth = len(leaf.strides) - (leaf.info.kind == "bytes")
        shape, spots = leaf.shape[:depth], np.full((1,), leaf.offset, np.intp)
        for length, stride in zip(shape, leaf.strides, strict=False):
            spots = (spots[:, None] + np.arange(length) * stride).reshape(-1)
        found.append(
            np.stack([spots, np.full(spots.size, index)], axis=1)[: spots.size if leaf.size else 0]
        )
    table = np.concatenate(found)
    _, once = np.unique(table[:, 0], return_index=True)
    return table[once]


@functools.lru_cache(maxsize=256)
def recoder(frame: Frame) -> Recoder | None:
    """What recodes the frames of a type; None where they stand on the wire as they are."""
    return None if frame.wire is None else Recoder(frame, frame.wire)
