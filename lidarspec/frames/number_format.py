"""Format physical values with enough decimals to distinguish the values of a field."""

from __future__ import annotations

import functools
from typing import NamedTuple

from lidarspec.spec.tree import FieldInfo, to_exact

#: The maximum number of decimals that are printed to distinguish all values of a field.
MAX_DIGITS = 12
#: The maximum number of further decimals that are printed to make each value exact.
MAX_EXTRA_DIGITS = 2


#: The number of significant digits that are printed of a 64-bit float, and of a shorter float.
DOUBLE_DIGITS = 15
FLOAT_DIGITS = 7


class NumberFormat(NamedTuple):
    """The digits with which the values of a field are printed.

    Attributes:
        decimals: the number of decimals; None if the number of significant digits is fixed.
        significant: the number of significant digits if `decimals` is None.
    """

    decimals: int | None
    significant: int = 0

    def format(self, value: float) -> str:
        """Format a number. Zero has no minus sign."""
        if self.decimals is not None:
            return format_fixed(value, self.decimals)
        return _remove_sign_of_zero(f"{value:.{self.significant}g}")


#: The format of numbers without decimals.
WHOLE = NumberFormat(0)


def find_number_format(info: FieldInfo) -> NumberFormat:
    """Return the digits that distinguish the values of a field."""
    if info.kind != "float":
        return NumberFormat(_count_digits(info.scale, info.offset))
    return NumberFormat(None, DOUBLE_DIGITS if info.bits > 32 else FLOAT_DIGITS)


@functools.lru_cache
def _count_digits(scale: float, offset: float) -> int:
    """Return the number of decimals that make all values of a field differ."""
    steps = (to_exact(scale), to_exact(offset))
    distinguishing = next(
        (digits for digits in range(MAX_DIGITS) if abs(steps[0]) * 10**digits >= 1), MAX_DIGITS
    )
    return next(
        (
            digits
            for digits in range(distinguishing, distinguishing + MAX_EXTRA_DIGITS + 1)
            if all(step * 10**digits % 1 == 0 for step in steps)
        ),
        distinguishing,
    )


def format_fixed(value: float, decimals: int) -> str:
    """Format a number with this number of decimals. Zero has no minus sign."""
    return _remove_sign_of_zero(f"{value:.{decimals}f}")


def _remove_sign_of_zero(text: str) -> str:
    if text.strip("-0."):
        return text
    return text.removeprefix("-")
