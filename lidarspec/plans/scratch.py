"""Memory for what is computed on the way, used again and again, so that it stays in the cache; in each thread another."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

#: pieces of memory kept for use again, and bytes of each at most.
MOST_KEPT, LARGEST = 2, 1 << 23

#: bytes; where arrays begin, and what is left between them, so that they do not all fall on the same places of a cache.
ALIGNED, APART = 64, 320

_KEPT: list[NDArray[np.uint8]] = []


class Scratch:
    """A piece of memory from which arrays are taken one after another."""

    def __init__(self, memory: NDArray[np.uint8]) -> None:
        self.memory, self._wanted = memory, 0

    def take(self, size: int) -> NDArray[np.uint8]:
        """So many bytes, whatever they hold, for as long as the scratch is used."""
        start = self._wanted
        self._wanted = start + size + -size % ALIGNED + APART
        return self.memory[start : start + size] if start + size <= len(self.memory) else np.empty(size, np.uint8)

    def grown(self) -> NDArray[np.uint8]:
        """The memory for the next one: as much as this one would have needed."""
        wanted = min(self._wanted, LARGEST)
        return self.memory if wanted <= len(self.memory) else _aligned(wanted)


def _aligned(size: int) -> NDArray[np.uint8]:
    memory = np.empty(size + ALIGNED, np.uint8)
    start = -memory.__array_interface__["data"][0] % ALIGNED
    return memory[start : start + size]


@contextmanager
def scratch() -> Iterator[Scratch]:
    """Memory that nobody else uses as long as it lasts."""
    try:
        memory = _KEPT.pop()  # at once, whatever other threads do
    except IndexError:
        memory = np.empty(0, np.uint8)
    taken = Scratch(memory)
    yield taken
    if len(_KEPT) < MOST_KEPT:
        _KEPT.append(taken.grown())
