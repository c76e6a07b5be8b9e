"""Tests of the figures of `stats` and `view`, counted by hand from known arrivals."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Counters, Decoder, Packets, simulate
from lidarspec.packets.stream import PacketStream
from lidarspec.scans.stream import ScanStream
from lidarspec.view.rate_meter import RateMeter, RateTally

ID = "ldrobot-stl27l"
FRAMES = 540
START = 1_700_000_000_000_000_000


class Bench:
    """A sensor's frames as they are fed, and the meter that counts them."""

    def __init__(self, frames: int = FRAMES) -> None:
        sensor = ls.sensor(ID)
        self.frames = simulate(sensor, frames)
        self.decoder: Decoder = sensor.decoder()
        self.meter = RateMeter(self.decoder.stats, counts_losses=False)
        self._packets, self._scans = (
            PacketStream(sensor, "data", self.decoder.stats),
            ScanStream(sensor),
        )

    def feed(self, data: bytes, at: int | None) -> Packets:
        packets = self._packets.add(self.decoder.frames(data, at))
        self.meter.add_packets(packets)
        for scan in self._scans.add(packets) if len(packets) else []:
            self.meter.add_scan(scan)
        return packets


@pytest.mark.slow
def test_rates_gaps_and_jitter_are_those_of_the_arrivals() -> None:
    bench = Bench()
    source = np.random.default_rng(3)
    at = START + np.cumsum(source.integers(100_000, 900_000, FRAMES))
    for frame, when in zip(bench.frames, at.tolist(), strict=True):
        bench.feed(frame, when)
    found = bench.meter.summary(bench.decoder.stats)
    gaps = np.diff(at) * 1e-9
    assert found.packets == FRAMES
    assert found.seconds == pytest.approx((at[-1] - at[0]) * 1e-9)
    assert found.packet_rate_hz == pytest.approx((FRAMES - 1) / found.seconds)
    assert found.jitter_s == pytest.approx(gaps.std(), rel=1e-6)
    assert found.longest_gap_s == pytest.approx(gaps.max())
    assert found.bytes_per_s == pytest.approx(47 * FRAMES / found.seconds)
    assert (found.scans, found.points) == (1, 2160)
    assert found.speed_hz == pytest.approx(10)


def test_readings_follow_each_other_without_a_gap_or_an_overlap() -> None:
    frames_per_reading = 100
    bench = Bench(3 * frames_per_reading)
    whole = 0
    for number in range(3):
        first = number * frames_per_reading
        for place in range(first, first + frames_per_reading):
            bench.feed(bench.frames[place], START + place * 1_000_000)
        found = bench.meter.take_reading(bench.decoder.stats)
        whole += found.packets
        assert found.packets == frames_per_reading
        assert found.packet_rate_hz == pytest.approx(1000)
        assert found.seconds == pytest.approx(0.1 if number else 0.099)
    assert whole == bench.meter.summary(bench.decoder.stats).packets


def test_errors_and_skipped_bytes_are_shares() -> None:
    bench = Bench(200)
    for number, frame in enumerate(bench.frames):
        bench.feed(frame[:-1] + b"\0" if number % 10 == 0 else frame, START + number)
    found = bench.meter.summary(bench.decoder.stats, seconds=2.0)
    assert found.error_rate == pytest.approx(0.1)
    assert found.skipped_rate == pytest.approx(0.1)
    assert found.loss_rate is None
    assert found.seconds == 2.0


def test_lost_packets_are_a_share_where_the_sensor_numbers_them() -> None:
    sensor = ls.sensor("robosense-m1")
    decoder = sensor.decoder()
    meter, stream = (
        RateMeter(decoder.stats, counts_losses=True),
        PacketStream(sensor, "data", decoder.stats),
    )
    frames = [frame for number, frame in enumerate(simulate(sensor, 200)) if number % 10 != 5]
    meter.add_packets(
        stream.add([decoder.datagrams(frames, [START + n * 1000 for n in range(len(frames))])])
    )
    assert meter.summary(decoder.stats).loss_rate == pytest.approx(0.1)


def test_without_arrival_times_rates_are_by_the_sensors_clock() -> None:
    bench = Bench()
    bench.feed(b"".join(bench.frames), None)
    found = bench.meter.summary(bench.decoder.stats)
    assert found.packet_rate_hz == pytest.approx(1800, rel=0.01)
    assert found.jitter_s is None
    assert found.longest_gap_s is None


def test_before_any_data_there_are_no_figures() -> None:
    bench = Bench()
    found = bench.meter.take_reading(bench.decoder.stats)
    assert (found.packets, found.scans, found.error_rate) == (0, 0, 0.0)
    assert {found.speed_hz, found.packet_rate_hz, found.jitter_s, found.points, found.seconds} == {
        None
    }
    assert all(value is None or math.isfinite(value) for value in found.to_dict().values())


def test_even_arrivals_have_no_jitter() -> None:
    bench = Bench(200)
    times = [START + number * 555_555 for number in range(200)]
    assert {later - earlier for earlier, later in pairwise(times)} == {555_555}
    for frame, at in zip(bench.frames, times, strict=True):
        bench.feed(frame, at)
    found = bench.meter.summary(bench.decoder.stats)
    assert found.jitter_s == pytest.approx(0, abs=1e-8)


def test_the_speed_is_exact_for_coarse_arrival_times_and_ignores_lost_ends() -> None:
    tally = RateTally(Counters())
    # Fifteen scans a second in steps of 10 ms. The end of one scan is lost.
    for period_ms in [70, 60, 70] * 20 + [130]:
        tally.add_scan(400, 390, 1000 / period_ms)
    found = tally.make_reading(Counters(), seconds=None, counts_losses=False)
    assert found.speed_hz == pytest.approx(15)


@pytest.mark.parametrize("periods_s", [[0.1, 0.4], [0.4, 0.1] * 50])
def test_half_of_the_scans_without_their_ends_do_not_change_the_speed(
    periods_s: list[float],
) -> None:
    tally = RateTally(Counters())
    for period_s in periods_s:
        tally.add_scan(400, 390, 1 / period_s)
    found = tally.make_reading(Counters(), seconds=None, counts_losses=False)
    assert found.speed_hz == pytest.approx(10)
