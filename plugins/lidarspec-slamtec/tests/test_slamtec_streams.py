"""Tests of RPLIDAR streams: every capsule type, mode changes, scans and false nodes."""

from __future__ import annotations

import random

import numpy as np
import pytest

from lidarspec import simulate
from lidarspec.spec import Polar
from lidarspec_slamtec.capsules import encode_ultra
from tests.engine.oracle import Oracle
from tests.engine.streams import damage
from tests.evidence import clockwise, decode

from .rplidar import A1, ANSWERS, capsule, capsules, find_nodes, make_node_sensor, turns

CONFIRM = A1.frames["node"].confirm


@pytest.mark.parametrize("answer", ["express", "ultra", "dense", "ultra_dense"])
def test_no_direction_goes_over_a_loss_or_a_new_start(answer: str) -> None:
    sensor, source = A1.configure(answer=answer), random.Random(5)
    first, second, third = (capsule(answer, source, degrees) for degrees in (10, 20, 30))
    parsed = A1.parse(third, frame=answer)
    parsed.start.sync = 1
    count = len(sensor.decode(first + second).points()) // 2
    for data in (first + second + A1.build(answer, parsed), first + second + b"\x00" + third):
        azimuth = sensor.decode(data).points().azimuth
        assert np.isfinite(azimuth).tolist() == [True] * count + [False] * 2 * count


@pytest.mark.parametrize("answer", [*ANSWERS, "node"])
def test_a_descriptor_switches_to_its_own_frames_alone(answer: str) -> None:
    for announced in (*ANSWERS, "node"):
        head = A1.example("scan_descriptor" if announced == "node" else f"{announced}_descriptor")
        body = turns(20) if answer == "node" else capsules(answer, 3)[7:]
        frames = A1.decode(head + body).stats.frames
        assert (answer in frames) == (announced == answer)


# Of 781 bytes, 1 % of damage leaves nothing whole; so HQ capsules are tried with less, too.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("answer", "rate"), [*((answer, 0.01) for answer in ANSWERS), ("hq", 0.001)]
)
def test_a_damaged_stream_equals_the_oracle(answer: str, rate: float) -> None:
    number = {("hq", 0.001): 16, ("hq", 0.01): 6, ("ultra_dense", 0.01): 60}.get((answer, rate), 30)
    data = damage(capsules(answer, number), rate, 11)
    found = [(item.frame, item.offset, item.data) for item in A1.split(data)]
    assert found == Oracle(A1, data).frames()
    intact = sum(name == answer for name, _, _ in found)
    assert intact == 0 if (answer, rate) == ("hq", 0.01) else 5 < intact < number
    decode(A1.configure(answer=answer), data)


def test_damaged_nodes_equal_the_oracle() -> None:
    data = damage(A1.example("scan_descriptor") + turns(600), 0.01, 12)
    found = [(item.frame, item.offset, item.data) for item in A1.split(data)]
    assert found == Oracle(A1, data).frames()
    assert 300 < len(found) < 600


def test_a_conversation_with_several_answers_equals_the_oracle() -> None:
    parts = [
        A1.example("info"),
        A1.example("scan_descriptor"),
        turns(30),
        A1.example("health"),
        capsules("dense", 6),
        capsules("hq", 3),
    ]
    data = damage(
        b"".join(parts) + A1.example("scan_descriptor") + turns(40, seed=2), 0.004, 5, burst=8
    )
    assert [(item.frame, item.offset, item.data) for item in A1.split(data)] == Oracle(
        A1, data
    ).frames()


@pytest.mark.slow
def test_false_nodes_are_as_rare_as_documented() -> None:
    noise = random.Random(8).randbytes(1 << 17)
    alone = find_nodes(make_node_sensor(1), noise)
    assert 0.95 < len(alone) / 13_525 < 1.05  # 865 530 in 8 MiB
    assert not find_nodes(A1.configure(answer="node"), noise)
    for answer in ANSWERS:
        frames = capsules(answer, 100)[7:]
        assert not find_nodes(A1.configure(answer="node"), frames)
        assert len(find_nodes(make_node_sensor(1), frames)) > 100


def test_joining_in_the_middle_of_a_node_finds_the_true_ones() -> None:
    data, wrong = turns(3000), {1: 0, CONFIRM: 0}
    for runs in wrong:
        sensor = make_node_sensor(runs)
        for spot in range(1, len(data) - 400, 211):
            wrong[runs] += sum(
                (offset + spot) % 5 != 0 for offset in find_nodes(sensor, data[spot : spot + 400])
            )
    assert wrong[1] > 10
    assert wrong[CONFIRM] == 0


def test_a_short_run_of_nodes_is_rejected() -> None:
    sensor, data = A1.configure(answer="node"), turns(CONFIRM)
    assert len(find_nodes(sensor, data)) == CONFIRM
    assert not find_nodes(sensor, data[5:])


@pytest.mark.parametrize("answer", ["node", "express", "dense", "hq"])
def test_scans_begin_where_the_azimuth_passes_zero(answer: str) -> None:
    sensor, number = (
        A1.configure(answer=answer),
        {"node": 1440, "express": 90, "dense": 80, "hq": 40}[answer],
    )
    scans = list(sensor.scans(b"".join(simulate(sensor, number))))
    whole = [scan for scan in scans if scan.complete]
    assert len(whole) >= 2
    for scan in whole:
        degrees = clockwise(scan.points)
        assert degrees[0] < 1
        assert len(scan) == {"node": 360, "express": 720, "dense": 800, "hq": 960}[answer]


def test_the_start_bit_marks_scan_starts() -> None:
    packets = make_node_sensor(1).decode(turns(1600))
    flags = np.flatnonzero(packets["head.start"])
    lengths = [len(scan) for scan in make_node_sensor(1).scans(turns(1600))]
    assert np.cumsum(lengths)[:-1].tolist() == flags[1:].tolist()


def test_simulated_predictions_that_cannot_reach_their_point_are_no_returns() -> None:
    near, far = 0.3, 20.0
    polar = Polar(np.array([[[near, far, near], [far, far, near], [0.0, near, 0.0]]]), 0)
    codes = encode_ultra(polar)
    assert codes["cabins.predict1"][0].tolist()[0] == 511
    assert codes["cabins.major"][0, 2] == 0
    assert codes["cabins.predict2"][0, 2] == 511
    assert abs(codes["cabins.predict1"][0, 1]) <= 1


def test_an_input_is_read_by_the_answer_that_it_holds() -> None:
    for answer in ANSWERS:
        assert A1.decode(capsules(answer, 3)).frame == answer
