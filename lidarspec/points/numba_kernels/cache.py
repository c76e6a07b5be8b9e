"""Keep compiled kernels on disk between runs.

They are in a folder that only its user can access, because the files are executed.

A kernel is one file: a keyed digest (HMAC), and behind it what Numba made of the kernel, a pickle,
which is opened only where the digest is right. The key is a file that its user alone can read, and
names come out of it too. So nothing that somebody else, a full disk or a crash left in the folder
is ever run; whatever is wrong there means compiling again.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import hmac
import os
import pickle
import secrets
import stat
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

from lidarspec.trusted_files import describe_sharing

# mypy: disable-error-code="no-untyped-call"

CACHE = "LIDARSPEC_CACHE"

#: bytes of the key, and of a digest.
SIZE = 32
#: what a file or folder has to lack, so that it is its user's alone.
_OTHERS = stat.S_IRWXG | stat.S_IRWXO
#: neither through a link nor waiting for a pipe's other end, where the system knows such things.
_PLAINLY = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


class StoredKernel:
    """The compiled code of one kernel, as a dispatcher of Numba asks for it and hands it over.

    Args:
        name: of the kernel, by all that its code depends on but for the processor.
    """

    cache_path = None

    def __init__(self, name: str) -> None:
        self._name = name

    def load_overload(self, signature: object, target: Any) -> Any:
        """Return the result of compiling the kernel in an earlier run.

        Returns None if there is none, or if it is not authentic.
        """
        from numba.core.compiler import CompileResult

        with contextlib.suppress(Exception):  # Numba compiles what it cannot use
            folder = _own(cache_folder())
            key = _key(folder)
            if key is not None:
                path = _path(folder, key, self._name, target)
                data = _read(path)
                if hmac.compare_digest(data[:SIZE], _digest(key, path.name, data[SIZE:])):
                    target.refresh()  # it knows of nothing before
                    return CompileResult._rebuild(target, *pickle.loads(data[SIZE:]))
        return None

    def save_overload(self, signature: object, result: Any) -> None:
        """Keep what Numba made of the kernel; where that cannot be done, it is said once."""
        from numba.core.serialize import dumps

        try:
            folder = _make_folder(cache_folder())
            key = _key(folder) or _new_key(folder)
            data = dumps(result._reduce())
            path = _path(folder, key, self._name, result.target_context)
            _write(path, _digest(key, path.name, data) + data)
        except Exception as error:  # the kernel is at hand all the same
            _warn(f"compiled code cannot be stored for later runs: {error}")


def is_stored(name: str) -> bool:
    """Return whether there is a file of this kernel, for one processor or another."""
    try:
        folder = _own(cache_folder())
        key = _key(folder)
        return key is not None and any(folder.glob(f"{_digest(key, name).hex()}-*"))
    except OSError:
        return False


def cache_folder() -> Path:
    """Return the folder of kernels: LIDARSPEC_CACHE, or the user's cache of the system."""
    named = os.environ.get(CACHE)
    if named:
        return Path(named)
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "lidarspec"


def _make_folder(folder: Path) -> Path:
    """Return the folder, made where it is missing.

    Raises:
        OSError: where it cannot be made, or is not its user's alone.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=stat.S_IRWXU)
    return _own(folder)


def _own(folder: Path) -> Path:
    """Return the folder that is given.

    Raises:
        OSError: where it is missing, or not its user's alone.
    """
    if reason := describe_sharing(folder.stat(), _OTHERS):
        raise PermissionError(f"{folder} {reason}")
    return folder


def _key(folder: Path) -> bytes | None:
    """The key of a folder; None where it has none, or not a whole one that is its user's alone."""
    with contextlib.suppress(OSError):
        key = _read(folder / "key")
        if len(key) == SIZE:
            return key
        return None
    return None


def _new_key(folder: Path) -> bytes:
    _write(folder / "key", secrets.token_bytes(SIZE))
    return _read(folder / "key")  # of whoever wrote it last


def _digest(key: bytes, name: str, data: bytes = b"") -> bytes:
    return hmac.digest(key, name.encode() + b"\0" + data, hashlib.sha256)


def _path(folder: Path, key: bytes, name: str, target: Any) -> Path:
    """Return the file of a kernel, for the processor that Numba compiles for here."""
    processor = _digest(key, repr(target.codegen().magic_tuple())).hex()[:16]
    return folder / f"{_digest(key, name).hex()}-{processor}"


def _read(path: Path) -> bytes:
    """Return the content of a file that belongs to the user alone.

    Raises:
        OSError: where it is not, or cannot be read.
    """
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | _PLAINLY)) as file:
        status = os.fstat(file.fileno())
        if describe_sharing(status, _OTHERS) or not stat.S_ISREG(status.st_mode):
            raise PermissionError(f"{path} is accessible to other users")
        return file.read()


def _write(path: Path, data: bytes) -> None:
    """Put a file in its place once it is whole; its user alone can read it."""
    number, unfinished = tempfile.mkstemp(dir=path.parent)
    try:
        with open(number, "wb") as file:
            file.write(data)
        os.replace(unfinished, path)
    except BaseException:
        os.unlink(unfinished)
        raise


@functools.cache
def _warn(text: str) -> None:
    """Say it, once a run."""
    warnings.warn(text, stacklevel=2)
