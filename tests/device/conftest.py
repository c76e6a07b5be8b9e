"""Disable the silence warning unless a test asks for it.

A busy machine may serve no data for a second.
"""

from __future__ import annotations

import pytest

from lidarspec.device import link_state, live_input
from tests.lines import TIMEOUT_S


@pytest.fixture(autouse=True)
def _patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_state, "FRAMELESS_WARNING_S", TIMEOUT_S)
    monkeypatch.setattr(live_input, "SENDER_TIMEOUT_S", TIMEOUT_S)


@pytest.fixture
def impatient(_patient: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Report silence, and bytes without frames, after a short time."""
    monkeypatch.setattr(link_state, "FRAMELESS_WARNING_S", 0.3)
    monkeypatch.setattr(live_input, "SENDER_TIMEOUT_S", 0.3)
