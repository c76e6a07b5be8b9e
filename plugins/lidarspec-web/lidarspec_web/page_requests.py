"""The requests of one page: their rate limit, and the threads for slow requests.

If a page sends too many requests, only this page is delayed: the server waits before it reads the
next message of the page. The slow requests of a page run in threads, one after another, so that no
page uses more than its share of the threads.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NoReturn

#: Number of messages of a page that are read without a delay after a pause; the next constant is
#: the number of messages per second.
MESSAGES_AT_ONCE = 100
MESSAGES_PER_S = 100.0
#: Number of waiting requests above which no message of the page is read.
MAX_WAITING = 16
#: Maximum pause between two requests of a queue.
MAX_REST_S = 0.1
ANSWER_THREADS = 4


class Workers:
    """The threads of a server, by purpose."""

    def __init__(self) -> None:
        self.answers = ThreadPoolExecutor(ANSWER_THREADS, "page-answers")
        # The sensor replies to one command after another, which may take seconds.
        self.commands = ThreadPoolExecutor(1, "page-commands")
        self.saves = ThreadPoolExecutor(1, "page-saves")

    def close(self) -> None:
        """Cancel the waiting work, and wait for the work that has begun."""
        for executor in (self.answers, self.commands, self.saves):
            executor.shutdown(cancel_futures=True)


class RateLimit:
    """Calculates how long to delay messages that arrive faster than allowed.

    Args:
        burst: number of messages that are not delayed after a pause, however fast they arrive.
        per_second: allowed number of messages per second.
    """

    def __init__(self, burst: int, per_second: float) -> None:
        self._period_s = 1 / per_second
        self._burst_s = burst / per_second
        self._due = 0.0

    def delay_s(self, now: float) -> float:
        """Count a message that arrives at the time `now`, and return its delay in seconds."""
        self._due = max(self._due, now - self._burst_s) + self._period_s
        return max(self._due - now, 0.0)


@dataclass(frozen=True)
class PageRequest:
    """A slow request.

    Attributes:
        command: the command of the sensor that the request concerns; "" if there is none.
        work: a function that handles the request. It returns the reply; None for no reply.
    """

    word: str
    command: str
    work: Callable[[], dict[str, Any] | None]


class RequestQueue:
    """Requests of one page that run one after another, in a thread.

    Args:
        finish: called with each request and its reply, or its exception.
    """

    def __init__(
        self,
        executor: Executor,
        finish: Callable[[PageRequest, dict[str, Any] | Exception | None], None],
    ) -> None:
        self._executor = executor
        self._finish = finish
        self._requests = asyncio.Queue[PageRequest]()

    @property
    def is_full(self) -> bool:
        """Whether the queue is full, so that no request should be added."""
        return self._requests.qsize() >= MAX_WAITING

    def add(self, request: PageRequest) -> None:
        """Add a request to the end of the queue."""
        self._requests.put_nowait(request)

    async def run(self) -> NoReturn:
        """Run the requests until the task is cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            request = await self._requests.get()
            begin = time.monotonic()
            result: dict[str, Any] | Exception | None
            try:
                result = await loop.run_in_executor(self._executor, request.work)
            except Exception as error:
                result = error
            self._finish(request, result)
            # Threads share one processor: other pages have the next turn.
            await asyncio.sleep(min(time.monotonic() - begin, MAX_REST_S))
