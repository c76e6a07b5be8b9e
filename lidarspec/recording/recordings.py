"""Recordings read: everything that came over a link, with its arrival time, in the order of then.

A `Recording` stops at the first damaged record, or salvages what lies behind it; what a killed process leaves behind is whole
records and at most one that is not. It is hostile input: no length is believed, and memory is bounded by one record (`format`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from lidarspec.errors import SourceError, WireError, suggest
from lidarspec.recording.format import DIRECTIONS, HEADER, MAGIC, VERSION, Header, Record, RecordReader, read_header


class Recording:
    """A recording, read in order: an iterable of `Record`s that goes on where the last loop stopped, and a context manager.

    Args:
        path: the file.
        salvage: go on behind damaged places, even where the header is one.

    Attributes:
        header: what it says of itself.

    Raises:
        SourceError: where the file cannot be opened, is no recording, or one of a later format.
        WireError: where its header is damaged, and `salvage` is not asked for.
    """

    def __init__(self, path: str | Path, *, salvage: bool = False) -> None:
        self.path, self.salvage = str(path), salvage
        try:
            self._file: BinaryIO = open(path, "rb")  # noqa: SIM115  closed by `close`
        except OSError as error:
            raise SourceError(f"{path}: {error.strerror or error}") from None
        try:
            self._reader = RecordReader(self._file, salvage=salvage)
            self._records = self._begin()
        except BaseException:
            self.close()
            raise

    @property
    def records(self) -> int:
        """Records read so far, the header and events among them."""
        return self._reader.records

    @property
    def damaged(self) -> int:
        """Damaged places so far; a record that is not whole at the end is one."""
        return self._reader.damaged

    @property
    def leftover(self) -> int:
        """Bytes in damaged places; without `salvage` all that are behind the last good record."""
        return self._reader.leftover

    @property
    def is_cut(self) -> bool:
        """Whether the last damaged place is a record that the file ends in."""
        return self._reader.is_cut

    @property
    def offset(self) -> int:
        """File offset of the next record, or of the damage that ended the reading."""
        return self._reader.offset

    def __iter__(self) -> Iterator[Record]:
        return self._records

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _begin(self) -> Iterator[Record]:
        """Read the header; the records behind it."""
        try:
            magic = self._file.read(len(MAGIC))
            if magic != MAGIC:
                seen = f"it begins with {magic.hex(' ')}" if magic else "it is empty"
                raise SourceError(f"{self.path}: not an .lsr recording: {seen}")
            pairs = iter(self._reader)
            first = next(pairs, None)
        except OSError as error:
            raise SourceError(f"{self.path}: {error.strerror or error}") from None
        if first is not None and first[0] == HEADER:
            self.header = read_header(first[1].data)
            if self.header.version > VERSION:
                raise SourceError(f"{self.path}: written in format {self.header.version}, and this lidarspec knows {VERSION}")
            return self._known(pairs)
        if not self.salvage:
            damage = WireError(f"{self.path}: the header of the recording is damaged or cut off")
            raise suggest(damage, f"lidarspec record {self.path} --salvage -o mended.lsr")
        self.header = Header()
        return self._known(itertools.chain([] if first is None else [first], pairs))

    def _known(self, pairs: Iterator[tuple[int, Record]]) -> Iterator[Record]:
        try:
            yield from (record for kind, record in pairs if kind in DIRECTIONS)
        except OSError as error:
            raise SourceError(f"{self.path}: {error.strerror or error}") from None
