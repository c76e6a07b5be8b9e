"""Colours by number: what each ink looks like with true colour, 256 colours, 16, or none.

Pictures hold numbers, so that two of them are compared cell by cell; only the terminal knows what it can show.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Depth = Literal["truecolor", "256", "standard", "none"]
Rgb = tuple[int, int, int]

#: colours of a ramp; few, so that noise in a range does not make every cell change with every scan.
STEPS = 20
#: near to far: hues that stay bright on a dark ground.
_RANGE: tuple[Rgb, ...] = ((255, 92, 87), (255, 170, 60), (236, 220, 72), (96, 216, 110), (64, 208, 220), (92, 150, 255), (186, 128, 255))
#: weak to strong.
_INTENSITY: tuple[Rgb, ...] = ((92, 78, 190), (160, 70, 190), (226, 84, 140), (255, 138, 84), (255, 204, 92), (255, 250, 190))
#: the same two for 16 colours.
_RANGE_16, _INTENSITY_16 = (91, 33, 92, 96, 94, 95), (34, 35, 95, 31, 93, 97)


@dataclass(frozen=True)
class Ink:
    """A colour and weight; `rgb` None is the terminal's own colour, `standard` the SGR number of the nearest of 16."""

    rgb: Rgb | None = None
    standard: int | None = None
    bold: bool = False
    faint: bool = False


def _ramp(stops: Sequence[Rgb], standard: Sequence[int]) -> list[Ink]:
    places = np.linspace(0, len(stops) - 1, STEPS)
    channels = [np.interp(places, range(len(stops)), [stop[channel] for stop in stops]) for channel in range(3)]
    nearest = np.minimum(np.arange(STEPS) * len(standard) // STEPS, len(standard) - 1)
    return [Ink((round(r), round(g), round(b)), standard[n]) for r, g, b, n in zip(*channels, nearest.tolist(), strict=True)]


PLAIN, STRONG, FAINT, LABEL, GOOD, ALARM = range(6)
_FIXED = (
    Ink(),
    Ink(bold=True),
    Ink((98, 100, 112), 90, faint=True),
    Ink((150, 154, 168), 37),
    Ink((96, 216, 110), 92, bold=True),
    Ink((255, 92, 87), 91, bold=True),
)
#: the first ink of each ramp, by what it shows.
RAMPS = {"range": len(_FIXED), "intensity": len(_FIXED) + STEPS}
INKS: tuple[Ink, ...] = (*_FIXED, *_ramp(_RANGE, _RANGE_16), *_ramp(_INTENSITY, _INTENSITY_16))


@functools.cache
def sgr(ink: int, depth: Depth) -> str:
    """The escape sequence that selects an ink, from whatever was selected before.

    Without colours the weights stay: what is faint is told from points by that alone.
    """
    chosen = INKS[ink]
    parts = ["0"]
    if chosen.bold:
        parts.append("1")
    if depth == "none" or chosen.rgb is None:
        parts += ["2"] * chosen.faint
    elif depth == "truecolor":
        parts.append("38;2;" + ";".join(map(str, chosen.rgb)))
    else:
        parts.append(f"38;5;{_cube(chosen.rgb)}" if depth == "256" else str(chosen.standard))
    return f"\x1b[{';'.join(parts)}m"


def style(ink: int) -> str:
    """The same as a style of rich."""
    chosen = INKS[ink]
    colour = "" if chosen.rgb is None else "#" + "".join(f"{part:02x}" for part in chosen.rgb)
    return " ".join(part for part in ("bold" if chosen.bold else "", colour) if part)


def _cube(rgb: Rgb) -> int:
    """The nearest colour of the 6 by 6 by 6 cube, or grey of the 24, among 256 colours."""
    levels = (0, 95, 135, 175, 215, 255)
    near = [min(range(6), key=lambda index, part=part: abs(levels[index] - part)) for part in rgb]  # type: ignore[misc]
    grey = min(23, max(0, round((sum(rgb) / 3 - 8) / 10)))
    cube_error = sum((levels[index] - part) ** 2 for index, part in zip(near, rgb, strict=True))
    if sum((8 + 10 * grey - part) ** 2 for part in rgb) < cube_error:
        return 232 + grey
    return 16 + 36 * near[0] + 6 * near[1] + near[2]
