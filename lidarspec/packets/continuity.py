"""Whether packets follow one another: what was lost, came twice or late, where there is a break,
and where each packet stands.

`Continuity` is the one judge of that. It asks the sensor's counter and its clock, and where it has
neither the bytes that were skipped; the counters, the breaks and the completeness of scans all
follow from the index that it gives: it runs on, and leaves out as many numbers as packets are
missing. What the counter cannot tell, the clock does: how often the counter has wrapped in a gap,
and whether a number that jumps is damaged. How long a packet takes by the clock is declared
(`Clock.pace`), or learned (`Pace`). Datagrams that only their clock numbers are judged by
`clock_order`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.expressions.columns import Batch
from lidarspec.expressions.graph import header_function
from lidarspec.frames.arrays import alike, counted
from lidarspec.framing.results import Counters, Numbers
from lidarspec.packets.clocks import Times
from lidarspec.packets.masked_sector import MaskedGaps
from lidarspec.packets.pace import Pace, Paces
from lidarspec.packets.packets import Index
from lidarspec.spec.description import Spec
from lidarspec.spec.timing import Clock, Sequence

#: how far back a packet may come and still be a late one; further back the sensor has started
#: again.
LATE = 64
#: the same where the packet would stand before the first one of all, which is more likely a turn
#: that was missed.
EARLY = 10
#: counters with at least so many values start again at 0 only when the sensor does.
LONG = 1 << 16
#: counters with more values fill 64 bits: differences wrap by themselves.
WIDE = 1 << 63
#: a first index, and a step of a counter, are no larger: an index fits 64 bits whatever the counter
#: says.
FARTHEST = 1 << 32
#: a clock that goes on by more nanoseconds from one packet to the next was set.
SET = 3600 * 10**9


@dataclass(frozen=True, eq=False)
class Clues:
    """What there is to judge the packets of a batch by.

    Attributes:
        numbers, periods: the counter, (n,), None where there is none; and after how many packets it
            starts again, one for all or (n,).
        there: which packets have the counter, (n,); None where all have.
        times, paces: of the sensor's clock, (n,) ns, None where there is none; and how long packets
            take by it.
        passed: from the time of the packet that arrived before to each, (n,) ns.
        skipped: before which packets there are bytes in no frame, (k,), and how many packets these
            would be, (k,).
    """

    batch: Batch
    numbers: NDArray[Any] | None
    periods: int | NDArray[np.int64]
    there: NDArray[np.bool_] | None
    times: Times | None
    passed: Times | None
    paces: Paces
    skipped: tuple[NDArray[np.intp], NDArray[np.int64]]

    def number(self, spot: int) -> int | None:
        """The counter of a packet."""
        return (
            None
            if self.numbers is None or (self.there is not None and not self.there[spot])
            else self.numbers.item(spot)
        )

    def time(self, spot: int) -> int | None:
        """The time of a packet, ns."""
        return None if self.times is None else self.times.item(spot)

    def period(self, spot: int) -> int:
        """After how many packets the counter of a packet starts again."""
        return max(self.periods if isinstance(self.periods, int) else self.periods.item(spot), 1)


@dataclass
class CountedLoss:
    """Packets that are missing by the counter, and that a masked sector leaves out (see
    `masked_sector.Loss`).
    """

    missing: int
    masked: int = 0


class Continuity:
    """Whether the packets of one stream follow one another; counts into `stats`.

    Args:
        counted, timed: whether these packets have the sensor's counter, and its clock.
        grain: the step of that clock, ns; 0 where it is fine.
    """

    def __init__(
        self, sensor: Spec, stats: Counters, *, counted: bool, timed: bool, grain: float = 0
    ) -> None:
        self._sensor, self._stats = sensor, stats
        self._rule: Sequence | None = sensor.sequence if counted else None
        self._clock: Clock | None = sensor.clock if timed else None
        self._pace = None if self._clock is None else Pace(self._clock, grain)
        self._number: int | None = None  # of the newest packet
        self._time: int | None = None  # of the newest packet, ns
        self._largest = 1  # bytes of the largest packet
        self._arrived: int | None = None  # the time of the packet that came last, ns
        self._suspect: tuple[int, int] | None = (
            None  # number and time of a packet whose counter jumped while the clock went on
        )
        self._period, self._index, self._first = 0, -1, 0
        self._missing = dict[int, CountedLoss]()
        self._gaps = MaskedGaps(sensor) if counted else None
        self._angle = math.nan  # of the newest packet, in turns

    def push(
        self, batch: Batch, times: Times | None, skipped: NDArray[np.int64]
    ) -> tuple[Index, NDArray[np.bool_]]:
        """The index of each packet, (n,), and True where there is a break before it, (n,).

        Args:
            batch: the packets; `breaks` are those at skipped bytes, and further ones are marked.
            times: by the sensor's clock, (n,) ns; None where it has none.
            skipped: bytes that are in no frame before each packet, (n,).

        Raises:
            SpecError: where the counter is no field of the header.
        """
        number, breaks = len(batch), batch.breaks
        if (
            self._rule is None
            and self._clock is None
            and alike(skipped) == 0
            and alike(batch.table.sizes) is not None
        ):
            self._index, self._largest = (
                self._index + number,
                max(self._largest, batch.table.sizes.item(0)),
            )
            return range(self._index + 1 - number, self._index + 1), breaks
        clues = self._clues(batch, times, skipped)
        if self._rule is None:
            return self._in_order(clues, breaks), breaks
        if self._gaps is not None:
            self._gaps.read(batch.table)
        found: Numbers = np.empty(number, np.int64)
        odd, spot, turn = [*self._odd(clues), number], 0, 0
        while spot < number:
            while odd[turn] <= spot:
                turn += 1
            ahead, counts = self._ahead(clues, spot)
            follows = ahead == 1 and counts == clues.number(spot)
            end = odd[turn] if follows else spot + 1
            if follows:
                first, self._index = self._index + 1, self._index + end - spot
                self._number, self._time = clues.number(end - 1), clues.time(end - 1)
                self._angle = self._angle_at(end - 1)
                found = self._placed(found, first, spot, end)
            else:
                index, is_break = self._step(clues, spot, ahead, counts)
                found = self._placed(found, index, spot, end)
                breaks[spot] |= is_break
            spot = end
        return found, breaks

    def forget(self) -> None:
        """Time has passed, and packets may have, that nothing tells of: the clock is not asked
        about the next one.
        """
        self._time = self._arrived = None
        if self._gaps is not None:
            self._gaps.forget()
        if self._pace is not None:
            self._pace.forget()

    @staticmethod
    def _placed(found: Numbers, first: int, start: int, stop: int) -> Numbers:
        """Indices with those of some packets put in, which run on from `first`; a range where these
        are all.
        """
        if stop - start == len(found):
            return range(first, first + stop - start)
        assert not isinstance(found, range)
        found[start:stop] = np.arange(first, first + stop - start)
        return found

    def _clues(self, batch: Batch, times: Times | None, skipped: NDArray[np.int64]) -> Clues:
        """What these packets say."""
        passed, paces = None, Paces([(0, math.nan)])
        if times is not None and self._pace is not None:
            passed, paces = np.empty(len(times), np.int64), self._pace.of(batch, times)
            passed[0] = 1 if self._arrived is None else times.item(0) - self._arrived
            np.subtract(times[1:], times[:-1], out=passed[1:])
            self._arrived = times.item(-1)
        sizes = batch.table.sizes
        spots, packets = np.empty(0, np.intp), np.empty(0, np.int64)
        if alike(skipped) != 0:
            spots = np.flatnonzero(skipped > 0)
            largest = (
                sizes[spots] if alike(sizes) is not None else np.maximum.accumulate(sizes)[spots]
            )
            packets = np.rint(skipped[spots] / np.maximum(largest, self._largest)).astype(np.int64)
        self._largest = max(
            self._largest, int(sizes.max()) if (size := alike(sizes)) is None else size
        )
        return Clues(batch, *self._numbers(batch), times, passed, paces, (spots, packets))

    def _odd(self, clues: Clues) -> list[int]:
        """The packets that do not follow the one that arrived before them: all others, but the
        first, go on from there.
        """
        numbers, passed = clues.numbers, clues.passed
        assert numbers is not None
        if clues.there is not None and not clues.there.all():
            return list(range(len(clues.batch)))
        each: Any = (
            clues.periods if isinstance(clues.periods, int) else np.maximum(clues.periods, 1)
        )
        steps = numbers[1:] - numbers[:-1]
        odd = steps != 1
        if not (isinstance(each, int) and each > WIDE) and odd.any():
            odd &= (steps - 1) % (each if isinstance(each, int) else each[1:]) != 0
        if not isinstance(each, int):
            odd |= each[1:] != each[:-1]
        least = each if isinstance(each, int) else int(each.min())
        half = clues.paces.shortest * least / 2
        if (
            passed is not None
            and least < LONG
            and max(int(passed.max()), -int(passed.min())) > half
        ):  # it may have wrapped
            odd |= (np.abs(passed) > clues.paces.at_each(counted(len(passed))) * each / 2)[1:]
        return (np.flatnonzero(odd) + 1).tolist()

    def _in_order(self, clues: Clues, breaks: NDArray[np.bool_]) -> Index:
        """The index of packets that come in order, and are not counted; `breaks` are marked."""
        passed, first, number = clues.passed, self._index + 1, len(clues.batch)
        grain = 0.0 if self._pace is None else self._pace.grain
        shortest = clues.paces.shortest
        limit = min(shortest + max(grain, shortest / 2), SET)
        is_steady = passed is None or (int(passed.min()) >= 0 and int(passed.max()) <= limit)
        spots, packets = clues.skipped
        if is_steady and not packets.any():
            self._index += number
            return range(first, first + number)
        ahead, restarts = 1 + packets, np.zeros(len(spots), np.bool_)
        if passed is not None:
            is_odd = (passed < 0) | (passed > limit)
            is_odd[spots] = True
            spots = np.flatnonzero(is_odd)
            ahead = np.ones(len(spots), np.int64)
            ahead[np.searchsorted(spots, clues.skipped[0])] += packets
            paces = clues.paces.at_each(spots)
            steps = passed[spots]
            by_clock = np.fmax(np.ceil((steps - np.maximum(grain, paces / 2)) / paces), 1).astype(
                np.int64
            )
            ahead = np.where(grain <= paces / 2, by_clock, np.maximum(by_clock, ahead))
            restarts = (steps < 0) | (steps > SET)
            ahead[restarts] = 2
            self._stats.lost += int(ahead[~restarts].sum()) - int(np.count_nonzero(~restarts))
        if first == 0 and len(spots) and spots[0] == 0:
            ahead[0] = 1
        breaks[spots] |= ahead > 1
        self._index += number + int(ahead.sum()) - len(ahead)
        return partial(_with_gaps, first, number, spots, ahead - 1)

    def _numbers(
        self, batch: Batch
    ) -> tuple[NDArray[Any] | None, int | NDArray[np.int64], NDArray[np.bool_] | None]:
        """The counter of each packet, after how many it starts again, and which packets have it."""
        if self._rule is None:
            return None, 1, None
        info = batch.table.schema.fields.get(self._rule.field)
        if info is None or info.axes:
            raise SpecError("a sequence is a field of the header", path=self._rule.field)
        numbers = batch.table.raw(self._rule.field)
        periods = self._last(batch, (1 << info.bits) - 1) - self._rule.first + 1
        if not isinstance(periods, int) or periods <= WIDE:
            numbers = numbers.astype(np.int64)
        return numbers, periods, batch.table.present(self._rule.field)

    def _last(self, batch: Batch, widest: int) -> int | NDArray[np.int64]:
        """The highest number of the counter, for each packet or for all."""
        assert self._rule is not None
        last = self._rule.last
        if callable(last):
            (values,) = header_function(last, batch.table.schema, _whole)(batch)
            return values.item(0) if (values == values[0]).all() else values
        return widest if last is None else int(last)

    def _ahead(self, clues: Clues, spot: int) -> tuple[int | None, int | None]:
        """How many places a packet stands ahead of the newest one, None where the sensor has
        started again; and its number, if right.
        """
        time, number, pace = clues.time(spot), clues.number(spot), clues.paces.at(spot)
        passed = (
            None
            if time is None or self._time is None or abs(time - self._time) > SET
            else time - self._time
        )
        if number is None:
            return 1, self._number
        period = clues.period(spot)
        if self._number is None or period != self._period:
            self._period = period
            return None, number
        ahead = (number - self._number) % period
        if passed is None or not pace > 0:
            return self._by_counter(ahead, period), number
        by_clock = passed / pace
        near = ahead + period * round((by_clock - ahead) / period)
        is_right = _agree(near, by_clock) and near >= -LATE
        if ahead == 1 and not is_right:
            near = 1  # the clock was set, or is uneven, or a recording begins anew
        elif not is_right:
            if by_clock <= -LATE:
                return None, number
            if by_clock <= 0.5:
                return round(
                    by_clock
                ), number  # late, from before the numbers started again or after it
            return self._damaged(number, time or 0, pace, by_clock)
        self._suspect = None
        return None if near <= -LATE else near, number

    def _by_counter(self, ahead: int, period: int) -> int | None:
        behind = period - ahead
        reach = LATE if self._index - behind >= self._first else EARLY
        if ahead == 0 or behind <= min(reach, period // 2):
            return -behind if ahead else 0
        return None if period >= LONG and ahead > min(period // 2, FARTHEST) else ahead

    def _damaged(self, number: int, time: int, pace: float, by_clock: float) -> tuple[int, int]:
        """What the clock says of a packet whose number does not fit, unless the numbers go on from
        there: then they have started again.
        """
        ahead, suspect = max(round(by_clock), 1), self._suspect
        self._suspect = number, time
        if suspect is not None and _agree(
            (number - suspect[0]) % self._period, (time - suspect[1]) / pace
        ):
            return ahead, number
        assert self._number is not None
        return ahead, self._number + ahead

    def _step(
        self, clues: Clues, spot: int, ahead: int | None, number: int | None
    ) -> tuple[int, bool]:
        """The index of a packet that does not follow the newest one, and whether there is a break
        before it.
        """
        if ahead is not None and ahead <= 0:
            return self._back(-ahead), False
        before, lost = self._index, 0 if ahead is None else ahead - 1
        if ahead is None:
            self._begin(number)
        else:
            missing = range(self._index + 1, self._index + ahead)[-LATE:]
            loss = CountedLoss(lost)
            self._count_lost(loss, spot)
            lost = loss.missing
            self._missing = {
                index: loss
                for index, loss in self._missing.items()
                if index > self._index + ahead - LATE
            }
            self._missing |= dict.fromkeys(missing, loss)
            self._index += ahead
        self._number, self._time = number, clues.time(spot)
        self._angle = self._angle_at(spot)
        return self._index, before >= 0 and (ahead is None or lost > 0)

    def _count_lost(self, loss: CountedLoss, spot: int) -> None:
        """Count the packets that are missing before another one as lost, but for those that are
        masked.
        """
        if self._gaps is not None and loss.missing:
            angle = self._angle_at(spot)
            loss.masked = self._gaps.count_masked(self._angle, angle, loss.missing)
            loss.missing -= loss.masked
        self._stats.lost += loss.missing
        if self._gaps is not None and loss.missing:
            self._stats.lost -= self._gaps.find_unlost(spot, self._angle, angle, loss)

    def _angle_at(self, spot: int) -> float:
        return math.nan if self._gaps is None else self._gaps.angle_at(spot)

    def _begin(self, number: int | None) -> None:
        """A first packet, or the sensor started again: nothing is known to be lost, and the index
        leaves out one number.
        """
        if self._index < 0 and self._rule is not None and number is not None:
            self._index = (number - self._rule.first) % self._period % FARTHEST
        else:
            self._index += 2
        self._first = self._index
        self._missing = {}
        self._suspect = None

    def _back(self, behind: int) -> int:
        index = self._index - behind
        if index in self._missing:
            loss = self._missing.pop(index)
            if loss.missing:
                self._stats.lost -= 1
                loss.missing -= 1
            self._stats.late += 1
        elif behind and index < self._first:
            self._stats.late += 1
        else:
            self._stats.duplicates += 1
        return index


def _with_gaps(
    first: int, number: int, spots: NDArray[np.intp], gaps: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Consecutive numbers, (number,), that leave out so many before some places."""
    index = np.ones(number, np.int64)
    index[:1] = first
    index[spots] += gaps
    return np.cumsum(index, out=index)


def _agree(ahead: int, by_clock: float) -> bool:
    """Whether a counter and a clock say the same."""
    return abs(ahead - by_clock) <= 1 + abs(by_clock) / 8 and (ahead > 0) == (by_clock > 0.5)


def _whole(values: Any, number: int) -> NDArray[np.int64]:
    found = np.asarray(values, np.float64).reshape(-1).astype(np.int64)
    return found if len(found) == 1 else np.broadcast_to(found, (number,))
