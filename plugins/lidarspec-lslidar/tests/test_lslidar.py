"""Tests of LSLIDAR N10, N10P, M10 and C16: a published packet, lengths and clock."""

from __future__ import annotations

import numpy as np
import pytest

import lidarspec as ls
from lidarspec import simulate
from tests.evidence import clockwise, decode, vector_bytes, vectors

N10, N10P, M10P, C16 = (ls.sensor(f"lslidar-{name}") for name in ("n10", "n10p", "m10p", "c16"))


def test_the_published_packet_of_an_n10() -> None:
    data = vector_bytes("vectors_serial2d.json", "lslidar_n10_synth")
    expected = vectors("vectors_serial2d.json")["lslidar_n10_synth"]["expected"]
    packets = decode(N10, data)
    cloud = packets.points()
    assert 1 / (24 * packets["period"][0]) == pytest.approx(expected["hz"], abs=1e-4)
    assert np.round(cloud.range * 1000).tolist() == expected["dist_mm"]
    assert cloud.intensity is not None
    assert cloud.intensity.tolist() == expected["intensity"]
    np.testing.assert_allclose(
        clockwise(cloud), np.linspace(expected["start_deg"], expected["end_deg"], 16), atol=1e-4
    )


def test_the_returns_of_an_n10p_share_their_direction() -> None:
    cloud = decode(N10P, b"".join(simulate(N10P, 40))).points()
    assert cloud.return_index is not None
    assert cloud.return_index[:4].tolist() == [0, 1, 0, 1]
    assert cloud.azimuth[0] == cloud.azimuth[1] != cloud.azimuth[2]


def test_m10p_packets_have_their_declared_length_and_cross_midnight() -> None:
    sweep = M10P.simulation.sweep
    assert sweep is not None
    sample = {"bright": 0, "distance": 1.0}
    packets = [
        M10P.build(
            "data", units=True, samples=[sample] * count, **{**sweep(0), "length": 20 + 2 * count}
        )
        for count in (69, 70, 74)
    ]
    assert len(decode(M10P, b"".join(packets)).points()) == 69 + 70 + 74
    late = M10P.build(
        "data", M10P.parse(packets[0]), hour=23, minute=59, second=59, millisecond=0, microsecond=0
    )
    assert np.diff(decode(M10P, late + packets[1]).time_ns).tolist() == [1_000_000_000]


def test_no_return_is_no_point_and_a_strong_reflection_is_one() -> None:
    samples = [
        {"bright": 1, "distance": 0x7FFF},
        {"bright": 1, "distance": 2000},
        {"bright": 0, "distance": 0},
    ]
    time = dict.fromkeys(
        ("year", "month", "day", "hour", "minute", "second", "millisecond", "microsecond"), 0
    )
    cloud = decode(
        M10P, M10P.build("data", length=26, start_angle=0, period=4167, samples=samples, **time)
    ).points()
    assert cloud.intensity is not None
    assert (cloud.valid.tolist(), cloud.intensity[1]) == ([False, True, False], 255)


def test_a_captured_packet_of_a_c16() -> None:
    data, expected = (
        vector_bytes("vectors_udp3d.json", "lslidar_c16_like_vli16"),
        vectors("vectors_udp3d.json")["lslidar_c16_like_vli16"]["expected"],
    )
    assert C16.build("data", C16.parse(data)) == data
    packets = decode(C16, [data])
    assert packets.raw["blocks"]["azimuth"][0].tolist() == expected["azimuths"]
    first = packets.raw["blocks"]["groups"]["channels"][0, 0].reshape(32)
    assert [first["distance"][slot] for _, slot, _, _ in expected["first"]] == [
        distance for *_, distance, _ in expected["first"]
    ]
    assert [first["intensity"][slot] for _, slot, _, _ in expected["first"]] == [
        intensity for *_, intensity in expected["first"]
    ]
    cloud = packets.points()
    assert cloud.valid.sum() == expected["n_nonzero"]
    assert packets.time_ns[0] == 90_724_466_616  # 00:01:30 and b8 7b 2e 2b nanoseconds


def test_a_c16_with_two_returns_and_with_steps_of_another_size() -> None:
    data = vector_bytes("vectors_udp3d.json", "lslidar_c16_like_vli16")
    parsed = C16.parse(data)
    parsed.return_mode = 0x39
    for first, second in zip(parsed.blocks[::2], parsed.blocks[1::2], strict=True):
        second.azimuth = first.azimuth
    dual = decode(C16, [C16.build("data", parsed)]).points()
    assert dual.return_index is not None
    assert dual.return_index.reshape(12, 32)[:, 0].tolist() == [0, 1] * 6
    np.testing.assert_array_equal(dual.azimuth[:32], dual.azimuth[32:64])
    np.testing.assert_allclose([dual.time[0], dual.time[-1]], [-191 * 3.125e-6, 0], atol=1e-9)
    single, fine = (
        C16.decode([data]).points(),
        decode(C16.configure(distance_unit=0.25), [data]).points(),
    )
    np.testing.assert_allclose(
        fine.range[fine.valid], single.range[single.valid] * 0.625, rtol=1e-6
    )
    with pytest.raises(ls.UsageError, match=r"0\.4 or 0\.25"):
        C16.configure(distance_unit=1.0)
