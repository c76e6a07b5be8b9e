"""Parsers like those of vendors, used instead of the engine's decoder.

One is correct; each of the others has one deliberate mistake.
"""

from __future__ import annotations

import re
from typing import Any

from lidarspec import Counters, Found, Sensor, WireError
from lidarspec.framing.results import pack_found
from tests.broken import sound

HEADERS = {b"\xaa\x55\xc3": "data", b"\x17\x71\x44": "ack"}
COUNT = 12  # offset of the count
LONGEST = 87
SOUND = sound.sensor()


class Parser:
    """A parser that searches for frames byte by byte."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor, self.stats, self.backend = sensor, Counters(), "auto"
        self.buffer, self.base = b"", 0

    def feed(self, data: bytes, at: int | None = None) -> list[Found]:
        """Add bytes; return the frames that they complete."""
        self.stats.bytes_in += len(data)
        self.buffer += bytes(data)
        return self.cut(final=False)

    def idle(self) -> list[Found]:
        """Discard the incomplete candidate; return the frames after it."""
        return self.cut(final=True)

    def finish(self) -> list[Found]:
        """End the input; return the frames in the remaining bytes."""
        return self.idle()

    def frames(self, data: bytes, at: int | None = None) -> list[Any]:
        """Return the frames that these bytes complete, in the form the engine needs."""
        return [pack_found(self.feed(data, at))]

    def rest(self) -> list[Any]:
        """Return the frames in the remaining bytes, in the form the engine needs."""
        return [pack_found(self.idle())]

    def cut(self, *, final: bool) -> list[Found]:
        """Remove the frames from the buffer; return them."""
        found, spot = list[Found](), 0
        while spot < len(self.buffer):
            size = self.size(self.buffer[spot : spot + LONGEST])
            if size is None and not final:
                break
            name = (
                self.frame(self.buffer[spot : spot + size])
                if size and spot + size <= len(self.buffer)
                else ""
            )
            if name and size:
                found.append(Found(name, self.base + spot, self.buffer[spot : spot + size]))
                self.stats.frames[name] = self.stats.frames.get(name, 0) + 1
                spot += size
            else:
                step = min(self.step(spot, size or 0), len(self.buffer) - spot)
                self.stats.bytes_skipped += step
                spot += step
        self.drop(spot)
        return found

    def drop(self, number: int) -> None:
        """Discard `number` bytes of the buffer."""
        self.buffer, self.base = self.buffer[number:], self.base + number
        self.stats.pending = len(self.buffer)

    def size(self, data: bytes) -> int | None:
        """Return the length of the frame at the start of these bytes.

        Returns 0 if there is none, and None if more bytes are needed.
        """
        for header, name in HEADERS.items():
            if data.startswith(header):
                size = 5 if name == "ack" else 15 + 3 * data[COUNT] if len(data) > COUNT else None
                if size is not None and self.too_long(size):
                    return 0
                return None if size is None or len(data) < size else size
            if header.startswith(data):
                return None
        return 0

    def too_long(self, size: int) -> bool:
        """Return whether the length exceeds every frame's maximum."""
        return size > LONGEST

    def frame(self, data: bytes) -> str:
        """Return the type of a frame, "" if it is invalid."""
        found = SOUND.split(data)
        return found[0].frame if len(found) == 1 and found[0].data == data else ""

    def step(self, spot: int, size: int) -> int:
        """Return how many bytes to skip after an invalid frame."""
        return 1


class PartialHeaderDropped(Parser):
    """Mistake: a partial header at the end of a chunk is dropped."""

    def feed(self, data: bytes, at: int | None = None) -> list[Found]:
        found = super().feed(data, at)
        if len(self.buffer) < 3:
            self.stats.bytes_skipped += len(self.buffer)
            self.drop(len(self.buffer))
        return found


class ClaimedLengthSkipped(Parser):
    """Mistake: if the checksum of a frame is wrong, its whole length is skipped."""

    def step(self, spot: int, size: int) -> int:
        return max(size, 1)


class MismatchingByteLost(Parser):
    """Mistake: a byte that does not match a header is not tried as a first byte."""

    def step(self, spot: int, size: int) -> int:
        return 2 if self.buffer[spot] == 0xAA and self.buffer[spot + 1 : spot + 2] != b"\x55" else 1


class LongestRefused(Parser):
    """Mistake: >= instead of > in the comparison with the maximum length."""

    def too_long(self, size: int) -> bool:
        return size >= LONGEST


class BufferOfTheClass(Parser):
    """Mistake: all decoders share one buffer."""

    held = bytearray()

    def feed(self, data: bytes, at: int | None = None) -> list[Found]:
        self.stats.bytes_in += len(data)
        self.held.extend(data)
        self.buffer = bytes(self.held)
        return self.cut(final=False)

    def drop(self, number: int) -> None:
        super().drop(number)
        del self.held[:number]


class HeldOverSilence(Parser):
    """Mistake: an incomplete candidate is kept when no more data arrives."""

    def idle(self) -> list[Found]:
        return []


class ExceptionSwallowed(Parser):
    """Mistake: an exception is ignored, and the lost bytes are not counted."""

    def feed(self, data: bytes, at: int | None = None) -> list[Found]:
        try:
            return super().feed(data, at)
        except Exception:
            return []

    def cut(self, *, final: bool) -> list[Found]:
        if len(self.buffer) % 7 == 3:
            self.buffer = b""
            raise IndexError("bytearray index out of range")
        return super().cut(final=final)


class BufferCopied(Parser):
    """Mistake: the buffer is copied for each byte.

    One of the copies is made byte by byte: a plain slice is so fast on some machines that the
    time of a short input hardly depends on it.
    """

    def cut(self, *, final: bool) -> list[Found]:
        found = []
        while self.buffer[:1] not in (b"", b"\xaa", b"\x17"):
            self.buffer = self.buffer[1:]
            self.base += 1
            self.stats.bytes_skipped += 1
        if self.buffer:
            found = super().cut(final=final)
        self.stats.pending = len(self.buffer)
        return found

    def step(self, spot: int, size: int) -> int:
        self.buffer = bytes(byte for byte in self.buffer)  # as above, after a header that was none
        return 1


class Own(Sensor):
    """A sensor that is read by the parser of this class, not by the engine."""

    parser: type[Any] = Parser

    def decoder(self, *, stream: bool | None = None, backend: str = "auto") -> Any:
        """Return the parser instead of the engine's decoder."""
        return type(self).parser(self)


class Indexless(Sensor):
    """A sensor whose errors do not include the index of the array element."""

    def parse(self, data: Any, frame: str | None = None, *, verify: bool = True) -> Any:
        try:
            return super().parse(data, frame, verify=verify)
        except WireError as error:
            path = re.sub(r"\[[0-9]+\]", "", error.path)
            raise WireError(
                error.reason, sensor=self.id, frame=error.frame, offset=error.offset, path=path
            ) from error


def read_by(parser: type[Parser]) -> Sensor:
    """Return the correct sensor with another parser."""
    return sound.sensor(kind=type(parser.__name__, (Own,), {"parser": parser}))
