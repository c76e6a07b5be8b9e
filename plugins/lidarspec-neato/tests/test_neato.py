"""Tests of Neato XV-11 and related models: the published vector, both directions."""

from __future__ import annotations

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from tests.evidence import decode, vector_bytes, vectors

FILE = "vectors_serial2d.json"
XV11, LDS01RR, LDS02RR, LFCD = (
    ls.sensor("neato-xv11"),
    ls.sensor("xiaomi-lds01rr"),
    ls.sensor("xiaomi-lds02rr"),
    ls.sensor("turtlebot3-lds-01"),
)


def test_the_published_packet() -> None:
    data, expected = vector_bytes(FILE, "neato_synth"), vectors(FILE)["neato_synth"]["expected"]
    samples = XV11.parse(data).samples
    packets = decode(XV11, data)
    assert packets["speed"].tolist() == [expected["rpm"]]
    assert [sample.range.distance for sample in samples] == expected["dist_mm"]
    assert [sample.range.invalid for sample in samples] == expected["invalid"]
    assert [sample.range.weak for sample in samples] == expected["warning"]
    assert [sample.signal for sample in samples] == expected["signal"]
    assert packets.points().valid.tolist() == [not invalid for invalid in expected["invalid"]]


def test_the_xv11_counts_counter_clockwise_and_the_lds02rr_clockwise() -> None:
    data = vector_bytes(FILE, "neato_synth")
    np.testing.assert_allclose(
        np.rad2deg(decode(XV11, data).points().azimuth), [0, 1, 2, 3], atol=1e-4
    )
    np.testing.assert_allclose(
        np.rad2deg(decode(LDS02RR, data).points().azimuth) % 360, [0, 359, 358, 357], atol=1e-4
    )


def test_only_a_model_that_rotates_the_other_way_differs_in_direction() -> None:
    label = "both models send the same packets; the label names the model"
    clockwise = "sends the same packets, but rotates clockwise"
    counter_clockwise = "sends the same packets, but rotates counter-clockwise"
    assert XV11.relatives == {"xiaomi-lds01rr": label, "xiaomi-lds02rr": clockwise}
    assert LDS01RR.relatives == {"neato-xv11": label, "xiaomi-lds02rr": clockwise}
    assert LDS02RR.relatives == dict.fromkeys(["neato-xv11", "xiaomi-lds01rr"], counter_clockwise)


@pytest.mark.parametrize("sensor", [XV11, LDS02RR, LFCD], ids=lambda sensor: sensor.id)
def test_a_turn_has_a_point_to_the_degree(sensor: ls.Sensor) -> None:
    scans = [scan for scan in sensor.scans(b"".join(simulate(sensor, 400))) if scan.complete]
    assert {len(scan) for scan in scans} == {360}


def test_packets_of_an_lfcd2_are_taken_whatever_their_trailer_is_and_never_alone() -> None:
    packets = [bytes([*packet[:40], i, 255 - i]) for i, packet in enumerate(simulate(LFCD, 5))]
    assert len(decode(LFCD, b"".join(packets))) == 5
    assert len(decode(LFCD, packets[0] + bytes(40))) == 0
