"""The Chromium of the system, for tests of what a browser shows; a test that asks for it is skipped where there is none."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

#: without a display, without the sandbox that root has not, and with WebGL in software.
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A browser of playwright's, closed at the end."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with api.sync_playwright() as running, contextlib.closing(running.chromium.launch(executable_path=installed(), args=FLAGS)) as browser:
        yield browser


def installed() -> str:
    """Where it is."""
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("Chromium is not installed")
    return path
