"""LSLIDAR N10, N10P and M10: the published packet, two returns, lengths that the packets say, and the clock."""

from __future__ import annotations

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.simulation.simulator import simulate
from tests.sensors.evidence import clockwise, decoded, vector_bytes, vectors

N10, N10P, M10P = (ls.sensor(f"lslidar-{name}") for name in ("n10", "n10p", "m10p"))


def test_the_published_packet_of_an_n10() -> None:
    data = vector_bytes("vectors_serial2d.json", "lslidar_n10_synth")
    expected = vectors("vectors_serial2d.json")["lslidar_n10_synth"]["expected"]
    packets = decoded(N10, data)
    cloud = packets.points()
    assert 1 / (24 * packets["period"][0]) == pytest.approx(expected["hz"], abs=1e-4)
    assert np.round(cloud.range * 1000).tolist() == expected["dist_mm"]
    assert cloud.intensity is not None
    assert cloud.intensity.tolist() == expected["intensity"]
    np.testing.assert_allclose(clockwise(cloud), np.linspace(expected["start_deg"], expected["end_deg"], 16), atol=1e-4)


def test_the_returns_of_an_n10p_share_their_direction() -> None:
    cloud = decoded(N10P, b"".join(simulate(N10P, 40))).points()
    assert cloud.return_index is not None
    assert cloud.return_index[:4].tolist() == [0, 1, 0, 1]
    assert cloud.azimuth[0] == cloud.azimuth[1] != cloud.azimuth[2]


def test_packets_of_an_m10p_are_as_long_as_they_say_and_run_on_over_midnight() -> None:
    sweep = M10P.simulation.sweep
    assert sweep is not None
    sample = {"bright": 0, "distance": 1.0}
    packets = [M10P.build("data", units=True, samples=[sample] * count, **{**sweep(0), "length": 20 + 2 * count}) for count in (69, 70, 74)]
    assert len(decoded(M10P, b"".join(packets)).points()) == 69 + 70 + 74
    late = M10P.build("data", M10P.parse(packets[0]), hour=23, minute=59, second=59, millisecond=0, microsecond=0)
    assert np.diff(decoded(M10P, late + packets[1]).time_ns).tolist() == [1_000_000_000]


def test_no_return_is_no_point_and_a_strong_reflection_is_one() -> None:
    samples = [{"bright": 1, "distance": 0x7FFF}, {"bright": 1, "distance": 2000}, {"bright": 0, "distance": 0}]
    time = dict.fromkeys(("year", "month", "day", "hour", "minute", "second", "millisecond", "microsecond"), 0)
    cloud = decoded(M10P, M10P.build("data", length=26, start_angle=0, period=4167, samples=samples, **time)).points()
    assert cloud.intensity is not None
    assert (cloud.valid.tolist(), cloud.intensity[1]) == ([False, True, False], 255)
