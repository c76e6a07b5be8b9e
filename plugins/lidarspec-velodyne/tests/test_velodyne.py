"""Tests of Velodyne packets: calculated points, the last block and a real packet."""

from __future__ import annotations

import pickle
import re
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.errors import UnknownOption
from lidarspec.packets.clock_status import read_clock_status
from lidarspec.packets.stream import PacketStream
from tests.calibration_files import write_velodyne_xml
from tests.evidence import assert_points, clockwise, decode, vector_bytes, vectors

FILE = "vectors_udp3d.json"
VLP16, HDL32E, HI_RES = (
    ls.sensor("velodyne-vlp16"),
    ls.sensor("velodyne-hdl32e"),
    ls.sensor("velodyne-puck-hi-res"),
)
VLP32C, VLS128 = ls.sensor("velodyne-vlp32c"), ls.sensor("velodyne-vls128")
STRONGEST, DUAL = 0x37, 0x39

Cells = Mapping[tuple[int, int], tuple[int, int]]


ONE_BANK = [b"\xff\xee"] * 12
FOUR_BANKS = [b"\xff\xee", b"\xff\xdd", b"\xff\xcc", b"\xff\xbb"]


def packet(
    azimuths: Sequence[int],
    cells: Cells,
    *,
    time_us: int = 0,
    mode: int = STRONGEST,
    product: int = 0x22,
    flags: Sequence[bytes] = ONE_BANK,
) -> bytes:
    """Return a data packet.

    Args:
        azimuths: hundredths of a degree, by block.
        cells: {(block, slot): (distance in steps, intensity)}.
    """
    found = b""
    for block, (flag, azimuth) in enumerate(zip(flags, azimuths, strict=True)):
        found += struct.pack("<2sH", flag, azimuth)
        found += b"".join(
            struct.pack("<HB", *cells.get((block, slot), (0, 0))) for slot in range(32)
        )
    return found.ljust(1200, b"\0") + struct.pack("<IBB", time_us, mode, product)


def steps(start: int, step: int = 40, *, each: int = 1) -> list[int]:
    """Return the azimuths of twelve blocks in hundredths of a degree.

    Args:
        each: number of consecutive blocks with the same azimuth.
    """
    return [(start + step * (block // each)) % 36000 for block in range(12)]


def make_packet(
    start: int, step: int = 40, *, each: int = 1, mode: int = STRONGEST, time_us: int = 0
) -> bytes:
    """Return a packet in which every distance is 10 m."""
    cells = {(block, slot): (5000, 7) for block in range(12) for slot in range(32)}
    return packet(steps(start, step, each=each), cells, mode=mode, time_us=time_us)


def spot(block: int, slot: int) -> int:
    return 32 * block + slot


def test_vlp16_points_by_hand() -> None:
    azimuths = [4500, 4540, 4580, 20000, 20040, 20080, 20120, 20160, 20200, 20240, 20280, 35990]
    first = packet(azimuths, {(0, 2): (5000, 17), (3, 31): (1000, 200), (11, 16): (2500, 3)})
    cloud = decode(VLP16, [first, packet(steps(30), {}, time_us=1327)]).points()
    # laser = slot % 16; it fires 2.304 us * laser after its round, the second round 55.296 us after
    # the first, a block takes 110.592 us. x = r cosE cosA, y = -r cosE sinA (clockwise), z = r sinE
    # - 0.04191 tanE.
    #   block 0, slot 2: 10 m, E -13; 4.608 / 110.592 = 0.0416667 of 0.40: A 45.0166667
    #     x = 10 * .974370 * .706901 = 6.88783, y = -10 * .974370 * .707312 = -6.89184, z =
    # -2.249511 + .04191 * .230868 = -2.23983
    #   block 3, slot 31: 2 m, E 15; 89.856 / 110.592 = 0.8125 of 0.40: A 200.325
    #     x = 2 * .965926 * -.937738 = -1.81157, y = -2 * .965926 * -.347347 = 0.67102, z = .517638
    # - .04191 * .267949 = 0.50641
    #   block 11, slot 16: 5 m, E -15; half of 0.40 to the first block of the next packet: A 0.10
    #     x = 5 * .965926 * .999998 = 4.82962, y = -5 * .965926 * .001745 = -0.00843, z = -1.294095
    # + .011230 = -1.28287
    expected = {
        spot(0, 2): (6.88783, -6.89184, -2.23983),
        spot(3, 31): (-1.81157, 0.67102, 0.50641),
        spot(11, 16): (4.82962, -0.00843, -1.28287),
    }
    assert_points(cloud, expected.items())
    spots = list(expected)
    assert cloud.ring is not None
    assert cloud.intensity is not None
    assert np.flatnonzero(cloud.valid).tolist() == spots
    assert cloud.intensity[spots].tolist() == [17, 200, 3]
    assert cloud.ring[spots].tolist() == [1, 15, 0]
    np.testing.assert_allclose(cloud.time[spots], [4.608e-6, 421.632e-6, 1271.808e-6], atol=1e-12)
    vendor = VLP16.configure(frame="vendor").decode([first, packet(steps(30), {})]).points()
    # x points to the right, y forward.
    np.testing.assert_allclose(vendor.xyz[spots[0]], (6.89184, 6.88783, -2.23983), atol=2e-5)


def test_vlp16_dual_return_by_hand() -> None:
    first = packet(steps(8800, each=2), {(10, 17): (3000, 40), (11, 17): (2000, 90)}, mode=DUAL)
    cloud = decode(VLP16, [first, packet(steps(9040, each=2), {}, mode=DUAL, time_us=664)]).points()
    # blocks 10 and 11 share A 90.00, the next pair has 90.40; slot 17 is laser 1, E 1, second
    # round: 57.6 / 110.592 = 0.5208333: A 90.2083333, cosA = -.003636, sinA = .999993
    #   block 10, the last return, 6 m: x = -6 * .999848 * .003636 = -0.02181, y = -5.99905, z =
    # .104714 - .000732 = 0.10398
    #   block 11, the strongest, 4 m: x = -0.01454, y = -3.99936, z = .069810 - .000732 = 0.06908
    expected = {
        spot(10, 17): (-0.02181, -5.99905, 0.10398),
        spot(11, 17): (-0.01454, -3.99936, 0.06908),
    }
    assert_points(cloud, expected.items())
    spots = list(expected)
    assert cloud.return_index is not None
    assert cloud.return_index[spots].tolist() == [0, 1]
    np.testing.assert_allclose(cloud.time[spots], 5 * 110.592e-6 + 57.6e-6, atol=1e-12)
    assert cloud.shape == (24, 32)


def test_hdl32e_points_by_hand() -> None:
    cells = {(2, 31): (10000, 11), (5, 0): (500, 12), (8, 15): (1500, 13)}
    azimuths = [29968, 29984, 30000, 30016, 30032, 18000, 18016, 18032, 9000, 9016, 9032, 9048]
    cloud = decode(HDL32E, [packet(azimuths, cells, product=0x21)]).points()
    # slot j fires 1.152 us * j after its block, which takes 46.08 us; z = r sinE - 0.02883 tanE
    #   block 2, slot 31: 20 m, E 10.67; 35.712 / 46.08 = 0.775 of 0.16: A 300.124, cosA = .501873,
    # sinA = -.864942
    #     x = 20 * .982710 * .501873 = 9.86391, y = 20 * .982710 * .864942 = 16.99975, z = 20 *
    # .185152 - .02883 * .188410 = 3.69761
    #   block 5, slot 0: 1 m, E -30.67; A 180
    #     x = -.860119, y = 0, z = -.510094 + .02883 * .593050 = -0.49300
    #   block 8, slot 15: 3 m, E 0; 17.28 / 46.08 = 0.375 of 0.16: A 90.06
    #     x = -3 * .001047 = -0.00314, y = -3.00000, z = 0
    expected = {
        spot(2, 31): (9.86391, 16.99975, 3.69761),
        spot(5, 0): (-0.86012, 0, -0.493),
        spot(8, 15): (-0.00314, -3, 0),
    }
    assert_points(cloud, expected.items(), atol=3e-5)
    spots = list(expected)
    assert cloud.ring is not None
    assert cloud.ring[spots].tolist() == [31, 0, 23]
    np.testing.assert_allclose(cloud.time[spots], [127.872e-6, 230.4e-6, 385.92e-6], atol=1e-12)


@pytest.mark.parametrize(("sensor", "name"), [(VLP16, "vlp16_dual_real"), (VLP32C, "vlp32c_real")])
def test_the_real_packets_of_the_vectors(sensor: ls.Sensor, name: str) -> None:
    data, expected = vector_bytes(FILE, name), vectors(FILE)[name]["expected"]
    parsed = sensor.parse(data)
    assert sensor.build("data", parsed) == data
    assert (parsed.return_mode, parsed.product, parsed.timestamp) == (
        expected["return_mode"],
        expected["product"],
        expected["tohus"],
    )
    assert [block.azimuth for block in parsed.blocks] == expected["azimuths"]
    packets = decode(sensor, [data])
    cloud = packets.points()
    assert packets.time_ns.tolist() == [expected["tohus"] * 1000]
    assert int(cloud.valid.sum()) == expected["n_nonzero"]
    assert cloud.intensity is not None
    for point in expected["points"]:
        index = spot(point["block"], point["j"])
        assert parsed.blocks[point["block"]].channels[point["j"]].distance == point["raw"]
        assert cloud.intensity[index] == point["intensity"]
        assert cloud.time[index] == pytest.approx(point["t_us"] * 1e-6, abs=1e-12)
        if sensor is VLP16:  # the other vector has it without the laser's own offset
            assert clockwise(cloud)[index] == pytest.approx(point["azimuth_deg"], abs=1e-4)
        np.testing.assert_allclose(cloud.xyz[index], point["xyz"], atol=6e-4)


def test_vlp32c_points_by_hand() -> None:
    cloud = decode(
        VLP32C, [packet(steps(9000), {(0, 0): (2500, 5), (3, 31): (5000, 9)}, product=0x28)]
    ).points()
    # 4 mm steps; slot j fires 2.304 us * (j // 2) after its block, which takes 55.296 us, and looks
    # 1.4 degrees to the right or left
    #   block 0, slot 0: 10 m, E -25; A 90.00 + 1.4 = 91.4
    #     x = 10 * .906308 * -.024432 = -.22143, y = -10 * .906308 * .999701 = -9.06037, z =
    # -4.226183 + .0424 * .466308 = -4.20641
    #   block 3, slot 31: 20 m, E -1.333; 34.56 / 55.296 = 0.625 of 0.40: A 91.45 - 1.4 = 90.05
    #     x = 20 * .999729 * -.000873 = -.01745, y = -19.99458, z = -.465257 + .0424 * .023269 =
    # -.46427
    assert_points(
        cloud,
        {
            spot(0, 0): (-0.22143, -9.06037, -4.20641),
            spot(3, 31): (-0.01745, -19.99458, -0.46427),
        }.items(),
    )
    assert cloud.ring is not None
    assert cloud.ring[[spot(0, 0), spot(0, 29)]].tolist() == [0, 31]
    np.testing.assert_allclose(cloud.time[[spot(0, 0), spot(3, 31)]], [0, 200.448e-6], atol=1e-12)


def test_the_high_resolution_of_the_puck() -> None:
    cloud = decode(HI_RES, [packet(steps(0), {(0, 16): (5000, 1)}, product=0x24)]).points()
    # as a VLP-16's, E -10: 10 m at A 0.20: x = 9.84802, y = -0.03438, z = -1.736482 + .04191 *
    # .176327 = -1.72909
    assert_points(cloud, [(spot(0, 16), (9.84802, -0.03438, -1.72909))])


def test_vls128_points_by_hand() -> None:
    azimuths = [value for value in (27000, 27020, 27040) for _ in range(4)]
    first = packet(
        azimuths,
        {(0, 0): (2500, 3), (5, 4): (1250, 7), (11, 31): (5000, 9)},
        product=0xA1,
        flags=FOUR_BANKS * 3,
    )
    packets = decode(
        VLS128, [first, packet([27060] * 12, {}, product=0xA1, flags=FOUR_BANKS * 3, time_us=160)]
    )
    cloud = packets.points()
    # eight lasers fire each 8/3 us, with a pause of two of these after eight; a sequence takes 20
    # and begins 7 us before the time
    #   block 0, slot 0: laser 1, E -11.742, 6.354 to the right: A 276.354; 10 m
    #     x = 10 * .979074 * .110671 = 1.08355, y = 10 * .979074 * .993857 = 9.73060, z = -2.035060
    # + .05863 * .207857 = -2.02287
    #   block 5, slot 4: laser 37, group 4, E -25, -0.911: 0.2 of 0.20: A 270.20 + .04 - .911 =
    # 269.329; 5 m
    #     x = 5 * .906308 * -.011711 = -.05307, y = 4.53123, z = -2.113091 + .05863 * .466308 =
    # -2.08575
    #   block 11, slot 31: laser 128, group 15 and the pause: 17 / 20 of 0.20, E 0.43: A 270.40 +
    # .17 - 6.354 = 264.216; 20 m
    #     x = 20 * .999972 * -.100778 = -2.01550, y = 19.89762, z = .150097 - .05863 * .007505 =
    # 0.14966
    expected = {
        spot(0, 0): (1.08355, 9.7306, -2.02287),
        spot(5, 4): (-0.05307, 4.53123, -2.08575),
        spot(11, 31): (-2.0155, 19.89762, 0.14966),
    }
    assert_points(cloud, expected.items(), atol=6e-5)
    assert cloud.ring is not None
    assert cloud.ring[list(expected)].tolist() == [4, 0, 75]
    np.testing.assert_allclose(cloud.time[list(expected)], [-7e-6, 57e-6, 145e-6], atol=1e-12)


def test_vls128_with_dual_return() -> None:
    flags = [flag for flag in FOUR_BANKS for _ in range(2)]
    cells = {(2, 4): (1250, 7), (3, 4): (2500, 8)}
    data = [
        packet([9000 + 20 * i] * 8, cells, product=0xA1, mode=DUAL, flags=flags, time_us=53 * i)
        for i in range(2)
    ]
    packets = decode(VLS128, data)
    assert packets.frame == "data_dual"
    cloud = packets.points()
    #   blocks 2 and 3, slot 4: laser 37, E -25, A 90 + .04 - .911 = 89.129, 5 and 10 m: x = 4.53154
    # * .015202 = .06889, y = -4.53102
    assert_points(
        cloud,
        [(spot(2, 4), (0.06889, -4.53102, -2.08575)), (spot(3, 4), (0.13778, -9.06203, -4.19884))],
        atol=6e-5,
    )
    assert cloud.return_index is not None
    assert cloud.return_index[[spot(2, 4), spot(3, 4)]].tolist() == [0, 1]


def test_the_real_packet_of_a_vls128() -> None:
    data, expected = vector_bytes(FILE, "vls128_real"), vectors(FILE)["vls128_real"]["expected"]
    parsed = VLS128.parse(data)
    assert VLS128.build("data", parsed) == data
    assert [block.azimuth for block in parsed.blocks] == expected["azimuths"]
    assert [f"{block.flag:04x}" for block in parsed.blocks] == expected["flags"]
    packets = decode(VLS128, [data])
    assert int(packets.raw["blocks"]["channels"]["distance"].sum()) == expected["sum_raw"]
    assert packets.time_ns.tolist() == [expected["tohus"] * 1000]


@pytest.mark.parametrize(("each", "mode"), [(1, STRONGEST), (2, DUAL)])
@pytest.mark.parametrize("beyond", [None, 2000, 24000])
def test_the_last_block_where_nothing_follows_or_packets_are_lost(
    each: int, mode: int, beyond: int | None
) -> None:
    data = [make_packet(1000, 39, each=each, mode=mode)]
    if beyond is not None:
        data.append(make_packet(beyond, 39, each=each, mode=mode, time_us=9000))
    last = steps(1000, 39, each=each)[-1] / 100
    inner, outer = range(12 - each), range(12 - each, 12)
    for sensor, known in ((VLP16, True), (VLP16.configure(last_block="invalid"), False)):
        cloud = decode(sensor, data).points()
        valid = cloud.valid.reshape(-1, 12, 32)[0]
        assert valid[inner].all()
        assert valid[outer].all() == valid[outer].any() == known
        if known:
            np.testing.assert_allclose(
                clockwise(cloud)[[spot(block, 16) for block in outer]], last + 0.195, atol=2e-5
            )


@pytest.mark.parametrize(("each", "mode"), [(1, STRONGEST), (2, DUAL)])
def test_directions_run_on_over_packet_borders_and_over_zero(each: int, mode: int) -> None:
    per_packet = 12 // each
    starts = [(35000 + 40 * per_packet * number) % 36000 for number in range(6)]
    data = [
        make_packet(start, each=each, mode=mode, time_us=1000 * number)
        for number, start in enumerate(starts)
    ]
    cloud = decode(VLP16, data).points()
    turned = (clockwise(cloud).reshape(72, 32)[::each] - 350) % 360
    slot = np.arange(32)
    within = 0.4 * (slot // 16 * 55.296 + slot % 16 * 2.304) / 110.592
    np.testing.assert_allclose(turned, 0.4 * np.arange(len(turned))[:, None] + within, atol=5e-5)


def test_points_are_not_interpolated_across_a_masked_sector() -> None:
    masked = packet([*steps(8900)[:6], *steps(27000)[:6]], {(5, 16): (500, 1)})
    assert clockwise(decode(VLP16, [masked]).points())[spot(5, 16)] == pytest.approx(91.2, abs=1e-4)


@pytest.mark.parametrize("jump_deg", [20, 116, 200, 350])
def test_a_single_block_after_a_masked_sector_uses_the_rotor_speed(jump_deg: int) -> None:
    """The last block of the packet is alone after a gap, so no azimuth follows it."""
    starts = steps(10_000)
    starts[-1] = (starts[-2] + 100 * jump_deg) % 36_000
    cells = {(block, slot): (500, 1) for block in range(12) for slot in range(32)}
    cloud = VLP16.decode([packet(starts, cells)]).points()
    first, last = clockwise(cloud)[[spot(11, 0), spot(11, 31)]]
    # Degrees from laser 0 to laser 31, at 0.4 degrees from block to block.
    within = 0.4 * (55.296 + 15 * 2.304) / 110.592
    assert (last - first) % 360 == pytest.approx(within, abs=1e-4)


def test_an_azimuth_that_falls_back_is_no_turn() -> None:
    stuck = packet([1000, 999, *steps(1000, 0)[2:]], {(0, 16): (500, 1)})
    assert clockwise(decode(VLP16, [stuck]).points())[spot(0, 16)] == pytest.approx(9.995, abs=1e-4)


def test_neither_the_product_byte_nor_an_unset_mode_changes_points() -> None:
    for sensor in (VLP16, HDL32E):
        clouds = [
            sensor.decode([packet(steps(10), {(4, 9): (700, 1)}, mode=m, product=p)]).points()
            for m, p in ((0x37, 0x22), (0, 0), (0x38, 0x21))
        ]
        for cloud in clouds[1:]:
            np.testing.assert_array_equal(cloud.xyz, clouds[0].xyz)


def test_the_clock_runs_on_over_the_hour() -> None:
    times = [3_599_999_000, 327, 1_654]
    packets = decode(VLP16, [make_packet(0, time_us=time) for time in times])
    assert np.diff(packets.time_ns).tolist() == [1_327_000, 1_327_000]


def test_azimuths_up_to_a_whole_turn_are_valid() -> None:
    wrong_flag = bytearray(make_packet(0))
    wrong_flag[300] = 0xFE
    packets = decode(VLP16, [packet([36000] * 12, {}), packet([36001] * 12, {}), bytes(wrong_flag)])
    assert (len(packets), packets.stats.implausible) == (1, 1)
    with pytest.raises(ls.WireError) as caught:
        VLP16.parse(bytes(wrong_flag), "data")
    assert (caught.value.path, caught.value.offset) == ("blocks[3].flag", 300)


def position(nmea: bytes, *, pps: int = 2, time_us: int = 123_456_789) -> bytes:
    """Return a position packet with a different value in each field."""
    inertial = struct.pack("<12H", *range(0x101, 0x10D))
    state = struct.pack("<BBBhIBBIBBBB", 41, 38, 35, -3, 600, 4, 2, time_us, pps, 1, 99, 22)
    return bytes(14) + inertial + bytes(149) + state + nmea.ljust(306, b"\0")


def test_the_position_packet() -> None:
    sentence = b"$GPRMC,220516,A,5133.82,N,00042.24,W,173.8,231.8,130694,004.2,W*70\r\n"
    data = position(sentence)
    assert len(data) == 512
    parsed = VLP16.parse(data)
    assert VLP16.build("position", parsed) == data
    assert bytes(parsed.nmea).rstrip(b"\0") == sentence
    assert [parsed.inertial[2].gyro, parsed.inertial[2].accel_y] == [0x109, 0x10C]
    assert (
        parsed.top_board_temperature,
        parsed.bottom_board_temperature,
        parsed.adc_temperature_change,
    ) == (41, 38, -3)
    assert (
        parsed.pps,
        parsed.thermal_status,
        parsed.shutdown_temperature,
        parsed.power_up_temperature,
    ) == (2, 1, 99, 22)
    packets = decode(VLP16, [data, make_packet(0), position(b"", pps=0, time_us=0)], "position")
    assert packets["timestamp"].tolist() == [pytest.approx(123.456789), 0]
    assert packets["adc_age"].tolist() == [600, 600]


@pytest.mark.parametrize(
    "data",
    [
        position(b"$GP\xff\xee"),
        position(b"", pps=4),
        b"\1" + position(b"")[1:],
        position(b"") + b"\0",
    ],
)
def test_invalid_position_packets_are_rejected(data: bytes) -> None:
    assert len(decode(VLP16, [data], "position")) == 0


def test_the_option_is_checked_and_kept() -> None:
    chosen = VLP16.configure(last_block="invalid")
    assert pickle.loads(pickle.dumps(chosen)).options == {"last_block": "invalid"}
    again = chosen.configure(frame="vendor")
    assert not again.decode([make_packet(0)]).points().valid[spot(11, 5)]
    assert VLP16.decode([make_packet(0)]).points().valid.all()
    with pytest.raises(ls.UsageError, match="'previous' or 'invalid', not 'mean'"):
        VLP16.configure(last_block="mean")
    with pytest.raises(UnknownOption):
        VLP16.configure(last="invalid")


@pytest.mark.parametrize(
    ("sensor", "lasers", "per_second", "product"),
    [(VLP16, 16, 753.5, 0x22), (HDL32E, 32, 1808.4, 0x21)],
)
def test_the_simulated_sensor_turns_ten_times_a_second(
    sensor: ls.Sensor, lasers: int, per_second: float, product: int
) -> None:
    frames = simulate(sensor, int(per_second * 0.25))
    packets = sensor.decode(frames)
    assert packets.raw["product"].tolist() == [product] * len(packets)
    assert (len(packets) - 1) / np.ptp(packets.time_ns * 1e-9) == pytest.approx(
        per_second, rel=1e-3
    )
    scans = list(sensor.scans(frames))
    assert [scan.complete for scan in scans] == [False, True, False]
    assert scans[1].rate_hz == pytest.approx(10, rel=2e-3)
    cloud = scans[1].points
    assert cloud.ring is not None
    assert set(cloud.ring.tolist()) == set(range(lasers))
    assert cloud.valid.mean() > 0.9


def test_the_difference_of_an_hdl32e_names_its_own_interval_first() -> None:
    intervals_us = [
        round(np.diff(sensor.decode(simulate(sensor, 2)).time_ns).item() / 1000)
        for sensor in (HDL32E, VLP16)
    ]
    text = VLP16.relatives["velodyne-hdl32e"]
    assert isinstance(text, str)
    numbers = [int(number) for number in re.findall(r"(\d+) us", text)]
    assert numbers[::2] == intervals_us


def test_the_hour_is_that_of_the_position_packets() -> None:
    """The data are from 13:59:59 on 2023-07-05.

    The packet with the hour arrives 0.5 s after or before them.
    """
    sentence = b"$GPRMC,135959,A,4807.038,N,01131.000,E,022.4,084.4,050723,003.1,W*00\r\n"
    ten = 1_688_558_400  # 12:00:00
    for told, read, seconds in (
        (0.5, 0.25, 7200.25),
        (3599.5, 3599.9, 7199.9),
        (3599.5, 0.1, 7200.1),
    ):
        packets = decode(
            VLP16,
            [
                packet(steps(0), {}, time_us=round(read * 1e6)),
                position(sentence, time_us=round(told * 1e6)),
            ],
        )
        assert packets.time_ns.tolist() == [ten * 10**9 + round(seconds * 1e9)]
        assert not packets.stats.undated


@pytest.mark.parametrize(
    ("nmea", "pps"),
    [
        (b"", 2),
        (b"$GPRMC,135959,V,,,,,,,050723,,,N*00", 2),
        (b"$GPGGA,135959,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47", 2),
        (b"$GPRMC,135959,A,,,,,,,310223,,,A*00", 2),
        (b"$GPRMC,135959,A,,,,,,,050723,,,A*00", 0),
    ],
    ids=["no sentence", "not valid", "without a date", "no day", "no pulse"],
)
def test_without_a_date_times_start_at_the_hour_with_a_warning(nmea: bytes, pps: int) -> None:
    packets = decode(VLP16, [position(nmea, pps=pps), packet(steps(0), {}, time_us=2_000_000)])
    assert packets.time_ns.tolist() == [2_000_000_000]
    assert packets.stats.undated == (
        "times count from the start of the sensor's clock, because no position frame with the date"
        " has arrived"
    )


def test_the_hour_runs_on_over_its_end_and_between_batches() -> None:
    clock = [3599.5, 3599.9, 0.3, 0.7]
    data = [
        packet(steps(40 * number), {}, time_us=round(second * 1e6))
        for number, second in enumerate(clock)
    ]
    stream = PacketStream(VLP16, "data", (decoder := VLP16.decoder()).stats)
    told = position(b"$GPRMC,235959,A,,,,,,,311223,,,A*00", time_us=3_599_600_000)
    parts = [
        stream.add([frames for datagram in part for frames in decoder.frames(datagram)])
        for part in (data[:1], [told, data[1]], data[2:])
    ]
    midnight = 1_704_067_200
    assert [part.time_ns.tolist() for part in parts] == [
        [3_599_500_000_000],
        [midnight * 10**9 - 100_000_000],
        [midnight * 10**9 + 300_000_000, midnight * 10**9 + 700_000_000],
    ]
    assert not decoder.stats.undated


def test_hdl64e_points_by_hand() -> None:
    """Laser 1 of the example unit has these corrections.

    Elevation -8.769 degrees, 7.156 degrees to the left, 0.195 m up, 26 mm aside, 1.52 m further.
    """
    sensor = ls.sensor("velodyne-hdl64e-s2")
    flags = [b"\xff\xee", b"\xff\xdd"] * 6
    cloud = decode(
        sensor,
        [packet(steps(9000, 20, each=2), {(0, 0): (4240, 9), (1, 0): (4240, 8)}, flags=flags)],
    ).points()
    # block 0, slot 0: 8.48 + 1.52 = 10 m, A = 90 + 7.156 = 97.156: cos -.124575, sin .992210; cosE
    # .988311, sinE -.152450
    #   out = 9.88311 + .195 * .152450 = 9.91284; x = -1.23489 + .026 * .992210 = -1.20909, y =
    # -9.83562 + .026 * -.124575 = -9.83886
    #   z = -1.52450 + .195 * .988311 = -1.33178
    assert_points(cloud, [(0, (-1.20909, -9.83886, -1.33178))], atol=2e-3)
    assert cloud.nominal
    assert cloud.ring is not None
    assert sorted(cloud.ring[:64].tolist()) == list(range(64))
    np.testing.assert_allclose(cloud.time[[0, 32, 64, 65]], [0, 0, 48e-6, 49.26e-6], atol=1e-12)


def test_dual_return_of_an_hdl64e_has_four_blocks_of_one_azimuth() -> None:
    cloud = (
        ls.sensor("velodyne-hdl64e-s3")
        .decode([packet(steps(0, 20, each=4), {}, flags=[b"\xff\xee", b"\xff\xdd"] * 6)])
        .points()
    )
    assert cloud.return_index is not None
    assert cloud.return_index[::32].tolist() == [0, 0, 1, 1] * 3
    np.testing.assert_allclose(cloud.time[::128], np.arange(3) * 57.6e-6, atol=1e-12)


def test_an_hdl64e_has_the_corrections_of_its_file(tmp_path: Path) -> None:
    """Laser 34 (id 33) has these corrections.

    3.3 degrees to the left, elevation -6.6 degrees, 0.66 m further, 9.9 cm up and 1.65 cm to the
    left across its beam.
    """
    sensor = ls.sensor("velodyne-hdl64e-s2").configure(
        calibration=write_velodyne_xml(tmp_path / "db.xml")
    )
    data = packet(steps(0, 20, each=2), {(1, 1): (2000, 9)}, flags=[b"\xff\xee", b"\xff\xdd"] * 6)
    cloud = decode(sensor, [data]).points()
    assert not cloud.nominal
    assert ls.sensor("velodyne-hdl64e-s2").decode([data]).points().nominal
    assert cloud.range[33] == pytest.approx(4.66)
    # 1.26 us after the shot A = 0.005 - 3.3 = -3.295: cos .998347, sin -.057473; cosE .993373, sinE
    # -.114937
    #   out = 4.66 * .993373 + .099 * .114937 = 4.64050; x = 4.63283 - .0165 * .057473 = 4.63188; y
    # = .26670 + .0165 * .998347 = .28318
    #   z = -4.66 * .114937 + .099 * .993373 = -.43726
    assert_points(cloud, [(33, (4.63188, 0.28318, -0.43726))], atol=5e-5)


def test_an_invalid_hdl64e_file_is_refused(tmp_path: Path) -> None:
    sensor, text = ls.sensor("velodyne-hdl64e-s3"), tmp_path / "text.xml"
    text.write_text("lasers: 64")
    with pytest.raises(
        ls.UsageError,
        match=r"text\.xml: not the calibration of an HDL-64E \(db\.xml\): syntax error",
    ):
        sensor.configure(calibration=text)
    with pytest.raises(ls.UsageError, match="contains 32 entries with 32 different lasers"):
        sensor.configure(calibration=write_velodyne_xml(tmp_path / "vlp32.xml", 32))
    with pytest.raises(ls.UsageError, match="rotCorrection_ of a laser must be finite"):
        sensor.configure(calibration=write_velodyne_xml(tmp_path / "nan.xml", rotCorrection_="nan"))


def test_position_packets_report_the_state_of_the_clock() -> None:
    datagrams = [position(b"", pps=0), packet(steps(0), {}), position(b""), packet(steps(1), {})]
    clock = VLP16.clock
    assert clock is not None
    assert clock.status is not None
    values = read_clock_status(decode(VLP16, datagrams))
    assert [clock.status.state_of(value).locked for value in values] == [False, True]
