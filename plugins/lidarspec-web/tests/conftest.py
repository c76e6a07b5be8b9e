"""A browser for the tests of the page."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import pytest

from .browser import FLAGS, find_browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Yield a browser of playwright, closed at the end."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with (
        api.sync_playwright() as running,
        contextlib.closing(
            running.chromium.launch(executable_path=find_browser(), args=FLAGS)
        ) as started,
    ):
        yield started
