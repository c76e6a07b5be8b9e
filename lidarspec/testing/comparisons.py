"""When two ways through the engine count as equal, and what every cloud has to look like."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.framing.decoder import Decoder, frames_of, is_stream
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import Found, Frames
from lidarspec.packets.packets import Packets
from lidarspec.packets.stream import PacketStream
from lidarspec.points.cloud import PointCloud
from lidarspec.spec.construct_layer import member
from lidarspec.spec.description import Sensor

#: units in the last place by which coordinates of two evaluations may differ, at the size of the range.
ULPS = 4


def cuts(found: Iterable[Found]) -> list[tuple[str, int, bytes]]:
    """(type, offset, bytes) of frames, without when they arrived."""
    return [(item.frame, item.offset, item.data) for item in found]


def assert_same_packets(one: Packets, other: Packets) -> None:
    """Fail unless both hold the same raw numbers, places, times, breaks and counters."""
    assert one.raw.dtype == other.raw.dtype
    for path in one.table.schema.fields:
        assert same(one.table.raw(path), other.table.raw(path)), f"raw {path} differs"
        assert same(one[path], other[path]), f"{path} differs"
    for array in one.table.schema.arrays:
        assert same(_counted(one, array), _counted(other, array)), f"the lengths of {array} differ"
    for name in ("offset", "time_ns", "host_ns", "index", "breaks"):
        assert same(getattr(one, name), getattr(other, name)), f"{name} differs"
    assert one.stats == other.stats


def _counted(packets: Packets, array: str) -> NDArray[np.intp]:
    """The lengths of an array; none where elements of one frame differ in it."""
    try:
        return packets.count(array)
    except SpecError:
        return np.empty(0, np.intp)


def assert_same_points(one: PointCloud, other: PointCloud, *, ulps: int = ULPS) -> None:
    """Fail unless both clouds have the same points and masks, places and directions within so many units in the last place."""
    assert_same_places(one, other, ulps=ulps)
    assert np.allclose(one.time, other.time, rtol=0, atol=1e-11, equal_nan=True)
    assert (one.stamp_ns, bool(one.nominal)) == (other.stamp_ns, bool(other.nominal))


def assert_same_places(one: PointCloud, other: PointCloud, *, ulps: int = ULPS) -> None:
    """The same, but for times, which batches round differently.

    Coordinates are compared at the size of the range, azimuths on the circle; everything else is equal.
    """
    assert one.columns.keys() == other.columns.keys()
    assert same(one.valid, other.valid)
    with np.errstate(invalid="ignore"):
        size = np.nanmax(np.abs(np.stack([one.range, one.x, one.y, one.z, np.ones(len(one))])), axis=0, initial=0).astype(np.float32)
        reach = np.where(np.isfinite(size), size, 1).astype(np.float32)
    for name in one.columns.keys() - {"time"}:
        first, second = one.columns[name], other.columns[name]
        if name in ("x", "y", "z", "range"):
            assert _close(first, second, ulps * np.spacing(np.minimum(reach, np.abs(one.range)) if name == "range" else reach)), (
                f"{name} differs"
            )
        elif name in ("azimuth", "elevation"):
            assert _close(first, second, ulps * np.spacing(np.float32(np.pi)), full=2 * np.pi), f"{name} differs"
        else:
            assert same(first, second), f"{name} differs"
    assert one.time.shape == other.time.shape
    assert np.allclose(one.time, other.time, rtol=1e-12, atol=1e-6, equal_nan=True)
    assert abs(one.stamp_ns - other.stamp_ns) <= 1000
    assert one.shape == other.shape


def _close(one: NDArray[Any], other: NDArray[Any], within: Any, full: float = 0.0) -> bool:
    """Whether numbers are as near to each other, on a circle if `full` is given; nan and infinities equal themselves."""
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    with np.errstate(invalid="ignore"):
        apart = np.abs(one.astype(np.float64) - other.astype(np.float64))
        apart = np.minimum(apart, np.abs(full - apart)) if full else apart
        return bool(((apart <= within) | (one == other) | (np.isnan(one) & np.isnan(other))).all())


def assert_well_formed(cloud: PointCloud) -> None:
    """Fail unless the cloud keeps the conventions: types, angles, REP-117, and no place without a return."""
    valid = cloud.valid
    assert cloud.x.dtype == cloud.y.dtype == cloud.z.dtype == cloud.range.dtype == np.float32
    assert cloud.time.dtype == np.float64
    assert all(len(column) == len(cloud) for column in cloud.columns.values())
    assert np.isfinite(cloud.xyz[valid]).all()
    assert np.isfinite(cloud.range[valid]).all()
    assert np.isnan(cloud.xyz[~valid]).all()
    assert (cloud.range[valid] >= 0).all()
    known = cloud.azimuth[np.isfinite(cloud.azimuth)]
    assert ((known >= -np.pi) & (known < np.pi)).all()


def same(one: NDArray[Any], other: NDArray[Any]) -> bool:
    """Whether two arrays are equal in shape, type and value; nan equals nan."""
    return one.dtype == other.dtype and one.shape == other.shape and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def assert_backends_agree(sensor: Sensor, data: Any) -> None:
    """Fail unless the compiled and the interpreted path give the same frames, packets, points and counters, and no plugin failed."""
    decoders = [sensor.decoder(stream=is_stream(data), backend=backend) for backend in ("auto", "construct")]
    found = [frames_of(decoder, data) for decoder in decoders]
    split = [cuts(one for spans in each for one in spans.found()) for each in found]
    assert split[0] == split[1]
    for name in dict.fromkeys((sensor.data_frame, *(name for name, _, _ in split[0]))):
        frame = sensor.frames[name]
        compiled, interpreted = (_packets(decoder, name, each) for decoder, each in zip(decoders, found, strict=True))
        assert not compiled.stats.plugin_errors, compiled.stats.tracebacks[0]
        assert_same_packets(compiled, interpreted)
        if frame.data:
            cloud = compiled.points()
            assert_well_formed(cloud)
            assert_same_points(cloud, interpreted.points())


def _packets(decoder: Decoder, name: str, found: Sequence[Frames]) -> Packets:
    """The packets of one type among the frames of a whole input, which is framed once for all types."""
    stats = copy.deepcopy(decoder.stats)
    return PacketStream(decoder.sensor, name, stats, interpreted=decoder.interpreted).add(found, whole=True)


def assert_command(sensor: Sensor, name: str, arguments: Mapping[str, float]) -> None:
    """Fail unless the command's frame parses back to its fixed values, and to its arguments within half a step."""
    command = sensor.commands[name]
    data = sensor.command(name, **arguments)
    if command.frame is None:
        assert data == b""
        return
    parsed = sensor.parse(data, frame=command.frame)
    assert sensor.build(command.frame, parsed) == data
    for path, value in command.values.items():
        assert member(parsed, path) == value
    fields = codec(sensor.frames[command.frame]).schema.fields
    for argument, value in arguments.items():
        info = fields[command.args[argument][0]]
        assert abs(member(parsed, info.path) * info.scale + info.offset - value) <= abs(info.scale) * 0.5001
