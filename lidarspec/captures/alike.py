"""Records of a capture that look like one whose datagram is known, found many at a time.

Consecutive datagrams of a device differ in their payloads, their times and little else. So one record is read plainly
(`records`, `ip`); what was found there holds for every record of the same length whose headers have the same
bytes, except for those that `ip.headers` names and the times. `Alike` is such a record; `walked` finds where records
begin. Whatever is not alike has to be read plainly too, so both ways give the same datagrams.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.captures.ip import Headers
from lidarspec.captures.records import ENHANCED_PACKET, LARGEST_BLOCK, LARGEST_PACKET, CapturedPacket, PcapngBlocks, PcapRecords

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
