"""Tests of YDLIDAR: the protocol's examples, packets of three models, detection."""

from __future__ import annotations

import json

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.detect.identification import find_contradiction, identify_sample
from lidarspec.detect.sample_bytes import SampleBytes
from tests.evidence import capture, clockwise, decode, vector_bytes, vectors

FILE = "vectors_serial2d.json"
X4, TG15, G4B = ls.sensor("ydlidar-x4"), ls.sensor("ydlidar-tg15"), ls.sensor("ydlidar-g4b")
TMINI, PLUS = ls.sensor("ydlidar-tmini-pro"), ls.sensor("ydlidar-tmini-plus")

PACKETS = {
    "yd_zero_packet_doc": X4,
    "yd_zero_capture": ls.sensor("ydlidar-x2"),
    "yd_40pt_wrap_capture": ls.sensor("ydlidar-x3"),
    "yd_tmini_zero": TMINI,
    "yd_tmini_16pt": TMINI,
    "yd_tmini_wrap": TMINI,
    "yd_tg15_capture": TG15,
}
ANSWERS = {
    "yd_scan_desc": X4,
    "yd_health": TMINI,
    "yd_devinfo_tmini_pro": TMINI,
    "yd_devinfo_tmini_plus": PLUS,
    "yd_stamp_synth": TMINI,
}
EXCERPTS = {"yd_angle_doc", "yd_si2_doc", "yd_si3_doc"}


def test_every_vector_of_the_family_is_used() -> None:
    assert {
        name for name in vectors(FILE) if name.startswith("yd_")
    } == PACKETS.keys() | ANSWERS.keys() | EXCERPTS


@pytest.mark.parametrize("name", PACKETS)
def test_a_published_packet_decodes_to_its_published_values(name: str) -> None:
    sensor, data, expected = (
        PACKETS[name],
        vector_bytes(FILE, name),
        vectors(FILE)[name]["expected"],
    )
    packets = decode(sensor, data)
    assert sensor.build("data", sensor.parse(data)) == data
    assert (packets.raw["ct"]["start"].tolist(), packets.raw["lsn"].tolist()) == (
        [expected["t"]],
        [expected.get("lsn", data[3])],
    )
    assert packets["fsa.angle"].tolist() == [expected["fsa_deg"]]
    assert packets["lsa.angle"].tolist() == [expected.get("lsa_deg", expected["fsa_deg"])]
    samples = sensor.parse(data).samples
    assert (samples[0].distance, samples[-1].distance) == (
        expected.get("first_mm", samples[0].distance),
        expected.get("last_mm", samples[-1].distance),
    )
    assert expected.get("flags", []) in ([], [sample.get("flags") for sample in samples])
    if "scan_freq_hz" in expected:
        assert packets["ct.frequency"].tolist() == [pytest.approx(expected["scan_freq_hz"])]
    if "step_deg" in expected:
        angles = expected["fsa_deg"] + expected["step_deg"] * np.arange(len(samples))
        np.testing.assert_allclose(clockwise(packets.points()), angles % 360, atol=1e-4)


@pytest.mark.parametrize("name", ANSWERS)
def test_a_published_reply_decodes_to_its_published_values(name: str) -> None:
    sensor, data, expected = (
        ANSWERS[name],
        vector_bytes(FILE, name),
        vectors(FILE)[name]["expected"],
    )
    parsed = sensor.parse(data)
    assert sensor.build(sensor.split(data)[0].frame, parsed) == data
    if "hw" in expected:
        assert (parsed.model, parsed.hardware) == (data[7], expected["hw"])
    assert parsed.get("status", 0) == expected.get("status", 0)
    assert parsed.get("time", 0) == expected.get("ms", 0)


def test_the_examples_of_single_samples_and_of_the_angles() -> None:
    angle, two, three = (
        vectors(FILE)[name]["expected"] for name in ("yd_angle_doc", "yd_si2_doc", "yd_si3_doc")
    )
    ends = {
        "fsa": {"angle": angle["fsa"]},
        "lsa": {"angle": angle["lsa"]},
        "ct": {"frequency": 0, "start": 0},
    }
    data = X4.build(
        "data",
        units=True,
        samples=[{"distance": metres} for metres in (1.0, *[3.0] * 38, 8.0)],
        **ends,
    )
    assert data[3:8] == vector_bytes(FILE, "yd_angle_doc")
    np.testing.assert_allclose(
        clockwise(decode(X4, data).points())[[0, 39]], [angle["a1"], angle["an"]], atol=2e-5
    )

    def alone(sensor: ls.Sensor, name: str) -> ls.PointCloud:
        sample = sensor.frames["data"].struct.subcon.samples.subcon.subcon.parse(
            vector_bytes(FILE, name)
        )
        return decode(
            sensor,
            sensor.build(
                "data",
                samples=[sample],
                fsa={"angle": 0},
                lsa={"angle": 0},
                ct={"frequency": 0, "start": 0},
            ),
        ).points()

    assert alone(X4, "yd_si2_doc").range.tolist() == [pytest.approx(two["mm"] / 1000)]
    assert alone(TG15, "yd_si2_doc").range.tolist() == [pytest.approx(28.645)]
    cloud = alone(G4B, "yd_si3_doc")
    assert cloud.intensity is not None
    assert (cloud.range.tolist(), cloud.intensity.tolist()) == (
        [pytest.approx(three["mm"] / 1000)],
        [three["q"]],
    )


def test_packets_of_a_tmini_pro() -> None:
    expected = json.loads(capture("ydlidar/packets.json").read_text())
    packets = decode(TMINI, b"".join(bytes.fromhex(one["hex"]) for one in expected))
    right = [one for one in expected if one["checksum_ok"]]
    assert (len(packets), packets.stats.bad_checksum) == (len(right), len(expected) - len(right))
    said = [sample for one in right for sample in one["dist_mm_intensity_flag"]]
    cloud = packets.points()
    assert cloud.intensity is not None
    assert len(cloud) == len(said)
    assert np.where(cloud.valid, np.round(cloud.range * 1000), 0).tolist() == [
        sample[0] for sample in said
    ]
    assert cloud.intensity.tolist() == [sample[1] for sample in said]
    assert packets["fsa.angle"].tolist() == [one["fsa_deg"] for one in right]


@pytest.mark.slow
def test_a_tmini_is_identified_by_its_state_field() -> None:
    tminis = {"ydlidar-tmini", "ydlidar-tmini-plus", "ydlidar-tmini-pro"}
    heard = SampleBytes("", (capture("ydlidar/packets_checksum_ok_concat.bin").read_bytes(),))
    assert {score.sensor.id for score in identify_sample(heard).candidates} == tminis
    information = TMINI.build(
        "info", model=150, firmware={"minor": 0, "major": 1}, hardware=2, serial=bytes(16)
    )
    found = identify_sample(SampleBytes("", (information + heard.chunks[0],)))
    assert (found.sensor, found.candidates[0].evidence) == (TMINI, "info.model is T-mini Pro")
    others = identify_sample(SampleBytes("", tuple(simulate(ls.sensor("ydlidar-g2"), 60))))
    assert {"cspc-coin-d4", "ydlidar-g2", "ydlidar-s4b"} <= {
        score.sensor.id for score in others.candidates
    }
    assert identify_sample(
        SampleBytes("", tuple(simulate(ls.sensor("ydlidar-tmini-plus-sh"), 60)))
    ).sensor is ls.sensor("ydlidar-tmini-plus-sh")


def test_a_related_model_with_other_frames_is_no_contradiction() -> None:
    coin = ls.sensor("cspc-coin-d4")
    info = coin.build(
        "info",
        model=b"COIN-D4".ljust(12, b"\0"),
        zero_angle=0,
        direction=0,
        correction=0,
        reserved=bytes(3),
        revision=1,
    )
    started = coin.split(info + b"".join(simulate(coin, 20)))
    assert started[0].frame == "info"
    assert find_contradiction(coin, started) == ""
    said = find_contradiction(TMINI, TMINI.split(vector_bytes(FILE, "yd_devinfo_tmini_plus")))
    assert said == "the frames are those of ydlidar-tmini-plus (info.model is T-mini Plus)"
