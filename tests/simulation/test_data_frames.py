"""Tests of simulated sensors with several data frame types, each with its own sweep."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.simulation.simulator import make_opening_frame, simulate
from lidarspec.spec import Fields, Polar, Simulation, following, wrap
from tests.shapes import SHAPES

MODES, AHEAD, OUTER = SHAPES["shape-modes"], SHAPES["shape-ahead"], SHAPES["shape-outer"]


@pytest.mark.parametrize("answer", ["plain", "express"])
def test_every_answer_is_simulated_by_its_own_sweep(answer: str) -> None:
    sensor = MODES.configure(answer=answer)
    frames = simulate(sensor, 40)
    assert [
        found.frame for found in MODES.split(make_opening_frame(sensor) + b"".join(frames))
    ] == [
        f"begin_{answer}",
        *[answer] * 40,
    ]
    assert np.rint(sensor.decode(b"".join(frames))["angle"]).tolist() == [
        i * (2 if answer == "plain" else 4) for i in range(40)
    ]


def test_a_sensor_that_needs_no_opening_has_none() -> None:
    assert make_opening_frame(AHEAD) == b""


def test_simulated_packets_that_need_the_next_do_not_depend_on_batches() -> None:
    def points(f: Fields) -> Polar:
        step = wrap(following(f.angle) - f.angle, 360) / 8
        return Polar(range=f.distances, azimuth=np.deg2rad(f.angle + step * np.arange(8)))

    sensor = dataclasses.replace(
        AHEAD, points=points, simulation=Simulation(lambda i: {"angle": i * 8 % 360})
    )
    assert simulate(sensor, 20) == simulate(sensor, 7) + simulate(sensor, 13, start=7)


def test_a_count_further_out_is_filled_in() -> None:
    data = OUTER.build("data", header={"version": 2}, body={"angle": 9, "distances": [1, 2, 3]})
    assert data[2:4] == b"\x24\x09"
    assert OUTER.parse(data).body.distances == [1, 2, 3]


def test_a_wrong_outer_count_is_a_usage_error() -> None:
    with pytest.raises(ls.UsageError, match="distances"):
        OUTER.build(
            "data", header={"version": 2, "size": 9}, body={"angle": 9, "distances": [1, 2, 3]}
        )
