"""What `parse` and `explain` are given: hexadecimal text, a file or standard input; and whose bytes they are."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from shlex import quote

import numpy as np

from lidarspec.device.settings import devices
from lidarspec.discovery.detect import scores
from lidarspec.errors import LidarSpecError, SourceError, UsageError, WireError, suggest
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import VALID
from lidarspec.plugins import sensors
from lidarspec.spec.sensor import Sensor
from lidarspec.transports.open_url import is_port, live_address, transport
from lidarspec.wire.parse import parse_typed

#: longest hexadecimal text that is repeated in the next command, and of other text in a message.
REPEATED, QUOTED = 400, 64
#: sensors whose share of the bytes is this close to the best fit as well.
AS_GOOD = 0.01
#: constant bits that make bytes look like a frame, and constant bytes that do so in the midst of others.
ALIKE, SYNC = 8, 2


@dataclass(frozen=True)
class Input:
    """Bytes to look at: datagrams, or pieces of one stream; `name` is how to ask for them again."""

    name: str
    chunks: tuple[bytes, ...]
    datagrams: bool = False

    @property
    def data(self) -> bytes:
        """All bytes in order."""
        return b"".join(self.chunks)


@dataclass(frozen=True)
class Piece:
    """A frame in the input, or with `frame` "" bytes that are in none."""

    offset: int
    data: bytes
    frame: str


def read(words: Sequence[str]) -> Input:
    """The input that the words of a command line stand for.

    Raises:
        UsageError: for text that is neither hexadecimal nor a file.
        SourceError: for a file that cannot be read.
    """
    text = " ".join(words)
    if text == "-":
        data = sys.stdin.buffer.read()
        return Input("-", (_unhexed(data) or data,))
    if len(words) == 1 and os.path.exists(text) and not is_port(text):
        return _file(text)
    try:
        return Input(text if len(text) <= REPEATED else "-", (_bytes(text),))
    except ValueError as error:
        if text in (known := devices()):
            return read([known[text].source])
        if len(words) == 1 and live_address(text) is not None:
            raise suggest(UsageError(f"{text} is live: this takes bytes or a file"), f"lidarspec read {quote(text)} --packets") from None
        if len(words) == 1 and re.search(r"[/\\.]", text):
            raise SourceError(f"{text}: no such file") from None
        raise UsageError(f"{text[:QUOTED]!r} is no file, and not hexadecimal: {error}") from None


def fitting(given: Input) -> list[Sensor]:
    """The installed sensors whose bytes these are, the best first; those with a type of exactly this frame before all others."""
    known = list(sensors().values())
    whole = [sensor for sensor in known if any(_is_frame(sensor, name, given.data) for name in sensor.frames)]
    if whole:
        return whole
    found = scores(list(given.chunks), datagrams=given.datagrams) if given.data else []
    return [score.sensor for score in found if score.share >= found[0].share - AS_GOOD]


def pieces(sensor: Sensor, given: Input) -> list[Piece]:
    """The frames of the input in order, and the bytes between them; empty where there is no frame."""
    data = given.data
    try:
        return [Piece(0, data, parse_typed(sensor, data)[0])]
    except LidarSpecError:
        frames = sensor.split(list(given.chunks) if given.datagrams else data)
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


def no_frame(sensor: Sensor, given: Input) -> WireError:
    """Why there is no frame of this sensor in the input, with the next command."""
    data = given.data
    longest = max((frame.max_length for frame in sensor.frames.values()), default=0)
    command = f"lidarspec explain {given.name} -s {sensor.id}"
    if not data:
        return suggest(WireError(f"{given.name} holds no bytes", sensor=sensor.id), f"lidarspec build {sensor.id} --help")
    if len(data) > longest:
        error = WireError(f"no frame in {len(data)} bytes", sensor=sensor.id, expected="a frame", data=data[:longest])
        return suggest(error, "lidarspec sensors")
    try:
        parse_typed(sensor, data)
    except WireError as error:
        return suggest(error, command)
    return suggest(WireError("the bytes are not plausible", sensor=sensor.id, data=data), command)


def nearest(given: Input) -> WireError:
    """No sensor fits: what the one that came farthest says, with its id, or that none came far."""
    if not given.data:
        return suggest(WireError(f"{given.name} holds no bytes"), "lidarspec sensors")
    known = sensors().values()
    faults = []
    for sensor in known:
        try:
            parse_typed(sensor, given.data)
        except WireError as fault:
            faults.append(fault)
        except LidarSpecError:
            continue
    best = max((fault for fault in faults if _begins_alike(fault)), key=lambda fault: fault.offset, default=None)
    if best is None:
        return suggest(WireError(f"no frame of any of the {len(known)} installed sensors", data=given.data[:QUOTED]), "lidarspec sensors")
    return suggest(best, f"lidarspec explain {given.name} -s {best.sensor}")


def _file(path: str) -> Input:
    opened = transport(path)
    try:
        chunks = tuple(chunk.data for chunk in opened.chunks())
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from None
    finally:
        opened.close()
    return Input(path, chunks, opened.datagrams)


def _bytes(text: str) -> bytes:
    """The bytes of hexadecimal text, with spaces, commas, colons and 0x as one likes."""
    digits = re.sub(r"0[xX]|[\s,:]", "", text)
    bad = re.search(r"[^0-9a-fA-F]", digits)
    if bad or not digits:
        raise ValueError(f"{bad[0]!r} is no digit of it" if bad else "there are no digits")
    if len(digits) % 2:
        raise ValueError(f"{len(digits)} digits make no whole bytes")
    return bytes.fromhex(digits)


def _unhexed(data: bytes) -> bytes | None:
    """The bytes that a text stands for, None where it is not hexadecimal."""
    try:
        return _bytes(data.decode("ascii"))
    except ValueError:
        return None


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
