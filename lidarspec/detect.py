"""Which installed sensor sent these bytes: each is tried, and what passes checksum and plausibility is counted."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

from lidarspec.errors import UsageError, WireError
from lidarspec.plugins import sensors
from lidarspec.sources import transport
from lidarspec.spec import Sensor

#: bytes and datagrams that are looked at.
LOOKED_AT, DATAGRAMS = 1 << 17, 400
#: bytes that an error shows.
SHOWN = 16


@dataclass(frozen=True)
class Score:
    """How well a sensor fits: the share of the bytes in its frames, and the number of its data frames."""

    sensor: Sensor
    share: float
    data_frames: int


def scores(chunks: list[bytes], *, datagrams: bool) -> list[Score]:
    """Every installed sensor of which a data frame was found, the best first."""
    total = sum(len(chunk) for chunk in chunks)
    found = []
    for sensor in sensors().values():
        if not any(frame.direction == "in" for frame in sensor.frames.values()):
            continue
        decoder = sensor.decoder(stream=not datagrams)
        for chunk in chunks:
            decoder.feed(chunk)
        decoder.finish()
        number = sum(decoder.stats.frames.get(name, 0) for name, frame in sensor.frames.items() if frame.data)
        if number:
            found.append(Score(sensor, 1 - decoder.stats.bytes_skipped / total, number))
    return sorted(found, key=lambda score: (-score.share, score.sensor.id))


def detected(source: str | Path) -> Sensor:
    """The one installed sensor whose frames a file holds.

    Raises:
        WireError: where none fits.
        UsageError: where several fit equally well: they are listed.
    """
    if str(source) == "-":
        raise UsageError("name the sensor with -s: standard input can be read only once")
    opened = transport(source)
    chunks: list[bytes] = []
    size = 0
    try:
        for chunk in itertools.islice(opened.chunks(), DATAGRAMS if opened.datagrams else None):
            chunks.append(chunk.data[:LOOKED_AT])
            size += len(chunks[-1])
            if size >= LOOKED_AT:
                break
    finally:
        opened.close()
    found = scores(chunks, datagrams=opened.datagrams)
    if not found:
        what = "no installed sensor's frames are in it" if size else "it holds no bytes"
        raise WireError(f"{source}: {what}", data=chunks[0][:SHOWN] if chunks else b"")
    best = [score.sensor.id for score in found if score.share >= found[0].share - 0.01]
    if len(best) > 1:
        raise UsageError(f"{source}: {', '.join(best)} send the same frames; name the sensor with -s")
    return found[0].sensor
