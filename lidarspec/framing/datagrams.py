"""Datagrams, each one frame, whole, or none: of which type each is, judged together.

The same rule as in a stream, without the search: at the first byte of a datagram the order of the types decides, a type
with `after` only counts while it is announced, and a frame has to be as long as its datagram.
"""

from __future__ import annotations

import bisect

import numpy as np
from numpy.typing import NDArray

from lidarspec.framing.frame_engine import CompiledCodec
from lidarspec.framing.plausibility import PLUGIN, SHORT, VALID, Status, Survey
from lidarspec.framing.search import COUNTED, Bytes1D, Framing, Mode, Offsets
from lidarspec.wire.arrays import alike, repeated
from lidarspec.wire.layout import Bytes2D, Layout, equal, exclude, right

#: constants that tell the types of most datagrams.
TOLD = 4


class Datagrams:
    """The frame types of a sensor, ready to be told from each other.

    Attributes:
        rejected: number of datagrams of the last batch that are none, by counter.
        errors: tracebacks out of plugins, of the last batch.
    """

    def __init__(self, framing: Framing) -> None:
        self._framing = framing
        self.rejected: dict[str, int] = {}
        self.errors: list[str] = []
        self._surveyed: tuple[int, Survey] | None = None

    def alike(self, rows: Bytes2D, mode: Mode) -> tuple[int, Layout] | None:
        """The type and layout of datagrams of one size, one a row; None where they are to be told apart by `kinds`.

        So they are where not all are frames of one type and layout, and where they change what is looked for.
        """
        self._surveyed = None
        kind = self._likely(rows, mode)
        if kind is None or right(self._framing.words[kind], rows) is not None or self._framing.switches(kind, mode):
            return None
        survey = self._framing.codecs[kind].alike(rows)
        if survey is None or survey.layout is None:
            return None
        if np.count_nonzero(survey.status):
            self._surveyed = kind, survey
            return None
        return kind, survey.layout

    def _likely(self, rows: Bytes2D, mode: Mode) -> int | None:
        """The type that the first datagram resembles, if none of those with its constants resembles one that comes first; else None."""
        first, before = rows[0].tobytes(), list[int]()
        for kind in self._framing.active(mode):
            if self._framing.codecs[kind].size not in (None, len(first)) or self._framing.ends[kind] > len(first):
                continue
            if all(first[spot] & mask == value for spot, mask, value in self._framing.marks[kind][:TOLD]):
                return None if any(self._resembled(other, kind, rows) for other in before) else kind
            before.append(kind)
        return None

    def _resembled(self, kind: int, other: int, rows: Bytes2D) -> bool:
        """Whether any row with the constants of the other type has those of this type as well."""
        if exclude(self._framing.marks[kind], self._framing.marks[other]):
            return False
        marked = right(self._framing.words[kind], rows)
        return marked is None or bool(np.count_nonzero(marked))

    def kinds(self, buffer: Bytes1D, starts: Offsets, sizes: Offsets, mode: Mode) -> Offsets:
        """The type of each datagram, as its index, -1 where it is none.

        Args:
            mode: remembered between batches, changed here.
        """
        self.rejected, self.errors = {}, []
        batch = _Batch(self, buffer, starts, sizes)
        position, parts = 0, []
        while position < len(starts):
            part = batch.kinds_from(position, mode)
            parts.append(part)
            position += len(part)
        self._surveyed = None
        return parts[0] if len(parts) == 1 else np.concatenate([np.empty(0, np.intp), *parts])

    def judged(self, buffer: Bytes1D, starts: Offsets, sizes: Offsets, mode: Mode) -> Offsets:
        """The type of each datagram while nothing changes what is looked for."""
        number, known = len(starts), alike(sizes)
        least, most = (known, known) if known is not None else (int(sizes.min()), int(sizes.max())) if number else (0, 0)
        kinds, left = None, None if least else np.flatnonzero(sizes)
        for kind in self._framing.active(mode):
            if left is not None and not len(left):
                break
            size = self._framing.codecs[kind].size
            if size is not None and not least <= size <= most:
                continue
            own, lengths = (starts, sizes) if left is None else (starts[left], sizes[left])
            marked = self._marked(kind, buffer, own, lengths)
            if np.count_nonzero(marked) < len(marked):
                own, lengths = own[marked], lengths[marked]
                if not len(own):
                    continue
            survey = self._survey(kind, buffer, own, whole=left is None and len(own) == number)
            valid = not np.count_nonzero(survey.status)
            if valid and left is None and len(own) == number and _same(survey.sizes, lengths):
                return repeated(kind, number)
            right = survey.sizes == lengths
            if not valid:
                right &= survey.status == VALID
            found = np.flatnonzero(marked)[right]
            kinds = np.full(number, -1, np.intp) if kinds is None else kinds
            kinds[found if left is None else left[found]] = kind
            left = np.flatnonzero((kinds < 0) & (sizes > 0))
        return np.full(number, -1, np.intp) if kinds is None else kinds

    def _survey(self, kind: int, buffer: Bytes1D, starts: Offsets, *, whole: bool) -> Survey:
        """What datagrams are, if they are of a type; `whole`: all of the batch, which `alike` may have looked at already."""
        known, self._surveyed = self._surveyed, None
        if whole and known is not None and known[0] == kind:
            return known[1]
        return self._framing.codecs[kind].survey(buffer, starts, gathered=False)

    def refused(self, buffer: Bytes1D, starts: Offsets, sizes: Offsets, mode: Mode) -> Status:
        """Why datagrams that are no frames are none, (n,), 0 where they resemble none; `PLUGIN` where each is to be judged alone."""
        reasons = np.zeros(len(starts), np.uint8)
        for kind in self._framing.active(mode):
            codec = self._framing.codecs[kind]
            if not isinstance(codec, CompiledCodec):
                return np.full(len(starts), PLUGIN, np.uint8)
            marked = np.flatnonzero(self._marked(kind, buffer, starts, sizes))
            if len(marked):
                survey, own = codec.survey(buffer, starts[marked], gathered=False), sizes[marked]
                status = np.where(survey.sizes > own, np.uint8(SHORT), survey.status)
                status[(status == VALID) & (survey.sizes == own)] = PLUGIN
                reasons[marked] = np.maximum(reasons[marked], status)
        return reasons

    def count(self, reasons: Status) -> None:
        """Count datagrams as rejected."""
        for reason, number in enumerate(np.bincount(reasons).tolist()):
            if number:
                counter = COUNTED.get(reason, "bad_length")
                self.rejected[counter] = self.rejected.get(counter, 0) + number

    def judged_alone(self, datagram: Bytes1D, mode: Mode) -> int:
        """The type of one datagram, -1 where it is none; counts why."""
        rejected, size = 0, np.array([len(datagram)])
        for kind in self._framing.active(mode) if len(datagram) else ():
            if not self._marked(kind, datagram, np.zeros(1, np.intp), size).all():
                continue
            survey = self._framing.codecs[kind].survey(datagram, np.zeros(1, np.intp))
            if survey.status[0] == VALID and survey.sizes[0] == len(datagram):
                return kind
            rejected = max(rejected, int(survey.status[0]))
            self.errors += survey.errors
        self.count(np.array([rejected], np.uint8))
        return -1

    def _marked(self, kind: int, buffer: Bytes1D, starts: Offsets, sizes: Offsets) -> NDArray[np.bool_]:
        """Which datagrams have the constants of a type."""
        constants, end = self._framing.words[kind], self._framing.ends[kind]
        size = alike(sizes)
        if size is None or size < end:
            whole = sizes >= end
            if not whole.all():
                marked = whole.copy()
                marked[whole] = self._marked(kind, buffer, starts[whole], sizes[whole])
                return marked
        marked = np.ones(len(starts), np.bool_)
        step = _step(starts)
        for word in constants if len(starts) else ():
            spot, dtype, _, _ = word
            found = (
                np.ndarray((len(starts),), dtype, buffer, starts.item(0) + spot, (step,))
                if step
                else np.ndarray((len(buffer) - spot - dtype.itemsize + 1,), dtype, buffer, spot, (1,))[starts]
            )
            marked &= equal(found, word)
        return marked


def evenly(buffer: Bytes1D, starts: Offsets, sizes: Offsets) -> Bytes2D | None:
    """Datagrams as the rows of an array, where they have one size and stand at one distance, one after another; else None."""
    count = len(starts)
    size = sizes.item(0) if count else 0
    if not size or (alike(sizes) is None and np.count_nonzero(sizes == size) < count):
        return None
    step = size if count == 1 else _step(starts)
    return np.ndarray((count, size), np.uint8, buffer, starts.item(0), (step, 1)) if step >= size else None


def _step(starts: Offsets) -> int:
    """The bytes from each datagram to the next, where they are the same for all; else 0."""
    steps = starts[1:] - starts[:-1]
    step = steps.item(0) if len(steps) else 0
    return step if step > 0 and np.count_nonzero(steps == step) == len(steps) else 0


def _same(first: Offsets, second: Offsets) -> bool:
    one, other = alike(first), alike(second)
    return bool((first == second).all()) if one is None or other is None else one == other


class _Batch:
    """Some datagrams, judged once for each of the frames that may have been announced."""

    def __init__(self, types: Datagrams, buffer: Bytes1D, starts: Offsets, sizes: Offsets) -> None:
        self._types, self._framing = types, types._framing
        self._buffer, self._starts, self._sizes = buffer, starts, sizes
        self._known: dict[str | None, tuple[int, Offsets, list[int]]] = {}

    def kinds_from(self, position: int, mode: Mode) -> Offsets:
        """The types from here up to the datagram that changes what is looked for."""
        if mode.after not in self._known:
            kinds = self._types.judged(self._buffer, self._starts[position:], self._sizes[position:], mode)
            switching = (
                [kind for kind in range(len(self._framing.names)) if self._framing.switches(kind, mode)] if self._framing.named else []
            )
            spots = (np.flatnonzero(np.isin(kinds, switching)) + position).tolist() if switching else []
            self._known[mode.after] = position, kinds, spots
        first, kinds, spots = self._known[mode.after]
        index = bisect.bisect_left(spots, position)
        stop = spots[index] + 1 if index < len(spots) else len(self._starts)
        found = kinds[position - first : stop - first]
        if alike(found) is None and len(lost := np.flatnonzero(found < 0)):
            found = self._rejected(found, lost, position, mode)
        if len(found) and found[-1] >= 0 and self._framing.switches(int(found[-1]), mode):
            mode.after = self._framing.names[int(found[-1])]
        return found

    def _rejected(self, found: Offsets, lost: Offsets, position: int, mode: Mode) -> Offsets:
        """Count those that are no frames; the types again, up to one that turns out to be a frame that changes what is looked for."""
        reasons = self._types.refused(self._buffer, self._starts[position + lost], self._sizes[position + lost], mode)
        for index in lost[reasons == PLUGIN].tolist():
            start = int(self._starts[position + index])
            found[index] = self._types.judged_alone(self._buffer[start : start + int(self._sizes[position + index])], mode)
            if found[index] >= 0 and self._framing.switches(int(found[index]), mode):
                found = found[: index + 1]
                break
        self._types.count(reasons[(reasons != PLUGIN) & (lost < len(found))])
        return found
