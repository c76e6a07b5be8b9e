"""Find the frame that a point of a scan came from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.packets.packets import Packets
from lidarspec.points.reference_evaluator import EvaluatedPoints
from lidarspec.scans.scan_ends import first_points


class PointOrigin(NamedTuple):
    """The frame that a point came from.

    Attributes:
        frame: the type of the frame.
        offset: the offset of the frame in the input.
        host_ns: the arrival time of the frame, ns since 1970; 0 if unknown.
        part: the index of the part of the frame that contains the point; 0 if frames have no parts.
        number: the index of the point in the part, or in the frame if it has no parts.
        data: the bytes of the frame; for a frame that is encoded on the wire, the decoded bytes.
    """

    frame: str
    offset: int
    host_ns: int
    part: int
    number: int
    data: bytes


class PointRun(NamedTuple):
    """Consecutive points of one batch of packets.

    Attributes:
        start: the index in `points` of the first point of the run.
        stop: the index in `points` after the last point of the run.
        parts_before: how many parts of the first frame were in earlier batches.
    """

    packets: Packets
    points: EvaluatedPoints
    start: int
    stop: int
    parts_before: int


class Provenance:
    """Finds the frames that the points of a scan came from.

    Args:
        runs: the points of the scan, in stream order.
        indices: the indices of the selected points in `runs`; None for all.
    """

    def __init__(
        self, runs: Sequence[PointRun] = (), indices: NDArray[np.intp] | None = None
    ) -> None:
        self._runs = runs
        self._indices = indices

    def select(self, indices: NDArray[np.intp]) -> Provenance:
        """Return the provenance of some points of the scan.

        Args:
            indices: the indices of these points in the scan, (k,).
        """
        if self._indices is not None:
            indices = self._indices[indices]
        return Provenance(self._runs, indices)

    def __call__(self, point: int) -> PointOrigin:
        """Return the origin of a point, given its index in the scan."""
        size = sum(run.stop - run.start for run in self._runs)
        if self._indices is not None:
            size = len(self._indices)
        if not 0 <= point < size:
            raise IndexError(f"point {point} does not exist: the scan has {size} points")
        if self._indices is not None:
            point = int(self._indices[point])
        first = 0
        runs = iter(self._runs)
        run = next(runs)
        while first + run.stop - run.start <= point:
            first += run.stop - run.start
            run = next(runs)
        return _find_origin(run, run.start + point - first)

    def iter_packets(self) -> Iterator[Packets]:
        """Yield the packets that the points came from, in stream order.

        Yields nothing if the scan has been unpickled, because packets are not pickled.
        """
        for run in self._runs:
            first, last = first_points(run.points).searchsorted([run.start, run.stop - 1], "right")
            yield run.packets.take(slice(int(first) - 1, int(last)))

    def __reduce__(self) -> Any:
        return Provenance, ()  # a pickled scan does not contain its packets


def _find_origin(run: PointRun, point: int) -> PointOrigin:
    """Return the origin of a point, given its index in the batch."""
    packets = run.packets
    starts = first_points(run.points)
    row = int(starts.searchsorted(point, side="right")) - 1
    table, rows = packets.frames
    if isinstance(rows, slice):
        frame_row = row
    else:
        frame_row = int(rows[row])
    return PointOrigin(
        frame=packets.frame_type,
        offset=int(packets.offset[row]),
        host_ns=int(packets.host_ns[row]),
        part=find_part(packets, row, run.parts_before),
        number=point - int(starts[row]),
        data=table.frame(frame_row),
    )


def find_part(packets: Packets, row: int, parts_before: int) -> int:
    """Return the index of a part in its frame; 0 if the packets are whole frames."""
    _, rows = packets.frames
    if isinstance(rows, slice):
        return 0
    part = row - int(rows.searchsorted(rows[row]))
    if rows[row] == rows[0]:
        part += parts_before
    return part
