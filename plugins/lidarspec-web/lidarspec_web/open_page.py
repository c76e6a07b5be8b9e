"""One open page: its requests, and the messages to it.

A page requests each scan after it has drawn the previous scan, and receives the newest scan. A slow
or hidden page therefore causes little work, and no page shows old data. Requests are JSON objects;
the entry `do` is the name of the handler. Slow requests run in threads (`page_requests`).

While a page is paused, a live source continues.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from lidarspec import LidarSpecError, UsageError
from lidarspec.errors import suggestion
from lidarspec_web.broadcast import ShownScan
from lidarspec_web.page_messages import PageMessages
from lidarspec_web.page_requests import (
    MESSAGES_AT_ONCE,
    MESSAGES_PER_S,
    PageRequest,
    RateLimit,
    RequestQueue,
    Workers,
)
from lidarspec_web.recent_bytes import RecentBytes

#: Number of unsent replies above which no further request is read.
MAX_REPLIES = 16
#: Time between two checks of whether a page with too many requests can be served.
BUSY_CHECK_S = 0.05
STATE_PERIOD_S = 0.5
FRAME_PERIOD_S = 0.5
#: A page that does not read a message within this time is disconnected.
SEND_TIMEOUT_S = 20.0
#: Maximum time that the first message to a page waits for a first scan.
GREETING_TIMEOUT_S = 3.0
GREETING_CHECK_S = 0.05
#: The codes with which browsers close a socket.
CLOSE_CODES = (1000, 1001, 1012)
#: Maximum number of points that a page may request.
MAX_POINTS = 1 << 24
#: Number of scans whose points a page may ask about: the drawn scan, and the scan that is being
#: sent.
HELD_SCANS = 2
#: The largest number in a request.
MAX_NUMBER = 1e12


class OpenPage:
    """Serves one page."""

    def __init__(self, answers: PageMessages, socket: WebSocket, workers: Workers) -> None:
        self._answers = answers
        self._broadcast = answers.broadcast
        self._socket = socket
        self._workers = workers
        self._replies = deque[dict[str, Any]]()
        self._has_news = asyncio.Event()
        self._rate_limit = RateLimit(MESSAGES_AT_ONCE, MESSAGES_PER_S)
        self._questions = RequestQueue(workers.answers, self._finish)
        self._commands = RequestQueue(workers.commands, self._finish)
        self._wanted_points: int | None = None  # of the requested scan
        self._held = deque[ShownScan](maxlen=HELD_SCANS)
        self._frozen: RecentBytes | None = None
        self._shows_frames = False
        self._sent_frame = -1
        self._sent_damaged = 0
        self._sent_end = False
        self._sent_recording = ("", "")
        self._state_due = 0.0
        self._frame_due = math.inf

    async def serve(self) -> str:
        """Serve the page until it is closed.

        Returns:
            How the page was closed, as a text that follows the name of the page.
        """
        await self._socket.accept()
        works = (
            self._receive_requests(),
            self._send_messages(),
            self._questions.run(),
            self._commands.run(),
        )
        tasks: set[asyncio.Task[str]] = {asyncio.create_task(work) for work in works}
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            return next(iter(done)).result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    def notify(self) -> None:
        """Make `serve` check for new messages to the page."""
        self._has_news.set()

    # Messages to the page.

    async def _send_messages(self) -> str:
        try:
            await self._greet()
            while True:
                self._has_news.clear()
                message = await self._choose_message()
                if message is None:
                    await self._wait_for_news()
                elif not await self._send_in_time(message):
                    return "was disconnected, because it stopped reading"
        except WebSocketDisconnect:
            return "was closed"

    async def _send_in_time(self, message: bytes | dict[str, Any]) -> bool:
        """Send a message, and return whether the page reads it in time."""
        try:
            await asyncio.wait_for(self._send(message), SEND_TIMEOUT_S)
        except TimeoutError:
            return False
        return True

    async def _greet(self) -> None:
        """Send the first message after the first scan, or after a timeout."""
        end = time.monotonic() + GREETING_TIMEOUT_S
        while self._broadcast.shown is None and time.monotonic() < end:
            await asyncio.sleep(GREETING_CHECK_S)
        await self._send(await self._run_in_thread(self._answers.hello))

    async def _wait_for_news(self) -> None:
        due = min(self._state_due, self._frame_due)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._has_news.wait(), max(due - time.monotonic(), 0.0))

    async def _run_in_thread(self, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._workers.answers, work)

    async def _send(self, message: bytes | dict[str, Any]) -> None:
        if isinstance(message, bytes):
            await self._socket.send_bytes(message)
        else:
            await self._socket.send_text(json.dumps(message, allow_nan=False))

    async def _choose_message(self) -> bytes | dict[str, Any] | None:
        """Return the message to send next; None if there is none."""
        if self._replies:
            return self._replies.popleft()
        return (
            self._make_scan_message()
            or self._end_message()
            or await self._make_frame_message()
            or self._make_state_message()
        )

    def _make_scan_message(self) -> bytes | None:
        max_points = self._wanted_points
        shown = self._find_unseen_scan()
        if max_points is None or shown is None:
            return None
        self._wanted_points = None
        self._held.append(shown)
        # Made in this thread: glibc would keep large blocks of memory for each further thread.
        return shown.message(max_points)

    def _end_message(self) -> dict[str, Any] | None:
        has_ended = self._broadcast.has_ended
        is_new = has_ended and not self._sent_end
        self._sent_end = has_ended
        if is_new:
            return {"is": "ended", "text": self._broadcast.end_reason}
        return None

    async def _make_frame_message(self) -> dict[str, Any] | None:
        if not self._shows_frames:
            self._frame_due = math.inf
            return None
        now = time.monotonic()
        if now < self._frame_due:
            return None
        self._frame_due = now + FRAME_PERIOD_S
        number = self._backlog.newest_number
        stored = self._backlog.frame(number)
        if stored is None or number == self._sent_frame:
            return None
        self._sent_frame = number
        try:
            return await self._run_in_thread(lambda: self._answers.frame(stored, "last"))
        except LidarSpecError:
            return None  # a frame without an explanation is not shown

    def _make_state_message(self) -> dict[str, Any] | None:
        now = time.monotonic()
        recording = self._find_recording()
        if now < self._state_due and recording == self._sent_recording:
            return None
        self._state_due = now + STATE_PERIOD_S
        self._sent_recording = recording
        is_frozen = self._frozen is not None
        state = self._answers.state(
            frozen=is_frozen,
            first_damaged=self._sent_damaged,
            paused_at=self._held[-1] if is_frozen else None,
        )
        self._sent_damaged = state["damaged"]["total"]
        return state

    def _find_recording(self) -> tuple[str, str]:
        """Return the file of the current recording, and the error of the last recording."""
        switch = self._broadcast.switch
        if switch is None:
            return "", ""
        current = switch.current_file
        return current[0] if current is not None else "", switch.trouble

    def _find_unseen_scan(self) -> ShownScan | None:
        """Return the newest scan; None if the page has it already, or is paused."""
        shown = self._broadcast.shown
        if shown is None or self._frozen is not None:
            return None
        if self._held and self._held[-1].number == shown.number:
            return None
        return shown

    @property
    def _backlog(self) -> RecentBytes:
        return self._frozen or self._broadcast.backlog

    # Requests of the page.

    async def _receive_requests(self) -> str:
        while True:
            message = await self._socket.receive()
            if message["type"] != "websocket.receive":
                break
            await asyncio.sleep(self._rate_limit.delay_s(time.monotonic()))
            self._handle(message.get("text") or "")
            while self._is_busy:
                await asyncio.sleep(BUSY_CHECK_S)
        if message.get("code") in CLOSE_CODES:
            return "was closed"
        return "was disconnected, because its connection failed or it did not answer pings"

    @property
    def _is_busy(self) -> bool:
        """Whether the page sends requests too fast, or does not read the replies."""
        return len(self._replies) > MAX_REPLIES or self._questions.is_full or self._commands.is_full

    def _handle(self, text: str) -> None:
        """Handle a request, or reply with the reason why it is refused."""
        word = ""
        try:
            request = json.loads(text)
            if isinstance(request, dict):
                word = str(request.get("do"))
            if word not in self._handlers:
                raise UsageError(
                    f'invalid message: "do" must be one of {", ".join(self._handlers)}'
                )
            self._handlers[word](self, request)
        except (ValueError, RecursionError):
            self._refuse(word, UsageError("invalid message: expected a JSON object"))
        except LidarSpecError as error:
            self._refuse(word, error)

    def _refuse(self, word: str, error: LidarSpecError, command: str = "") -> None:
        reply = {"is": "refused", "of": word, "text": str(error)}
        if command:
            reply["command"] = command
        if suggestion(error):
            reply["next"] = suggestion(error)
        self._reply(reply)

    def _reply(self, reply: dict[str, Any]) -> None:
        self._replies.append(reply)
        self.notify()

    def _reply_later(
        self, word: str, work: Callable[[], dict[str, Any] | None], command: str = ""
    ) -> None:
        """Queue a slow request; the reply is sent when the request has run.

        Args:
            work: a function that handles the request and returns the reply.
            command: the command of the sensor that the request concerns; "" if there is none.
        """
        self._questions.add(PageRequest(word, command, work))

    def _finish(self, request: PageRequest, result: dict[str, Any] | Exception | None) -> None:
        """Send the reply of a request that ran in a thread."""
        if isinstance(result, LidarSpecError):
            self._refuse(request.word, result, request.command)
        elif isinstance(result, Exception):
            self._refuse(request.word, LidarSpecError(describe_bug(result)), request.command)
        elif result is not None:
            self._reply(result)
        self.notify()

    def _ask_for_scan(self, request: Mapping[str, Any]) -> None:
        self._wanted_points = round(_read_number(request, "most", 1, MAX_POINTS))
        self.notify()

    def _pause(self, request: Mapping[str, Any]) -> None:
        if not self._broadcast.is_live:
            self._broadcast.pause()
        elif not self._held:
            raise UsageError("cannot pause before the first scan")
        elif self._frozen is not None:
            return
        else:
            self._frozen = self._broadcast.backlog.freeze()
        self._state_due = 0.0
        self.notify()

    def _play(self, request: Mapping[str, Any]) -> None:
        if self._broadcast.is_live:
            self._frozen = None
        else:
            self._broadcast.play()
        self._state_due = 0.0
        self.notify()

    def _step(self, request: Mapping[str, Any]) -> None:
        self._broadcast.step()

    def _seek(self, request: Mapping[str, Any]) -> None:
        self._broadcast.seek(_read_number(request, "to", 0.0, MAX_NUMBER))

    def _set_speed(self, request: Mapping[str, Any]) -> None:
        self._broadcast.set_speed(_read_number(request, "times", 0.0, MAX_NUMBER))

    def _watch(self, request: Mapping[str, Any]) -> None:
        self._shows_frames = request.get("frames") is True
        self._sent_frame = -1
        self._frame_due = 0.0
        self.notify()

    def _show_frame(self, request: Mapping[str, Any]) -> None:
        """Reply with the frame that the page requests."""
        backlog = self._backlog
        point = request.get("point")
        if isinstance(point, dict):
            scan = round(_read_number(point, "scan", 0, MAX_NUMBER))
            index = round(_read_number(point, "index", 0, MAX_POINTS))
            shown = next((held for held in self._held if held.number == scan), None)
            self._reply_later(
                "frame", lambda: self._answers.find_point_frame(shown, scan, index, backlog)
            )
        elif "damaged" in request:
            number = round(_read_number(request, "damaged", 0, MAX_NUMBER))
            self._reply_later("frame", lambda: self._answers.find_damaged(number, backlog))
        else:
            number = round(_read_number(request, "number", 0, MAX_NUMBER))
            self._reply_later("frame", lambda: self._answers.find_frame(number, backlog))

    def _compose(self, request: Mapping[str, Any]) -> None:
        name, arguments = _read_command(request)
        self._reply_later("compose", lambda: self._answers.compose_command(name, arguments), name)

    def _send_command(self, request: Mapping[str, Any]) -> None:
        name, arguments = _read_command(request)
        self._commands.add(
            PageRequest("send", name, lambda: self._answers.send_command(name, arguments))
        )

    def _record(self, request: Mapping[str, Any]) -> None:
        switch = self._broadcast.switch
        if switch is None:
            raise UsageError(
                f"{self._broadcast.source} is a file: only a live source can be recorded"
            )
        on = request.get("on")
        if not isinstance(on, bool | None):
            raise UsageError('"on" must be true or false')

        def change() -> None:
            if on is None:
                switch.toggle()
            else:
                switch.set_state(on=on)
            self._broadcast.on_news()

        self._reply_later("record", change)

    _handlers: Mapping[str, Callable[[OpenPage, Mapping[str, Any]], None]] = {
        "next": _ask_for_scan,
        "pause": _pause,
        "play": _play,
        "step": _step,
        "seek": _seek,
        "speed": _set_speed,
        "watch": _watch,
        "frame": _show_frame,
        "compose": _compose,
        "send": _send_command,
        "record": _record,
    }


def describe_bug(error: Exception) -> str:
    """Return the message for an exception that only a bug can cause."""
    return f"a bug in lidarspec: {type(error).__name__}: {error}"


def _read_number(request: Mapping[str, Any], name: str, low: float, high: float) -> float:
    """Return a number of a request.

    Raises:
        UsageError: if the value is not a number, or out of range.
    """
    value = request.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise UsageError(f"{name}: expected a number from {low:g} to {high:g}")
    return value


def _read_command(request: Mapping[str, Any]) -> tuple[str, dict[str, str]]:
    """Return the name of a command, and its non-empty arguments as text.

    Raises:
        UsageError: if the name is missing, or if the arguments are not texts.
    """
    name = request.get("command")
    arguments = request.get("arguments", {})
    if (
        not isinstance(name, str)
        or not isinstance(arguments, dict)
        or not all(isinstance(text, str) for text in arguments.values())
    ):
        raise UsageError("invalid command: expected a name, and arguments as strings")
    return name, {argument: text for argument, text in arguments.items() if text}
