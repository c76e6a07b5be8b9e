"""Read a source and serve its page: the server of `lidarspec view --web`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

from lidarspec import Device, Selection, Sensor, open as open_device
from lidarspec.recording.recorder_switch import RecordingSwitch
from lidarspec.transports.open_url import is_live
from lidarspec.view.live_scans import LOOK_S
from lidarspec_web.broadcast import Broadcast
from lidarspec_web.server import PageSite


class SourceServer:
    """Context manager that serves the page of a source, and then closes the source.

    Args:
        source: port, socket, file or ``sim:`` URL.
        sensor: the sensor; None to identify it.
        port: port to listen on; 0 for any free port.
        control: whether pages may send commands to a real sensor.
        report: called with a line for each page that is opened or closed.
        folder: the folder for recordings of pages; by default the working directory.

    Raises:
        LidarSpecError: if the source cannot be opened, or the server cannot listen.
    """

    def __init__(
        self,
        source: str,
        sensor: str | Sensor | None = None,
        *,
        selection: Selection | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
        control: bool = False,
        report: Callable[[str], None] = lambda text: None,
        page: Path | None = None,
        folder: Path | None = None,
    ) -> None:
        self.switch: RecordingSwitch | None = None
        if is_live(source):
            self.switch = RecordingSwitch(source, folder or Path.cwd())
        record = None if self.switch is None else self.switch.attach
        device = open_device(source, sensor, record=record, period=LOOK_S)
        if self.switch is not None:
            self.switch.sensor_id = device.sensor.id
        self.broadcast = Broadcast(
            source,
            device,
            reopen=partial(open_device, source, device.sensor),
            select=selection or Selection(),
            switch=self.switch,
        )
        try:
            self.site = PageSite(
                self.broadcast, host=host, port=port, control=control, page=page, report=report
            )
        except BaseException:
            self.broadcast.close()
            raise

    @property
    def link(self) -> str:
        """The URL of the page, with its token."""
        return self.site.link

    @property
    def device(self) -> Device:
        """The open source."""
        return self.broadcast.device

    @property
    def recordings(self) -> Sequence[tuple[str, int]]:
        """(path, number of received bytes) of each recording that was made from a page."""
        if self.switch is None:
            return ()
        return self.switch.written

    @property
    def trouble(self) -> str:
        """The error of the last recording; "" if there was no error or no recording."""
        if self.switch is None:
            return ""
        return self.switch.trouble

    def opening_page(self) -> str:
        """Write a file that redirects a browser to the link, and return the file's URL.

        Raises:
            OSError: if the file cannot be written.
        """
        return self.site.opening_page()

    def run(self, duration_s: float | None = None) -> None:
        """Read the source for `duration_s`; None to read until `broadcast.stop`.

        Raises:
            LidarSpecError: if the source fails.
        """
        self.broadcast.run(math.inf if duration_s is None else time.monotonic() + duration_s)

    def __enter__(self) -> Self:
        self.site.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.site.__exit__(kind, error, trace)
        finally:
            self.broadcast.close()
