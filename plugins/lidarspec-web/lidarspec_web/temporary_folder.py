"""The temporary folder of a server; after a crash, the next server removes it.

Each server locks its folder. The system releases the lock when the process ends for any reason, so
a folder that can be locked no longer belongs to a server. On systems without file locks (Windows),
a folder is removed only by its own server.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import tempfile
import threading
from pathlib import Path

if sys.platform != "win32":
    import fcntl

PREFIX = "lidarspec-view-"


class TemporaryFolder:
    """A folder that only the user can read, made when it is first needed."""

    def __init__(self) -> None:
        self._making = threading.Lock()
        self._path: Path | None = None
        self._lock: int | None = None

    @property
    def path(self) -> Path:
        """The folder; it is made on first use.

        Raises:
            OSError: if it cannot be made.
        """
        with self._making:
            if self._path is None:
                self._path, self._lock = _make_folder()
            return self._path

    def remove(self) -> None:
        """Remove the folder with its files."""
        with self._making:
            if self._path is not None:
                shutil.rmtree(self._path, ignore_errors=True)
            if self._lock is not None:
                os.close(self._lock)
            self._path = None
            self._lock = None


def remove_stale_folders() -> None:
    """Remove the temporary folders of servers that were killed."""
    if sys.platform == "win32":
        return
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        except OSError:
            continue  # a link, a file, another user's folder, or removed
        try:
            if os.fstat(descriptor).st_uid == os.getuid():
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path, ignore_errors=True)
        except OSError:
            continue  # its server still runs
        finally:
            os.close(descriptor)


def _make_folder() -> tuple[Path, int | None]:
    """Return a new folder, and the file descriptor that locks the folder."""
    while True:
        path = Path(tempfile.mkdtemp(prefix=PREFIX))
        if sys.platform == "win32":
            return path, None
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            continue  # another server, just starting, removed it as a stale one
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if path.is_dir():
            return path, descriptor
        os.close(descriptor)
