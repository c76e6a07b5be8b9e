"""Convert between frames as they are sent and the bytes of their structs.

Most frames are sent as the bytes of their struct (`Coder`). A frame type with a wire form
(`lidarspec.spec.wire_forms`) has a `FormCoder`.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.frames.compilability import NotCompilableError
from lidarspec.frames.layout import Bytes2D, Layout, LayoutRefusal, Leaf
from lidarspec.frames.layout_tree import HeaderNode, HeaderTree, find_fixed_constants, frame_layouts
from lidarspec.frames.measured_size import MeasuredSize
from lidarspec.spec.description import Frame
from lidarspec.spec.wire_forms import (
    Decoded,
    LimitsValues,
    NumberRun,
    Problem,
    Run,
    TextRun,
    WireForm,
)

#: The name under which parsed values keep the original frame, if `encode` cannot restore it.
SPELLING = "_wire"
#: The maximum number of bytes of an invalid field that an error shows.
MAX_SHOWN_BYTES = 12


class _UnchangedFrame(Decoded):
    """The result of `Coder.decode`: a struct whose bytes are those of the frame."""

    @property
    def offsets(self) -> list[int]:
        return list(range(len(self.struct) + 1))

    def offset(self, place: int) -> int:
        return place


class Coder:
    """Encodes and decodes frames that are sent as the bytes of their struct.

    Attributes:
        begins: the bytes that all frames begin with.
    """

    def __init__(self, frame: Frame) -> None:
        known = find_fixed_constants(frame.tree, frame.max_struct_bytes)
        self.begins = _join_bytes(
            {offset: value for offset, (mask, value) in known.items() if mask == 0xFF}
        )

    def decode(self, data: bytes) -> Decoded:
        """Decode one frame up to the first error."""
        return _UnchangedFrame(data, (), len(data))

    def encode(self, struct: bytes, spelling: object = None) -> bytes | None:
        """Return the frame for the bytes of a struct.

        Args:
            spelling: the frame from which the values were parsed, if it was kept. Several frames
                may encode the same values, for example with the number 1 or 01. This frame is
                returned if it decodes to `struct`.

        Returns:
            The encoded frame; None if the wire form cannot encode one of the values.
        """
        return struct

    def keep_spelling(self, values: Any, struct: bytes, data: bytes) -> Any:
        """Add the encoded frame to parsed values if `encode` would return other bytes.

        Args:
            values: the parsed values; the frame is added under the name `SPELLING`.
        """
        return values

    def find_size(self, data: bytes) -> int | None:
        """Return the size of the frame at the start of `data`; None if it is unknown."""
        return None

    def make_encodable(self, rows: Bytes2D, layout: Layout) -> None:
        """Change structs with random content so that the wire form can encode them.

        Args:
            rows: the bytes of the structs, one struct per row.
        """


class _FieldFinder:
    """Finds the next fields of a struct, given the first bytes that were decoded so far."""

    def __init__(self, tree: HeaderTree) -> None:
        self._tree = tree
        self._node = tree.find_node(b"")

    def __call__(self, struct: bytes) -> Sequence[Run]:
        self._node = self._tree.find_node(struct, since=self._node)
        if isinstance(self._node.leaf, MeasuredSize):
            raise SpecError(
                "frames of text cannot contain parts",
                path=self._node.leaf.info.path,
            )
        leaves, end = _find_known_fields(self._node)
        return list_runs_between(leaves, len(struct), end)


def _find_known_fields(node: HeaderNode) -> tuple[tuple[Leaf, ...], int]:
    """Return the fields that are known at a node of the header tree, and their end."""
    if isinstance(node.result, Layout):
        return tuple(node.result.leaves.values()), node.result.size
    if isinstance(node.leaf, Leaf):
        return tuple(node.before.values()), node.leaf.offset + node.leaf.size
    return (), 0


class FormCoder(Coder):
    """Encodes and decodes frames with a wire form.

    All methods raise `PluginError` if a plugin's wire form raises an exception.

    Attributes:
        form: the wire form.
        tree: the layouts of the struct.
        prefix: the constant bytes of frames that precede the first number field, by offset.

    Raises:
        SpecError: if the fields of the struct do not have computable offsets.
    """

    def __init__(self, frame: Frame, form: WireForm) -> None:
        tree = frame_layouts(frame)
        if isinstance(tree, NotCompilableError):
            raise SpecError(
                f"`wire` requires a struct in which all offsets can be calculated: {tree.reason}",
                path=tree.path,
            )
        self.form = form
        self.tree: HeaderTree = tree
        self._limit = frame.max_length
        self.prefix = self._find_prefix()
        self.begins = _join_bytes(self.prefix)

    def _find_prefix(self) -> dict[int, int]:
        leaves, constants = self.tree.find_fixed_fields()
        known = {offset: value for offset, (mask, value) in constants.items() if mask == 0xFF}
        texts = list[list[int | None]]()
        offset = 0
        for run in list_runs_between(leaves, 0, max(constants, default=-1) + 1):
            if isinstance(run, NumberRun):
                break
            texts.append([known.get(place) for place in range(offset, offset + run.size)])
            offset += run.size
        with _translate_form_errors(self.form.begins):
            begins = tuple(self.form.begins(texts))
        return {offset: byte for offset, byte in enumerate(begins) if byte is not None}

    def decode(self, data: bytes) -> Decoded:
        size = self.find_end(data[: self._limit])
        if not data:
            decoded = Decoded(b"", [], 0)
        elif size > 0:
            decoded = self.decode_whole(data[:size])
        else:
            decoded = self.decode_whole(data)
        return replace(decoded, problem=self._find_problem(data, size, decoded))

    def decode_whole(self, data: bytes) -> Decoded:
        """Decode a frame that consists of exactly these bytes."""
        with _translate_form_errors(self.form.decode):
            decoded = self.form.decode(data, _FieldFinder(self.tree))
            if not isinstance(decoded, Decoded):
                raise TypeError(f"returned {type(decoded).__name__}, expected Decoded")
        return decoded

    def find_end(self, data: bytes) -> int:
        """Return the size of the frame at the start of some bytes, as `WireForm.find_end` does."""
        with _translate_form_errors(self.form.find_end):
            size = int(self.form.find_end(data))
            if size > len(data):
                raise ValueError(f"returned the size {size}, but got only {len(data)} bytes")
        return size

    def find_size(self, data: bytes) -> int | None:
        size = self.find_end(data[: self._limit])
        if size > 0:
            return size
        return None

    def find_refusal(self, struct: bytes) -> LayoutRefusal | None:
        """Return the reason why the bytes of a struct have no layout.

        Returns None if they have a layout, or if the header is incomplete.
        """
        result = self.tree.find_node(struct).result
        if isinstance(result, LayoutRefusal):
            return result
        return None

    def encode(self, struct: bytes, spelling: object = None) -> bytes | None:
        if isinstance(spelling, bytes):
            known = self.decode(spelling)
            if known.problem is None and known.struct == struct:
                return spelling
        data = self.encode_unchecked(struct)
        if data is not None:
            decoded = self.decode(data)
            if decoded.problem is None and decoded.struct == struct:
                return data
        return None

    def encode_unchecked(self, struct: bytes) -> bytes | None:
        """Encode a struct without checking the result; None if it has no layout."""
        layout = self.tree.find_node(struct, is_whole_frame=True).result
        if not isinstance(layout, Layout) or layout.size != len(struct):
            return None
        with _translate_form_errors(self.form.encode):
            return bytes(self.form.encode(struct, list_runs(layout)))

    def keep_spelling(self, values: Any, struct: bytes, data: bytes) -> Any:
        if self.encode(struct) != data:
            values[SPELLING] = data
        return values

    def make_encodable(self, rows: Bytes2D, layout: Layout) -> None:
        begin = 0
        for run in list_runs(layout):
            part = rows[:, begin : begin + int(run.sizes.sum())]
            begin += part.shape[1]
            if isinstance(run, NumberRun):
                with _translate_form_errors(self.form.largest):
                    sizes = run.sizes.tolist()
                    largest = np.array([self.form.largest(size) for size in sizes], np.uint64)
                for row in part:
                    values = _wrap_values(run.from_bytes(row.tobytes()), largest)
                    if isinstance(self.form, LimitsValues):
                        values = self.form.to_encodable(run, values)
                    row[:] = np.frombuffer(run.to_bytes(values), np.uint8)
            elif self.form.is_text:
                part[:] = part % 26 + ord("A")

    def _find_problem(self, data: bytes, size: int, decoded: Decoded) -> Problem | None:
        """Return the first error in bytes that should be one frame; None if they are valid."""
        begins = self.begins
        if not data or not data.startswith(begins):
            got = data[: len(begins)]
            reason = (
                f"the frame begins with {got.hex(' ') or 'nothing'}, expected {begins.hex(' ')}"
            )
            return Problem(0, reason, expected=begins, got=got)
        if 0 < size < len(data):
            reason = f"the frame ends at byte {size}, but {len(data) - size} more bytes follow"
            return Problem(size, reason, expected=size, got=len(data))
        if size <= 0:
            reason = f"the frame does not end within {len(data)} bytes"
            return Problem(len(data), reason, got=len(data))
        if decoded.problem is not None and decoded.problem.reason:
            return decoded.problem
        struct = decoded.struct
        node = self.tree.find_node(struct, is_whole_frame=True)
        is_layout = isinstance(node.result, Layout) and node.result.size == len(struct)
        if decoded.problem is None and is_layout:
            return None
        leaves, end = _find_known_fields(node)
        path, begin, expected = _describe_field(leaves, min(len(struct), end), end)
        if decoded.problem is None:
            offset = decoded.offset(begin)
        else:
            offset = decoded.problem.offset
        if not leaves:
            reason = f"the frame has {size} bytes, which does not match its header"
            return Problem(offset, reason, got=size)
        got = data[offset : offset + MAX_SHOWN_BYTES]
        reason = f"{path or 'frame'} at byte {offset}: {got!r} is not {expected}"
        return Problem(offset, reason, path=path, expected=expected, got=got)


@contextmanager
def _translate_form_errors(method: Callable[..., Any]) -> Iterator[None]:
    """Convert exceptions in the block to `PluginError`.

    Args:
        method: the method of a plugin's wire form that the block calls.
    """
    try:
        yield
    except SpecError:
        raise
    except Exception as error:
        if method.__module__.partition(".")[0] == "lidarspec":
            raise
        what = f"wire form, {method.__qualname__}"
        raise PluginError.of(error, what, function=method) from error


def _describe_field(leaves: tuple[Leaf, ...], offset: int, end: int) -> tuple[str, int, str]:
    """Return the path, the offset and the expected type of the field at an offset."""
    offsets, owners = _locate_elements(leaves)
    index = int(offsets.searchsorted(offset, "right")) - 1
    path = ""
    if index >= 0 and offset < offsets[index] + leaves[owners[index]].size:
        offset = offsets.item(index)
        path = leaves[owners[index]].info.path
    runs = list_runs_between(leaves, offset, end)
    if not runs:
        return "", offset, "the end of the frame"
    size = runs[0].sizes.item(0)
    is_text = isinstance(runs[0], TextRun)
    if is_text:
        expected = f"{size} characters of text"
    else:
        expected = f"a {size}-byte number"
    return path, offset, expected


@functools.lru_cache(maxsize=2048)
def frame_coder(frame: Frame) -> Coder:
    """Return the coder of a frame type."""
    if frame.wire is None:
        return Coder(frame)
    return FormCoder(frame, frame.wire)


def list_runs(layout: Layout) -> Sequence[Run]:
    """Return the fields of a struct with this layout, grouped into runs.

    A run is one text field, or several consecutive numbers.
    """
    return list_runs_between(tuple(layout.leaves.values()), 0, layout.size)


@functools.lru_cache(maxsize=1024)
def list_runs_between(leaves: tuple[Leaf, ...], first: int, end: int) -> tuple[Run, ...]:
    """Return the fields between two offsets of a struct, grouped into runs."""
    offsets, owners = _locate_elements(leaves)
    inside = slice(int(offsets.searchsorted(first)), int(offsets.searchsorted(end)))
    offsets = offsets[inside]
    owners = owners[inside]
    all_sizes, all_kinds, all_little = _find_element_types(leaves)
    sizes = all_sizes[owners]
    ends = offsets + sizes
    is_text = all_kinds[owners] == "S"
    is_border = is_text[1:] | is_text[:-1] | (offsets[1:] != ends[:-1])
    runs = list[Run]()
    reached = first
    for part in np.split(np.arange(len(offsets)), np.flatnonzero(is_border) + 1):
        if not len(part):
            break
        begin = offsets.item(part[0])
        if begin > reached:
            runs.append(TextRun(begin - reached))
        if is_text[part[0]]:
            runs.append(TextRun(sizes.item(part[0])))
        else:
            fields = owners[part]
            paths = [leaves[owner].info.path for owner in fields.tolist()]
            runs.append(NumberRun(sizes[part], all_kinds[fields], all_little[fields], paths))
        reached = ends.item(part[-1])
    if reached < end:
        runs.append(TextRun(end - reached))
    return tuple(runs)


def _find_element_types(
    leaves: Sequence[Leaf],
) -> tuple[NDArray[np.intp], NDArray[np.str_], NDArray[np.bool_]]:
    """Return the size, kind and byte order of one element of each field.

    The size is in bytes. The kind is "S" for bytes.
    """
    kinds = list[str]()
    is_little = list[bool]()
    for leaf in leaves:
        kind = "u"
        order = ""
        if leaf.info.kind == "bytes":
            kind = "S"
        elif leaf.wire is not None:
            kind = leaf.wire.kind
            order = leaf.wire.byteorder
        else:
            element = leaf.elements[0]
            if element.run is not None and element.is_whole:
                order = element.run[0]
                kind = "i" if element.signed else "u"
        kinds.append(kind)
        is_little.append(order == "<")
    sizes = np.array([leaf.size for leaf in leaves], np.intp)
    return sizes, np.array(kinds, np.str_), np.array(is_little, np.bool_)


@functools.lru_cache(maxsize=256)
def _locate_elements(leaves: tuple[Leaf, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the offset of each element, and the index of the field that contains it."""
    offsets = [np.zeros(0, np.intp)]
    owners = [np.zeros(0, np.intp)]
    for index, leaf in enumerate(leaves):
        if not leaf.size:
            continue
        depth = len(leaf.strides) - (leaf.info.kind == "bytes")
        places = np.array([leaf.offset], np.intp)
        for length, stride in zip(leaf.shape[:depth], leaf.strides, strict=False):
            places = (places[:, None] + np.arange(length) * stride).reshape(-1)
        offsets.append(places)
        owners.append(np.full(len(places), index))
    all_offsets, first = np.unique(np.concatenate(offsets), return_index=True)
    return all_offsets, np.concatenate(owners)[first]


def _join_bytes(bytes_by_offset: dict[int, int]) -> bytes:
    """Return the known bytes from offset 0 up to the first unknown byte."""
    return bytes(
        bytes_by_offset[offset]
        for offset in itertools.takewhile(bytes_by_offset.__contains__, itertools.count())
    )


def _wrap_values(values: NDArray[np.uint64], largest: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return each value modulo (its largest value + 1).

    Args:
        largest: the largest allowed value for each column of `values`.
    """
    count = largest + np.uint64(1)  # wraps to 0 if all values of eight bytes are allowed
    return np.where(count == 0, values, values % np.maximum(count, 1))
