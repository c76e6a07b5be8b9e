"""Sensors with frames that construct parses and builds, to compare the engine with.

The engine uses construct, one frame at a time, for a frame type that has a part without a
computable offset. `by_construct` adds an empty part of this kind at the end of each frame.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

from lidarspec import Decoder, Packets, Scan, Sensor
from lidarspec.spec import Frame, tree

#: A part that no layout can have, and that has no bytes.
_NEVER_COMPILED = tree.Opaque("", tree.FieldInfo(""), "test", "read by construct")


class ConstructFrame(Frame):
    """A frame type without layouts."""

    @functools.cached_property
    def tree(self) -> tree.Node:
        return _with_part(super().tree)


def _with_part(node: tree.Node) -> tree.Node:
    """Return the tree of a frame with `_NEVER_COMPILED` added at its end."""
    if isinstance(node, tree.ChecksummedStruct):
        return dataclasses.replace(node, body=_with_part(node.body))
    assert isinstance(node, tree.Struct)
    return dataclasses.replace(node, members=(*node.members, _NEVER_COMPILED))


@functools.cache
def by_construct(sensor: Sensor) -> Sensor:
    """Return a sensor with frames that construct parses.

    Frames with a wire form are not changed. Points are then computed by the reference evaluator,
    without plans.
    """
    frames = {name: construct_frame(frame) for name, frame in sensor.frames.items()}
    return dataclasses.replace(sensor, frames=frames)


def construct_frame(frame: Frame) -> Frame:
    """Return a frame type that construct parses; one with a wire form as it is."""
    if frame.wire is not None:
        return frame
    values = {
        field.name: getattr(frame, field.name) for field in dataclasses.fields(frame) if field.init
    }
    return ConstructFrame(**values)


@dataclasses.dataclass(frozen=True)
class Reader:
    """A sensor, and the function that computes points of its packets."""

    sensor: Sensor
    backend: str

    def decode(self, data: Any, frame: str | None = None) -> Packets:
        """Return the packets of an input."""
        return self.sensor.decode(data, frame, backend=self.backend)

    def scans(self, data: Any) -> Iterator[Scan]:
        """Return the scans of an input."""
        return self.sensor.scans(data, backend=self.backend)

    def decoder(self, *, stream: bool | None = None) -> Decoder:
        """Return a decoder."""
        return self.sensor.decoder(stream=stream, backend=self.backend)


def reader(sensor: Sensor, name: str) -> Reader:
    """Return a reader by the name of a back end, or of "construct" as the judge."""
    if name == "construct":
        return Reader(by_construct(sensor), "auto")
    return Reader(sensor, name)
