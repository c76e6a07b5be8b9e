"""Format physical values with the decimals that their fields can distinguish."""

from __future__ import annotations

import functools

from lidarspec.spec.tree import FieldInfo, to_exact

#: The maximum number of decimals that are printed to distinguish all values of a field.
MAX_DIGITS = 12
#: The maximum number of further decimals that are printed to make each value exact.
MAX_EXTRA_DIGITS = 2


def count_decimals(info: FieldInfo) -> int | None:
    """Return the number of decimals to print of a field's values; None for a float field."""
    if info.kind == "float":
        return None
    return _count_digits(info.scale, info.offset)


@functools.lru_cache
def _count_digits(scale: float, offset: float) -> int:
    """Return the number of decimals that make all values of a field differ.

    Up to `MAX_EXTRA_DIGITS` more decimals are used if each value is then exact.
    """
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


def format_fixed(value: float, digits: int | None) -> str:
    """Format a number with `digits` decimals, and zero without a minus sign.

    If `digits` is None, the text has seven significant digits.
    """
    if digits is None:
        text = f"{value:.7g}"
    else:
        text = f"{value:.{digits}f}"
    if text.strip("-0."):
        return text
    return text.removeprefix("-")
