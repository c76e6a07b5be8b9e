"""Tests of Seyond Falcon: packets packed by hand, frames and invalid bytes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import lidarspec as ls
import lidarspec_seyond
from lidarspec import simulate
from tests.evidence import assert_points, decode

FALCON = ls.sensor("seyond-falcon")
VECTORS = json.loads(
    (Path(lidarspec_seyond.__file__).parent / "vectors.json").read_text(encoding="utf-8")
)


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["source"].rpartition(": ")[2])
def test_packets_of_one_return_and_two_by_hand(
    vector: dict[str, dict[str, dict[str, float]]],
) -> None:
    data = bytes.fromhex(str(vector["hex"]))
    packets = decode(FALCON, [data])
    assert packets.frame == vector["frame"]
    assert FALCON.build(packets.frame, FALCON.parse(data)) == data
    cloud = packets.points()
    assert_points(
        cloud,
        [(int(index), [at[axis] for axis in "xyz"]) for index, at in vector["points"].items()],
        atol=1e-3,
    )
    assert cloud.ring is not None
    assert cloud.ring[:4].tolist() == [0, 1, 2, 3]


def test_a_frame_is_a_scan_and_a_short_packet_is_invalid() -> None:
    sent = simulate(FALCON, 200)
    scans = list(FALCON.scans(sent))
    assert [(len(scan), scan.complete) for scan in scans] == [
        (10_080, False),
        (10_080, True),
        (10_080, True),
        (3360, False),
    ]
    assert scans[1].rate_hz == pytest.approx(10, rel=1e-4)
    assert float(np.ptp(np.rad2deg(scans[1].points.azimuth))) == pytest.approx(119.4, abs=0.1)
    assert len(FALCON.decode([sent[0][:-33], sent[0] + bytes(4)])) == 0
