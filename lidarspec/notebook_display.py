"""The methods with which notebooks display values.

IPython calls a method of the value, and this method calls a function of `lidarspec.view.notebook`.
That module imports the classes of all values, so it is imported only when a value is displayed.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

#: The module with a function for each kind of value.
DRAWING = "lidarspec.view.notebook"


def make_display_method(kind: str) -> Callable[[Any], str | None]:
    """Return a method that displays a value in notebooks.

    The method returns HTML, or None if the value is to be displayed as text.

    Args:
        kind: the name of the function in `lidarspec.view.notebook` that draws the value.
    """

    def representation(value: Any) -> str | None:
        text: str | None = getattr(importlib.import_module(DRAWING), kind)(value)
        return text

    return representation
