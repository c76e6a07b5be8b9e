"""The HTTP server of the page: its files, a WebSocket for each open page, and saved scans.

One event loop in a separate thread serves all pages of a source. `access` determines which requests
are served, `open_page` serves the sockets, and `scan_files` writes and sends scans.
"""

from __future__ import annotations

import asyncio
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from lidarspec import SourceError
from lidarspec_web.access import ANY_ADDRESS, Guard, add_token, make_token, write_redirect_page
from lidarspec_web.broadcast import Broadcast
from lidarspec_web.connections import BACKLOG, Connections, ErrorReporter
from lidarspec_web.open_page import SEND_TIMEOUT_S, OpenPage, describe_bug
from lidarspec_web.page_messages import PageMessages, list_save_formats
from lidarspec_web.page_requests import Workers
from lidarspec_web.scan_files import ScanSaver
from lidarspec_web.temporary_folder import TemporaryFolder, remove_stale_folders

#: The folder of the built page.
PAGE = Path(__file__).parent / "page"
MAX_PAGES = 64
#: The longest request of a page.
MAX_REQUEST_BYTES = 1 << 16
PING_PERIOD_S = 10.0
#: Maximum time that open pages have to close when the server ends.
SHUTDOWN_TIMEOUT_S = 1
#: Maximum number of digits of a scan's number.
MAX_NUMBER_DIGITS = 12


class PageSite:
    """Context manager that serves the page of a broadcast.

    Args:
        port: port to listen on; 0 for any free port.
        control: whether pages may send commands to a real sensor.
        report: called with a line for each page that is opened or closed.

    Attributes:
        link: the URL of the page, with its token.

    Raises:
        SourceError: if the server cannot listen on this address and port.
    """

    def __init__(
        self,
        broadcast: Broadcast,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        control: bool = False,
        page: Path | None = None,
        report: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._broadcast = broadcast
        self._report = report
        self._answers = PageMessages(broadcast, control=control)
        self._open_pages = set[OpenPage]()
        self._opened_count = 0
        self._files = page or PAGE
        self._folder = TemporaryFolder()
        self._workers = Workers()
        self._connections = Connections(report)
        self._saves = ScanSaver(self._folder, self._workers.saves, self._connections.drop)
        self._socket = _listen(host, port)
        self._token = make_token()
        link_host = _find_link_host(host)
        port = self._socket.getsockname()[1]
        self.link = f"http://{link_host}:{port}/?token={self._token}"
        guard = Guard(
            self._make_app(),
            host=host,
            link_host=link_host,
            port=port,
            token=self._token,
            on_token=self._connections.admit,
        )
        self._server = uvicorn.Server(self._make_config(guard))
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="pages")

    def _make_app(self) -> Starlette:
        routes = [
            Route("/", self._send_page),
            Route("/index.html", self._send_page),
            WebSocketRoute("/socket", self._serve_page),
            Route("/save/{name}", self._save_scan),
            Mount("/", StaticFiles(directory=self._files)),
        ]
        return Starlette(routes=routes)

    def _make_config(self, app: Guard) -> uvicorn.Config:
        return uvicorn.Config(
            app,
            http=self._connections.protocol_class(),
            backlog=BACKLOG,
            log_config=None,
            log_level="critical",  # its messages about requests are not for a terminal
            access_log=False,
            lifespan="off",
            server_header=False,
            loop="asyncio",
            ws="websockets-sansio",
            ws_max_size=MAX_REQUEST_BYTES,
            ws_ping_interval=PING_PERIOD_S,
            ws_ping_timeout=SEND_TIMEOUT_S,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=SHUTDOWN_TIMEOUT_S,
        )

    def opening_page(self) -> str:
        """Write a file that redirects a browser to the link, and return the file's URL.

        Raises:
            OSError: if the file cannot be written.
        """
        return write_redirect_page(self._folder.path, self.link).as_uri()

    def __enter__(self) -> Self:
        remove_stale_folders()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._broadcast.on_news = lambda: None
        self._server.should_exit = True
        self._thread.join()
        self._workers.close()
        self._socket.close()
        self._folder.remove()

    async def _serve(self) -> None:
        loop = asyncio.get_running_loop()

        def notify() -> None:
            loop.call_soon_threadsafe(self._notify_pages)

        self._broadcast.on_news = notify
        loop.set_exception_handler(ErrorReporter(self._report))
        watching = asyncio.create_task(self._connections.watch())
        await self._server.serve(sockets=[self._socket])
        watching.cancel()
        await self._connections.close()

    def _notify_pages(self) -> None:
        for page in self._open_pages:
            page.notify()

    def _send_page(self, request: Request) -> Response:
        text = (self._files / "index.html").read_text(encoding="utf-8")
        return HTMLResponse(add_token(text, self._token))

    async def _serve_page(self, socket: WebSocket) -> None:
        """Serve one page until it is closed."""
        if len(self._open_pages) >= MAX_PAGES:
            await socket.close()
            return
        page = OpenPage(self._answers, socket, self._workers)
        self._open_pages.add(page)
        self._opened_count += 1
        number = self._opened_count
        client = "an unknown address" if socket.client is None else socket.client.host
        self._report(f"page {number} was opened by {client}; open pages: {len(self._open_pages)}")
        ending = "was closed"
        try:
            ending = await page.serve()
        except Exception as error:
            ending = f"was closed because of {describe_bug(error)}"
        finally:
            self._open_pages.discard(page)
            self._report(f"page {number} {ending}; open pages: {len(self._open_pages)}")

    async def _save_scan(self, request: Request) -> Response:
        """Send a scan as a file, by its number."""
        number, _, suffix = request.path_params["name"].partition(".")
        if suffix not in list_save_formats():
            return PlainTextResponse(
                f"unknown format: expected {', '.join(list_save_formats())}", 404
            )
        shown = None
        if number.isdecimal() and len(number) < MAX_NUMBER_DIGITS:
            shown = self._broadcast.find_scan(int(number))
        if shown is None:
            return PlainTextResponse(
                "this scan is no longer available: pause the view before saving", 404
            )
        return self._saves.make_response(shown, suffix)


def _find_link_host(host: str) -> str:
    """Return the host for the link to a server."""
    if host in ANY_ADDRESS:
        return socket.gethostname()
    if ":" in host:
        return f"[{host}]"
    return host


def _listen(host: str, port: int) -> socket.socket:
    """Return a listening socket.

    Raises:
        SourceError: if the address cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, port), family=family)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else error
        raise SourceError(f"cannot serve the page at {host}:{port}: {reason}") from error
    if hasattr(socket, "TCP_USER_TIMEOUT"):
        # The system then drops data that a page never reads. Connections inherit the option.
        listener.setsockopt(
            socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(SEND_TIMEOUT_S * 1000)
        )
    return listener
