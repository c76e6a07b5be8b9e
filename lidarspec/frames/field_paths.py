"""Convert paths of fields, for example "points[3].distance", to names and indices."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

#: A path as a list of names and indices. An index is a number, or "*" for every element.
Steps = list[int | str]


def split_path(path: str) -> Steps:
    """Return the names and indices of a path.

    For "points[3].distance" the result is ["points", 3, "distance"].
    """
    return [int(step) if step.isdigit() else step for step in re.findall(r"\w+|\*", path)]


def is_index(step: int | str) -> bool:
    """Return whether a step of a path leads to elements of an array."""
    return step == "*" or isinstance(step, int)


def put_value(
    target: Any,
    path: Steps,
    value: Any,
    length: Callable[[str], int] = lambda array: 0,
    place: str = "",
) -> Any:
    """Set the field at a path of a struct or array, and return the struct or array.

    Dicts in `target` are changed in place, and lists are copied.

    Args:
        target: the struct or array; None to make a new one.
        path: the path. The index "*" sets the field in all elements.
        length: a function that returns the number of elements of the array at a path, 0 if unknown.
    """
    if not path:
        return value
    step, *rest = path
    if not is_index(step):
        target = {} if target is None else target
        below = f"{place.removesuffix('[]')}.{step}".removeprefix(".")
        target[step] = put_value(target.get(step), rest, value, length, below)
        return target
    target = [] if target is None else list(target)
    indices = range(length(place) or len(target)) if step == "*" else [int(step)]
    for index in indices:
        target.extend([None] * (index + 1 - len(target)))
        element = target[index]
        if isinstance(element, dict):
            element = dict(element)
        target[index] = put_value(element, rest, value, length, f"{place}[]")
    return target
