"""The system's Chromium for tests in a browser; tests are skipped without it."""

from __future__ import annotations

import shutil

import pytest

#: Root cannot use the sandbox. WebGL is rendered in software, and the page around it without WebGL,
#: which is faster.
FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
)


def find_browser() -> str:
    """Return its path."""
    path = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    if path is None:
        pytest.skip("Chromium is not installed")
    return path
