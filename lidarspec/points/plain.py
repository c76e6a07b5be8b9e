"""From packets to points: the sensor's `points` function evaluated once per batch, and its result flattened.

The plain evaluation: ordinary NumPy on `Column`s. Masks, coordinates and REP-117 are made here for every sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.columns.columns import Batch, Carry, Column, Fields, aligned, unpadded
from lidarspec.errors import SpecError
from lidarspec.packets.packets import Packets
from lidarspec.points.cloud import PointCloud, axis_matrix, narrowed
from lidarspec.spec.description import Spec
from lidarspec.spec.results import Cartesian, Points, Polar

_OPTIONAL = ("intensity", "ring", "return_index")


@dataclass(frozen=True, eq=False)
class Evaluated:
    """The points of the first `ready` packets of a batch.

    Attributes:
        cloud: they, flat, in stream order.
        ready: how many packets they are of; the others wait for what follows.
        carry: what the evaluation of the next batch needs, which starts with packet `ready`.
        counts: (ready, ...) points of each packet, with an axis for each array level, padding left out.
        fields: the columns of the batch, for the splitting into scans.
        axes: names of the axes of `counts` after the first.
    """

    cloud: PointCloud
    ready: int
    carry: Carry
    counts: NDArray[np.intp]
    fields: Fields
    axes: tuple[str | None, ...]


def points_function(sensor: Spec, frame: str) -> Callable[[Any], Points]:
    """The function that makes points of this frame type.

    Raises:
        SpecError: where the frame type has no points.
    """
    function = sensor.frames[frame].points or (sensor.points if sensor.frames[frame].data else None)
    if function is None:
        raise SpecError("this frame type has no points", path=frame, sensor=sensor.id)
    return function


def evaluate(packets: Packets, carry: Carry | None = None, *, final: bool = True, epoch: int | None = None) -> Evaluated:
    """The points of a batch.

    Args:
        carry: what the batch before left.
        final: nothing follows; what depends on it becomes nan (by `following`), and no packet waits.
        epoch: the time that the cloud's stamp is, int64 ns; by default that of the first packet.

    Raises:
        SpecError: where the plugin's function fails or returns columns that do not fit; the cause is chained.
    """
    batch = packets.batch(carry)
    found = Fields(batch)
    place = f"points of {packets.frame}"
    try:
        with np.errstate(all="ignore"):
            result = points_function(packets.sensor, packets.frame)(found)
            if not isinstance(result, Polar | Cartesian):
                raise TypeError(f"has to return Polar or Cartesian, not {type(result).__name__}")
            return _flattened(packets, result, columns_of(result, batch), batch, found, final=final, epoch=epoch)
    except Exception as error:
        raise SpecError(f"{type(error).__name__}: {error}", path=place, sensor=packets.sensor.id) from error


def columns_of(result: Points, batch: Batch) -> dict[str, Column]:
    """The parts of the result as columns; numbers and arrays get the batch's axes."""
    parts = {f.name: getattr(result, f.name) for f in fields(result) if f.name != "nominal"}
    if isinstance(result, Polar):
        parts |= dict(zip(("ox", "oy", "oz"), parts.pop("origin"), strict=True))
    depth = max([batch.table.schema.depth(), *(len(value.axes) for value in parts.values() if isinstance(value, Column))])
    anchor = Column(np.zeros((1,) * (1 + depth)), (None,) * depth, batch)
    return {name: value if isinstance(value, Column) else _anchored(value, anchor) for name, value in parts.items() if value is not None}


def _anchored(value: Any, anchor: Column) -> Column:
    (array, _), axes, ready = aligned((value, anchor), anchor.batch)
    return Column(array.reshape((1,) * (1 + len(axes) - array.ndim) + array.shape), axes, anchor.batch, ready=ready)


def _flattened(
    packets: Packets, result: Points, columns: dict[str, Column], batch: Batch, found: Fields, *, final: bool, epoch: int | None
) -> Evaluated:
    arrays, axes, ready = aligned(tuple(columns.values()), batch)
    ready = len(packets) if final else ready
    shape = np.broadcast_shapes((len(packets),) + (1,) * len(axes), *(array.shape for array in arrays))
    mask = unpadded(axes, shape, batch)
    flat = {name: _flat(array, shape, mask, ready) for name, array in zip(columns, arrays, strict=True)}
    base = epoch if epoch is not None else int(packets.time_ns[0]) if len(packets) else 0
    offsets = ((packets.time_ns - base) * 1e-9).reshape(-1, *(1,) * len(axes))
    flat["time"] = flat["time"] + _flat(offsets, shape, mask, ready)
    inside = np.ones(shape, np.bool_) if mask is None else mask.reshape(shape)
    organised = mask is None and len(axes) >= 2 and shape[-1] > 1
    cloud = make_cloud(
        flat,
        vendor_axes=packets.sensor.vendor_axes if packets.sensor.options.get("frame") == "vendor" else None,
        stamp_ns=base,
        shape=(ready * int(np.prod(shape[1:-1])), shape[-1]) if organised else None,
        nominal=np.bool_(batch.nominal or result.nominal),
    )
    return Evaluated(cloud, ready, batch.carried(ready), inside[:ready].astype(np.intp), found, axes)


def _flat(array: NDArray[Any], shape: tuple[int, ...], mask: NDArray[np.bool_] | None, ready: int) -> NDArray[Any]:
    full = np.broadcast_to(array, shape)[:ready]
    return full.reshape(-1) if mask is None else full.reshape(mask[:ready].shape)[mask[:ready]]


def make_cloud(flat: dict[str, NDArray[Any]], **extra: Any) -> PointCloud:
    """A cloud from flat columns of `Polar` (with ox, oy, oz) or `Cartesian`, by the rules of DESIGN 3.1."""
    vendor_axes = extra.pop("vendor_axes", None)
    with np.errstate(all="ignore"):
        polar = flat if "range" in flat else _polar(flat)
        distance = np.where(polar["range"] == 0, np.inf, np.where(polar["range"] < 0, np.nan, polar["range"]).astype(np.float64))
        distance = np.where(flat["invalid"].astype(np.bool_), np.nan, distance)
        azimuth, elevation = (polar[name].astype(np.float64) for name in ("azimuth", "elevation"))
        valid = np.isfinite(distance) & np.isfinite(azimuth) & np.isfinite(elevation)
        xyz = _xyz(flat, distance, azimuth, elevation)
        valid &= np.isfinite(xyz).all(axis=0)
        if vendor_axes is not None:
            turn = axis_matrix(vendor_axes)
            xyz = turn @ np.where(valid, xyz, 0)
            direction = turn @ np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)])
            azimuth = np.arctan2(direction[1], direction[0])
        xyz = np.where(valid, xyz, np.nan).astype(np.float32)
        types = {"intensity": np.float32, "ring": np.uint16, "return_index": np.uint8}
        optional = {name: np.nan_to_num(flat[name]).astype(types[name]) for name in _OPTIONAL if name in flat}
        return PointCloud(
            x=xyz[0],
            y=xyz[1],
            z=xyz[2],
            range=distance.astype(np.float32),
            azimuth=narrowed(azimuth),
            elevation=elevation.astype(np.float32),
            time=np.array(flat["time"], np.float64),
            valid=valid,
            **optional,
            **extra,
        )


def _xyz(flat: dict[str, NDArray[Any]], distance: NDArray[Any], azimuth: NDArray[Any], elevation: NDArray[Any]) -> NDArray[np.float64]:
    if "x" in flat:
        return np.stack([flat[name].astype(np.float64) for name in "xyz"])
    level = distance * np.cos(elevation)
    parts = (level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation))
    return np.stack([part + flat[name] for part, name in zip(parts, ("ox", "oy", "oz"), strict=True)])


def _polar(flat: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Range and direction of cartesian points."""
    x, y, z = (flat[name].astype(np.float64) for name in "xyz")
    level = np.hypot(x, y)
    return {"range": np.hypot(level, z), "azimuth": np.arctan2(y, x), "elevation": np.arctan2(z, level)}
