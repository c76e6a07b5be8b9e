"""The memory of programs: registers.

They are few and reused often, so that a chunk of packets stays in the cache.

A register is an array of one kind for a chunk. Registers that are never needed at the same time
share a slot (`slots_of`). Their memory comes from a `Scratch`, which is borrowed for one execution
and given back, so that each thread has another and each batch the same.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: pieces of memory kept for use again, and bytes of each at most.
MOST_KEPT = 2
LARGEST = 1 << 23

#: bytes; where arrays begin, and what is left between them, so that they do not all fall on the
#: same places of a cache.
ALIGNED = 64
APART = 320


class Scratch:
    """A piece of memory from which arrays are taken one after another."""

    def __init__(self) -> None:
        self._memory = _aligned(0)
        self._wanted = 0
        self._arranged: tuple[object, int, list[NDArray[Any]]] | None = None

    def arrays(
        self, owner: object, number: int, kinds: Sequence[tuple[int, np.dtype[Any]]]
    ) -> list[NDArray[Any]]:
        """Arrays that hold anything.

        Args:
            owner, number: who asks for how much; the same two get the same arrays the next time.
            kinds: elements of each array for each of `number`, and their type.
        """
        if self._arranged is None or self._arranged[0] is not owner or self._arranged[1] != number:
            self._wanted = 0
            self._arranged = (
                owner,
                number,
                [self._taken(number * count, dtype) for count, dtype in kinds],
            )
        return self._arranged[2]

    def _taken(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        start = self._wanted
        size = count * dtype.itemsize
        self._wanted = start + size + -size % ALIGNED + APART
        if start + size <= len(self._memory):
            memory = self._memory[start : start + size]
        else:
            memory = np.empty(size, np.uint8)
        return memory.view(dtype)

    def grow(self) -> None:
        """See to it that the next arrays have room, if as much is wanted."""
        wanted = min(self._wanted, LARGEST)
        if wanted > len(self._memory):
            self._memory = _aligned(wanted)
            self._arranged = None


_KEPT: list[Scratch] = []


def _aligned(size: int) -> NDArray[np.uint8]:
    memory = np.empty(size + ALIGNED, np.uint8)
    start = -memory.__array_interface__["data"][0] % ALIGNED
    return memory[start : start + size]


def borrowed() -> Scratch:
    """Memory that nobody else uses until it is given back."""
    try:
        return _KEPT.pop()  # at once, whatever other threads do
    except IndexError:
        return Scratch()


def given_back(scratch: Scratch) -> None:
    """Its arrays are not used any more; where this is never said, it is just freed."""
    scratch.grow()
    if len(_KEPT) < MOST_KEPT:
        _KEPT.append(scratch)


_CODES = {
    "single": "f4",
    "double": "f8",
    "index": "intp",
    "flag": "?",
    **{f"{sign}{size}": f"{sign}{size}" for sign in "iu" for size in (1, 2, 4)},
}
TYPES: dict[str, np.dtype[Any]] = {kind: np.dtype(code) for kind, code in _CODES.items()}


def slots_of(
    uses: Sequence[Collection[int]], kinds: Sequence[str], own: Collection[int]
) -> list[int]:
    """Return a slot for each register.

    Registers of one kind that are never needed at the same time share a slot.

    Args:
        uses: the registers that each step makes, reads or needs besides, in the order of the steps.
        kinds: of the registers.
        own: registers that have memory of their own.

    Returns:
        The number of each register's slot; -1 for those that have memory of their own, or are not
        used.
    """
    last = {register: place for place, used in enumerate(uses) for register in used}
    slots = [-1] * len(kinds)
    free = dict[str, list[int]]()
    count = 0
    for place, used in enumerate(uses):
        shared = set(used) - set(own)
        for register in shared:
            if slots[register] < 0:
                waiting = free.setdefault(kinds[register], [])
                if not waiting:
                    waiting.append(count)
                    count += 1
                slots[register] = waiting.pop()
        for register in shared:
            if last[register] == place:
                free[kinds[register]].append(slots[register])
    return slots
