"""The interface to the plugin that serves the page of `lidarspec view --web`.

The page and its server are in the distribution `lidarspec-web`, because they need a web framework.
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
    """Serves the page of a source; a context manager that closes the source."""

    @property
    def link(self) -> str:
        """The URL of the page, with its token."""

    @property
    def device(self) -> Device:
        """The opened device or file."""

    @property
    def recordings(self) -> Sequence[tuple[str, int]]:
        """(path, size in bytes) of each recording that was made from a page."""

    @property
    def trouble(self) -> str:
        """The reason why the last recording could not be written; "" if it was written."""

    def opening_page(self) -> str:
        """Write a local HTML file that redirects to `link`, and return the URL of the file.

        Start a browser with this URL instead of `link`, because `link` contains a token, and other
        users can see the command line of a browser.

        Raises:
            OSError: if the file cannot be written.
        """

    def run(self, duration_s: float | None) -> None:
        """Read the source and serve the page.

        Args:
            duration_s: seconds after which this returns; None to run until an interrupt.

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
    """Open a source, and return the server of its page.

    Args:
        source: the source, as the user typed it.
        sensor: the sensor, or its id; None to detect it.
        port: the port to listen on; 0 for any free port.
        control: whether pages may send commands.
        report: called with each message for the user.

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
