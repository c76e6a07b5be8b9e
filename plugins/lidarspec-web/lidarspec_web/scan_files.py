"""Save scans as files: a thread writes temporary files, which are then sent.

Only a few scans are saved at a time, so that saving takes little processor time from open pages,
and little space on the disk. A file is removed after it was sent, or if the client does not read
it.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Callable
from concurrent.futures import Executor
from pathlib import Path

from starlette.responses import PlainTextResponse, Response
from starlette.types import Receive, Scope, Send

from lidarspec import LidarSpecError
from lidarspec.formats import write
from lidarspec.points.appearance import choose_appearance, fit_to_points
from lidarspec.view.svg import svg
from lidarspec_web.broadcast import ShownScan
from lidarspec_web.connections import Client
from lidarspec_web.temporary_folder import TemporaryFolder

#: Maximum number of scans that wait, are written or are sent; further requests are refused.
MAX_SAVES = 8
CHUNK_BYTES = 1 << 16
#: Maximum pause between two written scans.
MAX_REST_S = 2.0
#: Timeout for a client to read a chunk.
SEND_TIMEOUT_S = 20.0


class ScanSaver:
    """Saves scans on request.

    Args:
        drop: closes the connection of a client that does not read its file.
    """

    def __init__(
        self, folder: TemporaryFolder, worker: Executor, drop: Callable[[Client | None], None]
    ) -> None:
        self._folder = folder
        self._worker = worker
        self._drop = drop
        self._numbers = itertools.count()
        self._count = 0
        self._writing = asyncio.Lock()
        self._rests_until = 0.0

    def make_response(self, shown: ShownScan, suffix: str) -> Response:
        """Return an HTTP response that writes and sends the scan when it is served."""
        return _SavedScan(self, shown, suffix)

    async def serve(
        self, shown: ShownScan, suffix: str, scope: Scope, receive: Receive, send: Send
    ) -> None:
        """Write a scan and send it, or send the reason why that is not possible."""
        if self._count >= MAX_SAVES:
            text = f"{MAX_SAVES} scans are being saved already: try again in a moment"
            await PlainTextResponse(text, 503)(scope, receive, send)
            return
        self._count += 1
        try:
            await self._write_and_send(shown, suffix, scope, receive, send)
        finally:
            self._count -= 1

    async def _write_and_send(
        self, shown: ShownScan, suffix: str, scope: Scope, receive: Receive, send: Send
    ) -> None:
        try:
            path = self._folder.path / f"{next(self._numbers)}.{suffix}"
            await self._write(path, shown)
        except (LidarSpecError, OSError) as error:
            await PlainTextResponse(str(error), 500)(scope, receive, send)
            return
        try:
            await _send_file(path, f"{shown.scan.sensor.id}-{shown.position:.3f}s.{suffix}", send)
        except TimeoutError:
            self._drop(scope["client"])
        finally:
            path.unlink()

    async def _write(self, path: Path, shown: ShownScan) -> None:
        """Write a scan to a file, after a pause that leaves processor time to open pages."""
        loop = asyncio.get_running_loop()
        async with self._writing:
            await asyncio.sleep(self._rests_until - time.monotonic())
            begin = time.monotonic()
            try:
                await loop.run_in_executor(self._worker, write_file, path, shown)
            finally:
                end = time.monotonic()
                self._rests_until = end + min(end - begin, MAX_REST_S)


class _SavedScan(Response):
    """A scan that is written when its request is served."""

    def __init__(self, saves: ScanSaver, shown: ShownScan, suffix: str) -> None:
        super().__init__()
        self._saves = saves
        self._shown = shown
        self._suffix = suffix

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve the request."""
        await self._saves.serve(self._shown, self._suffix, scope, receive, send)


def write_file(path: Path, shown: ShownScan) -> None:
    """Write a scan to a file, in the format of the file's suffix."""
    if path.suffix == ".svg":
        points = shown.scan.points
        text = svg(
            points,
            fit_to_points(points, choose_appearance(points)),
            f"{shown.scan.sensor.id}: {shown.scan}",
        )
        path.write_text(text, encoding="utf-8")
    else:
        write(path, [shown.scan])


async def _send_file(path: Path, name: str, send: Send) -> None:
    """Send a file as a download.

    Raises:
        TimeoutError: if the client does not read the file.
    """
    headers = {
        "content-type": "application/octet-stream",
        "content-length": str(path.stat().st_size),
        "content-disposition": f'attachment; filename="{name}"',
    }
    raw_headers = [(key.encode(), value.encode()) for key, value in headers.items()]
    await send({"type": "http.response.start", "status": 200, "headers": raw_headers})
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            part = {"type": "http.response.body", "body": chunk, "more_body": True}
            await asyncio.wait_for(send(part), SEND_TIMEOUT_S)
    await send({"type": "http.response.body", "body": b"", "more_body": False})
