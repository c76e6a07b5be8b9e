"""Tests of Velodyne captures, compared with the results of other decoders."""

from __future__ import annotations

import functools
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lidarspec as ls
from lidarspec.captures.pcap import CaptureReader
from tests.evidence import capture, decode

pytestmark = pytest.mark.slow  # captures of many megabytes

VLP16, HDL32E = ls.sensor("velodyne-vlp16"), ls.sensor("velodyne-hdl32e")
DUAL = "velodyne/vlp16_dual/packets.derived.pcap"
OLD = "velodyne/vlp16_old_firmware/vlp-16-test-90deg-1-50-frames.pcap"
HDL = "velodyne/hdl32e/sample_velodyne_hdl32.pcap"
RAW = "velodyne/vlp16_raw/recording.bin"

# The fields x y z intensity return_type channel azimuth elevation distance time.
PCD = np.dtype("f4, f4, f4, u1, u1, u2, f4, f4, f4, u4")


@functools.cache
def _payloads(path: Path) -> tuple[bytes, ...]:
    with path.open("rb") as file:
        return tuple(datagram.data for datagram in CaptureReader(file))


def payloads(name: str) -> tuple[bytes, ...]:
    """Return the datagrams of a capture; skip the test if it is missing."""
    return _payloads(capture(name))


@pytest.mark.parametrize(("sensor", "name"), [(VLP16, DUAL), (VLP16, OLD), (HDL32E, HDL)])
def test_compiled_and_interpreted_agree_on_real_packets(sensor: ls.Sensor, name: str) -> None:
    data = payloads(name)[:8]
    assert decode(sensor, data).stats.bytes_skipped == 0
    if name == OLD:
        assert len(decode(sensor, data, "position")) > 0


def test_old_firmware_pieces() -> None:
    data = payloads(OLD)
    packets = VLP16.decode(data)
    assert packets.stats.frames == {"data": 1902, "position": 367}
    assert (packets.stats.bytes_skipped, packets.stats.implausible) == (0, 0)
    assert packets.raw["blocks"]["azimuth"].max() == 36000
    assert set(packets.raw["product"].tolist()) == {0x21}
    scans = list(VLP16.scans(data))
    assert len(scans) == 52
    valid = [int(scan.points.valid.sum()) for scan in scans]
    assert [valid[piece] for piece in (0, 2, 16, 51)] == [5736, 13898, 13860, 274]
    assert [scan.complete for scan in scans] == [False, *[True] * 50, False]


def test_old_firmware_published_points() -> None:
    scans = list(VLP16.configure(frame="vendor").scans(payloads(OLD)))
    cloud = scans[16].points
    cloud = cloud[cloud.valid]
    assert cloud.ring is not None
    assert cloud.intensity is not None
    for index, ring, intensity, xyz in [
        (0, 0, 4, (0.0801272, 6.04037, -1.61865)),
        (13859, 15, 29, (-0.0094354, 4.91462, 1.31687)),
    ]:
        np.testing.assert_allclose(cloud.xyz[index, :2], xyz[:2], atol=1e-5)
        # The published values omit the vertical offset of the laser.
        offset = 0.04191 * np.tan(np.deg2rad(15)) * (1 if ring == 0 else -1)
        assert cloud.xyz[index, 2] - offset == pytest.approx(xyz[2], abs=1e-5)
        assert (cloud.ring[index], cloud.intensity[index]) == (ring, intensity)


def test_position_packets_of_a_sensor_without_gps() -> None:
    data = [datagram for datagram in payloads(OLD) if len(datagram) == 512]
    packets = decode(VLP16, data[:20], "position")
    assert VLP16.build("position", VLP16.parse(data[0])) == data[0]
    assert not packets.raw["pps"].any()
    assert not packets.raw["nmea"].any()
    times = VLP16.decode(payloads(OLD), "position")["timestamp"]
    span = VLP16.decode(payloads(OLD))["timestamp"]
    assert (np.diff(times) > 0).all()
    assert abs(times[0] - span[0]) < 0.02
    assert abs(times[-1] - span[-1]) < 0.02


def test_hdl32e_pieces() -> None:
    scans = list(HDL32E.scans(payloads(HDL)))
    assert [scan.complete for scan in scans] == [False, True, True, False]
    assert [scan.rate_hz for scan in scans[1:3]] == [pytest.approx(9.04, abs=0.02)] * 2
    assert sum(map(len, scans)) == 500 * 12 * 32


def test_dual_return_pieces() -> None:
    scans = list(VLP16.scans(payloads(DUAL)))
    assert [scan.complete for scan in scans] == [False, True, True, True, False]
    assert [scan.rate_hz for scan in scans[1:4]] == [pytest.approx(10, abs=0.02)] * 3
    # No scan is cut between the two blocks of a firing.
    assert all(len(scan) % 64 == 0 for scan in scans)


def test_recording_without_any_header_is_a_stream() -> None:
    data = capture(RAW).read_bytes()
    packets = VLP16.decode(data)
    assert (len(packets), packets.stats.bytes_skipped, packets.stats.frames) == (
        1000,
        0,
        {"data": 1000},
    )
    assert (
        VLP16.parse(capture("velodyne/vlp16_raw/packet.bin").read_bytes()).timestamp == 0x9EEA6B9B
    )


@pytest.mark.parametrize("start", range(1, 1206, 173))
def test_a_stream_that_begins_within_a_packet(start: int) -> None:
    packets = VLP16.decode(capture(RAW).read_bytes()[start : start + 20 * 1206])
    assert packets.stats.frames == {"data": 19}
    assert packets.stats.bytes_skipped == 1206


def test_a_lost_packet_moves_no_point_of_the_others() -> None:
    data = list(payloads(HDL)[:40])
    whole = HDL32E.decode(data).points()
    less = HDL32E.decode(data[:20] + data[21:]).points()
    kept = np.delete(np.arange(len(whole)), np.arange(20 * 384, 21 * 384))
    before = slice(19 * 384 + 11 * 32, 20 * 384)  # the block before the gap uses the step before it
    moved = np.nan_to_num(np.abs(whole.azimuth[kept] - less.azimuth))
    assert np.rad2deg(moved[before].max()) < 0.04
    moved[before] = 0
    assert not moved.any()


def read_published_points() -> NDArray[Any]:
    """Return the points that nebula published for one scan of the dual return capture."""
    _, _, body = (
        capture("velodyne/vlp16_dual/1673400472138016708.pcd")
        .read_bytes()
        .partition(b"DATA binary\n")
    )
    return np.frombuffer(body, PCD)


def test_dual_return_against_the_published_cloud() -> None:
    expected = read_published_points()
    assert len(expected) == 14831
    cloud = VLP16.decode(payloads(DUAL)).points()
    assert cloud.ring is not None
    xyz_of = cloud.xyz
    places = defaultdict(list)
    for index in np.flatnonzero(cloud.valid).tolist():
        firing = index // 64 % 6 * 2 + index // 16 % 2
        places[firing, int(cloud.ring[index]), round(float(cloud.range[index]) / 0.002)].append(
            index
        )
    apart, pair = np.empty((len(expected), 3)), np.empty(len(expected))
    for row, (*xyz, _, _, ring, _, _, distance, time) in enumerate(expected.tolist()):
        round_of_lasers = time // 55_296  # published times count blocks, not pairs of blocks
        firing = round_of_lasers // 4 * 2 + round_of_lasers % 2
        differences = np.abs(xyz_of[places[firing, ring, round(distance / 0.002)]] - xyz)
        apart[row], pair[row] = (
            differences[np.linalg.norm(differences, axis=1).argmin()],
            firing // 2,
        )
    assert np.median(np.linalg.norm(apart, axis=1)) < 0.010
    assert apart[:, 2].max() < 0.0115  # published without the vertical offsets of the lasers
    # in the published cloud the last pair of a packet does not turn, and echoes that only the
    # second block of a pair has are a pair ahead
    level = np.hypot(apart[:, 0], apart[:, 1])
    assert np.quantile(level[pair < 5], 0.99) < 0.005


def other_decoder(data: bytes, name: str) -> NDArray[Any]:
    """Return the points of one packet as velodyne-decoder decodes them.

    The columns are x, y, z, time and ring. Duplicates of dual return are merged.
    """
    peer = pytest.importorskip(
        "velodyne_decoder", reason="velodyne-decoder, a peer to compare with, is not installed"
    )
    config = peer.Config(model=getattr(peer.Model, name), min_range=0, max_range=1000)
    found = peer.ScanDecoder(config).decode(
        peer.PacketVector([peer.VelodynePacket(0.0, data)]), as_pcl_structs=True
    )
    return np.asarray(found[1])


@pytest.mark.parametrize(
    ("sensor", "model", "name", "product"),
    [(VLP16, "VLP16", DUAL, 0x22), (VLP16, "VLP16", OLD, 0x22), (HDL32E, "HDL32E", HDL, 0x21)],
)
def test_agreement_with_velodyne_decoder(
    sensor: ls.Sensor, model: str, name: str, product: int
) -> None:
    data = [datagram for datagram in payloads(name) if len(datagram) == 1206]
    cloud = sensor.decode(data).points()
    assert cloud.ring is not None
    each = 2 if name == DUAL else 1
    shape = (len(data), 12 // each, each, 32)
    xyz, ring, time = (
        cloud.xyz.reshape(*shape, 3),
        cloud.ring.reshape(shape),
        cloud.time.reshape(shape),
    )
    distances = []
    for number, datagram in enumerate(data):
        theirs = other_decoder(datagram[:1205] + bytes([product]), model)
        firing = (time[number, :, 0] - time[number, 0, 0, 0]).reshape(-1)
        turn, slot = np.divmod(np.abs(firing - theirs["time"][:, None]).argmin(axis=1), 32)
        assert np.abs(firing[32 * turn + slot] - theirs["time"]).max() < 2e-8
        assert (ring[number, turn, 0, slot] == theirs["ring"]).all()
        apart = (
            xyz[number, turn, :, slot] - np.stack([theirs[axis] for axis in "xyz"], axis=1)[:, None]
        )
        distances.append(np.nanmin(np.linalg.norm(apart, axis=2), axis=1))
    found = np.concatenate(distances)
    assert len(found) == (59414 if name == DUAL else cloud.valid.sum())
    assert (found < 0.005).mean() > 0.99
    assert np.median(found) < 0.001
