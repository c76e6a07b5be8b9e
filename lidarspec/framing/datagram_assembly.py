"""Join messages that arrive in several datagrams, before they are framed.

Fragments of a message may arrive in any order. A message is returned when all its fragments have
arrived. An incomplete message is dropped if there are too many newer incomplete messages, if more
than `MAX_WAIT_NS` have passed since its first fragment, or if no data arrives. Datagrams that are
not fragments are returned unchanged.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lidarspec.frames.compilability import NotCompilableError
from lidarspec.frames.layout import Layout
from lidarspec.frames.layout_tree import frame_layouts
from lidarspec.framing.results import Counters, Indices, Numbers
from lidarspec.spec.description import Frame
from lidarspec.spec.links import Assembled

#: The maximum number of incomplete messages, and of stored keys of completed and dropped messages.
MAX_WAITING_MESSAGES = 8
#: The time after which an incomplete message is dropped, ns.
MAX_WAIT_NS = 10**9

#: The maximum payload of a datagram in bytes.
MAX_DATAGRAM_BYTES = 65_535


@dataclass(frozen=True)
class _Fragment:
    key: Hashable
    index: int
    count: int
    payload: bytes


@dataclass
class _PartialMessage:
    """An incomplete message.

    Attributes:
        count: the declared number of fragments, or the declared size of the message in bytes.
        place: the offset in the input of the first received fragment.
        at: the arrival time of the first received fragment, ns.
        parts: the payloads of the fragments by index.
    """

    count: int
    place: int
    at: int
    parts: dict[int, bytes] = field(default_factory=dict)
    size: int = 0

    def add(self, fragment: _Fragment) -> None:
        self.parts[fragment.index] = fragment.payload
        self.size += len(fragment.payload)


@dataclass(frozen=True, eq=False)
class JoinedMessages:
    """Messages, in the order in which they were completed.

    Attributes:
        buffer: the bytes that contain the messages.
        starts: the offset of each message in the buffer.
        sizes: the size of each message in bytes.
        at: the arrival time of each message, ns.
        places: the offset of each message in the input.
        dropped: the number of bytes that were dropped before each message, and after the last one.
        header_bytes: the total number of bytes outside the payloads, such as headers, in all
            fragments that arrived.
    """

    buffer: NDArray[np.uint8]
    starts: Indices
    sizes: Indices
    at: NDArray[np.int64]
    places: NDArray[np.int64]
    dropped: NDArray[np.int64]
    header_bytes: int


class FragmentAssembler:
    """Joins the fragments of one link to messages.

    Args:
        longest: the maximum size of a message in bytes.
        stats: the counters, which include lost and late fragments.

    Raises:
        SpecError: if the struct of a fragment cannot be compiled.
    """

    def __init__(self, rule: Assembled, longest: int, stats: Counters) -> None:
        self._rule = rule
        self._longest = longest
        self._stats = stats
        layouts = frame_layouts(Frame(rule.struct, max_length=MAX_DATAGRAM_BYTES))
        if isinstance(layouts, NotCompilableError):
            raise rule.make_error(str(layouts))
        self._layouts = layouts
        self._waiting: dict[Hashable, _PartialMessage] = {}
        self._done: deque[Hashable] = deque(maxlen=MAX_WAITING_MESSAGES)
        self._dropped = 0

    @property
    def pending(self) -> int:
        """The number of bytes in incomplete messages."""
        return sum(message.size for message in self._waiting.values())

    def join(
        self,
        buffer: NDArray[np.uint8],
        starts: Numbers,
        sizes: Indices,
        at: NDArray[np.int64],
        base: int,
    ) -> JoinedMessages:
        """Add datagrams; return completed messages, and datagrams that are not fragments.

        Args:
            starts: the offset of each datagram in the buffer.
            sizes: the size of each datagram in bytes.
            at: the arrival times, ns.
            base: the offset of the first datagram in the input.
        """
        data = list[bytes]()
        places = list[int]()
        times = list[int]()
        dropped = list[int]()
        header_bytes = 0
        for start, size, time in zip(
            np.asarray(starts).tolist(), sizes.tolist(), at.tolist(), strict=True
        ):
            datagram = buffer[start : start + size].tobytes()
            fragment = self._parse_fragment(datagram)
            whole: tuple[bytes, int] | None = (datagram, base)
            if fragment is not None:
                header_bytes += size - len(fragment.payload)
                whole = self._store(fragment, base, time)
            if whole is not None:
                data.append(whole[0])
                places.append(whole[1])
                times.append(time)
                dropped.append(self._dropped)
                self._dropped = 0
            base += size
        lengths = np.array(list(map(len, data)), np.intp)
        left = self._dropped
        self._dropped = 0
        return JoinedMessages(
            np.frombuffer(b"".join(data), np.uint8),
            np.cumsum(lengths) - lengths,
            lengths,
            np.array(times, np.int64),
            np.array(places, np.int64),
            np.array([*dropped, left], np.int64),
            header_bytes,
        )

    def give_up(self) -> int:
        """Drop all incomplete messages, and return the number of dropped bytes."""
        for key in list(self._waiting):
            self._drop(key)
        dropped = self._dropped
        self._dropped = 0
        return dropped

    def _parse_fragment(self, datagram: bytes) -> _Fragment | None:
        """Return the fragment in a datagram; None if the datagram is not a fragment."""
        rule = self._rule
        layout = self._layouts.layout(datagram)
        if not isinstance(layout, Layout) or not layout.is_valid(datagram[: layout.size]):
            return None
        if rule.payload:
            leaf = layout.leaves[rule.payload]
            payload = datagram[leaf.offset : leaf.offset + leaf.size]
        else:
            payload = datagram[layout.size :]
        key = tuple(layout.leaves[path].read_scalar(datagram) for path in rule.keys)
        index = layout.leaves[rule.index].read_scalar(datagram) - rule.first
        count = layout.leaves[rule.count].read_scalar(datagram)
        is_whole = len(datagram) == layout.size or not rule.payload
        if is_whole and 0 <= index < count:
            return _Fragment(key, index, count, payload)
        return None

    def _store(self, fragment: _Fragment, place: int, time: int) -> tuple[bytes, int] | None:
        """Store a fragment; return the message that it completes and its offset."""
        for key in [
            key for key, message in self._waiting.items() if 0 <= message.at < time - MAX_WAIT_NS
        ]:
            self._drop(key)
        partial = self._waiting.get(fragment.key)
        if partial is not None and (
            partial.count != fragment.count
            or partial.parts.get(fragment.index, fragment.payload) != fragment.payload
        ):
            self._drop(fragment.key)  # a message of the same key has begun
            partial = None
        elif fragment.index in partial.parts if partial is not None else fragment.key in self._done:
            self._stats.fragments_late += 1
            self._dropped += len(fragment.payload)
            return None
        if partial is None:
            while len(self._waiting) >= MAX_WAITING_MESSAGES:
                self._drop(next(iter(self._waiting)))
            partial = self._waiting[fragment.key] = _PartialMessage(fragment.count, place, time)
        partial.add(fragment)
        if partial.size > self._longest:
            self._drop(fragment.key)
            return None
        if (partial.size if self._rule.in_bytes else len(partial.parts)) < partial.count:
            return None
        del self._waiting[fragment.key]
        self._done.append(fragment.key)
        return b"".join(part for _, part in sorted(partial.parts.items())), partial.place

    def _drop(self, key: Hashable) -> None:
        message = self._waiting.pop(key)
        self._stats.fragments_lost += (
            1 if self._rule.in_bytes else message.count - len(message.parts)
        )
        self._dropped += message.size
        self._done.append(key)
