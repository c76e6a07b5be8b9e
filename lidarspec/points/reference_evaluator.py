"""Evaluate points with ordinary NumPy: the reference evaluator.

The sensor's `points` function is called once per batch with columns as NumPy arrays, and its result
is flattened. This evaluator is used if `points` cannot be traced, and as the reference in tests.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import plugin_errors
from lidarspec.expressions.columns import Batch, Carry, Fields, align_points, make_value_mask
from lidarspec.frames.frame_table import Table
from lidarspec.framing.results import Counters
from lidarspec.points import conventions
from lidarspec.points.cloud import CloudColumns, LazyCloud, PointCloud, find_organised_shape
from lidarspec.points.column_sources import ColumnSource
from lidarspec.points.conventions import ExtraType
from lidarspec.spec.results import Cartesian, Points, Polar
from lidarspec.spec.sensor import SensorDescription

_OPTIONAL = ("intensity", "ring", "return_index", "column")


class PacketBatch(Protocol):
    """The attributes of `Packets` that evaluation needs.

    Attributes:
        table: the raw columns of the frames.
        time_ns: the times of the packets, (n,) int64 ns.
        stats: the counters of the decoder.
        backend: the back end that computes points: "auto", "numpy" or "jit".
    """

    sensor: SensorDescription
    frame: str
    table: Table
    time_ns: NDArray[np.int64]
    stats: Counters
    backend: str

    def __len__(self) -> int: ...

    def batch(self, carry: Carry | None = None) -> Batch:
        """Return the batch that plugin functions read through `Fields`.

        Args:
            carry: the state left by the previous batch.
        """


@dataclass(frozen=True, eq=False)
class EvaluatedPoints:
    """The points of the first `ready` packets of a batch.

    Attributes:
        source: the columns of the points, flat, in stream order.
        ready: the number of packets with points; all later packets wait for the next batch.
        counts: 1 for each point and 0 for padding, (ready, ...). The axes after the first are those
            of the nested arrays that contain the points.
        axes: the names of the axes of `counts` after the first.
        batch: all packets of the batch.
    """

    source: ColumnSource
    ready: int
    counts: NDArray[np.intp]
    axes: tuple[str | None, ...]
    batch: Batch

    @cached_property
    def cloud(self) -> LazyCloud:
        """The cloud of the points."""
        return LazyCloud.of(self.source, self.source.base)

    @property
    def carry(self) -> Carry:
        """The values to pass to the next batch, which starts with packet `ready`."""
        return self.batch.carry_over(self.ready)

    @property
    def fields(self) -> Fields:
        """The fields of all packets of the batch."""
        return Fields(self.batch)


def evaluate_plainly(
    packets: PacketBatch,
    carry: Carry | None = None,
    *,
    final: bool = True,
    stamp_ns: int | None = None,
) -> EvaluatedPoints:
    """Return the points of a batch, computed by the reference evaluator.

    Args:
        carry: the state left by the previous batch.
        final: whether no packets follow. If True, the result has the points of all packets.
        stamp_ns: the stamp of the cloud, int64 ns; by default the time of the first packet.

    Raises:
        PluginError: if the plugin's function fails or returns columns of a wrong shape.
    """
    batch = packets.batch(carry)
    function = packets.sensor.points_of(packets.frame)
    with (
        plugin_errors(f"points of {packets.frame}", packets.sensor.id, function),
        np.errstate(all="ignore"),
    ):
        result = function(Fields(batch))
        if not isinstance(result, Polar | Cartesian):
            raise TypeError(
                f"the function must return Polar or Cartesian, got {type(result).__name__}"
            )
        return _make_points(packets, result, batch, find_stamp(packets, stamp_ns), final=final)


def find_stamp(packets: PacketBatch, stamp_ns: int | None) -> int:
    """Return the stamp of a cloud, int64 ns: `stamp_ns`, or else the time of the first packet."""
    if stamp_ns is not None:
        return stamp_ns
    if len(packets):
        return int(packets.time_ns[0])
    return 0


def list_parts(result: Points) -> dict[str, Any]:
    """Return the parts of a `points` result by name, without missing parts."""
    parts = {
        f.name: getattr(result, f.name)
        for f in fields(result)
        if f.name not in ("nominal", "extra")
    }
    if isinstance(result, Polar):
        parts |= dict(zip(("ox", "oy", "oz"), parts.pop("origin"), strict=True))
    parts |= {name: extra.values for name, extra in result.extra.items()}
    return {name: value for name, value in parts.items() if value is not None}


def list_extra_types(result: Points, parts: Mapping[str, Any]) -> dict[str, ExtraType]:
    """Return the types of the columns in `extra`, by name."""
    return {name: ExtraType.of(extra, parts[name]) for name, extra in result.extra.items()}


def _make_points(
    packets: PacketBatch, result: Points, batch: Batch, stamp_ns: int, *, final: bool
) -> EvaluatedPoints:
    parts = list_parts(result)
    arrays, axes, ready, shape = align_points(parts, batch)
    ready = len(packets) if final else ready
    mask = make_value_mask(axes, shape, batch)
    every = {
        name: flatten_points(array, shape, mask, ready)
        for name, array in zip(parts, arrays, strict=True)
    }
    offsets = conventions.seconds_since(packets.time_ns, stamp_ns).reshape(-1, *(1,) * len(axes))
    every["time"] = every["time"] + flatten_points(offsets, shape, mask, ready)
    if mask is None:
        inside = np.ones(shape, np.bool_)
    else:
        inside = mask.reshape(shape)
    cloud = make_cloud(
        every,
        conventions.vendor_turn(packets.sensor),
        list_extra_types(result, parts),
        stamp_ns=stamp_ns,
        shape=find_organised_shape(len(every["time"]), conventions.make_grid(shape[1:], axes)),
        nominal=np.bool_(batch.nominal or result.nominal),
    )
    grids = None
    if mask is not None:
        grids = _find_grids(inside, axes)
    counts = inside[:ready].astype(np.intp)
    return EvaluatedPoints(CloudColumns(cloud, grids), ready, counts, axes, batch)


def _find_grids(inside: NDArray[np.bool_], axes: tuple[str | None, ...]) -> conventions.Grids:
    """Return the organisation of the points of each packet.

    Args:
        inside: whether an element of the arrays is a point and not padding, (n, ...).
    """
    inner = range(1, inside.ndim)
    lengths = np.stack(
        [
            inside.any(axis=tuple(other for other in inner if other != axis)).sum(axis=1)
            for axis in inner
        ],
        axis=1,
    )
    counts = inside.sum(axis=tuple(inner))
    lengths[lengths.prod(axis=1) != counts] = 0  # a packet with rows of several lengths has no grid
    shapes, which = np.unique(lengths, axis=0, return_inverse=True)
    grids = [conventions.make_grid(shape, axes) for shape in shapes.tolist()]
    return conventions.Grids(np.cumsum(counts), which.reshape(-1), grids)


def flatten_points(
    array: NDArray[Any], shape: tuple[int, ...], mask: NDArray[np.bool_] | None, ready: int
) -> NDArray[Any]:
    """Broadcast an array to a shape, and return the values of the points, (N,).

    Args:
        mask: True for points, False for padding; None if there is no padding.
        ready: the number of packets whose points are returned.
    """
    full = np.broadcast_to(array, shape)[:ready]
    if mask is None:
        return full.reshape(-1)
    return full.reshape(mask[:ready].shape)[mask[:ready]]


def make_cloud(
    flat: dict[str, NDArray[Any]],
    turn: NDArray[np.float64] | None,
    kinds: Mapping[str, ExtraType],
    **facts: Any,
) -> PointCloud:
    """Return a cloud from flat columns.

    Args:
        flat: the parts of `Polar` (with ox, oy, oz) or `Cartesian`, (N,) each.
        turn: the (3, 3) matrix from REP-103 to the configured axes; None if they are equal.
        kinds: the types of the columns in `extra`, by name.
        facts: `stamp_ns`, `shape` and `nominal` of the cloud.
    """
    with np.errstate(all="ignore"):
        distance, azimuth, elevation, xyz = (_place_cartesian if "x" in flat else _place_polar)(
            flat, flat["invalid"].astype(np.bool_)
        )
        is_finite = np.isfinite(azimuth) & np.isfinite(elevation) & np.isfinite(xyz).all(axis=0)
        valid = is_finite & (np.abs(distance) <= conventions.MAX_COORDINATE_M)
        if turn is not None:
            xyz = turn @ np.where(valid, xyz, 0)
            azimuth = conventions.turn_azimuth(azimuth, turn)
        angles = {
            "azimuth": conventions.narrow_angle(azimuth),
            "elevation": elevation.astype(np.float32),
        }
        columns = (
            dict(zip("xyz", np.where(valid, xyz, np.nan).astype(np.float32), strict=True)) | angles
        )
        columns |= {
            name: conventions.convert_numbers(flat[name], conventions.TYPES[name])
            for name in _OPTIONAL
            if name in flat
        }
        extra = {name: kind.column(flat[name]) for name, kind in kinds.items()}
        units = {name: kind.unit for name, kind in kinds.items()}
        columns |= {
            "range": distance.astype(np.float32),
            "time": np.array(flat["time"], np.float64),
            "valid": valid,
        }
        return PointCloud(**columns, extra=extra, units=units, **facts)


#: The range, azimuth and elevation of points, (N,) each, and their coordinates, (3, N).
_Placement = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[np.float64]]


def _place_polar(flat: dict[str, NDArray[Any]], invalid: NDArray[np.bool_]) -> _Placement:
    measured, azimuth, elevation = (
        flat[name].astype(np.float64) for name in ("range", "azimuth", "elevation")
    )
    distance = conventions.shown_range(measured, invalid)
    places = conventions.coordinates(
        distance, azimuth, elevation, [flat[name] for name in ("ox", "oy", "oz")]
    )
    return distance, azimuth, elevation, np.stack(places) + 0.0  # -0.0 becomes 0.0


def _place_cartesian(flat: dict[str, NDArray[Any]], invalid: NDArray[np.bool_]) -> _Placement:
    places = [flat[name].astype(np.float64) for name in "xyz"]
    measured, azimuth, elevation = conventions.find_direction(*places)
    return (
        conventions.shown_range(measured, invalid),
        azimuth,
        elevation,
        np.stack(conventions.place_points(places, invalid)),
    )
