"""Files in remote stores, such as s3://bucket/drives/a.pcap, opened by fsspec.

All functions also accept paths of local files.
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
from lidarspec.optional_libraries import import_library

#: URL scheme -> the library that fsspec requires for it; "" if it requires none.
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
#: The hash of a file is computed from this number of bytes at its beginning and at its end.
DIGESTED_END_BYTES = 1 << 16


def is_remote(path: object) -> bool:
    """Return whether a path is a URL with a supported scheme."""
    scheme, mark, _ = str(path).partition("://")
    return bool(mark) and scheme in DRIVERS


def find_file_system(url: str) -> Any:
    """Return the fsspec file system of a URL.

    Raises:
        UsageError: if fsspec, or the library for this scheme, is not installed.
        SourceError: if the store cannot be reached.
    """
    fsspec = import_library("fsspec", "fsspec")
    scheme = url.partition("://")[0]
    with _convert_failures(url):
        try:
            return fsspec.core.url_to_fs(url)[0]
        except ImportError as error:
            reason = f"{url}: {scheme}:// requires {DRIVERS[scheme]}, which is not installed"
            raise suggest(UsageError(reason), f"pip install {DRIVERS[scheme]}") from error


def open_stored(path: str) -> BinaryIO:
    """Open a path or URL for reading.

    Raises:
        UsageError: if the library of a store is not installed.
        SourceError: if the file cannot be opened.
    """
    if not is_remote(path):
        with system_errors(path):
            return open(path, "rb")
    system = find_file_system(path)
    with _convert_failures(path):
        file: BinaryIO = system.open(path, "rb")
        if isinstance(file, io.BytesIO):
            # This is a copy, because all readers of one BytesIO would share its offset.
            return io.BytesIO(file.getbuffer())
        return file


def find_files(pattern: str) -> list[tuple[str, str]]:
    """Return the files that match a path or URL with *, ? and **.

    Returns:
        (path, path relative to the part of the pattern without wildcards) of each file.

    Raises:
        SourceError: if there is none.
    """
    fixed = pattern
    while glob.has_magic(fixed):
        fixed = fixed.rpartition("/")[0]
    if is_remote(pattern):
        system = find_file_system(pattern)
        with _convert_failures(pattern):
            paths = [system.unstrip_protocol(path) for path in system.glob(pattern)]
    else:
        paths = [path for path in glob.glob(pattern, recursive=True) if os.path.isfile(path)]
    if not paths:
        raise SourceError(f"{pattern}: no such file")
    names = (
        normalise_path(path).removeprefix(normalise_path(fixed)).lstrip("/")
        if fixed != pattern
        else path.rpartition("/")[2]
        for path in paths
    )
    return sorted(zip(paths, names, strict=True))


def files_in(folder: str) -> set[str]:
    """Return the normalised paths of all files and folders below a folder, if any.

    Raises:
        SourceError: if the store cannot be reached.
    """
    if not is_remote(folder):
        return {
            normalise_path(Path(parent, name))
            for parent, folders, files in os.walk(folder)
            for name in (*folders, *files)
        }
    system = find_file_system(folder)
    with _convert_failures(folder):
        if system.exists(folder):
            return {normalise_path(system.unstrip_protocol(path)) for path in system.find(folder)}
        return set()


def normalise_path(path: object) -> str:
    """Return a normalised path or URL for comparison."""
    if is_remote(path):
        return str(path).partition("://")[2].lstrip("/")
    return Path(str(path)).as_posix().removeprefix("./")


def read_stamp(path: str) -> dict[str, Any]:
    """Return {"size": size in bytes, "modified": text} for a file.

    The text differs after each change of the file. It is the time of the last change, or the tag
    (ETag) that a store gives to each version of a file; "" if the store provides neither.

    Raises:
        SourceError: if the file does not exist.
    """
    if not is_remote(path):
        with system_errors(path):
            status = os.stat(path)
        return {"size": status.st_size, "modified": str(status.st_mtime_ns)}
    system = find_file_system(path)
    with _convert_failures(path):
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


def hash_ends(path: str) -> str:
    """Return a hash of the beginning and the end of a file."""
    with contextlib.closing(open_stored(path)) as file:
        head = file.read(DIGESTED_END_BYTES)
        file.seek(max(file.seek(0, os.SEEK_END) - DIGESTED_END_BYTES, 0))
        return hashlib.blake2b(head + file.read(DIGESTED_END_BYTES), digest_size=16).hexdigest()


def upload(local: Path, url: str) -> None:
    """Copy a local file or folder to a store.

    A single file is not visible in the store before it is complete.

    Raises:
        SourceError: if the copy fails.
    """
    system = find_file_system(url)
    with _convert_failures(url):
        if local.is_dir():
            system.put(str(local), url, recursive=True)
            return
        system.makedirs(url.rpartition("/")[0], exist_ok=True)
        with system.transaction, local.open("rb") as file, system.open(url, "wb") as target:
            shutil.copyfileobj(file, cast(Any, target), 1 << 22)


def remove(path: str | Path) -> None:
    """Remove a file or folder, if there is one.

    Raises:
        SourceError: if the file or folder cannot be removed.
    """
    if is_remote(path):
        system = find_file_system(str(path))
        with _convert_failures(str(path)):
            system.rm(str(path), recursive=True)
        return
    with system_errors(path):
        if os.path.isdir(path) and not os.path.islink(path):
            shutil.rmtree(path)
        else:
            Path(path).unlink(missing_ok=True)


@contextlib.contextmanager
def _convert_failures(url: str) -> Iterator[None]:
    """Convert all exceptions of a store to `SourceError`."""
    try:
        yield
    except LidarSpecError:
        raise
    except Exception as error:
        raise SourceError(f"{url}: {_failure_reason(url, error)}") from error


def _failure_reason(url: str, error: Exception) -> str:
    """Return the reason why a store failed."""
    text = str(error)
    if (
        normalise_path(text) != normalise_path(url)
        and text.lstrip("/") != normalise_path(url)
        and text
    ):
        return text
    if isinstance(error, FileNotFoundError):
        return "no such file"
    return type(error).__name__
