"""Tests of switching the recorder on and off from several threads.

The recorder writes only one file at a time.
"""

from __future__ import annotations

import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lidarspec.recording.recorder_switch import RecordingSwitch
from lidarspec.transports.open_url import open_transport
from lidarspec.transports.protocol import Chunk

FLAT = "ldrobot-stl27l"
PRESSES = 8


def open_switch(folder: Path) -> RecordingSwitch:
    """Return a switch that records a simulated sensor."""
    switch = RecordingSwitch(f"sim:{FLAT}", folder)
    switch.sensor_id = FLAT
    with contextlib.closing(open_transport(f"sim:{FLAT}")) as opened:
        switch.attach(opened)
    return switch


def press_at_once(switch: RecordingSwitch) -> None:
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
    assert switch.current_file is None
    assert not open_recordings(tmp_path)
    kept = {Path(path).name for path, _ in switch.written}
    assert {path.name for path in tmp_path.iterdir()} == kept


def test_a_recording_of_nothing_is_removed_and_reported(tmp_path: Path) -> None:
    switch = open_switch(tmp_path)
    switch.set_state(on=True)
    assert switch.current_file is not None
    name, size = switch.current_file
    assert (size, [path.name for path in tmp_path.iterdir()]) == (0, [name])
    switch.set_state(on=False)
    assert (switch.current_file, switch.written, list(tmp_path.iterdir())) == (None, [], [])
    assert switch.trouble == f"no data arrived for the recording {name}, so the file was removed"
    switch.set_state(on=True)
    assert switch.trouble == ""
    switch.write(Chunk(b"data", 1))
    switch.close()
    assert [size for _, size in switch.written] == [4]
