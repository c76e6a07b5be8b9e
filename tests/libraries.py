"""Optional libraries that tests use.

The first test that needs a library imports it; collection imports none.
"""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from typing import Any

import pytest


def needs(*packages: str) -> pytest.MarkDecorator:
    """Return a mark that skips a test if one of these packages is not installed."""
    missing = [package for package in packages if find_spec(package) is None]
    return pytest.mark.skipif(bool(missing), reason=f"{', '.join(missing)} is not installed")


class Library:
    """A module that is imported when one of its public names is first used.

    pytest reads names such as `__wrapped__` of every object in a test module; these import nothing.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:
        if attribute.startswith("_") or attribute == "pytestmark":
            raise AttributeError(attribute)
        return getattr(importlib.import_module(self._name), attribute)
