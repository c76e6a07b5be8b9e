"""The page of `lidarspec view --web`, its server, and the viewer for notebooks.

    from lidarspec_web import Viewer

    Viewer("/dev/ttyUSB0", "vendor-model")      # in a cell of a notebook

Modules in reading order:

* `source_server`: a source, read and served; `lidarspec view --web` runs it.
* `broadcast`: a source that is read once and shown to any number of pages; files are played.
* `recent_bytes`: the newest bytes of the source, frame by frame, and damaged bytes.
* `scan_message`: one scan as the binary message that a page draws.
* `page_messages`: all other messages to a page, as JSON.
* `command_forms`: the commands of the sensor, as forms of the page.
* `open_page`: one page that is open: its socket, its requests and what is sent to it.
* `page_requests`: limits on the requests of one page, and the threads that serve them.
* `server`: the HTTP server of the page's files, its sockets and saved scans.
* `access`: the token, host and origin that a request needs.
* `connections`: limits on the connections to the server.
* `scan_files`: scans that pages save as files.
* `temporary_folder`: the temporary folder of the server.
* `viewer`: a source in a cell of a notebook, drawn by the code of the page.

The folder `page` has the page and the notebook widget as `make page` builds them from TypeScript.
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
