"""Records of a capture that look like one whose datagram is known, found many at a time.

Consecutive datagrams of a device differ in their payloads, their times and little else. So one record is read plainly
(`records`, `ip`); what was found there holds for every record of the same length whose headers have the same
bytes, except for those that `ip.headers` names and the times. `Alike` is such a record; `walked` finds where records
begin. Whatever is not alike has to be read plainly too, so both ways give the same datagrams.

A capture read into buffers that are lent out and used again.

`Window` is a `Source` that holds as much of the file as fits into one buffer. `lent` gives that buffer away as an array;
it is not written to again while that array, or anything made from it without a copy, is alive. So whoever needs the
bytes for longer just keeps them: another buffer is used then, and the kept one is theirs.

Datagrams by the hundred, as arrays: where they stand in one buffer, when they came and from whom.

`CaptureBatches` reads captures so: of each kind of datagram the first is read plainly, and all that look the same are then
found at once (`alike`). What does not is read plainly, one by one, so that the datagrams, their order and what is
counted are those of `CaptureReader`.
"""

from __future__ import annotations

import os
import stat
import struct
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lidarspec.captures.ip import Headers, headers
from lidarspec.captures.pcap import CaptureReader, Datagram
from lidarspec.captures.records import (
    ENHANCED_PACKET,
    LARGEST_BLOCK,
    LARGEST_PACKET,
    CapturedPacket,
    Damaged,
    Passed,
    PcapngBlocks,
    PcapRecords,
    Source,
    Truncated,
    records,
)
from lidarspec.errors import SourceError
from lidarspec.framing.decoder import Decoder
from lidarspec.framing.results import Frames

#: bytes of a record, from its start, that are compared at most; longer headers are read plainly.
WIDEST = 128

_SECOND = 1_000_000_000
_FURTHEST = 4_000_000_000  # seconds; times further on are read plainly, so that none overflows
_PCAP_HEAD, _BLOCK_HEAD, _BLOCK_TAIL = 16, 28, 4
_SECTION = 0x0A0D0D0A
_HEAD = 12  # of either kind, as far as it tells the length
#: records of one length in a row for which looking at all of them at once is worth while.
_RUN = 16


@dataclass(frozen=True)
class Times:
    """How a record's time is read from its two words.

    Attributes:
        word: their type, with its byte order.
        high, low: which words of the record they are.
        ticks: of `low` in a second where `high` counts seconds, else of both together.
        is_split: whether `high` counts seconds.
        offset: ns.
    """

    word: str
    high: int
    low: int
    ticks: int
    is_split: bool
    offset: int = 0

    def fits(self) -> bool:
        """Whether all times up to `_FURTHEST` can be had without overflow."""
        return self.ticks <= 9 * _SECOND and abs(self.offset) < 1 << 62

    def ns(self, heads: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.bool_] | None]:
        """Times of records in ns since 1970, and which of them are right; None where all are."""
        words = heads.view(self.word)
        high, low = words[:, self.high].astype(np.int64), words[:, self.low]
        if self.is_split:
            high *= _SECOND
            high += low * np.int64(_SECOND // self.ticks)
            return high, None
        seconds, fraction = np.divmod(high << 32 | low, self.ticks)
        right = (high < 1 << 31) & (seconds < _FURTHEST)
        return seconds * _SECOND + fraction * _SECOND // self.ticks + self.offset, right


@dataclass(frozen=True, eq=False)
class Alike:
    """What records like one that is known have in common.

    Attributes:
        length: bytes from its start to that of the next one.
        start, size: of the payload in the record.
        source: address and port.
        times: how its time is read.
        value, mask: its first bytes, in words, and which of their bits count.
        trailer: type of the word at its end that repeats the length, with its byte order; None where there is none.
    """

    length: int
    start: int
    size: int
    source: tuple[str, int]
    times: Times
    value: NDArray[np.uint64]
    mask: NDArray[np.uint64]
    trailer: str | None

    def find(
        self, storage: NDArray[np.uint8], starts: NDArray[np.intp], lengths: NDArray[np.intp]
    ) -> tuple[NDArray[np.bool_] | None, NDArray[np.int64]]:
        """Which of these records are like it, None where all are, and their times; 128 bytes behind each start can be read."""
        same = lengths == self.length
        if not same.all():
            found = np.zeros(len(starts), np.bool_)
            some, at = self.find(storage, starts[same], lengths[same]) if same.any() else (None, np.empty(0, np.int64))
            found[same] = True if some is None else some
            return found, at
        heads = _windows(storage, starts, self.value.nbytes)
        differs = heads.view(np.uint64) ^ self.value
        differs &= self.mask
        at, good = self.times.ns(heads)
        if self.trailer is not None:
            ends = _windows(storage, starts + (self.length - _BLOCK_TAIL), _BLOCK_TAIL).view(self.trailer).ravel()
            whole: NDArray[np.bool_] = np.asarray(ends == self.length, np.bool_)
            good = whole if good is None else np.asarray(good & whole, np.bool_)
        if differs.any():
            alike: NDArray[np.bool_] = np.asarray(~differs.any(axis=1), np.bool_)
            good = alike if good is None else np.asarray(alike & good, np.bool_)
        return (None, at) if good is None or good.all() else (good, at[good])


def alike(
    record: bytes, packet: CapturedPacket, headers: Headers, source: tuple[str, int], form: PcapRecords | PcapngBlocks
) -> Alike | None:
    """What records like this one have in common; None where that cannot be told from their first bytes.

    Args:
        record: all its bytes.
        packet, headers, source: what was found in it.
        form: the file it stands in.
    """
    word = f"{form.order}u4"
    if isinstance(form, PcapRecords):
        head, free, trailer = _PCAP_HEAD, [*range(8), *range(12, 16)], None
        times = Times(word, 0, 1, _SECOND // form.unit, True)
    else:
        if struct.unpack_from(form.order + "I", record)[0] != ENHANCED_PACKET:
            return None
        head, free, trailer = _BLOCK_HEAD, [*range(12, 20), *range(24, 28)], word
        interface = form.interfaces[struct.unpack_from(form.order + "I", record, 8)[0]]
        times = Times(word, 3, 4, interface.ticks, False, interface.offset)
    start = head + headers.size
    if start > WIDEST or not times.fits():
        return None
    size = start + -start % 8
    mask = np.zeros(size, np.uint8)
    mask[:start] = 0xFF
    mask[[*free, *(head + place for place in headers.free)]] = 0
    value = np.frombuffer(record[:start].ljust(size, b"\0"), np.uint64)
    return Alike(len(record), start, headers.payload, source, times, value, mask.view(np.uint64), trailer)


class Walk(NamedTuple):
    """Where the records that are whole begin, and where the last one ends; `stuck`: what follows has to be read plainly."""

    starts: NDArray[np.intp]
    stuck: bool


def walked(storage: NDArray[np.uint8], start: int, stop: int, form: PcapRecords | PcapngBlocks) -> Walk:
    """The records of a window from `start` to `stop`."""
    pieces: list[NDArray[np.intp]] = []
    single: list[int] = []
    at, before, patience, length = start, 0, 0, -1
    step = _pcap_step if isinstance(form, PcapRecords) else _pcapng_step
    unpack = struct.Struct(form.order + "II").unpack_from
    view = storage.data
    if stop - at < _HEAD:
        return Walk(np.array([at], np.intp), False)
    while stop - at >= _HEAD and (length := step(unpack, view, at)) and at + length <= stop:
        if length == before and not patience and stop - at >= _RUN * length:
            run = _same(storage, at, (stop - at) // length, length, form)
            pieces += [np.array(single, np.intp), np.arange(at, at + run * length, length)]
            single, at, patience = [], at + run * length, 2 * _RUN if run < _RUN else 0
            continue
        single.append(at)
        at, before, patience = at + length, length, max(patience - 1, 0)
    return Walk(np.concatenate([*pieces, np.array([*single, at], np.intp)]), length == 0)


def _pcap_step(unpack: Callable[..., tuple[int, int]], view: memoryview, at: int) -> int:
    """The length of a record, 0 where it says something that cannot be."""
    captured, _ = unpack(view, at + 8)
    return _PCAP_HEAD + captured if captured <= LARGEST_PACKET else 0


def _pcapng_step(unpack: Callable[..., tuple[int, int]], view: memoryview, at: int) -> int:
    kind, length = unpack(view, at)
    return 0 if kind == _SECTION or length < 12 or length % 4 or length > LARGEST_BLOCK else length


def _same(storage: NDArray[np.uint8], at: int, count: int, length: int, form: PcapRecords | PcapngBlocks) -> int:
    """How many of `count` records that would begin every `length` bytes do have that length, until the first that has not."""
    place, claim = (8, length - _PCAP_HEAD) if isinstance(form, PcapRecords) else (4, length)
    claims: NDArray[np.uint32] = np.ndarray((count,), f"{form.order}u4", storage, at + place, (length,))
    others = claims != claim
    return int(others.argmax()) if others.any() else count


def _windows(storage: NDArray[np.uint8], starts: NDArray[np.intp], width: int) -> NDArray[np.uint8]:
    """The bytes from each start on, (n, width)."""
    everywhere: NDArray[np.void] = np.ndarray((len(storage) - width + 1,), f"V{width}", storage, 0, (1,))
    return everywhere[starts].view(np.uint8).reshape(len(starts), width)


#: bytes of a buffer: of the first as many as the file has; each that is filled makes the next one longer.
SMALLEST, LARGEST = 1 << 16, 8 * LARGEST_BLOCK

#: bytes behind what was read that may be looked at, whatever they are, so that records can be compared in words.
SLACK = 256

#: buffers kept for use again.
MOST_KEPT = 2


class Window(Source):
    """Bytes of a file or pipe, in buffers that can be lent out.

    Attributes:
        storage: the buffer in use, `SLACK` bytes longer than it is ever filled.
    """

    def __init__(self, file: BinaryIO) -> None:
        super().__init__(file)
        into: Callable[[Any], int | None] | None = getattr(file, "readinto1", getattr(file, "readinto", None))
        self._into = into
        self._kept: list[tuple[NDArray[np.uint8], weakref.ref[Any]]] = []
        self._lent: weakref.ref[Any] | None = None
        self._adopt(np.empty(_first_size(file) + SLACK, np.uint8), 0)

    @property
    def at(self) -> int:
        """Where in `storage` the next byte stands."""
        return self._at

    @property
    def stop(self) -> int:
        """How much of `storage` is filled."""
        return len(self._data)

    def go(self, at: int) -> None:
        """Makes the byte at this place of `storage` the next one."""
        self._at = at

    def more(self) -> bool:
        """Whether bytes came after those that are there; they may all move."""
        return self._has(len(self._data) - self._at + 1)

    def lent(self) -> NDArray[np.uint8]:
        """What is in the buffer, read-only: not written to again while this array or a view of it is alive."""
        array = np.frombuffer(self._view[: len(self._data)], np.uint8)
        array.flags.writeable = False
        self._lent = weakref.ref(array)
        return array

    def _has(self, size: int) -> bool:
        have = len(self._data) - self._at
        if have >= size:
            return True
        self._turn(have)
        while have < size:
            if have == len(self.storage) - SLACK:
                self._turn(have)
            count = self._read_at(have)
            if not count:
                break
            have += count
            self._data = self._view[:have]
        return have >= size

    def _read_at(self, start: int) -> int:
        """How many bytes came; they stand in the buffer from `start` on."""
        free = self._view[start : len(self.storage) - SLACK]
        try:
            if self._into is not None:
                return self._into(free) or 0
            piece = self._read(len(free))
        except OSError as error:
            raise SourceError(f"cannot read the capture: {error}") from error
        free[: len(piece)] = piece
        return len(piece)

    def _turn(self, have: int) -> None:
        """Puts what is not read yet to the front of a buffer that nobody holds."""
        size = len(self.storage) - SLACK
        tail, at = self.storage[self._at : self._at + have], self._at
        if len(self._data) == size:
            size = min(2 * size, LARGEST)
        if self._lent is not None:
            self._kept = [*self._kept[1 - MOST_KEPT :], (self.storage, self._lent)]
        spare = self._spare(size)
        spare[:have] = tail
        self._passed += at
        self._adopt(spare, have)

    def _spare(self, size: int) -> NDArray[np.uint8]:
        if self._lent is None and len(self.storage) - SLACK == size:
            return self.storage
        self._lent = None
        for index, (storage, lent) in enumerate(self._kept):
            if lent() is None and len(storage) - SLACK == size:
                del self._kept[index]
                return storage
        return np.empty(size + SLACK, np.uint8)

    def _adopt(self, storage: NDArray[np.uint8], have: int) -> None:
        self.storage = storage
        self._view = storage.data
        self._data, self._at = self._view[:have], 0


def _first_size(file: BinaryIO) -> int:
    try:
        status = os.fstat(file.fileno())
    except (AttributeError, OSError):
        return SMALLEST
    return min(max(status.st_size, SMALLEST), LARGEST) if stat.S_ISREG(status.st_mode) else SMALLEST


#: kinds of datagrams that are known at a time, and that become known in one batch: nobody's capture makes this slow.
MOST_KNOWN = 16

Sender = tuple[str, int]


@dataclass(frozen=True, eq=False)
class Batch:
    """n datagrams in the order of their arrival.

    Attributes:
        buffer: the bytes that they stand in. Whoever holds it or a view of it keeps it; otherwise it is used again.
        starts, sizes: (n,) of each payload in the buffer.
        at: (n,) int64 arrival times, ns since 1970; -1 where nobody knows.
        senders: (n,) indices into `names`.
        names: address and port of each sender.
    """

    buffer: NDArray[np.uint8]
    starts: NDArray[np.intp]
    sizes: NDArray[np.intp]
    at: NDArray[np.int64]
    senders: NDArray[np.intp]
    names: tuple[Sender, ...]

    def __len__(self) -> int:
        return len(self.starts)

    def data(self, index: int) -> bytes:
        """The bytes of one datagram."""
        return self.buffer[self.starts[index] : self.starts[index] + self.sizes[index]].tobytes()

    def of(self, host: str) -> Batch:
        """Those that come from this address."""
        if all(name[0] == host for name in self.names):
            return self
        wanted = np.array([name[0] == host for name in self.names], np.bool_)[self.senders]
        return Batch(self.buffer, self.starts[wanted], self.sizes[wanted], self.at[wanted], self.senders[wanted], self.names)

    def by_sender(self) -> dict[Sender, NDArray[np.intp]]:
        """Which datagrams came from each sender, as indices."""
        if len(self.names) == 1:
            return {self.names[0]: np.arange(len(self))}
        parts = {name: np.flatnonzero(self.senders == index) for index, name in enumerate(self.names)}
        return {name: part for name, part in parts.items() if len(part)}

    def hosts(self, found: Frames) -> dict[str, list[str]]:
        """The addresses that frames found in these datagrams came from, by type of frame."""
        hosts: dict[str, list[str]] = {}
        if len(self.names) == 1:
            for kind in np.flatnonzero(np.bincount(found.kinds)).tolist():
                hosts[found.names[kind]] = [self.names[0][0]]
            return hosts
        order = np.argsort(self.starts, kind="stable")
        senders = self.senders[order[np.searchsorted(self.starts[order], found.starts)]]
        for kind, sender in dict.fromkeys(zip(found.kinds.tolist(), senders.tolist(), strict=True)):
            known = hosts.setdefault(found.names[kind], [])
            known += [self.names[sender][0]] if self.names[sender][0] not in known else []
        return hosts


@runtime_checkable
class BulkTransport(Protocol):
    """A transport of datagrams that gives many at a time; see `files.Transport`."""

    def batches(self) -> Iterator[Batch]:
        """The same datagrams as those of `chunks`.

        Raises:
            SourceError: where they cannot be read.
        """


def first_frames(decoder: Decoder, batches: Iterable[Batch], wanted: Collection[str]) -> dict[str, bytes]:
    """The first frame of each type that is wanted, as far as there are some."""
    first: dict[str, bytes] = {}
    for batch in batches:
        found = decoder.placed(batch.buffer, batch.starts, batch.sizes, batch.at)
        for kind, name in enumerate(found.names):
            if name in wanted and name not in first and len(where := np.flatnonzero(found.kinds == kind)):
                first[name] = found.data(int(where[0]))
        if len(first) == len(wanted):
            break
    return first


class CaptureBatches(CaptureReader):
    """The same datagrams as `CaptureReader`'s, in batches; to be read either way, not both."""

    _reading = Window
    _source: Window

    def batches(self) -> Iterator[Batch]:
        """The datagrams of the file, as many at once as were read at once."""
        known: list[Alike] = []
        with self._to_the_end():
            form = records(self._source)
            while self._source.begin_record():
                walk = walked(self._source.storage, self._source.at, self._source.stop, form)
                if len(walk.starts) < 2 and not walk.stuck and self._source.more():
                    continue
                starts = walk.starts if len(walk.starts) > 1 else np.array([self._source.at])
                found = _Records(self, self._source, form, starts, known)
                ended = found.read()
                if len(batch := found.batch()):
                    self.stats.datagrams += len(batch)
                    yield batch
                if ended is not None:
                    raise ended
                known = found.still_known()


class _Records:
    """The records that are whole in the window; where there are none, the one that comes next."""

    def __init__(
        self, reader: CaptureReader, source: Window, form: PcapRecords | PcapngBlocks, starts: NDArray[np.intp], known: list[Alike]
    ) -> None:
        self._reader, self._source, self._form, self._known = reader, source, form, known
        number = max(len(starts) - 1, 1)
        self._are_whole = len(starts) > 1
        self._starts, self._lengths = starts, starts[1:] - starts[:-1] if self._are_whole else np.zeros(1, np.intp)
        self._kinds = np.full(number, -1, np.intp)  # indices into `_known`
        self._at = np.zeros(number, np.int64)
        self._plain: dict[int, Datagram] = {}
        self._learnt = self._counted = 0  # kinds; packets that were read plainly and are known all the same
        self._only: Alike | None = None  # what all records are like
        self._section = _sections(form)

    def read(self) -> Exception | None:
        """What ended the reading of the file, if it ended here."""
        if not any(self._match(kind) for kind in range(len(self._known))):
            for index in np.flatnonzero(self._kinds < 0).tolist():
                if self._kinds[index] >= 0:
                    continue  # like one that became known meanwhile
                self._source.go(int(self._starts[index]))
                try:
                    self._read_plainly(index)
                except (Damaged, Truncated) as ended:
                    self._kinds = self._kinds[:index]
                    return ended
                if _sections(self._form) != self._section:
                    self._kinds = self._kinds[: index + 1]
                    return None
                if self._only is not None:
                    break
        if self._are_whole:
            self._source.go(int(self._starts[-1]))
        return None

    def still_known(self) -> list[Alike]:
        """What is worth comparing the next records with, most frequent first."""
        if _sections(self._form) != self._section:
            return []
        if len(self._known) == 1:
            return self._known
        counts = np.bincount(self._kinds[self._kinds >= 0], minlength=len(self._known))
        return [self._known[kind] for kind in np.argsort(-counts, kind="stable")[:MOST_KNOWN].tolist()]

    def batch(self) -> Batch:
        """The datagrams of these records."""
        if self._only is not None and not self._plain:
            return self._uniform(self._only)
        known = np.flatnonzero(self._kinds >= 0)
        self._reader.stats.packets += len(known) - self._counted
        kinds = self._kinds[known]
        names: dict[Sender, int] = {}
        facts = np.array([(one.start, one.size, names.setdefault(one.source, len(names))) for one in self._known], np.intp).reshape(-1, 3)
        starts, sizes, senders = facts[kinds].T if len(facts) != 1 else (np.full(len(known), fact) for fact in facts.ravel())
        columns = [self._starts[known] + starts, sizes, self._at[known], senders]
        buffer = self._source.lent() if len(known) else np.empty(0, np.uint8)
        if self._plain:
            buffer = self._with_plain(buffer, columns, known, names)
        return Batch(buffer, columns[0], columns[1], columns[2], columns[3], tuple(names))

    def _uniform(self, kind: Alike) -> Batch:
        """The same where all records are of one kind."""
        number = len(self._at)
        self._reader.stats.packets += number - self._counted
        sizes, senders = (np.broadcast_to(np.intp(fact), number) for fact in (kind.size, 0))
        return Batch(self._source.lent(), self._starts[:number] + kind.start, sizes, self._at, senders, (kind.source,))

    def _with_plain(
        self, buffer: NDArray[np.uint8], columns: list[NDArray[Any]], known: NDArray[np.intp], names: dict[Sender, int]
    ) -> NDArray[np.uint8]:
        """The buffer with the bytes of datagrams that are not in it as they are, which take their places in the columns."""
        data = b"".join(datagram.data for datagram in self._plain.values())
        at = len(buffer)
        rows = []
        for datagram in self._plain.values():
            rows.append((at, len(datagram.data), datagram.at, names.setdefault(datagram.source, len(names))))
            at += len(datagram.data)
        order = np.argsort(np.concatenate([known, np.array(list(self._plain), np.intp)]), kind="stable")
        columns[:] = [np.concatenate(parts)[order] for parts in zip(columns, np.array(rows, np.int64).T, strict=True)]
        return np.concatenate([buffer, np.frombuffer(data, np.uint8)])

    def _read_plainly(self, index: int) -> None:
        self._source.begin_record()
        packet = self._form.read()
        datagram = self._reader.datagram(packet)
        if datagram is None or isinstance(packet, Passed):
            return
        self._plain[index] = datagram
        if self._learnt == MOST_KNOWN or not self._are_whole:
            return
        places = headers(packet.data, packet.link)
        record = self._source.storage[self._starts[index] : self._starts[index + 1]].tobytes()
        found = alike(record, packet, places, datagram.source, self._form) if places else None
        if found is not None:
            self._learnt += 1
            self._known = [*self._known, found]
            self._match(len(self._known) - 1)
            if self._kinds[index] >= 0:
                del self._plain[index]
                self._counted += 1

    def _match(self, kind: int) -> bool:
        """Whether all records are now known."""
        alike, number = self._known[kind], len(self._kinds)
        if kind == 0 and self._are_whole:
            found, at = alike.find(self._source.storage, self._starts[:number], self._lengths)
            if found is None:
                self._only, self._at = alike, at
                self._kinds = np.broadcast_to(np.intp(0), number)
                return True
            left = np.flatnonzero(found)
        else:
            left = np.flatnonzero(self._kinds < 0)
            found, at = alike.find(self._source.storage, self._starts[left], self._lengths[left])
            left = left if found is None else left[found]
        self._kinds[left] = kind
        self._at[left] = at
        return found is None


def _sections(form: PcapRecords | PcapngBlocks) -> int:
    return form.sections if isinstance(form, PcapngBlocks) else 0
