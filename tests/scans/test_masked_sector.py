"""Tests of masked sectors: no points are lost, and each revolution gives one scan."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan, Sensor, UsageError, simulate
from lidarspec.packets.stream import PacketStream
from lidarspec.scans.stream import ScanStream
from lidarspec.spec import Clock, Fields, OnChange, OnWrap, Simulation
from tests.packets.test_reorder import assert_same_scans
from tests.representatives import load_sensor
from tests.shapes.extras import BLOCKS

EXTRAS = load_sensor("shape-extras")
#: degrees from block to block.
STEP_DEG = 1
BLOCKS_PER_TURN = 360 // STEP_DEG
#: seconds from block to block: ten turns a second.
STEP_S = 0.1 / BLOCKS_PER_TURN
SECTORS = [(270, 90), (0, 180), (90, 110), (200, 30), (30, 320)]
TURNS = 6

Sector = tuple[int, int]


def is_visible(degrees: Any, sector: Sector) -> Any:
    start, stop = sector
    if start < stop:
        return (degrees >= start) & (degrees < stop)
    return (degrees >= start) | (degrees < stop)


def blocks_of(
    sector: Sector | None, *, whole_packets: bool, turns: int = TURNS
) -> list[np.ndarray]:
    """Return the numbers of the blocks in each packet of a masked sensor.

    Args:
        whole_packets: packets have the blocks that they would have without a mask; else those of
            the sector, one after another.
    """
    blocks = np.arange(turns * BLOCKS_PER_TURN // BLOCKS * BLOCKS)
    visible = (
        np.ones(len(blocks), bool)
        if sector is None
        else is_visible(blocks * STEP_DEG % 360, sector)
    )
    if whole_packets:
        packets = blocks.reshape(-1, BLOCKS)
        return list(packets[visible.reshape(-1, BLOCKS).any(axis=1)])
    sent = blocks[visible]
    return list(sent[: len(sent) // BLOCKS * BLOCKS].reshape(-1, BLOCKS))


def pace(f: Fields) -> float:
    return BLOCKS * STEP_S


def rotating(
    packets: Sequence[np.ndarray], *, counted: bool = False, clockwise: bool = False
) -> Sensor:
    """Return a sensor that sends these packets, ordered by a clock or by a counter.

    The counter counts the packets that were sent.
    """

    def sweep(i: int) -> dict[str, Any]:
        blocks = packets[min(i, len(packets) - 1)] + max(i - len(packets) + 1, 0)
        degrees = blocks * STEP_DEG % 360
        return {
            "number": i % 65_536,
            "time": round(float(blocks[0]) * STEP_S, 6),
            "blocks.azimuth": (360 - degrees) % 360 if clockwise else degrees,
            "blocks.signal": np.arange(BLOCKS),
        }

    return dataclasses.replace(
        EXTRAS,
        scan=OnWrap("blocks.azimuth"),
        clock=None if counted else Clock("time", wraps_at=4294.967296, pace=pace),
        sequence=EXTRAS.sequence if counted else None,
        simulation=Simulation(sweep, rate=100.0),
        turn=(5.0, 20.0),
    )


def degrees_of(scan: Scan) -> np.ndarray:
    """Return the angles of a scan's points without wraps, degrees."""
    return np.rad2deg(np.unwrap(scan.points.azimuth.astype(np.float64)))


def assert_one_scan_a_turn(scans: Sequence[Scan], sector: Sector) -> None:
    """Check that each scan, except the first and last, is the visible sector, once."""
    inner = scans[1:-1]
    assert len(inner) >= TURNS - 2
    assert all(scan.complete for scan in inner)
    for scan in inner:
        degrees = degrees_of(scan)
        width = (sector[1] - sector[0]) % 360
        assert abs(degrees[-1] - degrees[0]) == pytest.approx(width, abs=(BLOCKS + 1) * STEP_DEG)
        assert (degrees[0] - sector[0] + 180) % 360 - 180 == pytest.approx(
            0, abs=(BLOCKS + 1) * STEP_DEG
        )


@pytest.mark.parametrize("whole_packets", [True, False], ids=["whole", "packed"])
@pytest.mark.parametrize("sector", SECTORS, ids=str)
def test_a_masked_sector_is_no_loss_and_cuts_the_scans(sector: Sector, whole_packets: bool) -> None:
    packets = blocks_of(sector, whole_packets=whole_packets)
    sensor = rotating(packets)
    frames = simulate(sensor, len(packets))
    assert sensor.decode(frames).stats.lost == 0
    assert_one_scan_a_turn(list(sensor.scans(frames)), sector)


def test_a_sensor_that_counts_the_packets_it_sends() -> None:
    packets = blocks_of((90, 110), whole_packets=False)
    sensor = rotating(packets, counted=True)
    frames = simulate(sensor, len(packets))
    assert sensor.decode(frames).stats.lost == 0
    assert_one_scan_a_turn(list(sensor.scans(frames)), (90, 110))


def test_a_sensor_that_turns_the_other_way_has_the_same_scans() -> None:
    packets = blocks_of((270, 90), whole_packets=True)
    sensor = rotating(packets, clockwise=True)
    frames = simulate(sensor, len(packets))
    scans = list(sensor.scans(frames))
    assert sensor.decode(frames).stats.lost == 0
    assert len({len(scan) for scan in scans[1:-1]}) == 1
    assert all(scan.complete for scan in scans[1:-1])


def test_the_sizes_of_batches_do_not_matter() -> None:
    packets = blocks_of((200, 30), whole_packets=False, turns=3)
    sensor = rotating(packets)
    frames = simulate(sensor, len(packets))
    decoder = sensor.decoder()
    packet_stream = PacketStream(sensor, "data", decoder.stats)
    scan_stream = ScanStream(sensor)
    scans = list[Scan]()
    for start in range(0, len(frames), 5):
        part = frames[start : start + 5]
        scans += scan_stream.add(packet_stream.add([decoder.datagrams(part, [None] * len(part))]))
    assert_same_scans([*scans, *scan_stream.finish()], list(sensor.scans(frames)))
    assert decoder.stats.lost == 0
    assert "from about 28 to 200 degrees" in decoder.stats.masked


@pytest.mark.parametrize("lost", [range(20, 40), range(300, 330)], ids=["first turn", "later"])
def test_a_loss_is_no_masked_sector(lost: range) -> None:
    packets = blocks_of(None, whole_packets=True)
    kept = [packet for number, packet in enumerate(packets) if number not in lost]
    sensor = rotating(kept)
    frames = simulate(sensor, len(kept))
    stats = sensor.decode(frames).stats
    assert stats.lost == len(lost)
    assert not stats.masked
    scans = list(sensor.scans(frames))
    assert [len(scan) for scan in scans if scan.complete] == [BLOCKS_PER_TURN * 3] * sum(
        scan.complete for scan in scans
    )
    assert TURNS - 3 <= sum(scan.complete for scan in scans) < TURNS - 1


def test_a_loss_beside_a_masked_sector_counts() -> None:
    packets = blocks_of((270, 90), whole_packets=True)
    kept = [*packets[:100], *packets[103:]]
    sensor = rotating(kept)
    frames = simulate(sensor, len(kept))
    assert sensor.decode(frames).stats.lost == 3
    assert [scan.complete for scan in list(sensor.scans(frames))[1:-1]].count(False) == 1


def test_a_rotor_that_stops_behind_a_masked_sector_ends_its_scans() -> None:
    packets = blocks_of((270, 90), whole_packets=True, turns=2)[:70]
    sensor = rotating(packets)
    decoder = sensor.decoder()
    packet_stream = PacketStream(sensor, "data", decoder.stats)
    scan_stream = ScanStream(sensor)
    values = sensor.parse(simulate(sensor, 70)[-1])
    frames = simulate(sensor, 70)
    frames += [
        sensor.build("data", {**values, "time": values["time"] + number * 10_000})
        for number in range(1, 200)
    ]
    scans = scan_stream.add(packet_stream.add([decoder.datagrams(frames, [None] * len(frames))]))
    assert scans


def test_scans_are_cut_at_a_chosen_angle() -> None:
    packets = blocks_of(None, whole_packets=True)
    sensor = rotating(packets).configure(cut=90)
    frames = simulate(sensor, len(packets))
    scans = list(sensor.scans(frames))
    assert all(scan.complete for scan in scans[1:-1])
    assert [round(degrees_of(scan)[0]) for scan in scans[1:]] == [90] * (len(scans) - 1)


@pytest.mark.parametrize(("cut", "begins"), [(0, 0), (180, 270)])
def test_the_cut_of_the_user_has_priority_over_a_masked_sector(cut: float, begins: int) -> None:
    packets = blocks_of((270, 90), whole_packets=False)
    sensor = rotating(packets).configure(cut=cut)
    frames = simulate(sensor, len(packets))
    scans = list(sensor.scans(frames))
    assert sensor.decode(frames).stats.lost == 0
    assert all(scan.complete for scan in scans[1:-1])
    assert [round(degrees_of(scan)[0] % 360) for scan in scans[1:]] == [begins] * (len(scans) - 1)


def test_a_cut_that_cannot_be_is_refused() -> None:
    sensor = rotating(blocks_of(None, whole_packets=True))
    with pytest.raises(UsageError, match="cut must be an angle in degrees, not 'north'"):
        sensor.configure(cut="north")
    with pytest.raises(UsageError, match="do not end at an angle"):
        EXTRAS.configure(cut=90)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["velodyne-vlp16", "hesai-xt32", "robosense-rs16", "robosense-helios16p", "ouster-os1"]
)
@pytest.mark.parametrize("sector", [(270, 90), (0, 180), (90, 100)], ids=str)
def test_sensors_with_a_masked_sector(name: str, sector: Sector) -> None:
    sensor = ls.sensor(name)
    frames = simulate(sensor, 1600 if name == "hesai-xt32" else 500)
    packets = sensor.decode(frames)
    degrees = (
        packets["columns.measurement_id"] * 360 / 1024
        if isinstance(sensor.scan, OnChange)
        else packets[sensor.scan.name]
    )
    visible = [
        frame
        for frame, is_kept in zip(frames, is_visible(degrees, sector).any(axis=1), strict=True)
        if is_kept
    ]
    scans = list(sensor.scans(visible))
    assert sensor.decode(visible).stats.lost == 0
    assert all(scan.complete for scan in scans[1:-1])
    turns = np.unwrap(np.deg2rad(degrees[:, 0]))[-1] / (2 * np.pi)
    assert turns - 1 < len(scans) < turns + 2
