"""One frame type as an engine: which candidates are frames, and frames as columns. Compiled, and interpreted.

Both codecs answer the same questions with the same results; every test runs on both. `CompiledCodec` works by
layouts on whole batches; `InterpretedCodec` lets construct parse one candidate at a time, for structs that have no
computable layout and as the reference.
"""

from __future__ import annotations

import functools
import io
import traceback
from collections.abc import Iterable, Mapping
from typing import Protocol

import construct
import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.framing.plausibility import CHECKSUM, CONSTANT, LENGTH, PLUGIN, SHORT, VALID, Check, Conditions, Judge, Survey, plausibility
from lidarspec.spec.construct_layer import Mismatch
from lidarspec.spec.description import Frame
from lidarspec.wire.arrays import counted, repeated
from lidarspec.wire.frame_table import Group, Records, Rows, Table
from lidarspec.wire.layout import Layout, Marks, marks
from lidarspec.wire.layout_tree import NotCompilable, Refused, frame_layouts, prefix_of, rows_at
from lidarspec.wire.schema import Schema, schema

#: bytes of candidates looked at in one go, so that memory stays small on hostile streams.
BLOCK = 1 << 19


class Codec(Protocol):
    """The engine of one frame type.

    Attributes:
        size: that of all its frames, None where they differ.
        marks: the constants of `prefix`, whole bytes first, which tell the most.
    """

    frame: Frame
    schema: Schema
    size: int | None
    marks: Marks

    @property
    def prefix(self) -> Mapping[int, tuple[int, int]]:
        """The constants at the start: offset -> (mask, value)."""

    def survey(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], *, gathered: bool = True) -> Survey:
        """Whether the candidates at these offsets are frames; those whose prefix does not match must be left out.

        Args:
            gathered: whether their bytes are wanted too, see `Survey.rows`.
        """

    def alike(self, rows: NDArray[np.uint8]) -> Survey | None:
        """The same of candidates of one size and one layout, one a row; None where they are to be surveyed."""

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
        layouts = frame_layouts(frame)
        if isinstance(layouts, NotCompilable):
            raise layouts
        self.frame, self.schema, self.tree = frame, schema(frame.tree), layouts
        self.prefix, self.size = self.tree.prefix, _size(frame)
        self.marks = marks(self.prefix)
        self._conditions: Conditions | None = None

    def survey(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], *, gathered: bool = True) -> Survey:
        errors: list[str] = []
        groups, _ = self.tree.classify(buffer, offsets)
        if len(groups) == 1 and len(groups[0][1]) == len(offsets) and isinstance(groups[0][0], Layout):
            return self._alike(buffer, offsets, groups[0][0], gathered=gathered)
        status = np.full(len(offsets), SHORT, np.uint8)
        sizes = np.zeros(len(offsets), np.intp)
        for layout, which in groups:
            if isinstance(layout, Refused):
                status[which] = PLUGIN if layout.error else LENGTH
                errors += [layout.error] * len(which) if layout.error else []
                continue
            survey = self._alike(buffer, offsets[which], layout, gathered=gathered)
            status[which], sizes[which] = survey.status, survey.sizes
            errors += survey.errors
        return Survey(status, sizes, tuple(errors))

    def alike(self, rows: NDArray[np.uint8]) -> Survey | None:
        layout = self.tree.common(rows)
        if layout is None or layout.size != rows.shape[1]:
            return None
        errors: list[str] = []
        status = self._judge(layout)(rows, errors)
        return Survey(status, repeated(layout.size, len(rows)), tuple(errors), layout=layout)

    def _alike(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], layout: Layout, *, gathered: bool) -> Survey:
        """What candidates of one layout are."""
        whole = offsets <= len(buffer) - layout.size
        count = np.count_nonzero(whole)
        if count == len(offsets) or (count and whole[:count].all()):
            lead, cut = slice(0, count), slice(count, len(offsets))
        else:
            lead, cut = np.flatnonzero(whole), np.flatnonzero(~whole)  # type: ignore[assignment]
        errors: list[str] = []
        status, rows = self._judged(buffer, offsets[lead], layout, errors, gathered=gathered)
        sizes: NDArray[np.intp] = repeated(layout.size, len(offsets))
        if count < len(offsets):
            sizes = sizes.copy()
            short, sizes[cut] = _partial(buffer, offsets[cut], layout)
            if isinstance(lead, slice):
                status = np.concatenate([status, short])
            else:
                status, some, rows = np.empty(len(offsets), np.uint8), status, None
                status[lead], status[cut] = some, short
        return Survey(status, sizes, tuple(errors), rows)

    def _judged(
        self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], layout: Layout, errors: list[str], *, gathered: bool
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
        """The status of whole candidates of one layout; their bytes, one a row, if they are not too many."""
        judge = self._judge(layout)
        step = max(BLOCK // layout.size, 1)
        if len(offsets) <= step or not gathered:
            rows = rows_at(buffer, offsets, layout.size, gathered=gathered)
            return judge(rows, errors), rows if gathered else None
        parts = [judge(rows_at(buffer, offsets[start : start + step], layout.size), errors) for start in range(0, len(offsets), step)]
        return np.concatenate(parts), None

    def table(self, frames: Iterable[bytes]) -> Rows:
        frames = list(frames)
        joined = np.frombuffer(b"".join(frames), np.uint8)
        sizes = np.array([len(frame) for frame in frames], np.intp)
        return self.gather(joined, np.concatenate([[0], np.cumsum(sizes)])[:-1].astype(np.intp), sizes)

    def gather(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], sizes: NDArray[np.intp]) -> Rows:
        groups, _ = self.tree.classify(buffer, offsets)
        known = [(layout, which) for layout, which in groups if isinstance(layout, Layout)]
        return Rows(
            self.schema,
            [
                Group(layout, which, _rows(buffer, offsets if len(which) == len(offsets) else offsets[which], layout.size))
                for layout, which in known
            ],
        )

    def lined(self, layout: Layout, rows: NDArray[np.uint8], *, room: int) -> Rows:
        """Valid frames of one layout, one a row, as columns.

        Args:
            room: bytes that would be kept for the rows, if they stayed where they stand.
        """
        kept = rows if 2 * rows.size >= room else np.ascontiguousarray(rows)
        return Rows(self.schema, [Group(layout, counted(len(rows)), kept)])

    def _judge(self, layout: Layout) -> Judge:
        judge = layout.notes.get(Judge)
        if judge is None:
            checks: list[Check] | None = []
            if self.frame.plausible is not None:
                self._conditions = self._conditions or Conditions(self.frame.plausible, self.schema, layout)
                checks = self._conditions.checks(layout)
            judge = layout.notes[Judge] = Judge(self.frame, self.schema, layout, self.prefix, checks)
        return judge


class InterpretedCodec:
    """A frame type that construct parses, one candidate at a time; `reason` says why it is not compiled."""

    def __init__(self, frame: Frame, reason: str = "") -> None:
        self.frame, self.reason, self.schema = frame, reason, schema(frame.tree)
        self.prefix, self.size = prefix_of(frame.tree, frame.max_length), _size(frame)
        self.marks = marks(self.prefix)

    def survey(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], *, gathered: bool = True) -> Survey:
        status = np.zeros(len(offsets), np.uint8)
        sizes = np.zeros(len(offsets), np.intp)
        errors: list[str] = []
        for index, offset in enumerate(offsets):
            data = buffer[offset : offset + self.frame.max_length].tobytes()
            status[index], sizes[index] = self._judge(data, errors)
        return Survey(status, sizes, tuple(errors))

    def alike(self, rows: NDArray[np.uint8]) -> Survey | None:
        return None

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
            if not size:
                return LENGTH, 0
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


def _partial(buffer: NDArray[np.uint8], offsets: NDArray[np.intp], layout: Layout) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
    """Candidates whose end is not there yet: still possible, or already refuted by a constant; and how many bytes tell more."""
    status = np.full(len(offsets), SHORT, np.uint8)
    sizes = np.full(len(offsets), layout.size, np.intp)
    for spot in sorted(layout.constants, reverse=True):
        mask, value = layout.constants[spot]
        there = offsets + spot < len(buffer)
        status[there] = np.where(buffer[offsets[there] + spot] & mask == value, status[there], CONSTANT)
        sizes[~there] = spot + 1
    return status, sizes


def _rows(buffer: NDArray[np.uint8], offsets: NDArray[np.intp], size: int) -> NDArray[np.uint8]:
    """Frames, one a row, where they stand, if they are at least half of what stands there and would be kept for them; else copied."""
    return rows_at(buffer, offsets, size, gathered=2 * len(offsets) * size < len(buffer))


def _size(frame: Frame) -> int | None:
    try:
        return int(frame.prepared.sizeof())
    except Exception:  # of a part of the struct, which may be anybody's
        return None


@functools.lru_cache(maxsize=2048)
def codec(frame: Frame, *, interpreted: bool = False) -> CompiledCodec | InterpretedCodec:
    """The engine of a frame type: compiled where that is possible and construct is not asked for."""
    if interpreted:
        return InterpretedCodec(frame, "asked for")
    try:
        return CompiledCodec(frame)
    except NotCompilable as refusal:
        return InterpretedCodec(frame, str(refusal))
