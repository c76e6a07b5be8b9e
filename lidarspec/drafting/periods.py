"""What unknown bytes are made of: where frames may begin, how long they are, which checksum seals
them, and which fields change steadily.

Frames of one length show as a distance at which many bytes are equal; their sync bytes are then the
longest run of bytes that never change. Frames of several lengths show as a pair of bytes that comes
again and again, at distances that a length field in front of each frame explains.

Counters, angles that wrap at a full circle and clocks show by how they change: such a field rises
from frame to frame by about the same step each time; the wrong byte order, or a field read one byte
off, jumps. What it falls back from tells its scale: an angle in hundredths of a degree never
reaches 36 000.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.drafting.checksum_search import search
from lidarspec.drafting.samples import Match, values
from lidarspec.spec.checksums import ByteOrder

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
FEW = 8
FRONT = 16
BACK = 8
#: share of the steps that has to be regular, by which share of a step they may differ, and units
#: that they always may.
MOST = 0.9
EVEN = 0.05
GRAIN = 4
#: how much less even steps have to be without the lowest byte.
ROUGH = 1.5
#: part of all values that a step may be, and share of frames in which something may stay as it is
#: (two returns of one firing).
WIDE = 4
STILL = 0.75
#: bytes that are looked at, and the shortest and longest period.
LOOKED_AT = 1 << 15
SHORTEST = 4
LONGEST = 4096
#: distances that are tried as a length, and the share of frames in which a byte that never changes
#: is the same.
LAGS = 48
STEADY = 0.9
#: share of the bytes that has to be in frames, shares that are about the same, and many frames.
HALF = 0.5
CLOSE = 0.03
MANY = 12
#: part of the best weight that a shorter period needs.
ALIKE = 0.75
#: pairs of bytes that are tried as sync bytes, and frames that a structure needs.
PAIRS = 32
FRAMES = 3
#: A structure is refused if random bytes show one like it with a higher probability.
CHANCE = 1e-3
#: bytes behind the sync that may hold a length, and the largest size of one unit of it.
HEADER = 8
UNIT = 16


@dataclass(frozen=True)
class Candidate:
    """A field that changes as counters, angles or clocks do.

    Attributes:
        offset, size, order: where it stands in a frame or block, and how it is read.
        kind: "counter" rises by one each time; "angle" wraps at a full circle; "rising" is anything
            else that rises.
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
        if low == high:
            by = f"{usual}"
        else:
            by = f"{low} to {high}"
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
        rows: frames that follow each other, or as much of their beginnings as they have in common,
            shape (n, size).
    """
    if len(rows) < 3:
        return []
    found = sorted(
        _all(rows),
        key=lambda one: (one.kind == "rising", -one.size, -one.right / one.total, one.offset),
    )
    chosen: list[Candidate] = []
    for one in found:
        if all(one.end <= other.offset or one.offset >= other.end for other in chosen):
            chosen.append(one)
    return sorted(chosen, key=lambda one: one.offset)


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
                if order == "little":
                    from_low = range(size)
                else:
                    from_low = range(size - 1, -1, -1)
                if all(varied[offset + spot] for spot in list(from_low)[: size // 2 + 1]):
                    yield from _counter(rows, offset, size, order)
                    yield from _rising(rows, offset, size, order)


def _offsets(rows: NDArray[np.uint8], size: int) -> Iterable[int]:
    last = rows.shape[1] - size
    if len(rows) >= FEW:
        return range(last + 1)
    return sorted({*range(min(FRONT, last + 1)), *range(max(last - BACK, 0), last + 1)})


def _counter(
    rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder
) -> Iterator[Candidate]:
    """What rises by one each time, and falls back to where it began."""
    there = values(rows, offset, size, order)
    steps = np.diff(there)
    first = int(there.min())
    last = int(there.max())
    back = (there[:-1] == last) & (there[1:] == first) & (last > first + 1)
    right = int((steps == 1).sum() + back.sum())
    if right >= MOST * len(steps) and (steps == 1).sum() >= 2:
        wraps = int(back.sum())
        yield Candidate(
            offset,
            size,
            order,
            "counter",
            last + 1 if wraps else 0,
            (1, 1, 1),
            right,
            len(steps),
            wraps,
            first,
        )


def _rising(
    rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder
) -> Iterator[Candidate]:
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
    if wraps:
        circle = _circle(int(there.max()), int(np.median(usual - moved[falls])), usual)
    else:
        circle = 0
    if circle:
        forward = np.where(falls, moved + circle, moved)
    else:
        forward = moved
    uneven = np.abs(np.diff(forward))
    within = (forward > 0) & (forward <= WIDE * usual)
    if (
        within.mean() < MOST
        or np.median(uneven) > max(GRAIN, EVEN * usual)
        or usual * WIDE > (circle or 1 << 8 * size)
    ):
        return
    if len(rows) >= FEW and not _low_byte_counts(there):
        return
    regular = forward[within]
    kind: Kind = "angle" if circle in CIRCLES else "rising"
    spread = (int(regular.min()), usual, int(regular.max()))
    right = int(within.sum()) + len(steps) - len(moved)
    yield Candidate(offset, size, order, kind, circle, spread, right, len(steps), wraps)


def _low_byte_counts(there: NDArray[np.int64]) -> bool:
    """Whether the steps become less even without the lowest byte: else it belongs to something
    else.
    """
    steps = np.diff(there)
    coarse = 256 * np.diff(there >> 8)
    fine, rough = (np.abs(np.diff(each[steps != 0])) for each in (steps, coarse))
    forward = steps[steps != 0] > 0
    both = forward[1:] & forward[:-1]
    return bool(both.any()) and bool(rough[both].mean() > ROUGH * fine[both].mean())


def _circle(highest: int, fallen: int, usual: int) -> int:
    """What a field wraps at: a full circle that it comes near to and never reaches, else about as
    much as it was seen to fall.
    """
    near = [
        circle
        for circle in CIRCLES
        if highest < circle <= highest + 3 * usual and abs(fallen - circle) <= 3 * usual
    ]
    return min(near, key=lambda circle: abs(fallen - circle), default=fallen)


@dataclass(frozen=True)
class Length:
    """What a header says of the length of its frame: `rest` + `unit` times the number of `size`
    bytes at `place`.
    """

    place: int
    size: int
    order: ByteOrder
    unit: int
    rest: int

    @property
    def end(self) -> int:
        """The first byte behind the number."""
        return self.place + self.size

    def of(self, frame: bytes) -> int:
        """The length that a frame says it has."""
        return self.rest + self.unit * int.from_bytes(frame[self.place : self.end], self.order)

    def __str__(self) -> str:
        if self.size == 1:
            kind = "byte"
        else:
            kind = f"{self.order}-endian word"
        return f"{self.rest} + {self.unit} x {kind} at {self.place}"


@dataclass(frozen=True)
class Structure:
    """Frames that unknown bytes seem to consist of.

    Attributes:
        sync: bytes that each begins with.
        period: their length; None where it varies.
        length: how they say it, where it varies.
        share: share of the bytes that are in them.
        frames: the frames.
    """

    sync: bytes
    period: int | None
    length: Length | None
    share: float
    frames: tuple[bytes, ...]

    @cached_property
    def checksums(self) -> tuple[Match, ...]:
        """The checksums that fit, the likeliest first, as far as a second of search finds them."""
        return tuple(search(self.frames, quick=True))


def structure(chunks: Sequence[bytes], *, datagrams: bool) -> Structure | None:
    """The likely structure of unknown bytes, None where there is none to be seen.

    Args:
        chunks: datagrams, or pieces of a stream.
    """
    if datagrams:
        return _of_datagrams(chunks)
    return _of_stream(np.frombuffer(b"".join(chunks)[:LOOKED_AT], np.uint8))


def usual_bytes(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The commonest value of each column, (n,)."""
    return np.array([np.bincount(column, minlength=256).argmax() for column in rows.T], np.uint8)


def runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Where each run of True begins, and the first place behind it."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def cut(data: bytes, period: int, start: int = 0) -> list[bytes]:
    """Whole frames of one length."""
    return [data[first : first + period] for first in range(start, len(data) - period + 1, period)]


def _of_datagrams(chunks: Sequence[bytes]) -> Structure | None:
    """The datagrams of the commonest length, with the bytes that they begin with."""
    if len(chunks) < FRAMES:
        return None
    lengths, counts = np.unique([len(chunk) for chunk in chunks], return_counts=True)
    length = int(lengths[(lengths * counts).argmax()])
    frames = [chunk for chunk in chunks if len(chunk) == length]
    if len(frames) < FRAMES or length == 0:
        return None
    rows = np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), length)
    steady = (rows == rows[0]).all(axis=0)
    sync = frames[0][: int(np.argmin(steady)) if not steady.all() else length][:16]
    return Structure(
        sync, length, None, len(frames) * length / sum(map(len, chunks)), tuple(frames)
    )


def _of_stream(data: NDArray[np.uint8]) -> Structure | None:
    """The reading that explains more of the bytes; one length for all frames is the simpler one."""
    periodic = _periodic(data)
    varying = _by_length(data)
    if periodic is None or varying is None:
        return periodic or varying
    few = len(periodic.frames) < MANY <= len(varying.frames)
    if varying.share > periodic.share + CLOSE or few:
        return varying
    return periodic


def _periodic(data: NDArray[np.uint8]) -> Structure | None:
    """Frames of one length: of the distances at which most bytes are equal, the one at which the
    most stay the same all along.
    """
    lags = np.arange(SHORTEST, min(LONGEST, len(data) // FRAMES) + 1)
    equal = np.array([float((data[lag:] == data[:-lag]).mean()) for lag in lags])
    likely = lags[np.argsort(equal)[::-1][:LAGS]].tolist()
    framed = [
        (weight, found)
        for lag in likely
        for weight, found in _framed(data, lag)
        if found.share > HALF
    ]
    best = max((weight for weight, _ in framed), default=0.0)
    shortest = min(
        (found for weight, found in framed if weight > ALIKE * best),
        key=lambda found: found.period or 0,
        default=None,
    )
    if shortest is None:
        return None
    return _divided(data, shortest)


def _divided(data: NDArray[np.uint8], whole: Structure) -> Structure:
    """The frames of which a whole number repeats together, as turns of an index or in a simulation
    do; else the same.

    They are frames of their own where more than one byte begins them, or one and a counter.
    """
    period = whole.period or 0
    for part in (part for part in range(SHORTEST, period // 2 + 1) if period % part == 0):
        for _, found in _framed(data, part):
            if found.share > whole.share - CLOSE and (
                len(set(found.sync)) > 1 or _is_counted(found)
            ):
                return found
    return whole


def _is_counted(found: Structure) -> bool:
    rows = np.frombuffer(b"".join(found.frames), np.uint8).reshape(len(found.frames), -1)
    return any(one.kind == "counter" for one in candidates(rows))


def _framed(data: NDArray[np.uint8], period: int) -> Iterator[tuple[float, Structure]]:
    """Frames of this length, which begin with the longest run of bytes that are always the same,
    and the share of such bytes.
    """
    count = len(data) // period
    rows = data[: count * period].reshape(count, period)
    usual = usual_bytes(rows)
    if count >= 2 * FRAMES:
        steady = (rows == usual).mean(axis=0) >= STEADY
    else:
        steady = (rows == usual).all(axis=0)
    steady_count = int((steady & (usual != 0)).sum())
    if steady_count == 0 or steady.all() or _is_chance(data, steady_count, count, period):
        return
    start, length = _longest_run(steady, usual)
    sync = bytes(np.roll(usual, -start)[:length])
    frames = [frame for frame in cut(data.tobytes(), period, start) if frame.startswith(sync)]
    if len(frames) >= FRAMES:
        share = len(frames) * period / len(data)
        yield (
            share * steady_count / period,
            Structure(sync[:16], period, None, share, tuple(frames)),
        )


def _is_chance(data: NDArray[np.uint8], steady: int, count: int, period: int) -> bool:
    """Return whether random bytes with the same shares of values would show such a structure as
    well.

    Chernoff's bound gives the probability of so many steady bytes at one period; all periods that
    are tried count.

    Args:
        steady: bytes of a period that are the same in each repetition, and not 0.
        count: repetitions.
    """
    shares = np.bincount(data, minlength=256)[1:] / len(data)
    expected = period * float((shares**count).sum())
    if steady <= expected:
        return True
    if expected == 0:  # below the smallest float, after many repetitions
        return False
    log_of_one = steady - expected - steady * math.log(steady / expected)
    periods = min(LONGEST, len(data) // FRAMES)
    return math.log(periods) + log_of_one > math.log(CHANCE)


def _longest_run(steady: NDArray[np.bool_], usual: NDArray[np.uint8]) -> tuple[int, int]:
    """Start and length of the longest run of steady bytes, around the end too, without zeros in
    front: they tell little.
    """
    turn = int(np.argmin(steady))
    best = (-1, 0, 0)  # the circle is cut where no run is
    for start, end in runs(np.roll(steady, -turn)):
        run = np.roll(usual, -turn)[start:end]
        zeros = int(np.argmax(run != 0)) if run.any() else 0
        best = max(
            best,
            (int(np.count_nonzero(run)), -((turn + start + zeros) % len(usual)), len(run) - zeros),
        )
    return -best[1], best[2]


def _by_length(data: NDArray[np.uint8]) -> Structure | None:
    """Frames of several lengths, whose header says how long they are."""
    pairs = data[:-1].astype(np.int64) << 8 | data[1:]
    counts = np.bincount(pairs, minlength=1 << 16)
    best: tuple[float, int, Structure] | None = None
    for pair in np.argsort(counts)[::-1][:PAIRS].tolist():
        starts = np.flatnonzero(pairs == pair)
        if pair in (0, 0xFFFF) or len(starts) < 2 * FRAMES:
            continue
        found = _explained(data, starts, bytes([pair >> 8, pair & 0xFF]))
        if found is None:
            continue
        begins = int(
            starts[0]
            # of pairs in a header that do as well, the one in front:
            # captures often begin with a frame
        )
        if (
            best is None
            or found.share > best[0] + CLOSE
            or (found.share > best[0] - CLOSE and begins < best[1])
        ):
            best = (found.share, begins, found)
    if best is not None and best[0] > HALF:
        return best[2]
    return None


def _explained(data: NDArray[np.uint8], starts: NDArray[np.intp], sync: bytes) -> Structure | None:
    """Frames from one sync to the next, where a byte or a word behind it tells most of their
    lengths.
    """
    starts = starts[starts + HEADER + 2 < len(data)]
    steps = np.diff(starts)
    if len(steps) < FRAMES:
        return None
    best: tuple[float, Length | None, NDArray[np.bool_]] = (0.0, None, np.zeros(0, np.bool_))
    kinds: tuple[tuple[int, ByteOrder], ...] = ((1, "little"), (2, "little"), (2, "big"))
    for place in range(2, HEADER):
        low = data[starts[:-1] + place].astype(np.int64)
        high = data[starts[:-1] + place + 1].astype(np.int64)
        for (size, order), numbers in zip(
            kinds, (low, low | high << 8, high | low << 8), strict=True
        ):
            for unit in range(1, UNIT + 1):
                rest = steps - unit * numbers
                usual, number = _commonest(rest)
                told = rest == usual
                distinct = len(np.unique(steps[told]))
                share = float(steps[told].sum() / len(data))
                if distinct > 1 and number >= FRAMES and usual >= 0 and share > best[0]:
                    best = (share, Length(place, size, order, unit, usual), told)
    share, length, told = best
    if length is None:
        return None
    whole = data.tobytes()
    frames = [
        whole[start : start + step]
        for start, step in zip(starts[:-1][told].tolist(), steps[told].tolist(), strict=True)
    ]
    return Structure(sync, None, length, share, tuple(frames))


def _commonest(numbers: NDArray[np.int64]) -> tuple[int, int]:
    found, counts = np.unique(numbers, return_counts=True)
    return int(found[counts.argmax()]), int(counts.max())
