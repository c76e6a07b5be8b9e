"""Tests of the rotor's step between blocks: the last valid step replaces a long one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

import lidarspec as ls
from lidarspec.spec import between_blocks, following

FASTEST = 0.4  # degrees from block to block
Floats = NDArray[np.float64]


def steps(azimuth: list[float], *, repeat: bool = True) -> Floats:
    """Return the steps of one run of blocks, rounded to the resolution of the azimuth."""
    blocks = np.array(azimuth)
    found = between_blocks(blocks, following(blocks), fastest=FASTEST, repeat=repeat)
    return np.round(np.asarray(found, np.float64), 2)


def test_gaps_and_the_end_use_the_last_valid_step() -> None:
    np.testing.assert_array_equal(steps([10.0, 10.2, 90.0, 90.3]), [0.2, 0.2, 0.3, 0.3])


def test_a_single_block_between_gaps_uses_the_last_valid_step() -> None:
    np.testing.assert_array_equal(steps([10.0, 10.2, 50.0, 90.0]), [0.2, 0.2, 0.2, 0.2])


def test_without_repeat_a_gap_has_no_step() -> None:
    found = steps([10.0, 10.2, 90.0, 90.3], repeat=False)
    np.testing.assert_array_equal(found, [0.2, np.nan, 0.3, np.nan])


def test_before_the_first_good_step_there_is_none() -> None:
    np.testing.assert_array_equal(steps([10.0, 90.0, 90.3]), [np.nan, 0.3, 0.3])


def test_a_step_across_zero_and_a_step_back_are_the_short_way_round() -> None:
    np.testing.assert_array_equal(steps([359.9, 0.1, 0.05, 0.25]), [0.2, -0.05, 0.2, 0.2])


def test_a_step_may_be_a_quarter_longer_than_the_fastest() -> None:
    np.testing.assert_array_equal(steps([10.0, 10.3, 10.79, 11.30]), [0.3, 0.49, 0.49, 0.49])


@pytest.mark.parametrize("name", ["robosense-helios16p", "lslidar-c16", "velodyne-vlp16"])
def test_a_single_block_between_masked_sectors_has_directions(name: str) -> None:
    """Block 8 of the last packet has a gap of 60 degrees before and behind it."""
    sensor = ls.sensor(name)
    packets = [data for data in ls.simulate(sensor, 4) if sensor.split(data)[0].frame == "data"]
    values = sensor.parse(packets[-1])
    values.blocks[8].azimuth = (values.blocks[8].azimuth + 6_000) % 36_000
    for block in values.blocks[9:]:
        block.azimuth = (block.azimuth + 12_000) % 36_000
    cloud = sensor.decode([*packets[:-1], sensor.build("data", values)]).points()
    whole = sensor.decode(packets).points()
    size = len(cloud) // len(packets) // len(values.blocks)
    lone = slice(len(cloud) - 4 * size, len(cloud) - 3 * size)
    turn = np.angle(np.exp(1j * (cloud.azimuth[lone] - whole.azimuth[lone])))
    np.testing.assert_allclose(turn, -np.deg2rad(60), atol=1e-3)
