"""Read one input within limits, and return an undocumented result as a finding."""

from __future__ import annotations

import contextlib
import resource
import signal
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NoReturn

import lidarspec
from tests.fuzz.targets import Target

#: processor seconds that an input may take; what only waits is given the longer time, since other
#: jobs may have the processor.
BUSY, WAITING = 1.0, 30.0
#: bytes that an input may add to the process.
MEMORY = 500_000_000
_OURS = (str(Path(lidarspec.__file__).parent), "lidarspec_")


class TooLong(BaseException):
    """An input took too long; no `except Exception` of the reader catches this."""


@dataclass(frozen=True)
class Finding:
    """An input with an undocumented result.

    Attributes:
        target: the name of the target.
        data: the input.
        what: the exception.
        place: the innermost line of lidarspec or of a plugin in the traceback, which identifies
            the fault.
    """

    target: str
    data: bytes
    what: str
    place: str


@contextlib.contextmanager
def limits() -> Iterator[None]:
    """Limit the memory of the process, and let `judge` measure the time of an input."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    bound_memory()
    handlers = {kind: signal.signal(kind, _late) for kind in (signal.SIGPROF, signal.SIGALRM)}
    try:
        yield
    finally:
        for kind, handler in handlers.items():
            signal.signal(kind, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


def bound_memory() -> None:
    """Limit the additional memory of the process.

    Called again at times, because the input generator keeps some inputs.
    """
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, hard))


def _late(number: int, frame: FrameType | None) -> NoReturn:
    told = f"{BUSY:g} s of work" if number == signal.SIGPROF else f"{WAITING:g} s"
    raise TooLong(f"more than {told}")


def judge(target: Target, data: bytes) -> Finding | None:
    """Return the finding for an input, None if its result is documented."""
    signal.setitimer(signal.ITIMER_PROF, BUSY)
    signal.setitimer(signal.ITIMER_REAL, WAITING)
    try:
        target.run(data)
        return None
    except target.documented:
        return None
    except (Exception, TooLong, SystemExit) as error:
        signal.setitimer(signal.ITIMER_PROF, 0)
        return Finding(target.name, data, f"{type(error).__name__}: {error}"[:300], _place(error))
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)


def _place(error: BaseException) -> str:
    """Return the innermost line of our code, otherwise the innermost of all."""
    spots = traceback.extract_tb(error.__traceback__)
    ours = [spot for spot in spots if any(part in spot.filename for part in _OURS)]
    spot = (ours or spots)[-1]
    return f"{'/'.join(Path(spot.filename).parts[-3:])}:{spot.lineno}"
