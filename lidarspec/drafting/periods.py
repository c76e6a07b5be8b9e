"""Find frames in unknown bytes, and fields with steadily rising values.

`find_structure` finds the frames. If all frames have the same length, many bytes repeat at this
interval. If frames have several lengths, a length field gives the distance from the sync bytes to
the next sync bytes.

`find_rising_fields` finds counters, angles and clocks. Their values rise from frame to frame by
about the same step. The value at which an angle wraps gives its unit: an angle in hundredths of a
degree wraps at 36,000.
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
from lidarspec.drafting.samples import ChecksumMatch, read_values
from lidarspec.spec.checksums import ByteOrder

Kind = Literal["counter", "angle", "rising"]

#: For each full circle in raw units, the raw unit in degrees and its description.
FULL_CIRCLES = {
    360: (1.0, "whole degrees"),
    3_600: (0.1, "tenths of a degree"),
    5_760: (1 / 16, "sixteenths of a degree"),
    23_040: (1 / 64, "1/64 of a degree"),
    36_000: (0.01, "hundredths of a degree"),
    46_080: (1 / 128, "1/128 of a degree, or 1/64 with a flag in the lowest bit"),
    360_000: (0.001, "thousandths of a degree"),
    3_600_000: (0.0001, "1/10 000 of a degree"),
}
#: With fewer frames than this, constant bytes may be coincidence. In this case, only the first and
#: the last bytes of a frame are searched for fields.
FEW_FRAMES = 8
#: The number of bytes at the start of frames to search if there are few frames.
HEAD_SEARCH_BYTES = 16
#: The number of offsets at the end of frames to search if there are few frames.
TAIL_SEARCH_BYTES = 8
#: The minimum share of regular steps of a rising field.
MIN_REGULAR_SHARE = 0.9
#: The largest relative difference between regular steps.
STEP_TOLERANCE = 0.05
#: The absolute difference between steps that is regular at any step size, in raw units.
STEP_SLACK_UNITS = 4
#: Without the lowest byte of a field, its steps must vary more by at least this factor.
MIN_COARSENING = 1.5
#: The maximum ratio of a step to the usual step. The ratio of a field's range of values to the
#: usual step must be at least this.
MAX_STEP_RATIO = 4
#: The maximum share of frames with the same value as the frame before, for example with two returns
#: per firing.
MAX_UNCHANGED_SHARE = 0.75
#: The maximum number of bytes of a stream to search.
MAX_SEARCHED_BYTES = 1 << 15
#: The minimum frame length to search for. The next constant is the maximum frame length.
MIN_FRAME_BYTES = 4
MAX_FRAME_BYTES = 4096
#: The maximum number of distances to try as frame length.
MAX_DISTANCES = 48
#: A byte is constant if it has its usual value in at least this share of frames. The other frames
#: may be damaged.
MIN_CONSTANT_SHARE = 0.9
#: The minimum share of the bytes that must be in frames.
MIN_FRAMED_SHARE = 0.5
#: Shares that differ by less than this are treated as equal.
SHARE_TOLERANCE = 0.03
#: A structure with frames of several lengths is preferred if it has at least this number of frames,
#: and if the structure with frames of equal length has fewer frames than this.
MANY_FRAMES = 12
#: Of the periods whose weight is at least this share of the best weight, the shortest is used.
MIN_RELATIVE_WEIGHT = 0.75
#: The maximum number of byte pairs to try as sync bytes.
MAX_SYNC_PAIRS = 32
#: The smallest number of frames of a structure.
MIN_FRAMES = 3
#: A structure is rejected if the probability that random bytes have it is higher than this.
MAX_CHANCE_PROBABILITY = 1e-3
#: The length field must begin before this offset.
MAX_LENGTH_FIELD_OFFSET = 8
#: The maximum size of the elements that a length field counts, in bytes.
MAX_UNIT_BYTES = 16


@dataclass(frozen=True)
class RisingField:
    """A field that changes like a counter, an angle or a clock.

    Attributes:
        offset: offset in the frame or block, in bytes.
        size: size in bytes.
        kind: "counter" rises by one each time; "angle" wraps at a full circle; "rising" is any
            other field that rises.
        circle: the value at which the field wraps; 0 if no wrap was seen.
        steps: the smallest, usual and largest step.
        right: the number of steps that are regular: for a counter, the steps by one; for another
            field, the steps that are at most `MAX_STEP_RATIO` times the usual step.
        total: the number of all steps.
        first: for a counter, the value after a wrap.
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

    def describe_evidence(self, container: str = "frame") -> str:
        """Return the evidence for the field as a text.

        Args:
            container: "frame" or "block", which contains the field.
        """
        low, usual, high = self.steps
        if low == high:
            step = f"{usual}"
        else:
            step = f"{low} to {high}"
        of_steps = f"in {self.right} of {self.total} steps"
        text = f"rises by {step} from {container} to {container}, {of_steps}"
        if self.kind == "angle":
            unit = FULL_CIRCLES[self.circle][1]
            return f"{text}, and wraps at {self.circle}, so the unit may be {unit}"
        if not self.wraps:
            return f"{text}; no wrap found"
        if self.kind == "counter":
            return f"{text}, and wraps from {self.circle - 1} to {self.first}"
        return f"{text}, and wraps at about {self.circle}"


def find_rising_fields(rows: NDArray[np.uint8]) -> list[RisingField]:
    """Return the rising fields of consecutive frames, sorted by offset.

    Args:
        rows: the frames, or the first bytes of each frame, (n, size).
    """
    if len(rows) < 3:
        return []
    fields = sorted(
        _iter_rising_fields(rows),
        key=lambda field: (
            field.kind == "rising",
            -field.size,
            -field.right / field.total,
            field.offset,
        ),
    )
    chosen: list[RisingField] = []
    for field in fields:
        if all(field.end <= other.offset or field.offset >= other.end for other in chosen):
            chosen.append(field)
    return sorted(chosen, key=lambda field: field.offset)


def measure_share_between(first: NDArray[np.int64], last: NDArray[np.int64], circle: int) -> float:
    """Return the share of frames whose `last` is between `first` and the next `first`.

    Args:
        first: a field of each frame, (n,).
        last: another field of each frame, (n,).
        circle: the value at which both wrap; 0 if unknown.
    """
    modulus = circle or 1 << 40
    return float((((last - first)[:-1] % modulus) <= (np.diff(first) % modulus)).mean())


def _iter_rising_fields(rows: NDArray[np.uint8]) -> Iterator[RisingField]:
    varied = (rows != rows[0]).any(axis=0)
    for offset in _select_offsets(rows, 1):
        if varied[offset] and len(rows) >= FEW_FRAMES:
            yield from _iter_counters(rows, offset, 1, "little")
    byte_orders: tuple[ByteOrder, ...] = ("little", "big")
    for size in (2, 4) if len(rows) >= FEW_FRAMES else (2,):
        for offset in _select_offsets(rows, size):
            for order in byte_orders:
                if order == "little":
                    from_low = range(size)
                else:
                    from_low = range(size - 1, -1, -1)
                if all(varied[offset + index] for index in list(from_low)[: size // 2 + 1]):
                    yield from _iter_counters(rows, offset, size, order)
                    yield from _iter_rising(rows, offset, size, order)


def _select_offsets(rows: NDArray[np.uint8], size: int) -> Iterable[int]:
    """Return the offsets at which to search for a field of this size."""
    last = rows.shape[1] - size
    if len(rows) >= FEW_FRAMES:
        return range(last + 1)
    return sorted(
        {
            *range(min(HEAD_SEARCH_BYTES, last + 1)),
            *range(max(last - TAIL_SEARCH_BYTES, 0), last + 1),
        }
    )


def _iter_counters(
    rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder
) -> Iterator[RisingField]:
    """Yield the field if it is a counter: it rises by one, and wraps to its minimum."""
    counts = read_values(rows, offset, size, order)
    steps = np.diff(counts)
    first = int(counts.min())
    last = int(counts.max())
    is_wrap = (counts[:-1] == last) & (counts[1:] == first) & (last > first + 1)
    right = int((steps == 1).sum() + is_wrap.sum())
    if right >= MIN_REGULAR_SHARE * len(steps) and (steps == 1).sum() >= 2:
        wraps = int(is_wrap.sum())
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


def _iter_rising(
    rows: NDArray[np.uint8], offset: int, size: int, order: ByteOrder
) -> Iterator[RisingField]:
    """Yield the field if it rises by about the same step each time."""
    field_values = read_values(rows, offset, size, order)
    steps = np.diff(field_values)
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
        circle = _find_circle(int(field_values.max()), int(np.median(usual - moved[falls])), usual)
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
    if len(rows) >= FEW_FRAMES and not _includes_low_byte(field_values):
        return
    regular = forward[within]
    kind: Kind = "angle" if circle in FULL_CIRCLES else "rising"
    spread = (int(regular.min()), usual, int(regular.max()))
    right = int(within.sum()) + len(steps) - len(moved)
    yield RisingField(offset, size, order, kind, circle, spread, right, len(steps), wraps)


def _includes_low_byte(field_values: NDArray[np.int64]) -> bool:
    """Return whether the lowest byte of the values is a part of the rising field.

    The lowest byte is a part if the steps are more regular with it than without it.
    """
    steps = np.diff(field_values)
    moved = steps != 0
    coarse_steps = 256 * np.diff(field_values >> 8)
    fine_changes = np.abs(np.diff(steps[moved]))
    coarse_changes = np.abs(np.diff(coarse_steps[moved]))
    is_forward = steps[moved] > 0
    both = is_forward[1:] & is_forward[:-1]
    if not both.any():
        return False
    return bool(coarse_changes[both].mean() > MIN_COARSENING * fine_changes[both].mean())


def _find_circle(highest: int, estimate: int, usual: int) -> int:
    """Return the value at which a field wraps.

    Args:
        highest: the largest value of the field.
        estimate: the decrease at a wrap plus the usual step.
        usual: the usual step.
    """
    near = [
        circle
        for circle in FULL_CIRCLES
        if highest < circle <= highest + 3 * usual and abs(estimate - circle) <= 3 * usual
    ]
    return min(near, key=lambda circle: abs(estimate - circle), default=estimate)


@dataclass(frozen=True)
class LengthField:
    """A length field in the header of a frame.

    The frame length is `rest` + `unit` * value.

    Attributes:
        offset: offset of the field, in bytes.
        size: size of the field, in bytes.
        unit: size of the counted elements, in bytes; 1 for a length in bytes.
        rest: number of bytes that the field does not count.
    """

    offset: int
    size: int
    order: ByteOrder
    unit: int
    rest: int

    @property
    def end(self) -> int:
        """The offset after the field."""
        return self.offset + self.size

    def read(self, frame: bytes) -> int:
        """Return the length of a frame from its length field."""
        return self.rest + self.unit * int.from_bytes(frame[self.offset : self.end], self.order)

    def __str__(self) -> str:
        if self.size == 1:
            kind = "byte"
        else:
            kind = f"{self.order}-endian word"
        return f"{self.rest} + {self.unit} x {kind} at {self.offset}"


@dataclass(frozen=True)
class FrameStructure:
    """The likely frames in unknown bytes.

    Attributes:
        sync: the first bytes of each frame.
        period: the length of the frames; None if it varies.
        length: the length field, if the length varies.
        share: the share of the bytes that are in frames.
    """

    sync: bytes
    period: int | None
    length: LengthField | None
    share: float
    frames: tuple[bytes, ...]

    @cached_property
    def checksums(self) -> tuple[ChecksumMatch, ...]:
        """The checksums that match, the likeliest first.

        The search takes about a second.
        """
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


def find_usual_bytes(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the most frequent value of each column, (n,)."""
    return np.array([np.bincount(column, minlength=256).argmax() for column in rows.T], np.uint8)


def find_runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the (start, stop) indices of each run of True."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False)).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def split_frames(data: bytes, period: int, start: int = 0) -> list[bytes]:
    """Split data into frames of one length, without an incomplete last frame."""
    return [data[first : first + period] for first in range(start, len(data) - period + 1, period)]


def _find_in_datagrams(chunks: Sequence[bytes]) -> FrameStructure | None:
    """Return the structure of the datagrams of one length."""
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
    """Return the structure of a stream, with frames of one or of several lengths."""
    periodic = _find_fixed_length(data)
    varying = _find_varying_length(data)
    if periodic is None or varying is None:
        return periodic or varying
    has_more_frames = len(periodic.frames) < MANY_FRAMES <= len(varying.frames)
    if varying.share > periodic.share + SHARE_TOLERANCE or has_more_frames:
        return varying
    return periodic


def _find_fixed_length(data: NDArray[np.uint8]) -> FrameStructure | None:
    """Return the structure of frames of the same length; None if none is found."""
    lags = np.arange(MIN_FRAME_BYTES, min(MAX_FRAME_BYTES, len(data) // MIN_FRAMES) + 1)
    equal = np.array([float((data[lag:] == data[:-lag]).mean()) for lag in lags])
    likely = lags[np.argsort(equal)[::-1][:MAX_DISTANCES]].tolist()
    framed = [
        (weight, structure)
        for lag in likely
        for weight, structure in _iter_structures_of_length(data, lag)
        if structure.share > MIN_FRAMED_SHARE
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
    """Split the frames of a structure if each of them is a group of several frames.

    Args:
        whole: the structure that was found in the data.

    Returns:
        The structure of the single frames; `whole` if its frames are not groups.
    """
    # frames can repeat in groups, for example because an index in the frames counts from 0 to 5
    period = whole.period or 0
    for part_size in range(MIN_FRAME_BYTES, period // 2 + 1):
        if period % part_size:
            continue
        for _, structure in _iter_structures_of_length(data, part_size):
            if structure.share > whole.share - SHARE_TOLERANCE and (
                len(set(structure.sync)) > 1 or _has_counter(structure)
            ):
                return structure
    return whole


def _has_counter(structure: FrameStructure) -> bool:
    rows = np.frombuffer(b"".join(structure.frames), np.uint8).reshape(len(structure.frames), -1)
    return any(field.kind == "counter" for field in find_rising_fields(rows))


def _iter_structures_of_length(
    data: NDArray[np.uint8], period: int
) -> Iterator[tuple[float, FrameStructure]]:
    """Yield (weight, structure) for the frames of the length `period`, if any.

    The weight is the share of the data that consists of constant bytes.
    """
    count = len(data) // period
    rows = data[: count * period].reshape(count, period)
    usual = find_usual_bytes(rows)
    if count >= 2 * MIN_FRAMES:
        steady = (rows == usual).mean(axis=0) >= MIN_CONSTANT_SHARE
    else:
        steady = (rows == usual).all(axis=0)
    steady_count = int((steady & (usual != 0)).sum())
    if steady_count == 0 or steady.all() or _is_chance(data, steady_count, count, period):
        return
    start, length = _find_longest_run(steady, usual)
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


def _is_chance(data: NDArray[np.uint8], constant_count: int, count: int, period: int) -> bool:
    """Return whether the number of constant bytes is probably a coincidence.

    Args:
        constant_count: number of nonzero bytes of a period that are equal in each repetition.
        count: number of repetitions.
    """
    # Chernoff's bound for random bytes with the same distribution of values
    shares = np.bincount(data, minlength=256)[1:] / len(data)
    expected = period * float((shares**count).sum())
    if constant_count <= expected:
        return True
    if expected == 0:  # below the smallest float, after many repetitions
        return False
    log_chance = constant_count - expected - constant_count * math.log(constant_count / expected)
    periods = min(MAX_FRAME_BYTES, len(data) // MIN_FRAMES)
    return math.log(periods) + log_chance > math.log(MAX_CHANCE_PROBABILITY)


def _find_longest_run(steady: NDArray[np.bool_], usual: NDArray[np.uint8]) -> tuple[int, int]:
    """Return (start, length) of the run with the most nonzero constant bytes."""
    # Rotate so that the first byte is not constant. No run is then split.
    rotation = int(np.argmin(steady))
    best = (-1, 0, 0)
    for start, end in find_runs(np.roll(steady, -rotation)):
        run = np.roll(usual, -rotation)[start:end]
        zeros = int(np.argmax(run != 0)) if run.any() else 0
        offset = (rotation + start + zeros) % len(usual)
        best = max(best, (int(np.count_nonzero(run)), -offset, len(run) - zeros))
    return -best[1], best[2]


def _find_varying_length(data: NDArray[np.uint8]) -> FrameStructure | None:
    """Return the structure of frames with a length field; None if none is found."""
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
        # Several pairs of bytes in a header explain the lengths equally well. Use the pair that
        # occurs first, because captures often begin with a frame.
        first_start = int(starts[0])
        if (
            best is None
            or structure.share > best[0] + SHARE_TOLERANCE
            or (structure.share > best[0] - SHARE_TOLERANCE and first_start < best[1])
        ):
            best = (structure.share, first_start, structure)
    if best is not None and best[0] > MIN_FRAMED_SHARE:
        return best[2]
    return None


def _find_length_field(
    data: NDArray[np.uint8], starts: NDArray[np.intp], sync: bytes
) -> FrameStructure | None:
    """Return the structure of frames with given sync bytes; None if there is none.

    Args:
        starts: offsets of the sync bytes, (n,).
    """
    starts = starts[starts + MAX_LENGTH_FIELD_OFFSET + 2 < len(data)]
    steps = np.diff(starts)
    if len(steps) < MIN_FRAMES:
        return None
    best: tuple[float, LengthField | None, NDArray[np.bool_]] = (0.0, None, np.zeros(0, np.bool_))
    kinds: tuple[tuple[int, ByteOrder], ...] = ((1, "little"), (2, "little"), (2, "big"))
    for offset in range(2, MAX_LENGTH_FIELD_OFFSET):
        low = data[starts[:-1] + offset].astype(np.int64)
        high = data[starts[:-1] + offset + 1].astype(np.int64)
        for (size, order), lengths in zip(
            kinds, (low, low | high << 8, high | low << 8), strict=True
        ):
            for unit in range(1, MAX_UNIT_BYTES + 1):
                rest = steps - unit * lengths
                usual, count = _find_most_frequent(rest)
                fits = rest == usual
                distinct = len(np.unique(steps[fits]))
                share = float(steps[fits].sum() / len(data))
                if distinct > 1 and count >= MIN_FRAMES and usual >= 0 and share > best[0]:
                    best = (share, LengthField(offset, size, order, unit, usual), fits)
    share, length, fits = best
    if length is None:
        return None
    whole = data.tobytes()
    frames = [
        whole[start : start + step]
        for start, step in zip(starts[:-1][fits].tolist(), steps[fits].tolist(), strict=True)
    ]
    return FrameStructure(sync, None, length, share, tuple(frames))


def _find_most_frequent(integers: NDArray[np.int64]) -> tuple[int, int]:
    """Return the most frequent value and its number of occurrences."""
    distinct, counts = np.unique(integers, return_counts=True)
    return int(distinct[counts.argmax()]), int(counts.max())
