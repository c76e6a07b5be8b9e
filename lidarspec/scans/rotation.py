"""Find the rows at which a turning angle passes a given angle.

`WrapDetector` serves sensors whose direction of rotation is unknown: `Rotation` finds it from the
angles. `PassDetector` serves known directions, and angles that skip the one that they pass.

Both decide each row from the rows before it alone, so that the split into batches does not change
the result. An angle has to have been away from the given one before it passes again, so that jitter
does not count twice.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarspec.packets.masked_sector import JITTER

Floats = NDArray[np.float64]

#: turns that an angle has to have been away before it passes again.
MIN_TURNS_AWAY = 1 / 8
#: turns back after which the direction of rotation has changed.
REVERSAL_TURNS = 0.5
#: rows that are searched together at first; if nothing is found, twice as many, and so on.
FIRST_CHUNK_ROWS = 64


class Rotation:
    """The direction in which an angle turns.

    It is the direction of the last half turn, and at the start that of the total so far.
    """

    def __init__(self) -> None:
        self._direction = 0
        self._total = 0.0  # turns since the start
        self._furthest = 0.0  # the largest total in the present direction, times that direction

    def push(self, steps: Floats) -> Floats:
        """Return the direction at each of the next steps, 1 or -1, (k,).

        The length is 1 if the direction is the same for all.

        Args:
            steps: in turns, (k,), at least one.
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
        """Return whether the angle is farther than ever, with no step back afterwards."""
        if self._direction * total < self._furthest:
            return False
        return float((self._direction * steps).min(initial=0.0)) >= 0

    def _find_directions(self, totals: Floats) -> Floats:
        """Return the direction at each total, (k,)."""
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
        """Change the direction, or set the first one by the total so far."""
        if self._direction:
            self._direction = -self._direction
        elif total > 0:
            self._direction = 1
        else:
            self._direction = -1
        self._furthest = self._direction * total


class WrapDetector:
    """Finds the rows at which an angle passes a given angle, in either direction."""

    def __init__(self) -> None:
        self._rotation = Rotation()
        self._angle: float | None = None  # of the row before
        self._is_armed = True

    def push(self, angles: Floats, full: float, at: float) -> tuple[NDArray[np.intp], Floats]:
        """Return the rows at which the angle passes `at`, and the turns by which it advances.

        Args:
            angles: of the next rows, (k,), in any unit; rows with nan are ignored.
            full: a whole turn in this unit.
            at: the angle to pass.
        """
        finite = np.isfinite(angles)
        if not finite.all():
            rows = np.flatnonzero(finite)
            found, steps = self.push(angles[rows], full, at)
            return rows[found], steps
        if not len(angles):
            return np.empty(0, np.intp), np.empty(0)
        before = previous_values(angles, self._angle)
        self._angle = angles.item(-1)
        direction = self._rotation.push((_fold(angles - before + full / 2, full) - full / 2) / full)
        behind = _fold(direction * (angles - at), full)
        if len(direction) == 1:
            first = _fold(direction * (before[:1] - at), full).item()
            behind_earlier = previous_values(behind, first)
        else:
            behind_earlier = _fold(direction * (before - at), full)
        passed = np.flatnonzero(behind_earlier - behind > full / 2)
        found = self._keep_armed(passed, behind, full)
        return found, 1 - (behind_earlier[found] - behind[found]) / full

    def _keep_armed(
        self, passed: NDArray[np.intp], behind: Floats, full: float
    ) -> NDArray[np.intp]:
        """Return the rows, of those that pass, before which the angle was away."""
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
    """Finds the rows at which an angle passes a given angle, which it may skip.

    All angles are in turns.

    Args:
        at: the angle to pass.
        direction: 1 if angles grow, else -1.
    """

    def __init__(self, at: float, direction: int) -> None:
        self._at = at
        self._direction = direction
        self._angle: float | None = None  # of the row before
        self._turned = 1.0  # turns since it passed

    def restart(self, at: float, direction: int, angle: float | None) -> None:
        """Find another angle from now on.

        Args:
            angle: of the row before; None if there is none.
        """
        self._at = at
        self._direction = direction
        self._angle = angle

    def push(self, angles: Floats) -> NDArray[np.intp]:
        """Return the rows at which the angle passes.

        Args:
            angles: of the next rows, (k,).
        """
        if not len(angles):
            return np.empty(0, np.intp)
        before = previous_values(angles, self._angle)
        self._angle = angles.item(-1)
        steps = (self._direction * (angles - before)) % 1
        steps[steps > 1 - JITTER] = 0
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
    """Return the value before each; before the first one `first`, or if that is None itself."""
    previous = np.empty_like(values)
    if first is None:
        previous[:1] = values[:1]
    else:
        previous[:1] = first
    previous[1:] = values[:-1]
    return previous


def _fold(angles: Floats, full: float) -> Floats:
    """Return angles in [0, full), read-only.

    The results equal `np.mod`, in a fraction of its time.
    """
    outside = np.flatnonzero((angles < 0) | (angles >= full))
    if not len(outside):
        return angles
    if 8 * len(outside) < len(angles):
        folded = angles.copy()
        folded[outside] = _fold(angles[outside], full)
        return folded
    turns = angles / full
    np.floor(turns, out=turns)
    turns *= full
    return np.subtract(angles, turns, out=turns)


def _was_away(behind: Floats, full: float) -> bool:
    """Return whether any of these angles is away from 0."""
    low = full * MIN_TURNS_AWAY
    high = full * (1 - MIN_TURNS_AWAY)
    if len(behind) and low < behind[len(behind) // 2] < high:
        return True
    return bool(((behind > low) & (behind < high)).any())
