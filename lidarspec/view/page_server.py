"""The interface of the server of `lidarspec view --web`, which is a plugin.

The page and its server are a distribution of their own, `lidarspec-web`, because only they need a
web framework.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from lidarspec.device.device import Device
from lidarspec.entry_points import PAGE, entry_points
from lidarspec.errors import SpecError, UsageError, suggest
from lidarspec.known_sensors import install_command
from lidarspec.plugins import load_hooks
from lidarspec.scans.selection import Selection
from lidarspec.sensor_operations import Sensor

DISTRIBUTION = "lidarspec-web"


class PageServer(AbstractContextManager["PageServer"], Protocol):
    """Serves the page of a source while its context lasts, and then closes the source."""

    @property
    def link(self) -> str:
        """The URL of the page, with its token."""

    @property
    def device(self) -> Device:
        """The open source."""

    @property
    def recordings(self) -> Sequence[tuple[str, int]]:
        """Path of each recording that pages have made, and the bytes of the wire in it."""

    @property
    def trouble(self) -> str:
        """The reason why the last recording could not be started or written, "" if it could."""

    def opening_page(self) -> str:
        """Return the URL of a file that leads to the link, to start a browser with.

        Raises:
            OSError: if it cannot be written.
        """

    def run(self, duration_s: float | None) -> None:
        """Read the source for some time; None: until it is interrupted.

        Raises:
            LidarSpecError: if the source fails.
        """


def open_page_server(
    source: str,
    sensor: str | Sensor | None,
    *,
    selection: Selection,
    host: str,
    port: int,
    control: bool,
    report: Callable[[str], None],
) -> PageServer:
    """Open a source and return the server of its page, which the hook `lidarspec_page` makes.

    Raises:
        UsageError: if no plugin serves the page.
        SpecError: if the plugin cannot be loaded.
        LidarSpecError: if the source cannot be opened, or the server cannot listen.
    """
    entries = entry_points(PAGE)
    if not entries:
        error = UsageError(f"view --web requires {DISTRIBUTION}, which is not installed")
        raise suggest(error, install_command(DISTRIBUTION))
    entry = entries[0]
    server: PageServer | None = load_hooks(entry).call(
        "lidarspec_page",
        source=source,
        sensor=sensor,
        selection=selection,
        host=host,
        port=port,
        control=control,
        report=report,
    )
    if server is None:
        raise SpecError(f"{entry.module} has no hook lidarspec_page", path=entry.distribution)
    return server
