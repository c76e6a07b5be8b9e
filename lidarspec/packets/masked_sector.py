"""Detect masked sectors, in which a rotating sensor sends no packets.

A user can configure many rotating sensors to mask a part of each revolution. At a masked sector,
the time and the angle advance as if packets were lost. A gap is a masked sector if it recurs at the
same angles and no packet has ever come from these angles.

All angles are in turns, from 0 to 1. Widths are measured in the direction of rotation.
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

#: A whole turn in each unit of angles.
FULL_TURNS = {"deg": 360.0, "rad": 2 * np.pi}
#: The number of equal parts of a turn. A part is marked if a packet has begun in it.
ANGLE_BINS = 360
#: The minimum width of a masked sector, in turns.
MIN_WIDTH_TURNS = 1 / 36
#: The minimum width of a masked sector, in steps from packet to packet.
MIN_WIDTH_STEPS = 4
#: The variation of the edges of a gap, in steps from packet to packet.
EDGE_STEPS = 1.25
#: A step back by less than this, in turns, is jitter of the angle.
MAX_JITTER_TURNS = 1 / 200
#: Two gaps belong to one sector if they overlap by more than this share of the wider gap.
MIN_COMMON_SHARE = 0.5
#: The number of earlier gaps that a new gap is compared with.
REMEMBERED_GAPS = 16
#: The number of packets in the gap of a masked sector may vary by this number, because packets do
#: not begin exactly at its edges.
VARYING_PACKETS = 2


@dataclass(frozen=True)
class Sector:
    """A sector of a revolution.

    Attributes:
        start: the angle at which the sector begins, in turns.
        width: the width of the sector, in turns.
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
        """The angle at which the sector ends, in turns."""
        return (self.start + self.direction * self.width) % 1

    @property
    def middle(self) -> float:
        """The angle in the middle of the sector, in turns."""
        return (self.start + self.direction * self.width / 2) % 1

    def contains(self, angle: float) -> bool:
        """Return whether an angle is in the sector."""
        return forward_step(angle - self.start, self.direction) < self.width

    def intersect(self, other: Sector) -> Sector | None:
        """Return the overlap of two sectors; None if they do not overlap."""
        offset = forward_step(other.start - self.start, self.direction)
        if offset < self.width:
            return Sector(other.start, min(self.width - offset, other.width), self.direction)
        if other.contains(self.start):
            return other.intersect(self)
        return None


def forward_step(step: float, direction: int) -> float:
    """Return the angle of a step in the direction of rotation, in turns from 0 to 1.

    A small step back is jitter of the angle, and gives 0.

    Args:
        step: the angle after the step minus the angle before it, in turns.
        direction: 1 if angles grow as the sensor rotates, else -1.
    """
    ahead = (direction * step) % 1
    if ahead > 1 - MAX_JITTER_TURNS:
        return 0.0
    return ahead


class AngleReader:
    """Reads the angle at which each packet begins.

    Attributes:
        is_available: whether the sensor sends datagrams and its scans are cut by an angle field.
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
        """Return the angle at which each packet begins, (n,), in turns; None if unknown."""
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
        """Return the direction of rotation in the first packet: 1 or -1; 0 if unknown."""
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
    """Searches for the masked sector of one stream.

    Args:
        direction: 1 if angles grow as the sensor rotates, else -1.

    Attributes:
        sector: the masked sector; None until it is found.
    """

    def __init__(self, direction: int) -> None:
        self.direction = direction
        self.sector: Sector | None = None
        self._seen = np.zeros(ANGLE_BINS, np.bool_)
        self._gaps = list[Sector]()

    def add_angles(self, angles: Angles) -> None:
        """Record that packets came from some angles."""
        if self.sector is None:
            self._seen[(angles * ANGLE_BINS).astype(np.intp) % ANGLE_BINS] = True

    def add_gap(self, start: float, stop: float, step: float) -> list[int]:
        """Compare a gap with earlier gaps, and set `sector` if it recurs.

        Args:
            start: the angle of the packet before the gap, in turns.
            stop: the angle of the packet after the gap, in turns.
            step: the angle from one packet to the next, in turns.

        Returns:
            How many gaps ago each earlier gap at the sector was, 1 for the previous gap; [] if the
            gap does not recur.
        """
        gap = Sector.between(start, stop, self.direction)
        for other in reversed(self._gaps):
            common = gap.intersect(other)
            is_same = common is not None and common.width > MIN_COMMON_SHARE * max(
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

    def may_have_masked_sector(self, step: float) -> bool:
        """Return whether one of the stored gaps may be at a masked sector."""
        return any(self._is_unseen(gap, step) for gap in self._gaps)

    def _is_unseen(self, sector: Sector, step: float) -> bool:
        """Return whether no packet has begun in a sector; False for a narrow sector."""
        edge = EDGE_STEPS * step + 1 / ANGLE_BINS
        inner = sector.width - 2 * edge
        if inner < step + 1 / ANGLE_BINS:
            return False
        count = round(inner * ANGLE_BINS)
        angles = sector.start + self.direction * (edge + np.arange(count + 1) / ANGLE_BINS)
        return not self._seen[(angles * ANGLE_BINS).astype(np.intp) % ANGLE_BINS].any()


class GapLoss(Protocol):
    """A gap that counts as a loss until a masked sector explains it.

    Attributes:
        missing: the number of packets that count as lost.
        masked: the number of packets of the gap that a masked sector leaves out.
    """

    missing: int
    masked: int


class MaskedGaps:
    """Decides which gaps in one stream are at the masked sector, and which are losses.

    Attributes:
        masked: the number of packets that the masked sector leaves out in each revolution; 0 until
            the sector is found.
    """

    def __init__(self, sensor: SensorDescription) -> None:
        self._reader = AngleReader(sensor)
        self._angles: Angles | None = None  # of the current packets
        self._first_unrecorded = 0  # the first row that `_finder` has not seen
        self._finder: SectorFinder | None = None
        self._losses = list[GapLoss]()  # at the gaps that `_finder` remembers
        self.masked = 0  # packets that the masked sector leaves out

    def read(self, table: Table) -> None:
        """Read the angles of the next packets."""
        if self._angles is not None:
            self._record_angles_before(len(self._angles))
        if len(table):
            self._angles = self._reader.angles(table)
        else:
            self._angles = None
        self._first_unrecorded = 0
        if self._angles is not None and self._finder is None:
            direction = self._reader.direction(table)
            self._finder = SectorFinder(direction) if direction else None

    def _record_angles_before(self, row: int) -> None:
        """Record that the angles of the current packets before a row are not masked."""
        if self._finder is not None and self._angles is not None:
            self._finder.add_angles(self._angles[self._first_unrecorded : row])
        self._first_unrecorded = row

    def forget(self) -> None:
        """Forget the masked sector, because the sensor may have been configured again."""
        self._finder = None
        self._losses.clear()
        self.masked = 0

    def angle_at(self, row: int) -> float:
        """Return the angle of a row of the current packets, in turns; nan if unknown."""
        if self._angles is None:
            return math.nan
        return self._angles.item(row)

    def count_masked(self, start: float, stop: float, missing: int) -> int:
        """Return how many missing packets a masked sector leaves out; 0 without a sector.

        Args:
            start: the angle of the packet before the gap, in turns.
            stop: the angle of the packet after the gap, in turns.
            missing: the number of packets missing between them.
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

    def revoke_losses(self, row: int, start: float, stop: float, loss: GapLoss) -> int:
        """Count a recurring loss, and earlier losses at the same angles, as masked.

        Args:
            row: the row of the packet after the loss.
            start: the angle of the packet before the loss, in turns.
            stop: the angle of the packet after the loss, in turns.
            loss: the counts of the loss, which this method changes.

        Returns:
            The number of packets that no longer count as lost.
        """
        finder = self._finder
        if finder is None or finder.sector is not None or math.isnan(start) or math.isnan(stop):
            return 0
        width = forward_step(stop - start, finder.direction)
        step = width / (loss.missing + 1)
        if width < max(MIN_WIDTH_TURNS, MIN_WIDTH_STEPS * step):
            return 0
        self._record_angles_before(row)
        ago = finder.add_gap(start, stop, step)
        if not ago:
            self._losses.append(loss)
            del self._losses[:-REMEMBERED_GAPS]
            return 0
        losses = [self._losses[-each] for each in ago]
        self.masked = max(loss.missing, losses[0].missing)
        revoked = 0
        for each in (*losses, loss):
            revoked += each.missing
            each.masked = each.missing
            each.missing = 0
        return revoked
