"""The Chromium of the system, for tests of what a browser shows; a test that asks for it is skipped
where there is none.
"""

from __future__ import annotations

import shutil

import pytest

#: Without the sandbox that root lacks. WebGL is drawn in software, and the page around it without
#: WebGL, which costs less.
FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
)


def installed() -> str:
    """Where it is."""
    path = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    if path is None:
        pytest.skip("Chromium is not installed")
    return path
