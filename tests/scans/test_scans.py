"""Tests of the borders of scans, and of warnings about scans without an end."""

from __future__ import annotations

import functools
import itertools
import random
import tracemalloc
from collections.abc import Collection

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import Scan, simulate
from lidarspec.framing.results import Frames
from lidarspec.packets.stream import PacketStream
from lidarspec.scans.stream import ScanStream
from lidarspec.simulation.scenes import Room
from lidarspec.simulation.simulator import frame_simulation, make_opening_frame
from tests.shapes import SHAPES

#: a rotor that is blocked, or the start of a scan that does not come: seconds of the longest scan,
#: twice the slowest turn.
BLOCKED = {
    "ldrobot-ld06": 0.4,
    "velodyne-vlp16": 0.4,
    "slamtec-rplidar-a1": 2.0,
    "cspc-m1c1-mini": 1.0,
}
#: one sensor for each way to cut scans: where an angle wraps, in a stream and in datagrams, and
#: where a counter starts again.
CUT_BY = ("ldrobot-ld06", "velodyne-vlp16", "robosense-m1")
#: sensors whose scans are cut in one of these ways.
RELATED = ("velodyne-hdl32e", "hesai-pandar40p", "robosense-helios16p")
#: from one packet of a VLP-16 to the next.
PACKET_NS = 1_327_104


class Reading:
    """A decoder and the scans of its frames, read piece by piece."""

    def __init__(self, name: str) -> None:
        self.sensor = ls.sensor(name)
        decoder = self.sensor.decoder()
        self.decoder, self.stats = decoder, decoder.stats
        self._packets, self._scans = (
            PacketStream(self.sensor, self.sensor.data_frame, decoder.stats),
            ScanStream(self.sensor),
        )
        if decoder.stream:
            decoder.frames(make_opening_frame(self.sensor))

    def scans(self, frames: list[bytes]) -> list[Scan]:
        """Return the scans that some more frames complete."""
        decoder = self.decoder
        return self.scans_of(
            *(
                decoder.frames(b"".join(frames))
                if decoder.stream
                else [decoder.datagrams(frames, [1] * len(frames))]
            )
        )

    def scans_of(self, *found: Frames) -> list[Scan]:
        """Return the scans that frames of the decoder complete."""
        return self._scans.add(self._packets.add(found))


#: The sensor whose blocked rotor is simulated in the quick tier.
QUICK = "ldrobot-ld06"


@pytest.mark.parametrize(
    "name",
    [name if name == QUICK else pytest.param(name, marks=pytest.mark.slow) for name in BLOCKED],
)
def test_a_scan_ends_though_the_rotor_is_blocked(name: str) -> None:
    reading = Reading(name)
    blocked = frame_simulation(reading.sensor, reading.sensor.data_frame, blocked=True)
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


@pytest.mark.slow
def test_ten_minutes_of_a_blocked_rotor_keep_no_more_than_one_scan() -> None:
    reading, number = Reading("velodyne-vlp16"), 4096
    frames = frame_simulation(reading.sensor, "data", blocked=True).block(0, number, Room()).frames
    rows = np.frombuffer(b"".join(frames), np.uint8).reshape(number, -1)
    starts, sizes, kept = (
        np.arange(number) * rows.shape[1],
        np.full(number, rows.shape[1]),
        list[int](),
    )
    tracemalloc.start()
    for first in range(0, 600 * 10**9 // PACKET_NS, number):
        stamped = rows.copy()
        stamped[:, 1200:1204] = (
            ((np.arange(first, first + number) * PACKET_NS // 1000).astype("<u4"))
            .view(np.uint8)
            .reshape(-1, 4)
        )
        found = reading.decoder.decode_placed(
            stamped.reshape(-1), starts, sizes, np.ones(number, np.int64)
        )
        assert len(reading.scans_of(found)) in (13, 14)
        kept.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert max(kept[5:]) < 1.2 * min(kept[5:])


def test_no_warning_about_a_spinning_up_rotor_once_it_turns() -> None:
    reading = Reading("ldrobot-ld06")
    still = frame_simulation(reading.sensor, "data", blocked=True).block(0, 375, Room()).frames
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
    frames = frame_simulation(sensor, "data", blocked=True).block(0, 1000, Room()).frames
    with pytest.warns(
        UserWarning,
        match=r"ldrobot-ld06: the angle 'azimuth' did not pass 0 within .*: is the rotor blocked\?",
    ):
        assert len(list(sensor.scans(b"".join(frames)))) == 7


@functools.cache
def simulate_packets(name: str, number: int) -> list[bytes]:
    return simulate(ls.sensor(name), number)


def scans_without(name: str, lost: Collection[int], number: int = 4000) -> list[Scan]:
    """Return the scans of simulated frames without some of them."""
    sensor = ls.sensor(name)
    frames = [
        frame for place, frame in enumerate(simulate_packets(name, number)) if place not in lost
    ]
    return list(
        sensor.scans(
            frames if sensor.datagrams else b"".join([make_opening_frame(sensor), *frames])
        )
    )


@pytest.mark.parametrize(
    "name", [*CUT_BY, *(pytest.param(name, marks=pytest.mark.slow) for name in RELATED)]
)
def test_a_scan_is_complete_exactly_if_nothing_is_missing(name: str) -> None:
    sound = scans_without(name, ())
    assert [scan.complete for scan in sound] == [False, *[True] * (len(sound) - 2), False]
    sizes, per_packet = np.cumsum([len(scan) for scan in sound]), sum(map(len, sound)) / 4000
    middle = round((sizes[1] + sizes[2]) / 2 / per_packet)
    turn = round(len(sound[2]) / per_packet)
    for lost in (1, turn // 3, turn // 2 - 5):
        scans = scans_without(
            name,
            (
                range(middle, middle + lost)
                if lost < turn // 3 + 1
                else range(middle - lost // 2, middle + lost // 2)
            ),
        )
        assert len(scans) == len(sound)
        assert [scan.complete for scan in scans] == [
            False,
            True,
            False,
            *[True] * (len(sound) - 4),
            False,
        ], lost
        assert scans[2].whole
        assert np.isfinite(scans[2].rate_hz)


@pytest.mark.parametrize("name", CUT_BY)
@pytest.mark.parametrize(
    "turns",
    [
        0.6,
        1.0,
        2.0,
        *(pytest.param(turns, marks=pytest.mark.slow) for turns in (0.9, 1.1, 1.7, 3.4)),
    ],
)
@pytest.mark.parametrize("after", [0.0, 0.9, pytest.param(0.3, marks=pytest.mark.slow)])
def test_two_turns_are_never_one_scan(name: str, turns: float, after: float) -> None:
    sound = scans_without(name, ())
    turn = round(len(sound[2]) * 4000 / sum(map(len, sound)))
    first = round((len(sound[0]) + len(sound[1])) * 4000 / sum(map(len, sound))) + round(
        after * turn
    )
    scans = scans_without(name, range(first, first + round(turns * turn)))
    for scan in scans:
        assert len(scan) <= len(sound[2]) * 1.02
        assert np.ptp(scan.points.time) <= 1.2 * np.ptp(sound[2].points.time)
        assert not scan.complete or len(scan) >= len(sound[2]) * 0.98
    assert sum(scan.complete for scan in scans) >= len(sound) - 2 - turns - 3


def test_a_frame_with_its_first_packet_is_complete_though_the_one_before_has_no_end() -> None:
    scans = scans_without("robosense-m1", range(1250, 1260))
    assert [(len(scan) // 125, scan.complete) for scan in scans] == [
        (630, False),
        (620, False),
        *[(630, True)] * 4,
        (220, False),
    ]


def scans_of_pieces(name: str, frames: list[bytes], size: int) -> list[Scan]:
    """Return the scans of a shape's frames, with packets in batches of a size."""
    sensor = SHAPES[name]
    packets, stream = (
        sensor.decode(frames if sensor.datagrams else b"".join(frames)),
        ScanStream(sensor),
    )
    pieces = [packets.take(slice(start, start + size)) for start in range(0, len(packets), size)]
    return [scan for piece in pieces for scan in stream.add(piece)] + stream.finish()


@functools.cache
def segments() -> list[bytes]:
    return simulate(SHAPES["shape-segments"], 100)


@pytest.mark.parametrize("size", [7, 100, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("lost", "whole", "complete"),
    [(0, True, True), (3, True, False), (10, True, False), (11, False, False)],
)
def test_a_frame_of_parts_counts_once(lost: int, whole: bool, complete: bool, size: int) -> None:
    """A turn has 20 frames of 30 parts each.

    A turn is whole if at most half of its frames are missing.
    """
    frames = [frame for place, frame in enumerate(segments()) if not 24 <= place < 24 + lost]
    assert SHAPES["shape-segments"].decode(frames).stats.lost == lost
    scans = scans_of_pieces("shape-segments", frames, size)
    ends = (False, False)
    assert [(scan.whole, scan.complete) for scan in scans] == [
        ends,
        (whole, complete),
        (True, True),
        (True, True),
        ends,
    ]


def test_a_frame_that_two_scans_share_counts_in_both() -> None:
    sensor, segment = (
        SHAPES["shape-segments"],
        dict(channels=1, beams=1, start=0, elevations=[4], data=[[dict(distance=1, strength=2)]]),
    )
    turns = [
        [{**segment, "turn": turn, "time": turn * 1000} for turn in (number, number + 1)]
        for number in range(6)
    ]
    frames = [
        sensor.build("data", counter=number, step=15, segments=parts)
        for number, parts in enumerate(turns)
        if number != 3
    ]
    scans = scans_of_pieces("shape-segments", frames, 100)
    assert [(scan.whole, scan.complete) for scan in scans[1:4]] == [
        (True, True),
        (True, True),
        (True, False),
    ]


@pytest.mark.parametrize("size", [1, 100])
def test_a_frame_without_parts_that_have_points_leaves_no_gap(size: int) -> None:
    sensor = SHAPES["shape-tags"]
    empty = sensor.build("data", number=0, tags=[dict(type=2, temperature=30)], padding=bytes(5))
    frames = [
        frame for pair in zip(simulate(sensor, 16), [empty] * 16, strict=True) for frame in pair
    ]
    assert [scan.complete for scan in scans_of_pieces("shape-tags", frames, size)] == [
        False,
        True,
        True,
        False,
    ]
    cut_off = [*frames[:11], frames[10][:9], *frames[11:]]
    assert [scan.complete for scan in scans_of_pieces("shape-tags", cut_off, size)] == [
        False,
        False,
        True,
        False,
    ]


@pytest.mark.parametrize(
    "kind", ["node", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("express", "hq"))]
)
def test_false_and_missing_nodes_make_a_scan_incomplete(kind: str) -> None:
    sensor = ls.sensor("slamtec-rplidar-a1").configure(answer=kind)
    sound, draw = (
        make_opening_frame(sensor) + b"".join(simulate(sensor, 3000 if kind == "node" else 300)),
        random.Random(5),
    )
    whole = {len(scan) for scan in sensor.scans(sound) if scan.complete}
    for _ in range(8):
        data, place = bytearray(sound), draw.randrange(len(sound) // 3, len(sound) // 2)
        if draw.random() < 0.5:
            del data[place]
        else:
            data.insert(place, draw.randrange(256))
        scans = list(sensor.scans(bytes(data)))
        assert all(len(scan) in whole for scan in scans if scan.complete)
        assert len([scan for scan in scans[1:-1] if not scan.complete]) in (1, 2, 3)


def test_a_foreign_datagram_does_not_make_a_scan_incomplete() -> None:
    sensor = ls.sensor("velodyne-vlp16")
    frames = simulate(sensor, 400)
    assert [scan.complete for scan in sensor.scans([*frames[:150], b"noise", *frames[150:]])] == [
        scan.complete for scan in sensor.scans(frames)
    ]


@pytest.mark.parametrize("name", [*CUT_BY, "cspc-m1c1-mini"])
def test_pieces_do_not_change_losses(name: str) -> None:
    sensor, draw = ls.sensor(name), random.Random(2)
    frames = simulate(sensor, 2500)
    for place in (300, 900, 1200):
        del frames[place : place + draw.randrange(150)]
    found = []
    for size in (len(frames), 400, 37):
        reading = Reading(name)
        found.append(
            [
                (len(scan), scan.whole, scan.complete)
                for at in range(0, len(frames), size)
                for scan in reading.scans(frames[at : at + size])
            ]
        )
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize("size", [1, 7, 200])
def test_scans_end_where_an_angle_jumps_and_not_where_it_passes_0(size: int) -> None:
    """Each face of the mirror gives a scan of 20 rows, in one or several packets.

    The sector of the second face contains 0.
    """
    sensor = SHAPES["shape-mirror"]
    scans = scans_of_pieces("shape-mirror", simulate(sensor, 200), size)
    assert [len(scan) for scan in scans] == [40] * 30
    assert {scan.complete for scan in scans[1:-1]} == {True}
    assert np.ptp(np.rad2deg(scans[1].points.azimuth.astype(np.float64))) == pytest.approx(
        2 * 28.5 + 0.4, abs=1e-3
    )


@pytest.mark.parametrize(
    ("name", "falls"),
    [("ldrobot-stl27l", True), ("velodyne-vlp16", True), ("hokuyo-utm30lx", False)],
)
def test_a_laserscan_has_the_requested_beams_and_direction(name: str, falls: bool) -> None:
    sensor = ls.sensor(name)
    for scan in list(sensor.scans(simulate(sensor, 400)))[:4]:
        for beams in (450, 7):
            planar = scan.to_laserscan(beams=beams)
            assert len(planar.ranges) == len(planar.intensities) == beams
            assert planar.angle_max == pytest.approx(
                planar.angle_min + (beams - 1) * planar.angle_increment
            )
            assert (planar.time_increment < 0) == falls
            # Its clock counts in ms.
            assert abs(planar.time_increment) * beams == pytest.approx(planar.scan_time, rel=1e-3)
        assert len(scan.to_laserscan().ranges) == (sensor.beams or len(scan))


def test_a_scan_says_when_the_packet_of_its_first_point_arrived() -> None:
    """The time does not depend on the pieces; it is 0 if it is unknown."""
    reading = Reading("velodyne-vlp16")
    frames = simulate(reading.sensor, 400)
    arrivals = 10**18 + np.arange(len(frames)) * PACKET_NS
    decoder, scans = reading.decoder, list[Scan]()
    for start in range(0, len(frames), 37):
        part = slice(start, start + 37)
        scans += reading.scans_of(decoder.datagrams(frames[part], arrivals[part].tolist()))
    assert len(scans) > 3
    assert scans[0].host_ns == arrivals[0]
    for before, after in itertools.pairwise(scans):
        assert after.host_ns in arrivals
        assert (
            abs((after.host_ns - before.host_ns) - (after.stamp_ns - before.stamp_ns)) <= PACKET_NS
        )
        assert after.to_laserscan().host_ns == after.host_ns
    assert {scan.host_ns for scan in reading.sensor.scans(frames)} == {0}
