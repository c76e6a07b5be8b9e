"""The methods with which notebooks display values.

IPython calls a method of the value, and the method calls a function of `lidarspec.view.notebook`.
That module depends on all values, so it is only imported when a value is displayed.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

#: the module with a function for each kind of value.
DRAWING = "lidarspec.view.notebook"


def make_display_method(kind: str) -> Callable[[Any], str | None]:
    """Return a method that displays a value with the function of this name.

    The method returns None if the value is displayed as text.
    """

    def representation(value: Any) -> str | None:
        text: str | None = getattr(importlib.import_module(DRAWING), kind)(value)
        return text

    return representation
