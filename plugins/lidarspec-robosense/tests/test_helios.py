"""Tests of RoboSense RS-Helios-16P: vectors, calculated points, a real capture."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.captures.pcap import CaptureReader
from lidarspec.packets.stream import PacketStream
from tests.agreement import assert_same_points
from tests.evidence import assert_points, capture, clockwise, decode, vector_bytes, vectors

FILE = "vectors_udp3d.json"
SENSOR = ls.sensor("robosense-helios16p")
FOLDER = "robosense/helios16p"
DIFOP_AT = 543  # of 751 datagrams in the capture (captures/README.md)
SIZE = 1248
FIRING = 55.56e-6

TIMES, TEMPERATURES = {"rs_time_utc_us"}, {"rs_temp_le_8811", "rs_temp_le_8891"}
ANGLES = {"rs_cal_vert": 468, "rs_cal_horiz": 564}
OTHER_MODELS = {"rs_temp_be_2310", "rs_temp_be_a310"}  # the byte order of RS128 and Ruby

Channels = Mapping[tuple[int, int], tuple[int, int]]


def patch(data: bytes, offset: int, new: bytes | str) -> bytes:
    """Return the packet with `new` in place of its bytes from `offset` on."""
    new = bytes.fromhex(new) if isinstance(new, str) else new
    return data[:offset] + new + data[offset + len(new) :]


def msop(
    azimuths: Sequence[int],
    channels: Channels | None = None,
    *,
    count: int = 0,
    resolution: int = 1,
    time: float = 0.0,
) -> bytes:
    """Return an MSOP packet; the offsets are those of the manual's Table 9.

    Args:
        azimuths: raw values by block.
        channels: {(block, slot): (raw distance, intensity)}.
    """
    seconds = divmod(int(time), 1 << 32)
    header = struct.pack(
        ">4sH6xIxB2xHIIB11x",
        b"\x55\xaa\x05\x5a",
        1,
        count,
        resolution,
        *seconds,
        round(time % 1 * 1e6),
        7,
    )
    body = bytearray()
    for block, azimuth in enumerate(azimuths):
        body += b"\xff\xee" + struct.pack(">H", azimuth)
        for slot in range(32):
            body += struct.pack(">HB", *(channels or {}).get((block, slot), (0, 0)))
    return header + bytes(body) + b"\0\0\0\0\0\xff"


def difop(angles: Mapping[int, str] | None = None, *, mode: int = 4, rpm: int = 600) -> bytes:
    """Return a DIFOP packet.

    Args:
        angles: {offset: the three bytes of an angle in hexadecimal}; all other angles are 0.
        mode: the return mode.
        rpm: the rotation speed.
    """
    data = bytes.fromhex("a5ff005a11115555") + bytes(SIZE - 10) + b"\x0f\xf0"
    data = patch(patch(data, 8, struct.pack(">H", rpm)), 300, bytes([mode]))
    for offset, text in (angles or {}).items():
        data = patch(data, offset, text)
    return data


def steady(first: int, step: int) -> list[int]:
    """Return twelve raw azimuths at equal steps."""
    return [(first + step * block) % 36000 for block in range(12)]


def at(block: int, slot: int) -> int:
    """Return the index of a point in the cloud of one packet."""
    return 32 * block + slot


def datagrams() -> list[bytes]:
    """Return the payloads of the capture."""
    with open(capture(f"{FOLDER}/packets.derived.pcap"), "rb") as file:
        return [datagram.data for datagram in CaptureReader(file)]


def test_every_vector_of_the_model_is_used() -> None:
    known = {
        name
        for name, vector in vectors(FILE).items()
        if name.startswith("rs_")
        and any(word in vector["sensor"] for word in ("Helios", "mechanical"))
    }
    assert known == TIMES | TEMPERATURES | ANGLES.keys() | OTHER_MODELS


def test_time() -> None:
    parsed = SENSOR.parse(patch(msop(steady(0, 40)), 20, vector_bytes(FILE, "rs_time_utc_us")))
    expected = vectors(FILE)["rs_time_utc_us"]["expected"]
    assert (parsed.seconds, parsed.microseconds) == (expected["seconds"], expected["sub"])
    packets = decode(SENSOR, [msop(steady(0, 40), time=1_700_000_000.25)])
    assert packets.time_ns.tolist() == [1_700_000_000_250_000_000]


@pytest.mark.parametrize("name", sorted(TEMPERATURES))
def test_temperature(name: str) -> None:
    packets = decode(SENSOR, [patch(msop(steady(0, 40)), 38, vector_bytes(FILE, name))])
    sign = 1 - 2 * packets["temperature.negative"][0]
    assert sign * packets["temperature.magnitude"][0] == vectors(FILE)[name]["expected"]["celsius"]


@pytest.mark.parametrize("name", ANGLES)
def test_calibration_angles(name: str) -> None:
    info = patch(difop(), ANGLES[name], vector_bytes(FILE, name))
    cloud = decode(SENSOR, [info, msop(steady(0, 40))]).points()
    plain = decode(SENSOR, [difop(), msop(steady(0, 40))]).points()
    # One of the two is 0; clockwise counts positive.
    turned = np.rad2deg(plain.azimuth - cloud.azimuth + cloud.elevation)
    expected = np.array(vectors(FILE)[name]["expected"]["values"]) / 100
    np.testing.assert_allclose(turned[:4], expected, atol=1e-4)
    np.testing.assert_allclose(turned[16:20], expected, atol=1e-4)


def test_points_by_hand() -> None:
    """The points lie in all quadrants.

    x = d cos V cos H + C cos R, y = -(d cos V sin H + C sin R), z = d sin V, H = R + calibration.
    The first point is the manual's: distance 0x0140 and azimuth 0x88db of Figure 14, angles of
    appendix B.9 and B.10.
    """
    angles = {
        468: "0005d6",
        564: "010196",
        477: "00037a",
        573: "000166",
        513: "010321",
        609: "000165",
        504: "01018c",
        600: "01018c",
    }
    info = difop(angles)
    data = [
        msop(steady(0x88DB, 40), {(0, 0): (0x0140, 1)}, count=0),  # R 350.35, H 346.29
        # Laser 4 of the second firing: R 100.2340, H 103.8140.
        msop(steady(10_000, 40), {(0, 19): (4000, 2)}, count=50),
        # Laser 16 of the second firing: R 200.4402, H 204.0102.
        msop(steady(20_010, 38), {(0, 31): (12_345, 3)}, count=100),
        # Laser 13: R 20.1312, H 16.1712.
        msop(steady(2000, 40), {(0, 12): (65_535, 255)}, count=150),
    ]
    cloud = decode(SENSOR, [info, *data]).points()
    places = [at(12 * packet, slot) for packet, slot in enumerate((0, 19, 31, 12))]
    expected = [
        (0.78542, 0.18906, 0.20625),
        (-2.36518, -9.62826, 1.54710),
        (-27.94980, 12.44761, -4.30056),
        (157.01220, -45.53334, -11.31462),
    ]
    assert np.flatnonzero(cloud.valid).tolist() == places
    assert_points(cloud, zip(places, expected, strict=True))
    assert cloud.ring is not None
    assert cloud.intensity is not None
    assert cloud.return_index is not None
    assert cloud.ring[places].tolist() == [0, 3, 15, 12]
    assert cloud.intensity[places].tolist() == [1, 2, 3, 255]
    assert not cloud.return_index.any()
    assert cloud.shape == (4 * 24, 16)
    assert not cloud.nominal


def test_firing_times_of_single_return() -> None:
    cloud = decode(SENSOR, [difop(), msop(steady(0, 40))]).points()
    assert cloud.time[at(0, 15)] == pytest.approx(43.91e-6)
    assert cloud.time[at(1, 0)] == pytest.approx(2 * FIRING)
    assert cloud.time[at(11, 17)] == pytest.approx(23 * FIRING + 3.15e-6)
    assert bool((np.diff(cloud.time) > 0).all())


def test_dual_return_has_one_firing_a_block() -> None:
    """Laser 9 fires 26.53 us after the first laser; a block takes 55.56 us.

    The azimuth of laser 9 is therefore 0.2 * 26.53 / 55.56 degrees further.
    """
    channels = {(3, 8): (400, 5), (3, 24): (800, 6)}
    cloud = decode(SENSOR, [difop(mode=0), msop(steady(9000, 20), channels)]).points()
    first, second = at(3, 8), at(3, 24)
    assert cloud.return_index is not None
    assert cloud.return_index[[first, second]].tolist() == [0, 1]
    assert cloud.time[[first, second]].tolist() == pytest.approx([3 * FIRING + 26.53e-6] * 2)
    assert clockwise(cloud)[[first, second]].tolist() == pytest.approx(
        [90.6 + 0.2 * 26.53 / 55.56] * 2, abs=1e-4
    )
    assert cloud.range[[first, second]].tolist() == pytest.approx([1.0, 2.0])


def test_two_firings_share_the_step_to_the_following_block_also_over_a_packets_border() -> None:
    cloud = decode(
        SENSOR, [difop(), msop(steady(35_600, 40), count=7), msop(steady(80, 36), count=8)]
    ).points()
    turned = clockwise(cloud)
    assert turned[at(10, 16)] == pytest.approx(0.2, abs=1e-4)  # 0.00 to 0.40
    # From 0.40 to 0.80 degrees; the second angle is in the next packet.
    assert turned[at(11, 16)] == pytest.approx(0.6, abs=1e-4)
    assert turned[at(12, 16)] == pytest.approx(0.98, abs=1e-4)  # 0.80 to 1.16
    # No packet follows, so the step is that of the previous block.
    assert turned[at(23, 16)] == pytest.approx(0.8 + 11 * 0.36 + 0.18, abs=1e-4)


def test_a_lost_packet_and_a_gap_in_the_field_of_view_keep_the_step_before() -> None:
    azimuths = [*steady(8000, 30)[:6], *steady(24_000, 30)[:6]]
    cloud = decode(
        SENSOR, [difop(), msop(azimuths, count=1), msop(steady(24_220, 10), count=3)]
    ).points()
    turned = clockwise(cloud)
    assert turned[at(5, 16)] == pytest.approx(81.5 + 0.15, abs=1e-4)
    # Packet 2 is missing: 242.20 is not the next block.
    assert turned[at(11, 16)] == pytest.approx(241.5 + 0.15, abs=1e-4)
    assert turned[at(12, 16)] == pytest.approx(242.2 + 0.05, abs=1e-4)


@pytest.mark.parametrize(("rpm", "step"), [(600, 0.4), (1200, 0.8)])
def test_without_any_neighbour_the_step_is_that_of_the_speed(rpm: int, step: float) -> None:
    azimuths = [*steady(0, 3000)]
    turned = clockwise(decode(SENSOR, [difop(rpm=rpm), msop(azimuths)]).points())
    np.testing.assert_allclose(turned[16::32], np.array(azimuths) / 100 + step / 2, atol=1e-3)


def test_the_header_says_how_long_a_step_of_distance_is() -> None:
    channels = {(0, 0): (400, 1)}
    fine, coarse = (
        decode(SENSOR, [msop(steady(0, 40), channels, resolution=step)]).points() for step in (1, 0)
    )
    assert (fine.range[0], coarse.range[0]) == (1.0, 2.0)


def test_lasers_without_calibration_have_no_points() -> None:
    channels = {(0, 0): (400, 1), (0, 1): (400, 1), (0, 2): (400, 1)}
    cloud = decode(
        SENSOR, [difop({468: "ffffff", 567: "ffffff"}), msop(steady(0, 40), channels)]
    ).points()
    assert cloud.valid[:3].tolist() == [False, False, True]


def test_packets_before_the_device_information_are_nominal() -> None:
    """The angles of a DIFOP packet are not used for packets that arrive before it."""
    data = datagrams()
    decoder = SENSOR.decoder()
    stream = PacketStream(SENSOR, "data", decoder.stats)
    parts = [data[:500], data[500:600], data[600:]]
    before, across, after = (
        stream.add([spans for datagram in part for spans in decoder.frames(datagram)]).points()
        for part in parts
    )
    nominal, known = 15 - 2 * np.arange(3), [14.94, 13.03, 10.92]
    assert [bool(cloud.nominal) for cloud in (before, across, after)] == [True, True, False]
    border = (DIFOP_AT - 500) * at(12, 0)
    for cloud, first, expected in (
        (before, 0, nominal),
        (across, border - 32, nominal),
        (across, border, known),
        (after, 0, known),
    ):
        np.testing.assert_allclose(
            np.rad2deg(cloud.elevation[first : first + 3]), expected, atol=1e-4
        )


def test_a_file_is_read_with_the_first_device_information_from_its_start() -> None:
    data = datagrams()
    packets = SENSOR.decode(data)
    cloud = packets.points()
    assert not cloud.nominal
    assert packets.stats.frames == {"data": 750, "difop": 1}
    assert (packets.stats.bytes_skipped, packets.stats.lost, packets.stats.duplicates) == (0, 0, 0)
    given = np.loadtxt(
        capture(f"{FOLDER}/RobosenseHelios16P.csv"),
        delimiter=",",
        converters=lambda text: float(text.strip()),
    )
    np.testing.assert_allclose(np.rad2deg(cloud.elevation[:16]), given[:, 0], atol=1e-4)
    with ls.open(capture(f"{FOLDER}/packets.derived.pcap"), SENSOR) as device:
        scans = list(device.scans())
    assert [scan.complete for scan in scans] == [False, True, True, True, True, False]
    assert [round(scan.rate_hz, 1) for scan in scans if scan.complete] == [10.0] * 4
    assert_same_points(scans[2].points, list(SENSOR.scans(data))[2].points)


@pytest.mark.slow
def test_the_capture_is_the_same_on_both_paths_and_built_again() -> None:
    data = datagrams()
    some = [*data[:12], data[DIFOP_AT], *data[730:]]
    decode(SENSOR, some)
    decode(SENSOR, some, "difop")
    for datagram in some:
        assert (
            SENSOR.build("difop" if datagram[0] == 0xA5 else "data", SENSOR.parse(datagram))
            == datagram
        )


def test_packets_taken_out_are_lost_and_late_ones_come_in_their_place() -> None:
    data = datagrams()
    assert SENSOR.decode([*data[:100], *data[105:]]).stats.lost == 5
    mixed = [*data[:300], data[301], data[300], data[301], *data[302:]]
    scans, whole = (list(SENSOR.scans(source)) for source in (mixed, data))
    assert len(scans) == len(whole) == 6
    for one, other in zip(scans, whole, strict=True):
        assert_same_points(one.points, other.points)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(4))
def test_published_point_clouds(number: int) -> None:
    """The clouds were published by nebula.

    Nebula truncates azimuths to 0.01 degrees, and computes the step of each packet's last block
    from the rotation rate.
    """
    scan = list(SENSOR.scans(datagrams()))[number].points
    published = np.loadtxt(sorted(capture(FOLDER).glob("*.pcd"))[number], skiprows=11)
    distance, degrees = _nearest(scan, published)
    assert len(published) > 15_000
    assert (distance < 0.01).mean() > 0.998
    assert np.median(distance) < 0.0001
    ahead = (degrees - published[:, 6] / 100 + 180) % 360 - 180
    assert ((ahead > -0.0002) & (ahead < 0.0102)).mean() > 0.97


def _nearest(scan: ls.PointCloud, published: Any) -> tuple[Any, Any]:
    """Return, for each published point, the distance and azimuth of our nearest point.

    Only points of the same laser are compared. Azimuths are clockwise in degrees.
    """
    distance, degrees = np.empty(len(published)), np.empty(len(published))
    for laser in range(16):
        ours = scan[scan.valid & (scan.ring == laser)]
        theirs = np.flatnonzero(published[:, 5] == 15 - laser)
        squares = ((published[theirs, None, :3] - ours.xyz[None].astype(np.float64)) ** 2).sum(
            axis=-1
        )
        best = squares.argmin(axis=1)
        distance[theirs] = np.sqrt(squares[np.arange(len(theirs)), best])
        degrees[theirs] = clockwise(ours)[best]
    return distance, degrees


@pytest.mark.slow
def test_a_packet_of_another_model_is_a_warning(tmp_path: Path) -> None:
    """Lidar type 6 is a Helios-5515; it is still decoded as a 16P."""
    path, frames = tmp_path / "other.bin", simulate(SENSOR, 100)
    path.write_bytes(
        b"".join(SENSOR.build("data", {**SENSOR.parse(frame), "lidar_type": 6}) for frame in frames)
    )
    with ls.open(path, SENSOR) as device:
        assert list(device.scans())
        told = (
            "decoded as robosense-helios16p, but the frames are those of robosense-helios5515"
            " (type 6, Helios-5515); next: lidarspec detect"
        )
        assert [told in warning for warning in device.warnings] == [True, False]
    path.write_bytes(b"".join(frames))
    with ls.open(path, SENSOR) as device:
        assert list(device.scans())
        assert not any("decoded as" in warning for warning in device.warnings)


@pytest.mark.parametrize("hertz", [4.95, 10, 20])  # 300 rpm less a tolerance, 600, 1200
@pytest.mark.parametrize("model", ["helios32", "helios5515"])
def test_scans_are_complete_at_each_speed_of_the_32(model: str, hertz: float) -> None:
    sensor = ls.sensor(f"robosense-{model}")
    data = []
    for i in range(round(3.5 / hertz / (12 * FIRING))):
        time = i * 12 * FIRING
        azimuths = (time + np.arange(12) * FIRING) * hertz * 36_000 % 36_000
        data.append(msop(azimuths.astype(int).tolist(), count=i, time=time))
    scans = list(sensor.scans(data))
    assert [scan.complete for scan in scans] == [False, True, True, False]
