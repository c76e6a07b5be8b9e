"""Find the rows at which a rotating angle passes a given angle.

A row is a point or a packet. `WrapDetector` is for an unknown direction of rotation, and
`PassDetector` for a known direction. The division of a stream into batches does not change their
results.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarspec.packets.masked_sector import MAX_JITTER_TURNS

Floats = NDArray[np.float64]

#: An angle has to move away this far from the given angle, in turns, before it can pass it again.
MIN_TURNS_AWAY = 1 / 8
#: The direction of rotation reverses when the angle has moved back this far, in turns.
REVERSAL_TURNS = 0.5
#: The number of rows that are searched together at first; it doubles until a row is found.
FIRST_CHUNK_ROWS = 64


class Rotation:
    """Finds the direction in which an angle rotates."""

    def __init__(self) -> None:
        self._direction = 0
        self._total = 0.0  # turns since the start
        self._furthest = 0.0  # the largest total in the present direction, times that direction

    def push(self, steps: Floats) -> Floats:
        """Return the direction at each step, 1 or -1, (k,); (1,) if all are equal.

        Args:
            steps: one or more steps of the angle, in turns, (k,).
        """
        totals = steps.copy()
        totals[0] += self._total
        np.cumsum(totals, out=totals)
        self._total = totals.item(-1)
        if self._direction and self._only_advances(totals.item(0), steps[1:]):
            self._furthest = self._direction * self._total
            return np.array([float(self._direction)])
        return self._find_directions(totals)

    def _only_advances(self, total: float, steps: Floats) -> bool:
        """Return whether new steps advance beyond the furthest angle, and never go back."""
        if self._direction * total < self._furthest:
            return False
        return float((self._direction * steps).min(initial=0.0)) >= 0

    def _find_directions(self, totals: Floats) -> Floats:
        """Return the direction of rotation at each row, (k,); (1,) if all are equal.

        Args:
            totals: the turns from the start to each row, (k,).
        """
        # The direction reverses when the angle has moved back by half a turn.
        directions = np.empty(len(totals))
        start = 0
        size = FIRST_CHUNK_ROWS
        while start < len(totals):
            chunk = totals[start : start + size]
            stop = start + len(chunk)
            if self._direction:
                directions[start:stop] = self._direction
                ahead = self._direction * chunk
                furthest = np.maximum(np.maximum.accumulate(ahead), self._furthest)
                self._furthest = furthest.item(-1)
                is_reversed = furthest - ahead >= REVERSAL_TURNS
            else:
                directions[start:stop] = np.where(chunk < 0, -1, 1)
                is_reversed = np.abs(chunk) >= REVERSAL_TURNS
            if is_reversed.any():
                row = int(is_reversed.argmax())
                self._reverse(chunk.item(row))
                start += row
                size = FIRST_CHUNK_ROWS
            else:
                start = stop
                size *= 2
        if (directions == directions[0]).all():
            return directions[:1]
        return directions

    def _reverse(self, total: float) -> None:
        """Reverse the direction, or set the first direction."""
        if self._direction:
            self._direction = -self._direction
        elif total > 0:
            self._direction = 1
        else:
            self._direction = -1
        self._furthest = self._direction * total


class WrapDetector:
    """Finds the rows at which an angle passes a given angle, in an unknown direction.

    The direction is measured, and may reverse. A step of more than half a turn is taken for a
    shorter step in the other direction.
    """

    def __init__(self) -> None:
        self._rotation = Rotation()
        self._angle: float | None = None  # of the row before
        self._is_armed = True

    def push(self, angles: Floats, full: float, at: float) -> tuple[NDArray[np.intp], Floats]:
        """Find the rows at which the angle passes `at`.

        Args:
            angles: the angles of the next rows, (k,), in any unit; rows with nan are ignored.
            full: a whole turn in this unit.
            at: the angle to pass.

        Returns:
            The rows, and by how much the angle advances at each of them, in turns.
        """
        finite = np.isfinite(angles)
        if not finite.all():
            rows = np.flatnonzero(finite)
            passes, steps = self.push(angles[rows], full, at)
            return rows[passes], steps
        if not len(angles):
            return np.empty(0, np.intp), np.empty(0)
        before = previous_values(angles, self._angle)
        self._angle = angles.item(-1)
        direction = self._rotation.push(
            (_reduce_to_turn(angles - before + full / 2, full) - full / 2) / full
        )
        behind = _reduce_to_turn(direction * (angles - at), full)
        if len(direction) == 1:
            first = _reduce_to_turn(direction * (before[:1] - at), full).item()
            behind_earlier = previous_values(behind, first)
        else:
            behind_earlier = _reduce_to_turn(direction * (before - at), full)
        passed = np.flatnonzero(behind_earlier - behind > full / 2)
        passes = self._select_real_passes(passed, behind, full)
        return passes, 1 - (behind_earlier[passes] - behind[passes]) / full

    def _select_real_passes(
        self, passed: NDArray[np.intp], behind: Floats, full: float
    ) -> NDArray[np.intp]:
        """Return the rows of the passes that jitter cannot have caused.

        Args:
            passed: the rows of all passes.
            behind: the angle at each row minus the angle to pass, from 0 to `full`, (k,).
            full: a whole turn in the unit of the angles.
        """
        armed = list[int]()
        start = 0
        for row in passed.tolist():
            if self._is_armed or _was_away(behind[start:row], full):
                armed.append(row)
                self._is_armed = False
                start = row
        self._is_armed = self._is_armed or _was_away(behind[start:], full)
        return np.array(armed, np.intp)


class PassDetector:
    """Finds the rows at which an angle passes a given angle, in a known direction.

    A step may leap over the given angle, and may be almost a whole turn.

    Args:
        at: the angle to pass, in turns.
        direction: 1 if angles grow, else -1.
    """

    def __init__(self, at: float, direction: int) -> None:
        self._at = at
        self._direction = direction
        self._angle: float | None = None  # of the row before
        self._turned = 1.0  # turns since it passed

    def restart(self, at: float, direction: int, angle: float | None) -> None:
        """Detect passes of another angle from now on.

        Args:
            at: the angle to pass, in turns.
            direction: 1 if angles grow, else -1.
            angle: the angle of the previous row, in turns; None if there was no row.
        """
        self._at = at
        self._direction = direction
        self._angle = angle

    def push(self, angles: Floats) -> NDArray[np.intp]:
        """Return the rows at which the angle of this detector is passed.

        Args:
            angles: the angles of the next rows, in turns, (k,).
        """
        if not len(angles):
            return np.empty(0, np.intp)
        before = previous_values(angles, self._angle)
        self._angle = angles.item(-1)
        steps = (self._direction * (angles - before)) % 1
        steps[steps > 1 - MAX_JITTER_TURNS] = 0
        behind = (self._direction * (before - self._at)) % 1
        turned = self._turned + np.cumsum(steps)
        rows = list[int]()
        for row in np.flatnonzero(behind + steps >= 1).tolist():
            if turned[row] >= MIN_TURNS_AWAY:
                rows.append(row)
                turned -= turned[row]
        self._turned = turned.item(-1)
        return np.array(rows, np.intp)


def previous_values(values: Floats, first: float | None) -> Floats:
    """Return the previous value of each value, (k,).

    Args:
        first: the value before the first; None to use the first value itself.
    """
    previous = np.empty_like(values)
    if first is None:
        previous[:1] = values[:1]
    else:
        previous[:1] = first
    previous[1:] = values[:-1]
    return previous


def _reduce_to_turn(angles: Floats, full: float) -> Floats:
    """Return angles modulo a whole turn, in [0, full), as a read-only array."""
    # This is faster than `np.mod`, and has the same result.
    outside = np.flatnonzero((angles < 0) | (angles >= full))
    if not len(outside):
        return angles
    if 8 * len(outside) < len(angles):
        folded = angles.copy()
        folded[outside] = _reduce_to_turn(angles[outside], full)
        return folded
    turns = angles / full
    np.floor(turns, out=turns)
    turns *= full
    return np.subtract(angles, turns, out=turns)


def _was_away(behind: Floats, full: float) -> bool:
    """Return whether any angle is more than `MIN_TURNS_AWAY` away from 0.

    Args:
        behind: the angles, from 0 to `full`.
        full: a whole turn in the unit of the angles.
    """
    low = full * MIN_TURNS_AWAY
    high = full * (1 - MIN_TURNS_AWAY)
    if len(behind) and low < behind[len(behind) // 2] < high:
        return True
    return bool(((behind > low) & (behind < high)).any())
