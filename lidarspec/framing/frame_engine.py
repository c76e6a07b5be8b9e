"""One frame type as an engine: which candidates are frames, and frames as columns. Compiled, and
interpreted.

Both codecs answer the same questions with the same results; every test runs on both.
`CompiledCodec` works by layouts on whole batches: the header of a candidate is looked at once, when
it is judged, and its layout goes with it into the columns. `InterpretedCodec` lets construct parse
one candidate at a time, for structs that have no computable layout and as the reference.

`RecodedCodec` stands before either of them for frames with a wire form, text or escaped bytes: the
form finds where candidates end, and gives rows, which the other one judges as if they had come so.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Iterable

import construct
import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.frames.arrays import alike, counted, repeated
from lidarspec.frames.compilability import NotCompilable
from lidarspec.frames.frame_table import Group, Records, Rows, Table
from lidarspec.frames.layout import Layout, Refused, Sums, marks, right, rows_at, words
from lidarspec.frames.layout_tree import frame_layouts, prefix_of
from lidarspec.frames.schema import schema
from lidarspec.frames.slots import Recoder, recoder
from lidarspec.framing.many_lengths import AlikeLayouts, LayoutGroup, Together
from lidarspec.framing.plausibility import Conditions, Judge, plausibility
from lidarspec.framing.results import (
    CHECKSUM,
    CONSTANT,
    IMPLAUSIBLE,
    LENGTH,
    PLUGIN,
    SHORT,
    VALID,
    Frames,
    Recoded,
    Status,
)
from lidarspec.spec.description import Frame
from lidarspec.spec.syntax import Mismatch, fixed_size, has_conditions

#: bytes of candidates looked at in one go, so that memory stays small on hostile streams.
BLOCK = 1 << 19


class Codec:
    """The engine of one frame type.

    Attributes:
        prefix: the constants at the start: offset -> (mask, value).
        marks: these, whole bytes first, which tell the most.
        size: that of all its frames, None where they differ.
        layout: that of all its frames, None where they differ or construct parses them.
    """

    layout: Layout | None = None

    @property
    def compiled(self) -> CompiledCodec | None:
        """What knows the layouts of its frames, or of their rows; None where construct alone reads
        them.
        """
        return None

    def __init__(self, frame: Frame) -> None:
        self.frame, self.schema = frame, schema(frame.tree)
        self.prefix, self.size = (
            prefix_of(frame.tree, frame.room),
            fixed_size(frame.prepared) or None,
        )
        self.marks = marks(self.prefix)

    def survey(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None = None,
        *,
        kind: int = 0,
        gathered: bool = True,
        sums: Sums | None = None,
    ) -> Frames:
        """The candidates at these offsets, each with its layout and whether it is a frame.

        Args:
            offsets: those whose prefix does not match must be left out.
            stops: where their bytes end, and no more will come; by default with those of the
                buffer.
            kind: index of this type.
            gathered: whether their bytes are wanted too, as `Frames.rows`.
            sums: what computes checksums; by default their algorithms.
        """
        raise NotImplementedError

    def survey_rows(
        self, rows: NDArray[np.uint8], *, sums: Sums | None = None
    ) -> tuple[Layout, Status, tuple[PluginError, ...]] | None:
        """The layout of candidates of one size, one a row, the status of each, and failures of the
        plugin; None where they have not one.
        """
        return None

    def table(self, frames: Iterable[bytes]) -> Table:
        """Frames known to be of this type, as columns."""
        raise NotImplementedError

    def gather(self, frames: Frames) -> Table:
        """Frames that were found, all of this type, as columns."""
        return self.table(map(frames.data, range(len(frames))))


class CompiledCodec(Codec):
    """A frame type whose layouts are compiled.

    Raises:
        NotCompilable: where its struct has a part without a computable place.
    """

    def __init__(self, frame: Frame) -> None:
        layouts = frame_layouts(frame)
        if isinstance(layouts, NotCompilable):
            raise layouts
        super().__init__(frame)
        self.tree, layout = layouts, layouts.layout(b"")
        self.layout = layout if isinstance(layout, Layout) else None
        self._conditions: Conditions | None = None
        self._alike = AlikeLayouts()

    @property
    def compiled(self) -> CompiledCodec:
        return self

    def survey(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None = None,
        *,
        kind: int = 0,
        gathered: bool = True,
        sums: Sums | None = None,
    ) -> Frames:
        groups = (
            [(self.layout, counted(len(offsets)))]
            if self.layout is not None
            else self.tree.classify(buffer, offsets, stops)
        )
        kinds, errors = repeated(kind, len(offsets)), list[PluginError]()
        if (
            len(groups) == 1
            and len(groups[0][1]) == len(offsets)
            and isinstance(only := groups[0][0], Layout)
        ):
            status, sizes, rows = self._judged(
                buffer, offsets, stops, only, errors, gathered=gathered, sums=sums
            )
            return Frames(
                buffer,
                kinds,
                offsets,
                sizes,
                layouts=(only,),
                status=status,
                rows=rows,
                errors=tuple(errors),
            )
        status, forms = np.full(len(offsets), SHORT, np.uint8), np.full(len(offsets), -1, np.intp)
        layouts, short = list[Layout](), list[tuple[NDArray[np.intp], NDArray[np.intp]]]()
        left = list[LayoutGroup]()
        for layout, which in groups:
            if isinstance(layout, Refused):
                status[which] = (
                    PLUGIN if layout.error else CONSTANT if layout.by_constant else LENGTH
                )
                errors += [layout.error] if layout.error else []
                continue
            forms[which] = len(layouts)
            layouts.append(layout)
            left.append((layout, which))
        sizes = np.array([*(layout.size for layout in layouts), 0], np.intp)[forms]
        together, left = self._alike.split(left, self.judge)
        for some in together:
            left += self._judge_together(buffer, offsets, stops, some, status, sizes, sums)
        for layout, which in left:
            status[which], own, _ = self._judged(
                buffer,
                offsets[which],
                None if stops is None else stops[which],
                layout,
                errors,
                gathered=gathered,
                sums=sums,
            )
            short += [(which, own)] if alike(own) is None else []
        for which, own in short:
            sizes[which] = own
        return Frames(
            buffer,
            kinds,
            offsets,
            sizes,
            layouts=tuple(layouts),
            forms=forms,
            status=status,
            errors=tuple(errors),
        )

    def _judge_together(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None,
        together: Together,
        status: NDArray[np.uint8],
        sizes: NDArray[np.intp],
        sums: Sums | None,
    ) -> list[LayoutGroup]:
        """Judge the candidates of layouts that are alike; return those that are still to be judged
        layout by layout.

        Args:
            status, sizes: of all candidates, changed here.
        """
        which = together.which
        ends = np.full(len(which), len(buffer)) if stops is None else stops[which]
        is_whole = offsets[which] + sizes[which] <= ends
        partial = which[~is_whole]
        status[partial], sizes[partial] = _partial(
            buffer, offsets[partial], ends[~is_whole], together.layouts[0], sizes[partial]
        )
        whole = which[is_whole]
        status[whole] = together.judge(buffer, offsets[whole], together.forms[is_whole], sums)
        if together.is_final:
            return []
        is_undecided = np.zeros(len(which), np.bool_)
        is_undecided[is_whole] = status[whole] == VALID
        return together.by_layout(is_undecided)

    def survey_rows(
        self, rows: NDArray[np.uint8], *, sums: Sums | None = None
    ) -> tuple[Layout, Status, tuple[PluginError, ...]] | None:
        layout = self.layout or self.tree.common(rows)
        if layout is None or layout.size != rows.shape[1]:
            return None
        errors: list[PluginError] = []
        return layout, self.judge(layout)(rows, errors, sums), tuple(errors)

    def _judged(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None,
        layout: Layout,
        errors: list[PluginError],
        *,
        gathered: bool,
        sums: Sums | None,
    ) -> tuple[NDArray[np.uint8], NDArray[np.intp], NDArray[np.uint8] | None]:
        """Candidates of one layout.

        Returns:
            The status of each; how many bytes it has, or how many tell more; and the bytes of those
            that are whole, one a row, if these are wanted, are in front, and are not too many.
        """
        whole = offsets <= (len(buffer) if stops is None else stops) - layout.size
        count, number = int(np.count_nonzero(whole)), len(offsets)
        own = offsets if count == number else offsets[whole]
        gathered = gathered and (count == number or bool(whole[:count].all()))
        judge, step, kept = self.judge(layout), max(BLOCK // layout.size, 1), None
        if count <= step or not gathered:
            rows = rows_at(buffer, own, layout.size, gathered=gathered)
            judged, kept = judge(rows, errors, sums), rows if gathered else None
        else:
            blocks = (own[start : start + step] for start in range(0, count, step))
            judged = np.concatenate(
                [judge(rows_at(buffer, block, layout.size), errors, sums) for block in blocks]
            )
        if count == number:
            return judged, repeated(layout.size, number), kept
        status, sizes = np.empty(number, np.uint8), np.full(number, layout.size)
        status[whole] = judged
        ends = len(buffer) if stops is None else stops[~whole]
        status[~whole], sizes[~whole] = _partial(
            buffer, offsets[~whole], ends, layout, sizes[~whole]
        )
        return status, sizes, kept

    def table(self, frames: Iterable[bytes]) -> Rows:
        frames = list(frames)
        joined = np.frombuffer(b"".join(frames), np.uint8)
        sizes = np.array([len(frame) for frame in frames], np.intp)
        return self.gather(
            Frames(joined, repeated(0, len(frames)), np.cumsum(sizes) - sizes, sizes)
        )

    def gather(self, frames: Frames) -> Rows:
        """Frames that were found, all of this type, as columns: where they stand, if they are at
        least half of what is kept for them.
        """
        if frames.rows is not None and frames.layout is not None:
            rows = (
                frames.rows
                if 2 * frames.rows.size >= len(frames.buffer)
                else np.ascontiguousarray(frames.rows)
            )
            return Rows(self.schema, [Group(frames.layout, counted(len(rows)), rows)])
        known = (
            frames.by_layout()
            if frames.layouts
            else self.tree.classify(frames.buffer, frames.starts)
        )
        groups = []
        for layout, which in known:
            if isinstance(layout, Refused):
                continue
            starts = frames.starts if len(which) == len(frames) else frames.starts[which]
            is_sparse = 2 * len(which) * layout.size < len(frames.buffer)
            groups.append(
                Group(
                    layout, which, rows_at(frames.buffer, starts, layout.size, gathered=is_sparse)
                )
            )
        return Rows(self.schema, groups)

    def judge(self, layout: Layout) -> Judge:
        """What judges candidates of a layout that have the constants at the start."""
        judge = layout.notes.get(Judge)
        if judge is None:
            self._conditions = self._conditions or Conditions(
                self.frame.plausible, self.schema, layout
            )
            tests = self._conditions.met(layout), self._conditions.checks(layout)
            judge = layout.notes[Judge] = Judge(
                self.frame, self.schema, layout, self.prefix, *tests
            )
        return judge


class InterpretedCodec(Codec):
    """A frame type that construct parses, one candidate at a time; `reason` says why it is not
    compiled.
    """

    def __init__(self, frame: Frame, reason: str = "") -> None:
        super().__init__(frame)
        self.reason = reason
        lengths = ["lengths"] if any(info.held for info in self.schema.all_fields.values()) else []
        self._levels = [
            "constants",
            *lengths,
            *(["checksums"] if has_conditions(frame.prepared) else []),
            True,
        ]

    def survey(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None = None,
        *,
        kind: int = 0,
        gathered: bool = True,
        sums: Sums | None = None,
    ) -> Frames:
        status = np.zeros(len(offsets), np.uint8)
        sizes = np.zeros(len(offsets), np.intp)
        errors: list[PluginError] = []
        ends = (
            offsets + self.frame.room
            if stops is None
            else np.minimum(offsets + self.frame.room, stops)
        )
        for index, (offset, end) in enumerate(zip(offsets.tolist(), ends.tolist(), strict=True)):
            data = buffer[offset:end].tobytes()
            status[index], sizes[index] = self._judge(data, errors)
        return Frames(
            buffer,
            repeated(kind, len(offsets)),
            offsets,
            sizes,
            status=status,
            errors=tuple(errors),
        )

    def table(self, frames: Iterable[bytes]) -> Records:
        frames = list(frames)
        return Records(
            self.schema,
            [self.frame.prepared.parse(frame, _verify=False) for frame in frames],
            frames,
        )

    def _judge(self, data: bytes, errors: list[PluginError]) -> tuple[int, int]:
        stream = io.BytesIO(data)
        try:
            self.frame.prepared.parse_stream(stream, _verify=self._levels[0])
            size = stream.tell()
            if not size:
                return LENGTH, 0
            parsed = [
                self.frame.prepared.parse(data[:size], _verify=level) for level in self._levels[1:]
            ][-1]
        except Mismatch as mismatch:
            return {"checksum": CHECKSUM, "length": LENGTH, "value": IMPLAUSIBLE}.get(
                mismatch.reason, CONSTANT
            ), 0
        except construct.CheckError:
            return IMPLAUSIBLE, 0
        except construct.StreamError:
            return (LENGTH if len(data) >= self.frame.room else SHORT), 0
        except SpecError:
            raise
        except construct.ConstructError:
            return LENGTH, 0
        except Exception as error:
            errors.append(PluginError.of(error, "struct"))
            return PLUGIN, 0
        if self.frame.plausible is None:
            return VALID, size
        return int(
            plausibility(self.frame, Records(self.schema, [parsed], [data[:size]]), errors)[0]
        ), size


class RecodedCodec(Codec):
    """A frame type with a wire form: its rows are what `engine` knows as frames.

    Raises:
        SpecError: for a struct whose fields have no computable place.
    """

    def __init__(
        self, frame: Frame, recoder: Recoder, engine: CompiledCodec | InterpretedCodec
    ) -> None:
        super().__init__(frame)
        self.recoder, self.engine, self.size = recoder, engine, None
        self.prefix = {spot: (0xFF, byte) for spot, byte in recoder.prefix.items()}
        self.marks = marks(self.prefix)

    @property
    def compiled(self) -> CompiledCodec | None:
        return self.engine.compiled

    def survey(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None = None,
        *,
        kind: int = 0,
        gathered: bool = True,
        sums: Sums | None = None,
    ) -> Frames:
        if not len(
            offsets
        ):  # as most types of a sensor have none, the buffer is not gone through for each
            return Frames(buffer, repeated(kind, 0), offsets, offsets, status=np.zeros(0, np.uint8))
        reading = self.recoder.reading(buffer, offsets)
        told = offsets + max(self.prefix, default=-1) < (
            len(buffer) if stops is None else stops
        )  # else it may be no candidate at all
        status, errors = (
            np.where((reading.sizes == 0) | ~told, SHORT, LENGTH).astype(np.uint8),
            list[PluginError](),
        )
        whole = np.flatnonzero((reading.sizes > 0) & told)
        if reading.intact is not None:
            status[whole[~reading.intact[whole]]] = CHECKSUM
            whole = whole[reading.intact[whole]]
        groups = list[tuple[Layout, NDArray[np.intp], NDArray[np.uint8]]]()
        for layout, which, rows, is_read in self.recoder.rows(
            reading, offsets[whole], reading.sizes[whole]
        ):
            if isinstance(layout, Refused):
                status[whole[which]] = PLUGIN if layout.error else LENGTH
                errors += [layout.error] if layout.error else []
                continue
            own = whole[which] if is_read.all() else whole[which[is_read]]
            if not len(own):
                continue
            good = rows if len(own) == len(which) else rows[is_read]
            status[own] = self._judged(layout, good, errors, sums)
            groups.append((layout, own, good))
        recoded = (Recoded(kind, offsets, tuple(groups)),) if groups else ()
        kinds, sizes = repeated(kind, len(offsets)), np.maximum(reading.sizes, 0)
        return Frames(
            buffer, kinds, offsets, sizes, status=status, errors=tuple(errors), recoded=recoded
        )

    def _judged(
        self, layout: Layout, rows: NDArray[np.uint8], errors: list[PluginError], sums: Sums | None
    ) -> NDArray[np.uint8]:
        """The status of rows of one layout."""
        if isinstance(self.engine, CompiledCodec):
            held = right(words(self.engine.marks), rows)
            status = self.engine.judge(layout)(rows, errors, sums)
            return status if held is None else np.where(held, status, np.uint8(CONSTANT))
        surveys = [self.engine.survey(row, np.zeros(1, np.intp)) for row in rows]
        errors += [error for survey in surveys for error in survey.errors]
        judged = ((survey.status.item(0), survey.sizes.item(0)) for survey in surveys)
        return np.array(
            [
                LENGTH if status in (VALID, SHORT) and size != layout.size else status
                for status, size in judged
            ],
            np.uint8,
        )

    def table(self, frames: Iterable[bytes]) -> Table:
        frames = list(frames)
        sizes = np.array([len(frame) for frame in frames], np.intp)
        joined = np.frombuffer(b"".join(frames), np.uint8)
        return self.gather(
            Frames(joined, repeated(0, len(frames)), np.cumsum(sizes) - sizes, sizes)
        )

    def gather(self, frames: Frames) -> Table:
        known = next(
            (one.only(frames.starts) for one in frames.recoded if one.kind == alike(frames.kinds)),
            None,
        )
        if known is None:
            reading = self.recoder.reading(frames.buffer, frames.starts)
            read = self.recoder.rows(reading, frames.starts, frames.sizes)
            known = [
                (layout, which[right], rows[right])
                for layout, which, rows, right in read
                if isinstance(layout, Layout)
            ]
        groups = [Group(*group) for group in known]
        if isinstance(self.engine, CompiledCodec):
            return Rows(self.schema, groups)
        rows = {
            spot: row.tobytes()
            for group in groups
            for spot, row in zip(group.where.tolist(), group.rows, strict=True)
        }
        return self.engine.table(rows[spot] for spot in sorted(rows))


def _partial(
    buffer: NDArray[np.uint8],
    offsets: NDArray[np.intp],
    stops: NDArray[np.intp] | int,
    layout: Layout,
    sizes: NDArray[np.intp],
) -> tuple[NDArray[np.uint8], NDArray[np.intp]]:
    """Candidates whose end is not there yet: still possible, or already refuted by a constant or a
    length; and how many bytes tell more.

    Args:
        layout: whose constants and lengths they have.
        sizes: of each as a whole.
    """
    status = np.full(len(offsets), SHORT, np.uint8)
    sizes = sizes.copy()
    for verdict, known in ((LENGTH, layout.held), (CONSTANT, layout.constants)):
        for spot in sorted(known, reverse=True):
            mask, value = known[spot]
            there = offsets + spot < stops
            status[there] = np.where(
                buffer[offsets[there] + spot] & mask == value, status[there], verdict
            )
            sizes[~there] = np.minimum(sizes[~there], spot + 1)
    return status, sizes


def codec(
    frame: Frame, *, interpreted: bool = False
) -> CompiledCodec | InterpretedCodec | RecodedCodec:
    """Return the engine of a frame type: compiled if that is possible and construct is not asked
    for; always the same one.
    """
    return _codec(frame, interpreted)


@functools.lru_cache(maxsize=2048)
def _codec(frame: Frame, interpreted: bool) -> CompiledCodec | InterpretedCodec | RecodedCodec:
    recoding = recoder(frame)
    if recoding is not None:
        return RecodedCodec(
            frame,
            recoding,
            InterpretedCodec(frame, "asked for") if interpreted else CompiledCodec(frame),
        )
    if interpreted:
        return InterpretedCodec(frame, "asked for")
    try:
        return CompiledCodec(frame)
    except NotCompilable as refusal:
        return InterpretedCodec(frame, str(refusal))
