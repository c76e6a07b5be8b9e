"""Files in stores, such as s3://bucket/drives/a.pcap: what fsspec reaches by URL, as files of this
computer are by their paths.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import io
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, cast

from lidarspec.errors import LidarSpecError, SourceError, UsageError, suggest, system_errors
from lidarspec.libraries import import_library

#: what a URL of a store begins with, and the library that fsspec takes for it, where it has none of
#: its own.
DRIVERS = {
    **dict.fromkeys(("file", "ftp", "memory"), ""),
    **dict.fromkeys(("s3", "s3a"), "s3fs"),
    **dict.fromkeys(("gs", "gcs"), "gcsfs"),
    **dict.fromkeys(("az", "abfs", "abfss"), "adlfs"),
    **dict.fromkeys(("http", "https"), "aiohttp"),
    **dict.fromkeys(("ssh", "sftp"), "paramiko"),
    "oci": "ocifs",
    "oss": "ossfs",
    "smb": "smbprotocol",
    "hdfs": "pyarrow",
}
#: bytes at the beginning and at the end that tell a file from others of its size.
ENDS = 1 << 16


def is_stored(path: object) -> bool:
    """Whether a path is the URL of a file in a store."""
    scheme, mark, _ = str(path).partition("://")
    return bool(mark) and scheme in DRIVERS


def system_of(url: str) -> Any:
    """The file system of fsspec that a URL is of.

    Raises:
        UsageError: where fsspec, or its driver, is not installed.
        SourceError: where the store cannot be reached.
    """
    fsspec = import_library("fsspec", "fsspec")
    scheme = url.partition("://")[0]
    with _failures(url):
        try:
            return fsspec.core.url_to_fs(url)[0]
        except ImportError as error:
            reason = f"{url}: {scheme}:// takes {DRIVERS[scheme]}, which is not installed"
            raise suggest(UsageError(reason), f"pip install {DRIVERS[scheme]}") from error


def file_of(path: str) -> BinaryIO:
    """The open file of a path or URL, to be read.

    Raises:
        UsageError: where the library of a store is not installed.
        SourceError: where it cannot be opened.
    """
    if not is_stored(path):
        with system_errors(path):
            return open(path, "rb")
    system = system_of(path)
    with _failures(path):
        file = system.open(path, "rb")
        return (
            io.BytesIO(file.getbuffer()) if isinstance(file, io.BytesIO) else file
        )  # of which all readers share one place


def found(pattern: str) -> list[tuple[str, str]]:
    """The files of a path or URL, in which *, ? and ** stand for what they do in a shell: each with
    its path below the fixed part.

    Raises:
        SourceError: where there is none.
    """
    fixed = pattern
    while glob.has_magic(fixed):
        fixed = fixed.rpartition("/")[0]
    if is_stored(pattern):
        system = system_of(pattern)
        with _failures(pattern):
            paths = [system.unstrip_protocol(path) for path in system.glob(pattern)]
    else:
        paths = [path for path in glob.glob(pattern, recursive=True) if os.path.isfile(path)]
    if not paths:
        raise SourceError(f"{pattern}: there is no such file")
    names = (
        plain(path).removeprefix(plain(fixed)).lstrip("/")
        if fixed != pattern
        else path.rpartition("/")[2]
        for path in paths
    )
    return sorted(zip(paths, names, strict=True))


def files_in(folder: str) -> set[str]:
    """What is in a folder and below, plainly spelt; nothing where there is no folder.

    Raises:
        SourceError: where the store cannot be reached.
    """
    if not is_stored(folder):
        return {
            plain(Path(at, name))
            for at, folders, files in os.walk(folder)
            for name in (*folders, *files)
        }
    system = system_of(folder)
    with _failures(folder):
        if system.exists(folder):
            return {plain(system.unstrip_protocol(path)) for path in system.find(folder)}
        return set()


def plain(path: object) -> str:
    """One spelling of a path or URL, to be compared: memory:///a is memory://a, and ./a is a."""
    if is_stored(path):
        return str(path).partition("://")[2].lstrip("/")
    return Path(str(path)).as_posix().removeprefix("./")


def stamp(path: str) -> dict[str, Any]:
    """The `size` of a file, and when it was `modified` (or the store's tag for that).

    Raises:
        SourceError: where there is none.
    """
    if not is_stored(path):
        with system_errors(path):
            status = os.stat(path)
        return {"size": status.st_size, "modified": str(status.st_mtime_ns)}
    system = system_of(path)
    with _failures(path):
        info = system.info(path)
    tag = next(
        (
            info[name]
            for name in ("ETag", "etag", "LastModified", "mtime", "last_modified", "created")
            if info.get(name)
        ),
        "",
    )
    return {"size": info["size"], "modified": str(tag)}


def digest(path: str) -> str:
    """A hash of the beginning and the end of a file."""
    with contextlib.closing(file_of(path)) as file:
        head = file.read(ENDS)
        file.seek(max(file.seek(0, os.SEEK_END) - ENDS, 0))
        return hashlib.blake2b(head + file.read(ENDS), digest_size=16).hexdigest()


def put(local: Path, url: str) -> None:
    """Put a file or folder into a store, where a file appears whole.

    Raises:
        SourceError: where that fails.
    """
    system = system_of(url)
    with _failures(url):
        if local.is_dir():
            system.put(str(local), url, recursive=True)
            return
        system.makedirs(url.rpartition("/")[0], exist_ok=True)
        with system.transaction, local.open("rb") as file, system.open(url, "wb") as target:
            shutil.copyfileobj(file, cast(Any, target), 1 << 22)


def take_away(path: str | Path) -> None:
    """Remove a file or folder, if there is one.

    Raises:
        SourceError: where that fails.
    """
    if is_stored(path):
        system = system_of(str(path))
        with _failures(str(path)):
            system.rm(str(path), recursive=True)
        return
    with system_errors(path):
        if os.path.isdir(path) and not os.path.islink(path):
            shutil.rmtree(path)
        else:
            Path(path).unlink(missing_ok=True)


@contextlib.contextmanager
def _failures(url: str) -> Iterator[None]:
    """What a store refuses within, in whatever way, as a `SourceError`."""
    try:
        yield
    except LidarSpecError:
        raise
    except Exception as error:
        raise SourceError(f"{url}: {_failure_reason(url, error)}") from error


def _failure_reason(url: str, error: Exception) -> str:
    """Return why a store failed; many drivers repeat only the URL or path of a missing file."""
    text = str(error)
    if plain(text) != plain(url) and text.lstrip("/") != plain(url) and text:
        return text
    if isinstance(error, FileNotFoundError):
        return "no such file"
    return type(error).__name__
