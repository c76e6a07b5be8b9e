"""Freed memory is kept for what is asked for next, where the C library would give it back to the system each time."""

from __future__ import annotations

import numpy as np

#: bytes; what is freed at the end of the heap is kept up to twice as much.
KEPT = 1 << 24


def keep_freed_memory() -> None:
    """Lets the allocator keep freed blocks, 32 MiB of them at most; does nothing where it does so already.

    The columns of a batch are blocks of some hundred kilobytes that live for milliseconds. glibc takes such blocks from the
    system and gives them back, page by page, and fetching the pages anew costs several times what computing the columns
    costs. It stops doing so for blocks smaller than the largest one that was ever freed, so one is: it is never touched,
    and takes no memory.

    Source: mallopt(3), M_MMAP_THRESHOLD: the threshold is adjusted dynamically, and M_TRIM_THRESHOLD to twice its value.
    """
    np.empty(KEPT, np.uint8)
