"""Messages that come in several datagrams, joined before they are framed.

A fragment says of which message it is, which part of it, and how many there are
(`lidarspec.spec.links.Assembled`). Fragments may come in any order and twice. A message is handed
on with its last fragment, and never with one of another: what lacks a fragment is given up as soon
as a few newer messages have begun, a second has passed or the line falls silent, and what comes of
it later is dropped; both are counted. Datagrams that are no fragments pass as they are.
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

#: messages that are waited for at a time, of which so many are remembered when they are done, and
#: for how many nanoseconds.
WAITING = 8
PATIENCE = 10**9

#: the longest payload of a datagram.
DATAGRAM = 65_535


@dataclass(frozen=True)
class _Fragment:
    key: Hashable
    index: int
    count: int
    payload: bytes


@dataclass
class _PartialMessage:
    """An incomplete message.

    It has fragments by their index, the offset of the first one in the input, and its time of
    arrival.
    """

    count: int
    place: int
    at: int
    parts: dict[int, bytes] = field(default_factory=dict)

    @property
    def size(self) -> int:
        return sum(map(len, self.parts.values()))


@dataclass(frozen=True, eq=False)
class JoinedMessages:
    """Messages, in the order of their last fragments.

    Attributes:
        buffer, starts, sizes, at: as the decoder takes datagrams.
        places: where each begins in the input.
        dropped: bytes of messages that were given up before each, and in the end.
        heads: bytes of fragments that are no payload.
    """

    buffer: NDArray[np.uint8]
    starts: Indices
    sizes: Indices
    at: NDArray[np.int64]
    places: NDArray[np.int64]
    dropped: NDArray[np.int64]
    heads: int


class FragmentAssembler:
    """Joins the fragments of one link.

    Args:
        rule: what a fragment says.
        longest: the most bytes that a message can have.
        stats: where lost and late fragments are counted.

    Raises:
        SpecError: where construct alone can read a fragment.
    """

    def __init__(self, rule: Assembled, longest: int, stats: Counters) -> None:
        self._rule = rule
        self._longest = longest
        self._stats = stats
        layouts = frame_layouts(Frame(rule.struct, max_length=DATAGRAM))
        if isinstance(layouts, NotCompilableError):
            raise rule.wrong(str(layouts))
        self._layouts = layouts
        self._waiting: dict[Hashable, _PartialMessage] = {}
        self._done: deque[Hashable] = deque(maxlen=WAITING)
        self._dropped = 0

    @property
    def pending(self) -> int:
        """The bytes of fragments that wait for others."""
        return sum(message.size for message in self._waiting.values())

    def join(
        self,
        buffer: NDArray[np.uint8],
        starts: Numbers,
        sizes: Indices,
        at: NDArray[np.int64],
        base: int,
    ) -> JoinedMessages:
        """Return the messages that datagrams complete, among other datagrams.

        Args:
            base: the offset of the first datagram in the input.
        """
        data = list[bytes]()
        places = list[int]()
        times = list[int]()
        dropped = list[int]()
        heads = 0
        for start, size, time in zip(
            np.asarray(starts).tolist(), sizes.tolist(), at.tolist(), strict=True
        ):
            datagram = buffer[start : start + size].tobytes()
            fragment = self._fragment(datagram)
            whole: tuple[bytes, int] | None = (datagram, base)
            if fragment is not None:
                heads += size - len(fragment.payload)
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
            heads,
        )

    def give_up(self) -> int:
        """Wait for nothing any more; the bytes that were waiting."""
        for key in list(self._waiting):
            self._lose(key)
        dropped = self._dropped
        self._dropped = 0
        return dropped

    def _fragment(self, datagram: bytes) -> _Fragment | None:
        """Return the fragment in a datagram; None if it is not one."""
        rule = self._rule
        layout = self._layouts.layout(datagram)
        if not isinstance(layout, Layout) or not layout.sound(datagram[: layout.size]):
            return None
        if rule.payload:
            leaf = layout.leaves[rule.payload]
            payload = datagram[leaf.offset : leaf.offset + leaf.size]
        else:
            payload = datagram[layout.size :]
        key = tuple(layout.leaves[path].scalar(datagram) for path in rule.keys)
        index = layout.leaves[rule.index].scalar(datagram) - rule.first
        count = layout.leaves[rule.count].scalar(datagram)
        is_whole = len(datagram) == layout.size or not rule.payload
        if is_whole and 0 <= index < count:
            return _Fragment(key, index, count, payload)
        return None

    def _store(self, fragment: _Fragment, place: int, time: int) -> tuple[bytes, int] | None:
        """Store a fragment and return the message that it completes, with its offset.

        Returns None if other fragments are missing.
        """
        for key in [
            key for key, message in self._waiting.items() if 0 <= message.at < time - PATIENCE
        ]:
            self._lose(key)
        partial = self._waiting.get(fragment.key)
        if partial is not None and (
            partial.count != fragment.count
            or partial.parts.get(fragment.index, fragment.payload) != fragment.payload
        ):
            self._lose(fragment.key)  # a message of the same key has begun
            partial = None
        elif fragment.index in partial.parts if partial is not None else fragment.key in self._done:
            self._stats.fragments_late += 1
            self._dropped += len(fragment.payload)
            return None
        if partial is None:
            while len(self._waiting) >= WAITING:
                self._lose(next(iter(self._waiting)))
            partial = self._waiting[fragment.key] = _PartialMessage(fragment.count, place, time)
        partial.parts[fragment.index] = fragment.payload
        if partial.size > self._longest:
            self._lose(fragment.key)
            return None
        if (partial.size if self._rule.in_bytes else len(partial.parts)) < partial.count:
            return None
        del self._waiting[fragment.key]
        self._done.append(fragment.key)
        return b"".join(part for _, part in sorted(partial.parts.items())), partial.place

    def _lose(self, key: Hashable) -> None:
        message = self._waiting.pop(key)
        self._stats.fragments_lost += (
            1 if self._rule.in_bytes else message.count - len(message.parts)
        )
        self._dropped += message.size
        self._done.append(key)
