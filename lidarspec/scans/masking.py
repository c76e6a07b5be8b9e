"""Find the masked sector of a rotating sensor, and mark the packets after it.

A masked sector is a range of angles in which the sensor is configured to send no packets. The mark
of a packet, `Packets.masked`, is the number of packets that the sector leaves out before it.

The sector is found in the first revolutions of a stream. A step of the angle that is much larger
than other steps (a leap) may be the sector, or may be caused by lost packets. After the first leap,
packets are held for about one revolution, until this is known. Because these packets are held, even
the first scans can end before the sector and begin after it.
"""

from __future__ import annotations

import copy

import numpy as np

from lidarspec.packets.masked_sector import (
    MAX_JITTER_TURNS,
    MIN_WIDTH_STEPS,
    MIN_WIDTH_TURNS,
    VARYING_PACKETS,
    AngleReader,
    Angles,
    Sector,
    SectorFinder,
)
from lidarspec.packets.packets import Packets, join_packets
from lidarspec.scans.limits import SLOWEST_TURN_S
from lidarspec.spec.sensor import SensorDescription

#: A leap has to recur within this number of revolutions.
MAX_TURNS = 4
#: The maximum number of packets that are held.
MAX_HELD_PACKETS = 1 << 15


class Masking:
    """Searches for a masked sector, and marks the packets directly after it.

    The packets have to be in order.

    Args:
        sensor: a sensor whose packets have an angle (`AngleReader.is_available`).

    Attributes:
        angle_before_sector: the angle of the last packet before the first marked packet, in turns;
            None if there was no packet.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._reader = AngleReader(sensor)
        self._is_settled = False
        slowest_rate_hz = sensor.turn[0] if sensor.turn else 1 / SLOWEST_TURN_S
        self._longest_ns = int(MAX_TURNS / slowest_rate_hz * 1e9)
        self._finder: SectorFinder | None = None
        self._turned = 0.0  # turns since the start
        self._smallest_step = np.inf
        self._angle: float | None = None  # of the last packet searched
        self._held: list[Packets] = []
        self._is_holding = False
        self._marked_angle: float | None = None  # of the last packet marked
        self._index = 0  # of that packet
        self._masked = 0  # packets that the sector leaves out
        self._has_marked = False
        self.angle_before_sector: float | None = None

    @property
    def sector(self) -> Sector | None:
        """The masked sector; None until it is found."""
        if self._finder is None:
            return None
        return self._finder.sector

    def push(self, packets: Packets) -> list[Packets]:
        """Add packets, and return a list of at most two batches of released packets."""
        if not len(packets):
            return []
        if self._is_settled:
            if self.sector is None:
                return [packets]
            return [self._set_masked(packets)]
        angles = self._reader.angles(packets.table)
        if angles is None:
            self._is_settled = True
            return self._release(packets)
        leap = self._find_leap(packets, angles)
        if self._held:
            held = join_packets([*self._held, packets])
        else:
            held = packets
        if self._is_holding or leap is None:
            return self._hold_or_release(held)
        before = len(held) - len(packets) + max(leap - 1, -1 if self._held else 0)
        self._is_holding = True
        passed = [held.take(slice(0, before))] if before else []
        self._held = []
        return [
            *map(self._store_last, passed),
            *self._hold_or_release(held.take(slice(before, None))),
        ]

    def finish(self) -> list[Packets]:
        """Return a list of the packets that are still held."""
        self._is_settled = True
        return self._release(None)

    def _hold_or_release(self, held: Packets) -> list[Packets]:
        """Release or hold packets, and return a list of the released packets."""
        # After a leap, the last packet before the leap and all later packets are held.
        self._held = [held]
        if self._is_settled:
            return self._release(None)
        if self._is_holding:
            times = held.time_ns
            is_late = abs(int(times[-1]) - int(times[0])) > self._longest_ns
            if is_late or len(held) > MAX_HELD_PACKETS:
                self._is_settled = True
                return self._release(None)
            return []
        self._held = [held.take(slice(-1, None))]
        if len(held) > 1:
            return [self._store_last(held.take(slice(0, -1)))]
        return []

    def _release(self, packets: Packets | None) -> list[Packets]:
        everything = [*self._held, *([packets] if packets is not None else [])]
        self._held = []
        self._is_holding = False
        if not everything:
            return []
        released = join_packets(everything)
        return [released if self.sector is None else self._set_masked(released)]

    def _find_leap(self, packets: Packets, angles: Angles) -> int | None:
        """Return the row of the packet after the first leap; None without a leap.

        The angles of the packets are added to the search for the masked sector.
        """
        if self._finder is None:
            direction = self._reader.direction(packets.table)
            if not direction:
                return None
            self._finder = SectorFinder(direction)
        steps = self._compute_steps(angles, self._angle)
        smallest = np.minimum.accumulate(np.where(steps > 0, steps, np.inf))
        step_before = np.minimum(np.append(np.inf, smallest[:-1]), self._smallest_step)
        limits = np.maximum(step_before * MIN_WIDTH_STEPS, MIN_WIDTH_TURNS)
        turned = self._turned + np.cumsum(steps)
        leaps = np.flatnonzero(steps > limits)
        turns = np.flatnonzero(np.floor(turned) > np.floor(np.append(self._turned, turned[:-1])))
        before = angles[0] if self._angle is None else self._angle
        seen = 0
        for row in sorted({*leaps.tolist(), *turns.tolist()}):
            self._finder.add_angles(angles[seen:row])
            seen = row
            step = min(float(step_before[row]), MIN_WIDTH_TURNS)
            if steps[row] > limits[row]:
                start = before if row == 0 else angles[row - 1]
                self._finder.add_gap(float(start), float(angles[row]), step)
            is_turn_without_leap = row in turns and not self._finder.may_have_masked_sector(step)
            if self._finder.sector is not None or is_turn_without_leap or turned[row] > MAX_TURNS:
                self._is_settled = True
                break
        self._finder.add_angles(angles[seen:])
        self._smallest_step = min(self._smallest_step, float(smallest[-1]))
        self._turned = float(turned[-1])
        self._angle = float(angles[-1])
        if len(leaps):
            return leaps.item(0)
        return None

    def _compute_steps(self, angles: Angles, before: float | None) -> Angles:
        """Return the angle from each packet to the next, (n,), in turns from 0 to 1.

        Args:
            before: the angle of the previous packet; None if there was no packet.
        """
        assert self._finder is not None
        steps = np.diff(angles, prepend=angles[0] if before is None else before)
        ahead = (self._finder.direction * steps) % 1
        ahead[ahead > 1 - MAX_JITTER_TURNS] = 0
        return ahead

    def _store_last(self, packets: Packets) -> Packets:
        """Store the angle and the index of the last packet, and return the packets."""
        angles = self._reader.angles(packets.table)
        if angles is not None:
            self._marked_angle = float(angles[-1])
        self._index = packets.index.item(-1)
        return packets

    def _set_masked(self, packets: Packets) -> Packets:
        """Return the packets with `Packets.masked` set.

        It is 0 for all packets except the packets directly after the sector.
        """
        angles = self._reader.angles(packets.table)
        sector = self.sector
        if not self._has_marked:
            self._has_marked = True
            self.angle_before_sector = self._marked_angle
        if angles is None or sector is None:
            return packets
        if self._marked_angle is None:
            start = angles[0]
        else:
            start = self._marked_angle
        before = np.append(start, angles[:-1])
        behind = (sector.direction * (before - sector.middle)) % 1
        is_leap = behind + self._compute_steps(angles, self._marked_angle) >= 1
        index = packets.index
        if self._marked_angle is None:
            first = index.item(0) - 1
        else:
            first = self._index
        missing = np.where(is_leap, np.maximum(np.diff(index, prepend=first) - 1, 0), 0)
        if not self._masked and missing.any():
            self._masked = int(np.median(missing[missing > 0]))
        few = missing <= self._masked + VARYING_PACKETS
        marked = copy.copy(packets)
        marked.masked = np.where(few, missing, self._masked)
        self._store_last(packets)
        return marked


def describe_sector(sector: Sector) -> str:
    """Return the warning about a masked sector."""
    angles = sorted([sector.start * 360, sector.stop * 360], reverse=sector.direction < 0)
    if sector.contains(0.0):
        angles.reverse()
    return (
        f"no revolution has points from about {angles[0]:.0f} to {angles[1]:.0f} degrees. The"
        " sensor is assumed to be configured to send nothing in this sector: the sector does not"
        " count as packet loss, and scans begin in it"
    )
