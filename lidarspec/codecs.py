"""One frame type as an engine: which candidates are frames, and frames as columns. Compiled, and interpreted.

Both codecs answer the same questions with the same results; every test runs on both. `CompiledCodec` works by
layouts on whole batches; `InterpretedCodec` lets construct parse one candidate at a time, for structs that have no
computable layout and as the reference.
"""

from __future__ import annotations

import contextlib
import functools
import io
import math
import traceback
import weakref
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import construct
import numpy as np
from numpy.typing import NDArray

from lidarspec.access import Fields
from lidarspec.columns import Batch, Column, unpadded
from lidarspec.construction import Mismatch
from lidarspec.errors import SpecError
from lidarspec.headers import HeaderTree, Refused
from lidarspec.layout import Layout, Seal
from lidarspec.schema import Schema, schema
from lidarspec.spec import Frame
from lidarspec.tables import Group, Records, Rows, Table
from lidarspec.unpacking import Unpack, unpacker
from lidarspec.walk import NotCompilable, TooLong, Walk

VALID, SHORT, LENGTH, CONSTANT, CHECKSUM, IMPLAUSIBLE, PLUGIN = range(7)

#: bytes of candidates looked at in one go, so that memory stays small on hostile streams.
BLOCK = 1 << 17


@dataclass(frozen=True, eq=False)
class Survey:
    """What candidates are: a status and, where valid or short of bytes, a size for each; errors out of plugins."""

    status: NDArray[np.uint8]
    sizes: NDArray[np.intp]
    errors: tuple[str, ...] = ()


class Codec(Protocol):
    """The engine of one frame type."""

    frame: Frame
    schema: Schema

    @property
    def prefix(self) -> Mapping[int, tuple[int, int]]:
        """The constants at the start: offset -> (mask, value)."""

    def survey(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp]) -> Survey:
        """Whether the candidates at these offsets are frames; those whose prefix does not match must be left out."""

    def table(self, frames: Iterable[bytes]) -> Table:
        """Frames known to be of this type, as columns."""

    def gather(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], sizes: NDArray[np.intp]) -> Table:
        """Valid frames at these offsets, as columns."""


class CompiledCodec:
    """A frame type whose layouts are compiled.

    Raises:
        NotCompilable: where its struct has a part without a computable place.
    """

    def __init__(self, frame: Frame) -> None:
        self.frame, self.schema = frame, schema(frame.prepared)
        for info in self.schema.fields.values():
            if info.dtype is None:
                raise NotCompilable(info.path, "its branches have different types")
        self.tree = HeaderTree(frame.prepared, frame.max_length)
        self.prefix = self.tree.prefix

    def parse(self, frame: bytes) -> Any:
        """The Container of one whole, sound frame; None where construct has to look at it."""
        layout = self.tree.layout(frame)
        if not isinstance(layout, Layout) or not layout.sound(frame):
            return None
        function = _unpackers.get(layout)
        if function is None:
            function = _unpackers[layout] = unpacker(self.frame.prepared, layout) or _nothing
        return function(frame)

    def survey(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp]) -> Survey:
        status = np.full(len(offsets), SHORT, np.uint8)
        sizes = np.zeros(len(offsets), np.intp)
        errors: list[str] = []
        groups, _ = self.tree.classify(buffer, offsets)
        for layout, which in groups:
            if isinstance(layout, Refused):
                status[which] = PLUGIN if layout.error else LENGTH
                errors += [layout.error] * len(which) if layout.error else []
                continue
            sizes[which] = layout.size
            whole = offsets[which] + layout.size <= len(buffer)
            if not whole.all():
                cut = which[~whole]
                status[cut] = [_partial(buffer[offsets[i] :], layout) for i in cut]
            there = which[whole]
            step = max(BLOCK // max(layout.size, 1), 1)
            for start in range(0, len(there), step):
                part = there[start : start + step]
                status[part] = self._judge(_rows(buffer, offsets[part], layout.size), layout, errors)
        return Survey(status, sizes, tuple(errors))

    def table(self, frames: Iterable[bytes]) -> Rows:
        frames = list(frames)
        joined = np.frombuffer(b"".join(frames), np.uint8)
        sizes = np.array([len(frame) for frame in frames], np.intp)
        return self.gather(joined, np.concatenate([[0], np.cumsum(sizes)])[:-1].astype(np.intp), sizes)

    def gather(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], sizes: NDArray[np.intp]) -> Rows:
        groups, _ = self.tree.classify(buffer, offsets)
        known = [(layout, which) for layout, which in groups if isinstance(layout, Layout)]
        return Rows(self.schema, [Group(layout, which, _rows(buffer, offsets[which], layout.size)) for layout, which in known])

    def _judge(self, rows: NDArray[np.uint8], layout: Layout, errors: list[str]) -> NDArray[np.uint8]:
        status = np.where(layout.constant(rows), VALID, CONSTANT).astype(np.uint8)
        for seal in layout.seals:
            open_ = np.flatnonzero(status == VALID)
            if len(open_):
                some = rows if len(open_) == len(rows) else rows[open_]
                status[open_] = intactness(seal, some, errors)
        open_ = np.flatnonzero(status == VALID)
        if self.frame.plausible is not None and len(open_):
            table = Rows(self.schema, [Group(layout, np.arange(len(open_)), rows if len(open_) == len(rows) else rows[open_])])
            status[open_] = plausibility(self.frame, table, errors)
        return status


class InterpretedCodec:
    """A frame type that construct parses, one candidate at a time; `reason` says why it is not compiled."""

    def __init__(self, frame: Frame, reason: str = "") -> None:
        self.frame, self.reason, self.schema = frame, reason, schema(frame.prepared)
        self.prefix = _prefix(frame)

    def survey(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp]) -> Survey:
        status = np.zeros(len(offsets), np.uint8)
        sizes = np.zeros(len(offsets), np.intp)
        errors: list[str] = []
        for index, offset in enumerate(offsets):
            data = buffer[offset : offset + self.frame.max_length].tobytes()
            status[index], sizes[index] = self._judge(data, errors)
        return Survey(status, sizes, tuple(errors))

    def table(self, frames: Iterable[bytes]) -> Records:
        frames = list(frames)
        return Records(self.schema, [self.frame.prepared.parse(frame, _verify=False) for frame in frames], frames)

    def gather(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], sizes: NDArray[np.intp]) -> Records:
        return self.table(buffer[offset : offset + size].tobytes() for offset, size in zip(offsets, sizes, strict=True))

    def _judge(self, data: bytes, errors: list[str]) -> tuple[int, int]:
        stream = io.BytesIO(data)
        try:
            self.frame.prepared.parse_stream(stream, _verify="constants")
            size = stream.tell()
            parsed = self.frame.prepared.parse(data[:size])
        except Mismatch as mismatch:
            return (CHECKSUM if mismatch.reason == "checksum" else CONSTANT), 0
        except construct.StreamError:
            return (LENGTH if len(data) >= self.frame.max_length else SHORT), 0
        except SpecError:
            raise
        except construct.ConstructError:
            return LENGTH, 0
        except Exception:
            errors.append(traceback.format_exc())
            return PLUGIN, 0
        if self.frame.plausible is None:
            return VALID, size
        return int(plausibility(self.frame, Records(self.schema, [parsed], [data[:size]]), errors)[0]), size


def intactness(seal: Seal, rows: NDArray[np.uint8], errors: list[str]) -> NDArray[np.uint8]:
    """`VALID`, `CHECKSUM` or `PLUGIN` for each frame, by one of its checksums."""
    try:
        return np.where(seal.intact(rows), VALID, CHECKSUM).astype(np.uint8)
    except Exception:
        errors += [traceback.format_exc()] * len(rows)
        return np.full(len(rows), PLUGIN, np.uint8)


def plausibility(frame: Frame, table: Table, errors: list[str]) -> NDArray[np.uint8]:
    """`VALID`, `IMPLAUSIBLE` or `PLUGIN` for each frame of a table, by the frame's own test."""
    assert frame.plausible is not None
    batch = Batch(table, np.zeros(len(table), np.bool_))
    try:
        with np.errstate(all="ignore"):
            answer = frame.plausible(Fields(batch))
        array = np.broadcast_to(np.asarray(answer), (len(table), *np.shape(answer)[1:])) if np.ndim(answer) else np.full(len(table), answer)
        return np.where(_all(array, answer, batch), VALID, IMPLAUSIBLE).astype(np.uint8)
    except Exception:
        errors += [traceback.format_exc()] * len(table)
        return np.full(len(table), PLUGIN, np.uint8)


def _all(array: NDArray[Any], answer: Any, batch: Batch) -> NDArray[np.bool_]:
    """Whether a condition holds everywhere in each frame, padding left out."""
    flat = array.reshape(len(array), math.prod(array.shape[1:])).astype(np.bool_)
    mask = unpadded(answer.axes, array.shape, batch) if isinstance(answer, Column) else None
    return np.asarray((flat if mask is None else flat | ~mask).all(axis=1))


def _rows(buffer: NDArray[np.uint8], offsets: NDArray[np.intp], size: int) -> NDArray[np.uint8]:
    """The bytes of frames of one size, one a row, C-contiguous."""
    if not len(offsets) or not size:
        return np.zeros((len(offsets), size), np.uint8)
    if len(buffer) == len(offsets) * size and bool((np.diff(offsets) == size).all()) and offsets[0] == 0:
        return np.ascontiguousarray(buffer).reshape(-1, size)
    return np.lib.stride_tricks.sliding_window_view(buffer, size)[offsets]


def _partial(data: NDArray[np.uint8], layout: Layout) -> int:
    """A candidate whose end is not there yet: still possible, or already refuted by a constant."""
    for spot, (mask, value) in layout.constants.items():
        if spot < len(data) and data[spot] & mask != value:
            return CONSTANT
    return SHORT


def _prefix(frame: Frame) -> dict[int, tuple[int, int]]:
    """The constants at the start of a frame that cannot be compiled as a whole."""

    def stop(leaf: Any) -> int:
        raise TooLong

    state = Walk(stop, frame.max_length)
    with contextlib.suppress(NotCompilable, TooLong, SpecError):
        state.run(frame.prepared)
    return dict(state.constants)


_unpackers: weakref.WeakKeyDictionary[Layout, Unpack] = weakref.WeakKeyDictionary()


def _nothing(frame: bytes) -> None:
    """Stands in where no unpacker can be made."""


@functools.lru_cache(maxsize=2048)
def codec(frame: Frame, *, interpreted: bool = False) -> CompiledCodec | InterpretedCodec:
    """The engine of a frame type: compiled where that is possible and construct is not asked for."""
    if interpreted:
        return InterpretedCodec(frame, "asked for")
    try:
        return CompiledCodec(frame)
    except NotCompilable as refusal:
        return InterpretedCodec(frame, str(refusal))
