"""Tests of RoboSense RS-LiDAR-M1: vectors, calculated points and dual return."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from construct import Array, Bytes, Const, Int8ub, Int16ub, Int32ub, Struct

import lidarspec as ls
from lidarspec.packets.clock_status import frame_status
from lidarspec.spec import Clock, Fields, Frame, OnRewind, PacketCounter, Polar, Scaled, Udp
from tests.evidence import assert_points, decode, vector_bytes, vectors

FILE = "vectors_udp3d.json"
SENSOR = ls.sensor("robosense-m1")
SIZE = 1210

WHOLE = {"rsm1_msop_full_dual_1": "data", "rsm1_difop_rs_driver_fov": "difop_fov"}
EXCERPTS = {
    "rsm1_msop_header_manual",
    "rsm1_msop_blocks0_4_manual",
    "rsm1_point_manual_example",
    "rsm1_radius_example",
}
SPLITS = {"rsm1_split_unit_a", "rsm1_split_unit_b", "rsm1_split_loop"}
# A time with milliseconds and microseconds apart, of the mechanical models.
OTHER_LAYOUTS = {"rs_time_utc_us"}


def beginning(data: bytes) -> bytes:
    """Return a whole packet that begins with these bytes."""
    return data + bytes(SIZE - len(data))


def with_channel(data: bytes, block: int, channel: int, values: str) -> bytes:
    """Return the packet with other bytes in one channel.

    The offset of the channel is calculated from the manual's tables.
    """
    start, new = 32 + 47 * block + 2 + 9 * channel, bytes.fromhex(values)
    return data[:start] + new + data[start + len(new) :]


def test_every_vector_of_the_model_is_used() -> None:
    known = {
        name
        for name, vector in vectors(FILE).items()
        if name.startswith("rsm1_") or vector["sensor"].startswith("M1")
    }
    assert known == WHOLE.keys() | EXCERPTS | SPLITS | OTHER_LAYOUTS


@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_packet_is_parsed_and_built_to_the_same_bytes(name: str) -> None:
    data, frame = vector_bytes(FILE, name), WHOLE[name]
    assert len(data) == vectors(FILE)[name]["length"]
    parsed = SENSOR.parse(data, frame)
    assert SENSOR.build(frame, parsed) == data
    assert [(found.frame, found.data) for found in SENSOR.split([data])] == [(frame, data)]
    assert len(decode(SENSOR, [data], None if frame == "data" else frame)) == 1


def test_the_header_of_the_manual() -> None:
    expected = vectors(FILE)["rsm1_msop_header_manual"]["expected"]
    parsed = SENSOR.parse(beginning(vector_bytes(FILE, "rsm1_msop_header_manual")))
    for name in (
        "pkt_psn",
        "protocol_version",
        "wave_mode",
        "time_sync_mode",
        "seconds",
        "microseconds",
        "lidar_type",
    ):
        assert parsed[name] == expected[name], name
    assert parsed.mems_tmp == expected["temp_raw"]
    packets = decode(SENSOR, [SENSOR.build("data", parsed)])
    assert packets.time_ns.tolist() == [77633816_804541_000]
    assert packets["microseconds"].tolist() == [pytest.approx(0.804541)]


def test_the_first_five_blocks_of_the_manuals_capture() -> None:
    data = beginning(vector_bytes(FILE, "rsm1_msop_blocks0_4_manual"))
    expected = vectors(FILE)["rsm1_msop_blocks0_4_manual"]["expected"]
    packets = decode(SENSOR, [data])
    cloud = packets.points()
    names = {
        "radius_m": "radius",
        "elevation_deg": "elevation",
        "azimuth_deg": "azimuth",
        "intensity": "intensity",
    }
    for number, block in enumerate(expected["blocks"]):
        assert packets.raw["blocks"]["time_offset"][0, number] == block["time_offset_us"]
        for ring, point in enumerate(block.get("points", [])):
            for printed, path in names.items():
                if printed in point:
                    assert packets[f"blocks.channels.{path}"][0, number, ring] == pytest.approx(
                        point[printed], abs=1e-9
                    )
            index = 5 * number + ring
            assert not point or cloud.valid[index] == point.get(
                "valid", point.get("radius_raw", 1) > 0 and point.get("radius_m", 1) > 0
            )
    assert int(cloud.valid.sum()) == expected["n_valid"]
    assert SENSOR.build("data", SENSOR.parse(data)) == data


def test_points_by_hand() -> None:
    data = beginning(vector_bytes(FILE, "rsm1_msop_blocks0_4_manual"))
    data = with_channel(data, 5, 1, "03e8 7c18 8bb8 11 0000")
    data = with_channel(data, 6, 3, "0fa0 7f9c 7448 22 0000")
    cloud = decode(SENSOR, [data]).points()
    # (raw - 32768) / 100 degrees, radius * 5 mm; x = r cosE cosA, y = r cosE sinA, z = r sinE.
    #   block 0, channel 1: 0a77 = 2679: 13.395 m; 83a2 = 33698: E 9.30; 94df = 38111: A 53.43
    #     x = 13.395 * .986856 * .595805 = 7.87591, y = 13.395 * .986856 * .803131 = 10.61651, z =
    # 13.395 * .161604 = 2.16468
    #   block 0, channel 4: 071b = 1819: 9.095 m; 846c = 33900: E 11.32; 76e9 = 30441: A -23.27
    #     x = 9.095 * .980546 * .918656 = 8.19261, y = -9.095 * .980546 * .395064 = -3.52321, z =
    # 9.095 * .196289 = 1.78524
    #   block 5, channel 2: 03e8 = 1000: 5 m; 7c18 = 31768: E -10; 8bb8 = 35768: A 30
    #     x = 5 * .984808 * .866025 = 4.26434, y = 5 * .984808 * .5 = 2.46202, z = -5 * .173648 =
    # -0.86824
    #   block 6, channel 4: 0fa0 = 4000: 20 m; 7f9c = 32668: E -1; 7448 = 29768: A -30
    #     x = 20 * .999848 * .866025 = 17.31787, y = -20 * .999848 * .5 = -9.99848, z = -20 *
    # .017452 = -0.34905
    expected = {0: (7.87591, 10.61651, 2.16468), 3: (8.19261, -3.52321, 1.78524)}
    expected |= {26: (4.26434, 2.46202, -0.86824), 33: (17.31787, -9.99848, -0.34905)}
    assert_points(cloud, expected.items(), atol=3e-5)
    assert cloud.intensity is not None
    assert cloud.ring is not None
    assert cloud.intensity[[0, 26, 33]].tolist() == [0x2D, 0x11, 0x22]
    assert cloud.ring[[0, 3, 26, 33]].tolist() == [0, 3, 1, 3]
    np.testing.assert_array_equal(
        SENSOR.configure(frame="vendor").decode([data]).points().xyz, cloud.xyz
    )


@pytest.mark.parametrize("name", ["rsm1_point_manual_example", "rsm1_radius_example"])
def test_a_point_of_the_manual(name: str) -> None:
    expected = vectors(FILE)[name]["expected"]
    header = vector_bytes(FILE, "rsm1_msop_header_manual")
    packets = decode(
        SENSOR, [with_channel(beginning(header), 0, 0, vector_bytes(FILE, name).hex())]
    )
    for path in ("elevation", "azimuth"):
        assert packets[f"blocks.channels.{path}"][0, 0, 0] == pytest.approx(
            expected[f"{path}_deg"], abs=1e-9
        )
    cloud = packets.points()
    assert cloud.range[0] == pytest.approx(expected["radius_m"])
    assert_points(cloud, [(0, expected["xyz"])], atol=0.006)
    assert not cloud.valid[1:].any()


def test_no_return_by_its_radius_not_by_its_angles() -> None:
    packets = decode(
        SENSOR,
        [
            with_channel(
                beginning(vector_bytes(FILE, "rsm1_msop_blocks0_4_manual")),
                20,
                0,
                "0064 0000 0000 07",
            )
        ],
    )
    cloud = packets.points()
    assert not cloud.valid[2]  # radius 0, angle words 0
    assert not cloud.valid[24]  # radius 0, real angles
    assert cloud.valid[100]  # a return, angle words 0: -327.68 degrees is 32.32
    assert np.isinf(cloud.range[[2, 24]]).all()
    assert np.rad2deg(cloud.azimuth[100]) == pytest.approx(32.32, abs=1e-4)


def test_points_have_the_times_of_their_blocks() -> None:
    cloud = decode(SENSOR, [beginning(vector_bytes(FILE, "rsm1_msop_blocks0_4_manual"))]).points()
    assert cloud.stamp_ns == 77633816_804541_000
    np.testing.assert_allclose(
        cloud.time[:25], np.repeat([0, 3e-6, 7e-6, 10e-6, 13e-6], 5), atol=1e-12
    )
    assert cloud.shape == (25, 5)


def test_dual_return() -> None:
    first = vector_bytes(FILE, "rsm1_msop_full_dual_1")
    values = SENSOR.parse(first)
    assert (values.wave_mode, [block.return_seq for block in values.blocks]) == (0, [1] * 25)
    blocks = [{**block, "return_seq": 2} for block in values.blocks]
    second = SENSOR.build("data", {**values, "pkt_psn": 2, "blocks": blocks})
    packets = decode(SENSOR, [first, second])
    cloud = packets.points()
    assert cloud.return_index is not None
    assert len(cloud) == 250
    assert cloud.return_index.tolist() == [0] * 125 + [1] * 125
    # Two echoes at one distance are both kept.
    np.testing.assert_array_equal(cloud.xyz[:125], cloud.xyz[125:])
    single = decode(SENSOR, [beginning(vector_bytes(FILE, "rsm1_msop_header_manual"))]).points()
    assert single.return_index is not None
    assert single.return_index.tolist() == [0] * 125


def test_the_device_information() -> None:
    expected = vectors(FILE)["rsm1_difop_rs_driver_fov"]["expected"]
    parsed = SENSOR.parse(vector_bytes(FILE, "rsm1_difop_rs_driver_fov"), "difop_fov")
    assert (parsed.frame_rate, parsed.msop_port, parsed.difop_port) == (
        expected["frame_rate"],
        expected["msop_port"],
        expected["difop_port"],
    )
    assert ".".join(map(str, parsed.lidar_ip)) == expected["lidar_ip"]
    assert ".".join(map(str, parsed.host_ip)) == expected["host_ip"]
    assert (parsed.return_mode, parsed.seconds, parsed.microseconds) == (
        4,
        expected["seconds"],
        expected["microseconds"],
    )
    assert SENSOR.links["data"] == Udp(parsed.msop_port, parsed.difop_port)


@pytest.mark.parametrize("layout", ["difop", "difop_fov", "difop_guide", "difop_other"])
def test_the_first_28_bytes_are_equal_in_all_layouts(layout: str) -> None:
    # 10 Hz, 192.168.1.200, 192.168.1.102, MAC, 6699, 7788.
    head = bytes.fromhex("a5ff005a11115555 00 0a c0a801c8 c0a80166 001ccd0a0b0c 1a2b 1e6c")
    data = head + SENSOR.example(layout)[28:]
    parsed = SENSOR.parse(data, layout)
    assert parsed.frame_rate == 10
    assert parsed.lidar_ip == bytes([192, 168, 1, 200])
    assert parsed.host_ip == bytes([192, 168, 1, 102])
    assert parsed.mac == bytes.fromhex("001ccd0a0b0c")
    assert (parsed.msop_port, parsed.difop_port) == (6699, 7788)
    assert SENSOR.build(layout, parsed) == data


def test_the_field_of_view_is_in_its_layout_only() -> None:
    data = bytearray(vector_bytes(FILE, "rsm1_difop_rs_driver_fov"))
    data[28:36] = bytes.fromhex("1770 2ee0 04e2 09c4")  # 60, 120, 12.5 and 25 degrees
    found = decode(SENSOR, [bytes(data)], "difop_fov")
    fields = ("horizontal_start", "horizontal_end", "vertical_start", "vertical_end")
    assert [found[name].tolist() for name in fields] == [[60], [120], [12.5], [25]]


@pytest.mark.parametrize(("layout", "start"), [("difop", 117), ("difop_fov", 125)])
def test_calibration_by_its_offset(layout: str, start: int) -> None:
    data = bytearray(SENSOR.example(layout))
    for number in range(20):
        entry = bytes([number % 2]) + (1000 + number).to_bytes(2, "big")
        data[start + 3 * number : start + 3 * number + 3] = entry
    calibration = SENSOR.parse(bytes(data), layout).calibration
    signs_and_values = [(entry.sign, entry.value) for entry in calibration]
    assert signs_and_values == [(number % 2, 1000 + number) for number in range(20)]


def test_device_information_layouts_are_distinguished() -> None:
    """The layouts of DIFOP differ in the offsets of the modes and of the time.

    The content of a packet without a known layout is kept as bytes.
    """
    head = bytes.fromhex("a5ff005a11115555000a") + bytes(18)
    modes = bytes([5, 2, 1]) + (1_700_000_000).to_bytes(6, "big") + (999_999).to_bytes(4, "big")
    for frame, start in (
        ("difop", 44),
        ("difop_fov", 52),
        ("difop_guide", 54),
        ("difop_other", 60),
    ):
        data = bytearray(head + bytes([9]) * (256 - len(head)))
        data[start : start + len(modes)] = modes
        (found,) = SENSOR.split([bytes(data)])
        assert found.frame == frame
        assert SENSOR.build(frame, SENSOR.parse(bytes(data), frame)) == data
        assert frame == "difop_other" or SENSOR.parse(bytes(data), frame).seconds == 1_700_000_000


@pytest.mark.parametrize("size", [0, 1, 255, 257, 1209, 1211, 62152])
def test_datagrams_of_another_size_are_rejected(size: int) -> None:
    whole = vector_bytes(FILE, "rsm1_msop_full_dual_1") + bytes(62152)
    packets = decode(SENSOR, [whole[:size], whole[:SIZE]])
    assert (len(packets), packets.stats.bad_length, packets.stats.bytes_skipped) == (1, 1, size)


def test_errors_name_the_field() -> None:
    data = vector_bytes(FILE, "rsm1_msop_full_dual_1")
    for wrong, path, offset in [
        (b"\x55\xaa\x5a\xa4" + data[4:], "magic", 0),
        (data[:706], "blocks[14].channels[1].azimuth", 705),
    ]:
        with pytest.raises(ls.WireError) as caught:
            SENSOR.parse(wrong, "data")
        assert (caught.value.path, caught.value.offset) == (path, offset)
    assert (
        decode(
            SENSOR, [SENSOR.build("data", {**SENSOR.parse(data), "pkt_psn": 0})]
        ).stats.implausible
        == 1
    )


def test_the_sweep_stays_in_the_field_of_view() -> None:
    assert SENSOR.simulation.sweep is not None
    seen: dict[str, list[Any]] = {"azimuth": [], "elevation": []}
    for i in range(0, 630, 3):
        values = SENSOR.simulation.sweep(i)
        assert values["pkt_psn"] == i + 1
        for name, angles in seen.items():
            angles.append(values[f"blocks.channels.{name}"])
    azimuth, elevation = np.array(seen["azimuth"]), np.array(seen["elevation"])
    assert azimuth.shape == elevation.shape == (210, 25, 5)
    assert (azimuth.min(), azimuth.max()) == (
        pytest.approx(-60, abs=0.2),
        pytest.approx(60, abs=0.2),
    )
    assert (elevation.min(), elevation.max()) == (
        pytest.approx(-12.5, abs=0.3),
        pytest.approx(12.5, abs=0.3),
    )
    # Each channel covers a fifth of 120 degrees.
    np.testing.assert_allclose(np.ptp(azimuth, axis=(0, 1)), 24, atol=0.3)
    assert SENSOR.simulation.sweep(630)["pkt_psn"] == 1
    assert SENSOR.simulation.sweep(6300 + 63)["seconds"] + SENSOR.simulation.sweep(6300 + 63)[
        "microseconds"
    ] == pytest.approx(1.01)


def test_decoding_follows_a_struct_with_renamed_and_reordered_fields() -> None:
    shot = Struct(
        "bearing" / Scaled(Int16ub, 0.01, "deg", offset=-327.68),
        "far" / Scaled(Int16ub, 0.005, "m"),
        "spare" / Bytes(2),
    )
    group = Struct("shots" / Array(5, shot), "delay" / Scaled(Int8ub, 1e-6, "s"))
    struct = Struct(
        "magic" / Const(b"\x55\xaa\x5a\xa5"),
        "groups" / Array(3, group),
        "micros" / Scaled(Int32ub, 1e-6, "s"),
        "turn" / Int16ub,
    )

    def points(f: Fields) -> Polar:
        return Polar(f.groups.shots.far, np.deg2rad(f.groups.shots.bearing), time=f.groups.delay)

    other = dataclasses.replace(
        SENSOR,
        frames={"data": Frame(struct, data=True, max_length=103)},
        points=points,
        clock=Clock("micros"),
        sequence=PacketCounter("turn"),
        scan=OnRewind("turn"),
        info={},
    )
    groups = [
        {
            "delay": 0.00001 * g,
            "shots": [{"far": 1 + g, "bearing": 10 * k, "spare": b"xy"} for k in range(5)],
        }
        for g in range(3)
    ]
    data = other.build("data", units=True, groups=groups, micros=0.5, turn=7)
    assert other.build("data", other.parse(data)) == data
    cloud = decode(other, [data]).points()
    np.testing.assert_allclose(cloud.range, np.repeat([1, 2, 3], 5))
    np.testing.assert_allclose(
        np.rad2deg(cloud.azimuth), np.tile([0, 10, 20, 30, 40], 3), atol=1e-4
    )
    np.testing.assert_allclose(cloud.time, np.repeat([0, 1e-5, 2e-5], 5), atol=1e-12)
    assert cloud.stamp_ns == 500_000_000


def test_mode_and_status_of_synchronization_say_whether_the_clock_is_locked() -> None:
    clock = SENSOR.clock
    assert clock is not None
    assert clock.status is not None
    difop = SENSOR.parse(SENSOR.example("difop"), "difop")
    states = {}
    for mode in range(4):
        for status in range(3):
            difop.time_sync_mode = mode
            difop.time_sync_status = status
            frames = SENSOR.decode([SENSOR.build("difop", difop)], "difop")
            value = frame_status(clock.status, frames.table).item()
            states[mode, status] = clock.status.state_of(value)
    locked = {place: clock.epoch_in(state) for place, state in states.items() if state.locked}
    assert locked == {(1, 1): "utc", (2, 1): "tai", (3, 1): "tai"}
    assert all(state.locked is not None for state in states.values())


def test_an_undocumented_status_of_synchronization_is_unknown() -> None:
    helios = ls.sensor("robosense-helios32")
    assert helios.clock is not None
    assert helios.clock.status is not None
    difop = helios.parse(helios.example("difop"), "difop")
    for mode in range(4):
        for status in (3, 4, 5, 8, 255):
            difop.time_sync_mode = mode
            difop.time_sync_status = status
            frames = helios.decode([helios.build("difop", difop)], "difop")
            value = frame_status(helios.clock.status, frames.table).item()
            assert helios.clock.status.state_of(value).locked is None
