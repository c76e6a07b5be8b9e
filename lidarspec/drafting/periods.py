"""Find frames and steadily changing fields in unknown bytes.

`find_structure` finds the frames. Frames of one length cause a distance at which many bytes are
equal. Their sync bytes are then the longest run of constant bytes. Frames of several lengths cause
a frequent pair of bytes, at distances that a length field after the pair explains.

`find_rising_fields` finds counters, angles that wrap at a full circle, and clocks. Such a field
rises from frame to frame by about the same step. With the wrong byte order or offset it jumps
instead. The value at which an angle wraps gives its unit: an angle in hundredths of a degree never
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
from lidarspec.drafting.samples import ChecksumMatch, values
from lidarspec.spec.checksums import ByteOrder

Kind = Literal["counter", "angle", "rising"]

#: Full circle in raw units -> one unit in degrees, and in words.
CIRCLES = {
    360: (1.0, "whole degrees"),
    3_600: (0.1, "tenths of a degree"),
    5_760: (1 / 16, "sixteenths of a degree"),
    23_040: (1 / 64, "1/64 of a degree"),
    36_000: (0.01, "hundredths of a degree"),
    46_080: (1 / 128, "1/128 of a degree, or 1/64 with a flag in the lowest bit"),
    360_000: (0.001, "thousandths of a degree"),
    3_600_000: (0.0001, "1/10 000 of a degree"),
}
#: With fewer frames than this, only the first and last bytes of a frame are searched for fields.
FEW = 8
#: Number of first bytes that are searched then.
FRONT = 16
#: Number of offsets at the end that are searched then.
BACK = 8
#: Smallest share of regular steps.
MIN_REGULAR_SHARE = 0.9
#: Relative difference of two steps that counts as regular.
STEP_TOLERANCE = 0.05
#: Absolute difference of two steps that always counts as regular, in raw units.
STEP_SLACK_UNITS = 4
#: The steps have to be less even by this factor without the lowest byte of a field.
MIN_COARSENING = 1.5
#: Largest ratio of a step to the usual step, and smallest ratio of the value range to a usual step.
MAX_STEP_RATIO = 4
#: Largest share of frames in which the value may stay the same, as in two returns of one firing.
MAX_UNCHANGED_SHARE = 0.75
#: Number of bytes of a stream that are searched.
MAX_SEARCHED_BYTES = 1 << 15
#: Shortest and longest frame length that is searched, in bytes.
SHORTEST = 4
LONGEST = 4096
#: Number of distances that are tried as frame length.
MAX_DISTANCES = 48
#: Smallest share of frames in which a constant byte has its usual value; the others may be damaged.
STEADY = 0.9
#: Smallest share of the bytes that has to be in frames.
MIN_SHARE = 0.5
#: Shares that differ by less than this count as equal.
SHARE_TOLERANCE = 0.03
#: Number of frames that decides between one length and several: fewer may be coincidence.
MANY = 12
#: Smallest ratio of a shorter period's weight to the best weight, for the shorter one to be used.
MIN_RELATIVE_WEIGHT = 0.75
#: Number of byte pairs that are tried as sync bytes.
MAX_SYNC_PAIRS = 32
#: Smallest number of frames of a structure.
MIN_FRAMES = 3
#: A structure is refused if random bytes show one like it with a higher probability.
CHANCE = 1e-3
#: The length field has to begin before this offset.
HEADER = 8
#: Largest size of the elements that a length field counts, in bytes.
MAX_UNIT_BYTES = 16


@dataclass(frozen=True)
class RisingField:
    """A field that changes like a counter, an angle or a clock.

    Attributes:
        offset, size, order: position in the frame or block, in bytes, and byte order.
        kind: "counter" rises by one each time; "angle" wraps at a full circle; "rising" is any
            other field that rises.
        circle: the value at which the field wraps; 0 if no wrap was seen.
        steps: the smallest, usual and largest step.
        right, total: the number of regular steps, and of all steps.
        wraps: the number of wraps.
        first: the value of a counter after a wrap.
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
        """The offset after the field."""
        return self.offset + self.size

    @property
    def name(self) -> str:
        """The provisional name of the field in a draft."""
        return f"{self.kind}_{self.offset}"

    def why(self, what: str = "frame") -> str:
        """Describe the evidence; `what` is "frame" or "block"."""
        low, usual, high = self.steps
        if low == high:
            by = f"{usual}"
        else:
            by = f"{low} to {high}"
        text = f"rises by {by} from {what} to {what}, in {self.right} of {self.total}"
        if self.kind == "angle":
            return f"{text}, wraps at {self.circle}: {CIRCLES[self.circle][1]}?"
        if not self.wraps:
            return f"{text}; no wrap found"
        if self.kind == "counter":
            return f"{text}, wraps from {self.circle - 1} to {self.first}"
        return f"{text}, wraps at about {self.circle}"


def find_rising_fields(rows: NDArray[np.uint8]) -> list[RisingField]:
    """Return the rising fields of consecutive frames, without overlaps, by offset.

    Args:
        rows: the frames, or the first bytes of each, (n, size).
    """
    if len(rows) < 3:
        return []
    fields = sorted(
        _iter_rising_fields(rows),
        key=lambda one: (one.kind == "rising", -one.size, -one.right / one.total, one.offset),
    )
    chosen: list[RisingField] = []
    for one in fields:
        if all(one.end <= other.offset or one.offset >= other.end for other in chosen):
            chosen.append(one)
    return sorted(chosen, key=lambda one: one.offset)


def share_between(first: NDArray[np.int64], last: NDArray[np.int64], circle: int) -> float:
    """Return the share of frames with `last` between this `first` and the next."""
    modulus = circle or 1 << 40
    return float((((last - first)[:-1] % modulus) <= (np.diff(first) % modulus)).mean())


def _iter_rising_fields(rows: NDArray[np.uint8]) -> Iterator[RisingField]:
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
                if all(varied[offset + index] for index in list(from_low)[: size // 2 + 1]):
                    yield from _counter(rows, offset, size, order)
                    yield from _rising(rows, offset, size, order)


def _offsets(rows: NDArray[np.uint8], size: int) -> Iterable[int]:
    last = rows.shape[1] - size
    if len(rows) >= FEW:
        return range(last + 1)
    return sorted({*range(min(FRONT, last + 1)), *range(max(last - BACK, 0), last + 1)})


def _counter(
    rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder
) -> Iterator[RisingField]:
    """Yield a counter: it rises by one each time, and wraps to its smallest value."""
    there = values(rows, offset, size, order)
    steps = np.diff(there)
    first = int(there.min())
    last = int(there.max())
    back = (there[:-1] == last) & (there[1:] == first) & (last > first + 1)
    right = int((steps == 1).sum() + back.sum())
    if right >= MIN_REGULAR_SHARE * len(steps) and (steps == 1).sum() >= 2:
        wraps = int(back.sum())
        yield RisingField(
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
) -> Iterator[RisingField]:
    """Yield a field that rises by about the same step each time."""
    there = values(rows, offset, size, order)
    steps = np.diff(there)
    moved = steps[steps != 0]
    if (
        len(moved) < 2
        or len(moved) < (1 - MAX_UNCHANGED_SHARE) * len(steps)
        or not (moved > 0).any()
    ):
        return
    usual = int(np.median(moved[moved > 0]))
    falls = moved < 0
    wraps = int(falls.sum())
    if wraps > (1 - MIN_REGULAR_SHARE) * len(moved):
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
    within = (forward > 0) & (forward <= MAX_STEP_RATIO * usual)
    if (
        within.mean() < MIN_REGULAR_SHARE
        or np.median(uneven) > max(STEP_SLACK_UNITS, STEP_TOLERANCE * usual)
        or usual * MAX_STEP_RATIO > (circle or 1 << 8 * size)
    ):
        return
    if len(rows) >= FEW and not _low_byte_counts(there):
        return
    regular = forward[within]
    kind: Kind = "angle" if circle in CIRCLES else "rising"
    spread = (int(regular.min()), usual, int(regular.max()))
    right = int(within.sum()) + len(steps) - len(moved)
    yield RisingField(offset, size, order, kind, circle, spread, right, len(steps), wraps)


def _low_byte_counts(there: NDArray[np.int64]) -> bool:
    """Return whether the lowest byte belongs to the field: it makes steps more even."""
    steps = np.diff(there)
    coarse = 256 * np.diff(there >> 8)
    fine, rough = (np.abs(np.diff(each[steps != 0])) for each in (steps, coarse))
    forward = steps[steps != 0] > 0
    both = forward[1:] & forward[:-1]
    return bool(both.any()) and bool(rough[both].mean() > MIN_COARSENING * fine[both].mean())


def _circle(highest: int, fallen: int, usual: int) -> int:
    """Return the value at which a field wraps.

    This is a full circle if the highest value and the fall are close to one, else the fall itself.

    Args:
        highest: the highest value.
        fallen: the usual decrease at a wrap, plus one step.
        usual: the usual step.
    """
    near = [
        circle
        for circle in CIRCLES
        if highest < circle <= highest + 3 * usual and abs(fallen - circle) <= 3 * usual
    ]
    return min(near, key=lambda circle: abs(fallen - circle), default=fallen)


@dataclass(frozen=True)
class LengthField:
    """A length field in the header of a frame.

    The frame length is `rest` + `unit` times the number of `size` bytes at `place`.
    """

    place: int
    size: int
    order: ByteOrder
    unit: int
    rest: int

    @property
    def end(self) -> int:
        """The offset after the number."""
        return self.place + self.size

    def read(self, frame: bytes) -> int:
        """Return the frame length from the length field of a frame."""
        return self.rest + self.unit * int.from_bytes(frame[self.place : self.end], self.order)

    def __str__(self) -> str:
        if self.size == 1:
            kind = "byte"
        else:
            kind = f"{self.order}-endian word"
        return f"{self.rest} + {self.unit} x {kind} at {self.place}"


@dataclass(frozen=True)
class FrameStructure:
    """The likely frames in unknown bytes.

    Attributes:
        sync: the first bytes of each frame.
        period: the length of the frames; None if it varies.
        length: the length field, if the length varies.
        share: the share of the bytes that are in frames.
        frames: the frames.
    """

    sync: bytes
    period: int | None
    length: LengthField | None
    share: float
    frames: tuple[bytes, ...]

    @cached_property
    def checksums(self) -> tuple[ChecksumMatch, ...]:
        """The checksums that fit, likeliest first, found in about a second of search."""
        return tuple(search(self.frames, quick=True))


def find_structure(chunks: Sequence[bytes], *, datagrams: bool) -> FrameStructure | None:
    """Return the likely structure of unknown bytes; None if none is found.

    Args:
        chunks: datagrams, or pieces of a stream.
        datagrams: whether the chunks are datagrams.
    """
    if datagrams:
        return _find_in_datagrams(chunks)
    return _find_in_stream(np.frombuffer(b"".join(chunks)[:MAX_SEARCHED_BYTES], np.uint8))


def usual_bytes(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the most frequent value of each column, (n,)."""
    return np.array([np.bincount(column, minlength=256).argmax() for column in rows.T], np.uint8)


def find_runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return start and stop of each run of True."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def split_frames(data: bytes, period: int, start: int = 0) -> list[bytes]:
    """Split data into frames of one length; an incomplete last one is left out."""
    return [data[first : first + period] for first in range(start, len(data) - period + 1, period)]


def _find_in_datagrams(chunks: Sequence[bytes]) -> FrameStructure | None:
    """Return the structure of the datagrams with the length that most bytes are in."""
    if len(chunks) < MIN_FRAMES:
        return None
    lengths, counts = np.unique([len(chunk) for chunk in chunks], return_counts=True)
    length = int(lengths[(lengths * counts).argmax()])
    frames = [chunk for chunk in chunks if len(chunk) == length]
    if len(frames) < MIN_FRAMES or length == 0:
        return None
    rows = np.frombuffer(b"".join(frames), np.uint8).reshape(len(frames), length)
    steady = (rows == rows[0]).all(axis=0)
    sync = frames[0][: int(np.argmin(steady)) if not steady.all() else length][:16]
    return FrameStructure(
        sync, length, None, len(frames) * length / sum(map(len, chunks)), tuple(frames)
    )


def _find_in_stream(data: NDArray[np.uint8]) -> FrameStructure | None:
    """Return the structure that explains more bytes; prefer one length."""
    periodic = _find_fixed_length(data)
    varying = _find_varying_length(data)
    if periodic is None or varying is None:
        return periodic or varying
    few = len(periodic.frames) < MANY <= len(varying.frames)
    if varying.share > periodic.share + SHARE_TOLERANCE or few:
        return varying
    return periodic


def _find_fixed_length(data: NDArray[np.uint8]) -> FrameStructure | None:
    """Return frames of one length.

    Of the distances at which most bytes are equal, select the one with the largest share of
    constant bytes, or a shorter one that is almost as good.
    """
    lags = np.arange(SHORTEST, min(LONGEST, len(data) // MIN_FRAMES) + 1)
    equal = np.array([float((data[lag:] == data[:-lag]).mean()) for lag in lags])
    likely = lags[np.argsort(equal)[::-1][:MAX_DISTANCES]].tolist()
    framed = [
        (weight, structure)
        for lag in likely
        for weight, structure in _iter_frames_of_length(data, lag)
        if structure.share > MIN_SHARE
    ]
    best = max((weight for weight, _ in framed), default=0.0)
    shortest = min(
        (structure for weight, structure in framed if weight > MIN_RELATIVE_WEIGHT * best),
        key=lambda structure: structure.period or 0,
        default=None,
    )
    if shortest is None:
        return None
    return _split_groups(data, shortest)


def _split_groups(data: NDArray[np.uint8], whole: FrameStructure) -> FrameStructure:
    """Split frames that are groups of shorter frames; return others unchanged.

    A group repeats if, for example, an index runs from 0 to 5, or the data is simulated. A part
    counts as a frame if its sync bytes have different values, or if it has a counter.
    """
    period = whole.period or 0
    for part in (part for part in range(SHORTEST, period // 2 + 1) if period % part == 0):
        for _, structure in _iter_frames_of_length(data, part):
            if structure.share > whole.share - SHARE_TOLERANCE and (
                len(set(structure.sync)) > 1 or _is_counted(structure)
            ):
                return structure
    return whole


def _is_counted(structure: FrameStructure) -> bool:
    rows = np.frombuffer(b"".join(structure.frames), np.uint8).reshape(len(structure.frames), -1)
    return any(one.kind == "counter" for one in find_rising_fields(rows))


def _iter_frames_of_length(
    data: NDArray[np.uint8], period: int
) -> Iterator[tuple[float, FrameStructure]]:
    """Yield frames of this length and their weight; nothing if there are none.

    The frames begin with the longest run of constant bytes. The weight is the share of constant
    bytes, multiplied by the share of bytes in frames.
    """
    count = len(data) // period
    rows = data[: count * period].reshape(count, period)
    usual = usual_bytes(rows)
    if count >= 2 * MIN_FRAMES:
        steady = (rows == usual).mean(axis=0) >= STEADY
    else:
        steady = (rows == usual).all(axis=0)
    steady_count = int((steady & (usual != 0)).sum())
    if steady_count == 0 or steady.all() or _is_chance(data, steady_count, count, period):
        return
    start, length = _longest_run(steady, usual)
    sync = bytes(np.roll(usual, -start)[:length])
    frames = [
        frame for frame in split_frames(data.tobytes(), period, start) if frame.startswith(sync)
    ]
    if len(frames) >= MIN_FRAMES:
        share = len(frames) * period / len(data)
        yield (
            share * steady_count / period,
            FrameStructure(sync[:16], period, None, share, tuple(frames)),
        )


def _is_chance(data: NDArray[np.uint8], steady: int, count: int, period: int) -> bool:
    """Return whether random bytes are likely to show such a structure.

    The random bytes have the same shares of values. Chernoff's bound gives the probability of as
    many steady bytes at one period; all periods that are tried count.

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
    periods = min(LONGEST, len(data) // MIN_FRAMES)
    return math.log(periods) + log_of_one > math.log(CHANCE)


def _longest_run(steady: NDArray[np.bool_], usual: NDArray[np.uint8]) -> tuple[int, int]:
    """Return start and length of the run with the most nonzero constant bytes.

    A run may continue from the end of the period to its start. Zeros at the start of a run are left
    out, since they are frequent in any data.
    """
    turn = int(np.argmin(steady))  # rotate to a byte that is not constant, so that no run is split
    best = (-1, 0, 0)
    for start, end in find_runs(np.roll(steady, -turn)):
        run = np.roll(usual, -turn)[start:end]
        zeros = int(np.argmax(run != 0)) if run.any() else 0
        best = max(
            best,
            (int(np.count_nonzero(run)), -((turn + start + zeros) % len(usual)), len(run) - zeros),
        )
    return -best[1], best[2]


def _find_varying_length(data: NDArray[np.uint8]) -> FrameStructure | None:
    """Return frames of several lengths, with a length field in the header."""
    pairs = data[:-1].astype(np.int64) << 8 | data[1:]
    counts = np.bincount(pairs, minlength=1 << 16)
    best: tuple[float, int, FrameStructure] | None = None
    for pair in np.argsort(counts)[::-1][:MAX_SYNC_PAIRS].tolist():
        starts = np.flatnonzero(pairs == pair)
        if pair in (0, 0xFFFF) or len(starts) < 2 * MIN_FRAMES:
            continue
        structure = _find_length_field(data, starts, bytes([pair >> 8, pair & 0xFF]))
        if structure is None:
            continue
        # Several pairs of a header explain the lengths equally well. Use the one that occurs first,
        # since captures often begin with a frame.
        begins = int(starts[0])
        if (
            best is None
            or structure.share > best[0] + SHARE_TOLERANCE
            or (structure.share > best[0] - SHARE_TOLERANCE and begins < best[1])
        ):
            best = (structure.share, begins, structure)
    if best is not None and best[0] > MIN_SHARE:
        return best[2]
    return None


def _find_length_field(
    data: NDArray[np.uint8], starts: NDArray[np.intp], sync: bytes
) -> FrameStructure | None:
    """Return the frames between sync bytes that a length field explains.

    The length field is the byte or word after the sync bytes that gives most lengths.

    Args:
        starts: offsets of the sync bytes.
    """
    starts = starts[starts + HEADER + 2 < len(data)]
    steps = np.diff(starts)
    if len(steps) < MIN_FRAMES:
        return None
    best: tuple[float, LengthField | None, NDArray[np.bool_]] = (0.0, None, np.zeros(0, np.bool_))
    kinds: tuple[tuple[int, ByteOrder], ...] = ((1, "little"), (2, "little"), (2, "big"))
    for place in range(2, HEADER):
        low = data[starts[:-1] + place].astype(np.int64)
        high = data[starts[:-1] + place + 1].astype(np.int64)
        for (size, order), numbers in zip(
            kinds, (low, low | high << 8, high | low << 8), strict=True
        ):
            for unit in range(1, MAX_UNIT_BYTES + 1):
                rest = steps - unit * numbers
                usual, number = _most_frequent(rest)
                fits = rest == usual
                distinct = len(np.unique(steps[fits]))
                share = float(steps[fits].sum() / len(data))
                if distinct > 1 and number >= MIN_FRAMES and usual >= 0 and share > best[0]:
                    best = (share, LengthField(place, size, order, unit, usual), fits)
    share, length, fits = best
    if length is None:
        return None
    whole = data.tobytes()
    frames = [
        whole[start : start + step]
        for start, step in zip(starts[:-1][fits].tolist(), steps[fits].tolist(), strict=True)
    ]
    return FrameStructure(sync, None, length, share, tuple(frames))


def _most_frequent(numbers: NDArray[np.int64]) -> tuple[int, int]:
    distinct, counts = np.unique(numbers, return_counts=True)
    return int(distinct[counts.argmax()]), int(counts.max())
