"""Tests of SICK TiM871S (CoLa B), TiM5xx (CoLa A) and multiScan136."""

from __future__ import annotations

import struct
from dataclasses import replace

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.detect.identification import identify_sample
from lidarspec.detect.sample_bytes import SampleBytes
from lidarspec.errors import CommandError, UsageError
from tests.evidence import capture, decode, vector_bytes, vectors

LMS511 = ls.sensor("sick-lms511")
TIM871S, TIM551 = ls.sensor("sick-tim871s"), ls.sensor("sick-tim551")
MRS1104, MULTISCAN = ls.sensor("sick-mrs1104"), ls.sensor("sick-multiscan136")


def telegrams() -> list[bytes]:
    """Return the datagrams of the multiScan capture.

    The file contains each datagram after its length.
    """
    data, found, start = (
        capture("sick/multiscan_compact_test01_udp_scandata.telegrams.bin").read_bytes(),
        list[bytes](),
        0,
    )
    while start < len(data):
        size = struct.unpack_from("<I", data, start)[0]
        found.append(data[start + 4 : start + 4 + size])
        start += 4 + size
    return found


@pytest.mark.slow
def test_every_scan_of_a_tim871s_is_read() -> None:
    data = capture("sick/20210113_tim871s_elephant.tcpstream.bin").read_bytes()
    packets = TIM871S.decode(data)
    cloud = packets.points()
    assert (packets.stats.frames["scan"], packets.stats.lost, len(cloud)) == (150, 0, 150 * 811)
    raw = np.frombuffer(data, ">u2", 811, data.index(b"DIST1") + 21)
    np.testing.assert_allclose(cloud.range[:811][raw >= 50], raw[raw >= 50] * 0.001, atol=1e-6)
    np.testing.assert_allclose(
        cloud.azimuth[:811], np.deg2rad(-135 + 0.3333 * np.arange(811)), atol=1e-5
    )
    np.testing.assert_array_equal(cloud.valid[:811], raw >= 50)
    assert len(list(TIM871S.scans(data))) == 150
    named = {one.sensor.id for one in identify_sample(SampleBytes("", (data,))).candidates}
    assert named == {"sick-tim561", "sick-tim571", "sick-tim781", "sick-tim781s", "sick-tim871s"}


def test_bad_headers_are_counted_equally_for_all_chunk_sizes() -> None:
    source = np.random.default_rng(1)
    data = b"".join(b"\x02\x02\x02\x02" + source.bytes(4) + b"sAN LMCstopmeas " for _ in range(40))
    counted = list[ls.Counters]()
    for size in (len(data), 333, 1):
        decoder = LMS511.decoder()
        for start in range(0, len(data), size):
            decoder.feed(data[start : start + size])
        decoder.finish()
        counted.append(decoder.stats)
    assert counted[0].bad_length > 0
    assert counted[1:] == counted[:1] * 2


def test_a_telegram_in_text_is_read_and_built_again() -> None:
    data = vector_bytes("vectors_serial2d.json", "sick_tim_sra")
    cloud = decode(TIM551, data).points()
    assert TIM551.build("text", TIM551.parse(data)) == data
    np.testing.assert_allclose(cloud.range[:4], [0.278, 0.288, 0.291, 0.285], atol=1e-6)
    np.testing.assert_allclose(cloud.azimuth, np.deg2rad(np.arange(271) - 135.0), atol=1e-5)
    assert cloud.intensity is not None
    tokens = data.split(b" ")
    assert cloud.intensity.tolist() == [
        int(token, 16) for token in tokens[tokens.index(b"RSSI1") + 6 :][:271]
    ]


def test_telegrams_with_and_without_strengths() -> None:
    data = vector_bytes("vectors_serial2d.json", "sick_tim_sra")
    values = TIM551.parse(data)
    bare = TIM551.build("text", {**values, "channels8": 0, "rssi1_8bit": None})
    cloud = decode(TIM551, data + bare).points()
    assert cloud.intensity is not None
    assert cloud.intensity[271:].tolist() == [0] * 271
    np.testing.assert_array_equal(cloud.range[271:], cloud.range[:271])


@pytest.mark.slow
@pytest.mark.parametrize("cola", ["A", "B"])
@pytest.mark.parametrize(
    ("name", "echoes"),
    [("sick-lms111", 2), ("sick-lms511", 3), ("sick-lms511", 5), ("sick-mrs1104", 3)],
)
def test_any_number_of_echoes_is_read_with_their_strengths(
    name: str, echoes: int, cola: str
) -> None:
    sensor = ls.sensor(name).configure(cola=cola, echoes=echoes)
    frame = "echoes_text" if cola == "A" else "echoes"
    values = sensor.parse(ls.simulate(sensor, 1)[0])
    first, beams = dict(values.dist1), values.dist1.count
    for number in range(1, echoes + 1):
        values[f"dist{number}"] = {
            **first,
            "content": f"DIST{number}".encode(),
            "samples": [1000 * number] * beams,
        }
        values[f"rssi{number}"] = {
            **first,
            "content": f"RSSI{number}".encode(),
            "samples": [10 * number] * beams,
        }
        values[f"rssi{number}_8bit"] = None
    data = sensor.build(frame, {**values, "channels": 2 * echoes, "channels8": 0})
    packets = sensor.decode(data * 2)
    cloud = packets.points()
    assert dict(packets.stats.frames) == {frame: 2}
    assert cloud.intensity is not None
    assert cloud.return_index is not None
    assert cloud.range[:echoes].tolist() == list(range(1, echoes + 1))
    assert cloud.intensity[:echoes].tolist() == [10 * number for number in range(1, echoes + 1)]
    assert cloud.return_index[:echoes].tolist() == list(range(echoes))
    with pytest.raises(UsageError, match="echoes must be a number from 1 to"):
        sensor.configure(echoes=6)


@pytest.mark.parametrize("cola", ["A", "B"])
@pytest.mark.parametrize("bits", [0, 8, 16])
@pytest.mark.parametrize(
    "echoes", [1, 2, *(pytest.param(echoes, marks=pytest.mark.slow) for echoes in (3, 4, 5))]
)
def test_strengths_come_in_8_or_16_bits_or_not_at_all(echoes: int, bits: int, cola: str) -> None:
    sensor = LMS511.configure(cola=cola, echoes=echoes)
    frame = sensor.data_frames[0] if echoes == 1 else {"A": "echoes_text", "B": "echoes"}[cola]
    channel = {"scale": 1.0, "offset": 0.0, "start": -50_000, "step": 5000, "count": 2}
    values = sensor.parse(sensor.example(frame), frame)
    for number in range(1, echoes + 1):
        values[f"dist{number}"] = {**channel, "samples": [1000 * number, 1000 * number + 1]}
        strengths = {**channel, "samples": [10 * number, 10 * number + 1]}
        values[f"rssi{number}"] = strengths if bits == 16 else None
        values[f"rssi{number}_8bit"] = strengths if bits == 8 else None
    for name in ("position", "name", "comment", "date", "event"):
        values |= {f"has_{name}": 0, name: None}
    values |= {
        "channels": echoes * (2 if bits == 16 else 1),
        "channels8": echoes if bits == 8 else 0,
    }
    values |= {"encoder_count": 0, "encoders": [], "scan_rate": 5000, "beam_rate": 360}
    data = sensor.build(frame, values)
    assert sensor.build(frame, sensor.parse(data, frame)) == data
    packets = sensor.decode(data * 2, frame)
    assert dict(packets.stats.frames) == {frame: 2}
    cloud = packets.points()
    np.testing.assert_allclose(cloud.range[:echoes], np.arange(1, echoes + 1))
    assert cloud.intensity is not None
    assert cloud.intensity[:echoes].tolist() == [
        10 * number if bits else 0 for number in range(1, echoes + 1)
    ]


@pytest.mark.parametrize("cola", ["A", "B"])
def test_a_refusal_is_reported_at_once_in_words(cola: str) -> None:
    sensor = TIM551.configure(cola=cola)
    if cola == "A":
        assert sensor.parse(b"\x02sFA 3\x03", "refused").error.name == "variable_unknown"
    refused = (("refused", {"error": 4}),)
    sensor = replace(
        sensor,
        simulation=replace(
            sensor.simulation, answers={**sensor.simulation.answers, "set_range": refused}
        ),
    )
    with ls.open("sim:", sensor) as device:
        with pytest.raises(
            CommandError,
            match=r"set_range: the sensor refused the command: error value_not_allowed \(4\)$",
        ):
            device.send("set_range", timeout=60, step=0.5, start=0, stop=90)
        assert device.send("get_state", timeout=60).confirmed


def test_every_telegram_of_a_multiscan_is_read() -> None:
    data = telegrams()
    packets = MULTISCAN.decode(data)
    cloud = packets.points()
    assert (dict(packets.stats.frames), len(cloud)) == ({"scan": 66, "imu": 28}, 59_400)
    assert [len(scan) for scan in MULTISCAN.scans(data) if scan.complete] == [10_800] * 5
    assert (
        9.5
        < np.median(np.linalg.norm(MULTISCAN.decode(data, "imu").imu().linear_acceleration, axis=1))
        < 10.1
    )


def test_multiscan_imu_samples_equal_published_values() -> None:
    expected = vectors("vectors_udp3d.json")["sick_imu"]["expected"]
    packets = MULTISCAN.decode([vector_bytes("vectors_udp3d.json", "sick_imu")], "imu")
    samples, orientation = packets.imu(), [packets[f"orientation_{axis}"][0] for axis in "wxyz"]
    assert samples.linear_acceleration[0].tolist() == pytest.approx(expected["acc"])
    assert samples.angular_velocity[0].tolist() == pytest.approx([0.01, 0.02, 0.03])
    assert (orientation, packets.time_ns.tolist()) == (
        expected["quat_wxyz"],
        [expected["ts_us"] * 1000],
    )


@pytest.mark.parametrize(
    "name", ["sick_compact_estmultiscan2layerscompactv4", "sick_compact_unittestcompactv4"]
)
def test_modules_of_a_multiscan_are_those_published(name: str) -> None:
    data, expected = (
        vector_bytes("vectors_udp3d.json", name),
        vectors("vectors_udp3d.json")[name]["expected"],
    )
    parsed = MULTISCAN.parse(data)
    assert MULTISCAN.build("scan", parsed) == data
    decode(MULTISCAN, [data])
    for module, known in zip(parsed.modules, filter(None, expected["modules"]), strict=False):
        assert (module.segment, module.turn, module.beam_count) == (
            known["segment"],
            known["frame"],
            known["beams"],
        )
        for beam in known["first"]:
            found = module.beams[beam["beam"]][beam["layer"]]
            assert [[echo.distance, echo.strength] for echo in found.echoes] == beam["echoes"]
            assert (found.property.reflector, found.azimuth) == (beam["prop"], beam["az_raw"])


def test_a_turn_of_an_mrs1000_is_four_layers() -> None:
    whole = [scan for scan in MRS1104.scans(b"".join(ls.simulate(MRS1104, 13))) if scan.complete]
    assert [len(scan) for scan in whole] == [4 * 1101] * 2
    assert sorted({float(angle) for angle in np.rad2deg(whole[0].points.elevation).round(2)}) == [
        -2.5,
        0.0,
        2.5,
        5.0,
    ]


def test_a_cola_a_scanner_gets_text_requests() -> None:
    text = TIM551.configure(cola="A")
    assert text.command("start") == b"\x02sEN LMDscandata 1\x03"
    assert text.command("login") == b"\x02sMN SetAccessMode 3 F4724744\x03"
    with pytest.raises(ls.UsageError, match="'A' or 'B'"):
        TIM551.configure(cola="C")
