"""Tests of dates, and of what a clock counts."""

from __future__ import annotations

import datetime

import numpy as np
import pytest

import lidarspec as ls
from lidarspec.errors import SpecError
from lidarspec.spec import Clock, ClockState, ClockStatus, unix_time
from tests.shapes import SHAPES

EPOCH = datetime.date(1970, 1, 1)
FIRST = datetime.date(1900, 1, 1).toordinal()
LAST = datetime.date(2405, 1, 1).toordinal()


def test_every_day_of_five_centuries_agrees_with_datetime() -> None:
    days = [datetime.date.fromordinal(number) for number in range(FIRST, LAST)]
    year, month, day = np.array([(each.year, each.month, each.day) for each in days]).T
    expected = [86_400 * (each - EPOCH).days for each in days]
    np.testing.assert_array_equal(unix_time(year, month, day), expected)


def test_time_of_day_is_added() -> None:
    moment = datetime.datetime(2024, 2, 29, 23, 59, 58, tzinfo=datetime.UTC)
    assert unix_time(2024, 2, 29, 23, 59, 58) == moment.timestamp()


def test_arguments_broadcast() -> None:
    hours = np.arange(24)[:, None]
    assert unix_time(np.array([2000, 2001]), 1, 1, hours).shape == (24, 2)


def test_a_clock_refuses_an_epoch_that_it_cannot_count() -> None:
    with pytest.raises(SpecError) as unknown:
        Clock("time", epoch="utz")
    assert unknown.value.path == "clock.epoch"
    with pytest.raises(SpecError) as endless:
        Clock("time", epoch="hour")
    assert endless.value.path == "clock.wraps_at"
    with pytest.raises(SpecError):
        ClockState("locked", True, epoch="gpt")
    with pytest.raises(SpecError):
        ClockStatus("sync", {})


def test_a_state_of_the_clock_has_its_own_epoch_or_that_of_the_clock() -> None:
    free = ClockState("not locked", False, epoch="boot")
    locked = ClockState("locked", True)
    status = ClockStatus("sync", {0: free, 1: locked})
    clock = Clock("time", epoch="tai", status=status)
    assert clock.epoch_in(status.state_of(0)) == "boot"
    assert clock.epoch_in(status.state_of(1)) == "tai"
    assert status.state_of(7).locked is None
    assert status.state_of(np.nan).locked is None


def test_the_option_epoch_replaces_that_of_the_clock() -> None:
    configured = SHAPES["shape-synced"].configure(epoch="utc").configure(frame="rep103")
    assert configured.clock is not None
    assert configured.clock.epoch == "utc"


@pytest.mark.parametrize(
    ("shape", "epoch"),
    [("shape-synced", "utz"), ("shape-synced", "hour"), ("shape-count", "utc")],
)
def test_the_option_epoch_must_fit_the_clock(shape: str, epoch: str) -> None:
    with pytest.raises(ls.UsageError):
        SHAPES[shape].configure(epoch=epoch)
