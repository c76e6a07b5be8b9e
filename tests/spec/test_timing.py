"""Tests that `unix_time` converts dates like the standard library."""

from __future__ import annotations

import datetime

import numpy as np

from lidarspec.spec import unix_time

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
