"""Tests of Quanergy M8 and MQ8: packets with three returns, and older packets."""

from __future__ import annotations

import numpy as np

import lidarspec as ls
from tests.evidence import decode, vector_bytes, vectors

M8, MQ8 = ls.sensor("quanergy-m8"), ls.sensor("quanergy-mq8")
FILE, NAME = "vectors_udp3d.json", "quanergy_m8_type0"


def test_the_packet_of_three_returns() -> None:
    data, expected = vector_bytes(FILE, NAME), vectors(FILE)[NAME]["expected"]
    assert M8.build("data", M8.parse(data)) == data
    packets = decode(M8, data)
    first = packets.raw["firings"][0, 0]
    assert [first[name].tolist() for name in ("first", "second", "third")] == expected["f0"]
    cloud = packets.points()
    np.testing.assert_allclose(cloud.range[:6], [1, 2, 3, 1.00001, 2.00001, 3.00001], rtol=1e-6)
    np.testing.assert_allclose(cloud.elevation[[0, 18]], [-0.318505, 0], atol=1e-7)
    np.testing.assert_allclose(decode(MQ8, data).points().elevation[0], -0.24435, atol=1e-7)
    assert cloud.return_index is not None
    assert cloud.return_index[:4].tolist() == [0, 1, 2, 0]


def test_a_repeated_return_is_one_point() -> None:
    parsed = M8.parse(vector_bytes(FILE, NAME))
    parsed.firings[0].first = list(parsed.firings[0].third)
    cloud = decode(M8, M8.build("data", parsed)).points()
    assert cloud.valid[:6].tolist() == [False, True, True] * 2


def test_older_packets_have_distances_of_ten_millimetres() -> None:
    parsed = M8.parse(vector_bytes(FILE, NAME))
    parsed.api = 4
    parsed.firings[0].third[0] = 300
    assert decode(M8, M8.build("data", parsed)).points().range[2] == 3
