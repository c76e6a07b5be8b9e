"""Fields of unknown frames that show by how they change: counters, angles that wrap at a full circle, clocks.

A field that rises from frame to frame does so by about the same step each time; the wrong byte order, or a field read one byte
off, jumps. What it falls back from tells its scale: an angle in hundredths of a degree never reaches 36 000.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.checksums import ByteOrder

Kind = Literal["counter", "angle", "rising"]

#: full circles on the wire -> what one unit of them is, in degrees, and in words.
CIRCLES = {
    360: (1.0, "whole degrees"),
    3_600: (0.1, "tenths of a degree"),
    5_760: (1 / 16, "sixteenths of a degree"),
    23_040: (1 / 64, "1/64 of a degree"),
    36_000: (0.01, "hundredths of a degree"),
    46_080: (1 / 128, "1/128 of a degree, or 1/64 above a bit of its own"),
    360_000: (0.001, "thousandths of a degree"),
    3_600_000: (0.0001, "1/10 000 of a degree"),
}
#: frames below which only the ends of a frame are looked at, and how far these go.
FEW, FRONT, BACK = 8, 16, 8
#: share of the steps that has to be regular, by which share of a step they may differ, and units that they always may.
MOST, EVEN, GRAIN = 0.9, 0.05, 4
#: how much less even steps have to be without the lowest byte.
ROUGH = 1.5
#: part of all values that a step may be, and share of frames in which something may stay as it is (two returns of one firing).
WIDE, STILL = 4, 0.75


@dataclass(frozen=True)
class Candidate:
    """A field that changes as counters, angles or clocks do.

    Attributes:
        offset, size, order: where it stands in a frame or block, and how it is read.
        kind: "counter" rises by one each time; "angle" wraps at a full circle; "rising" is anything else that rises.
        circle: what it wraps at, 0 where it was not seen to wrap.
        steps: the smallest, usual and largest step.
        right, total: steps that are regular, and all.
        wraps: how often it fell back.
        first: what a counter falls back to.
    """

    offset: int
    size: int
    order: ByteOrder
    kind: Kind
    circle: int
    steps: tuple[int, int, int]
    right: int
    total: int
    wraps: int
    first: int = 0

    @property
    def end(self) -> int:
        """The first byte behind it."""
        return self.offset + self.size

    @property
    def name(self) -> str:
        """What it is called until somebody knows better."""
        return f"{self.kind}_{self.offset}"

    def why(self, what: str = "frame") -> str:
        """The evidence in words; `what` it rises with."""
        low, usual, high = self.steps
        by = f"{usual}" if low == high else f"{low} to {high}"
        text = f"rises by {by} from {what} to {what}, in {self.right} of {self.total}"
        if self.kind == "angle":
            return f"{text}, wraps at {self.circle}: {CIRCLES[self.circle][1]}?"
        if not self.wraps:
            return f"{text}; not seen to start again"
        if self.kind == "counter":
            return f"{text}, from {self.circle - 1} back to {self.first}"
        return f"{text}, starts again at about {self.circle}"


def candidates(rows: NDArray[np.uint8]) -> list[Candidate]:
    """The fields that rise, without overlaps, in the order of the frame.

    Args:
        rows: frames that follow each other, or as much of their beginnings as they have in common, shape (n, size).
    """
    if len(rows) < 3:
        return []
    found = sorted(_all(rows), key=lambda one: (one.kind == "rising", -one.size, -one.right / one.total, one.offset))
    chosen: list[Candidate] = []
    for one in found:
        if all(one.end <= other.offset or one.offset >= other.end for other in chosen):
            chosen.append(one)
    return sorted(chosen, key=lambda one: one.offset)


def values(rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder) -> NDArray[np.int64]:
    """What stands at a place in each row."""
    columns = rows[:, offset : offset + size].astype(np.int64)
    shifts = 8 * np.arange(size, dtype=np.int64)
    total: NDArray[np.int64] = (columns << (shifts if order == "little" else shifts[::-1])).sum(axis=1)
    return total


def follows(first: NDArray[np.int64], last: NDArray[np.int64], circle: int) -> float:
    """The share of frames in which `last` lies between this frame's `first` and the next one's."""
    modulus = circle or 1 << 40
    return float((((last - first)[:-1] % modulus) <= (np.diff(first) % modulus)).mean())


def _all(rows: NDArray[np.uint8]) -> Iterator[Candidate]:
    varied = (rows != rows[0]).any(axis=0)
    for offset in _offsets(rows, 1):
        if varied[offset] and len(rows) >= FEW:
            yield from _counter(rows, offset, 1, "little")
    orders: tuple[ByteOrder, ...] = ("little", "big")
    for size in (2, 4) if len(rows) >= FEW else (2,):
        for offset in _offsets(rows, size):
            for order in orders:
                from_low = range(size) if order == "little" else range(size - 1, -1, -1)
                if all(varied[offset + spot] for spot in list(from_low)[: size // 2 + 1]):
                    yield from _counter(rows, offset, size, order)
                    yield from _rising(rows, offset, size, order)


def _offsets(rows: NDArray[np.uint8], size: int) -> Iterable[int]:
    last = rows.shape[1] - size
    if len(rows) >= FEW:
        return range(last + 1)
    return sorted({*range(min(FRONT, last + 1)), *range(max(last - BACK, 0), last + 1)})


def _counter(rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder) -> Iterator[Candidate]:
    """What rises by one each time, and falls back to where it began."""
    there = values(rows, offset, size, order)
    steps, first, last = np.diff(there), int(there.min()), int(there.max())
    back = (there[:-1] == last) & (there[1:] == first) & (last > first + 1)
    right = int((steps == 1).sum() + back.sum())
    if right >= MOST * len(steps) and (steps == 1).sum() >= 2:
        wraps = int(back.sum())
        yield Candidate(offset, size, order, "counter", last + 1 if wraps else 0, (1, 1, 1), right, len(steps), wraps, first)


def _rising(rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder) -> Iterator[Candidate]:
    """What rises by about the same step each time."""
    there = values(rows, offset, size, order)
    steps = np.diff(there)
    moved = steps[steps != 0]
    if len(moved) < 2 or len(moved) < (1 - STILL) * len(steps) or not (moved > 0).any():
        return
    usual = int(np.median(moved[moved > 0]))
    falls = moved < 0
    wraps = int(falls.sum())
    if wraps > (1 - MOST) * len(moved):
        return
    circle = _circle(int(there.max()), int(np.median(usual - moved[falls])), usual) if wraps else 0
    forward = np.where(falls, moved + circle, moved) if circle else moved
    uneven = np.abs(np.diff(forward))
    within = (forward > 0) & (forward <= WIDE * usual)
    if within.mean() < MOST or np.median(uneven) > max(GRAIN, EVEN * usual) or usual * WIDE > (circle or 1 << 8 * size):
        return
    if len(rows) >= FEW and not _low_byte_counts(there):
        return
    regular = forward[within]
    kind: Kind = "angle" if circle in CIRCLES else "rising"
    spread = (int(regular.min()), usual, int(regular.max()))
    right = int(within.sum()) + len(steps) - len(moved)
    yield Candidate(offset, size, order, kind, circle, spread, right, len(steps), wraps)


def _low_byte_counts(there: NDArray[np.int64]) -> bool:
    """Whether the steps become less even without the lowest byte: else it belongs to something else."""
    steps, coarse = np.diff(there), 256 * np.diff(there >> 8)
    fine, rough = (np.abs(np.diff(each[steps != 0])) for each in (steps, coarse))
    forward = steps[steps != 0] > 0
    both = forward[1:] & forward[:-1]
    return bool(both.any()) and bool(rough[both].mean() > ROUGH * fine[both].mean())


def _circle(highest: int, fallen: int, usual: int) -> int:
    """What a field wraps at: a full circle that it comes near to and never reaches, else about as much as it was seen to fall."""
    near = [circle for circle in CIRCLES if highest < circle <= highest + 3 * usual and abs(fallen - circle) <= 3 * usual]
    return min(near, key=lambda circle: abs(fallen - circle), default=fallen)
