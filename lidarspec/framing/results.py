"""The results of framing: `Frames`, many frames as arrays; `Found`, one frame; `Counters`.

`Frames` first contains candidates. The search selects the accepted frames, and the decoder adds
their offsets and arrival times. Each array is made when it is first read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.arrays import (
    broadcast_value,
    count_up,
    group_by_value,
    repeat,
    select_values,
    take_rows,
)
from lidarspec.frames.layout import Bytes2D, Layout

Indices = NDArray[np.intp]
Status = NDArray[np.integer[Any]]
#: Offsets as an array, or as a range, which is converted to an array when it is first read.
Numbers = NDArray[np.int64] | range

#: The status of a candidate: valid, incomplete, or the reason why it is invalid.
VALID, SHORT, LENGTH, CONSTANT, CHECKSUM, IMPLAUSIBLE, PLUGIN = range(7)

#: Up to this number of layouts, searching for the frames of each layout is faster than sorting.
MAX_UNSORTED_LAYOUTS = 16
#: Up to this number of layouts, counting the frames of each layout first saves no time.
MAX_UNCOUNTED_LAYOUTS = 4

#: The number of bytes that the repr of a frame shows.
MAX_REPR_BYTES = 8

#: The counter for each status of a rejected candidate.
COUNTERS_BY_STATUS = {
    SHORT: "bad_length",
    LENGTH: "bad_length",
    CHECKSUM: "bad_checksum",
    IMPLAUSIBLE: "implausible",
    PLUGIN: "plugin_errors",
}


@dataclass(repr=False)
class Counters:
    """Counters of the input, and warnings about the data.

    ``bytes_in == bytes in frames + bytes_skipped + pending`` always holds.

    Attributes:
        frames: the number of frames by type.
        bytes_filler: the number of bytes in `bytes_skipped` that are declared fillers, which the
            sensor sends between frames.
        pending: the number of bytes that are not decided yet, because a candidate is incomplete.
        bad_checksum, bad_length, implausible: the numbers of rejected candidates, by the reason.
        bad_constant: the number of datagrams without the constants of any frame. In a stream, such
            bytes are not candidates and are skipped.
        lost, duplicates, late: the numbers of lost, duplicate and late packets, found by the
            sensor's counter or clock.
        incomplete_returns: the number of incomplete groups of packets. A group contains the returns
            of the same firings (`PacketCounter.returns`); it is incomplete if some, but not all, of
            its packets were lost.
        fragments_lost: the number of fragments that were missing when their message was dropped.
        fragments_late: the number of fragments that arrived twice, or after their message was
            joined or dropped.
        kernel_drops: the number of datagrams that the operating system dropped.
        queue_dropped: the number of chunks that were dropped because a queue was full.
        foreign: the number of datagrams from other senders.
        disconnects: how often the device has disappeared.
        unread: the number of bytes of a damaged file that could not be read.
        plugin_errors: the number of packets or candidates for which a function of the plugin raised
            an error. `failures` has the first errors.
        nominal: whether a default calibration was used in any scan.
        unended: the warning about scans without an end; "" without a warning.
        undated: the warning about times without a date; "" without a warning.
        masked: the warning about a masked sector; "" without a warning.
    """

    bytes_in: int = 0
    frames: dict[str, int] = field(default_factory=dict)
    bytes_skipped: int = 0
    bytes_filler: int = 0
    pending: int = 0
    bad_checksum: int = 0
    bad_length: int = 0
    bad_constant: int = 0
    implausible: int = 0
    lost: int = 0
    duplicates: int = 0
    late: int = 0
    incomplete_returns: int = 0
    fragments_lost: int = 0
    fragments_late: int = 0
    kernel_drops: int = 0
    queue_dropped: int = 0
    foreign: int = 0
    plugin_errors: int = 0
    disconnects: int = 0
    unread: int = 0
    failures: list[PluginError] = field(default_factory=list, repr=False, compare=False)
    nominal: bool = field(default=False, repr=False, compare=False)
    unended: str = field(default="", repr=False, compare=False)
    undated: str = field(default="", repr=False, compare=False)
    masked: str = field(default="", repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Return the counters by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.compare}

    def count_error(self, failure: PluginError, number: int) -> None:
        """Count packets for which a function of the plugin raised an error."""
        self.plugin_errors += number
        if len(self.failures) < 5:
            self.failures.append(failure)

    @property
    def tracebacks(self) -> list[str]:
        """The tracebacks of the first few errors of the plugin, as text."""
        return [failure.traceback for failure in self.failures]

    def failure(self, sensor: str) -> PluginError | None:
        """Return the first error of the plugin; None if there was no error.

        Its message states for how many packets or candidates the plugin failed.
        """
        if not self.failures:
            return None
        first = self.failures[0]
        reason = f"{first.reason}, at {self.plugin_errors} packet{'s' * (self.plugin_errors != 1)}"
        return PluginError(
            reason,
            path=first.path,
            sensor=sensor,
            rule=first.rule,
            file=first.file,
            line=first.line,
            traceback=first.traceback,
        )

    def __repr__(self) -> str:
        return f"Counters({self})"

    def __str__(self) -> str:
        parts = [
            f"{name} {value}"
            for name, value in self.to_dict().items()
            if value and name != "frames"
        ]
        return (
            ", ".join(
                [*(f"{number} {name} frames" for name, number in self.frames.items()), *parts]
            )
            or "nothing received yet"
        )


@dataclass(frozen=True, slots=True, repr=False)
class Found:
    """One frame in the input.

    Attributes:
        frame: the name of the frame type.
        offset: the offset of the frame in the input. For datagrams, it is the offset in the
            concatenation of all datagrams.
        data: the bytes of the frame.
        at: the arrival time of the bytes that completed the frame, ns; None if unknown.
        gap: the number of bytes that were skipped between the previous frame and this one, without
            fillers.
    """

    frame: str
    offset: int
    data: bytes
    at: int | None = None
    gap: int = 0

    def __repr__(self) -> str:
        begin = f"{self.data[:MAX_REPR_BYTES].hex(' ')}{' ...' * (len(self.data) > MAX_REPR_BYTES)}"
        return f"Found({self.frame} at byte {self.offset}, {len(self.data)} bytes: {begin})"


class Frames:
    """Frames or candidates in a piece of input, in order, as arrays of length n.

    Attributes:
        buffer: the bytes that contain the frames, at the offsets `starts`.
        sizes: the size of each frame in bytes. For an incomplete candidate, it is the number of
            bytes required to decide about it, 0 if unknown.
        names: the names of the incoming frame types of the sensor.
        kinds: the index in `names` of the type of each frame; -1 for a datagram that is not a
            frame.
        layouts: the layouts of the frames.
        forms: for each frame, the index of its layout in `layouts`; -1 if unknown.
        status: the status of each frame, which is `VALID` or the reason why a candidate is not a
            frame.
        offsets: the offset of each frame in the whole input. For datagrams, it is the offset in the
            concatenation of all datagrams.
        places: the values of `offsets` as a range, if the frames have one size and follow one
            another; otherwise the same array.
        rows: the bytes of each complete frame as a row, if all have one layout and the rows were
            gathered.
    """

    def __init__(
        self,
        buffer: NDArray[np.uint8],
        kinds: Indices,
        starts: Numbers,
        sizes: Indices,
        *,
        layouts: tuple[Layout, ...] = (),
        forms: Indices | None = None,
        status: Status | None = None,
        rows: Bytes2D | None = None,
        errors: tuple[PluginError, ...] = (),
    ) -> None:
        number = len(kinds)
        self.buffer = buffer
        self.kinds = kinds
        self.sizes = sizes
        self.layouts = layouts
        self.rows = rows
        self.errors = errors
        self._starts = self.places = starts
        if forms is None:
            self.forms = repeat(0 if layouts else -1, number)
        else:
            self.forms = forms
        self.status = repeat(VALID, number) if status is None else status
        self.names: tuple[str, ...] = ()

    @classmethod
    def make_empty(cls, buffer: NDArray[np.uint8]) -> Frames:
        """Return an object without frames."""
        return cls(buffer, repeat(-1, 0), range(0), repeat(0, 0))

    @classmethod
    def join(cls, parts: Sequence[Frames]) -> Frames:
        """Join candidates that have the same buffer; rows and errors are left out."""
        if len(parts) == 1:
            return parts[0]
        layouts = list[Layout]()
        firsts = dict[int, int]()
        for part in parts:
            if id(part.layouts) not in firsts:
                firsts[id(part.layouts)] = len(layouts)
                layouts += part.layouts
        return cls(
            parts[0].buffer,
            np.concatenate([part.kinds for part in parts]),
            np.concatenate([part.starts for part in parts]),
            np.concatenate([part.sizes for part in parts]),
            layouts=tuple(layouts),
            forms=np.concatenate([_shift(part.forms, firsts[id(part.layouts)]) for part in parts]),
            status=np.concatenate([part.status for part in parts]),
        )

    def __len__(self) -> int:
        return len(self.kinds)

    @cached_property
    def starts(self) -> Indices:
        """The offset of each frame in the buffer, (n,)."""
        return to_array(self._starts)

    @cached_property
    def offsets(self) -> NDArray[np.int64]:
        """The offset of each frame in the input, (n,)."""
        return to_array(self.places)

    @cached_property
    def gaps(self) -> NDArray[np.int64]:
        """The number of bytes skipped before each frame, (n,), without fillers.

        The numbers are 0 until the decoder sets them.
        """
        return repeat(0, len(self))

    @cached_property
    def at(self) -> NDArray[np.int64]:
        """The arrival time of each frame, (n,) ns, -1 if unknown."""
        return repeat(-1, len(self))

    @property
    def layout(self) -> Layout | None:
        """The layout of all frames; None if layouts differ or are unknown."""
        form = broadcast_value(self.forms)
        if form is None or form < 0:
            return None
        return self.layouts[form]

    @property
    def total_bytes(self) -> int:
        """The total size of all frames in bytes."""
        size = broadcast_value(self.sizes)
        if size is None:
            return int(self.sizes.sum())
        return size * len(self)

    @cached_property
    def is_all_valid(self) -> bool:
        """Whether all candidates are valid frames."""
        return not np.count_nonzero(self.status)

    def select(self, which: NDArray[np.bool_] | Indices | slice) -> Frames:
        """Return the frames that a mask, ascending indices or a slice select."""
        if not (isinstance(which, slice) or which.dtype != np.bool_):
            which = np.flatnonzero(which)
        rows = self.rows
        if rows is not None:
            if isinstance(which, slice):
                rows = rows[which]
            else:
                rows = take_rows(rows, which[: which.searchsorted(len(rows))])
        chosen = {
            name: select_values(getattr(self, name), which)
            for name in ("kinds", "sizes", "forms", "status", "gaps", "at")
            if name in vars(self)
        }
        starts = _select(self._starts, which)
        if self.places is self._starts:
            places = starts
        else:
            places = _select(self.places, which)
        return self._replace(**chosen, rows=rows, _starts=starts, places=places)

    def group_by_layout(self) -> list[tuple[Layout, Indices]]:
        """Return pairs of a layout and the indices of its frames, (k,).

        Frames without a known layout are left out.
        """
        form = broadcast_value(self.forms)
        if form is not None:
            if form >= 0:
                return [(self.layouts[form], count_up(len(self)))]
            return []
        if len(self.layouts) <= MAX_UNCOUNTED_LAYOUTS:
            groups = [
                (layout, np.flatnonzero(self.forms == form))
                for form, layout in enumerate(self.layouts)
            ]
            return [(layout, which) for layout, which in groups if len(which)]
        return [
            (self.layouts[form], which)
            for form, which in group_by_value(self.forms, MAX_UNSORTED_LAYOUTS)
            if form >= 0
        ]

    def locate(
        self,
        names: tuple[str, ...],
        places: Numbers,
        gaps: NDArray[np.int64],
        at: NDArray[np.int64],
    ) -> Frames:
        """Return these frames with their offsets in the input and their arrival times.

        Args:
            places: the offset of each frame in the input, (n,).
            gaps: the number of bytes skipped before each frame, (n,).
            at: the arrival time of each frame, ns, (n,).
        """
        if self.rows is None or isinstance(self._starts, range):
            return self._replace(names=names, places=places, gaps=gaps, at=at)
        number, size = self.rows.shape
        starts = range(0, number * size, size)
        return self._replace(
            names=names,
            places=places,
            gaps=gaps,
            at=at,
            buffer=self.rows.reshape(-1),
            _starts=starts,
        )

    def with_arrivals(self, at: NDArray[np.int64]) -> Frames:
        """Return these frames with other arrival times, (n,) ns."""
        return self._replace(at=at)

    def _replace(self, **changes: Any) -> Frames:
        changed = object.__new__(Frames)
        vars(changed).update(vars(self), **changes)
        for name in ("starts", "offsets", "is_all_valid"):
            vars(changed).pop(name, None)
        return changed

    def data(self, index: int) -> bytes:
        """Return the bytes of one frame."""
        return self.buffer[self.starts[index] : self.starts[index] + self.sizes[index]].tobytes()

    def to_found(self) -> list[Found]:
        """Return the frames as a list of `Found`."""
        rows = zip(
            self.kinds.tolist(),
            self.offsets.tolist(),
            self.gaps.tolist(),
            self.at.tolist(),
            strict=True,
        )
        return [
            Found(self.names[kind], offset, self.data(index), None if at < 0 else at, gap)
            for index, (kind, offset, gap, at) in enumerate(rows)
        ]


def pack_found(frames: Sequence[Found]) -> Frames:
    """Return a list of `Found` as `Frames`."""
    names = tuple(dict.fromkeys(item.frame for item in frames))
    sizes = np.array([len(item.data) for item in frames], np.intp)
    columns = [
        np.array(column, np.int64)
        for column in zip(
            *((f.offset, f.gap, -1 if f.at is None else f.at) for f in frames), strict=True
        )
    ]
    offsets, gaps, at = columns or [np.empty(0, np.int64)] * 3
    kinds = np.array([names.index(item.frame) for item in frames], np.intp)
    buffer = np.frombuffer(b"".join(item.data for item in frames), np.uint8)
    return Frames(buffer, kinds, np.cumsum(sizes) - sizes, sizes).locate(names, offsets, gaps, at)


def to_array(numbers: Numbers) -> NDArray[np.int64]:
    """Return the numbers as an array, (n,)."""
    if isinstance(numbers, range):
        return np.arange(numbers.start, numbers.stop, numbers.step)
    return numbers


def _shift(forms: Indices, first: int) -> Indices:
    """Return indices of layouts, increased by `first`; -1 (unknown) is unchanged."""
    form = broadcast_value(forms)
    if form is None:
        return np.where(forms < 0, -1, forms + first)
    return repeat(form + first if form >= 0 else -1, len(forms))


def _select(numbers: Numbers, which: NDArray[np.bool_] | Indices | slice) -> Numbers:
    if isinstance(which, slice):
        return numbers[which]
    return to_array(numbers)[which]
