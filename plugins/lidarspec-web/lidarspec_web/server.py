"""A broadcast as a page: the files of the page, a WebSocket for each one that is open, and scans to
be saved.

One event loop in a thread of its own serves them all. A page is sent a scan only where it has asked
for one, so that a slow or hidden one costs nothing. `access` says which requests are served.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request as HttpRequest
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from lidarspec import LidarSpecError, SourceError, UsageError
from lidarspec.errors import suggestion
from lidarspec_web.access import ANY_ADDRESS, Guard, add_token, make_token, write_opening_page
from lidarspec_web.answers import Answers, saves
from lidarspec_web.backlog import Backlog
from lidarspec_web.broadcast import Broadcast, Shown
from lidarspec_web.connections import BACKLOG, Connections, ErrorReporter
from lidarspec_web.page_requests import (
    MESSAGES_AT_ONCE,
    MESSAGES_PER_S,
    Lane,
    RateLimit,
    Request,
    Workers,
)
from lidarspec_web.saving import Saves
from lidarspec_web.temporary import TemporaryFolder, remove_stale_folders

#: the page, as it was built.
PAGE = Path(__file__).parent / "page"
#: bytes of a message from a page at most, and answers that wait to be sent to one.
LARGEST, WAITING = 1 << 16, 16
#: seconds until a page that asks too much is looked at again.
BUSY = 0.05
#: seconds from one state to the next, and from one frame that is watched to the next.
STATE, WATCHED = 0.5, 0.5
#: seconds after which a page that takes nothing, or does not answer a ping, is dropped; and that
#: pages are given at the end.
STALLED, PING, FAREWELL = 20.0, 10.0, 1
#: seconds that a page waits for a first scan before it is told what there is; how a page ends that
#: is closed; and how many may be open.
GREETING, CLOSED, PAGES = 3.0, (1000, 1001, 1012), 64
#: points of a message at most, and the scans that a page may still ask about: the one that is
#: drawn, and the one that is on its way.
POINTS, HELD = 1 << 24, 2
#: the largest number in a message, and one digit more than a scan's number has.
LONGEST, DIGITS = 1e12, 12


class Page:
    """One page that is open.

    Args:
        answers: what it is told.
        socket: to the page.
        workers: do what takes a while.
    """

    def __init__(self, answers: Answers, socket: WebSocket, workers: Workers) -> None:
        self._answers, self._broadcast, self._socket = answers, answers.broadcast, socket
        self._replies = deque[dict[str, Any]]()
        self._stirred = asyncio.Event()
        self._workers = workers
        self._rate_limit = RateLimit(MESSAGES_AT_ONCE, MESSAGES_PER_S)
        self._questions = Lane(workers.answers, self._finish)
        self._commands = Lane(workers.commands, self._finish)
        self._most: int | None = None  # points of the scan that is wanted; None where none is
        self._held = deque[Shown](maxlen=HELD)
        self._frozen: Backlog | None = None  # the bytes as they were when a live source was paused
        self._watches, self._watched, self._known = False, -1, 0
        self._has_ended = False
        self._sent_recording = ("", "")
        self._due = {"state": 0.0, "frame": 0.0}

    async def serve(self) -> str:
        """Answer the page until it goes away: what became of it, in words."""
        await self._socket.accept()
        works = (self._listen(), self._speak(), self._questions.run(), self._commands.run())
        tasks: set[asyncio.Task[str]] = {asyncio.create_task(work) for work in works}
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            return next(iter(done)).result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def stir(self) -> None:
        """Look whether there is something for the page."""
        self._stirred.set()

    async def _listen(self) -> str:
        while (message := await self._socket.receive())["type"] == "websocket.receive":
            await asyncio.sleep(self._rate_limit.delay_s(time.monotonic()))
            self._hear(message.get("text") or "")
            while self._is_busy:
                await asyncio.sleep(BUSY)
        return "closed" if message.get("code") in CLOSED else "dropped: it does not answer any more"

    @property
    def _is_busy(self) -> bool:
        """Whether the page asks faster than it is answered, or does not read the answers."""
        return len(self._replies) > WAITING or self._questions.is_full or self._commands.is_full

    async def _speak(self) -> str:
        try:
            await self._greet()
        except WebSocketDisconnect:
            return "closed"
        while True:
            self._stirred.clear()
            message = await self._next()
            try:
                if message is None:
                    await asyncio.wait_for(
                        self._stirred.wait(), max(min(self._due.values()) - time.monotonic(), 0.0)
                    )
                else:
                    await asyncio.wait_for(self._send(message), STALLED)
            except TimeoutError:
                if message is not None:
                    return "dropped: it takes nothing any more"
            except WebSocketDisconnect:
                return "closed"

    async def _greet(self) -> None:
        """Say hello as soon as there is a scan, which says what is drawn, or after a moment."""
        patience = time.monotonic() + GREETING
        while self._broadcast.shown is None and time.monotonic() < patience:
            await asyncio.sleep(GREETING / 60)
        await self._send(await self._in_thread(self._answers.hello))

    async def _in_thread(self, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._workers.answers, work)

    async def _send(self, message: bytes | dict[str, Any]) -> None:
        if isinstance(message, bytes):
            await self._socket.send_bytes(message)
        else:
            await self._socket.send_text(json.dumps(message, allow_nan=False))

    async def _next(self) -> bytes | dict[str, Any] | None:
        """What is to be sent now; None where there is nothing."""
        broadcast, now = self._broadcast, time.monotonic()
        if self._replies:
            return self._replies.popleft()
        if self._most is not None and (shown := self._unseen()) is not None:
            most, self._most = self._most, None
            self._held.append(shown)
            return shown.message(
                most
            )  # here: the large blocks of further threads would stay in arenas of theirs
        if broadcast.has_ended != self._has_ended:
            self._has_ended = broadcast.has_ended
            return {"is": "ended", "text": broadcast.ending} if self._has_ended else None
        self._due["frame"] = self._due["frame"] if self._watches else math.inf
        if now >= self._due["frame"]:
            self._due["frame"] = now + WATCHED
            newest = self._bytes.newest
            if newest != self._watched and (taken := self._bytes.frame(newest)) is not None:
                self._watched = newest
                with contextlib.suppress(LidarSpecError):  # what cannot be explained is not shown
                    return await self._in_thread(lambda: self._answers.frame(taken, "last"))
        recording = self._recording()
        if now >= self._due["state"] or recording != self._sent_recording:
            self._due["state"] = now + STATE
            self._sent_recording = recording
            frozen = self._frozen is not None
            state = self._answers.state(
                frozen=frozen, since=self._known, at=self._held[-1] if frozen else None
            )
            self._known = state["damaged"]["total"]
            return state
        return None

    def _recording(self) -> tuple[str, str]:
        """Return the name of the file that is being written, and why the last one failed."""
        switch = self._broadcast.switch
        if switch is None:
            return "", ""
        current = switch.recording
        return current[0] if current is not None else "", switch.trouble

    def _unseen(self) -> Shown | None:
        """The newest scan, where the page has not had it yet and wants to see it go on."""
        shown = self._broadcast.shown if self._frozen is None else None
        return (
            shown
            if shown is not None and not (self._held and self._held[-1].number == shown.number)
            else None
        )

    @property
    def _bytes(self) -> Backlog:
        return self._frozen or self._broadcast.backlog

    def _hear(self, text: str) -> None:
        """Do what a page asks for; what is nonsense is refused, with a word."""
        word = ""
        try:
            message = json.loads(text)
            if not isinstance(message, dict) or (word := str(message.get("do"))) not in self._words:
                raise UsageError(f"a message says what to do: {', '.join(self._words)}")
            self._words[word](self, message)
        except (ValueError, RecursionError):
            self._refuse(word, UsageError("a message is an object in JSON"))
        except LidarSpecError as error:
            self._refuse(word, error)

    def _refuse(self, word: str, error: LidarSpecError, command: str = "") -> None:
        facts = {"is": "refused", "of": word, "text": str(error)}
        facts |= {
            name: text for name, text in (("command", command), ("next", suggestion(error))) if text
        }
        self._answer(facts)

    def _answer(self, reply: dict[str, Any]) -> None:
        self._replies.append(reply)
        self.stir()

    def _later(
        self, word: str, work: Callable[[], dict[str, Any] | None], command: str = ""
    ) -> None:
        """Answer a question that takes a while, after those before it."""
        self._questions.add(Request(word, command, work))

    def _finish(self, request: Request, result: dict[str, Any] | Exception | None) -> None:
        """Answer a request that was done in a thread."""
        if isinstance(result, LidarSpecError):
            self._refuse(request.word, result, request.command)
        elif isinstance(result, Exception):
            self._refuse(request.word, LidarSpecError(_bug(result)), request.command)
        elif result is not None:
            self._answer(result)
        self.stir()

    def _next_scan(self, message: Mapping[str, Any]) -> None:
        self._most = round(_number(message, "most", 1, POINTS))
        self.stir()

    def _pause(self, message: Mapping[str, Any]) -> None:
        if self._broadcast.is_live:
            if not self._held:
                raise UsageError("there is nothing to pause before the first scan")
            if self._frozen is not None:
                return
            self._frozen = self._broadcast.backlog.frozen()
        else:
            self._broadcast.pause()
        self._due["state"] = 0.0
        self.stir()

    def _play(self, message: Mapping[str, Any]) -> None:
        if self._broadcast.is_live:
            self._frozen = None
        else:
            self._broadcast.play()
        self._due["state"] = 0.0
        self.stir()

    def _step(self, message: Mapping[str, Any]) -> None:
        self._broadcast.step()

    def _seek(self, message: Mapping[str, Any]) -> None:
        self._broadcast.seek(_number(message, "to", 0.0, LONGEST))

    def _speed(self, message: Mapping[str, Any]) -> None:
        self._broadcast.play_at(_number(message, "times", 0.0, LONGEST))

    def _watch(self, message: Mapping[str, Any]) -> None:
        self._watches, self._watched = message.get("frames") is True, -1
        self._due["frame"] = 0.0
        self.stir()

    def _frame(self, message: Mapping[str, Any]) -> None:
        backlog, point = self._bytes, message.get("point")
        if isinstance(point, dict):
            number, index = (
                round(_number(point, "scan", 0, LONGEST)),
                round(_number(point, "index", 0, POINTS)),
            )
            shown = next((one for one in self._held if one.number == number), None)
            self._later("frame", lambda: self._answers.origin(shown, number, index, backlog))
        elif "damaged" in message:
            number = round(_number(message, "damaged", 0, LONGEST))
            self._later("frame", lambda: self._answers.damaged(number, backlog))
        else:
            number = round(_number(message, "number", 0, LONGEST))
            self._later("frame", lambda: self._answers.numbered(number, backlog))

    def _compose(self, message: Mapping[str, Any]) -> None:
        name, words = _command(message)
        self._later("compose", lambda: self._answers.composed(name, words), name)

    def _command(self, message: Mapping[str, Any]) -> None:
        name, words = _command(message)
        self._commands.add(Request("send", name, lambda: self._answers.sent(name, words)))

    def _record(self, message: Mapping[str, Any]) -> None:
        switch = self._broadcast.switch
        if switch is None:
            raise UsageError(
                f"{self._broadcast.source} is a file already: there is nothing to record"
            )
        on = message.get("on")
        if not isinstance(on, bool | None):
            raise UsageError("on is true or false")

        def change() -> None:
            if on is None:
                switch.toggle()
            else:
                switch.set(on=on)
            self._broadcast.news()

        self._later("record", change)

    _words: Mapping[str, Callable[[Page, Mapping[str, Any]], None]] = {
        "next": _next_scan,
        "pause": _pause,
        "play": _play,
        "step": _step,
        "seek": _seek,
        "speed": _speed,
        "watch": _watch,
        "frame": _frame,
        "compose": _compose,
        "send": _command,
        "record": _record,
    }


def _bug(error: Exception) -> str:
    return f"a bug in lidarspec: {type(error).__name__}: {error}"


def _number(message: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """A number of a message."""
    value = message.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise UsageError(f"{name} is a number from {low:g} to {high:g}")
    return value


def _command(message: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """The name of a command, and its arguments as they were typed; those that were left empty are
    left out.
    """
    name, words = message.get("command"), message.get("arguments", {})
    if (
        not isinstance(name, str)
        or not isinstance(words, dict)
        or not all(isinstance(text, str) for text in words.values())
    ):
        raise UsageError("a command has a name, and arguments that are texts")
    return name, {argument: text for argument, text in words.items() if text}


class Site:
    """The page of a broadcast, served while this is entered.

    Args:
        broadcast: what is shown.
        host, port: where to listen; 0 is a free port.
        control: whether commands may be sent to a sensor that is no simulated one.
        page: the folder of the page's files; by default `PAGE`.
        say: is told, line by line, of pages that come and go.

    Attributes:
        link: to the page, with the token that it needs.

    Raises:
        SourceError: where it cannot listen there.
    """

    def __init__(
        self,
        broadcast: Broadcast,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        control: bool = False,
        page: Path | None = None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._broadcast, self._say, self._answers = (
            broadcast,
            say,
            Answers(broadcast, control=control),
        )
        self._open, self._pages = set[Page](), 0
        self._socket = _listening(host, port)
        port = self._socket.getsockname()[1]
        name = _name_of(host)
        self._token = make_token()
        self.link = f"http://{name}:{port}/?token={self._token}"
        self._folder = TemporaryFolder()
        self._files = page or PAGE
        routes = [
            Route("/", self._send_page),
            Route("/index.html", self._send_page),
            WebSocketRoute("/socket", self._watched),
            Route("/save/{name}", self._saved),
            Mount("/", StaticFiles(directory=self._files)),
        ]
        app = Starlette(routes=routes)
        self._connections = Connections(say)
        self._workers = Workers()
        self._saves = Saves(self._folder, self._workers.saves, self._connections.drop)
        self._server = uvicorn.Server(
            uvicorn.Config(
                Guard(
                    app,
                    host=host,
                    name=name,
                    port=port,
                    token=self._token,
                    admit=self._connections.admit,
                ),
                http=self._connections.protocol_class(),
                backlog=BACKLOG,
                log_config=None,
                log_level="critical",  # what it has to say of requests is not for a terminal
                access_log=False,
                lifespan="off",
                server_header=False,
                loop="asyncio",
                ws="websockets-sansio",
                ws_max_size=LARGEST,
                ws_ping_interval=PING,
                ws_ping_timeout=STALLED,
                ws_per_message_deflate=False,
                timeout_graceful_shutdown=FAREWELL,
            )
        )
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), name="pages")

    def opening_page(self) -> str:
        """Return the URL of a file that leads to the link, to start a browser with.

        Raises:
            OSError: if it cannot be written.
        """
        return write_opening_page(self._folder.path, self.link).as_uri()

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
        self._broadcast.news = lambda: None
        self._server.should_exit = True
        self._thread.join()
        self._workers.close()
        self._socket.close()
        self._folder.remove()

    async def _serve(self) -> None:
        loop = asyncio.get_running_loop()

        def stir() -> None:
            loop.call_soon_threadsafe(self._stir)

        self._broadcast.news = stir
        loop.set_exception_handler(ErrorReporter(self._say))
        watching = asyncio.create_task(self._connections.watch())
        await self._server.serve(sockets=[self._socket])
        watching.cancel()
        await self._connections.close()

    def _stir(self) -> None:
        for page in self._open:
            page.stir()

    def _send_page(self, request: HttpRequest) -> Response:
        text = (self._files / "index.html").read_text(encoding="utf-8")
        return HTMLResponse(add_token(text, self._token))

    async def _watched(self, socket: WebSocket) -> None:
        """One page, from its opening until it is closed."""
        if len(self._open) >= PAGES:
            await socket.close()
            return
        page = Page(self._answers, socket, self._workers)
        number = self._pages + 1
        self._open.add(page)
        self._pages = number
        self._say(
            f"page {number} opened by {socket.client.host if socket.client else 'nobody'};"
            f" {len(self._open)} open"
        )
        became = "closed"
        try:
            became = await page.serve()
        except Exception as error:
            became = f"closed: {_bug(error)}"
        finally:
            self._open.discard(page)
            self._say(f"page {number} {became}; {len(self._open)} open")

    async def _saved(self, request: HttpRequest) -> Response:
        """A scan as a file, by the number that a page knows it by."""
        number, _, suffix = request.path_params["name"].partition(".")
        shown = (
            self._broadcast.numbered(int(number))
            if number.isdecimal() and len(number) < DIGITS
            else None
        )
        if suffix not in saves():
            return PlainTextResponse(f"a scan is saved as {', '.join(saves())}", 404)
        if shown is None:
            return PlainTextResponse("this scan is not kept any more: pause before saving", 404)
        return self._saves.response(shown, suffix)


def _name_of(host: str) -> str:
    """Return the host of the link to a server that listens there."""
    if host in ANY_ADDRESS:
        return socket.gethostname()
    return f"[{host}]" if ":" in host else host


def _listening(host: str, port: int) -> socket.socket:
    try:
        found = socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
    except OSError as error:
        raise SourceError(
            f"no page can be served at {host}:{port}:"
            f" {os.strerror(error.errno) if error.errno else error}"
        ) from error
    if hasattr(
        socket, "TCP_USER_TIMEOUT"
    ):  # so that the system gives up what a page never takes; connections have it from here
        found.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(STALLED * 1000))
    return found
