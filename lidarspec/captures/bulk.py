"""Read the datagrams of a capture in batches.

A batch has arrays of offsets, times and senders.

Most records of one sensor differ only in their payload and time. `CaptureBatches` therefore parses
one of these records, and `RecordKind.find` selects the others by comparing their header bytes. All
other records are parsed one at a time. The datagrams and the statistics are the same as those of
`CaptureReader`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.captures.pcap import CaptureReader, Datagram, StreamReader
from lidarspec.captures.records import (
    MAX_BLOCK_BYTES,
    DamagedRecordError,
    Form,
    NoPacketReason,
    TimeEncoding,
    make_record_reader,
)
from lidarspec.captures.source import BufferedInput, TruncatedError
from lidarspec.frames.layout import gather_rows
from lidarspec.framing.results import Frames, Indices
from lidarspec.transports.protocol import Origin, Sender

#: The maximum number of header bytes to compare. Records with longer headers are read singly.
MAX_HEADER_BYTES = 128

#: The largest size of a buffer.
MAX_BUFFER_BYTES = 2 * MAX_BLOCK_BYTES
_TRAILER_BYTES = 4
#: In both formats, the first bytes of a record contain its length. This is their number.
_MIN_HEAD_BYTES = 16
#: Consecutive records of equal length are checked together from this number on. For fewer records,
#: single checks are faster.
_MIN_RUN_RECORDS = 16
#: The maximum number of known kinds that the records of a batch are compared with, and of new kinds
#: that a batch may add. It limits the time per batch for any file.
MAX_KINDS = 16


@dataclass(frozen=True, eq=False)
class RecordKind:
    """The common properties of records with datagrams of one sender and size.

    Attributes:
        start: offset of the payload in the record.
        size: length of the payload, bytes.
        value: the first bytes of a record, as 64-bit words.
        mask: the bits of `value` that are equal in all records of the kind.
        trailer: the NumPy type of the length that is repeated at the end of a record; None if it is
            not repeated.
    """

    length: int
    start: int
    size: int
    source: Sender
    times: TimeEncoding
    value: NDArray[np.uint64]
    mask: NDArray[np.uint64]
    trailer: str | None

    def find(
        self, storage: NDArray[np.uint8], starts: Indices, lengths: Indices
    ) -> tuple[NDArray[np.bool_] | None, NDArray[np.int64]]:
        """Return the mask of the records of this kind, and their times.

        Args:
            storage: the buffer, with at least `MAX_HEADER_BYTES` after each start.
            starts: offsets of the records, (n,).

        Returns:
            A mask, (n,) bool, or None if all records are of this kind; and the times of the
            selected records, ns.
        """
        same = lengths == self.length
        if not same.all():
            matches = np.zeros(len(starts), np.bool_)
            if same.any():
                some, at = self.find(storage, starts[same], lengths[same])
            else:
                some = None
                at = np.empty(0, np.int64)
            matches[same] = True if some is None else some
            return matches, at
        heads = _gather_windows(storage, starts, self.value.nbytes)
        differs = heads.view(np.uint64) ^ self.value
        differs &= self.mask
        at, good = self.times.read_ns(heads)
        if self.trailer is not None:
            ends = (
                _gather_windows(storage, starts + (self.length - _TRAILER_BYTES), _TRAILER_BYTES)
                .view(self.trailer)
                .ravel()
            )
            whole: NDArray[np.bool_] = np.asarray(ends == self.length, np.bool_)
            if good is None:
                good = whole
            else:
                good = np.asarray(good & whole, np.bool_)
        if differs.any():
            equal: NDArray[np.bool_] = np.asarray(~differs.any(axis=1), np.bool_)
            if good is None:
                good = equal
            else:
                good = np.asarray(equal & good, np.bool_)
        if good is None or good.all():
            return (None, at)
        return (good, at[good])


def make_record_kind(record: bytes, datagram: Datagram, form: Form) -> RecordKind | None:
    """Return the kind of a record, with which similar records are found.

    Args:
        record: the bytes of the record.
        datagram: the datagram in the record.
        form: the record reader of the file.

    Returns:
        None if all such records must be read singly: the packet is reassembled or truncated, its
        headers are longer than `MAX_HEADER_BYTES`, `form` has no layout for the record, or its
        times may exceed 64 bits.
    """
    headers = datagram.headers
    pattern = form.find_layout(record)
    if headers is None or pattern is None:
        return None
    head = pattern.head
    start = pattern.head + headers.size
    if start > MAX_HEADER_BYTES or not pattern.times.fits_int64():
        return None
    size = start + -start % 8
    mask = np.zeros(size, np.uint8)
    mask[:start] = 0xFF
    # If the packet has headers, they give the length of the payload, so the original length of the
    # packet may vary.
    original = pattern.original_offsets if headers.size else ()
    variable = [head + offset for offset in headers.variable_offsets]
    mask[[*pattern.time_offsets, *original, *variable]] = 0
    value = np.frombuffer(record[:start].ljust(size, b"\0"), np.uint64)
    return RecordKind(
        len(record),
        start,
        headers.payload_size,
        datagram.source,
        pattern.times,
        value,
        mask.view(np.uint64),
        pattern.trailer,
    )


def find_records(
    storage: NDArray[np.uint8], start: int, stop: int, form: Form
) -> tuple[Indices, bool]:
    """Return the offsets of the complete records between `start` and `stop`.

    Args:
        form: the record reader of the file.

    Returns:
        An array with the start of each record and, as its last element, the end of the last record
        (only `start` if there is no complete record); and whether `form.read` must read the record
        that begins at the last element.
    """
    pieces: list[Indices] = []
    single: list[int] = []
    at = start
    before = 0
    singles_left = 0  # records to read one by one after a run that ended early
    length = -1
    view = storage.data
    if stop - at < _MIN_HEAD_BYTES:
        return np.array([at], np.intp), False
    while (
        stop - at >= _MIN_HEAD_BYTES
        and (length := form.find_length(view, at))
        and at + length <= stop
    ):
        if length == before and not singles_left and stop - at >= _MIN_RUN_RECORDS * length:
            run = _count_equal_lengths(storage, at, (stop - at) // length, length, form)
            pieces += [np.array(single, np.intp), np.arange(at, at + run * length, length)]
            single = []
            at = at + run * length
            singles_left = 2 * _MIN_RUN_RECORDS if run < _MIN_RUN_RECORDS else 0
            continue
        single.append(at)
        at = at + length
        before = length
        singles_left = max(singles_left - 1, 0)
    return np.concatenate([*pieces, np.array([*single, at], np.intp)]), length == 0


def _count_equal_lengths(
    storage: NDArray[np.uint8], at: int, count: int, length: int, form: Form
) -> int:
    """Return the number of consecutive records of `length` bytes, at most `count`."""
    field_offset, kind, value = form.length_field(length)
    values: NDArray[Any] = np.ndarray((count,), kind, storage, at + field_offset, (length,))
    others = values != value
    if others.any():
        return int(others.argmax())
    return count


def _gather_windows(storage: NDArray[np.uint8], starts: Indices, width: int) -> NDArray[np.uint8]:
    """Return the `width` bytes after each start, (n, width)."""
    everywhere: NDArray[np.void] = np.ndarray(
        (len(storage) - width + 1,), f"V{width}", storage, 0, (1,)
    )
    return everywhere[starts].view(np.uint8).reshape(len(starts), width)


@dataclass(frozen=True, eq=False)
class CapturedDatagrams:
    """A batch of n datagrams in the order of their arrival.

    Attributes:
        buffer: an array that contains the payloads. Later batches overwrite it, unless the array or
            a view of it is still in use.
        starts: (n,) offset of each payload in the buffer.
        sizes: (n,) length of each payload, bytes.
        at: (n,) int64 arrival times, ns since 1970; 0 if a record has no time.
        senders: (n,) index in `names` of each datagram's sender.
        names: (address, port) of each sender in the batch.
        gap: whether datagrams before this batch were skipped.
    """

    buffer: NDArray[np.uint8]
    starts: Indices
    sizes: Indices
    at: NDArray[np.int64]
    senders: Indices
    names: tuple[Sender, ...]
    gap: bool = False

    def __len__(self) -> int:
        return len(self.starts)

    def data(self, index: int) -> bytes:
        """Return the bytes of one datagram."""
        return self.buffer[self.starts[index] : self.starts[index] + self.sizes[index]].tobytes()

    @property
    def joined(self) -> bytes:
        """The bytes of all datagrams, concatenated."""
        size = self.sizes.item(0) if len(self) else 0
        if (self.sizes == size).all():
            return gather_rows(self.buffer, self.starts, size).tobytes()
        return b"".join(map(self.data, range(len(self))))

    def select_sender(self, origin: Origin) -> CapturedDatagrams:
        """Return only the datagrams from senders that match `origin`."""
        if all(name in origin for name in self.names):
            return self
        wanted = np.array([name in origin for name in self.names], np.bool_)[self.senders]
        return CapturedDatagrams(
            self.buffer,
            self.starts[wanted],
            self.sizes[wanted],
            self.at[wanted],
            self.senders[wanted],
            self.names,
        )

    def parts(self, size: int) -> Iterator[CapturedDatagrams]:
        """Split the batch into parts of about `size` bytes."""
        ends = np.cumsum(self.sizes)
        start = 0
        while start < len(self):
            stop = max(
                int(ends.searchsorted(ends[start] - self.sizes[start] + size, side="right")),
                start + 1,
            )
            own = slice(start, stop)
            yield CapturedDatagrams(
                self.buffer,
                self.starts[own],
                self.sizes[own],
                self.at[own],
                self.senders[own],
                self.names,
            )
            start = stop

    def count_by_host(self) -> dict[str, int]:
        """Return the number of datagrams of each IP address."""
        hosts = dict[str, int]()
        numbers = np.bincount(self.senders, minlength=len(self.names)).tolist()
        for (host, _), number in zip(self.names, numbers, strict=True):
            hosts[host] = hosts.get(host, 0) + number
        return hosts

    def iter_frame_senders(self, frames: Frames) -> Iterator[tuple[str, Sender]]:
        """Yield (frame type, sender) of the frames that were found in these datagrams."""
        if len(self.names) == 1:
            yield from (
                (frames.names[kind], self.names[0])
                for kind in np.flatnonzero(np.bincount(frames.kinds)).tolist()
            )
            return
        order = np.argsort(self.starts, kind="stable")
        senders = self.senders[order[np.searchsorted(self.starts[order], frames.starts)]]
        for kind in np.unique(frames.kinds).tolist():
            own = senders[frames.kinds == kind]
            changes = np.flatnonzero(np.diff(own, prepend=-1))
            yield from (
                (frames.names[kind], self.names[sender]) for sender in own[changes].tolist()
            )


class CaptureBatches(CaptureReader):
    """Reads the datagrams of a capture in batches of arrays.

    Iteration yields single datagrams, as for `CaptureReader`. Use either iteration or `batches`,
    not both.
    """

    max_buffer_bytes = MAX_BUFFER_BYTES

    def batches(self) -> Iterator[CapturedDatagrams]:
        """Yield the datagrams of the file, in one batch for each filled buffer."""
        kinds: list[RecordKind] = []
        with self._close_at_end():
            form = self._form = self._form or make_record_reader(self._source)
            while self._source.begin_record():
                starts, stuck = find_records(
                    self._source.storage, self._source.at, self._source.stop, form
                )
                if len(starts) < 2 and not stuck and self._source.read_more():
                    continue
                if len(starts) <= 1:
                    starts = np.array([self._source.at])
                block = _RecordBlock(self, self._source, form, starts, kinds)
                ended = block.read()
                before = self._source.offset
                if len(batch := block.batch()):
                    self.stats.datagrams += len(batch)
                    yield batch
                if self._source.offset != before:
                    continue  # the consumer of the batch called `skip_until`
                if isinstance(ended, DamagedRecordError):
                    self._skip_damage(form)
                elif ended is not None:
                    raise ended
                kinds = block.rank_kinds()


class StreamBatches(StreamReader, CaptureBatches):
    """Reads the packets in the capture of a byte stream, in batches."""


class _RecordBlock:
    """The complete records in the buffer, or one record that `form.read` must read.

    The block has only the next record if `find_records` finds no complete record, because the
    buffer contains only a part of the next record, or because `form.find_length` returns 0.
    """

    def __init__(
        self,
        reader: CaptureReader,
        source: BufferedInput,
        form: Form,
        starts: Indices,
        kinds: list[RecordKind],
    ) -> None:
        self._reader = reader
        self._source = source
        self._form = form
        self._known = kinds
        number = max(len(starts) - 1, 1)
        self._are_whole = len(starts) > 1
        self._starts = starts
        self._lengths = starts[1:] - starts[:-1] if self._are_whole else np.zeros(1, np.intp)
        self._kinds = np.full(number, -1, np.intp)  # indices into `_known`
        self._at = np.zeros(number, np.int64)
        self._singles: dict[int, Datagram] = {}
        self._kinds_added = 0  # number of kinds that were added for these records
        # Number of packets with a kind that were read singly, so that they are already counted.
        self._matched_singles = 0
        self._only: RecordKind | None = None  # the kind of all records, if there is only one
        self._section = form.sections
        self._storage = source.storage
        # Store the buffer now, because the source may switch to another buffer when it reads more.
        self._buffer = source.view()

    def read(self) -> Exception | None:
        """Read the records; return the exception if one cannot be read, else None."""
        if not any(self._match(kind) for kind in range(len(self._known))):
            for index in np.flatnonzero(self._kinds < 0).tolist():
                if self._kinds[index] >= 0:
                    continue  # its kind was added for an earlier record of this loop
                self._source.at = int(self._starts[index])
                try:
                    self._read_single(index)
                except (DamagedRecordError, TruncatedError) as ended:
                    self._kinds = self._kinds[:index]
                    return ended
                if self._form.sections != self._section:
                    self._kinds = self._kinds[: index + 1]
                    return None
                if self._only is not None:
                    break
        if self._are_whole:
            self._source.at = int(self._starts[-1])
        return None

    def rank_kinds(self) -> list[RecordKind]:
        """Return the kinds to compare with the next records, the most frequent first."""
        if self._form.sections != self._section:
            return []
        if len(self._known) == 1:
            return self._known
        counts = np.bincount(self._kinds[self._kinds >= 0], minlength=len(self._known))
        return [
            self._known[kind] for kind in np.argsort(-counts, kind="stable")[:MAX_KINDS].tolist()
        ]

    def batch(self) -> CapturedDatagrams:
        """Return the datagrams of these records."""
        if self._only is not None and not self._singles:
            return self._make_uniform_batch(self._only)
        matched = np.flatnonzero(self._kinds >= 0)
        self._reader.stats.packets += len(matched) - self._matched_singles
        kinds = self._kinds[matched]
        names: dict[Sender, int] = {}
        facts = np.array(
            [
                (kind.start, kind.size, names.setdefault(kind.source, len(names)))
                for kind in self._known
            ],
            np.intp,
        ).reshape(-1, 3)
        if len(facts) != 1:
            starts, sizes, senders = facts[kinds].T
        else:
            starts, sizes, senders = (np.full(len(matched), fact) for fact in facts.ravel())
        columns = [self._starts[matched] + starts, sizes, self._at[matched], senders]
        if len(matched):
            buffer = self._buffer
        else:
            buffer = np.empty(0, np.uint8)
        if self._singles:
            buffer = self._add_singles(buffer, columns, matched, names)
        return CapturedDatagrams(
            buffer, columns[0], columns[1], columns[2], columns[3], tuple(names)
        )

    def _make_uniform_batch(self, kind: RecordKind) -> CapturedDatagrams:
        """Return the batch of these records, which are all of one kind."""
        number = len(self._at)
        self._reader.stats.packets += number - self._matched_singles
        sizes, senders = (np.broadcast_to(np.intp(fact), number) for fact in (kind.size, 0))
        return CapturedDatagrams(
            self._buffer,
            self._starts[:number] + kind.start,
            sizes,
            self._at,
            senders,
            (kind.source,),
        )

    def _add_singles(
        self,
        buffer: NDArray[np.uint8],
        columns: list[NDArray[Any]],
        matched: Indices,
        names: dict[Sender, int],
    ) -> NDArray[np.uint8]:
        """Add the singly read datagrams to `columns`, in the order of the records.

        Returns:
            A longer buffer: `buffer`, followed by the payloads of the singly read datagrams.
        """
        data = b"".join(datagram.data for datagram in self._singles.values())
        at = len(buffer)
        rows = []
        for datagram in self._singles.values():
            rows.append(
                (at, len(datagram.data), datagram.at, names.setdefault(datagram.source, len(names)))
            )
            at += len(datagram.data)
        order = np.argsort(
            np.concatenate([matched, np.array(list(self._singles), np.intp)]), kind="stable"
        )
        columns[:] = [
            np.concatenate(parts)[order]
            for parts in zip(columns, np.array(rows, np.int64).T, strict=True)
        ]
        return np.concatenate([buffer, np.frombuffer(data, np.uint8)])

    def _read_single(self, index: int) -> None:
        self._source.begin_record()
        packet = self._form.read()
        datagram = self._reader.to_datagram(packet)
        if datagram is None or isinstance(packet, NoPacketReason):
            return
        self._singles[index] = datagram
        if self._kinds_added == MAX_KINDS or not self._are_whole:
            return
        record = self._storage[self._starts[index] : self._starts[index + 1]].tobytes()
        kind = make_record_kind(record, datagram, self._form)
        if kind is not None:
            self._kinds_added += 1
            self._known = [*self._known, kind]
            self._match(len(self._known) - 1, since=index)
            if self._kinds[index] >= 0:
                del self._singles[index]
                self._matched_singles += 1

    def _match(self, kind: int, since: int = 0) -> bool:
        """Assign a kind to matching records; return whether all records have a kind."""
        template = self._known[kind]
        number = len(self._kinds)
        if kind == since == 0 and self._are_whole:
            matches, at = template.find(self._storage, self._starts[:number], self._lengths)
            if matches is None:
                self._only = template
                self._at = at
                self._kinds = np.broadcast_to(np.intp(0), number)
                return True
            left = np.flatnonzero(matches)
        else:
            left = since + np.flatnonzero(self._kinds[since:] < 0)
            matches, at = template.find(self._storage, self._starts[left], self._lengths[left])
            left = left if matches is None else left[matches]
        self._kinds[left] = kind
        self._at[left] = at
        return matches is None and not since
