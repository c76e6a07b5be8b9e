"""Where the points of a frame come from: the fields that `points` uses for each of its columns, and the beams of simulated packets."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import LidarSpecError
from lidarspec.frames.access import Fields
from lidarspec.frames.columns import Batch, aligned, unpadded
from lidarspec.frames.schema import FieldInfo
from lidarspec.frames.tables import Group, Rows
from lidarspec.frames.tracing import Node, Traced, trace
from lidarspec.geometry import Polar
from lidarspec.packets import Packets
from lidarspec.points import points_function
from lidarspec.simulation.sweeps import FrameMaker, sealed
from lidarspec.testing.subject import Subject

Floats = NDArray[np.float64]


def data_frames(subject: Subject) -> list[str]:
    """The names of the frame types that carry points."""
    return [name for name, frame in subject.sensor.frames.items() if frame.data]


def swept(subject: Subject, name: str, packets: int, start: int = 0) -> list[bytes]:
    """Packets along the sensor's `sweep`; none where it declares none, or the frame type is not compiled."""
    sweep = subject.sensor.frames[name].sweep or subject.sensor.sweep
    if sweep is None:
        return []
    try:
        return sealed(FrameMaker(subject.sensor, name).table([sweep(start + index) for index in range(packets)]))
    except LidarSpecError:
        return []


def read(subject: Subject, name: str, frames: list[bytes]) -> Packets:
    """Frames of one data type, decoded: a mode that another frame switches to is begun with that frame."""
    sensor = subject.sensor
    if sum(frame.data for frame in sensor.frames.values()) > 1:
        sensor = sensor.configure(answer=name)
    return sensor.decode(frames if sensor.datagrams else b"".join(frames), name)


def traced(subject: Subject, name: str) -> Any:
    """What `points` returns for traced columns of one example; None where the frame is not compiled.

    Raises:
        Untraceable: where it cannot be traced, with the reason.
    """
    packets = read(subject, name, [subject.example(name)] * subject.sensor.frames[name].confirm)
    if not isinstance(packets.table, Rows) or not packets.table.groups:
        return None
    group = packets.table.groups[0]
    batch = packets.batch()
    table = Rows(batch.table.schema, [Group(group.layout, np.arange(2), np.ascontiguousarray(group.rows[[0, 0]]))])
    state = {key: (frames, which[group.where[[0, 0]]]) for key, (frames, which) in batch.state.items()}
    return trace(points_function(subject.sensor, name), Batch(table, np.zeros(2, np.bool_), state, batch.defaults))[0]


def used(value: Any) -> Iterator[tuple[Node, bool]]:
    """The fields that a traced value is made of, and whether each is only looked up in a table."""
    pending = [(value.node, False)] if isinstance(value, Traced) else []
    while pending:
        node, looked_up = pending.pop()
        if node.kind in ("field", "state"):
            yield node, looked_up
        looked_up = looked_up or getattr(node.function, "__qualname__", "").startswith("take.")
        pending += [(arg, looked_up) for arg in node.args if isinstance(arg, Node)]


def field_of(subject: Subject, name: str, node: Node) -> FieldInfo | None:
    """The field that a node is, of this frame type or of the state that another one leaves."""
    from lidarspec.frames.codecs import codec

    frame, path = name, node.path
    if node.kind == "state":
        _, frame, path = node.path.split(".", 2)
    return codec(subject.sensor.frames[frame]).schema.fields.get(path)


@dataclass(frozen=True, eq=False)
class Beams:
    """Directions of points as `points` gives them, before they are folded, padding left out."""

    azimuth: Floats
    elevation: Floats


def beams(subject: Subject, name: str, packets: Packets) -> Beams | None:
    """The directions of the points of some packets; None where they are not polar."""
    batch = packets.batch()
    with np.errstate(all="ignore"):
        polar = points_function(subject.sensor, name)(Fields(batch))
        if not isinstance(polar, Polar):
            return None
        arrays, axes, _ = aligned((polar.azimuth, polar.elevation, polar.range), batch)
    shape = np.broadcast_shapes((len(packets), *(1,) * len(axes)), *(array.shape for array in arrays))
    mask = unpadded(axes, shape, batch)
    azimuth, elevation = (
        np.broadcast_to(np.asarray(array, np.float64), shape).reshape(shape[0], math.prod(shape[1:])) for array in arrays[:2]
    )
    return Beams(azimuth[mask], elevation[mask]) if mask is not None else Beams(azimuth, elevation)
