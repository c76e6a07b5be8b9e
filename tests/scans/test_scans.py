"""Where scans end, and what is said of those that do not."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan
from lidarspec.framing.results import Frames
from lidarspec.packets.stream import PacketStream
from lidarspec.scans.scans import ScanStream
from lidarspec.simulation.scenes import Room
from lidarspec.simulation.simulator import opening, simulate, simulation

#: a rotor that is blocked, or the start of a scan that does not come: seconds of the longest scan, twice the slowest turn.
BLOCKED = {"ldrobot-ld06": 0.4, "velodyne-vlp16": 0.4, "slamtec-rplidar-a1": 2.0, "cspc-m1c1-mini": 1.0}
#: from one packet of a VLP-16 to the next.
PACKET_NS = 1_327_104


class Reading:
    """A sensor read in pieces: its scans as they come."""

    def __init__(self, name: str) -> None:
        self.sensor = ls.sensor(name)
        decoder = self.sensor.decoder()
        self.decoder, self.stats = decoder, decoder.stats
        self._packets, self._scans = PacketStream(self.sensor, self.sensor.data_frame, decoder.stats), ScanStream(self.sensor)
        if decoder.stream:
            decoder.frames(opening(self.sensor))

    def scans(self, frames: list[bytes]) -> list[Scan]:
        """The scans that some more frames complete."""
        decoder = self.decoder
        return self.scans_of(*(decoder.frames(b"".join(frames)) if decoder.stream else [decoder.datagrams(frames, [1] * len(frames))]))

    def scans_of(self, *found: Frames) -> list[Scan]:
        """The scans that frames of the decoder complete."""
        return self._scans.add(self._packets.add(found))


@pytest.mark.parametrize("name", BLOCKED)
def test_a_scan_ends_though_the_rotor_is_blocked(name: str) -> None:
    reading = Reading(name)
    blocked = simulation(reading.sensor, reading.sensor.data_frame, blocked=True)
    longest, sizes = BLOCKED[name], list[int]()
    for part in range(4):
        frames = blocked.block(part * 4000, 4000, Room()).frames
        for scan in reading.scans(frames):
            assert not scan.complete
            assert not np.isfinite(scan.rate_hz)
            assert scan.points.time[-1] - scan.points.time[0] <= longest * 1.01
            sizes.append(len(scan))
    assert len(sizes) > 2
    assert max(sizes) < 1.1 * min(sizes[1:])
    assert ("is the rotor blocked?" in reading.stats.unended) == (name != "cspc-m1c1-mini")
    assert f"within {longest:g} s" in reading.stats.unended


def test_ten_minutes_of_a_blocked_rotor_keep_no_more_than_one_scan() -> None:
    reading, number = Reading("velodyne-vlp16"), 4096
    frames = simulation(reading.sensor, "data", blocked=True).block(0, number, Room()).frames
    rows = np.frombuffer(b"".join(frames), np.uint8).reshape(number, -1)
    starts, sizes, kept = np.arange(number) * rows.shape[1], np.full(number, rows.shape[1]), list[int]()
    tracemalloc.start()
    for first in range(0, 600 * 10**9 // PACKET_NS, number):
        stamped = rows.copy()
        stamped[:, 1200:1204] = ((np.arange(first, first + number) * PACKET_NS // 1000).astype("<u4")).view(np.uint8).reshape(-1, 4)
        found = reading.decoder.placed(stamped.reshape(-1), starts, sizes, np.ones(number, np.int64))
        assert len(reading.scans_of(found)) in (13, 14)
        kept.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert max(kept[5:]) < 1.2 * min(kept[5:])


def test_what_a_spinning_up_rotor_left_open_is_not_complained_of_once_it_turns() -> None:
    reading = Reading("ldrobot-ld06")
    still = simulation(reading.sensor, "data", blocked=True).block(0, 375, Room()).frames
    assert [scan.complete for scan in reading.scans(still)] == [False, False]
    assert "is the rotor blocked?" in reading.stats.unended
    turning = reading.scans(simulate(reading.sensor, 375, start=375))
    assert [scan.complete for scan in turning[-5:]] == [True] * 5
    assert not reading.stats.unended


def test_scans_go_on_after_a_pause_and_no_rotor_is_blamed_for_it() -> None:
    reading = Reading("velodyne-vlp16")
    frames = simulate(reading.sensor, 2000)
    scans = reading.scans(frames[:200] + frames[1800:])
    assert not reading.stats.unended
    assert max(np.ptp(scan.points.time) for scan in scans) < 0.2


def test_scans_of_data_without_an_end_are_warned_of() -> None:
    sensor = ls.sensor("ldrobot-ld06")
    frames = simulation(sensor, "data", blocked=True).block(0, 1000, Room()).frames
    with pytest.warns(UserWarning, match=r"ldrobot-ld06: the angle does not pass 0 \(azimuth\): is the rotor blocked\?"):
        assert len(list(sensor.scans(b"".join(frames)))) == 7
