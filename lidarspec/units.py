"""Units of physical values, by name, and exact conversions of the few that the engine itself needs."""

from __future__ import annotations

import re
from fractions import Fraction

from lidarspec.errors import UsageError

#: unit -> how many of the SI unit it is; only units that someone may type on the command line.
_FACTORS: dict[str, dict[str, Fraction]] = {
    "m": {"m": Fraction(1), "cm": Fraction(1, 100), "mm": Fraction(1, 1000)},
    "s": {"s": Fraction(1), "ms": Fraction(1, 1000), "us": Fraction(1, 10**6), "ns": Fraction(1, 10**9)},
    "deg": {"deg": Fraction(1)},
    "rad": {"rad": Fraction(1)},
    "deg/s": {"deg/s": Fraction(1), "Hz": Fraction(360), "rpm": Fraction(6)},
    "Hz": {"Hz": Fraction(1), "rpm": Fraction(1, 60)},
    "rpm": {"rpm": Fraction(1), "Hz": Fraction(60)},
}


def exact(number: float | int) -> Fraction:
    """The decimal number that was written, not the binary one nearest to it: 0.001 is 1/1000."""
    return Fraction(repr(float(number))) if isinstance(number, float) else Fraction(number)


def factor(unit: str, target: str) -> Fraction | None:
    """How many `target` one `unit` is, or None where the two measure different things."""
    if unit == target:
        return Fraction(1)
    return _FACTORS.get(target, {}).get(unit)


def split_unit(text: str) -> tuple[str, str]:
    """A number and its unit out of "324.27deg"; the unit is empty where there is none."""
    known = sorted({unit for table in _FACTORS.values() for unit in table}, key=len, reverse=True)
    for unit in known:
        if text.endswith(unit) and _is_number(text[: -len(unit)]):
            return text[: -len(unit)].strip(), unit
    return text, ""


def slug(unit: str) -> str:
    """A unit as part of a name: "deg/s" is "deg_s"."""
    return re.sub(r"\W+", "_", unit).strip("_").lower()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def duration(text: str) -> float:
    """Seconds out of "10s", "500ms", "2min", or a bare number of seconds.

    Raises:
        UsageError: where it is no duration, or a negative one.
    """
    for unit, seconds in (("min", 60.0), ("ms", 1e-3), ("us", 1e-6), ("h", 3600.0), ("s", 1.0), ("", 1.0)):
        number = text.strip().removesuffix(unit)
        if text.strip().endswith(unit) and _is_number(number) and 0 <= float(number) < float("inf"):
            return float(number) * seconds
    raise UsageError(f"{text!r} is no duration: a number with ms, s, min or h, such as 10s")
