"""Tests that clocks continue over gaps, according to the host's clock."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np
import pytest
from construct import Array, If, Int8ub, Int16ub, Int16ul, Int64ul, Struct, this

from lidarspec import SpecError
from lidarspec.packets.clocks import Unwrapper
from lidarspec.spec import Clock, PacketCounter, Scaled
from tests.by_construct import reader
from tests.engine.against_construct import BACKENDS, sensor

SECOND = 10**9
NOW = 1_700_000_000 * SECOND


def times(*seconds: float) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([round(second * SECOND) for second in seconds], np.int64)


def test_unseen_clock_turns_are_counted_by_arrival_times() -> None:
    clock = Unwrapper(30.0)
    first = clock.push(times(10, 11), NOW + times(0, 1))
    later = clock.push(times(12, 13), NOW + times(92, 93))
    assert ((np.concatenate([first, later]) - first[0]) / SECOND).tolist() == [0, 1, 92, 93]


def test_a_packet_without_the_optional_clock_has_the_time_of_the_one_before() -> None:
    struct = Struct(
        "has_time" / Int8ub, "time" / If(this.has_time == 1, Scaled(Int16ub, 0.001, "s"))
    )
    ours = dataclasses.replace(sensor(struct), clock=Clock("time"))
    frames = [b"\1\x05\xdc", b"\0", b"\0", b"\1\x09\xc4"]
    for backend in BACKENDS:
        packets = reader(ours, backend).decode(frames)
        assert (packets.time_ns / SECOND).tolist() == [1.5, 1.5, 1.5, 2.5]


def test_a_pause_of_more_than_half_a_turn_goes_forward_where_the_host_says_so() -> None:
    for pause, arrived in (
        (18, 18),
        (22, 21.5),
        (14, 14),
        (0.01, 18),
    ):  # the last was held back on its way
        clock = Unwrapper(30.0)
        found = [
            clock.push(times(reading % 30), NOW + times(at))
            for reading, at in ((11, 1), (11 + pause, 1 + arrived))
        ]
        assert (np.concatenate(found)[1] - found[0][0]) / SECOND == pause


@pytest.mark.parametrize("arrivals", [[0, 0], [0, NOW], [NOW, 0]])
def test_unknown_arrival_times_count_no_turns(arrivals: list[int]) -> None:
    clock = Unwrapper(30.0)
    found = np.concatenate(
        [
            clock.push(times(at), np.array([host], np.int64))
            for at, host in zip((10, 11), arrivals, strict=True)
        ]
    )
    assert np.diff(found).tolist() == [SECOND]


def test_readings_run_on_over_a_hundred_turns_also_when_late() -> None:
    rng = np.random.default_rng(1)
    true = np.cumsum(rng.integers(1, 4_000_000_000, 1000)) + 7
    true[500], true[501] = true[501], true[500]
    clock = Unwrapper(30.0)
    assert true[-1] // (30 * SECOND) > 60
    found = np.concatenate(
        [
            clock.push(part % (30 * SECOND), np.zeros(len(part), np.int64))
            for part in np.array_split(true, 37)
        ]
    )
    assert (found - found[0] == true - true[0]).all()


def test_a_late_reading_from_before_the_wrap_goes_back() -> None:
    clock = Unwrapper(30.0)
    found = clock.push(times(29, 1, 29.5, 2), np.zeros(4, np.int64))
    assert ((found - found[0]) / SECOND).tolist() == [0, 2, 0.5, 3]


def test_a_clock_in_an_array_is_refused_before_any_bytes() -> None:
    frame = Struct("b" / Array(2, Struct("t" / Scaled(Int16ul, 0.001, "s"), "d" / Int8ub)))
    refused = dataclasses.replace(sensor(frame), clock=Clock("b.t"))
    with pytest.raises(SpecError, match=r"b\.t"):
        refused.decode([])
    with pytest.raises(SpecError, match="when"):
        dataclasses.replace(sensor(frame), clock=Clock("when")).decode([])


def wide(numbers: Iterable[int]) -> list[bytes]:
    return [number.to_bytes(8, "little") + b"\1" for number in numbers]


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_counter_of_64_bits_counts_losses_and_starts_again(first: int, backend: str) -> None:
    counted = dataclasses.replace(
        sensor(Struct("n" / Int64ul, "d" / Int8ub)), sequence=PacketCounter("n", first=first)
    )
    turn = [2**63 - 1, 2**63, 2**64 - 2, 2**64 - 1, first, first + 1]
    for numbers, lost in (
        ([1, 2, 3, 7, 8], 3),
        (turn[:2], 0),
        (turn[2:], 0),
        ([2**64 - 3, first + 1], 3),
    ):
        stats = reader(counted, backend).decode(wide(numbers)).stats
        assert (stats.lost, stats.late, stats.duplicates, stats.plugin_errors) == (lost, 0, 0, 0), (
            numbers
        )
    # It was switched off and on.
    packets = reader(counted, backend).decode(wide([10**18, 5, 6, 2**63, 2**63 + 1]))
    assert (packets.stats.lost, packets.stats.plugin_errors) == (0, 0)
    assert np.diff(packets.index)[[1, 3]].tolist() == [1, 1]
