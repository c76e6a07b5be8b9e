"""Tests of Ouster: real packets of six layouts, metadata, a simulated web server.

The vendor published digests and points of these packets.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.captures.pcap import CaptureReader
from lidarspec.detect.identification import identify_senders
from lidarspec.spec import Learned
from lidarspec_ouster import make_nominal_unit
from lidarspec_ouster.metadata import read_unit
from lidarspec_ouster.packets import ABSENT_CRCS, PROFILES, packet_bytes
from lidarspec_ouster.recognition import recognise
from tests.evidence import capture, decode, vector_bytes, vectors

OS0, OS1, OS2 = (ls.sensor(f"ouster-os{number}") for number in range(3))
#: capture, the metadata beside it, and the layout that packets alone tell.
CAPTURES = {
    "OS-0-32-U1_v2.2.0_1024x10": (
        "OS-0-32-U1_v2.2.0_1024x10",
        ("RNG19_RFL8_SIG16_NIR16_DUAL", 32, 1024),
    ),
    "OS-2-32-U0_v2.0.0_1024x10": ("OS-2-32-U0_v2.0.0_1024x10", ("LEGACY", 32, 1024)),
    "OS-1-128_v2.3.0_1024x10_lb_n3": ("OS-1-128_v2.3.0_1024x10", ("RNG15_RFL8_NIR8", 128, 1024)),
}
VECTORS = [
    "legacy_os1_32",
    "dual_os0_32",
    "rng15_os0_128",
    "single_os2_128",
    "crc64_rng15",
    "fusa_os1_128",
]
FILE = "vectors_udp3d.json"
TYPES = {"range": "u4", "signal": "u2", "near_ir": "u2", "reflectivity": "u1", "flags": "u1"}


@functools.cache
def payloads(path: Path) -> list[bytes]:
    with path.open("rb") as file:
        return [datagram.data for datagram in CaptureReader(file)]


def unit(name: str) -> tuple[ls.Sensor, list[bytes]]:
    """Return the sensor of a capture with its metadata, and the datagrams."""
    metadata = capture(f"ouster/{CAPTURES[name][0]}.json")
    return ls.sensor(f"ouster-os{name[3]}").configure(metadata=metadata), payloads(
        capture(f"ouster/{name}.pcap")
    )


def digest(values: Any) -> str:
    return hashlib.md5(np.ascontiguousarray(values).tobytes()).hexdigest()


def pixels(packets: ls.Packets, name: str) -> Any:
    """Return a field of the pixels in the vendor's type, (packets, rows, columns)."""
    return packets.raw["columns"]["pixels"][name].transpose(0, 2, 1).astype(TYPES[name.rstrip("2")])


@pytest.mark.parametrize("name", list(CAPTURES)[:2])
def test_every_field_has_the_digest_of_the_vendor(name: str) -> None:
    sensor, data = unit(name)
    packets = sensor.decode(data)
    digests = json.loads(capture(f"ouster/{name}_digest.json").read_text(encoding="utf-8"))[
        "packet_hash"
    ]
    columns = packets.raw["columns"]
    legacy = "encoder" in columns.dtype.names
    # The vendor's reader returns 0 if the columns have no frame number or encoder value.
    absent = np.zeros(columns.shape)
    status = columns["status"]
    if not legacy:
        status = 2 * status["reserved"] + status["valid"]
    found = {
        "TIMESTAMP": digest(columns["timestamp"].astype("u8")),
        "MEASUREMENT_ID": digest(columns["measurement_id"].astype("u2")),
        "STATUS": digest(status.astype("u4")),
        "FRAME_ID": digest((columns["frame_id"] if legacy else absent).astype("u2")),
        "ENCODER_COUNT": digest((columns["encoder"] if legacy else absent).astype("u4")),
    }
    # RAW32 are the words that contain the fields.
    names = [key for key in digests if key not in found and not key.startswith("RAW")]
    found |= {key: digest(pixels(packets, key.lower())) for key in names}
    assert found == {key: digests[key] for key in found}
    assert len(names) == (5 if legacy else 9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "backend", ("numpy", "jit") if importlib.util.find_spec("numba") else ("numpy",)
)
@pytest.mark.parametrize("name", CAPTURES)
def test_points_are_those_of_the_vendor(name: str, backend: str) -> None:
    sensor, data = unit(name)
    scan = next(sensor.scans(data, backend=backend))
    with np.load(capture(f"ouster/{name}.frame0.npz")) as expected:
        ranges, xyz = expected["RANGE"].T, expected["xyz"].transpose(1, 0, 2)
    shape = (*ranges.shape, -1)
    valid, points = (
        scan.points.valid.reshape(shape)[..., 0],
        scan.points.xyz.reshape(*shape, 3)[:, :, 0],
    )
    np.testing.assert_array_equal(valid, ranges > 0)
    np.testing.assert_allclose(points[valid], xyz[valid], rtol=0, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", CAPTURES)
def test_a_capture_is_read_whole(name: str) -> None:
    sensor, data = unit(name)
    packets = decode(sensor, data[:4] + data[-4:])
    assert packets.stats.bytes_skipped == 0
    stats = sensor.decode(data).stats
    assert (stats.frames["data"] + stats.frames.get("imu", 0), stats.bytes_skipped, stats.lost) == (
        len(data),
        0,
        0,
    )
    assert sensor.build("data", sensor.parse(data[0], "data")) == data[0]


@pytest.mark.parametrize("name", VECTORS)
def test_published_packets(name: str) -> None:
    vector, data = vectors(FILE)[f"ouster_{name}"], vector_bytes(FILE, f"ouster_{name}")
    params, expected = vector["params"], vector["expected"]
    assert packet_bytes(params["profile"], params["H"]) == len(data)
    sensor = OS0.configure(metadata=Learned(json.dumps(metadata_of(params)).encode()))
    packets = decode(sensor, [data])
    fields = packets.raw["columns"]["pixels"]
    shift = {"RANGE": 3, "RANGE2": 3, "NEAR_IR": 4} if "RNG15" in params["profile"] else {}
    sums = {
        key: int(fields[key.lower()].astype(np.int64).sum()) << shift.get(key, 0)
        for key in expected["sum"]
    }
    assert sums == expected["sum"]
    head = packets.raw if "init_id" in expected else packets.raw["columns"]
    assert {
        key: np.ravel(head[key])[0] for key in ("frame_id", "init_id", "serial") if key in expected
    } == {key: expected[key] for key in ("frame_id", "init_id", "serial") if key in expected}
    cloud = packets.points()
    xyz = cloud.xyz.reshape(16, params["H"], -1, 3)[:, :, 0]
    for point in expected["first"]:
        np.testing.assert_allclose(xyz[point["mid"], point["row"]], point["xyz"], atol=6e-4)


def metadata_of(params: dict[str, Any]) -> dict[str, Any]:
    """Return the parameters of a vector as a metadata file."""
    beam = [1, 0, 0, params["n"], 0, 1, 0, 0, 0, 0, 1, params["nz"], 0, 0, 0, 1]
    layout = {
        "columns_per_frame": params["W"],
        "columns_per_packet": params["columns_per_packet"],
        "udp_profile_lidar": params["profile"],
    }
    angles = {
        "beam_altitude_angles": params["alt"],
        "beam_azimuth_angles": params["az"],
        "beam_to_lidar_transform": beam,
    }
    return {
        "lidar_data_format": layout,
        "beam_intrinsics": angles,
        "lidar_intrinsics": {"lidar_to_sensor_transform": params["l2s"]},
    }


def test_bits_of_every_profile_match_the_table() -> None:
    vectors(FILE)
    table = json.loads(
        (capture("ouster").parents[1] / "protocols" / "tables_udp3d.json").read_text(
            encoding="utf-8"
        )
    )["ouster"]["profiles"]
    assert set(table) == set(PROFILES)
    names = {"red": "R", "green": "G", "blue": "B"}
    for profile, bits in PROFILES.items():
        spots = np.cumsum([0, *bits.values()]).tolist()
        stand = {
            names.get(name, name.upper()): [spot, width]
            for (name, width), spot in zip(bits.items(), spots, strict=False)
            if name[0] != "_"
        }
        listed = table[profile]["fields_bit_offset_bits_leftshift"]
        assert stand == {name: place[:2] for name, place in listed.items() if name != "RGB"}
        assert spots[-1] == 8 * table[profile]["bytes_per_pixel"]


def test_a_wrong_crc_is_rejected_and_an_absent_one_accepted() -> None:
    checksummed = vector_bytes(FILE, "ouster_crc64_rng15")
    sensor = OS0.configure(rows=128, turn=512, profile="RNG15_RFL8_NIR8")
    damaged = checksummed[:100] + bytes([checksummed[100] ^ 1]) + checksummed[101:]
    assert len(sensor.decode([checksummed])) == 1
    assert len(sensor.decode([damaged])) == 0
    for crc in ABSENT_CRCS:
        assert len(sensor.decode([damaged[:-8] + crc.to_bytes(8, "little")])) == 1


def test_the_imu_by_the_published_packet() -> None:
    vector = vectors(FILE)["ouster_imu_legacy"]
    felt = OS0.decode([bytes.fromhex(vector["hex"])], "imu").imu()
    assert felt.time_ns.tolist() == [vector["expected"]["gyro_ts"]]
    np.testing.assert_allclose(
        felt.linear_acceleration[0] / 9.80665, vector["expected"]["acc_g"], atol=1e-6
    )
    np.testing.assert_allclose(
        np.rad2deg(felt.angular_velocity[0]), vector["expected"]["gyro_dps"], atol=1e-6
    )


def test_lost_and_invalid_columns_leave_gaps() -> None:
    sensor = OS1.configure(rows=16, turn=512)
    packets = simulate(sensor, 32)
    parsed = sensor.parse(packets[5], "data")
    parsed.columns[3].status.valid = 0
    packets[5] = sensor.build("data", {**parsed, "crc": None})
    cloud = sensor.decode([*packets[:2], *packets[3:]]).points().organise(512)
    valid = cloud.valid.reshape(cloud.shape)
    missing = {*range(32, 48), 83}
    assert cloud.shape == (512, 16)
    assert set(np.flatnonzero(~valid.any(axis=1)).tolist()) == missing
    assert valid[sorted(set(range(512)) - missing)].all()


@pytest.mark.slow
def test_packets_identify_their_layout() -> None:
    for name, (_, layout) in CAPTURES.items():
        found = identify_senders(capture(f"ouster/{name}.pcap"))[0]
        options = found.candidates[0].sensor.options
        assert (options["profile"], options["rows"], options["turn"]) == layout
        assert f"profile={layout[0]}, rows={layout[1]}, turn=1024" in found.candidates[0].evidence


@pytest.mark.parametrize("name", VECTORS)
def test_one_packet_identifies_its_layout(name: str) -> None:
    params = vectors(FILE)[f"ouster_{name}"]["params"]
    assert recognise([vector_bytes(FILE, f"ouster_{name}")]) == {
        "profile": params["profile"],
        "rows": params["H"],
        "turn": params["W"],
    }


@pytest.mark.parametrize("data", [b"", bytes(8448), b"\x01" + bytes(8447), bytes(6464)])
def test_length_alone_does_not_identify_a_packet(data: bytes) -> None:
    assert recognise([data]) == {}


@pytest.mark.slow
@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_is_simulated_and_read(profile: str) -> None:
    sensor = OS2.configure(rows=16, turn=512, profile=profile)
    packets = decode(sensor, simulate(sensor, 2))
    cloud = packets.points()
    assert (len(packets), cloud.shape) == (2, (32, 16))
    assert cloud.nominal
    assert cloud.valid.all()


@pytest.mark.slow
def test_metadata_are_learned_from_the_web_server_of_a_simulated_sensor() -> None:
    with ls.open("sim:ouster-os1") as device:
        assert not device.latest(timeout=30).points.nominal
        assert set(device.learned) == {"metadata"}
        assert device.sensor.on_open == ()


def test_older_and_newer_metadata_are_equivalent(tmp_path: Path) -> None:
    made = dataclasses.replace(
        make_nominal_unit("OS1", 16, 512, "LEGACY"), nominal=False, serial="7"
    )
    sections = json.loads(made.to_metadata())
    flat = {key: value for section in sections.values() for key, value in section.items()}
    flat["data_format"] = {key: flat.pop(key) for key in sections["lidar_data_format"]}
    for name, data in (("new", sections), ("old", flat)):
        (tmp_path / name).write_text(json.dumps(data))
    new, old = read_unit(tmp_path / "new"), read_unit(tmp_path / "old")
    assert new.to_metadata() == old.to_metadata() == made.to_metadata()
    assert (
        OS1.configure(metadata=tmp_path / "old").configure(frame="vendor").frames["data"]
        is OS1.configure(metadata=tmp_path / "new").frames["data"]
    )


def test_keys_are_read_from_whichever_section_has_them(tmp_path: Path) -> None:
    unit = dataclasses.replace(make_nominal_unit("OS1", 16, 512, "RNG15_RFL8_NIR8"), samples=8)
    data = json.loads(unit.to_metadata())
    data["imu_data_format"] = {
        "imu_measurements_per_packet": data["lidar_data_format"].pop("imu_measurements_per_packet")
    }
    (tmp_path / "unit.json").write_text(json.dumps(data))
    assert read_unit(tmp_path / "unit.json").samples == 8


@pytest.mark.parametrize(
    ("product", "distance_mm"),
    [
        ("OS-0-128", 27.67),
        ("OS-1-64", 15.806),
        ("OS-2-32-U0", 13.762),
        ("", 12.163),
        ("OS1", 12.163),
    ],
)
def test_missing_offsets_are_those_of_the_model_and_nominal(
    tmp_path: Path, product: str, distance_mm: float
) -> None:
    """The expected values are the defaults of ouster-sdk (sensor_info.cpp, metadata.cpp)."""
    data = json.loads(make_nominal_unit("OS1", 16, 512, "LEGACY").to_metadata())
    data["sensor_info"]["prod_line"] = product
    del data["beam_intrinsics"]["beam_to_lidar_transform"]
    del data["lidar_intrinsics"]
    (tmp_path / "unit.json").write_text(json.dumps(data))
    unit = read_unit(tmp_path / "unit.json")
    assert unit.nominal
    assert unit.beam[0, 3] == distance_mm
    assert unit.lidar.tolist() == [[-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 36.18], [0, 0, 0, 1]]


def test_imu_measurements_come_in_si_units() -> None:
    """Captured values of ACCEL32_GYRO32_NMEA are multiples of 9.80665/2048 and (pi/180)/16.4."""
    unit = dataclasses.replace(make_nominal_unit("OS1", 16, 512, "RNG15_RFL8_NIR8"), samples=2)
    sensor = OS1.configure(metadata=Learned(unit.to_metadata()))
    gravity = 2048 * 9.80665 / 2048
    rate = 164 * np.deg2rad(1) / 16.4
    measurement = {f"{name}_{axis}": 0.0 for name in ("acceleration", "gyro") for axis in "xyz"}
    measurement |= {
        "timestamp": 0,
        "measurement_id": 0,
        "status": 0,
        "acceleration_z": gravity,
        "gyro_x": rate,
    }
    values = sensor.parse(sensor.example("imu"), "imu")
    samples = sensor.decode(
        [sensor.build("imu", {**values, "samples": [measurement] * 2})], "imu"
    ).imu()
    np.testing.assert_allclose(samples.linear_acceleration, [[0, 0, 9.80665]] * 2, atol=1e-5)
    np.testing.assert_allclose(samples.angular_velocity, [[np.deg2rad(10), 0, 0]] * 2, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"beam_altitude_angles": None}, "beam_altitude_angles is missing"),
        ({"beam_azimuth_angles": [1, 2]}, "beam_azimuth_angles has 2 numbers, expected 16"),
        (
            {"beam_azimuth_angles": [float("nan")] * 16},
            "beam_azimuth_angles must be a list of numbers",
        ),
        ({"columns_per_frame": 1 << 40}, "columns_per_frame must be from 1 to 4096"),
        ({"columns_per_frame": 500}, "500 is not a multiple of columns_per_packet"),
        ({"pixels_per_column": 32}, "has 16 angles, expected 32"),
        ({"udp_profile_lidar": "RNG99"}, "RNG99 is not supported"),
        ({"lidar_to_sensor_transform": [1, 2]}, "lidar_to_sensor_transform has 2 numbers"),
        ({"prod_line": "OS-0-32"}, "those of an OS-0-32: use -s ouster-os0"),
    ],
)
def test_metadata_that_cannot_be_are_refused_by_name(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    data = {
        key: value
        for section in json.loads(
            make_nominal_unit("OS1", 16, 512, "LEGACY").to_metadata()
        ).values()
        for key, value in section.items()
    }
    (tmp_path / "unit.json").write_text(json.dumps({**data, **change}))
    with pytest.raises(ls.UsageError, match=message):
        OS1.configure(metadata=tmp_path / "unit.json")


@pytest.mark.parametrize(
    "options",
    [
        {"rows": 8},
        {"rows": 1 << 20},
        {"turn": 500},
        {"profile": "RNG99"},
        {"metadata": "x", "rows": 16},
    ],
)
def test_layouts_that_there_are_not_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ls.UsageError):
        OS1.configure(**options)


def test_a_layout_beside_metadata_is_refused_by_name() -> None:
    with pytest.raises(ls.UsageError, match="because the metadata contain rows and turn"):
        OS1.configure(metadata="unit.json", rows=16, turn=512)


def test_metadata_say_what_the_clock_counts(tmp_path: Path) -> None:
    metadata = json.loads(make_nominal_unit("OS1", 32, 512, "LEGACY").to_metadata())
    metadata["config_params"]["timestamp_mode"] = "TIME_FROM_PTP_1588"
    path = tmp_path / "os1.json"
    path.write_text(json.dumps(metadata))
    sensor = ls.sensor("ouster-os1").configure(metadata=path)
    assert sensor.clock is not None
    assert sensor.clock.epoch == "tai"
    told = sensor.configure(epoch="utc").configure(metadata=path)
    assert told.clock is not None
    assert told.clock.epoch == "utc"
