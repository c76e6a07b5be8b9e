"""Tests of packets and scans of lossy, late, duplicate and noisy input.

The results equal those of an oracle, and do not depend on the batches.
"""

from __future__ import annotations

import dataclasses
import itertools
import random
from collections.abc import Sequence

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Counters, Packets, Scan, simulate
from lidarspec.packets.stream import PacketStream
from lidarspec.scans.stream import ScanStream
from tests.by_construct import reader
from tests.representatives import load_sensor
from tests.shapes import SHAPES

COLUMNS = ("time_ns", "host_ns", "index", "breaks", "offset")


def facts(scan: Scan) -> tuple[int, bool, int]:
    return len(scan), scan.complete, scan.stamp_ns


def run(
    sensor: ls.Sensor, datagrams: list[bytes], cuts: Sequence[int]
) -> tuple[list[Packets], list[Scan], Counters]:
    decoder = sensor.decoder(stream=False)
    stream, scans = PacketStream(sensor, sensor.data_frame, decoder.stats), ScanStream(sensor)
    batches: list[Packets] = []
    found: list[Scan] = []
    for start, end in itertools.pairwise(cuts):
        batches.append(
            stream.add([decoder.datagrams(datagrams[start:end], list(range(start, end)))])
        )
        found += scans.add(batches[-1])
    return batches, found + scans.finish(), decoder.stats


def column(batches: list[Packets], name: str) -> np.ndarray:
    return np.concatenate([getattr(batch, name) for batch in batches])


def disturb(datagrams: list[bytes], draw: random.Random, loss: float) -> list[bytes]:
    """Return the datagrams with some lost, late or duplicate, and noise between them."""
    left = [datagram for datagram in datagrams if draw.random() >= loss]
    for _ in range(len(left) // 20 if loss else 0):
        spot = draw.randrange(len(left))
        left.insert(min(len(left), spot + draw.randint(0, 7)), left.pop(spot))
        left.insert(
            draw.randrange(len(left)), draw.choice([b"noise", left[draw.randrange(len(left))]])
        )
    return left


@pytest.mark.parametrize("loss", [0, pytest.param(0.01, marks=pytest.mark.slow), 0.2])
@pytest.mark.parametrize(
    "name",
    [
        "shape-headed",
        "shape-paced",
        "velodyne-vlp16",
        pytest.param("robosense-m1", marks=pytest.mark.slow),
    ],
)
def test_batches_do_not_matter(name: str, loss: float) -> None:
    sensor = load_sensor(name)
    draw = random.Random(f"{name} {loss}")
    datagrams = disturb(simulate(sensor, 150), draw, loss)
    whole, scans, stats = run(sensor, datagrams, [0, len(datagrams)])
    splits = [
        sorted({0, len(datagrams), *(draw.randrange(len(datagrams)) for _ in range(many))})
        for many in (3, 20)
    ]
    for cuts in [*splits, range(len(datagrams) + 1)]:
        batches, other, counted = run(sensor, datagrams, cuts)
        assert counted == stats
        assert all(np.array_equal(column(batches, each), column(whole, each)) for each in COLUMNS)
        assert [facts(scan) for scan in other] == [facts(scan) for scan in scans]
        for scan, same in zip(other, scans, strict=True):
            assert np.array_equal(scan.rate_hz, same.rate_hz, equal_nan=True)
            for each in same.points.columns:
                assert np.array_equal(
                    getattr(scan.points, each), getattr(same.points, each), equal_nan=True
                ), each


@pytest.mark.parametrize("seed", range(6))
def test_sequences_against_the_true_numbers(seed: int) -> None:
    """The counter wraps many times; the index must follow the true packet numbers.

    Packets are lost and late.
    """
    draw = random.Random(seed)
    sensor = SHAPES["shape-datagrams"]
    template = sensor.example("data")
    true = [index for index in range(100, 1500) if draw.random() > 0.03]
    for _ in range(40):
        spot = draw.randrange(20, len(true) - 20)
        true.insert(spot + draw.randint(0, 9), true.pop(spot))
    datagrams = [template[:4] + bytes([index % 200 + 1]) + template[5:] for index in true]
    cuts = sorted({0, len(true), *(draw.randrange(len(true)) for _ in range(seed))})
    batches, _, stats = run(sensor, datagrams, cuts)
    index = column(batches, "index")
    assert (index - index[0] == np.array(true) - true[0]).all()
    assert stats.lost == max(true) - min(true) + 1 - len(true)
    highest = np.maximum.accumulate(true)
    assert stats.late == int((np.array(true[1:]) < highest[:-1]).sum())
    assert (column(batches, "breaks")[1:] == (np.array(true[1:]) > highest[:-1] + 1)).all()


def test_late_and_doubled_packets_make_the_same_scans() -> None:
    sensor = ls.sensor("robosense-m1")
    datagrams = simulate(sensor, 1500)
    draw = random.Random(7)
    late = list(datagrams)
    for spot in range(30, 1400, 40):
        late.insert(spot + draw.randint(1, 8), late.pop(spot))
        late.insert(spot + 9, late[spot + 1])
    _, scans, _ = run(sensor, datagrams, [0, 1500])
    _, same, stats = run(sensor, late, [0, 700, len(late)])
    assert (stats.lost, stats.late > 20, stats.duplicates > 20) == (0, True, True)
    for scan, other in zip(scans, same, strict=True):
        assert all(
            np.array_equal(getattr(scan.points, each), getattr(other.points, each), equal_nan=True)
            for each in scan.points.columns
        )


def test_a_period_that_depends_on_the_frame_is_looked_up_again_when_it_changes() -> None:
    """The last value of the counter is 630 or 1260, depending on a field."""
    sensor = ls.sensor("robosense-m1")
    single = list(simulate(sensor, 1300))
    frame = sensor.build("data", {**sensor.parse(single[0]), "wave_mode": 0})
    dual = [frame[:4] + number.to_bytes(2, "big") + frame[6:] for number in range(1, 1261)]
    assert [sensor.parse(data).pkt_psn for data in dual[::420]] == [1, 421, 841]
    datagrams = [*single[:630], *dual, *dual[:40], *single[:100]]
    batches, _, stats = run(sensor, datagrams, [0, 300, 640, 1500, len(datagrams)])
    assert (stats.lost, stats.late, stats.duplicates) == (0, 0, 0)
    assert int(column(batches, "breaks").sum()) == 2, (
        "where the period changes the counter starts again"
    )


@pytest.mark.parametrize("backend", ["numpy", "construct"])
@pytest.mark.parametrize("counts", [(1, 0), (0, 1, 1), (0, 0), (3, 0, 1)])
def test_packets_without_samples_give_no_points_whatever_packets_are_beside_them(
    counts: tuple[int, ...], backend: str
) -> None:
    shape = SHAPES["shape-count"]
    sensor = dataclasses.replace(
        shape, frames={"data": dataclasses.replace(shape.frames["data"], plausible=None)}
    )
    samples = [
        [dict(distance=1000 + index, quality=index)] * count for index, count in enumerate(counts)
    ]
    packets = reader(sensor, backend).decode(
        b"".join(sensor.build("data", first=0, last=100, samples=each) for each in samples),
    )
    cloud = packets.points()
    assert (len(packets), len(cloud)) == (len(counts), sum(counts))
    assert cloud.intensity is not None
    assert cloud.intensity.tolist() == [
        index for index, count in enumerate(counts) for _ in range(count)
    ]
