"""Tests of TI IWR6843: points with velocities, empty frames and other radars."""

from __future__ import annotations

import struct

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.detect.identification import identify_sample
from lidarspec.detect.sample_bytes import SampleBytes
from tests.evidence import decode

RADAR = ls.sensor("ti-iwr6843")
AHEAD, ASIDE = (
    (0.5, 4.0, 0.25, -1.0),
    (-2.0, 1.0, -0.5, 0.75),
)  # x to the right, y ahead, z up, velocity


def points(*those: tuple[float, ...]) -> tuple[int, bytes]:
    return 1, b"".join(struct.pack("<4f", *one) for one in those)


def frame(number: int, *parts: tuple[int, bytes], platform: int = 0xA6843) -> bytes:
    """Return a frame according to TI's header table, with padding that is not 0."""
    body = b"".join(struct.pack("<II", kind, len(content)) + content for kind, content in parts)
    size = -(-(40 + len(body)) // 32) * 32
    header = struct.pack(
        "<8I", 0x03050004, size, platform, number, number * 20_000_000 % 2**32, 0, len(parts), 0
    )
    return (bytes([2, 1, 4, 3, 6, 5, 8, 7]) + header + body).ljust(size, b"\x0f")


def test_points_are_turned_to_our_axes_and_have_velocities() -> None:
    side = (7, struct.pack("<4h", 180, 600, 95, 610))
    packets = decode(
        RADAR,
        frame(1, points(AHEAD, ASIDE), side)
        + frame(2)
        + frame(3, (99, b"what is this"), points(ASIDE)),
    )
    cloud = packets.points()
    assert cloud.xyz.tolist() == [[4.0, -0.5, 0.25], [1.0, 2.0, -0.5], [1.0, 2.0, -0.5]]
    assert cloud.extra["velocity"].tolist() == [-1.0, 0.75, 0.75]
    assert dict(cloud.units)["velocity"] == "m/s"
    assert packets.parts("tlvs.side_info")["points.snr"].tolist() == [[18.0, 9.5]]
    assert np.diff(packets.time_ns).tolist() == [100_000_000] * 2
    assert (packets.stats.lost, packets.stats.bytes_skipped) == (0, 0)


def test_its_cycles_start_again_and_a_lost_frame_is_counted() -> None:
    data = [frame(number, points(AHEAD)) for number in (213, 214, 215, 217)]
    packets = decode(RADAR, b"".join(data))
    assert packets.time_ns[-1] - packets.time_ns[0] == 400_000_000
    assert packets.stats.lost == 1


def test_a_frame_of_another_radar_is_not_its_own() -> None:
    assert RADAR.decode(frame(1, points(AHEAD), platform=0xA1843)).stats.frames == {}


def test_each_frame_is_a_scan_and_is_known_by_its_own() -> None:
    wire = b"".join(ls.simulate(RADAR, 12))
    scans = list(RADAR.scans(wire))
    assert [len(scan.points) for scan in scans] == [24] * 12
    assert [
        one.sensor.id
        for one in identify_sample(SampleBytes("a wire", (wire,), datagrams=False)).candidates
    ] == ["ti-iwr6843"]


@pytest.mark.slow
def test_it_sends_by_itself_on_a_serial_port() -> None:
    with ls.open("sim:iwr6843") as device:
        assert device.latest(timeout=30).points.valid.any()
    with pytest.raises(ls.UsageError):
        RADAR.command("start")
