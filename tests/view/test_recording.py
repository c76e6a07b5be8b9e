"""Recordings that pages switch on and off: one at a time, however many press at once."""

from __future__ import annotations

import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import lidarspec as ls
from lidarspec.transports.open_url import transport
from lidarspec.transports.protocol import Chunk
from lidarspec.view.live import Switch
from tests.view.pages import FLAT, Station

PRESSES = 8


def open_switch(folder: Path) -> Switch:
    """Return a switch that records a simulated sensor."""
    switch = Switch(f"sim:{FLAT}", folder)
    switch.sensor_id = FLAT
    with contextlib.closing(transport(f"sim:{FLAT}")) as opened:
        switch.attached(opened)
    return switch


def press_at_once(switch: Switch) -> None:
    barrier = threading.Barrier(PRESSES)

    def press() -> None:
        barrier.wait()
        switch.toggle()
        switch.write(Chunk(b"data", 1))

    with ThreadPoolExecutor(PRESSES) as threads:
        for done in [threads.submit(press) for _ in range(PRESSES)]:
            done.result()


def open_recordings(folder: Path) -> list[str]:
    start = f"recorder of {folder}"
    return [one.name for one in threading.enumerate() if one.name.startswith(start)]


def test_presses_at_once_leave_no_recording_open(tmp_path: Path) -> None:
    """An even number of presses ends with all files closed, and no file is empty."""
    switch = open_switch(tmp_path)
    press_at_once(switch)
    assert switch.recording is None
    assert not open_recordings(tmp_path)
    kept = {Path(path).name for path, _ in switch.written}
    assert {path.name for path in tmp_path.iterdir()} == kept


def test_a_recording_of_nothing_is_removed_and_reported(tmp_path: Path) -> None:
    switch = open_switch(tmp_path)
    switch.set(on=True)
    assert switch.recording is not None
    name, size = switch.recording
    assert (size, [path.name for path in tmp_path.iterdir()]) == (0, [name])
    switch.set(on=False)
    assert (switch.recording, switch.written, list(tmp_path.iterdir())) == (None, [], [])
    assert switch.trouble == f"nothing came while {name} was recorded: it is removed"
    switch.set(on=True)
    assert switch.trouble == ""
    switch.write(Chunk(b"data", 1))
    switch.close()
    assert [size for _, size in switch.written] == [4]


def test_pages_that_press_at_once_agree(tmp_path: Path) -> None:
    """Each asks for the state that its button offers, and all see the same file."""
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
        assert one.asked("record", on="yes")["text"] == "on is true or false"
    assert {path.name for path in tmp_path.glob("*.lsr")} == names
    with ls.open(tmp_path / names.pop()) as again:
        assert sum(len(packets) for packets in again.packets())


@pytest.mark.slow
def test_every_second_press_ends_the_recording(tmp_path: Path) -> None:
    """The message without `on` changes the state, whatever that is."""
    with Station(f"sim:{FLAT}", tmp_path) as station, station.page() as page:
        for _ in range(4):
            page.say("record")
        page.scan()
        page.state(lambda state: state["recording"] is None)
        assert not open_recordings(tmp_path)
