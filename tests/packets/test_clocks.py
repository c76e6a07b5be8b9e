"""Clocks that run on over gaps, by what the host saw."""

from __future__ import annotations

import numpy as np
import pytest

from lidarspec.packets.clocks import Unwrapper

SECOND = 10**9
NOW = 1_700_000_000 * SECOND


def times(*seconds: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([round(second * SECOND) for second in seconds], np.int64)


def test_whole_turns_that_nobody_saw_are_counted_by_the_host() -> None:
    clock = Unwrapper(30.0)
    first = clock.push(times(10, 11), NOW + times(0, 1))
    later = clock.push(times(12, 13), NOW + times(92, 93))
    assert ((np.concatenate([first, later]) - first[0]) / SECOND).tolist() == [0, 1, 92, 93]


@pytest.mark.parametrize("arrivals", [[0, 0], [0, NOW], [NOW, 0]])
def test_an_arrival_that_nobody_knows_counts_no_turns(arrivals: list[int]) -> None:
    clock = Unwrapper(30.0)
    found = np.concatenate([clock.push(times(at), np.array([host], np.int64)) for at, host in zip((10, 11), arrivals, strict=True)])
    assert np.diff(found).tolist() == [SECOND]


def test_readings_run_on_over_a_hundred_turns_also_when_late() -> None:
    rng = np.random.default_rng(1)
    true = np.cumsum(rng.integers(1, 4_000_000_000, 1000)) + 7
    true[500], true[501] = true[501], true[500]
    clock = Unwrapper(30.0)
    assert true[-1] // (30 * SECOND) > 60
    found = np.concatenate([clock.push(part % (30 * SECOND), np.zeros(len(part), np.int64)) for part in np.array_split(true, 37)])
    assert (found - found[0] == true - true[0]).all()
