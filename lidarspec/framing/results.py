"""What a decoder found and counted: frames as arrays or one by one, and the counters.

Frames of one layout that stand at one distance, with nothing lost between them, are `Alike`: arrays that follow from a few
numbers cost more than finding such frames does, and are made only when they are read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from lidarspec.wire.arrays import repeated
from lidarspec.wire.layout import Bytes2D, Layout


@dataclass
class Counters:
    """What became of the input. ``bytes_in == bytes in frames + bytes_skipped + pending`` always holds.

    Attributes:
        frames: number of frames by type.
        bytes_filler: declared fillers among the skipped bytes.
        pending: bytes held because a candidate needs more.
        bad_checksum, bad_length, implausible: rejected candidates.
        lost, duplicates, late: packets, by the sensor's sequence.
        kernel_drops, queue_dropped, foreign, disconnects: counted by the transports.
        plugin_errors: exceptions out of a plugin; `tracebacks` keeps the first ones.
    """

    bytes_in: int = 0
    frames: dict[str, int] = field(default_factory=dict)
    bytes_skipped: int = 0
    bytes_filler: int = 0
    pending: int = 0
    bad_checksum: int = 0
    bad_length: int = 0
    implausible: int = 0
    lost: int = 0
    duplicates: int = 0
    late: int = 0
    kernel_drops: int = 0
    queue_dropped: int = 0
    foreign: int = 0
    plugin_errors: int = 0
    disconnects: int = 0
    tracebacks: list[str] = field(default_factory=list, repr=False, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """The counters by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "tracebacks"}

    def error(self, traceback: str, number: int = 1) -> None:
        """Count an exception out of a plugin, and keep the first few tracebacks."""
        self.plugin_errors += number
        if len(self.tracebacks) < 5:
            self.tracebacks.append(traceback)

    def __str__(self) -> str:
        parts = [f"{name} {value}" for name, value in self.to_dict().items() if value and name != "frames"]
        return ", ".join([*(f"{number} {name} frames" for name, number in self.frames.items()), *parts]) or "nothing yet"


@dataclass(frozen=True, slots=True)
class Found:
    """One frame in the input.

    Attributes:
        frame: the name of its type.
        offset: of its first byte in everything fed so far (of its datagram's payload, joined, for datagram links).
        data: its bytes.
        at: arrival time in ns of the piece of input that completed it; None if the caller gave none.
        gap: bytes (other than fillers) skipped since the frame before it.
    """

    frame: str
    offset: int
    data: bytes
    at: int | None = None
    gap: int = 0


@dataclass(frozen=True, eq=False)
class Spans:
    """Frames of a piece of input as arrays, in stream order.

    Attributes:
        names: the types; `kinds` are indices into them.
        buffer: the bytes that the frames stand in, at `starts`, `sizes` long.
        offsets, gaps, at: as in `Found`; `at` is -1 where nobody knows it.
        layout: that all have; None where they have not, or nobody knows.
    """

    names: tuple[str, ...]
    buffer: NDArray[np.uint8]
    kinds: NDArray[np.intp]
    starts: NDArray[np.intp]
    sizes: NDArray[np.intp]
    offsets: NDArray[np.int64]
    gaps: NDArray[np.int64]
    at: NDArray[np.int64]
    layout: Layout | None = None

    def __len__(self) -> int:
        return len(self.kinds)

    def data(self, index: int) -> bytes:
        """The bytes of one frame."""
        return self.buffer[self.starts[index] : self.starts[index] + self.sizes[index]].tobytes()

    def arrived(self, at: NDArray[np.int64]) -> Self:
        """The same frames with other times of arrival."""
        found = object.__new__(type(self))
        vars(found).update(vars(self), at=at)
        return found

    def found(self) -> list[Found]:
        """The frames one by one."""
        rows = zip(self.kinds.tolist(), self.offsets.tolist(), self.gaps.tolist(), self.at.tolist(), strict=True)
        return [
            Found(self.names[kind], offset, self.data(index), None if at < 0 else at, gap)
            for index, (kind, offset, gap, at) in enumerate(rows)
        ]


class Alike(Spans):
    """Frames of one layout at one distance, one after another in the input: a `Spans` whose arrays are made when they are read.

    Args:
        kind: index of their type.
        rows: their bytes, one a row, each contiguous by itself.
        first: where the first one begins in the buffer.
        offset: of the first one in the input.
        gap: bytes skipped before it.
    """

    def __init__(
        self,
        names: tuple[str, ...],
        buffer: NDArray[np.uint8],
        kind: int,
        layout: Layout,
        rows: Bytes2D,
        first: int,
        offset: int,
        gap: int,
        at: NDArray[np.int64],
    ) -> None:
        vars(self).update(names=names, buffer=buffer, at=at, layout=layout)
        vars(self).update(kind=kind, rows=rows, first=first, offset=offset, gap=gap)

    kind: int
    layout: Layout
    rows: Bytes2D
    first: int
    offset: int
    gap: int

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def kinds(self) -> NDArray[np.intp]:
        """The type of each."""
        return repeated(self.kind, len(self))

    @cached_property
    def starts(self) -> NDArray[np.intp]:
        """Where each begins in the buffer."""
        return self.first + np.arange(len(self)) * self.rows.strides[0]

    @cached_property
    def sizes(self) -> NDArray[np.intp]:
        """The bytes of each."""
        return repeated(self.rows.shape[1], len(self))

    @cached_property
    def offsets(self) -> NDArray[np.int64]:
        """Where each begins in the input."""
        return np.arange(self.run.start, self.run.stop, self.run.step)

    @property
    def run(self) -> range:
        """The same as a range."""
        size = self.rows.shape[1]
        return range(self.offset, self.offset + size * len(self), size)

    @cached_property
    def gaps(self) -> NDArray[np.int64]:
        """The bytes skipped before each."""
        if not self.gap:
            return repeated(0, len(self))
        gaps = np.zeros(len(self), np.int64)
        gaps[0] = self.gap
        return gaps


def packed(found: Sequence[Found]) -> Spans:
    """Frames given one by one as arrays."""
    names = tuple(dict.fromkeys(item.frame for item in found))
    sizes = np.array([len(item.data) for item in found], np.intp)
    columns = [np.array(column, np.int64) for column in zip(*((f.offset, f.gap, -1 if f.at is None else f.at) for f in found), strict=True)]
    offsets, gaps, at = columns or [np.empty(0, np.int64)] * 3
    kinds = np.array([names.index(item.frame) for item in found], np.intp)
    buffer = np.frombuffer(b"".join(item.data for item in found), np.uint8)
    return Spans(names, buffer, kinds, np.cumsum(sizes) - sizes, sizes, offsets, gaps, at)
