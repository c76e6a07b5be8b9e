"""Scans with distances of two or three characters, or with distances and intensities.

ME and GE request a distance and an intensity of three characters each. ND, NE, HD and HE request
the same for each echo of a step, with "&" between echoes. Several steps can be merged to a cluster,
for which the scanner sends one distance, the shortest. It is assumed that a last cluster with fewer
steps is sent as well, and that the direction of a cluster is the direction of its middle. A step is
assumed to have at most three echoes, as in Hokuyo's urg_library.

Source: SCIP 2.0, C-42-03320B, sections 5 (steps), 6 (characters), 8.1 (MD and MS, time, errors) and
8.2 (GD and GS); UTM-30LX-EW, C-42-03886 (intensities and echoes).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from construct import Array, Const, Int8ub, Int16ub, Int24ub, Int32ub, OneOf, Struct, this

from lidarspec.spec import Echoes, Fields, Frame, Lines, Polar, Scaled, Scip, SixBits

LINE_CHARACTERS = 64  # of data
#: Echoes per step -> maximum characters of a scan. 1081 distances with intensities need 6727, with
#: three echoes each 22,327.
MAX_SCAN_CHARACTERS = {1: 7000, 3: 23_000}
MAX_ECHOES = 3  # per step
CLOCK_WRAP_S = 2**24 * 1e-3
MIN_RANGE_M = 0.02  # lower values are error codes (tables 3 and 4)
#: Kind -> the commands for continuous scans and for one scan.
SCAN_COMMANDS = {
    "distances": ("MD", "GD"),
    "intensities": ("ME", "GE"),
    "short": ("MS", "GS"),
    "echoes": ("ND", "HD"),
    "echo_intensities": ("NE", "HE"),
}
DIGITS = {2: ("tens", "ones"), 4: ("thousands", "hundreds", "tens", "ones")}
FIELDS: dict[str, Any] = {
    "S": Struct("distance" / Scaled(Int16ub, 0.001, "m")),
    "D": Struct("distance" / Scaled(Int24ub, 0.001, "m")),
    "E": Struct("distance" / Scaled(Int24ub, 0.001, "m"), "intensity" / Int24ub),
}


@dataclass(frozen=True)
class Geometry:
    """The steps and the rotation of a scanner.

    Attributes:
        division: the number of steps of a full revolution.
        first: the first step that the scanner measures.
        last: the last step that the scanner measures.
        ahead: the step straight ahead.
        end: the highest step that can be requested.
        rate: the revolutions per second.
    """

    division: int
    first: int
    last: int
    ahead: int
    end: int
    rate: float
    kinds: tuple[str, ...]


@dataclass(frozen=True)
class RequestedSteps:
    """The requested steps, and the number of steps that are merged to one distance."""

    first: int
    last: int
    cluster: int

    @property
    def text(self) -> bytes:
        """The steps as they are written in a command."""
        return f"{self.first:04}{self.last:04}{self.cluster:02}".encode()


def make_decimal(name: str, places: int, most: int = 9999) -> Any:
    """Return the struct of a decimal number, with a field for each digit.

    Args:
        most: the largest number; it limits the first digit if there are four digits.
    """
    first = most // 10 ** (places - 1) if places == 4 else 9
    largest = (first, *[9] * (places - 1))
    digits = zip(DIGITS[places], largest, strict=True)
    return name / Struct(
        *(digit_name / Scaled(OneOf(Int8ub, range(high + 1)), 1, "") for digit_name, high in digits)
    )


def decimal_value(digits: Any) -> Any:
    """Return the value of a `make_decimal` struct with four digits."""
    return digits.thousands * 1000 + digits.hundreds * 100 + two_digit_value(digits)


def two_digit_value(digits: Any) -> Any:
    """Return the value of the tens and ones of a `make_decimal` struct."""
    return digits.tens * 10 + digits.ones


def split_digits(name: str, value: int, places: int) -> dict[str, int]:
    """Return the digits of `value`, keyed by their paths in the struct `name`."""
    return {
        f"{name}.{digit_name}": int(digit)
        for digit_name, digit in zip(DIGITS[places], f"{value:0{places}}", strict=True)
    }


def cluster_size(f: Any) -> Any:
    """Return the number of steps of a cluster; 00 means one step."""
    return two_digit_value(f.cluster) + (two_digit_value(f.cluster) == 0)


def distance_count(f: Any) -> Any:
    """Return the number of distances in a scan."""
    return (decimal_value(f.last) - decimal_value(f.first)) // cluster_size(f) + 1


def plausible(f: Fields, end: int) -> Any:
    """Return whether the steps are in order and at most `end`."""
    return (decimal_value(f.last) <= end) & (decimal_value(f.first) <= decimal_value(f.last))


def points(f: Fields, geometry: Geometry, echoes: int) -> Polar:
    """Return the points of a scan, counter-clockwise from the first step."""
    step = decimal_value(f.first) + f.points.index * cluster_size(f) + (cluster_size(f) - 1) / 2
    returns = f.points if echoes == 1 else f.points.echoes
    return Polar(
        range=returns.distance,
        azimuth=(step - geometry.ahead) * (2 * np.pi / geometry.division),
        intensity=getattr(returns, "intensity", None),
        time=step / (geometry.division * geometry.rate),
        return_index=None if echoes == 1 else np.arange(echoes),
        invalid=returns.distance < MIN_RANGE_M,
    )


@cache
def make_scan_frame(command: str, geometry: Geometry) -> Frame:
    """Return the frame of a scan, which is the reply to a command."""
    is_continuous = command[0] in "MN"
    echoes = MAX_ECHOES if command[0] in "NH" else 1
    fields = FIELDS[command[1]]
    rest: tuple[Any, ...] = ()
    if is_continuous:
        rest = (
            "skip" / Int8ub * "number of revolutions that are skipped between two scans",
            make_decimal("left", 2) * "number of scans that remain; 0: unlimited",
        )
    struct = Struct(
        "command" / Const(command.encode()),
        make_decimal("first", 4, geometry.end) * "number of the first step",
        make_decimal("last", 4, geometry.end) * "number of the last step",
        make_decimal("cluster", 2) * "number of steps that are combined into one distance",
        *rest,
        "status" / Const(b"99" if is_continuous else b"00"),
        "time" / Scaled(Int32ub, 0.001, "s") * "time at step 0; the time has 24 bits",
        "points"
        / Array(
            distance_count(this),
            fields if echoes == 1 else Struct("echoes" / Array(echoes, fields)),
        ),
    )
    return Frame(
        struct,
        data=True,
        max_length=MAX_SCAN_CHARACTERS[echoes],
        plausible=partial(plausible, end=geometry.end),
        points=partial(points, geometry=geometry, echoes=echoes),
        acknowledged={
            "LS711": "the first of the four digits of a step number is always 0, because this model"
            " has fewer than 1000 steps"
        }
        if geometry.end < 1000
        else {},
        wire=Lines(LINE_CHARACTERS, head=(15 if is_continuous else 12, 2, 4), bare=1, check=Scip())
        | SixBits(echoes=None if echoes == 1 else Echoes(fields.sizeof(), echoes)),
    )


def pace(f: Fields, rate: float) -> Any:
    """Return the seconds from a scan to the next; nan for a scan that was requested singly.

    Source: SCIP 2.0, 8.1.

    Args:
        rate: revolutions per second.
    """
    skipped = getattr(f, "skip", None)
    return np.nan if skipped is None else (1 + skipped) / rate


def sweep(i: int, geometry: Geometry, requested: RequestedSteps) -> dict[str, Any]:
    """Return the values of simulated scan i."""
    steps = (
        split_digits("first", requested.first, 4)
        | split_digits("last", requested.last, 4)
        | split_digits("cluster", requested.cluster, 2)
    )
    return {
        **steps,
        "skip": 0,
        **split_digits("left", 0, 2),
        "time": i / geometry.rate % CLOCK_WRAP_S,
    }
