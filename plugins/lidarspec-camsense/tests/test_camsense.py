"""Tests of Camsense X1 and LDS08RR: packets of real units, and the zero of angles."""

from __future__ import annotations

import json

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.detect.identification import identify_sample
from lidarspec.detect.sample_bytes import SampleBytes
from tests.evidence import capture, clockwise, decode, vector_bytes, vectors

FILE = "vectors_serial2d.json"
X1, LDS08RR = ls.sensor("camsense-x1"), ls.sensor("camsense-lds08rr")
PACKETS = {
    "camsense_x1_capture": X1,
    "camsense_x1_invalid_capture": X1,
    "camsense_x1_wrap_capture": X1,
    "lds08rr_capture_1": LDS08RR,
    "lds08rr_capture_2": LDS08RR,
}


def test_every_vector_of_the_family_is_used() -> None:
    assert {
        name for name in vectors(FILE) if name.startswith(("camsense_", "lds08rr_"))
    } == PACKETS.keys()


@pytest.mark.parametrize("name", PACKETS)
def test_a_published_packet_decodes_to_its_published_values(name: str) -> None:
    sensor, data, expected = (
        PACKETS[name],
        vector_bytes(FILE, name),
        vectors(FILE)[name]["expected"],
    )
    packets, cloud = decode(sensor, data), decode(sensor, data).points()
    assert sensor.build("data", sensor.parse(data)) == data
    assert packets["start_angle"].tolist() == [expected["start_deg"]]
    assert packets["end_angle"].tolist() == [expected.get("end_deg", packets["end_angle"][0])]
    assert packets["speed"][0] / 60 == pytest.approx(
        expected.get("hz", packets["speed"][0] / 60), abs=1e-6
    )
    millimetres = np.where(cloud.valid, np.round(cloud.range * 1000), 0).tolist()
    assert millimetres == expected.get("dist_mm", millimetres)
    assert cloud.intensity is not None
    assert cloud.intensity.tolist() == expected.get("intensity", cloud.intensity.tolist())


@pytest.mark.slow
def test_lds08rr_and_x1_packets_are_distinguished() -> None:
    expected = json.loads(capture("camsense/packets.json").read_text())
    data = b"".join(bytes.fromhex(one["hex"]) for one in expected)
    cloud = decode(LDS08RR, data).points()
    points = np.array([point for one in expected for point in one["pts"]])
    np.testing.assert_allclose(clockwise(cloud), points[:, 0], atol=1e-4)
    np.testing.assert_allclose(cloud.range * 1000, points[:, 1], atol=1e-3)
    np.testing.assert_array_equal(cloud.intensity, points[:, 2])
    assert identify_sample(SampleBytes("", (data,))).sensor is LDS08RR
    assert (
        identify_sample(SampleBytes("", (vector_bytes(FILE, "camsense_x1_capture") * 3,))).sensor
        is X1
    )


def test_azimuths_advance_across_360_degrees() -> None:
    angles = clockwise(decode(X1, vector_bytes(FILE, "camsense_x1_wrap_capture")).points())
    np.testing.assert_allclose(
        angles, (354.03125 + np.arange(8) * (360.5625 - 354.03125) / 7) % 360, atol=1e-4
    )


def test_angles_from_the_zero_of_the_housing() -> None:
    data = vector_bytes(FILE, "camsense_x1_capture")
    turned = clockwise(decode(X1.configure(zero="housing"), data).points()) - clockwise(
        decode(X1, data).points()
    )
    np.testing.assert_allclose(turned, 21, atol=1e-4)
    with pytest.raises(ls.UsageError, match="'data' or 'housing'"):
        X1.configure(zero="motor")
    with pytest.raises(ls.UsageError, match="zero"):
        LDS08RR.configure(zero="housing")
