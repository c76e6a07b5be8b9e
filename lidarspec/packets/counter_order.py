"""Find lost, late and duplicate packets by their counter (`PacketCounter`).

`CounterOrder` gives each packet an index, which is the unwrapped counter with gaps for missing
packets. A late packet fills the gap that was left for it.

If the pace of the clock is declared, the clock shows how often the counter wrapped in a gap, and
whether a value of the counter is corrupt.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.expressions.columns import Batch
from lidarspec.expressions.graph import header_function
from lidarspec.framing.results import Counters, to_array
from lidarspec.packets.clocks import Times
from lidarspec.packets.masked_sector import MaskedGaps
from lidarspec.packets.pace import MAX_STEP_NS, Paces, read_paces, shortest_pace
from lidarspec.packets.packets import Index
from lidarspec.packets.returns import GroupCounter
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.timing import Clock, PacketCounter

#: The maximum number of places by which a packet can be late. If it is further back, the sensor
#: restarted.
MAX_PLACES_LATE = 64
#: The maximum number of places by which a packet can precede the first packet of the stream. It is
#: smaller, because a packet further back more likely shows a wrap of the counter during a loss.
MAX_PLACES_EARLY = 10
#: A counter with at least this many values does not wrap in normal use: if it returns to 0, the
#: sensor has restarted.
LONG_PERIOD = 1 << 16
#: A counter with more values than this fills 64 bits; its differences wrap without a modulo.
MAX_SIGNED_PERIOD = 1 << 63
#: The limit of the first index and of each step of the index, so that it fits in 64 bits for any
#: counter.
MAX_INDEX_STEP = 1 << 32


@dataclass(frozen=True, eq=False)
class CounterReadings:
    """The counter and the clock in the packets of a batch.

    Attributes:
        numbers: the values of the counter, (n,).
        periods: the number of values before the counter wraps: an int for all packets, or (n,).
        has_counter: whether each packet has the counter, (n,); None if all packets have it.
        times: the times by the sensor's clock, (n,) ns; None if there is no clock, or if the
            pace of the clock is not declared.
        steps: the measured time since the previous packet, (n,) ns; None if `times` is None.
        paces: the declared time since the previous packet (`Clock.pace`), (n,) ns; nan if unknown.
    """

    numbers: NDArray[Any]
    periods: int | NDArray[np.int64]
    has_counter: NDArray[np.bool_] | None
    times: Times | None
    steps: Times | None
    paces: Paces

    def number(self, row: int) -> int | None:
        """Return the counter of a packet; None if the packet does not have it."""
        if self.has_counter is not None and not self.has_counter[row]:
            return None
        return int(self.numbers.item(row))

    def time(self, row: int) -> int | None:
        """Return the time of a packet, ns; None without a clock."""
        if self.times is None:
            return None
        return self.times.item(row)

    def period(self, row: int) -> int:
        """Return the number of values before the counter of a packet wraps."""
        if isinstance(self.periods, int):
            period = self.periods
        else:
            period = self.periods.item(row)
        return max(period, 1)


@dataclass
class CountedLoss:
    """The numbers of lost and of masked packets in a gap of the counter."""

    missing: int
    masked: int = 0


@dataclass(frozen=True)
class CounterJump:
    """A jump of the counter that a single corrupt value may have caused.

    Attributes:
        number: the counter of the packet before the jump.
        loss: the loss counted for the jump; None if no loss was counted.
    """

    number: int
    loss: CountedLoss | None


class CounterOrder:
    """Finds lost, late and duplicate packets of one stream by their counter.

    Args:
        sensor: the sensor that declares the counter.
        stats: counts lost, late and duplicate packets.
        clock: the clock of the packets; used only if its pace is declared.
    """

    def __init__(self, sensor: SensorDescription, stats: Counters, clock: Clock | None) -> None:
        assert sensor.sequence is not None
        self._rule: PacketCounter = sensor.sequence
        self._clock = clock if clock is not None and clock.pace is not None else None
        self._stats = stats
        self._gaps = MaskedGaps(sensor)
        self._groups: GroupCounter | None = None
        if self._rule.returns != 1:
            self._groups = GroupCounter(self._rule, stats)
        self._arrived: int | None = None  # time of the packet that arrived last, ns
        self._number: int | None = None  # of the newest packet
        self._time: int | None = None  # of the newest packet, ns
        self._angle = math.nan  # of the newest packet, in turns
        self._period = 0
        self._index = -1  # of the newest packet
        self._first = 0  # index of the first packet since the sensor started
        self._missing = dict[int, CountedLoss]()  # by index
        # number and time of a packet that may be damaged
        self._suspect: tuple[int, int] | None = None
        self._jump: CounterJump | None = None  # before the newest packet

    def push(self, batch: Batch, times: Times | None) -> tuple[Index, NDArray[np.bool_]]:
        """Return the index of each packet, and whether the stream breaks before the packet.

        Both have the shape (n,). The stream breaks where packets were lost or the sensor restarted.
        The index has gaps for lost packets.

        Args:
            batch: the packets. Breaks that `batch.breaks` contains already are returned as well.
            times: times by the sensor's clock, (n,) ns; None without a clock.

        Raises:
            SpecError: if the counter is not a field outside of arrays.
        """
        index, breaks = self._place_all(batch, times)
        if self._groups is not None:
            self._groups.push(batch, to_array(index))
        return index, breaks

    def _place_all(
        self, batch: Batch, times: Times | None
    ) -> tuple[NDArray[np.int64] | range, NDArray[np.bool_]]:
        """Return the same as `push`, without counting the returns of firings."""
        count = len(batch)
        readings = self._read_batch(batch, times)
        self._gaps.read(batch.table)
        index = np.empty(count, np.int64)
        odd_rows = [*self._find_unexpected(readings), count]
        next_odd = row = 0
        while row < count:
            while odd_rows[next_odd] <= row:
                next_odd += 1
            ahead, number = self._count_places_ahead(readings, row)
            if ahead == 1 and number == readings.number(row):
                stop = odd_rows[next_odd]
                first = self._index + 1
                self._index += stop - row
                self._jump = None
                self._set_newest(readings.number(stop - 1), readings.time(stop - 1), stop - 1)
                if stop - row == count:
                    return range(first, first + count), batch.breaks
                index[row:stop] = np.arange(first, first + stop - row)
                row = stop
            else:
                index[row], is_break = self._place(readings, row, ahead, number)
                batch.breaks[row] |= is_break
                row += 1
        return index, batch.breaks

    def forget(self) -> None:
        """Forget the last clock reading and the masked sector, because input was lost."""
        self._time = None
        self._arrived = None
        self._gaps.forget()

    def _read_batch(self, batch: Batch, times: Times | None) -> CounterReadings:
        """Return the counter and the clock of a batch."""
        info = batch.table.schema.fields.get(self._rule.field)
        if info is None or info.axes:
            raise SpecError(
                "the counter of a PacketCounter must be a field outside of arrays",
                path=self._rule.field,
            )
        numbers = batch.table.raw(self._rule.field)
        periods = self._find_last_number(batch, (1 << info.bits) - 1) - self._rule.first + 1
        if not isinstance(periods, int) or periods <= MAX_SIGNED_PERIOD:
            numbers = numbers.astype(np.int64)
        has_counter = batch.table.present(self._rule.field)
        if self._clock is None or times is None:
            unknown = np.broadcast_to(np.nan, (len(batch),))
            return CounterReadings(numbers, periods, has_counter, None, None, unknown)
        if self._arrived is None:
            first_step = 1
        else:
            first_step = times.item(0) - self._arrived
        self._arrived = times.item(-1)
        steps = np.empty(len(times), np.int64)
        steps[0] = first_step
        np.subtract(times[1:], times[:-1], out=steps[1:])
        paces = read_paces(self._clock, batch)
        return CounterReadings(numbers, periods, has_counter, times, steps, paces)

    def _find_last_number(self, batch: Batch, largest: int) -> int | NDArray[np.int64]:
        """Return the value after which the counter wraps: an int, or one per packet, (n,)."""
        last = self._rule.last
        if callable(last):
            (values,) = header_function(last, batch.table.schema, _to_integers)(batch)
            if (values == values[0]).all():
                return values.item(0)
            return values
        if last is None:
            return largest
        return int(last)

    def _find_unexpected(self, readings: CounterReadings) -> list[int]:
        """Return the rows of packets that do not directly follow the previous packet."""
        # Row 0 is not included.
        numbers = readings.numbers
        if readings.has_counter is not None and not readings.has_counter.all():
            return list(range(len(numbers)))
        steps = numbers[1:] - numbers[:-1]
        is_odd = steps != 1
        periods = readings.periods
        if isinstance(periods, int):
            each: Any = periods
            least = periods
            if periods <= MAX_SIGNED_PERIOD and is_odd.any():
                is_odd &= (steps - 1) % periods != 0
        else:
            each = np.maximum(periods, 1)
            least = int(each.min())
            is_odd &= (steps - 1) % each[1:] != 0
            is_odd |= each[1:] != each[:-1]
        if readings.steps is not None and least < LONG_PERIOD:
            longest = max(int(readings.steps.max()), -int(readings.steps.min()))
            if longest > shortest_pace(readings.paces) * least / 2:  # the counter may have wrapped
                is_odd |= (np.abs(readings.steps) > readings.paces * each / 2)[1:]
        return (np.flatnonzero(is_odd) + 1).tolist()

    def _count_places_ahead(
        self, readings: CounterReadings, row: int
    ) -> tuple[int | None, int | None]:
        """Compare a packet with the newest packet.

        Returns:
            The index of the packet minus the newest index, or None if the sensor has restarted; and
            the counter of the packet, corrected if the clock shows that it is corrupt. If the
            packet has no counter, the results are 1 and the counter of the newest packet.
        """
        number = readings.number(row)
        if number is None:
            return 1, self._number
        period = readings.period(row)
        if self._number is None or period != self._period:
            self._period = period
            return None, number
        ahead = (number - self._number) % period
        time = readings.time(row)
        pace = readings.paces.item(row)
        if time is None or self._time is None or not pace > 0:
            return self._count_by_number(ahead, period), number
        passed = time - self._time
        if abs(passed) > MAX_STEP_NS:
            return self._count_by_number(ahead, period), number
        by_clock = passed / pace
        near = ahead + period * round((by_clock - ahead) / period)
        if _is_consistent(near, by_clock) and near >= -MAX_PLACES_LATE:
            self._suspect = None
            return (None if near == -MAX_PLACES_LATE else near), number
        if ahead == 1:  # the clock was set, or a recording starts again
            self._suspect = None
            return 1, number
        if by_clock <= -MAX_PLACES_LATE:
            return None, number
        if by_clock <= 0.5:  # a late packet, from before or after a reset of the counter
            return round(by_clock), number
        return self._correct(number, time, pace, by_clock)

    def _count_by_number(self, ahead: int, period: int) -> int | None:
        """Return how many places a packet is ahead of the newest, by the counter alone.

        Args:
            ahead: the counter minus the newest packet's counter, modulo `period`.
        """
        # The result is None if the sensor has restarted.
        if ahead == 0:
            return 0
        behind = period - ahead
        if self._index - behind >= self._first:
            reach = MAX_PLACES_LATE
        else:
            reach = MAX_PLACES_EARLY
        if behind <= min(reach, period // 2):
            return -behind
        if period >= LONG_PERIOD and ahead > min(period // 2, MAX_INDEX_STEP):
            return None
        return ahead

    def _correct(self, number: int, time: int, pace: float, by_clock: float) -> tuple[int, int]:
        """Return the number of places ahead by the clock, and the corrected counter."""
        # A sensor that has reset its counter contradicts the clock again and again. Its counter is
        # not corrected.
        ahead = max(round(by_clock), 1)
        suspect = self._suspect
        self._suspect = (number, time)
        if suspect is not None:
            number_before, time_before = suspect
            places = (number - number_before) % self._period
            if _is_consistent(places, (time - time_before) / pace):
                return ahead, number
        assert self._number is not None
        return ahead, self._number + ahead

    def _place(
        self, readings: CounterReadings, row: int, ahead: int | None, number: int | None
    ) -> tuple[int, bool]:
        """Return the index of an unexpected packet, and whether a break precedes it."""
        if ahead is not None and ahead <= 0:
            return self._place_late(-ahead), False
        jump = self._jump
        self._jump = None
        is_first = self._index < 0
        if jump is not None and self._is_continued(jump, number):
            if jump.loss is not None:
                self._stats.lost -= jump.loss.missing
            self._restart(number)
            is_break = True
        elif ahead is None:
            self._store_jump(None)
            self._restart(number)
            is_break = not is_first
        else:
            loss = self._add_loss(row, ahead)
            if ahead > MAX_PLACES_LATE:
                self._store_jump(loss)
            is_break = not is_first and loss.missing > 0
        self._set_newest(number, readings.time(row), row)
        return self._index, is_break

    def _store_jump(self, loss: CountedLoss | None) -> None:
        """Store a jump of the counter, unless a clock checks the counter."""
        if self._clock is None and self._number is not None:
            self._jump = CounterJump(self._number, loss)

    def _is_continued(self, jump: CounterJump, number: int | None) -> bool:
        """Return whether a counter value continues the sequence before a jump."""
        # If so, the value at the jump was corrupt.
        if number is None:
            return False
        return 0 < (number - jump.number) % self._period <= MAX_PLACES_LATE

    def _add_loss(self, row: int, ahead: int) -> CountedLoss:
        """Advance the index to a packet, and count the packets missing before it as lost."""
        loss = CountedLoss(ahead - 1)
        before = self._index
        self._index += ahead
        if loss.missing:
            angle = self._gaps.angle_at(row)
            loss.masked = self._gaps.count_masked(self._angle, angle, loss.missing)
            loss.missing -= loss.masked
            self._stats.lost += loss.missing
            if loss.missing:
                self._stats.lost -= self._gaps.revoke_losses(row, self._angle, angle, loss)
        oldest = self._index - MAX_PLACES_LATE
        kept = {index: each for index, each in self._missing.items() if index > oldest}
        added = range(max(before + 1, oldest), self._index)
        self._missing = kept | dict.fromkeys(added, loss)
        return loss

    def _restart(self, number: int | None) -> None:
        """Begin with the first packet, or begin again after the sensor restarted."""
        if self._index < 0 and number is not None:
            self._index = (number - self._rule.first) % self._period % MAX_INDEX_STEP
        else:
            self._index += 2
        self._first = self._index
        self._missing = {}
        self._suspect = None

    def _place_late(self, behind: int) -> int:
        """Return the index of a packet that is late or a duplicate, and count it.

        Args:
            behind: how many places the packet is behind the newest packet.
        """
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

    def _set_newest(self, number: int | None, time: int | None, row: int) -> None:
        self._number = number
        self._time = time
        self._angle = self._gaps.angle_at(row)


def _is_consistent(ahead: int, by_clock: float) -> bool:
    """Return whether the counter and the clock advance by about as many packets."""
    is_near = abs(ahead - by_clock) <= 1 + abs(by_clock) / 8
    return is_near and (ahead > 0) == (by_clock > 0.5)


def _to_integers(values: Any, count: int) -> NDArray[np.int64]:
    integers = np.asarray(values, np.float64).reshape(-1).astype(np.int64)
    if len(integers) == 1:
        return integers
    return np.broadcast_to(integers, (count,))
