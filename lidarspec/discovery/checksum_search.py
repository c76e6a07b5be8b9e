"""Which checksum is this: what a set of sample frames is sealed with, where it stands and what it covers."""

from __future__ import annotations

from collections.abc import Iterable

from lidarspec.discovery.crc_search import crc_matches
from lidarspec.discovery.samples import Match, Samples, best_first
from lidarspec.discovery.sum_search import plain_matches

#: matches that are told.
TOLD = 8


def search(frames: Iterable[bytes]) -> list[Match]:
    """The checksums that fit the frames, the plainest and best proven first; empty where none does.

    Args:
        frames: whole frames, the more of them and the more different the better; some may be damaged, and lengths may differ.
    """
    samples = Samples(frames)
    if samples.shortest < 3 or not any(map(any, samples.frames)):
        return []
    found = list(plain_matches(samples))
    if not any(match.sure for match in found):
        found += crc_matches(samples)
    if not found:
        found += crc_matches(samples, mixed=True)
    return best_first(found)[:TOLD]
