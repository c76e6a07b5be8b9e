"""Which single flipped bit makes a damaged frame whole again, if any does: each one is tried, through the engine itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from lidarspec.frames.codecs import CompiledCodec, codec
from lidarspec.frames.judging import VALID
from lidarspec.spec import Sensor

#: bytes of candidates that are tried in one go, and the longest frame that construct alone has to read so often.
BLOCK, INTERPRETED = 1 << 20, 128


class Flip(NamedTuple):
    """A bit that may have flipped: byte of the frame, and bit of it, 0 the lowest."""

    offset: int
    bit: int

    def mended(self, data: bytes) -> bytes:
        """The bytes with this bit turned back."""
        return data[: self.offset] + bytes([data[self.offset] ^ 1 << self.bit]) + data[self.offset + 1 :]


def flips(sensor: Sensor, name: str, data: bytes) -> list[Flip]:
    """Every single bit of which the opposite makes the bytes one valid and plausible frame of this type."""
    frame = sensor.frames[name]
    engine = codec(frame)
    if not 0 < len(data) <= frame.max_length or (not isinstance(engine, CompiledCodec) and len(data) > INTERPRETED):
        return []
    if engine.size not in (None, len(data)) or any(spot >= len(data) for spot in engine.prefix):
        return []
    wrong = {spot for spot, (mask, value) in engine.prefix.items() if data[spot] & mask != value}
    if len(wrong) > 1:
        return []
    found = []
    for tried in _blocks([Flip(spot, bit) for spot in wrong or range(len(data)) for bit in range(8)], max(1, BLOCK // len(data))):
        rows = np.tile(np.frombuffer(data, np.uint8), (len(tried), 1))
        rows[np.arange(len(tried)), [flip.offset for flip in tried]] ^= np.array([1 << flip.bit for flip in tried], np.uint8)
        fits = np.ones(len(tried), np.bool_)
        for spot, (mask, value) in engine.prefix.items():
            fits &= rows[:, spot] & mask == value
        places = np.flatnonzero(fits)
        if not len(places):
            continue
        survey = engine.survey(rows.reshape(-1), places * len(data))
        right = (survey.status == VALID) & (survey.sizes == len(data))
        found += [tried[place] for place in places[right].tolist()]
    return found


def _blocks(tried: list[Flip], size: int) -> Iterator[list[Flip]]:
    for first in range(0, len(tried), size):
        yield tried[first : first + size]
