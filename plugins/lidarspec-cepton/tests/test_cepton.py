"""Tests of Cepton Vista: a published point, frame parity and both signature orders."""

from __future__ import annotations

import numpy as np

import lidarspec as ls
from lidarspec import simulate
from tests.evidence import decode, vector_bytes, vectors

VISTA = ls.sensor("cepton-vista")
FILE, NAME = "vectors_udp3d.json", "cepton_point_unit"


def test_the_point_of_the_public_reader() -> None:
    data, expected = vector_bytes(FILE, NAME), vectors(FILE)[NAME]["expected"]
    for signature in (b"STDV", b"VDTS"):
        packet = (
            signature
            + bytes([1, 24, 0, 0])
            + bytes(8)
            + bytes([1, 10, 2, 0])
            + bytes(4)
            + data
            + data
        )
        assert VISTA.build("data", VISTA.parse(packet)) == packet
        cloud = decode(VISTA, [packet]).points()
        right, ahead, up = expected["xyz"]
        np.testing.assert_allclose(cloud.xyz[0], (ahead, -right, up), rtol=1e-6)
        np.testing.assert_allclose(cloud.time, [2e-6, 4e-6], atol=1e-9)
        assert cloud.ring is not None
        assert cloud.ring[0] == expected["channel"]


def test_pictures_are_cut_where_the_parity_changes() -> None:
    scans = list(VISTA.scans(simulate(VISTA, 3 * 64)))
    assert [len(scan) for scan in scans] == [64 * 144] * 3
