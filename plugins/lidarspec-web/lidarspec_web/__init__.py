"""The page of `lidarspec view --web`, its server, and the viewer for notebooks.

    from lidarspec_web import Viewer

    Viewer("/dev/ttyUSB0", "vendor-model")      # in a cell of a notebook

Modules in reading order:

* `source_server`: reads a source and serves its page; `lidarspec view --web` runs it.
* `broadcast`: reads a source once and shows it to any number of pages; files are played.
* `recent_bytes`: stores the newest frames and the newest damaged bytes of the source.
* `scan_message`: converts a scan to the binary message that a page draws.
* `page_messages`: makes all other messages to a page, as JSON.
* `command_forms`: the commands of the sensor, as forms of the page.
* `open_page`: serves one open page: receives its requests, and sends scans and replies.
* `page_requests`: limits on the requests of one page, and the threads that serve them.
* `server`: the HTTP server, which serves the files of the page, sockets and saved scans.
* `access`: checks the token, the host and the origin of a request.
* `connections`: limits the connections to the server.
* `scan_files`: saves scans as files for pages.
* `temporary_folder`: the temporary folder of the server.
* `viewer`: shows a source in a cell of a notebook, with the code of the page.

The folder `page` contains the page and the notebook widget, which `make page` builds from
TypeScript.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from lidarspec.spec import hookimpl

if TYPE_CHECKING:
    from lidarspec import Selection, Sensor
    from lidarspec_web.source_server import SourceServer
    from lidarspec_web.viewer import Viewer as Viewer

__all__ = ["Viewer"]


@hookimpl
def lidarspec_page(
    source: str,
    sensor: str | Sensor | None,
    selection: Selection,
    host: str,
    port: int,
    control: bool,
    report: Callable[[str], None],
) -> SourceServer:
    """Open a source and return the server of its page."""
    from lidarspec_web.source_server import SourceServer

    return SourceServer(
        source,
        sensor,
        selection=selection,
        host=host,
        port=port,
        control=control,
        report=report,
    )


def __getattr__(name: str) -> Any:
    if name != "Viewer":
        raise AttributeError(f"module 'lidarspec_web' has no attribute {name!r}")
    from lidarspec_web.viewer import Viewer

    return Viewer
