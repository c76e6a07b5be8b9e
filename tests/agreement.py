"""Assertions that two ways through the engine give equal frames, packets and points."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec import Packets, PointCloud, Sensor, SpecError
from lidarspec.framing.decoder import Decoder, decode_all, is_stream
from lidarspec.framing.results import Counters, Found, Frames
from lidarspec.packets.stream import PacketStream
from lidarspec.testing.cloud_assertions import (
    ULPS,
    are_equal,
    assert_same_places,
    assert_well_formed,
)
from tests.by_construct import by_construct


def cuts(found: Iterable[Found]) -> list[tuple[str, int, bytes]]:
    """Return (type, offset, bytes) of frames, without their times."""
    return [(item.frame, item.offset, item.data) for item in found]


#: Counters of rejected candidates. construct names the first fault in the order of the wire, our
#: engine a wrong constant before a wrong checksum.
REJECTIONS = {"bad_constant", "bad_length", "bad_checksum", "implausible"}


def list_counters(stats: Counters, *, by_reason: bool) -> dict[str, Any]:
    """Return counters by name, without those of rejected candidates unless `by_reason`."""
    left_out = set() if by_reason else REJECTIONS
    return {name: value for name, value in stats.to_dict().items() if name not in left_out}


def assert_same_packets(one: Packets, other: Packets, *, by_reason: bool = True) -> None:
    """Fail unless both hold the same raw numbers, places, times, breaks and counters.

    Args:
        by_reason: whether the reasons for rejected candidates have to be the same, too.
    """
    assert one.raw.dtype == other.raw.dtype
    for path in one.table.schema.fields:
        assert are_equal(one.table.raw(path), other.table.raw(path)), f"raw {path} differs"
        if one.table.schema.columns[path].kind != "other":
            assert are_equal(one[path], other[path]), f"{path} differs"
    # a text is an array of bytes in the frame, but not in the columns
    arrays = {axis for info in one.table.schema.columns.values() for axis in info.axes}
    for array in arrays.intersection(one.table.schema.arrays):
        assert are_equal(_lengths(one, array), _lengths(other, array)), (
            f"the lengths of {array} differ"
        )
    for name in ("offset", "time_ns", "host_ns", "index", "breaks"):
        assert are_equal(getattr(one, name), getattr(other, name)), f"{name} differs"
    assert list_counters(one.stats, by_reason=by_reason) == list_counters(
        other.stats, by_reason=by_reason
    )
    for axis, node in one.table.schema.separate_parts.items():
        assert are_equal(one.count(axis), other.count(axis)), f"the numbers of {axis} differ"
        for kind in node.kinds:
            parts = f"{axis}.{kind.name}".rstrip(".")
            assert_same_packets(one.parts(parts), other.parts(parts), by_reason=by_reason)


def _lengths(packets: Packets, array: str) -> NDArray[np.intp]:
    """Return the lengths of an array in each packet.

    The result is empty if the elements of a frame differ in length.
    """
    try:
        return packets.count(array)
    except SpecError:
        return np.empty(0, np.intp)


def assert_same_points(one: PointCloud, other: PointCloud, *, ulps: int = ULPS) -> None:
    """Fail unless both clouds have the same points, masks, places, times and stamps.

    Args:
        ulps: tolerance of coordinates and angles in units in the last place.
    """
    assert_same_places(one, other, ulps=ulps)
    assert np.allclose(one.time, other.time, rtol=0, atol=1e-11, equal_nan=True)
    assert (one.stamp_ns, bool(one.nominal)) == (other.stamp_ns, bool(other.nominal))


def assert_backends_agree(sensor: Sensor, data: Any) -> None:
    """Fail unless our engine reads an input as construct does, and no plugin failed.

    Frames, packets, points and counters are compared.

    Args:
        data: bytes, or a list of datagrams.
    """
    judges = sensor, by_construct(sensor)
    decoders = [judge.decoder(stream=is_stream(data)) for judge in judges]
    found = [decode_all(decoder, data) for decoder in decoders]
    split = [cuts(frame for frames in each for frame in frames.to_found()) for each in found]
    assert split[0] == split[1]
    for name in dict.fromkeys((sensor.data_frame, *(name for name, _, _ in split[0]))):
        ours, theirs = (
            _packets(decoder, name, each) for decoder, each in zip(decoders, found, strict=True)
        )
        assert not ours.stats.plugin_errors, ours.stats.tracebacks[0]
        assert_same_packets(ours, theirs, by_reason=False)
        if sensor.frames[name].data:
            cloud = ours.points()
            assert_well_formed(cloud)
            assert_same_points(cloud, theirs.points())


def _packets(decoder: Decoder, name: str, found: Sequence[Frames]) -> Packets:
    """Return the packets of one type among the frames of a whole input."""
    stats = copy.deepcopy(decoder.stats)
    return PacketStream(decoder.sensor, name, stats, backend=decoder.backend).add(found, whole=True)
