"""The columns of points, made when they are asked for: of a batch, or of a stretch of the stream over several batches.

A batch makes a column for all its points at once, and slices of it share that. A scan of many points is a `Stretches`: its
columns are made for the packets that it is of and no others, straight into arrays of its own.
"""

from __future__ import annotations

import bisect
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.graph import Node
from lidarspec.packets.packets import Packets
from lidarspec.points.cloud import Columns, axis_matrix, narrowed
from lidarspec.points.numba_kernels.kernels import spread_out
from lidarspec.points.plain import points_function

if TYPE_CHECKING:
    from lidarspec.points.evaluate import Share

_MAIN = ("x", "y", "z", "intensity")

#: points of a scan from which on its columns are made for itself; smaller ones share those of so many points.
LEAST, SHARED = 1 << 14, 1 << 16


class Made(Columns):
    """Columns by name, each made once."""

    def __init__(self, packets: Packets, shares: Sequence[Share], size: int) -> None:
        self.size, self._packets, self._shares = size, packets, shares
        self._function = points_function(packets.sensor, packets.frame)
        self._made: dict[str, NDArray[Any]] = {}
        axes = packets.sensor.vendor_axes if packets.sensor.options.get("frame") == "vendor" else None
        self._turn = None if axes is None else axis_matrix(axes)

    def column(self, name: str) -> NDArray[Any] | None:
        """A column of `PointCloud`; None where the sensor has none."""
        if name not in self._made:
            self._made |= self._columns(name)
        return self._made.get(name)

    @abstractmethod
    def _programmed(self, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        """Columns that programs or kernels make."""

    @abstractmethod
    def _plain(self, name: str) -> NDArray[Any]:
        """A part of what `points` returned, evaluated plainly."""

    @abstractmethod
    def _times(self) -> NDArray[np.float64]:
        """The column "time"."""

    def _columns(self, name: str) -> dict[str, NDArray[Any]]:
        parts = self._shares[0].plan.parts
        if name in _MAIN:
            return self._coordinates(name, parts)
        if name == "valid":
            x = self.column("x")
            assert x is not None
            return {"valid": ~np.isnan(x)}
        if name in ("range", "azimuth"):
            found = self._programmed(("range", "azimuth") if self._packets.backend == "jit" else (name,))
            return found | {"azimuth": self._azimuth(found["azimuth"])} if "azimuth" in found else found
        if name == "time":
            return {name: self._times()}
        if name == "elevation":
            return {name: self._plain(name).astype(np.float32, copy=False)}
        types: dict[str, Any] = {"ring": np.uint16, "return_index": np.uint8}
        return {name: np.nan_to_num(self._plain(name)).astype(types[name], copy=False)} if name in parts else {}

    def _coordinates(self, name: str, parts: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
        """The columns that are made together; where all points are level, the height only when it is asked for."""
        level = self._turn is None and all(share.plan.level for share in self._shares)
        if level and name == "z":
            x = self.column("x")
            assert x is not None
            return {"z": np.where(np.isnan(x), x, np.float32(0))}
        return self._turned(self._programmed(tuple(n for n in _MAIN if n in parts or (n in "xyz" and not (level and n == "z")))))

    def _azimuth(self, angles: NDArray[Any]) -> NDArray[np.float32]:
        """Azimuths in the axes that are asked for, narrowed where a kernel has not done so."""
        if self._turn is None and angles.dtype == np.float32:
            return angles
        if self._turn is not None:
            direction = self._turn[:2, :2] @ np.stack([np.cos(angles), np.sin(angles)])
            angles = np.arctan2(direction[1], direction[0])
        return narrowed(angles)

    def _turned(self, found: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Coordinates in the vendor's axes, where those are asked for; each is one of REP-103's, or its opposite."""
        if self._turn is None:
            return found
        made = dict(found)
        for name, row in zip("xyz", self._turn, strict=True):
            source = int(np.flatnonzero(row)[0])
            made[name] = found["xyz"[source]] * np.float32(row[source])
        return made


class Block(NamedTuple):
    """Points of a batch, from `start` to `stop`, and the columns made of them so far."""

    start: int
    stop: int
    made: dict[str, NDArray[Any]]


class Points(Made):
    """The points of a batch; what a `LazyCloud` reads from.

    Args:
        base: the time that times count from, ns.
    """

    def __init__(self, packets: Packets, shares: Sequence[Share], size: int, base: int) -> None:
        super().__init__(packets, shares, size)
        self.base = base
        self._blocks: list[Block] = []

    @property
    def even(self) -> Share | None:
        """The share of all packets, where they have one layout and stand in order."""
        return self._shares[0] if len(self._shares) == 1 and self._shares[0].first is None else None

    def has(self, name: str) -> bool:
        """Whether a column is made already."""
        return name in self._made

    def stretch(self, start: int, stop: int) -> Columns:
        return Stretches([Stretch(self, start, stop)])

    def part(self, name: str, start: int, stop: int) -> NDArray[Any] | None:
        """A column of some points; those behind them have it made too, for whoever asks for them next."""
        if self.even is None or self.has(name) or self.size <= SHARED:
            column = self.column(name)
            return None if column is None else column[start:stop]
        found, at = [], start
        while at < stop:
            first, end, made = self._block(at)
            column = Stretches([Stretch(self, first, end)], made).column(name)
            if column is None:
                return None
            found.append(column[at - first : stop - first])
            at = end
        return found[0] if len(found) == 1 else np.concatenate(found)

    def _block(self, at: int) -> Block:
        """The points around one that have their columns made together; they are in no other block."""
        index = bisect.bisect(self._blocks, at, key=lambda block: block.start)
        if index and at < self._blocks[index - 1].stop:
            return self._blocks[index - 1]
        width = self._shares[0].plan.width
        after = self._blocks[index].start if index < len(self._blocks) else self.size
        start = at // width * width
        block = Block(start, min(start + max(SHARED // width, 1) * width, after), {})
        self._blocks.insert(index, block)
        return block

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        share = self.even
        if share is None or self.has("time"):
            return cast("NDArray[np.float64]", self.column("time"))[indices]
        packets, spots = np.divmod(indices, share.plan.width)
        after = share.plan.parts["time"]
        few = share.some(packets).plain(after) if isinstance(after, Node) else share.plain(after)[packets]
        offsets = (self._packets.time_ns[packets] - self.base) * 1e-9
        return np.asarray(few.reshape(len(packets), -1)[np.arange(len(packets)), spots] + offsets)

    def times_of(self, share: Share, first: int, stop: int) -> NDArray[np.float64]:
        """The times of all points of some packets of a share, as many axes as those have."""
        offsets = (self._packets.time_ns[share.group.where[first:stop]] - self.base) * 1e-9
        return np.asarray(share.plain(share.plan.parts["time"])[first:stop] + offsets.reshape(-1, *(1,) * len(share.plan.shape)))

    def _times(self) -> NDArray[np.float64]:
        return self._joined([self.times_of(share, 0, len(share.group.where)) for share in self._shares], np.float64)

    def _plain(self, name: str) -> NDArray[Any]:
        found = [share.plain(share.plan.parts[name]) for share in self._shares]
        return self._joined(found, np.result_type(*found))

    def _programmed(self, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        found = [share.program(names, self._function, self._packets.backend) for share in self._shares]
        return {name: self._joined([part[name] for part in found], found[0][name].dtype) for name in names}

    def _joined(self, parts: list[NDArray[Any]], dtype: Any) -> NDArray[Any]:
        """The points of all layouts in stream order, those of packets that wait left out."""
        if self.even is not None:
            flat = parts[0].reshape(-1)[: self.size]
            return flat.astype(dtype, copy=False)
        found = np.empty(self.size, dtype)
        for share, part in zip(self._shares, parts, strict=True):
            assert share.first is not None
            spread_out(part.reshape(-1), share.first, share.plan.width, found, compiled=self._packets.backend == "jit")
        return found


@dataclass(frozen=True, eq=False)
class Stretch:
    """Consecutive points of a batch."""

    points: Points
    start: int
    stop: int


class Stretches(Made):
    """Consecutive points of a stream, each stretch of another batch.

    Args:
        made: columns made before, to be added to; then all are made for these points alone, however few they are.
    """

    def __init__(self, parts: Sequence[Stretch], made: dict[str, NDArray[Any]] | None = None) -> None:
        first = parts[0].points
        super().__init__(first._packets, first._shares, sum(part.stop - part.start for part in parts))
        self._parts = parts
        self._stands_alone = (self.size >= LEAST or made is not None) and self._is_even()
        self._made = self._made if made is None else made

    def _is_even(self) -> bool:
        """Whether the packets all have one layout, and are whole but for the first and the last one."""
        shares = [part.points.even for part in self._parts]
        width = self._shares[0].plan.width
        inner = [*(part.stop for part in self._parts[:-1]), *(part.start for part in self._parts[1:])]
        return all(share is not None and share.plan is self._shares[0].plan for share in shares) and not any(at % width for at in inner)

    def column(self, name: str) -> NDArray[Any] | None:
        if name in self._made or (self._stands_alone and not all(part.points.has(name) for part in self._parts)):
            return super().column(name)
        found = [part.points.part(name, part.start, part.stop) for part in self._parts]
        if any(column is None for column in found):
            return None
        slices = cast("list[NDArray[Any]]", found)
        if name == "time":
            slices = [column + self._later(part) for column, part in zip(slices, self._parts, strict=True)]
        return slices[0] if len(slices) == 1 else np.concatenate(slices)

    def followed(self, others: Sequence[Columns]) -> Columns | None:
        parts = [*self._parts]
        for other in others:
            if not isinstance(other, Stretches):
                return None
            parts += other._parts
        return Stretches(parts)

    def times_at(self, indices: NDArray[np.intp]) -> NDArray[np.float64]:
        found, start = np.empty(len(indices)), 0
        for part in self._parts:
            stop = start + part.stop - part.start
            inside = (indices >= start) & (indices < stop)
            if inside.any():
                found[inside] = part.points.times_at(indices[inside] - start + part.start) + self._later(part)
            start = stop
        return found

    def _later(self, part: Stretch) -> float:
        """What times of a batch count from, after what those of the first one do; seconds."""
        return (part.points.base - self._parts[0].points.base) * 1e-9

    def _programmed(self, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        head, parts = self._shares[0], self._packets_of()
        number = sum(stop - first for _, _, first, stop in parts)
        maker = head.maker(names, self._function, self._packets.backend, number)
        found, start = maker.columns(number), 0
        for _, share, first, stop in parts:
            end = start + (stop - first) * head.plan.width
            share.fill(maker, {name: column[start:end] for name, column in found.items()}, first, stop)
            start = end
        return {name: self._trimmed(column) for name, column in found.items()}

    def _plain(self, name: str) -> NDArray[Any]:
        found = [share.plain(share.plan.parts[name])[first:stop].reshape(-1) for _, share, first, stop in self._packets_of()]
        return self._trimmed(np.concatenate(found))

    def _times(self) -> NDArray[np.float64]:
        found = [part.points.times_of(share, first, stop) + self._later(part) for part, share, first, stop in self._packets_of()]
        return self._trimmed(np.concatenate([times.reshape(-1) for times in found]))

    def _packets_of(self) -> list[tuple[Stretch, Share, int, int]]:
        """The first packet of each part, and the one after its last, with their share."""
        width = self._shares[0].plan.width
        return [(part, cast("Share", part.points.even), part.start // width, -(-part.stop // width)) for part in self._parts]

    def _trimmed(self, column: NDArray[Any]) -> NDArray[Any]:
        """A column of whole packets without the points before and after."""
        skipped = self._parts[0].start % self._shares[0].plan.width
        return column[skipped : skipped + self.size]
