"""Store compiled kernels on disk between runs.

The compiled code is executed, so the files are in a folder that only the user can access. Each file
begins with a keyed digest (HMAC) of the code. A file with a wrong digest is not loaded, and the
kernel is compiled again.
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

#: The size of the key and of a digest, bytes.
DIGEST_BYTES = 32
#: The permissions that a private file or folder must not have.
_SHARED_PERMISSIONS = stat.S_IRWXG | stat.S_IRWXO
#: The flags to open a file without following links or waiting for a pipe, if the system has them.
_SAFE_OPEN_FLAGS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


class StoredKernel:
    """The stored code of one kernel, in the form that a Numba dispatcher expects.

    Args:
        name: the name of the kernel, a hash of everything that its code depends on, except for the
            processor.
    """

    cache_path = None

    def __init__(self, name: str) -> None:
        self._name = name

    def load_overload(self, signature: object, target: Any) -> Any:
        """Return the code that an earlier run compiled.

        Returns None if no code is stored, or if its digest shows that it was changed.
        """
        from numba.core.compiler import CompileResult

        with contextlib.suppress(Exception):  # if this fails, Numba compiles the kernel
            folder = _check_private(cache_folder())
            key = _read_key(folder)
            if key is not None:
                path = _find_path(folder, key, self._name, target)
                data = _read(path)
                if hmac.compare_digest(
                    data[:DIGEST_BYTES], _compute_digest(key, path.name, data[DIGEST_BYTES:])
                ):
                    target.refresh()  # loads the functions that the code refers to
                    return CompileResult._rebuild(target, *pickle.loads(data[DIGEST_BYTES:]))
        return None

    def save_overload(self, signature: object, result: Any) -> None:
        """Store the compiled code; warn once if this fails."""
        from numba.core.serialize import dumps

        try:
            folder = _make_folder(cache_folder())
            key = _read_key(folder) or _make_key(folder)
            data = dumps(result._reduce())
            path = _find_path(folder, key, self._name, result.target_context)
            _write(path, _compute_digest(key, path.name, data) + data)
        except Exception as error:  # the kernel can be used in this run
            _warn(f"compiled code cannot be stored for later runs: {error}")


def is_stored(name: str) -> bool:
    """Return whether a file of this kernel exists, for any processor."""
    try:
        folder = _check_private(cache_folder())
        key = _read_key(folder)
        return key is not None and any(folder.glob(f"{_compute_digest(key, name).hex()}-*"))
    except OSError:
        return False


def cache_folder() -> Path:
    """Return the folder of kernels: LIDARSPEC_CACHE, or a folder in the user's cache."""
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
    """Create the folder if it is missing, and return it.

    Raises:
        OSError: if the folder cannot be created, or if other users can access it.
    """
    folder.mkdir(parents=True, exist_ok=True, mode=stat.S_IRWXU)
    return _check_private(folder)


def _check_private(folder: Path) -> Path:
    """Return a folder after checking that only the user can access it.

    Raises:
        OSError: if the folder is missing, or if other users can access it.
    """
    if reason := describe_sharing(folder.stat(), _SHARED_PERMISSIONS):
        raise PermissionError(f"{folder} {reason}")
    return folder


def _read_key(folder: Path) -> bytes | None:
    """Return the key of a folder; None if it is missing, invalid or not private."""
    with contextlib.suppress(OSError):
        key = _read(folder / "key")
        if len(key) == DIGEST_BYTES:
            return key
        return None
    return None


def _make_key(folder: Path) -> bytes:
    _write(folder / "key", secrets.token_bytes(DIGEST_BYTES))
    return _read(folder / "key")  # another process may have written a key at the same time


def _compute_digest(key: bytes, name: str, data: bytes = b"") -> bytes:
    return hmac.digest(key, name.encode() + b"\0" + data, hashlib.sha256)


def _find_path(folder: Path, key: bytes, name: str, target: Any) -> Path:
    """Return the path of the file with a kernel's code for this computer's processor."""
    processor = _compute_digest(key, repr(target.codegen().magic_tuple())).hex()[:16]
    return folder / f"{_compute_digest(key, name).hex()}-{processor}"


def _read(path: Path) -> bytes:
    """Return the content of a file that only the user can access.

    Raises:
        OSError: if other users can access it, or if it cannot be read.
    """
    with open(
        path, "rb", opener=lambda name, flags: os.open(name, flags | _SAFE_OPEN_FLAGS)
    ) as file:
        status = os.fstat(file.fileno())
        if describe_sharing(status, _SHARED_PERMISSIONS) or not stat.S_ISREG(status.st_mode):
            raise PermissionError(f"{path} can be read or changed by other users: remove it")
        return file.read()


def _write(path: Path, data: bytes) -> None:
    """Write a file that only the user can read."""
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
    """Issue a warning once in a run of the program."""
    warnings.warn(text, stacklevel=2)
