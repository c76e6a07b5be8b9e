"""Temporary names of files while they are written, and removal of abandoned files.

A file is written under a temporary name in the folder of its destination, and renamed when it is
complete. A process that is killed leaves a temporary file.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import time
from pathlib import Path

from lidarspec.errors import SourceError
from lidarspec.remote_files import remove

#: Seconds without a write after which the file of an ended process is removed. Before that, a
#: process of the same number on another computer may still be writing it.
ABANDONED_AFTER_S = 60.0


def path_while_written(path: Path) -> Path:
    """Return the temporary path of a file or folder while this process writes it."""
    return path.with_name(f".{os.getpid()}.{path.name}")


def remove_abandoned_files(path: Path) -> None:
    """Remove the temporary files that killed processes have left beside their destination.

    Args:
        path: the destination of the temporary files; it is not removed.
    """
    for process, name in _list_unfinished(path.parent.absolute()):
        left = path.with_name(f".{process}.{name}")
        with contextlib.suppress(OSError, SourceError):
            if (
                name == path.name
                and not is_running(process)
                and time.time() - left.stat().st_mtime > ABANDONED_AFTER_S
            ):
                remove(left)


@functools.cache  # listed once: a folder can get many thousands of files
def _list_unfinished(folder: Path) -> list[tuple[int, str]]:
    """Return (process number, final name) of each unfinished file in a folder."""
    try:
        names = os.listdir(folder)
    except OSError:
        return []
    matches = (re.fullmatch(r"\.([1-9]\d*)\.(.+)", name, re.DOTALL) for name in names)
    return [(int(match[1]), match[2]) for match in matches if match]


def is_running(process: int) -> bool:
    """Return whether a process exists; True if this is unknown."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True
