"""Tests of recordings that pages switch on and off: only one at a time."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

import lidarspec as ls
from tests.lines import until

from .pages import FLAT, Station


def test_pages_that_press_at_once_agree(tmp_path: Path) -> None:
    """Each requests the state that its button offers, and all see the same file."""
    station = Station(f"sim:{FLAT}", tmp_path)
    with station, station.page() as one, station.page() as other:
        for page in (one, other, one, other):
            page.say("record", on=True)
        states = [page.state(lambda state: state["recording"]) for page in (one, other)]
        names = {state["recording"]["name"] for state in states}
        one.state(lambda state: state["recording"]["bytes"])
        assert len(names) == 1
        for page in (one, other):
            page.say("record", on=False)
        for page in (one, other):
            page.state(lambda state: state["recording"] is None)
        assert one.request("record", on="yes")["text"] == '"on" must be true or false'
    assert {path.name for path in tmp_path.glob("*.lsr")} == names
    with ls.open(tmp_path / names.pop()) as again:
        assert sum(len(packets) for packets in again.packets())


def recorders(folder: Path) -> list[threading.Thread]:
    """Return the threads that record into a folder."""
    name = f"recorder of {folder}"
    return [thread for thread in threading.enumerate() if thread.name.startswith(name)]


@pytest.mark.slow
def test_every_second_press_ends_the_recording(tmp_path: Path) -> None:
    """The message without `on` toggles the state."""
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        for _ in range(4):
            page.say("record")
        page.scan()
        page.state(lambda state: state["recording"] is None)
        until(lambda: not recorders(tmp_path))  # the last one closes its file first
