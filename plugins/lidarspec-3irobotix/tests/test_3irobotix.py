"""Tests of 3iRobotix Delta: packets of a real unit, wrong lengths, and the 2G."""

from __future__ import annotations

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from lidarspec.detect.identification import identify_sample
from lidarspec.detect.sample_bytes import SampleBytes
from tests.evidence import clockwise, decode, vector_bytes, vectors

FILE = "vectors_serial2d.json"
DELTA_2A, DELTA_2G = ls.sensor("3irobotix-delta2a"), ls.sensor("3irobotix-delta2g")


def test_the_packets_of_a_delta_2a() -> None:
    data, expected = (
        vector_bytes(FILE, "delta_2a_data_capture"),
        vectors(FILE)["delta_2a_data_capture"]["expected"],
    )
    packets = decode(DELTA_2A, data)
    parsed, cloud = DELTA_2A.parse(data), packets.points()
    assert DELTA_2A.build("data", parsed) == data
    assert (parsed.length, parsed.size, parsed.sum) == (
        expected["length"],
        expected["data_len"],
        expected["cs"],
    )
    assert packets["speed"].tolist() == [expected["speed_hz"]]
    assert packets["zero_offset"].tolist() == [expected["zero_offset_deg"]]
    assert [[sample.quality, sample.distance] for sample in parsed.samples[:3]] == expected[
        "first3"
    ]
    assert np.round(cloud.range[-1] * 1000, 2) == expected["last_mm"]
    np.testing.assert_allclose(
        clockwise(cloud),
        expected["start_deg"] + np.arange(expected["n"]) * 22.5 / expected["n"],
        atol=1e-4,
    )
    speed = DELTA_2A.parse(vector_bytes(FILE, "delta_2a_rpm_only"))
    assert (speed.version, speed.speed) == (0, 201)  # 10.05 Hz


def test_a_packet_with_contradictory_lengths_is_invalid() -> None:
    data = bytearray(vector_bytes(FILE, "delta_2a_data_capture"))
    data[7] -= 3
    data[-2:] = (sum(data[:-2]) & 0xFFFF).to_bytes(2, "big")
    assert decode(DELTA_2A, bytes(data)).stats.frames == {}


@pytest.mark.slow
def test_only_a_2g_is_identified_by_its_packet_start() -> None:
    assert identify_sample(SampleBytes("", tuple(simulate(DELTA_2G, 60)))).sensor is DELTA_2G
    found = identify_sample(SampleBytes("", tuple(simulate(DELTA_2A, 60))))
    assert found.sensor is None
    assert {score.sensor.id for score in found.candidates} == {
        f"3irobotix-{name}" for name in ("delta2a", "delta2b", "delta2d", "lds08rr")
    }
