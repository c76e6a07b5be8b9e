"""Run a contender in a process of another environment.

The parent sends a function of `libraries` with its arguments. The worker calls this function, which
prepares the contender. Then the worker runs the contender for each request and replies with the
seconds by its own clock. Requests and replies are pickles on the worker's standard input and
output. The worker needs `libraries` and `measure`, and nothing of lidarspec. It ends when its input
closes.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from measure import Clock, Contender, Timed


class RemoteContender:
    """A contender that a worker prepares and times.

    Args:
        python: the interpreter of the worker's environment.
        prepare: a function of `libraries`.
        arguments: arguments of that function.

    Raises:
        Missing: if the library is not installed there.
    """

    def __init__(self, python: Path, prepare: Callable[..., Contender], *arguments: Any) -> None:
        self._worker = subprocess.Popen(
            [python, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        self.amount: int = self._request((prepare, arguments))

    def seconds(self, repeats: int, clock: Clock) -> float:
        """Return the mean seconds of a run, measured by the worker."""
        seconds: float = self._request((repeats, clock))
        return seconds

    def close(self) -> None:
        """End the worker."""
        self._worker.communicate()

    def _request(self, message: Any) -> Any:
        assert self._worker.stdin is not None
        assert self._worker.stdout is not None
        pickle.dump(message, self._worker.stdin)
        self._worker.stdin.flush()
        reply = pickle.load(self._worker.stdout)
        if isinstance(reply, Exception):
            self.close()
            raise reply
        return reply


def prepare_in(python: Path, prepare: Callable[..., Contender], *arguments: Any) -> Timed:
    """Prepare a contender in the environment of an interpreter, or here if there is none."""
    if python.is_file():
        return RemoteContender(python, prepare, *arguments)
    return prepare(*arguments)


def serve() -> None:
    """Run the worker: prepare the contender and answer requests."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # keep a library's output out of the replies
    try:
        prepare, arguments = pickle.load(sys.stdin.buffer)
        contender = prepare(*arguments)
    except Exception as error:
        pickle.dump(error, replies)
        return
    reply: float = contender.amount
    while True:
        pickle.dump(reply, replies)
        replies.flush()
        try:
            repeats, clock = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        reply = contender.seconds(repeats, clock)


if __name__ == "__main__":
    serve()
