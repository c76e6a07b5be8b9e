"""Detect masked sectors, in which a rotating sensor sends no packets.

The user of a sensor can configure a part of each revolution to be masked.

At a masked sector the clock advances and the angle leaps, as if packets were lost. A gap belongs to
a masked sector if it recurs at the same angles and no packet has ever come from the angles between.
After a real loss, packets from the missing angles arrive in earlier or later revolutions.

All angles here are in turns, from 0 to 1. Widths are measured in the direction of rotation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.frame_table import Table
from lidarspec.points.cloud import COLUMNS
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.timing import OnChange, OnWrap

Angles = NDArray[np.float64]

#: a whole turn in each unit of angles.
FULL_TURNS = {"deg": 360.0, "rad": 2 * np.pi}
#: the number of equal parts of a turn in which angles are remembered.
BINS = 360
#: the narrowest sector that is searched for, in turns.
MIN_WIDTH = 1 / 36
#: the narrowest sector in steps from packet to packet.
MIN_WIDTH_STEPS = 4
#: how far the edges of a gap vary, in steps from packet to packet.
EDGE_STEPS = 1.25
#: a step back by less, in turns, is jitter of the angle and not a leap over the rest of the turn.
JITTER = 1 / 200
#: two gaps belong to one sector if they share more than this share of the wider gap.
COMMON_SHARE = 0.5
#: the number of earlier gaps that a new gap is compared with.
REMEMBERED_GAPS = 16
#: how many packets the gap of a masked sector may vary by: packets do not begin at its edges.
VARYING_PACKETS = 2


@dataclass(frozen=True)
class Sector:
    """A sector of a revolution.

    Attributes:
        start: the angle at which it begins, in the direction of rotation, turns.
        width: its width, turns.
        direction: 1 if angles grow as the sensor rotates, else -1.
    """

    start: float
    width: float
    direction: int

    @classmethod
    def between(cls, start: float, stop: float, direction: int) -> Sector:
        """Return the sector from one angle to another."""
        return cls(start, forward_step(stop - start, direction), direction)

    @property
    def stop(self) -> float:
        """The angle at which it ends, in turns."""
        return (self.start + self.direction * self.width) % 1

    @property
    def middle(self) -> float:
        """The angle in its middle, in turns."""
        return (self.start + self.direction * self.width / 2) % 1

    def contains(self, angle: float) -> bool:
        """Return whether an angle is in the sector."""
        return forward_step(angle - self.start, self.direction) < self.width

    def common(self, other: Sector) -> Sector | None:
        """Return the intersection of two sectors; None if they do not overlap."""
        offset = forward_step(other.start - self.start, self.direction)
        if offset < self.width:
            return Sector(other.start, min(self.width - offset, other.width), self.direction)
        if other.contains(self.start):
            return other.common(self)
        return None


def forward_step(step: float, direction: int) -> float:
    """Return a step in the direction of rotation, in turns from 0 to 1.

    A step back by less than `JITTER` counts as 0.
    """
    ahead = (direction * step) % 1
    if ahead > 1 - JITTER:
        return 0.0
    return ahead


class AngleReader:
    """A reader of the angle at which each packet begins, by the rule that cuts scans.

    Args:
        sensor: the sensor that sends the packets.

    Attributes:
        is_available: whether the rule uses an angle field of datagrams.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        rule = sensor.scan
        self._path = ""
        self._full: float | None = None
        self._grows = False
        if isinstance(rule, OnChange):
            self._path = rule.angle
            self._full = rule.full
            self._grows = True
        elif isinstance(rule, OnWrap) and rule.name not in COLUMNS:
            self._path = rule.name
        self.is_available = bool(self._path) and sensor.datagrams

    def angles(self, table: Table) -> Angles | None:
        """Return the angle at which each packet begins, (n,), in turns.

        Returns None if the packets do not have the field, or have no part with it.
        """
        if self.is_available:
            info = table.schema.fields.get(self._path)
        else:
            info = None
        if info is None or self._full is not None:
            full = self._full
        else:
            full = FULL_TURNS.get(info.unit)
        if info is None or full is None:
            return None
        raw = table.raw(self._path)
        if not raw.size:
            return None
        first = raw.reshape(len(raw), -1)[:, 0].astype(np.float64)
        return np.mod((first * info.scale + info.offset) / full, 1.0)

    def direction(self, table: Table) -> int:
        """Return the direction of rotation in the first packet of a table: 1 or -1.

        Returns 0 if the packet does not show the direction.
        """
        if self._grows:
            return 1
        info = table.schema.fields[self._path]
        rows = (
            table.raw(self._path)[:1].reshape(-1).astype(np.float64)
            * info.scale
            / FULL_TURNS[info.unit]
        )
        steps = np.diff(rows)
        balance = np.sign(steps - np.rint(steps)).sum()
        return int(np.sign(balance))


class SectorFinder:
    """The search for the masked sector of one stream.

    Args:
        direction: 1 if angles grow as the sensor rotates, else -1.

    Attributes:
        sector: the masked sector; None until it is found.
    """

    def __init__(self, direction: int) -> None:
        self.direction = direction
        self.sector: Sector | None = None
        self._seen = np.zeros(BINS, np.bool_)
        self._gaps = list[Sector]()

    def add_angles(self, angles: Angles) -> None:
        """Record that packets came from some angles."""
        if self.sector is None:
            self._seen[(angles * BINS).astype(np.intp) % BINS] = True

    def add_gap(self, start: float, stop: float, step: float) -> list[int]:
        """Compare a gap with earlier ones, and set `sector` if it recurs.

        Args:
            start, stop: the angles of the packets before and after the gap, turns.
            step: the angle from one packet to the next, turns. The edges of a gap may vary by about
                this much, because packets do not begin at the edges of the sector.

        Returns:
            The earlier gaps that contain the sector, each as its distance in gaps (1 is the last
            one). The list is empty if no sector is found.
        """
        gap = Sector.between(start, stop, self.direction)
        for other in reversed(self._gaps):
            common = gap.common(other)
            is_same = common is not None and common.width > COMMON_SHARE * max(
                gap.width, other.width
            )
            if common is not None and is_same and self._is_unseen(common, step):
                self.sector = common
                return [
                    ago
                    for ago, each in enumerate(reversed(self._gaps), start=1)
                    if each.contains(common.middle)
                ]
        self._gaps.append(gap)
        del self._gaps[:-REMEMBERED_GAPS]
        return []

    def has_unseen_gaps(self, step: float) -> bool:
        """Return whether any gap may still prove to be a masked sector."""
        return any(self._is_unseen(gap, step) for gap in self._gaps)

    def _is_unseen(self, sector: Sector, step: float) -> bool:
        """Return whether no packet began in a sector, apart from its edges.

        If the sector were not masked, at least one packet of each revolution would begin there.
        """
        edge = EDGE_STEPS * step + 1 / BINS
        inner = sector.width - 2 * edge
        if inner < step + 1 / BINS:
            return False
        count = round(inner * BINS)
        angles = sector.start + self.direction * (edge + np.arange(count + 1) / BINS)
        return not self._seen[(angles * BINS).astype(np.intp) % BINS].any()


class GapLoss(Protocol):
    """A gap that counts as a loss so far.

    Attributes:
        missing: the number of packets that count as lost.
        masked: the number of packets that a masked sector leaves out, which do not count as lost.
    """

    missing: int
    masked: int


class MaskedGaps:
    """Gaps at a masked sector of one stream, as distinct from losses.

    The packets may be in any order. A gap counts as a loss until it recurs one revolution later.

    Args:
        sensor: the sensor that sends the packets.

    Attributes:
        masked: the number of packets that the masked sector leaves out; 0 until it is known.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._reader = AngleReader(sensor)
        self._angles: Angles | None = None  # of the current packets
        self._first_unnoted = 0  # the first row that `_finder` has not seen
        self._finder: SectorFinder | None = None
        self._losses = list[GapLoss]()  # at the gaps that `_finder` remembers
        self.masked = 0  # packets that the masked sector leaves out

    def read(self, table: Table) -> None:
        """Read the angles of the next packets."""
        if self._angles is not None:
            self._note_until(len(self._angles))
        if len(table):
            self._angles = self._reader.angles(table)
        else:
            self._angles = None
        self._first_unnoted = 0
        if self._angles is not None and self._finder is None:
            direction = self._reader.direction(table)
            self._finder = SectorFinder(direction) if direction else None

    def _note_until(self, row: int) -> None:
        """Record that the current packets before a row came from unmasked angles."""
        if self._finder is not None and self._angles is not None:
            self._finder.add_angles(self._angles[self._first_unnoted : row])
        self._first_unnoted = row

    def forget(self) -> None:
        """Start again, since the next packets may come from a sensor set differently."""
        self._finder = None
        self._losses.clear()
        self.masked = 0

    def angle_at(self, row: int) -> float:
        """Return the angle of a row of the current packets, in turns; nan if unknown."""
        if self._angles is None:
            return math.nan
        return self._angles.item(row)

    def count_masked(self, start: float, stop: float, missing: int) -> int:
        """Return how many of the packets missing between two angles are masked.

        Returns 0 if no masked sector is known.
        """
        if self._finder is None:
            sector = None
        else:
            sector = self._finder.sector
        if sector is None or math.isnan(start) or math.isnan(stop):
            return 0
        if not Sector.between(start, stop, sector.direction).contains(sector.middle):
            return 0
        if missing <= self.masked + VARYING_PACKETS:
            return missing
        return min(self.masked, missing)

    def find_unlost(self, row: int, start: float, stop: float, loss: GapLoss) -> int:
        """Compare a loss with earlier ones; if it recurs, mark these losses as masked.

        Args:
            row: the packet after the loss.
            start, stop: the angles of the packets before and after the loss, turns.
            loss: its counts, which are changed if it recurs.

        Returns:
            The number of packets that were counted as lost but are masked.
        """
        finder = self._finder
        if finder is None or finder.sector is not None or math.isnan(start) or math.isnan(stop):
            return 0
        width = forward_step(stop - start, finder.direction)
        step = width / (loss.missing + 1)
        if width < max(MIN_WIDTH, MIN_WIDTH_STEPS * step):
            return 0
        self._note_until(row)
        ago = finder.add_gap(start, stop, step)
        if not ago:
            self._losses.append(loss)
            del self._losses[:-REMEMBERED_GAPS]
            return 0
        losses = [self._losses[-each] for each in ago]
        self.masked = max(loss.missing, losses[0].missing)
        unlost = 0
        for each in (*losses, loss):
            unlost += each.missing
            each.masked = each.missing
            each.missing = 0
        return unlost
