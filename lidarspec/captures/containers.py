"""Detect the kind of a file by its first bytes, and decompress it.

Files without raw sensor data are refused. Files are decompressed while they are read. If a
compressed file is damaged, the content ends at the damage, and `find_damage` returns the reason. A
zip archive must be a file, not a pipe.
"""

from __future__ import annotations

import io
import os
import re
import sys
import zipfile
from contextlib import ExitStack, closing
from pathlib import Path
from shlex import quote
from typing import Any, BinaryIO, NamedTuple, cast

from lidarspec.captures.records import is_capture
from lidarspec.errors import SourceError, UnknownName, UsageError, suggest, system_errors
from lidarspec.optional_libraries import import_library
from lidarspec.recording.format import MAGIC
from lidarspec.remote_files import open_stored

#: The number of bytes at the start of a file from which its kind is detected.
HEAD_BYTES = 512
#: The maximum number of bytes to decompress in one step.
STEP_BYTES = 1 << 13
#: The maximum number of bytes that one read of a file decompresses. A read of a pipe returns the
#: bytes that have arrived.
READ_BYTES = 1 << 20
#: The maximum nesting of compressed files, such as a compressed capture in a zip archive.
MAX_NESTING = 2
#: The maximum number of files of an archive to list in a message.
MAX_NAMES = 6


class Packing(NamedTuple):
    """A compression format.

    Attributes:
        command: a shell command that decompresses a file; {} stands for the file.
    """

    name: str
    module: str
    command: str


ZIP = Packing("zip", "zipfile", "unzip {}")
#: The compression formats, by a pattern of the first bytes of the file.
PACKINGS = {
    rb"\x1f\x8b\x08[\x00-\x1f]": Packing("gzip", "gzip", "gunzip -k {}"),
    rb"BZh[1-9]1AY&SY": Packing("bzip2", "bz2", "bunzip2 -k {}"),
    rb"\xfd7zXZ\x00": Packing("xz", "lzma", "unxz -k {}"),
    rb"\x28\xb5\x2f\xfd|[\x50-\x5f]\x2a\x4d\x18": Packing(
        "zstd", "compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd", "unzstd {}"
    ),
    rb"PK\x03\x04": ZIP,
}
#: For a pattern of the first bytes of an unsupported file, the kind of the file, and the command
#: that extracts the data.
CONTAINERS = {
    rb"\x04\x22\x4d\x18": ("compressed by lz4", "unlz4 {}"),
    rb"7z\xbc\xaf\x27\x1c": ("a 7z archive", "7z x {}"),
    rb"Rar!\x1a\x07": ("a RAR archive", "7z x {}"),
    rb".{257}ustar": ("a tar archive", "tar -xf {}"),
    rb"snoop\x00{3}|btsnoop\x00|\x34\xcd\xb2\xa1|\xa1\xb2\xcd\x34": (
        "a capture in an unsupported format",
        "editcap {} capture.pcapng",
    ),
    rb"version https://git-lfs": (
        "a Git LFS pointer instead of the file",
        "git lfs pull",
    ),
    rb"\x89HDF\r\n": ("an HDF5 file", ""),
    rb"PAR1": ("a Parquet file", ""),
    rb"ARROW1\x00\x00|FEA1": ("an Arrow file", ""),
    rb"\x93NUMPY": ("a NumPy array", ""),
    rb"\x80[\x02\x03](?:[\]})(]q\x00|c\w|\x8a\n)|\x80[\x04\x05]\x95.{5}\x00{3}": (
        "a Python pickle",
        "",
    ),
    rb"# \.PCD v|ply\r?\n|LASF|ASTM-E57": ("a point cloud file", ""),
    rb"\x89PNG\r\n|\xff\xd8\xff[\xdb\xe0\xe1\xee]|GIF8[79]a|.{4}ftyp": ("an image or a video", ""),
    rb"%PDF-": ("a PDF document", ""),
    rb"\x7fELF": ("an executable file", ""),
    rb"\s*(?:\[\s*)?\{\s*\"[^\"]*\"\s*:": ("JSON", ""),
    rb"(?i)\s*<(?:\?xml|!doctype|html)": ("an XML or HTML page", ""),
}
_REFUSED = CONTAINERS | {
    beginning: (f"compressed more than once by {packing.name}", packing.command)
    for beginning, packing in PACKINGS.items()
}


class Damage(NamedTuple):
    """The reason why decompression ended early.

    Attributes:
        unread: number of compressed bytes that were not read.
    """

    text: str
    unread: int


class UnpackedFile(io.RawIOBase):
    """The content of a compressed file, decompressed while it is read; not seekable.

    Args:
        packed: the compressed file. `close` closes it, unless it is standard input.

    Attributes:
        damage: the reason why decompression ended early; None if it did not.
    """

    def __init__(self, name: str, packed: BinaryIO, file: Any) -> None:
        self.name = name
        self._packed = packed
        self._file = file
        self.damage: Damage | None = None
        self._step = READ_BYTES if packed.seekable() else HEAD_BYTES
        self._count = 0

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        room = min(len(buffer), self._step)
        count = 0
        while count < room and (data := self._read_some(room - count)):
            buffer[count : count + len(data)] = data
            count += len(data)
        return count

    def close(self) -> None:
        if not self.closed:
            self._file.close()
            if self._packed is not sys.stdin.buffer:
                self._packed.close()
        super().close()

    def _read_some(self, size: int) -> bytes:
        if self.damage is not None:
            return b""
        try:
            data: bytes = self._file.read1(min(STEP_BYTES, size))
            self._count += len(data)
            return data
        except EOFError:
            self.damage = Damage(f"{self.name} is truncated{self._message_end}", 0)
        except Exception as error:
            # Each library raises its own exceptions for damaged bytes; bz2 and gzip raise OSError.
            if isinstance(error, OSError) and error.errno is not None:
                raise
            offset = self._packed.tell() if self._packed.seekable() else 0
            size = self._packed.seek(0, os.SEEK_END) if offset else 0
            where = f" before byte {offset} of {size}" if offset else ""
            self.damage = Damage(
                f"{self.name} is corrupt{where} ({error}){self._message_end}", max(size - offset, 1)
            )
        return b""

    @property
    def _message_end(self) -> str:
        """The end of a message about damage, which says how much content was read."""
        return f": only the first {self._count} decompressed bytes were read"


def find_damage(file: BinaryIO) -> Damage | None:
    """Return the reason why a decompressed file ended early; None if it did not."""
    raw = getattr(file, "raw", None)
    if isinstance(raw, UnpackedFile):
        return raw.damage
    return None


def open_capture(path: str | os.PathLike[str], member: str = "") -> BinaryIO:
    """Open a file for reading, and decompress a compressed file; see `unpack`."""
    with system_errors(os.fspath(path)), ExitStack() as undo:
        file = undo.enter_context(closing(open_stored(os.fspath(path))))
        content = unpack(os.fspath(path), file, member)
        undo.pop_all()
    return content


def unpack(name: str, file: BinaryIO, member: str = "") -> BinaryIO:
    """Return an open file, or the decompressed content of a compressed file.

    Closing the result closes the file.

    Args:
        member: the file to read from a zip archive; "" for the only capture or recording in it.

    Raises:
        SourceError: for an archive that cannot be decompressed, or contains no capture.
        UsageError: for an archive with several captures, or if a library is missing.
    """
    for _ in range(MAX_NESTING):
        packing = _detect_packing(peek_head(file))
        if packing is None:
            break
        if packing is ZIP:
            content = _open_archive_member(name, file, member)
            member = ""
        else:
            content = import_library(packing.module, "zstd").open(file)
        file = cast(BinaryIO, io.BufferedReader(UnpackedFile(name, file, content), READ_BYTES))
    if member:
        raise UsageError(f"{name} is not a zip archive, so it does not contain {member}")
    return file


def _detect_packing(start: bytes) -> Packing | None:
    return next(
        (packing for beginning, packing in PACKINGS.items() if re.match(beginning, start)), None
    )


def _open_archive_member(name: str, file: BinaryIO, member: str) -> Any:
    """Open one file of a zip archive."""
    if not file.seekable():
        raise SourceError(
            f"{name} is a zip archive, which cannot be read from a pipe: pass the file"
        )
    try:
        archive = zipfile.ZipFile(file)
        names = [
            item.filename
            for item in archive.infolist()
            if not item.is_dir() and not item.filename.startswith("__MACOSX/")
        ]
        return archive.open(_choose_member(name, archive, names, member))
    except (UsageError, SourceError):
        raise
    except Exception as error:  # zipfile raises exceptions of many types for damaged archives
        if isinstance(error, zipfile.BadZipFile):
            command = f"zip -FF {quote(name)} --out repaired.zip"
        else:
            command = f"unzip {quote(name)}"
        raise suggest(
            SourceError(f"cannot read the zip archive {name}: {error}"), command
        ) from error


def _choose_member(name: str, archive: zipfile.ZipFile, names: list[str], member: str) -> str:
    """Return the requested or the only suitable file of a zip archive."""
    if member:
        if member not in names:
            raise UnknownName(member, names, place=name)
        return member
    if len(names) == 1:
        return names[0]
    readable = [item for item in names if _is_readable(archive, item)]
    if len(readable) == 1:
        return readable[0]
    candidates = readable or names
    shown = ", ".join(candidates[:MAX_NAMES])
    if len(candidates) > MAX_NAMES:
        shown += ", ..."
    if not readable:
        raise SourceError(f"the zip archive {name} contains no capture, only {shown or 'nothing'}")
    raise suggest(
        UsageError(f"{name} contains {len(readable)} captures: {shown}"),
        f"repeat with {quote(f'{name}?file={readable[0]}')}",
    )


def _is_readable(archive: zipfile.ZipFile, member: str) -> bool:
    """Return whether a file of an archive is a capture, a recording or compressed."""
    with archive.open(member) as file:
        start = file.read(HEAD_BYTES)
    return is_capture(start) or start.startswith(MAGIC) or _detect_packing(start) is not None


def refuse_unsupported_file(path: str, start: bytes) -> None:
    """Raise SourceError if a file is of a known kind that cannot be read.

    Args:
        start: the first `HEAD_BYTES` of the file, decompressed.

    Raises:
        SourceError: for an unsupported file.
    """
    for beginning, (kind, command) in _REFUSED.items():
        if re.match(beginning, start, re.DOTALL):
            error = SourceError(
                f"{path} is {kind}: expected a capture, a recording or the raw bytes of a sensor"
            )
            if command and Path(path).exists():
                raise suggest(error, command.format(quote(path)))
            raise error


def peek_head(file: BinaryIO) -> bytes:
    """Return the first bytes of a file or pipe, without consuming them."""
    if isinstance(file, io.BufferedReader):
        return file.peek(HEAD_BYTES)[:HEAD_BYTES]
    start = file.read(HEAD_BYTES)
    file.seek(-len(start), os.SEEK_CUR)
    return start
