"""Leap seconds: the offsets of TAI and GPS time from UTC.

The dates of the leap seconds are read from the newest table of the operating system or of the
package tzdata. Without a table, the offset since 2017 is used for all times. GPS time is always
19 s behind TAI.

Source: IERS Bulletin C; tz database, `leapseconds`; NIST, `leap-seconds.list`.
"""

from __future__ import annotations

import functools
import importlib.util
import zoneinfo
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: TAI minus UTC since 2017; the next constant is TAI minus UTC before the first leap second in
#: 1972, s.
CURRENT_TAI_OFFSET_S = 37
FIRST_TAI_OFFSET_S = 10
#: TAI minus GPS time, s.
TAI_MINUS_GPS_S = 19
#: Seconds from 1900, the start of NTP time, to 1970.
NTP_EPOCH_S = 2_208_988_800
FILES = ("leapseconds", "leap-seconds.list")


@dataclass(frozen=True)
class LeapSeconds:
    """The offset of TAI from UTC at any time since 1972.

    Attributes:
        starts_s: the times at which the offsets begin to apply, seconds since 1970, ascending.
        offsets_s: TAI minus UTC after each of these times, s.
        expires_s: the time after which the table may lack leap seconds, seconds since 1970; None if
            the table does not expire.
        path: the file with the table; "" for the built-in offset.
    """

    starts_s: tuple[int, ...]
    offsets_s: tuple[int, ...]
    expires_s: int | None = None
    path: str = ""

    def tai_minus_utc(self, utc_s: float) -> int:
        """Return TAI minus UTC in seconds at a UTC time (seconds since 1970)."""
        index = bisect_right(self.starts_s, utc_s) - 1
        return self.offsets_s[max(index, 0)]

    def gps_minus_utc(self, utc_s: float) -> int:
        """Return GPS time minus UTC in seconds at a UTC time (seconds since 1970)."""
        return self.tai_minus_utc(utc_s) - TAI_MINUS_GPS_S

    def offsets_by_scale(self, utc_s: float) -> dict[str, int]:
        """Return the offsets of "utc", "tai" and "gps" from UTC in seconds, by name.

        Args:
            utc_s: the time at which the offsets are valid, seconds since 1970.
        """
        return {
            "utc": 0,
            "tai": self.tai_minus_utc(utc_s),
            "gps": self.gps_minus_utc(utc_s),
        }

    def utc_from_tai(self, tai_s: ArrayLike) -> NDArray[Any]:
        """Return the UTC of times in TAI; both are seconds since 1970.

        UTC has no number for a leap second. A time within it gets the UTC of one second earlier.

        Args:
            tai_s: the times, of any shape.

        Returns:
            the same shape; integers remain integers.
        """
        offsets_s = np.array(self.offsets_s)
        offsets_before_s = np.concatenate([offsets_s[:1], offsets_s[:-1]])
        starts_tai_s = np.array(self.starts_s) + offsets_before_s
        index = np.searchsorted(starts_tai_s, tai_s, side="right") - 1
        utc_s: NDArray[Any] = np.asarray(tai_s) - offsets_s[np.maximum(index, 0)]
        return utc_s

    def has_expired(self, utc_s: float) -> bool:
        """Return whether the table may lack leap seconds up to a time (seconds since 1970)."""
        return self.expires_s is not None and utc_s >= self.expires_s


BUILT_IN = LeapSeconds((0,), (CURRENT_TAI_OFFSET_S,))


@functools.lru_cache(maxsize=1)
def read_leap_seconds() -> LeapSeconds:
    """Return the table with the latest expiry date on this computer.

    Returns `BUILT_IN` if this computer has no table.
    """
    tables = list[LeapSeconds]()
    for path in _iter_files():
        try:
            tables.append(parse_leap_seconds(path.read_text("utf-8"), str(path)))
        except (OSError, ValueError):
            continue  # another file may be readable
    return max(tables, key=lambda table: table.expires_s or 0, default=BUILT_IN)


def parse_leap_seconds(text: str, path: str = "") -> LeapSeconds:
    """Return the table in a text in the format `leapseconds` or `leap-seconds.list`.

    Raises:
        ValueError: if the text has no leap seconds.
    """
    if "\nLeap" in text or text.startswith("Leap"):
        return _parse_zone_table(text, path)
    return _parse_ntp_table(text, path)


def _iter_files() -> Iterator[Path]:
    """Yield the paths at which this computer may have a table."""
    folders = [Path(folder) for folder in zoneinfo.TZPATH]
    package = importlib.util.find_spec("tzdata")
    if package is not None and package.origin is not None:
        folders.append(Path(package.origin).parent / "zoneinfo")
    for folder in folders:
        for name in FILES:
            yield folder / name


def _parse_zone_table(text: str, path: str) -> LeapSeconds:
    """Return the table of lines such as "Leap 2016 Dec 31 23:59:60 + S"."""
    starts = list[int]()
    offsets = list[int]()
    offset = FIRST_TAI_OFFSET_S
    expires: int | None = None
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["#expires"]:
            expires = int(words[1])
        if words[:1] != ["Leap"]:
            continue
        _, year, month, day, _, sign = words[:6]
        date = datetime.strptime(f"{year} {month} {day}", "%Y %b %d").replace(tzinfo=UTC)
        if not starts:
            starts.append(0)
            offsets.append(offset)
        if sign == "+":
            offset += 1
        else:
            offset -= 1
        starts.append(int((date + timedelta(days=1)).timestamp()))
        offsets.append(offset)
    if not starts:
        raise ValueError(path)
    return LeapSeconds(tuple(starts), tuple(offsets), expires, path)


def _parse_ntp_table(text: str, path: str) -> LeapSeconds:
    """Return the table of lines such as "3692217600 37 # 1 Jan 2017"."""
    starts = list[int]()
    offsets = list[int]()
    expires: int | None = None
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["#@"]:
            expires = int(words[1]) - NTP_EPOCH_S
        if words and not words[0].startswith("#"):
            starts.append(int(words[0]) - NTP_EPOCH_S)
            offsets.append(int(words[1]))
    if not starts:
        raise ValueError(path)
    return LeapSeconds(tuple(starts), tuple(offsets), expires, path)
