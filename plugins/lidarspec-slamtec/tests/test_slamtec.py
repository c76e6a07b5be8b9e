"""Tests of RPLIDAR A1, A3, S2 and C1: vectors, calculated points and commands."""

from __future__ import annotations

import math
import pickle
import random
import zlib
from typing import Any

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.errors import OutOfRange
from lidarspec.frames.row_checksums import compute_checksums
from lidarspec.framing.frame_engine import get_codec
from tests.evidence import assert_points, clockwise, decode, vector_bytes, vectors

from .rplidar import make_node_sensor

FILE = "vectors_serial2d.json"
A1, A3, S2, C1 = (ls.sensor(f"slamtec-rplidar-{name}") for name in ("a1", "a3", "s2", "c1"))

WHOLE = {
    "rp_req_express": "express_request",
    "rp_req_express_mode3": "express_request",
    "rp_req_conf71_mode3": "mode_config_request",
    "rp_devinfo_a1": "info",
    "rp_health_ok": "health",
    "rp_conf_us": "config",
    "rp_conf_maxdist": "config",
    "rp_conf_anstype": "config",
    "rp_conf_name": "config",
    "rp_desc_scan": "scan_descriptor",
    "rp_desc_express": "express_descriptor",
    "rp_desc_ultra": "ultra_descriptor",
    "rp_desc_ultradense": "ultra_dense_descriptor",
    "rp_node_synth": "node",
}
PAIRS = {"rp_capsule_pair_synth": "express", "rp_ultra_pair_synth": "ultra"}
EXCERPTS = {"rp_varbit"}

#: where the vectors name something otherwise than the fields do.
FIELDS = {
    "length": "descriptor.length",
    "mode": "descriptor.mode",
    "fw_minor": "firmware_minor",
    "fw_major": "firmware_major",
    "hw": "hardware",
    "conf_type": "key",
    "us_per_sample": "value.us_per_sample",
    "max_distance_m": "value.max_distance",
    "ans_type": "value.answer_type",
    "sync": "head.start",
    "quality": "head.quality",
    "check": "beam.check",
    "angle_deg": "beam.angle",
}


def test_every_vector_of_the_family_is_used() -> None:
    assert {
        name for name in vectors(FILE) if name.startswith("rp_")
    } == WHOLE.keys() | PAIRS.keys() | EXCERPTS


@pytest.mark.parametrize(("name", "frame"), WHOLE.items())
def test_a_vector_parses_and_builds(name: str, frame: str) -> None:
    data = vector_bytes(FILE, name)
    parsed = A1.parse(data)
    assert parsed == A1.parse(data, frame=frame)
    assert A1.build(frame, parsed) == data
    for key, expected in vectors(FILE)[name]["expected"].items():
        if key in ("checksum_ok", "sync_ok", "name", "dist_mm"):
            continue
        assert physical(frame, parsed, FIELDS.get(key, key)) == expected, key


def physical(frame: str, parsed: Any, path: str) -> Any:
    """Return a field of a parsed frame in its unit."""
    info = get_codec(A1.frames[frame]).schema.fields[path]
    for name in path.split("."):
        parsed = parsed[name]
    return parsed * info.scale + info.offset


def test_the_name_of_a_mode_is_text() -> None:
    assert A1.parse(vector_bytes(FILE, "rp_conf_name")).value.data == b"Sensitivity\x00"


@pytest.mark.parametrize(("name", "answer"), PAIRS.items())
def test_a_pair_of_capsules_has_the_expected_points(name: str, answer: str) -> None:
    data, expected = vector_bytes(FILE, name), vectors(FILE)[name]["expected"]
    cloud = decode(A1.configure(answer=answer), data).points()
    number = expected["n"]
    metres = np.array(expected["dist_mm"]) / 1000
    np.testing.assert_allclose(
        cloud.range[:number], np.where(metres == 0, np.inf, metres), atol=1e-6
    )
    if "angle_deg" in expected:
        np.testing.assert_allclose(clockwise(cloud)[:number], expected["angle_deg"], atol=2e-5)
    assert cloud.valid[:number].sum() == np.count_nonzero(metres)
    assert not cloud.valid[number:].any()  # the second one waits for a third


def test_the_scale_of_ultra_capsules() -> None:
    expected = vectors(FILE)["rp_varbit"]["expected"]["v"]
    for code, millimetres in zip(
        np.frombuffer(vector_bytes(FILE, "rp_varbit"), "<u2").tolist(), expected, strict=True
    ):
        cabins = [{"major": code, "predict1": 0, "predict2": 511}] * 32
        data = b"".join(
            A1.build("ultra", start={"angle": angle, "sync": 0}, cabins=cabins)
            for angle in (0, 640)
        )
        cloud = A1.configure(answer="ultra").decode(data).points()
        np.testing.assert_allclose(
            cloud.range[:3], [millimetres / 1000, millimetres / 1000, np.inf], rtol=1e-6
        )


def test_a_node_by_hand() -> None:
    # bd: quality bd >> 2 = 47, !S 0, S 1.   1681: >> 1 = 2880, / 64 = 45 degrees clockwise.   0fa0
    # = 4000 quarters of a millimetre.
    cloud = decode(make_node_sensor(1), bytes.fromhex("bd8116a00f")).points()
    assert_points(cloud, [(0, (math.sqrt(0.5), -math.sqrt(0.5), 0))])
    assert cloud.intensity is not None
    assert cloud.intensity.tolist() == [47]


def test_dense_capsules_by_hand() -> None:
    # Start angles 80 and 100 degrees, 40 points: half a degree apart. Point 20 is at 90 degrees
    # clockwise, 2.5 m: to the right.
    distances = [1000] * 20 + [2500] + [0] * 19
    data = b"".join(
        S2.build("dense", start={"angle": angle * 64, "sync": 0}, distances=distances)
        for angle in (80, 100)
    )
    cloud = decode(S2.configure(answer="dense"), data).points()
    assert_points(
        cloud,
        [(20, (0, -2.5, 0)), (0, (math.cos(math.radians(80)), -math.sin(math.radians(80)), 0))],
    )
    assert cloud.range[21] == np.inf
    assert cloud.valid.sum() == 21


def test_ultra_dense_capsules_by_hand() -> None:
    # A step of 2 degrees: 0, 2, 4 ... from 350 on. One of each scale, with 18 bits of code above
    # it:
    #   scale 0: code 3 << 10 | 500: 500 * 2 = 1000 mm, quality 3.         scale 1: 3 << 11 | 651:
    # 651 * 3 + 2046 = 3999 mm, quality 3 << 1.
    #   scale 2: 3 << 12 | 453: 453 * 4 + 8187 = 9999 mm, quality 3 << 2.  scale 3: 3 << 13 | 86: 86
    # * 5 + 24567 = 24997 mm, quality 3 << 3.
    codes = [3 << 10 | 500, 3 << 11 | 651, 3 << 12 | 453, 3 << 13 | 86]
    cabins = [cabin(codes[0], 0, codes[1], 1), cabin(codes[2], 2, codes[3], 3)] + [
        cabin(0, 0, 0, 0)
    ] * 30
    data = b"".join(
        S2.build(
            "ultra_dense",
            time_stamp=0,
            status=0,
            start={"angle": angle * 64, "sync": 0},
            cabins=cabins,
        )
        for angle in (350, 118)
    )
    cloud = decode(S2.configure(answer="ultra_dense"), data).points()
    np.testing.assert_allclose(cloud.range[:5], [1.0, 3.999, 9.999, 24.997, np.inf], rtol=1e-6)
    np.testing.assert_allclose(clockwise(cloud)[:6], [350, 352, 354, 356, 358, 0], atol=2e-5)
    assert cloud.intensity is not None
    assert cloud.intensity[:4].tolist() == [3, 6, 12, 24]


def cabin(first: int, first_scale: int, second: int, second_scale: int) -> dict[str, int]:
    """Return a cabin of an ultra-dense capsule from two 18-bit codes and their scales."""
    return {
        "first_low": first & 0x3FFF,
        "first_high": first >> 14,
        "first_scale": first_scale,
        "second_low": second & 0x3FFF,
        "second_high": second >> 14,
        "second_scale": second_scale,
    }


def test_an_ultra_capsule_by_hand() -> None:
    # Majors 0 and 1000 (1000: 512 + 488 * 2 = 1488 mm, a step of 2). Cabin 0 has none of its own:
    # both predictions go by the next.
    #   1488 + 3 * 2 = 1494 mm and 1488 - 5 * 2 = 1478 mm; cabin 1: 1488 mm, none, none.
    # Directions: starts 10 and 29.2 degrees, 96 points: 0.2 degrees apart. 1494 mm: 98361 / 5976 =
    # 16; 8 degrees less
    #   (16 * 64 + 4096 / 98304) / 65536 rad = 0.8953 degrees: 7.1047. 10.2 - 7.1047 = 3.0953.
    cabins = [
        {"major": 0, "predict1": 3, "predict2": -5},
        {"major": 1000, "predict1": 511, "predict2": -512},
    ]
    cabins += [{"major": 0, "predict1": 511, "predict2": 511}] * 30
    starts = [{"angle": round(degrees * 64), "sync": 0} for degrees in (10, 29.203125)]
    cloud = decode(
        A3.configure(answer="ultra"),
        b"".join(A3.build("ultra", start=start, cabins=cabins) for start in starts),
    ).points()
    np.testing.assert_allclose(
        cloud.range[:6], [np.inf, 1.494, 1.478, 1.488, np.inf, np.inf], rtol=1e-6
    )
    np.testing.assert_allclose(clockwise(cloud)[1], 10 + 19.203125 / 96 - 7.1047, atol=1e-4)


def test_an_hq_capsule_by_hand() -> None:
    # Angle 4096: 4096 * 90 / 16384 = 22.5 degrees. The CRC-32 of zlib over 777 bytes and three
    # zeros.
    points = [
        {"angle": 4096, "distance": 8000, "quality": 20, "flag": {"reserved": 0, "start": 1}}
    ] + [{"angle": 0, "distance": 0, "quality": 0, "flag": {"reserved": 0, "start": 0}}] * 95
    data = A3.build("hq", time_stamp=5, nodes=points)
    assert len(data) == 781
    assert int.from_bytes(data[-4:], "little") == zlib.crc32(data[:-4] + bytes(3))
    cloud = decode(A3.configure(answer="hq"), data).points()
    assert_points(cloud, [(0, (2 * math.cos(math.pi / 8), -2 * math.sin(math.pi / 8), 0))])
    assert cloud.valid.tolist() == [True] + [False] * 95
    wrong = data[:9] + bytes([data[9] ^ 1]) + data[10:]
    assert A3.configure(answer="hq").decode(wrong).stats.bad_checksum == 1


def test_the_padded_checksum_of_a_batch() -> None:
    algorithm = A1.frames["hq"].struct.algorithm
    rows = np.frombuffer(random.Random(3).randbytes(40 * 777), np.uint8).reshape(40, 777)
    assert compute_checksums(algorithm, rows).tolist() == [
        zlib.crc32(row.tobytes() + bytes(3)) for row in rows
    ]
    assert algorithm(b"1234") == zlib.crc32(b"1234")


def test_the_compensation_of_express_capsules_signed_or_not() -> None:
    empty = {
        "first": {"distance": 1000, "dtheta_high": 2},
        "second": {"distance": 1000, "dtheta_high": 0},
    }
    # 101000: 40, or -24; 001000: 8.
    cabins = [{**empty, "dtheta_low": {"first": 8, "second": 8}}] * 16
    data = b"".join(
        A1.build("express", start={"angle": angle * 64, "sync": 0}, cabins=cabins)
        for angle in (100, 132)
    )
    sensor = A1.configure(answer="express")
    np.testing.assert_allclose(
        clockwise(decode(sensor, data).points())[:2], [100 - 5, 101 - 1], atol=1e-4
    )
    signed = sensor.configure(dtheta="signed")
    np.testing.assert_allclose(
        clockwise(decode(signed, data).points())[:2], [100 + 3, 101 - 1], atol=1e-4
    )
    for also in (signed.configure(mode=3), pickle.loads(pickle.dumps(signed))):
        np.testing.assert_allclose(
            clockwise(also.decode(data).points())[:2], [100 + 3, 101 - 1], atol=1e-4
        )
    with pytest.raises(ls.UsageError, match="unsigned"):
        A1.configure(dtheta="both")


@pytest.mark.parametrize(
    "command", ["stop", "reset", "scan", "force_scan", "get_info", "get_health", "get_samplerate"]
)
def test_requests_without_payload(command: str) -> None:
    codes = {
        "stop": 0x25,
        "reset": 0x40,
        "scan": 0x20,
        "force_scan": 0x21,
        "get_info": 0x50,
        "get_health": 0x52,
        "get_samplerate": 0x59,
    }
    assert A1.command(command) == bytes([0xA5, codes[command]])


def test_requests_with_payload() -> None:
    assert A1.command("express_scan", mode=0) == vector_bytes(FILE, "rp_req_express")
    assert A1.command("express_scan", mode=3) == vector_bytes(FILE, "rp_req_express_mode3")
    assert A1.command("get_us_per_sample", mode=3) == vector_bytes(FILE, "rp_req_conf71_mode3")
    assert (
        A1.command("get_config", key=0x7C)
        == A1.command("get_typical_mode")
        == bytes.fromhex("a584047c00000059")
    )
    assert A3.command("start_motor") == bytes.fromhex("a5f002 9402 c1")  # 660 of 1023
    assert (
        S2.command("motor_speed", speed=600)
        == S2.command("start_motor")
        == bytes.fromhex("a5a802 5802 55")
    )
    assert A3.command("get_accessory") == bytes.fromhex("a5ff04 00000000 5e")
    with pytest.raises(OutOfRange):
        A3.command("motor_duty", duty=1024)


def test_the_motor_of_an_a1_runs_while_dtr_is_low() -> None:
    assert A1.command("start_motor") == b""
    assert dict(A1.commands["start_motor"].lines) == {"dtr": False}
    assert dict(A1.commands["stop_motor"].lines) == {"dtr": True}


def test_opening_starts_the_scan_mode_that_was_configured() -> None:
    assert A1.on_open == ("stop", "start_motor", "scan")
    sensor = A1.configure(answer="ultra", mode=3)
    assert sensor.command(sensor.on_open[-1]) == A1.command("express_scan", mode=3)
    with pytest.raises(ls.UsageError):
        A1.configure(mode=256)


def test_bauds_of_the_models() -> None:
    bauds = {sensor.id[-2:]: sensor.links["data"].baud for sensor in (A1, A3, S2, C1)}  # type: ignore[union-attr]
    assert bauds == {"a1": 115_200, "a3": 256_000, "s2": 1_000_000, "c1": 460_800}
