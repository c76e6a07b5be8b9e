"""Tests of the offsets of TAI and GPS time from UTC, read from the tables of a computer."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from lidarspec import leap_seconds
from lidarspec.leap_seconds import BUILT_IN, LeapSeconds, parse_leap_seconds, read_leap_seconds

# Excerpts of the files of the tz database, 2025b.
ZONE_TABLE = """\
# The correction (+ or -) is made at the given time.
Leap\t2012\tJun\t30\t23:59:60\t+\tS
Leap\t2015\tJun\t30\t23:59:60\t+\tS
Leap\t2016\tDec\t31\t23:59:60\t+\tS
#updated 1751846400 (2025-07-07 00:00:00 UTC)
#expires 1782604800 (2026-06-28 00:00:00 UTC)
"""
NTP_TABLE = """\
#@\t3991593600
3550089600      35      # 1 Jul 2012
3644697600      36      # 1 Jul 2015
3692217600      37      # 1 Jan 2017
"""
NEW_YEAR_2017 = datetime(2017, 1, 1, tzinfo=UTC).timestamp()


@pytest.fixture
def computer(tmp_path, monkeypatch):
    """Simulate a computer whose only time zone folder is empty; yield the folder."""
    monkeypatch.setattr(leap_seconds.zoneinfo, "TZPATH", (str(tmp_path),))
    monkeypatch.setattr(leap_seconds.importlib.util, "find_spec", lambda name: None)
    read_leap_seconds.cache_clear()
    yield tmp_path
    read_leap_seconds.cache_clear()


def test_both_formats_give_the_same_offsets():
    zone = parse_leap_seconds(ZONE_TABLE)
    ntp = parse_leap_seconds(NTP_TABLE)
    # The excerpt counts from 10 s in 1972; 25 leap seconds are missing, three are in it.
    assert [offset - 10 for offset in zone.offsets_s] == [0, 1, 2, 3]
    assert ntp.offsets_s == (35, 36, 37)
    assert zone.starts_s[1:] == ntp.starts_s
    assert zone.expires_s == ntp.expires_s == datetime(2026, 6, 28, tzinfo=UTC).timestamp()


def test_the_offset_changes_at_midnight():
    table = parse_leap_seconds(NTP_TABLE)
    assert table.tai_minus_utc(NEW_YEAR_2017 - 0.001) == 36
    assert table.tai_minus_utc(NEW_YEAR_2017) == 37
    assert table.gps_minus_utc(NEW_YEAR_2017 - 0.001) == 17
    assert table.gps_minus_utc(NEW_YEAR_2017) == 18


@pytest.mark.parametrize("seconds", [-1.5, -0.001, 0.0, 0.001, 1e6])
def test_utc_from_tai_is_the_inverse(seconds):
    table = parse_leap_seconds(NTP_TABLE)
    utc = NEW_YEAR_2017 + seconds
    assert table.utc_from_tai(utc + table.tai_minus_utc(utc)) == utc


def test_a_leap_second_repeats_the_second_before_it():
    table = parse_leap_seconds(NTP_TABLE)
    assert table.utc_from_tai(NEW_YEAR_2017 + 35.5) == NEW_YEAR_2017 - 0.5
    assert table.utc_from_tai(NEW_YEAR_2017 + 36.5) == NEW_YEAR_2017 - 0.5
    assert table.utc_from_tai(NEW_YEAR_2017 + 37) == NEW_YEAR_2017


def test_a_table_expires():
    table = parse_leap_seconds(ZONE_TABLE)
    assert not table.has_expired(1_782_604_799)
    assert table.has_expired(1_782_604_800)
    assert not BUILT_IN.has_expired(1e12)


def test_without_a_table_the_present_offsets_apply(computer):
    assert read_leap_seconds() is BUILT_IN
    assert BUILT_IN.tai_minus_utc(1.8e9) == 37
    assert BUILT_IN.gps_minus_utc(1.8e9) == 18


def test_the_table_that_expires_last_is_read(computer):
    older = NTP_TABLE.replace("3991593600", "3991593599")
    (computer / "leap-seconds.list").write_text(older)
    assert read_leap_seconds().path == str(computer / "leap-seconds.list")
    (computer / "leapseconds").write_text(ZONE_TABLE)
    read_leap_seconds.cache_clear()
    assert read_leap_seconds().path == str(computer / "leapseconds")


def test_a_file_without_leap_seconds_is_ignored(computer):
    (computer / "leapseconds").write_text("no table\n")
    assert read_leap_seconds() is BUILT_IN


@pytest.mark.parametrize("name", leap_seconds.FILES)
def test_tables_of_this_computer(name):
    paths = [path for path in leap_seconds._iter_files() if path.name == name and path.exists()]
    if not paths:
        pytest.skip(f"this computer has no {name}")
    table: LeapSeconds = parse_leap_seconds(Path(paths[0]).read_text("utf-8"))
    assert table.tai_minus_utc(NEW_YEAR_2017) == 37
    assert table.tai_minus_utc(0) == 10
