"""Count the packets of the current scan, and the packets that are missing in it.

If the points are in parts of the frames (`Parts`), each part is a row of `Packets`, but all parts
of a frame together count as one packet. A packet in which a scan ends counts in this scan and in
the next one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.arrays import broadcast_value, repeat
from lidarspec.packets.packets import Packets

Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PacketCounts:
    """The counts that n packets add to a scan, (n,) each.

    Attributes:
        times: the times of the packets, ns.
        counts: 1 for each whole frame and for the first part of a frame; 0 for all other parts.
        sizes: the sizes of the packets, in bytes or in points.
        missing: the number of packets missing directly before each packet.
        follows_gap: whether packets are missing directly before each packet, even if their number
            is unknown.
    """

    times: Integers
    counts: Integers
    sizes: NDArray[np.intp]
    missing: Integers
    follows_gap: NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        packets: Packets,
        number: int,
        points: NDArray[np.intp] | None,
        previous_index: int | None,
    ) -> PacketCounts:
        """Return the counts of the first packets of a batch.

        Args:
            points: the number of points of each packet, (number,); None to measure sizes in bytes.
            previous_index: the index of the packet before the batch; None at the start of the
                stream.
        """
        index = packets.index[:number]
        if previous_index is None:
            previous_index = index.item(0) - 1
        frames, rows = packets.frames
        is_in_parts = frames is not packets.table
        follows_gap = packets.breaks[:number]
        if is_in_parts or packets.masked is not None or index.item(-1) - previous_index != number:
            steps = np.diff(index, prepend=previous_index)
            missing = np.maximum(steps - 1, 0)
            if packets.masked is not None:
                masked = packets.masked[:number]
                missing = np.maximum(missing - masked, 0)
                follows_gap = follows_gap & (masked == 0)
            follows_gap = follows_gap | (missing > 0)
        else:
            missing = repeat(0, number)
            if follows_gap.any():
                follows_gap = follows_gap.copy()
        counts = repeat(1, number)
        if is_in_parts:
            counts = (steps != 0).astype(np.int64)
        sizes = points
        if sizes is None:
            sizes = frames.sizes[rows][:number]
            if is_in_parts:
                sizes = sizes * counts
        return cls(packets.time_ns[:number], counts, sizes, missing, follows_gap)

    def part(self, start: int, stop: int) -> PacketCounts:
        """Return the counts of the packets in rows `start` to `stop - 1`."""
        rows = slice(start, stop)
        return PacketCounts(
            self.times[rows],
            self.counts[rows],
            self.sizes[rows],
            self.missing[rows],
            self.follows_gap[rows],
        )

    def share_with_next_scan(self, row: int) -> None:
        """Change the counts of a packet in which a scan has ended, for the next scan.

        The packet counts in the next scan as well. The packets missing before it do not.
        """
        if not self.counts[row]:
            self.counts[row] = 1
        if self.missing[row]:
            self.missing[row] = 0
        if self.follows_gap[row]:
            self.follows_gap[row] = False


class OpenScan(NamedTuple):
    """The counts of a scan that has not ended.

    Attributes:
        has_start: whether the start of the scan has arrived.
        since: the time of the first packet of the scan, ns.
        packets: the number of packets of the scan.
        size: the size of the scan, in bytes or in points.
        lost: the number of packets missing in the scan.
        has_gap: whether packets are missing in the scan, even if their number is unknown.
    """

    has_start: bool = False
    since: int = 0
    packets: int = 0
    size: float = 0
    lost: int = 0
    has_gap: bool = False

    @property
    def is_whole(self) -> bool:
        """Whether the scan is whole in the sense of `Scan.whole`, if it ends now.

        This requires the start of the scan, and at least half of its packets.
        """
        return self.has_start and self.lost <= self.packets

    def add(self, packets: PacketCounts) -> OpenScan:
        """Add one or more packets, and return the counts of the scan."""
        since = self.since
        if not self.packets:
            since = packets.times.item(0)
        return OpenScan(
            self.has_start,
            since,
            self.packets + _sum(packets.counts),
            self.size + _sum(packets.sizes),
            self.lost + _sum(packets.missing),
            self.has_gap or bool(packets.follows_gap.any()),
        )

    def add_gap(self, packets: PacketCounts) -> OpenScan:
        """Add the packets missing before `packets`, and return the counts of the scan."""
        return self._replace(
            lost=self.lost + _sum(packets.missing),
            has_gap=self.has_gap or bool(packets.follows_gap.any()),
        )


def _sum(values: Integers) -> int:
    each = broadcast_value(values)
    if each is None:
        return int(values.sum())
    return each * len(values)
