"""Tests of finding the plugin that serves the page of `view --web`."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from lidarspec.entry_points import EntryPoint
from lidarspec.view import page_server
from tests.cli.running import ran

SOURCE = "sim:ldrobot-stl27l"


def entry_point(module: str) -> EntryPoint:
    return EntryPoint("web", module, "other-page", "1.0")


def test_a_missing_page_plugin_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(page_server, "entry_points", lambda group: [])
    message = ran("view", SOURCE, "--web", code=2).stderr
    assert "lidarspec-web, which is not installed" in message
    assert "next: pip install" in message


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("import absent_framework\n", "No module named 'absent_framework'"),
        ("", "has no hook lidarspec_page"),
    ],
)
def test_a_plugin_that_does_not_load_is_named(
    text: str, reason: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "page_of_another.py").write_text(text, encoding="utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "page_of_another", raising=False)
    monkeypatch.setattr(page_server, "entry_points", lambda group: [entry_point("page_of_another")])
    message = ran("view", SOURCE, "--web", code=1).stderr
    assert "other-page" in message
    assert reason in message
