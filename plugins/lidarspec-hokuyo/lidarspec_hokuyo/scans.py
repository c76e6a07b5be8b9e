"""The scans that a scanner sends: distances of two or three characters, or distances with
intensities; of one echo, or of up to three.

Source: SCIP 2.0, C-42-03320B: characters (6), steps (5), MD and MS with the time and the errors
(8.1), GD and GS (8.2). ME and GE send a distance and an intensity of three characters each
(UTM-30LX-EW, C-42-03886). ND, NE, HD and HE send the same for each echo of a step, with "&" between
them (C-42-03886). A cluster of steps comes as one distance, its shortest; that a last cluster of
fewer steps comes too, that a cluster is seen in its middle, and that a step has three echoes at
most (Hokuyo's urg_library makes room for three), is assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from construct import Array, Const, Int8ub, Int16ub, Int24ub, Int32ub, OneOf, Struct, this

from lidarspec.spec import Echoes, Fields, Frame, Lines, Polar, Scaled, Scip, SixBits

WIDTH = 64  # characters of a line of data
LONGEST = {
    1: 7000,
    3: 23_000,
}  # characters by echoes: 1081 distances with intensities take 6727, with three echoes each 22,327
ECHOES = 3  # of a step, at most
WRAP = 2**24 * 1e-3  # seconds after which the clock starts again
LEAST = 0.02  # metres: what is below is the number of an error (tables 3 and 4)
#: kind -> the commands for scan after scan, and for one.
KINDS = {
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
    """Where a scanner looks, and how.

    Attributes:
        division: steps of a whole turn.
        first, last, ahead: the first and the last step that it measures, and the one straight
            ahead.
        end: the highest step that can be asked for.
        rate: turns a second.
        kinds: of scans that it sends.
    """

    division: int
    first: int
    last: int
    ahead: int
    end: int
    rate: float
    kinds: tuple[str, ...]


@dataclass(frozen=True)
class Asked:
    """Which steps are asked for, and how many of them come as one distance."""

    first: int
    last: int
    cluster: int

    @property
    def text(self) -> bytes:
        """The same as in a command."""
        return f"{self.first:04}{self.last:04}{self.cluster:02}".encode()


def decimal(name: str, places: int, most: int = 9999) -> Any:
    """A number of so many decimal digits, the first of them no larger than that of the largest
    number.
    """
    first = most // 10 ** (places - 1) if places == 4 else 9
    largest = (first, *[9] * (places - 1))
    digits = zip(DIGITS[places], largest, strict=True)
    return name / Struct(
        *(place / Scaled(OneOf(Int8ub, range(high + 1)), 1, "") for place, high in digits)
    )


def number(digits: Any) -> Any:
    """What digits of a `decimal` say."""
    return digits.thousands * 1000 + digits.hundreds * 100 + two(digits)


def two(digits: Any) -> Any:
    """What two digits say."""
    return digits.tens * 10 + digits.ones


def digits(name: str, value: int, places: int) -> dict[str, int]:
    """Return the digits of a number, by their paths."""
    return {
        f"{name}.{place}": int(digit)
        for place, digit in zip(DIGITS[places], f"{value:0{places}}", strict=True)
    }


def width(f: Any) -> Any:
    """Return the steps of a cluster, of which 00 means one too."""
    return two(f.cluster) + (two(f.cluster) == 0)


def count(f: Any) -> Any:
    """How many distances there are."""
    return (number(f.last) - number(f.first)) // width(f) + 1


def plausible(f: Fields, end: int) -> Any:
    """Return the steps are those of the scanner."""
    return (number(f.last) <= end) & (number(f.first) <= number(f.last))


def points(f: Fields, geometry: Geometry, echoes: int) -> Polar:
    """Points from the first step on, counter-clockwise; a distance below the shortest is the number
    of an error, or no echo.
    """
    step = number(f.first) + f.points.index * width(f) + (width(f) - 1) / 2
    seen = f.points if echoes == 1 else f.points.echoes
    return Polar(
        range=seen.distance,
        azimuth=(step - geometry.ahead) * (2 * np.pi / geometry.division),
        intensity=getattr(seen, "intensity", None),
        time=step / (geometry.division * geometry.rate),
        return_index=None if echoes == 1 else np.arange(echoes),
        invalid=seen.distance < LEAST,
    )


@cache
def scan(command: str, geometry: Geometry) -> Frame:
    """Return the answer to a command for scans."""
    goes_on = command[0] in "MN"
    echoes = ECHOES if command[0] in "NH" else 1
    fields = FIELDS[command[1]]
    rest: tuple[Any, ...] = ()
    if goes_on:
        rest = (
            "skip" / Int8ub * "turns left out between scans",
            decimal("left", 2) * "scans to come; 0: on and on",
        )
    struct = Struct(
        "command" / Const(command.encode()),
        decimal("first", 4, geometry.end) * "step",
        decimal("last", 4, geometry.end) * "step",
        decimal("cluster", 2) * "steps that come as one distance",
        *rest,
        "status" / Const(b"99" if goes_on else b"00"),
        "time" / Scaled(Int32ub, 0.001, "s") * "when the turn was at step 0; 24 bits",
        "points"
        / Array(count(this), fields if echoes == 1 else Struct("echoes" / Array(echoes, fields))),
    )
    return Frame(
        struct,
        data=True,
        max_length=LONGEST[echoes],
        plausible=partial(plausible, end=geometry.end),
        points=partial(points, geometry=geometry, echoes=echoes),
        acknowledged={"LS711": "it has no step of four digits"} if geometry.end < 1000 else {},
        wire=Lines(WIDTH, head=(15 if goes_on else 12, 2, 4), bare=1, check=Scip())
        | SixBits(echoes=None if echoes == 1 else Echoes(fields.sizeof(), echoes)),
    )


def pace(f: Fields, rate: float) -> Any:
    """Return the seconds from a scan to the next, nan if scans are asked for one by one.

    Turns are left out between scans as the command asks for (SCIP 2.0, 8.1).

    Args:
        rate: turns a second.
    """
    skipped = getattr(f, "skip", None)
    return np.nan if skipped is None else (1 + skipped) / rate


def sweep(i: int, geometry: Geometry, asked: Asked) -> dict[str, Any]:
    """Scan i of those that were asked for."""
    steps = (
        digits("first", asked.first, 4)
        | digits("last", asked.last, 4)
        | digits("cluster", asked.cluster, 2)
    )
    return {**steps, "skip": 0, **digits("left", 0, 2), "time": i / geometry.rate % WRAP}
