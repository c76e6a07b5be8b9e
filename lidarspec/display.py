"""What a notebook shows of our values: IPython asks a value for it, and the value asks what draws
it, which stands above all values.

Nothing of that is imported before somebody asks.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

#: the module with a function for each kind of value.
DRAWING = "lidarspec.view.notebook"


def drawn(kind: str) -> Callable[[Any], str | None]:
    """A method that gives what the function of this name in `lidarspec.view.notebook` makes of the
    value; None where it shows as text.
    """

    def representation(value: Any) -> str | None:
        text: str | None = getattr(importlib.import_module(DRAWING), kind)(value)
        return text

    return representation
