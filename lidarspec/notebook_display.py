"""The methods with which notebooks display values.

`lidarspec.view.notebook` draws the values. This module is separate, so that `lidarspec.view` is
imported only when a value is displayed.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

#: The module with a function for each kind of value.
DRAWING = "lidarspec.view.notebook"


def make_display_method(kind: str) -> Callable[[Any], str | None]:
    """Return a method that displays its object in a notebook.

    The method returns the object as HTML, or None if the notebook has to display the text.

    Args:
        kind: the name of the function in `lidarspec.view.notebook` that draws the value.
    """

    def representation(value: Any) -> str | None:
        text: str | None = getattr(importlib.import_module(DRAWING), kind)(value)
        return text

    return representation
