"""Tests of RS-LiDAR-M1 scans: borders, and late, duplicate and lost packets."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.packets.stream import PacketStream
from lidarspec.scans.stream import ScanStream
from tests.agreement import assert_same_points
from tests.evidence import decode, vector_bytes, vectors

FILE = "vectors_udp3d.json"
SENSOR = ls.sensor("robosense-m1")
TEMPLATE = SENSOR.build(
    "data", SENSOR.parse(SENSOR.example("data", seed=1)), seconds=0, microseconds=0
)


def packet(number: int, frame: int = 0, *, last: int = 630) -> bytes:
    """Return packet `number` of a frame of 0.1 s; its first radius identifies it.

    The offsets are from the manual's tables: number at 4, mode at 8, microseconds at 16, first
    radius at 34.
    """
    microseconds = round((frame + (number - 1) / last) * 100_000)
    mode, places = (
        bytes([0 if last == 1260 else 4]),
        (number.to_bytes(2, "big"), microseconds.to_bytes(4, "big")),
    )
    data = (
        TEMPLATE[:4]
        + places[0]
        + TEMPLATE[6:8]
        + mode
        + TEMPLATE[9:16]
        + places[1]
        + TEMPLATE[20:34]
    )
    return data + (1000 * frame + number).to_bytes(2, "big") + TEMPLATE[36:]


def frames(count: int, *, last: int = 630) -> list[bytes]:
    """Return the packets of `count` whole frames."""
    return [
        packet(number, frame, last=last) for frame in range(count) for number in range(1, last + 1)
    ]


def numbers(scan: ls.Scan) -> list[int]:
    """Return the packet numbers of a scan, which `packet` sets as first radius."""
    return [round(float(distance) / 0.005) for distance in scan.points.range[::125]]


def same_scans(one: list[ls.Scan], other: list[ls.Scan]) -> None:
    assert [(len(scan), scan.complete) for scan in one] == [
        (len(scan), scan.complete) for scan in other
    ]
    for scan, twin in zip(one, other, strict=True):
        assert_same_points(scan.points, twin.points)


def test_the_template_is_a_packet() -> None:
    assert SENSOR.parse(packet(7, 1)).pkt_psn == 7
    assert SENSOR.parse(packet(7, 1)).blocks[0].channels[0].radius == 1007


@pytest.mark.parametrize("name", ["rsm1_split_unit_a", "rsm1_split_unit_b", "rsm1_split_loop"])
def test_frames_are_cut_where_the_vendors_driver_cuts(name: str) -> None:
    data, expected = vector_bytes(FILE, name), vectors(FILE)[name]["expected"]
    psn = [int.from_bytes(data[i : i + 2], "big") for i in range(0, len(data), 2)]
    frame = np.cumsum(expected["new_frame_before"]).tolist()
    arrived = [(turn, number) for turn, number in zip(frame, psn, strict=True)]
    scans = list(SENSOR.scans([packet(number, turn) for turn, number in arrived]))
    wanted = [
        sorted({1000 * turn + number for turn, number in arrived if turn == one})
        for one in sorted(set(frame))
    ]
    assert [numbers(scan) for scan in scans] == wanted


@pytest.mark.slow
@pytest.mark.parametrize("last", [630, 1260])
def test_frames_of_single_and_dual_return(last: int) -> None:
    packets = decode(SENSOR, frames(2, last=last)[last - 20 : last + 10])
    assert (packets.stats.lost, packets.stats.late, packets.stats.duplicates) == (0, 0, 0)
    scans = list(SENSOR.scans(frames(3, last=last)[last - 40 : -20]))
    assert [(len(scan) // 125, scan.complete) for scan in scans] == [
        (40, False),
        (last, True),
        (last - 20, False),
    ]
    assert scans[1].rate_hz == pytest.approx(10, rel=1e-3)
    assert scans[1].points.shape == (25 * last, 5)


def shuffle(data: list[bytes], seed: int) -> list[bytes]:
    """Return the packets with some of them up to five positions late."""
    source = random.Random(seed)
    return [
        item
        for _, item in sorted(
            (place + source.choice([0, 0, 0, 5.5]), item) for place, item in enumerate(data)
        )
    ]


def duplicate(data: list[bytes], seed: int) -> list[bytes]:
    """Return the packets with some of them twice, at once or a few positions later."""
    source = random.Random(seed)
    again = [
        (place + source.choice([0.5, 3.5]), item)
        for place, item in enumerate(data)
        if source.random() < 0.05
    ]
    return [item for _, item in sorted([*enumerate(data), *again], key=lambda pair: pair[0])]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("disturbed", [shuffle, duplicate])
def test_late_and_doubled_packets_give_the_same_scans(
    disturbed: Callable[[list[bytes], int], list[bytes]], seed: int
) -> None:
    data = frames(3)
    changed = disturbed(data, seed)
    assert changed != data
    packets = SENSOR.decode(changed)
    same_scans(list(SENSOR.scans(changed)), list(SENSOR.scans(data)))
    assert packets.stats.lost == 0
    assert packets.stats.duplicates == len(changed) - len(data)
    assert (packets.stats.late > 0) == (disturbed is shuffle)


def test_a_late_packet_is_part_of_its_own_scan() -> None:
    data = frames(2)
    late = data[:627] + data[628:634] + [data[627]] + data[634:]
    same_scans(list(SENSOR.scans(late)), list(SENSOR.scans(data)))


def test_lost_packets_are_counted() -> None:
    data = frames(3)
    kept = [item for place, item in enumerate(data) if place not in {5, 6, 7, 629, 630, 1000}]
    packets = decode(SENSOR, kept[:10])
    assert packets.stats.lost == 3
    assert packets.breaks.tolist() == [place == 5 for place in range(10)]
    scans = list(SENSOR.scans(kept))
    assert SENSOR.decode(kept).stats.lost == 6
    assert [len(scan) // 125 for scan in scans] == [626, 628, 630]


def test_a_long_loss_is_counted_by_the_length_of_the_frame() -> None:
    dual = frames(1, last=1260)
    assert SENSOR.decode(dual[:20] + dual[720:740]).stats.lost == 700
    single = frames(2)
    assert SENSOR.decode(single[:100] + single[650:660]).stats.lost == 550


def test_no_point_remains_from_the_previous_scan() -> None:
    for earlier, later in pairwise(SENSOR.scans(shuffle(frames(4), 9))):
        assert {number // 1000 for number in numbers(earlier)} == {numbers(earlier)[-1] // 1000}
        assert later.stamp_ns - earlier.stamp_ns == 100_000_000


@pytest.mark.slow
def test_packets_fed_one_by_one_give_the_same_scans() -> None:
    data = shuffle(frames(2), 4)
    decoder = SENSOR.decoder()
    packets, scans = PacketStream(SENSOR, "data", decoder.stats), ScanStream(SENSOR)
    found = [scan for item in data for scan in scans.add(packets.add(decoder.frames(item)))]
    same_scans(found + scans.finish(), list(SENSOR.scans(frames(2))))
