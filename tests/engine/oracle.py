"""The documented framing rule, implemented byte by byte and by brute force.

It shares no code with the engine's framing. construct parses the author's own struct at one offset,
and the frame's `plausible` test judges the result. Nothing is done in bulk, so that the engine's
bulk code can be compared with it.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from construct import ConstructError

from lidarspec import Sensor
from lidarspec.expressions.columns import Batch
from lidarspec.framing.frame_engine import get_codec
from lidarspec.spec import Fields, Frame
from tests.by_construct import construct_frame
from tests.engine.plain_forms import plain_row

#: (name, offset, bytes) of a frame.
Cut = tuple[str, int, bytes]


class Oracle:
    """The frames of one stream, found by trying every type at every offset."""

    def __init__(self, sensor: Sensor, data: bytes) -> None:
        self._frames = {
            name: frame for name, frame in sensor.frames.items() if frame.direction == "in"
        }
        self._codecs = {
            name: get_codec(construct_frame(frame)) for name, frame in self._frames.items()
        }
        self._named = {frame.after for frame in self._frames.values()} - {None}
        answer = sensor.options.get("answer")
        self._mode = self._frames[answer].after if answer else None
        self._data = data
        self._known: dict[tuple[str, int], int] = {}

    def frames(self) -> list[Cut]:
        """Return the valid frames: the leftmost candidate, then the next one after it.

        At an invalid byte the search continues one byte further.
        """
        found: list[Cut] = []
        spot, run = 0, ("", -1)
        while spot < len(self._data):
            name = next((name for name in self._frames if self._is_accepted(name, spot, run)), None)
            if name is None:
                spot += 1
                continue
            size = self._valid(name, spot)
            found.append((name, spot, self._data[spot : spot + size]))
            self._mode = name if name in self._named else self._mode
            spot += size
            run = (name, spot)
        return found

    def _is_accepted(self, name: str, spot: int, run: tuple[str, int]) -> bool:
        """Return whether a frame of this type is accepted at this offset.

        It must be valid and, if it is weak, be part of a long enough run.
        """
        for _ in range(1 if run == (name, spot) else self._frames[name].confirm):
            if not self._valid(name, spot) or self._earlier(name, spot, run):
                return False
            spot += self._valid(name, spot)
        return True

    def _earlier(self, name: str, spot: int, run: tuple[str, int]) -> bool:
        before = list(self._frames)[: list(self._frames).index(name)]
        return any(self._is_accepted(other, spot, run) for other in before)

    def _valid(self, name: str, spot: int) -> int:
        """Return the size of the valid candidate of this type at this offset, otherwise 0."""
        if self._frames[name].after not in (None, self._mode):
            return 0
        if (name, spot) not in self._known:
            self._known[name, spot] = self._size(name, self._frames[name], spot)
        return self._known[name, spot]

    def _size(self, name: str, frame: Frame, spot: int) -> int:
        data = self._data[spot : spot + frame.max_length]
        row, size = (
            (data, 0)
            if frame.wire is None
            else plain_row(frame.wire, frame.struct, data) or (b"", 0)
        )
        stream = io.BytesIO(row)
        try:
            frame.prepared.parse_stream(stream)
        except ConstructError:
            return 0
        if frame.wire is not None and stream.tell() != len(row):
            return 0
        size = size or stream.tell()
        return (
            size
            if frame.plausible is None
            or self._sensible(name, frame.plausible, self._data[spot : spot + size])
            else 0
        )

    def _sensible(self, name: str, plausible: Any, data: bytes) -> bool:
        with np.errstate(all="ignore"):
            return bool(
                np.all(
                    np.asarray(
                        plausible(
                            Fields(Batch(self._codecs[name].table([data]), np.zeros(1, np.bool_)))
                        )
                    )
                )
            )
