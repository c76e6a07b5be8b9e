"""Tests that the clocks of the largest families are measured well, and their faults named.

Real frames of each sensor arrive in virtual time, 0 to 5 ms late; the clock of the sensor runs
50 ppm fast. To keep runs short, all sensors send 240 packets a second, the rate of the slowest
sensor. Only the STL-27L sends at its own rate, because its clock counts milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.frames.frame_table import CompiledTable, LayoutRows
from lidarspec.framing.frame_engine import get_codec
from lidarspec.packets.clock_monitor import ClockMonitor
from lidarspec.packets.packets import Packets
from lidarspec.packets.stream import PacketStream
from lidarspec.simulation.clock_faults import ClockFaults, ClockTimeline, parse_clock_faults
from lidarspec.simulation.clock_writer import ClockWriter, StatusWriter
from lidarspec.simulation.frame_maker import FrameMaker

pytestmark = pytest.mark.slow

#: Sensor -> the time scale that its clock follows, "" from power-up.
SENSORS = {
    "velodyne-vlp16": "utc",
    "robosense-m1": "tai",
    "hesai-xt32": "utc",
    "ouster-os1": "tai",
    "livox-mid360": "tai",
    "seyond-falcon": "utc",
    "sick-multiscan136": "utc",
    "ldrobot-stl27l": "",
}
EPOCHS = {"ouster-os1": "tai"}
RATE_HZ = 240
RATES_HZ = {"ldrobot-stl27l": 1800}
PIECE_S = 0.1
CHUNK_S = 10
JITTER_S = 5e-3
PPM = 50.0
BEGAN_NS = 1_768_564_800 * 10**9  # 2026-01-16, 12:00 UTC
#: Fault -> its event, and the time of both, s.
FAULTS = {
    "step=0.2s@120s": ("jump", 120),
    "step=37s@240s": ("jump", 240),
    "pps=1@360s": ("second_step", 360),
    "restart@483s": ("restart", 483),
}
UNLOCK = "unlock@60s"


@dataclass(frozen=True)
class SimulatedClock:
    """A sensor with a clock that has faults.

    Args:
        sensor: the sensor.
        faults: the faults.
        rate_hz: packets a second.
    """

    sensor: ls.Sensor
    faults: ClockFaults
    rate_hz: int

    def iter_packets(self, seconds: int, seed: int) -> Iterator[Packets]:
        """Yield packets with their arrival times, in chunks of ten seconds."""
        sensor = self.sensor
        name = sensor.data_frame
        decoder = sensor.decoder(stream=False)
        stream = PacketStream(sensor, name, decoder.stats)
        random = np.random.default_rng(seed)
        count = CHUNK_S * self.rate_hz
        for start in range(0, seconds * self.rate_hz, count):
            sent_ns = np.arange(start, start + count) * 10**9 // self.rate_hz
            data = self._make_frames(sent_ns)
            status = self._make_status(sent_ns[:1])
            packets = stream.add([decoder.datagrams(status + data)])
            assert len(packets) == count
            late_ns = np.rint(random.uniform(0, JITTER_S * 1e9, count)).astype(np.int64)
            packets.host_ns = BEGAN_NS + sent_ns + late_ns
            yield packets

    def _make_frames(self, times: np.ndarray) -> list[bytes]:
        """Return the data frames at some times since power-on, ns."""
        sensor = self.sensor
        name = sensor.data_frame
        example = ls.simulate(sensor, 1)[0]
        first = repeat_frame(sensor, name, example, 1)
        table = repeat_frame(sensor, name, example, len(times))
        assert sensor.clock is not None
        writer = ClockWriter(sensor, sensor.clock, first)
        base = writer.read(first).item()
        timeline = ClockTimeline(self.faults, BEGAN_NS)
        writer.write(table, timeline.apply_faults(base + times, times, base))
        status = sensor.clock.status
        if status is not None and not status.frame:
            states = timeline.lock_states(times)
            StatusWriter(sensor, first, writer.read).write(table, states, self.faults.follows)
        return FrameMaker(sensor, name).make_frames(table)

    def _make_status(self, times: np.ndarray) -> list[bytes]:
        """Return the frames of another type that report the state of the clock."""
        sensor = self.sensor
        assert sensor.clock is not None
        status = sensor.clock.status
        if status is None or not status.frame:
            return []
        frame = sensor.parse(sensor.example(status.frame), status.frame)
        if "nmea" in frame:
            frame.nmea = bytes(len(frame.nmea))  # no date, so that the clock counts from the hour
        example = sensor.build(status.frame, frame)
        first = repeat_frame(sensor, status.frame, example, 1)
        table = repeat_frame(sensor, status.frame, example, len(times))
        states = ClockTimeline(self.faults).lock_states(times)
        StatusWriter(sensor, first).write(table, states, self.faults.follows)
        return FrameMaker(sensor, status.frame).make_frames(table)


def repeat_frame(sensor: ls.Sensor, name: str, data: bytes, count: int) -> CompiledTable:
    """Return a table of one frame, repeated, whose fields can be written."""
    table = get_codec(sensor.frames[name]).table([data])
    assert isinstance(table, CompiledTable)
    (group,) = table.groups
    rows = np.repeat(group.rows, count, axis=0)
    return CompiledTable(table.schema, [LayoutRows(group.layout, np.arange(count), rows)])


def make_clock(name: str, *faults: str) -> SimulatedClock:
    """Return a sensor whose clock runs fast and has these faults."""
    sensor = ls.sensor(name)
    if name in EPOCHS:
        sensor = sensor.configure(epoch=EPOCHS[name])
    words = [*filter(None, [SENSORS[name]]), f"drift={PPM}ppm", *faults]
    faults = parse_clock_faults(",".join(words))
    return SimulatedClock(sensor, faults, RATES_HZ.get(name, RATE_HZ))


def iter_pieces(packets: Packets) -> Iterator[Packets]:
    """Yield the packets of each tenth of a second."""
    count = round(len(packets) * PIECE_S / CHUNK_S)
    for start in range(0, len(packets), count):
        yield packets.take(slice(start, start + count))


@pytest.mark.parametrize("name", SENSORS)
def test_offset_and_drift_are_measured(name: str) -> None:
    clock = make_clock(name)
    monitor = ClockMonitor(clock.sensor)
    for number, packets in enumerate(clock.iter_packets(600, seed=1)):
        monitor.add(packets)
        report = monitor.report()
        last_sent_ns = ((number + 1) * len(packets) - 1) * 10**9 // clock.rate_hz
        true_offset_s = (packets.time_ns.item(-1) - BEGAN_NS - last_sent_ns) / 1e9
        assert report.offset_s == pytest.approx(true_offset_s, abs=1e-3)
        if number >= 6:  # after a minute
            assert report.drift_ppm == pytest.approx(PPM, abs=1)


@pytest.mark.parametrize("name", SENSORS)
def test_nothing_is_named_in_an_hour_without_faults(name: str) -> None:
    clock = replace(make_clock(name), rate_hz=60)
    monitor = ClockMonitor(clock.sensor)
    for packets in clock.iter_packets(3600, seed=4):
        monitor.add(packets)
        report = monitor.report()
        assert not any(finding.is_fault for finding in report.findings)
        assert report.events == ()


@pytest.mark.parametrize("name", SENSORS)
def test_every_fault_is_named_within_two_seconds(name: str) -> None:
    clock = make_clock(name, *FAULTS)
    monitor = ClockMonitor(clock.sensor)
    named = []
    for packets in clock.iter_packets(600, seed=2):
        for piece in iter_pieces(packets):
            for event in monitor.add(piece):
                named.append((event.code, (piece.host_ns.item(-1) - BEGAN_NS) / 1e9))
    expected = list(FAULTS.values())
    changes = [(code, at_s) for code, at_s in named if code != "lock_lost"]
    assert [code for code, _ in changes] == [code for code, _ in expected]
    for (_, at_s), (_, fault_s) in zip(changes, expected, strict=True):
        assert fault_s < at_s < fault_s + 2


@pytest.mark.parametrize("name", ["velodyne-vlp16", "robosense-m1", "livox-mid360"])
def test_a_lost_lock_is_named_with_the_packet_that_reports_it(name: str) -> None:
    clock = make_clock(name, UNLOCK)
    monitor = ClockMonitor(clock.sensor)
    named = []
    for packets in clock.iter_packets(120, seed=3):
        for piece in iter_pieces(packets):
            for event in monitor.add(piece):
                named.append((event.code, (piece.host_ns.item(0) - BEGAN_NS) / 1e9))
    assert [code for code, _ in named] == ["lock_lost"]
    assert 60 <= named[0][1] < 60 + PIECE_S
    assert monitor.report().verdict.code == "not_locked"
