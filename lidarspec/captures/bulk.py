"""Datagrams of a capture by the hundred, as arrays: where they stand in one buffer, when they came
and from whom.

Consecutive datagrams of a device differ in their payloads, their times and little else. So
`CaptureBatches` reads one record as `CaptureReader` does; what was found there holds for every
record of the same length whose headers have the same bytes, except for those that its headers and
the file's format name as free. `walked` finds where the records of a buffer begin, and all that are
`Alike` are then found at once. Whatever is not alike is read one by one, so that the datagrams,
their order and what is counted are the same, whatever is in the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.captures.ip import Headers
from lidarspec.captures.pcap import CaptureReader, Datagram, StreamReader
from lidarspec.captures.records import LARGEST_BLOCK, Damaged, Form, Passed, Times, records
from lidarspec.captures.source import Source, Truncated
from lidarspec.frames.layout import rows_at
from lidarspec.framing.results import Frames, Indices
from lidarspec.transports.protocol import Origin, Sender

#: bytes of a record, from its start, that are compared at most; longer headers are read plainly.
WIDEST = 128

#: bytes that a buffer grows to, where the file has so many.
LARGEST = 2 * LARGEST_BLOCK
_TRAILER = 4
# bytes of a record of either format, as far as they tell the length and whether that is sure
_HEAD = 16
#: records of one length in a row for which looking at all of them at once is worth while.
_RUN = 16
#: kinds of datagrams that are known at a time, and that become known in one batch: nobody's capture
#: makes this slow.
MOST_KNOWN = 16


@dataclass(frozen=True, eq=False)
class Alike:
    """What records like one that is known have in common.

    Attributes:
        length: bytes from its start to that of the next one.
        start, size: of the payload in the record.
        source: address and port.
        times: how its time is read.
        value, mask: its first bytes, in words, and which of their bits count.
        trailer: type of the word at its end that repeats the length, with its byte order; None
            where there is none.
    """

    length: int
    start: int
    size: int
    source: Sender
    times: Times
    value: NDArray[np.uint64]
    mask: NDArray[np.uint64]
    trailer: str | None

    def find(
        self, storage: NDArray[np.uint8], starts: Indices, lengths: Indices
    ) -> tuple[NDArray[np.bool_] | None, NDArray[np.int64]]:
        """Which of these records are like it, (n,), or None where all are, and their times, (n,)
        ns; 128 bytes behind each can be read.
        """
        same = lengths == self.length
        if not same.all():
            found = np.zeros(len(starts), np.bool_)
            if same.any():
                some, at = self.find(storage, starts[same], lengths[same])
            else:
                some = None
                at = np.empty(0, np.int64)
            found[same] = True if some is None else some
            return found, at
        heads = _windows(storage, starts, self.value.nbytes)
        differs = heads.view(np.uint64) ^ self.value
        differs &= self.mask
        at, good = self.times.ns(heads)
        if self.trailer is not None:
            ends = (
                _windows(storage, starts + (self.length - _TRAILER), _TRAILER)
                .view(self.trailer)
                .ravel()
            )
            whole: NDArray[np.bool_] = np.asarray(ends == self.length, np.bool_)
            if good is None:
                good = whole
            else:
                good = np.asarray(good & whole, np.bool_)
        if differs.any():
            alike: NDArray[np.bool_] = np.asarray(~differs.any(axis=1), np.bool_)
            if good is None:
                good = alike
            else:
                good = np.asarray(alike & good, np.bool_)
        if good is None or good.all():
            return (None, at)
        return (good, at[good])


def alike(record: bytes, headers: Headers, source: Sender, form: Form) -> Alike | None:
    """What records like this one have in common; None where that cannot be told from their first
    bytes.

    Args:
        record: all its bytes.
        headers, source: what was found in it.
        form: the file it stands in.
    """
    pattern = form.pattern(record)
    if pattern is None:
        return None
    head = pattern.head
    start = pattern.head + headers.size
    if start > WIDEST or not pattern.times.fits():
        return None
    size = start + -start % 8
    mask = np.zeros(size, np.uint8)
    mask[:start] = 0xFF
    told = pattern.uncut if headers.size else ()  # headers say how long the payload is
    mask[[*pattern.free, *told, *(head + offset for offset in headers.variable_offsets)]] = 0
    value = np.frombuffer(record[:start].ljust(size, b"\0"), np.uint64)
    return Alike(
        len(record),
        start,
        headers.payload_size,
        source,
        pattern.times,
        value,
        mask.view(np.uint64),
        pattern.trailer,
    )


def walked(storage: NDArray[np.uint8], start: int, stop: int, form: Form) -> tuple[Indices, bool]:
    """Where whole records begin from `start` to `stop`, and where the last one ends; and whether
    what follows has to be read plainly.
    """
    pieces: list[Indices] = []
    single: list[int] = []
    at = start
    before = 0
    patience = 0
    length = -1
    view = storage.data
    if stop - at < _HEAD:
        return np.array([at], np.intp), False
    while stop - at >= _HEAD and (length := form.length(view, at)) and at + length <= stop:
        if length == before and not patience and stop - at >= _RUN * length:
            run = _same(storage, at, (stop - at) // length, length, form)
            pieces += [np.array(single, np.intp), np.arange(at, at + run * length, length)]
            single = []
            at = at + run * length
            patience = 2 * _RUN if run < _RUN else 0
            continue
        single.append(at)
        at = at + length
        before = length
        patience = max(patience - 1, 0)
    return np.concatenate([*pieces, np.array([*single, at], np.intp)]), length == 0


def _same(storage: NDArray[np.uint8], at: int, count: int, length: int, form: Form) -> int:
    """How many of `count` records that would begin every `length` bytes do have that length, until
    the first that has not.
    """
    place, kind, claim = form.claim(length)
    claims: NDArray[Any] = np.ndarray((count,), kind, storage, at + place, (length,))
    others = claims != claim
    if others.any():
        return int(others.argmax())
    return count


def _windows(storage: NDArray[np.uint8], starts: Indices, width: int) -> NDArray[np.uint8]:
    """The bytes from each start on, (n, width)."""
    everywhere: NDArray[np.void] = np.ndarray(
        (len(storage) - width + 1,), f"V{width}", storage, 0, (1,)
    )
    return everywhere[starts].view(np.uint8).reshape(len(starts), width)


@dataclass(frozen=True, eq=False)
class Batch:
    """n datagrams in the order of their arrival.

    Attributes:
        buffer: the bytes that they stand in. Whoever holds it or a view of it keeps it; otherwise
            it is used again.
        starts, sizes: (n,) of each payload in the buffer.
        at: (n,) int64 arrival times, ns since 1970; -1 where nobody knows.
        senders: (n,) indices into `names`.
        names: address and port of each sender.
        gap: whether datagrams before them were passed over.
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
        """The bytes of one datagram."""
        return self.buffer[self.starts[index] : self.starts[index] + self.sizes[index]].tobytes()

    @property
    def joined(self) -> bytes:
        """The bytes of all of them."""
        size = self.sizes.item(0) if len(self) else 0
        if (self.sizes == size).all():
            return rows_at(self.buffer, self.starts, size).tobytes()
        return b"".join(map(self.data, range(len(self))))

    def of(self, origin: Origin) -> Batch:
        """The datagrams of the batch that come from one address, or one port of it."""
        if all(name in origin for name in self.names):
            return self
        wanted = np.array([name in origin for name in self.names], np.bool_)[self.senders]
        return Batch(
            self.buffer,
            self.starts[wanted],
            self.sizes[wanted],
            self.at[wanted],
            self.senders[wanted],
            self.names,
        )

    def parts(self, size: int) -> Iterator[Batch]:
        """The datagrams in stretches of about so many bytes."""
        ends = np.cumsum(self.sizes)
        start = 0
        while start < len(self):
            stop = max(
                int(ends.searchsorted(ends[start] - self.sizes[start] + size, side="right")),
                start + 1,
            )
            own = slice(start, stop)
            yield Batch(
                self.buffer,
                self.starts[own],
                self.sizes[own],
                self.at[own],
                self.senders[own],
                self.names,
            )
            start = stop

    def sent(self, found: Frames) -> Iterator[tuple[str, Sender]]:
        """The types of frames found in these datagrams, and who sent them: of each type again where
        the sender changes.
        """
        if len(self.names) == 1:
            yield from (
                (found.names[kind], self.names[0])
                for kind in np.flatnonzero(np.bincount(found.kinds)).tolist()
            )
            return
        order = np.argsort(self.starts, kind="stable")
        senders = self.senders[order[np.searchsorted(self.starts[order], found.starts)]]
        for kind in np.unique(found.kinds).tolist():
            own = senders[found.kinds == kind]
            changes = np.flatnonzero(np.diff(own, prepend=-1))
            yield from ((found.names[kind], self.names[sender]) for sender in own[changes].tolist())


class CaptureBatches(CaptureReader):
    """The datagrams of a capture in batches of arrays, which say of each what `CaptureReader` says;
    read either way, not both.
    """

    largest = LARGEST

    def batches(self) -> Iterator[Batch]:
        """The datagrams of the file, as many at once as were read at once."""
        known: list[Alike] = []
        with self._count_end():
            form = self._form = self._form or records(self._source)
            while self._source.begin_record():
                starts, stuck = walked(
                    self._source.storage, self._source.at, self._source.stop, form
                )
                if len(starts) < 2 and not stuck and self._source.more():
                    continue
                if len(starts) <= 1:
                    starts = np.array([self._source.at])
                found = _Records(self, self._source, form, starts, known)
                ended = found.read()
                place = self._source.place
                if len(batch := found.batch()):
                    self.stats.datagrams += len(batch)
                    yield batch
                if self._source.place != place:
                    continue  # somebody has gone on to another time
                if isinstance(ended, Damaged):
                    self._skip_damage(form)
                elif ended is not None:
                    raise ended
                known = found.still_known()


class StreamBatches(StreamReader, CaptureBatches):
    """The packets of a capture of a byte stream, in batches."""


class _Records:
    """The records that are whole in the window; where there are none, the one that comes next."""

    def __init__(
        self, reader: CaptureReader, source: Source, form: Form, starts: Indices, known: list[Alike]
    ) -> None:
        self._reader = reader
        self._source = source
        self._form = form
        self._known = known
        number = max(len(starts) - 1, 1)
        self._are_whole = len(starts) > 1
        self._starts, self._lengths = (
            starts,
            starts[1:] - starts[:-1] if self._are_whole else np.zeros(1, np.intp),
        )
        self._kinds = np.full(number, -1, np.intp)  # indices into `_known`
        self._at = np.zeros(number, np.int64)
        self._plain: dict[int, Datagram] = {}
        self._learnt = self._counted = (
            0  # kinds; packets that were read plainly and are known all the same
        )
        self._only: Alike | None = None  # what all records are like
        self._section = form.sections
        self._storage = source.storage
        self._buffer = (
            source.lent()
        )  # of another the source may be, once it has looked further ahead

    def read(self) -> Exception | None:
        """What ended the reading of the file, if it ended here."""
        if not any(self._match(kind) for kind in range(len(self._known))):
            for index in np.flatnonzero(self._kinds < 0).tolist():
                if self._kinds[index] >= 0:
                    continue  # like one that became known meanwhile
                self._source.at = int(self._starts[index])
                try:
                    self._read_plainly(index)
                except (Damaged, Truncated) as ended:
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

    def still_known(self) -> list[Alike]:
        """What is worth comparing the next records with, most frequent first."""
        if self._form.sections != self._section:
            return []
        if len(self._known) == 1:
            return self._known
        counts = np.bincount(self._kinds[self._kinds >= 0], minlength=len(self._known))
        return [
            self._known[kind] for kind in np.argsort(-counts, kind="stable")[:MOST_KNOWN].tolist()
        ]

    def batch(self) -> Batch:
        """The datagrams of these records."""
        if self._only is not None and not self._plain:
            return self._uniform(self._only)
        known = np.flatnonzero(self._kinds >= 0)
        self._reader.stats.packets += len(known) - self._counted
        kinds = self._kinds[known]
        names: dict[Sender, int] = {}
        facts = np.array(
            [
                (one.start, one.size, names.setdefault(one.source, len(names)))
                for one in self._known
            ],
            np.intp,
        ).reshape(-1, 3)
        if len(facts) != 1:
            starts, sizes, senders = facts[kinds].T
        else:
            starts, sizes, senders = (np.full(len(known), fact) for fact in facts.ravel())
        columns = [self._starts[known] + starts, sizes, self._at[known], senders]
        if len(known):
            buffer = self._buffer
        else:
            buffer = np.empty(0, np.uint8)
        if self._plain:
            buffer = self._with_plain(buffer, columns, known, names)
        return Batch(buffer, columns[0], columns[1], columns[2], columns[3], tuple(names))

    def _uniform(self, kind: Alike) -> Batch:
        """What was read at once, as a batch, where all records are of one kind; columns are of
        shape (n,).
        """
        number = len(self._at)
        self._reader.stats.packets += number - self._counted
        sizes, senders = (np.broadcast_to(np.intp(fact), number) for fact in (kind.size, 0))
        return Batch(
            self._buffer,
            self._starts[:number] + kind.start,
            sizes,
            self._at,
            senders,
            (kind.source,),
        )

    def _with_plain(
        self,
        buffer: NDArray[np.uint8],
        columns: list[NDArray[Any]],
        known: Indices,
        names: dict[Sender, int],
    ) -> NDArray[np.uint8]:
        """The buffer with the bytes of datagrams that are not in it as they are, which take their
        places in the columns.
        """
        data = b"".join(datagram.data for datagram in self._plain.values())
        at = len(buffer)
        rows = []
        for datagram in self._plain.values():
            rows.append(
                (at, len(datagram.data), datagram.at, names.setdefault(datagram.source, len(names)))
            )
            at += len(datagram.data)
        order = np.argsort(
            np.concatenate([known, np.array(list(self._plain), np.intp)]), kind="stable"
        )
        columns[:] = [
            np.concatenate(parts)[order]
            for parts in zip(columns, np.array(rows, np.int64).T, strict=True)
        ]
        return np.concatenate([buffer, np.frombuffer(data, np.uint8)])

    def _read_plainly(self, index: int) -> None:
        self._source.begin_record()
        packet = self._form.read()
        datagram = self._reader.to_datagram(packet)
        if datagram is None or isinstance(packet, Passed):
            return
        self._plain[index] = datagram
        if self._learnt == MOST_KNOWN or not self._are_whole:
            return
        places = self._reader.headers(packet)
        record = self._storage[self._starts[index] : self._starts[index + 1]].tobytes()
        if places:
            found = alike(record, places, datagram.source, self._form)
        else:
            found = None
        if found is not None:
            self._learnt += 1
            self._known = [*self._known, found]
            self._match(len(self._known) - 1, since=index)
            if self._kinds[index] >= 0:
                del self._plain[index]
                self._counted += 1

    def _match(self, kind: int, since: int = 0) -> bool:
        """Whether all records are now known; those before `since` were read: what was malformed
        there may be right by now.
        """
        alike = self._known[kind]
        number = len(self._kinds)
        if kind == since == 0 and self._are_whole:
            found, at = alike.find(self._storage, self._starts[:number], self._lengths)
            if found is None:
                self._only = alike
                self._at = at
                self._kinds = np.broadcast_to(np.intp(0), number)
                return True
            left = np.flatnonzero(found)
        else:
            left = since + np.flatnonzero(self._kinds[since:] < 0)
            found, at = alike.find(self._storage, self._starts[left], self._lengths[left])
            left = left if found is None else left[found]
        self._kinds[left] = kind
        self._at[left] = at
        return found is None and not since
