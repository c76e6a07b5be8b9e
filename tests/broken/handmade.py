"""A parser of one's own, as vendors write them, in the place of the engine's decoder: this one is right."""

from __future__ import annotations

from typing import Any

from lidarspec import Counters, Found, Sensor
from lidarspec.framing.results import packed
from tests.broken import sound

HEADERS = {b"\xaa\x55\xc3": "data", b"\x17\x71\x44": "ack"}
COUNT = 12  # where the count stands
LONGEST = 87
SOUND = sound.sensor()


class Parser:
    """Bytes in, frames out; frames are looked for byte by byte."""

    def __init__(self, sensor: Sensor) -> None:
        self.sensor, self.stats, self.interpreted = sensor, Counters(), False
        self.buffer, self.base = b"", 0

    def feed(self, data: bytes, at: int | None = None) -> list[Found]:
        """The frames that these bytes complete."""
        self.stats.bytes_in += len(data)
        self.buffer += bytes(data)
        return self.cut(final=False)

    def idle(self) -> list[Found]:
        """What waits is given up."""
        return self.cut(final=True)

    finish = idle

    def frames(self, data: bytes, at: int | None = None) -> list[Any]:
        """The same as `feed`, as the engine asks for it."""
        return [packed(self.feed(data, at))]

    def rest(self) -> list[Any]:
        """The same as `idle`."""
        return [packed(self.idle())]

    def cut(self, *, final: bool) -> list[Found]:
        """The frames in the buffer."""
        found, spot = list[Found](), 0
        while spot < len(self.buffer):
            size = self.size(self.buffer[spot : spot + LONGEST])
            if size is None and not final:
                break
            name = self.frame(self.buffer[spot : spot + size]) if size and spot + size <= len(self.buffer) else ""
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
        """What was looked at is no longer needed."""
        self.buffer, self.base = self.buffer[number:], self.base + number
        self.stats.pending = len(self.buffer)

    def size(self, data: bytes) -> int | None:
        """The length of the frame that these bytes begin with; 0 where none does, None where more are needed."""
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
        """Whether no frame is so long."""
        return size > LONGEST

    def frame(self, data: bytes) -> str:
        """The type of a frame, "" where it is none."""
        found = SOUND.split(data)
        return found[0].frame if len(found) == 1 and found[0].data == data else ""

    def step(self, spot: int, size: int) -> int:
        """How far to go on where there is no frame; `size`: of one whose checksum is wrong."""
        return 1


class Own(Sensor):
    """A sensor that is read by a parser of its own."""

    parser: type[Any] = Parser

    def decoder(self, *, stream: bool | None = None, backend: str = "auto") -> Any:
        """The parser in the place of the engine's."""
        return type(self).parser(self)
