"""Layouts: the positions of all fields of a frame, for loading and storing values.

A `Layout` describes the frames of one header variant. `lidarspec.frames.layout_tree` makes it from
the frame tree. A `Leaf` is the position of one field. A `FrameChecksum` has the fields that store a
checksum, and the bytes that the checksum covers. Most functions handle many frames at once, given
as rows of bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, reduce
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.row_checksums import compute_over_spans
from lidarspec.spec.bits import BitField, Segment
from lidarspec.spec.checksums import Checksum, Single, make_single
from lidarspec.spec.tree import (
    Check,
    FieldInfo,
    Formula,
    Node,
    evaluate_arrays,
    get_element,
    iter_subformulas,
    refs,
    width,
)

Bytes2D = NDArray[np.uint8]


def view_elements(
    rows: Bytes2D,
    dtype: np.dtype[Any],
    offset: int,
    shape: tuple[int, ...],
    strides: tuple[int, ...],
) -> NDArray[Any]:
    """Return a view of the elements at an offset of each row, (n, *shape).

    Each row has to be contiguous.
    """
    if rows.flags.c_contiguous:
        return np.ndarray((len(rows), *shape), dtype, rows, offset, (rows.shape[1], *strides))
    first = rows[:, offset : offset + dtype.itemsize].view(dtype)
    if not shape:
        return first[:, 0]
    return np.lib.stride_tricks.as_strided(first, (len(rows), *shape), (rows.strides[0], *strides))


def view_span(rows: Bytes2D) -> NDArray[np.uint8]:
    """Return a view of the memory from the first row to the last, (k,).

    Bytes between the rows are included.
    """
    if rows.flags.c_contiguous:
        return rows.reshape(-1)
    return np.lib.stride_tricks.as_strided(
        rows, ((len(rows) - 1) * rows.strides[0] + rows.shape[1],), (1,)
    )


def gather_rows(
    buffer: NDArray[np.uint8], offsets: NDArray[np.intp], size: int, *, gathered: bool = True
) -> NDArray[np.uint8]:
    """Return rows of `size` bytes, one for each start offset, (n, size).

    The result may be a view of the buffer.

    Args:
        gathered: whether the result has to be C-contiguous.
    """
    count = len(offsets)
    if not count or not size:
        return np.zeros((count, size), np.uint8)
    if size == 1:
        return buffer.take(offsets).reshape(count, 1)
    first = offsets.item(0)
    if count > 1:
        step = offsets.item(1) - offsets.item(0)
    else:
        step = size
    even = offsets.item(-1) - first == (count - 1) * step
    if even and count > 2:
        even = np.count_nonzero(offsets[1:] - offsets[:-1] == step) == count - 1
    if even and step == size:
        return buffer[first : first + count * size].reshape(count, size)
    if even and step > size and not gathered:
        return np.ndarray((count, size), np.uint8, buffer.data, first, (step, 1))
    windows: NDArray[Any] = np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer.data, 0, (1,))
    return windows[offsets].view(np.uint8).reshape(count, size)


@dataclass(frozen=True, eq=False)
class Leaf:
    """The position of one field.

    Attributes:
        offset: the offset of the first element, in bytes from the start of the frame.
        shape: the number of elements along each array that contains the field.
        strides: the distance from one element to the next along each array, in bytes. An array
            inside a bit block has no stride.
        wire: the dtype and byte order of the field in the frame; None if NumPy cannot read it
            directly.
        elements: if `wire` is None, the bits of the field, or of each element of its array inside a
            bit block.
        size: the size of one element, or of the bit block that contains the field, in bytes.
    """

    info: FieldInfo
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    size: int
    wire: np.dtype[Any] | None = None
    elements: tuple[BitField, ...] = ()

    def load(self, rows: Bytes2D) -> NDArray[Any]:
        """Return the raw values of the field, (n, *shape), in native byte order."""
        if self.wire is not None:
            return self._view(rows, self.wire, 0).astype(self._native)
        assert self.info.dtype is not None
        if not self._is_packed:
            return self._read_bits(rows, self.elements[0])
        columns = [self._read_bits(rows, element) for element in self.elements]
        return np.stack(columns, axis=-1)

    def read_scalar(self, frame: bytes | memoryview) -> int:
        """Return the raw value of an integer field outside arrays in one frame."""
        if self.elements:
            return self.elements[0].value(frame[self.offset : self.offset + self.size])
        assert self.wire is not None
        order: Literal["big", "little"] = "big" if self.wire.byteorder == ">" else "little"
        return int.from_bytes(
            frame[self.offset : self.offset + self.size], order, signed=self.wire.kind == "i"
        )

    def read(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None = None,
    ) -> tuple[NDArray[np.intp] | None, NDArray[Any]]:
        """Read an integer field in the candidates (possible frames) at these offsets.

        The field must not be in an array.

        Args:
            stops: the end offset of each candidate; by default the end of the buffer.

        Returns:
            The indices of the candidates that have the field (None if all have it), and the values.
        """
        there = offsets + (self.offset + self.size) <= (len(buffer) if stops is None else stops)
        which = None if there.all() else np.flatnonzero(there)
        starts = (offsets if which is None else offsets[which]) + self.offset
        if self.wire is not None and len(starts):
            windows: NDArray[Any] = np.ndarray(
                (len(buffer) - self.size + 1,), self.wire, buffer.data, 0, (1,)
            )
            return which, windows[starts].astype(self._native)
        return which, self._from_start.load(gather_rows(buffer, starts, self.size))

    def read_first(self, frame: bytes | memoryview) -> int | None:
        """Return the value of the field, given the first bytes of a frame.

        Returns None if the bytes end in or before the field.
        """
        if self.offset + self.size <= len(frame):
            return self.read_scalar(frame)
        return None

    def store(self, rows: Bytes2D, values: Any) -> None:
        """Write raw values, broadcast to (n, *shape), into frames given as rows of bytes."""
        full = np.broadcast_to(np.asarray(values), (len(rows), *self.shape))
        if self.wire is not None:
            self._view(rows, self.wire, 0)[...] = full.astype(self.wire.newbyteorder("="))
            return
        for index, element in enumerate(self.elements):
            column = (full[..., index] if self._is_packed else full).astype(np.int64)
            for part in element.segments:
                view = self._view(rows, np.dtype("u1"), part.byte)
                bits = (column >> part.target << part.low).astype(np.uint8) & np.uint8(part.mask)
                view[...] = (view & np.uint8(~part.mask & 0xFF)) | bits

    def offsets(self, depth: int | None = None) -> list[int]:
        """Return the offset of each element, in C order.

        Args:
            depth: the number of outer arrays to iterate over; None for all arrays outside a
                bit block.
        """
        offsets = [self.offset]
        for length, stride in list(zip(self.shape, self.strides, strict=False))[:depth]:
            offsets = [offset + stride * index for offset in offsets for index in range(length)]
        return offsets

    def raw(self, given: Sequence[Any]) -> NDArray[Any]:
        """Convert the physical values of n frames to raw values, (n, ...)."""
        if self.info.kind == "bytes":
            size = self.shape[-1]
            given = [
                list(value[:size].ljust(size, b"\0")) if isinstance(value, bytes) else value
                for value in given
            ]
        values = np.array([np.asarray(value, np.float64) for value in given])
        return np.asarray(
            self.info.raw(
                values.reshape(*values.shape, *(1,) * (1 + len(self.shape) - values.ndim))
            )
        )

    @cached_property
    def _from_start(self) -> Leaf:
        return self.shift(self.offset)

    @cached_property
    def _native(self) -> np.dtype[Any]:
        assert self.wire is not None
        return self.wire.newbyteorder("=")

    @property
    def _is_packed(self) -> bool:
        """Whether the innermost array is inside a bit block; such an array has no stride."""
        return len(self.shape) > len(self.strides)

    def _view(self, rows: Bytes2D, dtype: np.dtype[Any], offset: int) -> NDArray[Any]:
        shape = self.shape[: len(self.strides)]
        if not len(rows) or 0 in shape:
            return np.empty((len(rows), *shape), dtype)
        return view_elements(rows, dtype, self.offset + offset, shape, self.strides)

    def _read_bits(self, rows: Bytes2D, element: BitField) -> NDArray[Any]:
        assert self.info.dtype is not None
        wide = np.dtype(f"u{self.info.dtype.itemsize}")
        total = (
            self._read_bits_in_byte(rows, element.segments[0], wide)
            if len(element.segments) == 1
            else self._read_contiguous_bits(rows, element, wide)
        )
        if total is None:
            total = np.zeros((len(rows), *self.shape[: len(self.strides)]), wide)
            for part in element.segments:
                bits = (
                    self._view(rows, np.dtype("u1"), part.byte) & np.uint8(part.mask)
                ) >> part.low
                total |= bits.astype(wide) << wide.type(part.target)
        if element.signed:
            sign = wide.type(1 << (element.width - 1))
            return np.asarray(((total ^ sign) - sign).view(self.info.dtype))
        return total.astype(self.info.dtype, copy=False)

    def _read_bits_in_byte(self, rows: Bytes2D, part: Segment, wide: np.dtype[Any]) -> NDArray[Any]:
        """Return the values of bits within one byte."""
        total = self._view(rows, np.dtype("u1"), part.byte).astype(wide)
        if part.mask != 0xFF:
            total &= wide.type(part.mask)
            total >>= wide.type(part.low)
        return total

    def _read_contiguous_bits(
        self, rows: Bytes2D, element: BitField, wide: np.dtype[Any]
    ) -> NDArray[Any] | None:
        """Return the values of contiguous bits; None if they cannot be read as words."""
        if element.run is None:
            return None
        order, first, count, lowest = element.run
        spare = wide.itemsize - count
        if spare < 0 or self.offset + first < spare:
            return None
        total = self._view(rows, np.dtype(f"{order}u{wide.itemsize}"), first - spare).astype(wide)
        lowest += 8 * spare if order == "<" else 0
        if lowest:
            total >>= wide.type(lowest)
        if lowest + element.width < 8 * wide.itemsize:
            total &= wide.type((1 << element.width) - 1)
        return total

    @property
    def byte_span(self) -> tuple[int, int]:
        """The offset of the first byte of the field, and the offset after its last byte.

        If the field is in arrays, these are the offsets of its first element.
        """
        if not self.elements:
            return self.offset, self.offset + self.size
        byte_offsets = [
            self.offset + part.byte for element in self.elements for part in element.segments
        ]
        return min(byte_offsets), max(byte_offsets) + 1

    def element(self, path: str, indices: Mapping[str, int]) -> Leaf | None:
        """Return one element of the arrays of the field; None if it does not exist.

        A negative index counts from the end.
        """
        info = get_element(self.info, path, indices)
        if info is None:
            return None
        offset = self.offset
        shape = list(self.shape)
        bit_fields = self.elements
        kept = 0
        for place, (axis, length) in enumerate(zip(self.info.axes, self.shape, strict=True)):
            index = indices.get(axis, 0)
            if not -length <= index < length:
                return None
            if axis not in indices:
                kept = place + 1
            elif place < len(self.strides):
                offset, shape[place] = offset + index % length * self.strides[place], 1
            else:
                bit_fields = (bit_fields[index],)
        if self.info.kind == "bytes" and info.kind == "int":
            size = 1
        else:
            size = self.size
        return replace(
            self,
            info=info,
            offset=offset,
            shape=tuple(shape[:kept]),
            strides=self.strides[:kept],
            size=size,
            elements=bit_fields,
        )

    def shift(self, offset: int) -> Leaf:
        """Return the leaf with `offset` subtracted from its own offset."""
        return replace(self, offset=self.offset - offset)


@dataclass(frozen=True, eq=False)
class Derivation:
    """A value without bytes of its own, such as a `Computed`, in frames of one layout.

    Attributes:
        shape: the number of elements along each array that contains the value.
        strides: the difference between the values of consecutive elements along each array.
        formula: a formula of fields of the frame; None if the value is computed from `start`.
        start: the value of the first element.
        picked: for each array, the index of the selected element, or None if all elements of the
            array are selected; () if all elements of all arrays are selected.
    """

    info: FieldInfo
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    formula: Formula | None = None
    start: Any = 0
    picked: tuple[int | None, ...] = ()

    def load(self, rows: Bytes2D, leaves: Mapping[str, Leaf]) -> NDArray[Any]:
        """Return the values of frames given as rows of bytes, (n, *shape)."""
        whole = self._compute(rows, leaves)
        full = np.broadcast_to(whole, (len(rows), *self.shape))
        if not self.picked:
            return full
        chosen = (slice(None) if index is None else index for index in self.picked)
        return full[(slice(None), *chosen)]

    def _compute(self, rows: Bytes2D, leaves: Mapping[str, Leaf]) -> NDArray[Any]:
        depth = len(self.shape)
        if self.formula is not None:
            columns = {}
            for ref in refs(self.formula):
                values = leaves[ref.path].load(rows)
                dtype = np.int64 if values.dtype.kind in "iu" else np.float64
                spare = (1,) * (1 + depth - values.ndim)
                columns[ref.path] = values.astype(dtype).reshape(*values.shape, *spare)
            return np.asarray(evaluate_arrays(self.formula, columns, None))
        values = np.array(self.start).reshape((1,) * (1 + depth))
        if any(self.strides):
            for axis, (length, stride) in enumerate(zip(self.shape, self.strides, strict=True)):
                steps = np.arange(length) * stride
                values = values + steps.reshape(*(1,) * (1 + axis), -1, *(1,) * (depth - axis - 1))
        return values

    def element(self, path: str, indices: Mapping[str, int]) -> Derivation | None:
        """Return one element of the arrays of the value; None if it does not exist."""
        info = get_element(self.info, path, indices)
        picked = tuple(indices.get(axis) for axis in self.info.axes)
        exists = all(
            index is None or -length <= index < length
            for index, length in zip(picked, self.shape, strict=True)
        )
        if info is None or not exists:
            return None
        return replace(self, info=info, picked=picked)


#: A function that computes one checksum of many frames, (n,). It returns None if the algorithm of
#: the checksum has to compute it.
Sums = Callable[["FrameChecksum", Bytes2D], "NDArray[np.uint64] | None"]


@dataclass(frozen=True, eq=False)
class FrameChecksum:
    """A checksum of the frame.

    Attributes:
        leaves: the fields with the checksum, low bits first.
        spans: the byte ranges that the checksum covers.
        absent: the stored values that mean that the sensor has computed no checksum.
    """

    leaves: tuple[Leaf, ...]
    spans: tuple[tuple[int, int], ...]
    algorithm: Checksum
    absent: tuple[int, ...]
    #: The offset after the last byte of the struct with the checksum.
    end: int = 0

    def covers(self, other: FrameChecksum) -> bool:
        """Return whether this checksum covers the bytes of another checksum."""
        return any(
            start < leaf.byte_span[1] and leaf.byte_span[0] < end
            for start, end in self.spans
            for leaf in other.leaves
        )

    def load_stored(self, rows: Bytes2D) -> NDArray[np.uint64]:
        """Return the checksums that the frames contain, (n,)."""
        if len(self.leaves) == 1 and self.leaves[0].info.kind != "bytes":
            return self.leaves[0].load(rows).astype(np.uint64)
        total = np.zeros(len(rows), np.uint64)
        shift = 0
        for leaf in self.leaves:
            values = leaf.load(rows).astype(np.uint64)
            if leaf.info.kind == "bytes":
                values = np.bitwise_or.reduce(values << self._list_byte_shifts(leaf), axis=1)
            total |= values << np.uint64(shift)
            shift += leaf.info.bits
        return total

    def _list_byte_shifts(self, leaf: Leaf) -> NDArray[np.uint64]:
        """Return the position of each byte in the value of a field, in bits."""
        powers = np.arange(0, leaf.info.bits, 8, dtype=np.uint64)
        if self.algorithm.order == "little":
            return powers
        return powers[::-1]

    def compute(self, rows: Bytes2D, sums: Sums | None = None) -> NDArray[np.uint64]:
        """Compute the checksums of the frames, (n,).

        Args:
            sums: a function that computes some checksums faster. If it is None or returns None,
                the algorithm of the checksum is used.
        """
        values = None if sums is None else sums(self, rows)
        if values is None:
            return compute_over_spans(self.algorithm, rows, self.spans or ((0, 0),))
        return values

    def fill(self, rows: Bytes2D) -> None:
        """Compute the checksums and write them into the frames."""
        values = self.compute(rows)
        shift = 0
        for leaf in self.leaves:
            part = (values >> np.uint64(shift)) & np.uint64((1 << leaf.info.bits) - 1)
            if leaf.info.kind == "bytes":
                part = part[:, None] >> self._list_byte_shifts(leaf) & np.uint64(0xFF)
            leaf.store(rows, part)
            shift += leaf.info.bits

    def is_valid(self, frame: bytes) -> bool:
        """Return whether the checksum of one frame is correct.

        A stored value in `absent` counts as correct.
        """
        stored = shift = 0
        for leaf in self.leaves:
            if leaf.info.kind == "bytes":
                stored |= (
                    int.from_bytes(
                        frame[leaf.offset : leaf.offset + leaf.size], self.algorithm.order
                    )
                    << shift
                )
            else:
                stored |= (leaf.read_scalar(frame) & ((1 << leaf.info.bits) - 1)) << shift
            shift += leaf.info.bits
        covered = [frame[start:end] for start, end in self.spans]
        return stored in self.absent or stored == self._single(
            covered[0] if len(covered) == 1 else b"".join(covered)
        )

    @cached_property
    def _single(self) -> Single:
        return make_single(self.algorithm)

    def are_valid(self, rows: Bytes2D, sums: Sums | None = None) -> NDArray[np.bool_]:
        """Return whether the checksum of each frame is correct, (n,).

        A stored value in `absent` counts as correct.
        """
        stored = self.load_stored(rows)
        if self.absent:
            filled = reduce(np.logical_and, (stored != np.uint64(value) for value in self.absent))
        else:
            filled = None
        if filled is None or filled.all():
            return np.asarray(stored == self.compute(rows, sums))
        right = np.ones(len(rows), np.bool_)
        if filled.any():
            right[filled] = stored[filled] == self.compute(rows[filled], sums)
        else:
            right[filled] = True
        return right


@dataclass(frozen=True, eq=False)
class Condition:
    """A condition that frames have to meet.

    Without a `formula`, the field must have one of its allowed values. With a `formula`, the value
    of the formula must not be 0.
    """

    fields: tuple[FieldInfo, ...]
    formula: Formula | None
    #: The path of the check, or of the field.
    path: str = ""

    @classmethod
    @lru_cache(maxsize=4096)
    def of(cls, what: FieldInfo | Check) -> Condition:
        """Return the condition for a check, or for the allowed values of a field."""
        if isinstance(what, FieldInfo):
            return cls((what,), None, what.path)
        fields = tuple(ref.info for ref in refs(what.condition))
        return cls(fields, what.condition, what.path)

    def values(self, raw: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
        """Return whether the condition is true, element by element.

        The condition is false if one of its fields is missing in `raw`.
        """
        if len(raw) < len(self.fields):
            return np.zeros(1, np.bool_)
        if self.formula is None:
            (values,) = raw.values()
            info = self.fields[0]
            if info.allowed is None and info.adapter is not None:
                return info.adapter.can_decode(values, is_bytes=info.kind == "bytes")
            return np.isin(values, np.array(self.fields[0].allowed, values.dtype))
        depth = max(array.ndim for array in raw.values())
        columns = {
            path: array.astype(self._dtype).reshape(*array.shape, *(1,) * (depth - array.ndim))
            for path, array in raw.items()
        }
        results = np.asarray(evaluate_arrays(self.formula, columns, self._dtype))
        return results if results.dtype == np.bool_ else results != 0

    @cached_property
    def _dtype(self) -> Any:
        """The smallest integer type that can represent all intermediate values of the formula."""
        most = max(width(part) for part in iter_subformulas(self.formula or 0))
        if most < 15:
            return np.int16
        if most < 31:
            return np.int32
        return np.int64


class FrameTest(Protocol):
    """A test of the values of some fields; it is true in all valid frames."""

    @property
    def fields(self) -> tuple[FieldInfo, ...]:
        """The fields that the test reads."""

    def values(self, raw: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
        """Return whether the test is true, element by element."""


def find_passing(test: FrameTest, leaves: Mapping[str, Leaf], rows: Bytes2D) -> NDArray[np.bool_]:
    """Return whether each frame, given as a row of bytes, passes a test, (n,).

    In a frame with arrays, the test must be true for all elements.
    """
    raw = {
        info.path: leaf.load(rows)
        for info in test.fields
        if (leaf := leaves.get(info.path)) is not None
    }
    held = test.values(raw).astype(np.bool_, copy=False)
    held = np.broadcast_to(held, (len(rows), *held.shape[1:]))
    return np.asarray(held.all(axis=tuple(range(1, held.ndim))))


@dataclass(frozen=True, eq=False)
class LayoutRefusal:
    """The reason why frames with a certain header have no layout.

    There are three reasons: a plugin expression fails, a constant is wrong, or else the lengths in
    the header are invalid (`InvalidLengthError`).

    Attributes:
        error: the error of the plugin expression; None for the other reasons.
        has_wrong_constant: whether a constant is wrong.
        constants: for invalid lengths, the constants before the field that makes the frame too
            long, as (mask, value) by offset. They still have to be compared with the frames, whose
            constants may be wrong as well.
    """

    error: PluginError | None = None
    has_wrong_constant: bool = False
    constants: Mapping[int, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Layout:
    """The layout of the frames of one header variant.

    Attributes:
        size: the size of the frames in bytes.
        leaves: the position of each field, by path.
        constants: the constant bits, as (mask, value) by offset.
        checksums: the checksums, inner checksums first.
        places: the byte range of each named field, struct and array outside other arrays, by path.
        branches: the branch that each `When` and `Select` takes.
        following: the fields whose values the header implies, each with its value.
        lengths: the length of each array, by path; 0 for an array inside an empty array.
        regions: the `Region` of each sequence of parts (frames within the frame), by path.
        held: the bits that the fields with `SizeOf` must have, as (mask, value) by offset.
        conditions: the conditions that the values of fields have to meet.
        derived: the `Derivation` of each value without bytes of its own, by path; a `Leaf` for a
            copy of a field.
        notes: a cache for results that other modules derive from the layout.
    """

    size: int
    leaves: Mapping[str, Leaf]
    constants: Mapping[int, tuple[int, int]]
    checksums: tuple[FrameChecksum, ...]
    places: Mapping[str, tuple[int, int]]
    branches: Mapping[Node, Node] = field(default_factory=dict)
    following: tuple[tuple[Leaf, int], ...] = ()
    lengths: Mapping[str, int] = field(default_factory=dict)
    regions: Mapping[str, Any] = field(default_factory=dict)
    held: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    conditions: tuple[Condition, ...] = ()
    derived: Mapping[str, Leaf | Derivation] = field(default_factory=dict)
    notes: dict[Any, Any] = field(default_factory=dict, repr=False)

    @cached_property
    def known(self) -> Mapping[int, tuple[int, int]]:
        """The bits in `constants` and in `held`, as (mask, value) by offset."""
        both = dict(self.constants)
        for offset, (mask, value) in self.held.items():
            other = both.get(offset, (0, 0))
            both[offset] = (mask | other[0], value | other[1])
        return both

    @cached_property
    def _mask(self) -> int:
        """The masks of `known` as one little-endian number."""
        return sum(mask << 8 * offset for offset, (mask, _) in self.known.items())

    @cached_property
    def _value(self) -> int:
        """The values of `known` as one little-endian number."""
        return sum(value << 8 * offset for offset, (_, value) in self.known.items())

    def column(self, path: str) -> Leaf | Derivation | None:
        """Return the position of a field or derived value; None if the layout lacks it."""
        return self.leaves.get(path) or self.derived.get(path)

    def load(self, path: str, rows: Bytes2D) -> NDArray[Any]:
        """Return the raw values of a field, or of a derived value, (n, *shape)."""
        found = self.column(path)
        if isinstance(found, Derivation):
            return found.load(rows, self.leaves)
        assert found is not None
        return found.load(rows)

    def is_valid(self, frame: bytes) -> bool:
        """Return whether size, constants, checksums and conditions of a frame are valid."""
        return (
            len(frame) == self.size
            and int.from_bytes(frame, "little") & self._mask == self._value
            and all(part.is_valid(frame) for part in (*self.checksums, *self.regions.values()))
            and (
                not self.conditions
                or self.meet_conditions(np.frombuffer(frame, np.uint8).reshape(1, -1)).item()
            )
        )

    def meet_conditions(self, rows: Bytes2D) -> NDArray[np.bool_]:
        """Return whether each frame, given as a row of bytes, meets all conditions, (n,)."""
        met = np.ones(len(rows), np.bool_)
        for condition in self.conditions:
            met &= self.meet_condition(condition, rows)
        return met

    def meet_condition(self, condition: Condition, rows: Bytes2D) -> NDArray[np.bool_]:
        """Return whether each frame, given as a row of bytes, meets a condition, (n,)."""
        return find_passing(condition, self.leaves, rows)

    def complete_rows(self, rows: Bytes2D) -> None:
        """Write constants, lengths and checksums into frames given as rows of bytes."""
        self.write_constants(rows)
        for checksum in self.checksums:
            checksum.fill(rows)

    def write_constants(self, rows: Bytes2D) -> None:
        """Write the constants, and the values in `following`, into rows of bytes."""
        for leaf, value in self.following:
            leaf.store(rows, value)
        set_bits(rows, self.known)


def set_bits(rows: Bytes2D, bits_by_offset: Mapping[int, tuple[int, int]]) -> None:
    """Write bits into frames given as rows of bytes.

    Args:
        bits_by_offset: the bits, as (mask, value) by offset.
    """
    if bits_by_offset:
        offsets = list(bits_by_offset)
        bits = np.array(list(bits_by_offset.values()), np.uint8)
        rows[:, offsets] = rows[:, offsets] & ~bits[:, 0] | bits[:, 1]


#: Constant bytes, each as (offset, mask, value).
Marks = tuple[tuple[int, int, int], ...]

#: Constant bytes that are compared together, as (offset, dtype, mask, value). The mask is None for
#: all bits.
Word = tuple[int, np.dtype[Any], Any, Any]


def sort_constants(constants: Mapping[int, tuple[int, int]]) -> Marks:
    """Return constants in a list: first the bytes in which all bits are constant."""
    constant_bytes = [(offset, mask, value) for offset, (mask, value) in constants.items()]
    return tuple(sorted(constant_bytes, key=lambda mark: (mark[1] != 0xFF, mark[0])))


@lru_cache(maxsize=2048)
def merge_constants(constants: Marks) -> tuple[Word, ...]:
    """Merge constant bytes into words of 1, 2, 4 or 8 bytes."""
    left = {offset: (mask, value) for offset, mask, value in constants}
    merged = list[Word]()
    while left:
        first = min(left)
        size = next(size for size in (8, 4, 2, 1) if first + size - 1 in left)
        pairs = [left.pop(offset, (0, 0)) for offset in range(first, first + size)]
        dtype = np.dtype(f"<u{size}")
        mask, value = (
            np.frombuffer(bytes(column), dtype)[0] for column in zip(*pairs, strict=True)
        )
        merged.append(
            (first, dtype, None if all(pair[0] == 0xFF for pair in pairs) else mask, value)
        )
    return tuple(merged)


def are_contradictory(some: Marks, others: Marks) -> bool:
    """Return whether two sets of constants contradict each other."""
    bits_by_offset = {offset: (mask, value) for offset, mask, value in others}
    both = [
        (mask & bits_by_offset[offset][0], value ^ bits_by_offset[offset][1])
        for offset, mask, value in some
        if offset in bits_by_offset
    ]
    return any(mask & differing for mask, differing in both)


def match_word(values: NDArray[Any], word: Word) -> NDArray[np.bool_]:
    """Return whether each value matches a constant word."""
    _, _, mask, value = word
    return np.asarray((values if mask is None else values & mask) == value)


def match_constants(constants: tuple[Word, ...], rows: Bytes2D) -> NDArray[np.bool_] | None:
    """Return whether each row has all constants, (n,); None if all rows have them."""
    held: NDArray[np.bool_] | None = None
    for word in constants:
        offset, dtype, _, _ = word
        if offset + dtype.itemsize > rows.shape[1]:
            return np.zeros(len(rows), np.bool_)
        each = match_word(view_elements(rows, dtype, offset, (), ()), word)
        number = np.count_nonzero(each)
        if number < len(rows):
            if held is None:
                held = each
            else:
                held = np.bitwise_and(held, each, out=held)
        if not number:
            break
    return held
