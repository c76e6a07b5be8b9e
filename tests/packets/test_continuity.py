"""Tests of lost, duplicate and late packets, by the counter and by the clock."""

from __future__ import annotations

import dataclasses
import itertools
import random
from collections.abc import Callable, Sequence

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Counters, Packets, Sensor, simulate
from lidarspec.packets.stream import PacketStream
from lidarspec_ldrobot import CRC8
from tests.engine.streams import damage
from tests.representatives import load_sensor

#: sensors without a counter, and what tells their packets apart.
UNCOUNTED = ["velodyne-vlp16", "velodyne-hdl32e", "hesai-pandar40p", "hesai-pandar64"]


def list_losses(packets: Packets) -> tuple[int, int, int]:
    stats = packets.stats
    assert stats.plugin_errors == 0
    return stats.lost, stats.late, stats.duplicates


def decode(sensor: Sensor, frames: Sequence[bytes]) -> Packets:
    return sensor.decode(list(frames) if sensor.datagrams else b"".join(frames))


def decode_in_pieces(
    sensor: Sensor, frames: Sequence[bytes], size: int
) -> tuple[np.ndarray, Counters]:
    """Decode datagrams in pieces; return the index of each packet, and the counters."""
    decoder = sensor.decoder()
    stream = PacketStream(sensor, "data", decoder.stats)
    parts = [frames[start : start + size] for start in range(0, len(frames), size)]
    return np.concatenate(
        [stream.add([decoder.datagrams(part, [None] * len(part))]).index for part in parts]
    ), decoder.stats


def test_sensors_without_a_counter_are_known() -> None:
    assert all(ls.sensor(name).data_frame == "data" for name in UNCOUNTED)
    for name in UNCOUNTED:
        sequence = ls.sensor(name).sequence
        assert sequence is None or sequence.field not in str(ls.sensor(name).frames["data"])


def test_sensors_with_datagrams_that_count_no_losses_are_known() -> None:
    datagrams = [sensor for sensor in ls.sensors().values() if sensor.datagrams]
    assert [sensor.id for sensor in datagrams if not sensor.counts_losses] == [
        "benewake-ce30d",
        "seyond-falcon",
    ]


@pytest.mark.parametrize("name", ["shape-paced", *UNCOUNTED, "ldrobot-ld06", "robosense-m1"])
@pytest.mark.parametrize("lost", [1, 50])
def test_a_clock_gap_is_a_loss_without_a_counter(name: str, lost: int) -> None:
    sensor = load_sensor(name)
    frames = simulate(sensor, 600)
    packets = decode(sensor, frames[:250] + frames[250 + lost :])
    assert list_losses(packets) == (lost, 0, 0)
    assert np.flatnonzero(packets.breaks).tolist() == [250]
    assert packets.index.tolist() == [
        int(packets.index[0]) + place for place in range(600) if not 250 <= place < 250 + lost
    ]
    assert list_losses(decode(sensor, frames)) == (0, 0, 0)


def test_a_declared_pace_finds_that_every_second_packet_is_missing() -> None:
    sensor = ls.sensor("velodyne-vlp16")
    assert list_losses(sensor.decode(simulate(sensor, 600)[::2])) == (299, 0, 0)


def test_a_clock_too_coarse_for_single_packets_claims_no_more_than_is_sure() -> None:
    """The clock counts milliseconds, and an STL-27L sends two packets in this time."""
    sensor = ls.sensor("ldrobot-stl27l")
    frames = simulate(sensor, 3000)
    assert list_losses(decode(sensor, frames)) == (0, 0, 0)
    for lost in (1, 3, 20, 400):
        found = list_losses(decode(sensor, frames[:2000] + frames[2000 + lost :]))[0]
        assert lost - 4 - lost // 25 <= found <= lost + lost // 25


def swap(frames: list[bytes]) -> list[bytes]:
    changed = list(frames)
    for spot in range(50, len(frames) - 10, 37):
        changed[spot], changed[spot + 3] = changed[spot + 3], changed[spot]
    return changed


def duplicate(frames: list[bytes]) -> list[bytes]:
    return [frame for place, frame in enumerate(frames) for _ in range(1 + (place % 10 == 3))]


def doubled_late(frames: list[bytes]) -> list[bytes]:
    return [
        other
        for place, frame in enumerate(frames)
        for other in ([frame, frames[place - 5]] if place % 50 == 30 else [frame])
    ]


@pytest.mark.parametrize("name", UNCOUNTED)
@pytest.mark.parametrize("disturbed", [swap, duplicate, doubled_late])
def test_order_follows_the_clock_without_a_counter(
    name: str, disturbed: Callable[[list[bytes]], list[bytes]]
) -> None:
    sensor = ls.sensor(name)
    frames = simulate(sensor, 600)
    changed = disturbed(frames)
    assert changed != frames
    packets = sensor.decode(changed)
    lost, late, duplicates = list_losses(packets)
    assert (lost, duplicates) == (0, len(changed) - len(frames))
    assert (late > 0) == (disturbed is swap)
    for scan, same in itertools.zip_longest(sensor.scans(changed), sensor.scans(frames)):
        assert (len(scan), scan.complete, scan.stamp_ns) == (
            len(same),
            same.complete,
            same.stamp_ns,
        )
        for column in scan.points.columns:
            np.testing.assert_array_equal(
                getattr(scan.points, column), getattr(same.points, column)
            )


def test_packets_of_one_time_that_differ_are_not_doubles() -> None:
    sensor = ls.sensor("velodyne-vlp16")
    frames = simulate(sensor, 100)
    other = frames[51][:1200] + frames[50][1200:]
    assert list_losses(sensor.decode([*frames[:51], other, *frames[52:]]))[2] == 0


@pytest.mark.parametrize("lost", [300, 629, 630, 631, 6300, 118_976])
def test_losses_beyond_a_counter_wrap_are_counted_by_the_clock(lost: int) -> None:
    sensor = ls.sensor("robosense-m1")
    packets = sensor.decode(simulate(sensor, 700) + simulate(sensor, 700, start=700 + lost))
    assert list_losses(packets) == (lost, 0, 0)
    assert int(packets.breaks.sum()) == 1


def helios(number: int, counter: int) -> bytes:
    sensor = ls.sensor("robosense-helios16p")
    (frame,) = simulate(sensor, 1, start=number)
    return sensor.build("data", {**sensor.parse(frame), "bottom_packet_count": counter})


@pytest.mark.parametrize("counter", [40_000, 0, 103, 95, 99, 2**16 - 1])
def test_a_counter_that_jumps_without_the_clock_is_damage_and_no_loss(counter: int) -> None:
    sensor = load_sensor("shape-extras")
    frames = simulate(sensor, 300)
    damaged = sensor.build("data", {**sensor.parse(frames[100]), "number": counter})
    packets = sensor.decode([*frames[:100], damaged, *frames[101:]])
    assert list_losses(packets) == (0, 0, 0)
    assert np.diff(packets.index).tolist() == [1] * 299
    assert not packets.breaks.any()


def test_a_restarted_counter_with_a_continuing_clock() -> None:
    sensor = ls.sensor("robosense-helios16p")
    frames = simulate(sensor, 200) + [
        helios(number, number - 200) for number in range(200, 230) if number not in (210, 211)
    ]
    assert list_losses(sensor.decode(frames)) == (2, 0, 0)


def test_one_damaged_reading_of_the_clock_loses_nothing() -> None:
    sensor = ls.sensor("velodyne-vlp16")
    frames = simulate(sensor, 600)
    for reading in (1_000_000_000, 3_000_000_000):
        damaged = frames[300][:1200] + reading.to_bytes(4, "little") + frames[300][1204:]
        packets = sensor.decode([*frames[:300], damaged, *frames[301:]])
        assert list_losses(packets) == (0, 0, 0)
        assert np.flatnonzero(packets.breaks).tolist() == [300, 301]


def set_time(frame: bytes, time_ms: int) -> bytes:
    """Return an LDROBOT data frame with another time and a valid checksum."""
    body = frame[:-3] + time_ms.to_bytes(2, "little")
    return body + bytes([CRC8(body)])


@pytest.mark.parametrize("size", [1, 47, 1000, 10**6])
@pytest.mark.parametrize("lost", [0, 400])
@pytest.mark.parametrize(
    "times_ms",
    [(29_000,), (10_000,), (1_200,), (5_000, 9_000), (9_000, 5_000), (14_000, 14_500, 3)],
)
def test_wrong_times_with_a_valid_checksum_lose_nothing(
    times_ms: tuple[int, ...], lost: int, size: int
) -> None:
    """A checksum of 8 bits accepts one of 256 damaged frames."""
    sensor = ls.sensor("ldrobot-stl27l")
    frames = simulate(sensor, 4000)
    wrong = [set_time(frame, ms) for frame, ms in zip(frames[2000:], times_ms, strict=False)]
    after = frames[2000 + len(wrong) + lost :]
    data = b"".join([*frames[:2000], *wrong, *after])
    decoder = sensor.decoder()
    stream = PacketStream(sensor, "data", decoder.stats)
    parts = [stream.add(decoder.frames(data[i : i + size])) for i in range(0, len(data), size)]
    breaks = np.concatenate([part.breaks for part in parts])
    assert np.flatnonzero(breaks).tolist() == list(range(2000, 2001 + len(wrong)))
    assert decoder.stats.lost == pytest.approx(lost, abs=lost // 50)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("rate", [0.001, 0.01])
def test_losses_in_a_damaged_stream_are_counted(rate: float, seed: int) -> None:
    sensor = ls.sensor("ldrobot-stl27l")
    frames = simulate(sensor, 10_000)
    packets = sensor.decode(damage(b"".join(frames), rate, seed))
    assert packets.stats.lost == pytest.approx(len(frames) - len(packets), rel=0.01)


def test_clock_changes_and_restarts_are_no_loss() -> None:
    for name in ("robosense-m1", "hesai-pandar40p"):
        sensor = ls.sensor(name)
        frames = simulate(sensor, 2000)
        for again in (frames[:300] + frames[:300], frames[1000:1300] + frames[:300]):
            assert list_losses(sensor.decode(again))[0] <= 630


def test_a_clock_without_a_declared_pace_counts_no_loss() -> None:
    vlp16 = ls.sensor("velodyne-vlp16")
    assert vlp16.clock is not None
    sensor = dataclasses.replace(vlp16, clock=dataclasses.replace(vlp16.clock, pace=None))
    frames = simulate(vlp16, 600)
    packets = sensor.decode(frames[:300] + frames[310:])
    assert list_losses(packets) == (0, 0, 0)
    assert vlp16.counts_losses
    assert not sensor.counts_losses


@pytest.mark.parametrize("lost", [0, 3])
@pytest.mark.parametrize("counter", [294_968_297, 1_000, 2**32 - 1])
def test_one_damaged_counter_without_a_pace_is_two_breaks_and_no_loss(
    counter: int, lost: int
) -> None:
    sensor = ls.sensor("robosense-helios16p")
    frames = simulate(sensor, 300)
    packets = sensor.decode([*frames[:200], helios(200, counter), *frames[201 + lost :]])
    assert list_losses(packets) == (0, 0, 0)
    assert np.flatnonzero(packets.breaks).tolist() == [200, 201]


@pytest.mark.parametrize(
    "name", ["shape-paced", "shape-columns", "shape-headed", "velodyne-vlp16", "robosense-m1"]
)
@pytest.mark.parametrize("seed", [0, 2])
def test_pieces_do_not_matter(name: str, seed: int) -> None:
    sensor = load_sensor(name)
    draw = random.Random(seed)
    frames = [frame for frame in simulate(sensor, 200) if draw.random() > 0.02 * seed]
    for _ in range(10):
        spot = draw.randrange(20, len(frames) - 20)
        frames.insert(spot + draw.randint(0, 5), frames.pop(spot))
        frames.insert(draw.randrange(len(frames)), frames[spot])
    index, stats = decode_in_pieces(sensor, frames, len(frames))
    for size in (1, 7, 64):
        other, others = decode_in_pieces(sensor, frames, size)
        assert np.array_equal(other, index)
        assert others == stats


@pytest.mark.parametrize("name", ["robosense-m1", "hesai-xt32", "velodyne-vlp16"])
def test_a_looped_recording_continues(name: str) -> None:
    sensor = ls.sensor(name)
    packets = sensor.decode(simulate(sensor, 630) * 4)
    assert list_losses(packets) == (0, 0, 0)
    assert packets.breaks.sum() == (0 if name == "robosense-m1" else 3)
    assert sum(len(scan) for scan in sensor.scans(simulate(sensor, 630) * 4)) == len(
        packets.points()
    )
