"""One layout per distinct header, found for a whole batch of candidates at once.

Counts, If and Switch make a frame's layout depend on some of its own header fields. The tree here asks for those
fields in the order in which the walk of the struct did: each node is one field, each branch one of its values, each
end a `Layout`, or the reason why there is none. Candidates are sorted through it in bulk, by value.
"""

from __future__ import annotations

import random
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import construct
import numpy as np
from construct import Construct
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.frames import choices
from lidarspec.frames.layout import Layout, Leaf
from lidarspec.frames.walk import NotCompilable, TooLong, Unread, Walk, walk
from lidarspec.rules import children

#: distinct headers remembered; garbage must not fill the memory with their layouts.
REMEMBERED = 4096

#: different values of a header field that are looked for one by one.
FEW = 4


@dataclass(frozen=True, eq=False)
class Refused:
    """A header that leads to no frame: too long, or an expression of the plugin failed (`error`: its traceback)."""

    error: str = ""


@dataclass(eq=False)
class _Node:
    leaf: Leaf | None = None
    children: dict[int, _Node] = field(default_factory=dict)
    result: Layout | Refused | None = None


class _Short(Unread):
    """The sample ends before a field that the layout depends on."""

    def __init__(self, leaf: Leaf) -> None:
        self.leaf = leaf


_NONE = np.empty(0, np.intp)
Group = tuple[Layout | Refused, NDArray[np.intp]]


def rows_at(buffer: NDArray[np.uint8], offsets: NDArray[np.intp], size: int, *, gathered: bool = True) -> NDArray[np.uint8]:
    """As many bytes from each of these offsets, one a row; no copy where they stand back to back.

    Args:
        gathered: C-contiguous; else no copy either where they stand at one distance, and each row is contiguous by itself.
    """
    count = len(offsets)
    if not count or not size:
        return np.zeros((count, size), np.uint8)
    if size == 1:
        return buffer.take(offsets).reshape(count, 1)
    first, step = offsets.item(0), offsets.item(1) - offsets.item(0) if count > 1 else size
    even = offsets.item(-1) - first == (count - 1) * step
    if even and count > 2:
        even = np.count_nonzero(offsets[1:] - offsets[:-1] == step) == count - 1
    if even and step == size:
        return buffer[first : first + count * size].reshape(count, size)
    if even and step > size and not gathered:
        return np.ndarray((count, size), np.uint8, buffer.data, first, (step, 1))
    windows: NDArray[Any] = np.ndarray((len(buffer) - size + 1,), f"V{size}", buffer.data, 0, (1,))
    return windows[offsets].view(np.uint8).reshape(count, size)


class HeaderTree:
    """All layouts of one frame type.

    Raises:
        NotCompilable: where some part of the struct has no computable place, whatever the header.
    """

    def __init__(self, con: Construct, limit: int) -> None:
        self._con, self._limit = con, limit
        self._root, self._size = _Node(), 0
        self.prefix = self._prefix()
        choices.try_headers(con, limit)

    def classify(self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp]) -> tuple[list[Group], NDArray[np.intp]]:
        """The candidates at `offsets`, sorted by layout.

        Returns:
            (layout or refusal, indices into `offsets`) for each kind; and the indices of those whose header is not
            all there.
        """
        if self._size > REMEMBERED:
            self._root, self._size = _Node(), 0
        if isinstance(self._root.result, Layout) and len(offsets):
            return [(self._root.result, np.arange(len(offsets)))], _NONE
        groups: list[Group] = []
        short: list[NDArray[np.intp]] = []
        stack = [(self._root, np.arange(len(offsets)))] if len(offsets) else []
        while stack:
            node, which = stack.pop()
            if node.result is None and node.leaf is None:
                self._explore(buffer[offsets[which[0]] : offsets[which[0]] + self._limit])
            if node.result is not None:
                groups.append((node.result, which))
            elif node.leaf is not None:
                self._branch(node, node.leaf, buffer, offsets, which, stack, short)
        return groups, np.concatenate(short) if short else _NONE

    def common(self, rows: NDArray[np.uint8]) -> Layout | None:
        """The layout of candidates, one a row, if they have one and the fields that decide it are the same in all; else None."""
        first = rows[0].tobytes()
        layout = self.layout(first)
        if not isinstance(layout, Layout):
            return None
        same = (np.count_nonzero(leaf.load(rows) == leaf.scalar(first)) == len(rows) for leaf in self.asked(first))
        return layout if all(same) else None

    def layout(self, frame: bytes) -> Layout | Refused | None:
        """The layout of one frame, or None where its header is not all there."""
        node: _Node | None = self._root
        while node is not None and node.leaf is not None and node.leaf.offset + node.leaf.size <= len(frame):
            node = node.children.get(node.leaf.scalar(frame))
        if node is not None and node.result is not None:
            return node.result
        groups, _ = self.classify(np.frombuffer(frame, np.uint8), np.zeros(1, np.intp))
        return groups[0][0] if groups else None

    def asked(self, frame: bytes) -> list[Leaf]:
        """The fields that decided the layout of this frame, in the order in which they were asked for."""
        found, node = [], self._root
        while node.leaf is not None:
            found.append(node.leaf)
            node = node.children[node.leaf.scalar(frame)]
        return found

    def choose(
        self, source: random.Random, drawn: Mapping[str, Callable[[random.Random], int]] | None = None
    ) -> tuple[Layout, dict[str, int]]:
        """A layout of a header chosen at random, with the values of the fields it depends on, by path; see `choices.choose`."""
        return choices.choose(self._con, self._limit, source, drawn or {})

    def _branch(
        self,
        node: _Node,
        leaf: Leaf,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        which: NDArray[np.intp],
        stack: list[tuple[_Node, NDArray[np.intp]]],
        short: list[NDArray[np.intp]],
    ) -> None:
        there = offsets[which] + leaf.offset + leaf.size <= len(buffer)
        if not there.all():
            short.append(which[~there])
            which = which[there]
        if not len(which):
            return
        values = leaf.at(leaf.offset).load(rows_at(buffer, offsets[which] + leaf.offset, leaf.size))
        if np.count_nonzero(values == values[0]) == len(values):
            stack.append((node.children.setdefault(values.item(0), _Node()), which))
            return
        few = _few(values)
        if few is not None:
            stack.extend((node.children.setdefault(value, _Node()), which[values == value]) for value in few)
            return
        order = np.argsort(values, kind="stable")
        values = values[order]
        edges = [0, *(np.flatnonzero(values[1:] != values[:-1]) + 1).tolist(), len(values)]
        which = which[order]
        for start, stop in pairwise(edges):
            stack.append((node.children.setdefault(int(values[start]), _Node()), which[start:stop]))

    def _explore(self, sample: NDArray[np.uint8]) -> None:
        """Walk the struct along one sample, and add what the walk asked for and found to the tree."""
        trail: list[tuple[Leaf, int]] = []

        def read(leaf: Leaf) -> int:
            choices.check_control(leaf)
            if leaf.offset + leaf.size > len(sample):
                raise _Short(leaf)
            value = int(leaf.at(leaf.offset).load(sample[None, leaf.offset : leaf.offset + leaf.size].copy())[0])
            trail.append((leaf, value))
            return value

        result: Layout | Refused | None = None
        missing: Leaf | None = None
        try:
            result = walk(self._con, read, self._limit).layout()
        except _Short as short:
            missing = short.leaf
        except TooLong:
            result = Refused()
        except SpecError:
            raise
        except Exception:
            result = Refused(traceback.format_exc())
        node = self._root
        for leaf, value in trail:
            node.leaf = leaf
            node = node.children.setdefault(value, _Node())
        node.leaf, node.result = missing, result
        self._size += 1

    def _prefix(self) -> dict[int, tuple[int, int]]:
        """The constants whose place depends on no header field."""
        state = Walk(_stop, self._limit)
        try:
            state.run(self._con)
        except (NotCompilable, SpecError):
            raise
        except Exception:
            pass  # a field of the header was asked for, or it leads to no frame, which `classify` says
        return dict(state.constants)


def _few(values: NDArray[Any]) -> list[int] | None:
    """The values in ascending order, if they are few different ones, which are found one by one sooner than sorted."""
    found, left = list[int](), values
    while len(left) and len(found) < FEW:
        found.append(left.item(0))
        left = left[left != left[0]]
    return None if len(left) else sorted(found)


class _Stop(Unread):
    """A field of the header was asked for."""


def _stop(leaf: Leaf) -> int:
    choices.check_control(leaf)
    raise _Stop


def check_compilable(con: Construct) -> None:
    """Raise `NotCompilable` if any branch of a tree holds a construct without a computable place."""
    _check(con, "")


_PLAIN: tuple[Any, ...] = (
    construct.FormatField,
    construct.Bytes,
    construct.BytesInteger,
    construct.Transformed,
    construct.Struct,
    construct.Array,
    construct.Const,
    construct.Renamed,
    construct.Enum,
    construct.Default,
    construct.Rebuild,
    construct.IfThenElse,
    construct.Switch,
    type(construct.Pass),
)


def _check(con: Construct, path: str) -> None:
    if isinstance(con, construct.Renamed):
        path = f"{path}.{con.name}" if path else str(con.name)
    if not isinstance(con, _PLAIN) and type(con).__module__ != "lidarspec.fields":
        raise NotCompilable(path, f"{type(con).__name__} has no fixed place")
    if not isinstance(con, construct.Transformed):
        for child in children(con):
            _check(child, path)
