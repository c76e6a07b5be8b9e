"""Whose some bytes are, frame by frame: of a text or file that was given to be looked at, not of a line that is listened to.

Bytes that are exactly one frame of a sensor are that sensor's; others belong to those that the most of them are in frames of, as
`detect` has it. Where none fits, the one whose frame they begin like is the one that is said to be nearest.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarspec.discovery.detect import AS_GOOD, scores
from lidarspec.errors import LidarSpecError, WireError
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import VALID
from lidarspec.plugins import sensors
from lidarspec.spec.sensor import Sensor
from lidarspec.wire.parse import parse_typed

#: constant bits that make bytes look like a frame, and constant bytes that do so in the midst of others.
ALIKE, SYNC = 8, 2


@dataclass(frozen=True)
class Piece:
    """A frame in the input, or with `frame` "" bytes that are in none."""

    offset: int
    data: bytes
    frame: str


def fitting(chunks: Sequence[bytes], *, datagrams: bool) -> list[Sensor]:
    """The installed sensors whose bytes these are, the best first; those with a type of exactly this frame before all others."""
    known = list(sensors().values())
    data = b"".join(chunks)
    whole = [sensor for sensor in known if any(_is_frame(sensor, name, data) for name in sensor.frames)]
    if whole:
        return whole
    found = scores(chunks, datagrams=datagrams) if data else []
    return [score.sensor for score in found if score.share >= found[0].share - AS_GOOD]


def pieces(sensor: Sensor, chunks: Sequence[bytes], *, datagrams: bool) -> list[Piece]:
    """The frames of the input in order, and the bytes between them; empty where there is no frame."""
    data = b"".join(chunks)
    try:
        return [Piece(0, data, parse_typed(sensor, data)[0])]
    except LidarSpecError:
        frames = sensor.split(list(chunks) if datagrams else data)
    if not frames:
        return []
    found: list[Piece] = []
    end = 0
    for frame in frames:
        if frame.offset > end:
            found.append(Piece(end, data[end : frame.offset], ""))
        found.append(Piece(frame.offset, frame.data, frame.frame))
        end = frame.offset + len(frame.data)
    return found + ([Piece(end, data[end:], "")] if end < len(data) else [])


def likely_starts(sensor: Sensor, data: bytes) -> list[int]:
    """Where bytes begin like an incoming frame: with two constant bytes or more, and any other; in ascending order."""
    starts: set[int] = set()
    for frame in sensor.frames.values():
        prefix = codec(frame).prefix
        size = next((spot for spot in range(len(prefix) + 1) if prefix.get(spot, (0, 0))[0] != 0xFF), 0)
        if frame.direction == "in" and size >= SYNC:
            magic = bytes(prefix[spot][1] for spot in range(size))
            starts |= {found.start() for found in re.finditer(re.escape(magic) + b"(?=.)", data, re.DOTALL)}
    return sorted(starts)


def nearest(data: bytes) -> WireError | None:
    """What the installed sensor that came farthest with some bytes says of them, with its id; None where none came far."""
    faults = []
    for sensor in sensors().values():
        try:
            parse_typed(sensor, data)
        except WireError as fault:
            faults.append(fault)
        except LidarSpecError:
            continue
    return max((fault for fault in faults if _begins_alike(fault)), key=lambda fault: fault.offset, default=None)


def _is_frame(sensor: Sensor, name: str, data: bytes) -> bool:
    """Whether the bytes are exactly one valid and plausible frame of a type."""
    frame = sensor.frames[name]
    if not 0 < len(data) <= frame.max_length:
        return False
    engine = codec(frame)
    if any(spot >= len(data) or data[spot] & mask != value for spot, (mask, value) in engine.prefix.items()):
        return False
    survey = engine.survey(np.frombuffer(data, np.uint8), np.zeros(1, np.intp))
    return bool(survey.status[0] == VALID and survey.sizes[0] == len(data))


def _begins_alike(fault: WireError) -> bool:
    """Whether the bytes have the constants that the frame type begins with, and those are enough not to be chance."""
    if not fault.frame:
        return False
    prefix = codec(sensors()[fault.sensor].frames[fault.frame]).prefix
    there = [(fault.data[spot], mask, value) for spot, (mask, value) in prefix.items() if spot < len(fault.data)]
    return all(byte & mask == value for byte, mask, value in there) and sum(mask.bit_count() for _, mask, _ in there) >= ALIKE
