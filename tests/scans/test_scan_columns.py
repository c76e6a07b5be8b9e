"""Tests of the columns of scans: slices of the columns of all points."""

from __future__ import annotations

import dataclasses
import functools
import gc
import itertools
import random
import weakref
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Decoder, Packets, PointCloud, Scan, Sensor, simulate
from lidarspec.captures.ip import ETHERNET
from lidarspec.captures.pcap import Datagram, make_datagram_record
from lidarspec.captures.records import make_capture_head
from lidarspec.errors import UsageError
from lidarspec.frames.frame_table import CompiledTable
from lidarspec.packets.stream import PacketStream
from lidarspec.points import batch_columns
from lidarspec.points.cloud import COLUMNS, CloudColumns, LazyCloud
from lidarspec.points.column_sources import JoinedColumns, SourcePart
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.scans.stream import ScanStream, iter_scans
from lidarspec.spec import OnChange, OnWrap, Udp
from tests.agreement import assert_same_points
from tests.broken import points_fail, sound
from tests.by_construct import reader
from tests.points.backends import BACKENDS, COMPILED
from tests.representatives import REPRESENTATIVES
from tests.shapes import SHAPES

SHAPED = [name for name, sensor in SHAPES.items() if sensor.frames]
#: Sensors whose kernels are compiled: a stream, datagrams, Cartesian points.
COMPILED_CASES = [
    pytest.param(name, "jit", marks=COMPILED)
    for name in ("ldrobot-stl27l", "velodyne-vlp16", "livox-mid360")
]


@functools.cache
def frames_of(name: str, number: int) -> list[bytes]:
    return list(simulate(ls.sensor(name), number))


def packets_of(name: str, number: int, backend: str) -> Packets:
    return reader(ls.sensor(name), backend).decode(frames_of(name, number))


def batches(packets: Packets, *sizes: int) -> list[Packets]:
    edges = [0, *itertools.accumulate(sizes), len(packets)]
    return [packets.take(slice(start, stop)) for start, stop in itertools.pairwise(edges)]


def assert_cut_from(
    scans: list[Scan], whole: PointCloud, names: tuple[str, ...] = (*COLUMNS, "valid")
) -> None:
    start = 0
    for scan in scans:
        stop = start + len(scan)
        for name in names:
            found, wanted = getattr(scan.points, name), getattr(whole, name)
            if name == "time":
                assert (
                    abs(found + (scan.stamp_ns - whole.stamp_ns) * 1e-9 - wanted[start:stop]).max(
                        initial=0
                    )
                    < 2e-9
                )
            elif wanted is None:
                assert found is None
            else:
                np.testing.assert_array_equal(found, wanted[start:stop], err_msg=name)
                assert found.dtype == wanted.dtype
        start = stop
    assert start == len(whole)


@BACKENDS
@pytest.mark.parametrize("least", [0, 1 << 14, 1 << 30])
@pytest.mark.parametrize(
    "name", ["velodyne-vlp16", "robosense-m1", pytest.param("hesai-xt32", marks=pytest.mark.slow)]
)
def test_scans_are_the_points_of_the_whole_cut(
    name: str, least: int, backend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch_columns, "MIN_OWN_POINTS", least)
    monkeypatch.setattr(batch_columns, "BLOCK_POINTS", 5000)
    packets = packets_of(name, 700, backend)
    scans = list(iter_scans(packets.sensor, batches(packets, 1, 300, 2, 333)))
    assert len(scans) > 1
    assert_cut_from(scans, packets.points())


@pytest.mark.parametrize(
    "order", [("time", "z", "valid"), ("azimuth", "x"), ("ring", "range", "y", "azimuth")]
)
def test_columns_do_not_depend_on_the_order_in_which_they_are_read(order: tuple[str, ...]) -> None:
    packets = packets_of("velodyne-vlp16", 200, "numpy")
    assert_cut_from(list(iter_scans(packets.sensor, batches(packets, 90))), packets.points(), order)


def test_the_vendors_axes_hold_for_scans_too() -> None:
    sensor = ls.sensor("hesai-xt32").configure(frame="vendor")
    packets = sensor.decode(simulate(sensor, 400))
    assert_cut_from(list(iter_scans(sensor, batches(packets, 123))), packets.points())


def test_scans_of_batches_that_are_evaluated_in_different_ways_have_all_columns() -> None:
    """One part of the scan has z as a column, and in the other part z is derived.

    A plan of a planar sensor does not compute z, but the reference evaluator does.
    """
    packets = packets_of("ldrobot-stl27l", 20, "numpy")
    planned = packets.points()
    plain = evaluate_plainly(packets).cloud
    assert isinstance(planned, LazyCloud)
    parts = [
        SourcePart(planned.lazy.source, 0, 100),
        SourcePart(CloudColumns(plain), 100, len(plain)),
    ]
    cloud = LazyCloud.of(JoinedColumns(parts), plain.stamp_ns)
    np.testing.assert_array_equal(cloud.z, plain.z)
    assert_same_points(cloud, plain, ulps=4)


def test_large_scans_are_computed_without_the_rest_of_their_batch() -> None:
    packets = packets_of("robosense-m1", 2000, "numpy")
    scans = list(iter_scans(packets.sensor, [packets]))
    middle = scans[1].points
    assert middle.x.base is not None
    assert len(middle.x.base) < len(packets.points()) / 2
    assert middle.x is middle.x


def test_small_scans_share_computed_columns() -> None:
    sensor = small_scans()
    packets = sensor.decode(simulate(ls.sensor("velodyne-vlp16"), 700))
    scans = list(iter_scans(sensor, [packets]))
    bases = {id(scan.points.x.base) for scan in scans}
    assert len(scans) > 300
    assert len(bases) < 20
    assert_cut_from(scans, packets.points())


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
def test_small_scans_may_be_read_in_any_order(seed: int) -> None:
    sensor = small_scans()
    packets = sensor.decode(simulate(ls.sensor("velodyne-vlp16"), 400))
    scans = list(iter_scans(sensor, batches(packets, 190)))
    for index in np.random.default_rng(seed).permutation(len(scans))[:100]:
        assert scans[index].points.x is not None
    assert_cut_from(scans, packets.points())


def small_scans() -> Sensor:
    """Return a sensor with one scan per packet."""
    vlp16 = ls.sensor("velodyne-vlp16")
    return Sensor(
        "test-small",
        vendor="Test",
        model="Small",
        frames={name: vlp16.frames[name] for name in ("data", "position")},
        points=vlp16.points,
        scan=OnChange("timestamp"),
        links=vlp16.links,
        clock=vlp16.clock,
        range_limits=vlp16.range_limits,
        status="manual",
        source="none",
    )


@pytest.mark.parametrize("size", ["large", "small"])
def test_packets_go_with_the_last_scan_that_is_made_of_them(size: str) -> None:
    sensor = ls.sensor("velodyne-vlp16") if size == "large" else small_scans()
    waiting = batches(sensor.decode(simulate(ls.sensor("velodyne-vlp16"), 700)), 350)
    known = [weakref.ref(packets) for packets in waiting]
    gc.collect()
    gc.disable()
    try:
        for scan in iter_scans(sensor, (waiting.pop(0) for _ in range(2))):
            assert len(scan.points.x) == len(scan.points.time) == len(scan)
        del scan
        assert not any(packets() for packets in known)
    finally:
        gc.enable()


@pytest.mark.parametrize("opened", [False, True], ids=["packets", "capture"])
def test_a_scan_is_forgotten_once_it_was_given(opened: bool, tmp_path: Path) -> None:
    sensor, path = ls.sensor("velodyne-vlp16"), tmp_path / "some.pcap"
    frames = simulate(sensor, 700)
    with path.open("wb") as file:
        file.write(make_capture_head(ETHERNET))
        for frame in frames:
            file.write(
                make_datagram_record(
                    Datagram(frame, 10**18, ("192.168.1.200", 2368), ("192.168.1.102", 2368))
                )
            )
    given = list[weakref.ref[Scan]]()
    with ls.open(path, sensor) as device:
        for scan in device.scans() if opened else iter_scans(sensor, [sensor.decode(frames)]):
            given.append(weakref.ref(scan))
            assert len(scan.points.x) == len(scan)
            assert sum(known() is not None for known in given) <= 2
    assert len(given) > 5


def test_an_oscillating_sensor_is_cut_equally_for_all_batch_sizes() -> None:
    # With a clock, packets that go back in time would be late.
    sensor = dataclasses.replace(ls.sensor("velodyne-vlp16"), clock=None)
    assert isinstance(sensor.scan, OnWrap)
    frames = simulate(ls.sensor("velodyne-vlp16"), 300)
    packets = sensor.decode([*frames, *frames[::-1], *frames])
    whole = [len(scan) for scan in iter_scans(sensor, [packets])]
    assert len(whole) > 8
    for sizes in ((1, 7, 250), (310, 280), tuple([20] * 44)):
        assert [len(scan) for scan in iter_scans(sensor, batches(packets, *sizes))] == whole


@pytest.mark.parametrize("name", SHAPED)
def test_packets_in_shared_buffers_give_the_same_points(name: str) -> None:
    assert_place_of_packets_does_not_matter(SHAPES[name], "numpy")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "backend"), [*((name, "numpy") for name in REPRESENTATIVES), *COMPILED_CASES]
)
def test_packets_of_a_sensor_in_shared_buffers_give_the_same_points(
    name: str, backend: str
) -> None:
    assert_place_of_packets_does_not_matter(ls.sensor(name), backend)


def assert_place_of_packets_does_not_matter(sensor: Sensor, backend: str) -> None:
    """Fail unless packets in one buffer and in separate buffers give equal points."""
    frames = [sensor.example(sensor.data_frame, seed=seed) for seed in range(5)]
    size = Counter(map(len, frames)).most_common(1)[0][0]
    rows = np.stack([np.frombuffer(frame, np.uint8) for frame in frames if len(frame) == size])
    apart = np.full((len(rows), size + 1), 0xFF, np.uint8)
    apart[:, :size] = rows
    starts, sizes = np.arange(len(rows)) * (size + 1), np.full(len(rows), size)
    unknown = np.full(len(rows), -1)
    found = []
    for buffer, places in (
        (rows.reshape(-1), np.arange(len(rows)) * size),
        (apart.reshape(-1), starts),
    ):
        decoder = Decoder(sensor, stream=False, backend=backend)
        stream = PacketStream(sensor, sensor.data_frame, decoder.stats, backend=backend)
        found.append(stream.add([decoder.decode_placed(buffer, places, sizes, unknown)]))
    together, separate = found
    assert len(together) == len(separate)
    if isinstance(separate.table, CompiledTable) and len(separate):
        link = sensor.links["data"]
        recoded = sensor.frames[sensor.data_frame].wire is not None
        # Joined or recoded bytes are copies.
        copied = recoded or (isinstance(link, Udp) and link.assembled is not None)
        if len(separate.table.groups[0].where) == len(rows) > 1 and not copied:
            assert separate.table.groups[0].rows.strides[0] == size + (size > 1)
        assert_cut_from([Scan(separate.points(), 0.0, True, sensor)], together.points())


@pytest.mark.parametrize("number", [0, -1, 2.5, "360", True])
def test_an_invalid_number_of_sectors_is_refused(number: Any) -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    scan = next(sensor.scans(sensor.example("data")))
    for bins in (scan.to_bins, scan.to_laserscan):
        with pytest.raises(UsageError, match=f"{bins.__name__} requires the number of sectors"):
            bins(number)
    assert scan.to_bins(np.int32(4)).shape == (4,)


@pytest.mark.parametrize("backend", ["numpy", pytest.param("construct", marks=pytest.mark.soak)])
def test_scans_with_gaps_are_incomplete_or_not_whole(
    backend: str,
) -> None:
    frames = simulate(ls.sensor("cspc-m1c1-mini"), 1500)
    judged = reader(ls.sensor("cspc-m1c1-mini"), backend)
    sensor = judged.sensor
    noise = random.Random(5)

    def scans_with(share: float, pieces: int) -> list[Scan]:
        """Return the scans with a share of the packets damaged, read in `pieces` pieces."""
        data = b"".join(bytes(len(frame)) if noise.random() < share else frame for frame in frames)
        stream, decoder = ScanStream(sensor), judged.decoder(stream=True)
        packets = PacketStream(sensor, "data", decoder.stats, backend=judged.backend)
        step = len(data) // pieces + 1
        cut = [
            stream.add(packets.add(decoder.frames(data[at : at + step])))
            for at in range(0, len(data), step)
        ]
        return [scan for scans in cut for scan in scans]

    gaps = scans_with(0.2, 1)[1:]
    assert sum(scan.whole for scan in gaps) > 40
    assert {len(scan) for scan in gaps if scan.complete} <= {380}
    for pieces in (1, 7):
        noise.seed(6)
        damaged = scans_with(0.9, pieces)
        assert len(damaged) > 3
        assert not any(scan.complete or scan.whole or np.isfinite(scan.rate_hz) for scan in damaged)


def test_a_scan_whose_datagrams_are_mostly_lost_is_not_complete() -> None:
    sensor = ls.sensor("hesai-xt32")
    frames = simulate(sensor, 2000)
    few = [frame for index, frame in enumerate(frames) if not 510 < index < 690]
    assert {scan.complete for scan in list(sensor.scans(frames))[1:-1]} == {True}
    assert [scan.complete for scan in sensor.scans(few)].count(False) == 3


def test_scans_of_a_wrong_sensor_and_of_a_plugin_that_raises_are_warned_of() -> None:
    other = b"".join(simulate(ls.sensor("cspc-m1c1-mini"), 40))
    with pytest.warns(
        UserWarning,
        match=r"ldrobot-stl27l: no data frame in the data .* come from another sensor\?",
    ):
        assert not list(ls.sensor("ldrobot-stl27l").scans(other))
    with pytest.warns(UserWarning, match=r"distnace.*, at 12 packets"):
        list(sound.sensor(points=points_fail.points).scans(b"".join(simulate(sound.sensor(), 12))))


@pytest.mark.parametrize("backend", ["construct", "numpy"])
@pytest.mark.parametrize("size", [1, 2, 3, 100])
def test_the_shape_of_a_scan_is_that_of_its_packets_whatever_they_came_with(
    backend: str, size: int
) -> None:
    sensor = SHAPES["shape-segments"]

    def segment(turn: int, channels: int, beams: int) -> dict[str, Any]:
        data = [[dict(distance=1, strength=1)] * channels] * beams
        return dict(
            turn=turn,
            channels=channels,
            beams=beams,
            time=turn,
            start=0,
            elevations=[1] * channels,
            data=data,
        )

    turns = [[(3, 4), (3, 2), (3, 0), (3, 4)], [(2, 5), (0, 5), (2, 5)], [(3, 4), (2, 4)], [(2, 1)]]
    segments = [segment(turn, *each) for turn, sizes in enumerate(turns) for each in sizes]
    frames = [
        sensor.build("data", counter=i, step=15, segments=segments[2 * i : 2 * i + 2])
        for i in range(len(segments) // 2)
    ]
    read = [
        reader(sensor, backend).decode(frames[start : start + size])
        for start in range(0, len(frames), size)
    ]
    assert [scan.points.shape for scan in iter_scans(sensor, read)] == [
        (10, 3),
        (10, 2),
        None,
        (1, 2),
    ]
