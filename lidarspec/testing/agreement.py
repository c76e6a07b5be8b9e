"""What has to agree: the ways through the engine, two runs over the same bytes, single packets and
batches.

First when two results count as equal, as functions that fail where they do not; then the properties
of a sensor that rest on them. A
sensor's own functions (expressions of the struct, `plausible`, `points`, `clock`) may look at
nothing but the frame that they are given: one with a memory, or one that looks at the whole batch,
gives other results where packets come in another way. That is what is looked for here; one
property, `parse_decode_and_any_cutting_agree`, is the canary of the engine itself.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.framing.decoder import Decoder, frames_of, is_stream
from lidarspec.framing.frame_engine import InterpretedCodec, codec
from lidarspec.framing.results import Found, Frames, packed
from lidarspec.packets.packets import Packets, joined
from lidarspec.packets.stream import PacketStream
from lidarspec.points.cloud import PointCloud
from lidarspec.scans.scans import Scan, scans_of
from lidarspec.spec.sensor import Sensor
from lidarspec.testing import subject as material
from lidarspec.testing.findings import Violation, require
from lidarspec.testing.subject import MANY, Subject

#: units in the last place by which coordinates of two evaluations may differ, at the size of the
#: range.
ULPS = 4
#: how often the canary cuts a stream with the usual number of examples and at least, and how often
#: it damages one.
CUTS, LEAST_CUTS, DAMAGED = 8, 2, 1
#: rounds of a conversation if a shorter one has no scan, since few random frames of a sensor have
#: points.
MORE_ROUNDS = 12
#: Bytes that construct parses again, at most, while streams come in chunks: it parses an incomplete
#: frame from its start with each further chunk.
REREAD_BYTES = 1_000_000
#: streams up to this length are also fed byte by byte, with the usual number of examples.
SHORT_STREAM = 4000


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
        assert same(_lengths(one, array), _lengths(other, array)), f"the lengths of {array} differ"
    for name in ("offset", "time_ns", "host_ns", "index", "breaks"):
        assert same(getattr(one, name), getattr(other, name)), f"{name} differs"
    assert one.stats == other.stats
    for axis, node in one.table.schema.parts.items():
        assert same(one.count(axis), other.count(axis)), f"the numbers of {axis} differ"
        for kind in node.kinds:
            parts = f"{axis}.{kind.name}".rstrip(".")
            assert_same_packets(one.parts(parts), other.parts(parts))


def _lengths(packets: Packets, array: str) -> NDArray[np.intp]:
    """The lengths of an array in each packet; none where elements of one frame differ in it."""
    try:
        return packets.count(array)
    except SpecError:
        return np.empty(0, np.intp)


def assert_same_points(one: PointCloud, other: PointCloud, *, ulps: int = ULPS) -> None:
    """Fail unless both clouds have the same points, masks, times and places, directions within so
    many units in the last place.
    """
    assert_same_places(one, other, ulps=ulps)
    assert np.allclose(one.time, other.time, rtol=0, atol=1e-11, equal_nan=True)
    assert (one.stamp_ns, bool(one.nominal)) == (other.stamp_ns, bool(other.nominal))


def assert_same_places(one: PointCloud, other: PointCloud, *, ulps: int = ULPS) -> None:
    """Fail unless both clouds have the same points and masks, places and directions within so many
    units in the last place.

    Coordinates are compared at the size of the range, azimuths on the circle, times to the
    microsecond, since batches round them differently; everything else is equal.
    """
    assert one.columns.keys() == other.columns.keys()
    assert same(one.valid, other.valid)
    with np.errstate(invalid="ignore"):
        size = np.nanmax(
            np.abs(np.stack([one.range, one.x, one.y, one.z, np.ones(len(one))])), axis=0, initial=0
        ).astype(np.float32)
        reach = np.where(np.isfinite(size), size, 1).astype(np.float32)
    for name in one.columns.keys() - {"time"}:
        first, second = one.columns[name], other.columns[name]
        if name in ("x", "y", "z", "range"):
            near = _close(
                first,
                second,
                ulps
                * np.spacing(np.minimum(reach, np.abs(one.range)) if name == "range" else reach),
            )
        elif name in ("azimuth", "elevation"):
            near = _close(first, second, ulps * np.spacing(np.float32(np.pi)), full=2 * np.pi)
        else:
            near = same(first, second)
        assert near, f"{name} differs"
    assert one.time.shape == other.time.shape
    assert np.allclose(one.time, other.time, rtol=1e-12, atol=1e-6, equal_nan=True)
    assert abs(one.stamp_ns - other.stamp_ns) <= 1000
    assert one.shape == other.shape


def _close(one: NDArray[Any], other: NDArray[Any], within: Any, full: float = 0.0) -> bool:
    """Whether numbers are as near to each other, on a circle if `full` is given; nan and infinities
    equal themselves.
    """
    if one.dtype != other.dtype or one.shape != other.shape:
        return False
    with np.errstate(invalid="ignore"):
        apart = np.abs(one.astype(np.float64) - other.astype(np.float64))
        apart = np.minimum(apart, np.abs(full - apart)) if full else apart
        return bool(((apart <= within) | (one == other) | (np.isnan(one) & np.isnan(other))).all())


def assert_well_formed(cloud: PointCloud) -> None:
    """Fail unless the cloud keeps the conventions: types, angles, REP-117, and no place without a
    return.
    """
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
    return (
        one.dtype == other.dtype
        and one.shape == other.shape
        and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    )


def assert_backends_agree(sensor: Sensor, data: Any) -> None:
    """Fail unless the compiled and the interpreted path give the same frames, packets, points and
    counters, and no plugin failed.

    Args:
        data: bytes, or a list of datagrams.
    """
    decoders = [
        sensor.decoder(stream=is_stream(data), backend=backend) for backend in ("auto", "construct")
    ]
    found = [frames_of(decoder, data) for decoder in decoders]
    split = [cuts(frame for frames in each for frame in frames.found()) for each in found]
    assert split[0] == split[1]
    for name in dict.fromkeys((sensor.data_frame, *(name for name, _, _ in split[0]))):
        compiled, interpreted = (
            _packets(decoder, name, each) for decoder, each in zip(decoders, found, strict=True)
        )
        assert not compiled.stats.plugin_errors, compiled.stats.tracebacks[0]
        assert_same_packets(compiled, interpreted)
        if sensor.frames[name].data:
            cloud = compiled.points()
            assert_well_formed(cloud)
            assert_same_points(cloud, interpreted.points())


def _packets(decoder: Decoder, name: str, found: Sequence[Frames]) -> Packets:
    """The packets of one type among the frames of a whole input, which is framed once for all
    types.
    """
    stats = copy.deepcopy(decoder.stats)
    return PacketStream(decoder.sensor, name, stats, backend=decoder.backend).add(found, whole=True)


def a_clean_input_loses_nothing(subject: Subject) -> None:
    """Frames one after another are found as they are, and every byte of them."""
    frames = subject.conversation()
    data = material.delivery(subject.sensor, frames)
    found = [(found.frame, found.data) for found in subject.sensor.split(data)]
    wrong = next(
        (
            index
            for index, pair in enumerate(zip(found, frames, strict=False))
            if pair[0] != pair[1]
        ),
        min(len(found), len(frames)),
    )
    if found != frames:
        name = frames[min(wrong, len(frames) - 1)][0]
        took = (
            f"; a {found[wrong][0]!r} frame is found there"
            if wrong < len(found) and found[wrong][0] != name
            else ""
        )
        raise Violation(
            "LS306" if took else "LS401",
            f"of {len(frames)} frames, number {wrong} is not found{took}",
            name,
        )
    stats = subject.sensor.decode(data).stats
    require(not stats.plugin_errors, "LS414", str(stats.failure("")))
    require(
        (stats.bytes_skipped, stats.pending) == (0, 0),
        "LS401",
        f"{stats.bytes_skipped} bytes skipped, {stats.pending} pending",
    )


def the_same_bytes_give_the_same_points(subject: Subject) -> None:
    """Decoding twice gives the same, by the plan of the points and plainly."""
    data = material.delivery(subject.sensor, subject.conversation(rounds=1))
    for backend in ("auto", "construct"):
        one, other = (subject.sensor.decode(data, backend=backend).points() for _ in range(2))
        require(len(one) == len(other), "LS415", "two runs give different numbers of points")
        for name, column in one.columns.items():
            equal = column.tobytes() == other.columns[name].tobytes()
            require(
                equal,
                "LS415",
                f"two runs give another {name}",
                f"{subject.sensor.data_frame}.points",
            )


def parse_decode_and_any_cutting_agree(subject: Subject) -> None:
    """Clean and damaged input gives the same values parsed and decoded, on both engines, and
    however a stream is cut.
    """
    sensor, source = subject.sensor, subject.source("agree")
    frames = subject.conversation(rounds=1)
    for damaged in range(1 + DAMAGED):
        parts = [
            (name, material.mutated(data, source) if damaged and source.random() < 0.4 else data)
            for name, data in frames
        ]
        data = material.delivery(sensor, parts)
        assert_backends_agree(sensor, data)
        if not sensor.datagrams:
            _cut_anywhere(subject, data)
    for name, data in dict(frames).items():
        _read_alike(sensor, name, data)


def _read_alike(sensor: Sensor, name: str, data: bytes) -> None:
    """Hold the numbers of a parsed frame to those of the same frame in a table."""
    try:
        row = sensor.decode(
            [data] if sensor.datagrams else data * sensor.frames[name].confirm, name
        ).raw[:1]
    except SpecError:  # an array in one branch alone has no raw form
        return
    for number in row:
        path = _differing(sensor.parse(data, frame=name), number)
        require(
            path is None,
            "LS402",
            "it is parsed as another number than it is decoded",
            f"{name}.{path}",
        )


def _differing(parsed: Any, raw: Any, path: str = "") -> str | None:
    """The path of the first number of a parsed frame that is another one in a row of `Packets.raw`;
    None where there is none.
    """
    if isinstance(parsed, dict):
        entries = [
            (f"{path}.{key}".lstrip("."), value, raw[key])
            for key, value in parsed.items()
            if key in (raw.dtype.names or ())
        ]
    elif isinstance(parsed, list):
        entries = [(f"{path}[{index}]", value, raw[index]) for index, value in enumerate(parsed)]
    else:
        number = isinstance(parsed, int | float) and np.ndim(raw) == 0
        return path if number and parsed == parsed and parsed != raw else None
    return next(
        (
            found
            for name, value, other in entries
            if (found := _differing(value, other, name)) is not None
        ),
        None,
    )


def _cut_anywhere(subject: Subject, data: bytes) -> None:
    """Hold the frames and counters of a stream in pieces to those of the whole."""
    sensor, source = subject.sensor, subject.source("cuts")
    whole = sensor.decoder()
    expected = cuts(whole.feed(data) + whole.finish())
    rounds = CUTS if len(sensor.frames) <= MANY else CUTS // 4
    number = subject.scale_rounds(rounds, LEAST_CUTS)
    scale = _chunk_scale(subject, number * len(data))
    splits = [list(material.pieces(data, source, scale)) for _ in range(number)]
    splits += (
        [[data[spot : spot + 1] for spot in range(len(data))]]
        if len(data) <= subject.scale_rounds(SHORT_STREAM)
        else []
    )
    for split in splits:
        decoder = sensor.decoder()
        found = cuts([frame for chunk in split for frame in decoder.feed(chunk)] + decoder.finish())
        lost = next(
            (frame for frame in expected if frame not in found),
            (found or expected or [("", 0, b"")])[0],
        )
        require(
            found == expected,
            "LS405",
            f"in {len(split)} pieces, the frame at byte {lost[1]} is not found as in one",
            lost[0],
        )
        require(decoder.stats == whole.stats, "LS405", "the counters depend on the split")


def _chunk_scale(subject: Subject, length: int) -> int:
    """Return the factor by which chunks are longer than usual: 1 unless construct alone reads long
    frames.

    Args:
        length: bytes of all streams together.
    """
    incoming = subject.sensor.incoming
    interpreted = [
        subject.length(name)
        for name, frame in incoming.items()
        if isinstance(codec(frame), InterpretedCodec)
    ]
    chunks = length / material.MEAN_CHUNK
    reread_bytes = (
        chunks * max(interpreted, default=0) / 2
    )  # on average half of a frame has arrived
    return max(round(reread_bytes / REREAD_BYTES), 1)


def single_packets_equal_a_batch(subject: Subject) -> None:
    """Packets that come one by one are those of one batch."""
    found = subject.sensor.split(material.delivery(subject.sensor, subject.conversation()))
    for name in subject.sensor.incoming:
        stats = [Decoder(subject.sensor, stream=True).stats for _ in range(2)]
        single, batch = (PacketStream(subject.sensor, name, each) for each in stats)
        assert_same_packets(
            joined([single.add([packed([item])]) for item in found]), batch.add([packed(found)])
        )


def scans_do_not_depend_on_batches(subject: Subject) -> None:
    """Scans are cut alike, with the same points, however many packets come at a time."""

    def scans(found: list[Found], size: int) -> list[Scan]:
        stats = Decoder(subject.sensor, stream=True).stats
        stream = PacketStream(subject.sensor, subject.sensor.data_frame, stats)
        batches = [
            stream.add([packed(found[start : start + size])])
            for start in range(0, len(found), size)
        ]
        scans = list(scans_of(subject.sensor, batches))
        require(not stats.plugin_errors, "LS414", str(stats.failure("")))
        return scans

    found: list[Found] = []
    whole: list[Scan] = []
    for rounds in (None, MORE_ROUNDS):
        found = subject.sensor.split(
            material.delivery(subject.sensor, subject.conversation(rounds=rounds))
        )
        whole = scans(found, len(found))
        if whole:
            break
    require(whole, "LS404", "there is no scan")
    for size in (1, 3):
        parts = scans(found, size)
        alike = [(len(scan), scan.whole, scan.complete) for scan in parts] == [
            (len(scan), scan.whole, scan.complete) for scan in whole
        ]
        require(alike, "LS404", f"{size} packets at a time give other scans than all at once")
        for part, other in zip(parts, whole, strict=True):
            assert_well_formed(part.points)
            assert_same_places(part.points, other.points)
