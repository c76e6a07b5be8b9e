"""Frames that are believed in runs alone: cutting a piece of a stream while such a type is looked
for.

A frame of five bytes without a checksum stands at every sixth place of noise. So types with
`confirm` are believed where so many valid ones follow each other. Here one goes from run to run:
along a run, the candidates at its stride are judged together, as far as it lasts; where it breaks,
all offsets of a stretch are, and the next run is the first place where each of `confirm` strides
further on is valid too. Types with a checksum are few between them, and are met one by one.
"""

from __future__ import annotations

import bisect

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.arrays import repeated
from lidarspec.frames.layout import Layout, right
from lidarspec.framing.candidates import Bytes1D, Candidates, Framing, Mode, Offsets, Piece, fitting
from lidarspec.framing.results import CONSTANT, IMPLAUSIBLE, PLUGIN, SHORT, VALID, Frames

#: strides judged together at first, and at most; and how many are judged sooner as the rows of an
#: array.
FIRST, LONGEST, FEW = 64, 1 << 14, 8

#: offsets of a stretch at first, and at most.
NARROW, WIDE = 1 << 8, 1 << 12

#: what `Lane` says of a candidate that takes more bytes than there are.
WAIT = -1

_UNKNOWN = 255


class Lane:
    """A weak type in a piece: what stands at each offset, judged when it is asked for.

    Args:
        others: the offsets at which types that come first in the order are live, with whether they
            wait for bytes; sorted.
        before: the weak types that come first in the order.
    """

    def __init__(
        self,
        framing: Framing,
        kind: int,
        buffer: Bytes1D,
        others: dict[int, bool],
        before: list[Lane],
        *,
        final: bool,
    ) -> None:
        self.kind, self._final, self._before = kind, final, before
        codec = framing.codecs[kind]
        self._framing, self._buffer = framing, buffer
        self._others, self._spots = others, list(others)
        self._confirm, self._size = codec.frame.confirm, codec.size
        self._reach = (self._confirm - 1) * codec.frame.max_length
        self._sizes = np.zeros(0 if self._size else len(buffer), np.intp)
        self._forms = np.zeros(0 if codec.layout else len(buffer), np.intp)
        self.layouts: list[Layout] = [codec.layout] if codec.layout else []
        self.status = np.full(len(buffer), _UNKNOWN, np.uint8)
        self.errors: tuple[PluginError, ...] = ()
        self._start = self._stop = self._end = 0
        self._width = NARROW
        self._hits: list[int] = []

    def first(self, start: int, stop: int, *, believed: bool) -> int | None:
        """The first offset from `start` to `stop` where a run may begin, or, if it is believed
        already, go on; None if there is none.
        """
        if (believed and self._live(start)) or (
            not self._start <= start < self._stop and self._straight(start)
        ):
            return start
        while start <= stop:
            if not self._start <= start < self._stop:
                self._stretch(start)
            spot = bisect.bisect_left(self._hits, start)
            if spot < len(self._hits):
                return self._hits[spot] if self._hits[spot] <= stop else None
            start = self._stop
        return None

    def run(self, spot: int, *, believed: bool, steady: bool) -> int:
        """How many frames are taken here; `WAIT` if that takes more bytes than there are.

        Args:
            believed: they go on with a run; else so many have to follow each other as it takes to
                believe them.
            steady: the whole run may be taken at once, if its frames have one size; else one frame
                is.
        """
        wanted = 1 if believed else self._confirm
        place = spot
        if self._certain(spot, wanted):
            place += wanted * self.length(spot)
            wanted = 0
        for number in range(wanted):
            answer = self._stands(place, first=number == 0)
            if answer != 1:
                return answer
            place += self.length(place)
        return (self._onward(place) - spot) // self._size if steady and self._size else 1

    def _certain(self, spot: int, number: int) -> bool:
        """Whether so many valid ones are known from here on, and nothing comes first; False where
        that is not easily told.
        """
        if not self._size or self._before:
            return False
        stop = spot + number * self._size
        index = bisect.bisect_left(self._spots, spot)
        return (index == len(self._spots) or self._spots[index] >= stop) and self.status[
            spot : stop : self._size
        ].tobytes() == bytes(number)

    def length(self, spot: int) -> int:
        """The size of the valid candidate at an offset."""
        return self._size or int(self._sizes[spot])

    def forms(self, offsets: Offsets) -> Offsets:
        """Which of its layouts the valid candidates at these offsets have, (k,); -1 where nobody
        knows.
        """
        return self._forms[offsets] if self.has_forms else repeated(0, len(offsets))

    @property
    def has_forms(self) -> bool:
        """Whether its frames may have more than one layout."""
        return len(self._forms) > 0

    def _stands(self, spot: int, *, first: bool) -> int:
        """Whether a frame of this type, of a run or its first, stands at an offset: 1, 0 or `WAIT`."""
        if spot >= len(self._buffer):
            return 0 if self._final else WAIT
        if not first:
            if spot in self._others:
                return WAIT if self._others[spot] else 0
            for lane in self._before:
                other = lane.run(spot, believed=False, steady=False)
                if other:
                    return WAIT if other == WAIT else 0
        if self.status[spot] == _UNKNOWN:
            self._judge(np.array([spot]))
        if self.status[spot] == SHORT:
            return 0 if self._final else WAIT
        return int(self.status[spot] == VALID)

    def _onward(self, spot: int) -> int:
        """Where a run ends that is believed up to here: before the first invalid candidate, or at
        another type's.
        """
        assert self._size
        number = FIRST
        while True:
            index = bisect.bisect_left(self._spots, spot)
            stop = self._spots[index] if index < len(self._spots) else len(self._buffer)
            status = self._along(spot, min(number, -(-(stop - spot) // self._size)))
            broken = status != VALID
            valid = int(broken.argmax()) if len(status) else 0
            if valid < len(status) and broken[valid]:
                return spot + valid * self._size
            if not len(status):
                return spot
            spot += len(status) * self._size
            number = min(4 * number, LONGEST)

    def _along(self, spot: int, number: int) -> NDArray[np.uint8]:
        """The status at every stride from an offset on: at so many, or at fewer if those are known
        already.
        """
        assert self._size
        if self._start <= spot < self._end:
            return self.status[spot : min(spot + number * self._size, self._end) : self._size]
        known = self._judged_rows(spot, min(number, (len(self._buffer) - spot) // self._size))
        if known and self.status[spot + (known - 1) * self._size] != VALID:
            number = known  # the run breaks there, or before
        self._judge(spot + self._size * np.arange(known, number))
        return self.status[spot : spot + number * self._size : self._size]

    def _judged_rows(self, spot: int, number: int) -> int:
        """How many in a row are judged as the rows of an array: up to the first without the right
        constants, 0 where that cannot be.
        """
        if number < FEW:
            return 0
        assert self._size
        rows = np.ndarray((number, self._size), np.uint8, self._buffer, spot, (self._size, 1))
        marked = right(self._framing.words[self.kind], rows)
        count = number if marked is None else int(marked.argmin())
        codec = self._framing.codecs[self.kind]
        survey = codec.survey_rows(rows[:count], sums=self._framing.sums) if count else None
        if survey is not None:
            layout, status, errors = survey
            offsets = slice(spot, spot + count * self._size, self._size)
            self.status[offsets] = status
            self._know(offsets, (layout,), repeated(0, count), errors)
        elif count:
            return 0
        if count < number:
            self.status[spot + count * self._size] = CONSTANT
        return min(count + 1, number)

    def _live(self, spot: int) -> bool:
        if self.status[spot] == _UNKNOWN:
            self._judge(np.array([spot]))
        return bool(self.status[spot] in (VALID, SHORT))

    def _straight(self, spot: int) -> bool:
        """Whether a run may begin right here."""
        if self._size is None or self.status[spot] not in (VALID, SHORT, _UNKNOWN):
            return False
        status = self._along(spot, min(self._confirm, -(-(len(self._buffer) - spot) // self._size)))
        return bool(self._open(status).all())

    def _stretch(self, start: int) -> None:
        """Judge all offsets from `start` on, and find those where a run may begin."""
        self._start = start
        self._stop = min(start + self._width, len(self._buffer))
        self._end = min(self._stop + self._reach, len(self._buffer))
        self._width = min(2 * self._width, WIDE)
        self._judge(np.arange(start, self._end))
        count = self._stop - start
        if self._size is None:
            self._hits = (
                np.flatnonzero(self._open(self.status[start : self._stop])) + start
            ).tolist()
            return
        live = np.full(count + self._reach, not self._final)
        live[: self._end - start] = self._open(self.status[start : self._end])
        hits = live[:count].copy()
        for number in range(1, self._confirm):
            hits &= live[number * self._size : number * self._size + count]
        self._hits = (np.flatnonzero(hits) + start).tolist()

    def _open(self, status: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """Which are valid, or may become so."""
        return (status == VALID) if self._final else (status <= SHORT)

    def _judge(self, offsets: Offsets) -> None:
        """Find out the status at these offsets, which are in order."""
        self.status[offsets] = CONSTANT
        fit = fitting(self._buffer, offsets, self._framing.marks[self.kind])
        if not len(fit):
            return
        survey = self._framing.survey(self.kind, self._buffer, fit)
        self.status[fit] = survey.status
        if self._size is None:
            self._sizes[fit] = survey.sizes
        self._know(fit, survey.layouts, survey.forms, survey.errors)

    def _know(
        self,
        offsets: Offsets | slice,
        layouts: tuple[Layout, ...],
        forms: Offsets,
        errors: tuple[PluginError, ...],
    ) -> None:
        """Remember the layouts of candidates, and failures of the plugin."""
        self.errors = errors or self.errors
        if len(self._forms):
            self._forms[offsets] = np.where(forms < 0, -1, forms + len(self.layouts))
            self.layouts += layouts


class Runs:
    """What goes through a piece of a stream while weak types are looked for: a `Walk` of the
    search.

    Args:
        candidates: of the strong types.
        live: those that are looked for with the weak ones, and are valid or wait for bytes.
        mode: remembered between pieces, changed here.
        base: offset of the piece in the stream.
    """

    def __init__(
        self, framing: Framing, candidates: Candidates, live: Frames, mode: Mode, base: int
    ) -> None:
        self._framing, self._mode, self._base, self._live = framing, mode, base, live
        self._buffer, self._length, self._is_whole = (
            candidates.buffer,
            len(candidates.buffer),
            candidates.is_whole,
        )
        facts = zip(
            live.kinds.tolist(), live.sizes.tolist(), (live.status == SHORT).tolist(), strict=True
        )
        self._strong: dict[int, tuple[int, int, bool]] = dict(
            zip(live.starts.tolist(), facts, strict=True)
        )
        self._spots = list(self._strong)
        self._lanes: list[Lane] = []
        self._taken: list[tuple[int, int, int, int]] = []
        for kind in filter(framing.weak, framing.active(mode)):
            others = {
                spot: short for spot, (other, _, short) in self._strong.items() if other < kind
            }
            before = list(self._lanes)
            self._lanes.append(
                Lane(framing, kind, self._buffer, others, before, final=candidates.final)
            )

    def advance(self, position: int, piece: Piece) -> int:
        """Take what is valid from an offset on, until the end or a frame that changes what is
        looked for; where that frame ends.
        """
        counted = position
        while position < self._length:
            spot = self._next(position)
            if spot is None:
                break
            answer = self._at(spot)
            if answer is None:
                piece.end, piece.waiting = spot, self._is_whole
                piece.need = self._strong[spot][1] if spot in self._strong else 0
                break
            kind, number, size = answer
            if not number:
                position = spot + 1
                continue
            self._count(piece, counted, spot, before=kind)
            self._taken.append((kind, spot, number, size))
            position = counted = spot + number * size
            if self._accepted(kind, position):
                return position
        self._count(piece, counted, piece.end)
        return piece.end

    def frames(self) -> Frames:
        """All that were taken."""
        return self._frames(self._taken) if self._taken else Frames.none(self._buffer)

    def _next(self, position: int) -> int | None:
        """The first offset from here on where something may stand."""
        index = bisect.bisect_left(self._spots, position)
        found = self._spots[index] if index < len(self._spots) else None
        for lane in self._lanes:
            spot = lane.first(
                position,
                self._length - 1 if found is None else found,
                believed=self._believed(lane, position),
            )
            found = found if spot is None else spot
        return found

    def _at(self, spot: int) -> tuple[int, int, int] | None:
        """The type, number and size of the frames that are taken at an offset (0: none); None if
        that takes more bytes than there are.
        """
        kind, size, short = self._strong.get(spot, (len(self._framing.names), 0, False))
        for lane in self._lanes:
            if lane.kind > kind:
                break
            steady = lane is self._lanes[0] and not self._framing.switches(lane.kind, self._mode)
            number = lane.run(spot, believed=self._believed(lane, spot), steady=steady)
            if number == WAIT:
                return None
            if number:
                return lane.kind, number, lane.length(spot)
        if short:
            return None
        return kind, int(size > 0), size

    def _believed(self, lane: Lane, spot: int) -> bool:
        return (
            self._mode.run == self._framing.names[lane.kind]
            and self._mode.run_end == self._base + spot
        )

    def _accepted(self, kind: int, end: int) -> bool:
        """Remember that frames of a type were taken; whether they change what is looked for."""
        name, switched = self._framing.names[kind], self._framing.switches(kind, self._mode)
        self._mode.run, self._mode.run_end = (
            (name, self._base + end) if self._framing.weak(kind) else (None, -1)
        )
        if switched:
            self._mode.after = name
        return switched

    def _count(self, piece: Piece, start: int, stop: int, *, before: int = 0) -> None:
        """Count the weak candidates that were passed over from `start` to `stop`, and at `stop`
        those of types before a type.
        """
        for lane in self._lanes:
            status = lane.status[start : stop + (lane.kind < before)].tobytes()
            if status:
                numbers = [status.count(reason) for reason in range(PLUGIN + 1)]
                numbers[IMPLAUSIBLE] += numbers[VALID]  # but not believed
                piece.reject(numbers, lane.errors)

    def _frames(self, taken: list[tuple[int, int, int, int]]) -> Frames:
        """The frames of the runs that were taken: type, first offset, number and size of their
        frames.
        """
        if len(taken) == 1:
            kind, spot, number, size = taken[0]
            kinds, sizes = repeated(kind, number), repeated(size, number)
            starts: Offsets = np.arange(spot, spot + number * size, size)
            layouts, forms = self._layouts(kinds, starts)
        else:
            all_kinds, spots, numbers, all_sizes = np.array(taken, np.intp).T
            kinds, sizes = np.repeat(all_kinds, numbers), np.repeat(all_sizes, numbers)
            steps, last = sizes.copy(), spots + (numbers - 1) * all_sizes
            steps[np.cumsum(numbers) - numbers] = spots - np.concatenate(([0], last[:-1]))
            starts = np.cumsum(steps)
            if any(lane.has_forms for lane in self._lanes):
                layouts, forms = self._layouts(kinds, starts)
            else:  # all frames of a run have one layout
                layouts, forms = self._layouts(all_kinds, spots)
                forms = np.repeat(forms, numbers)
        return Frames(self._buffer, kinds, starts, sizes, layouts=layouts, forms=forms)

    def _layouts(self, kinds: Offsets, starts: Offsets) -> tuple[tuple[Layout, ...], Offsets]:
        """The layouts of frames that were taken, and which of them each has."""
        for lane in self._lanes:
            if np.count_nonzero(kinds == lane.kind) == len(kinds):
                return tuple(lane.layouts), lane.forms(starts)
        layouts, forms = list(self._live.layouts), np.full(len(kinds), -1, np.intp)
        strong = np.logical_and.reduce([kinds != lane.kind for lane in self._lanes])
        forms[strong] = self._live.forms[self._live.starts.searchsorted(starts[strong])]
        for lane in self._lanes:
            own = kinds == lane.kind
            known = lane.forms(starts[own])
            forms[own] = np.where(known < 0, -1, known + len(layouts))
            layouts += lane.layouts
        return tuple(layouts), forms
