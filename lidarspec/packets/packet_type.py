"""Decide how packets of one frame type are timed and how their losses are found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

from lidarspec.errors import UnknownFrame
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.frame_engine import get_codec
from lidarspec.packets.clocks import clock_fields, clock_parts, clock_terms
from lidarspec.spec.sensor import SensorDescription
from lidarspec.spec.timing import Clock


@dataclass(frozen=True, eq=False)
class PacketType:
    """The timing and loss rules of one frame type of a sensor.

    Attributes:
        codec: parses frames of the type.
        other_types: the names of all other frame types that the sensor sends and that are not data,
            such as a configuration. The last frame of each type before a packet is part of the
            packet's state (`Packets.state`).
        clock: the clock of the packets; None without a clock.
        timed_sensor: the sensor, with its clock replaced by `clock`.
        loss_clock: the clock that shows losses; None if there is no such clock.
        loss_clock_step_ns: the resolution of `loss_clock`, ns; 0 if a function computes the clock.
        clock_of_counter: the clock that checks the packet counter; None if there is no such clock.
        is_ordered_by_clock: whether the packets are datagrams that have a clock but no counter.
    """

    sensor: SensorDescription
    frame: str
    codec: Codec
    other_types: tuple[str, ...]
    clock: Clock | None
    timed_sensor: SensorDescription
    loss_clock: Clock | None
    loss_clock_step_ns: float
    clock_of_counter: Clock | None
    is_counted: bool
    is_ordered_by_clock: bool

    def __reduce__(self) -> Any:
        return get_packet_type, (self.sensor, self.frame)


@lru_cache(maxsize=256)
def get_packet_type(sensor: SensorDescription, frame: str) -> PacketType:
    """Return the rules of a frame type; repeated calls return the same object.

    Raises:
        UnknownFrame: if the sensor has no such type.
    """
    if frame not in sensor.frames:
        raise UnknownFrame(frame, sensor.frames, place=sensor.id)
    own_codec = get_codec(sensor.frames[frame])
    is_main = frame in sensor.main_frames
    clock = find_clock(sensor, frame)
    timed_sensor = sensor
    if clock is not None and clock is not sensor.clock:
        timed_sensor = replace(sensor, clock=clock)
    clock_of_counter = None
    if is_main and clock is not None:
        clock_of_counter = sensor.clock
    loss_clock = clock_of_counter
    step_ns = 0.0
    if loss_clock is not None:
        fields = clock_fields(loss_clock)
        if clock_parts(fields, own_codec.schema) is not None:
            loss_clock = None
        else:
            terms = clock_terms(fields, own_codec.schema, sensor.id)
            step_ns = float(min((step for _, step, _, _ in terms), default=0))
    counter = sensor.sequence
    is_counted = is_main and counter is not None and _has_field(sensor, frame, counter.field)
    return PacketType(
        sensor,
        frame,
        own_codec,
        tuple(name for name, other in sensor.incoming.items() if not other.data and name != frame),
        clock,
        timed_sensor,
        loss_clock,
        step_ns,
        clock_of_counter,
        is_counted,
        not is_counted and loss_clock is not None and sensor.datagrams,
    )


def find_clock(sensor: SensorDescription, frame: str) -> Clock | None:
    """Return the clock of a frame type; None if it has no clock."""
    # In a sensor with points, a type without points and IMU data does not use the sensor's clock.
    declared = sensor.frames[frame]
    shared = sensor.clock
    if declared.clock is not None or shared is None:
        return declared.clock
    if declared.data:
        if all(_has_field(sensor, frame, path) for path in clock_fields(shared)):
            return shared
        return None
    if not clock_fields(shared) or (declared.imu is None and sensor.has_points):
        return None
    schema = get_codec(declared).schema
    if all(path in schema.scan_names for path in clock_fields(shared)):
        return shared
    return None


def _has_field(sensor: SensorDescription, frame: str, path: str) -> bool:
    """Return whether packets of a frame type have a field."""
    # If no type has the field, the answer is True, so that reading the field raises an error.
    schemas = {name: get_codec(sensor.frames[name]).schema for name in sensor.main_frames}
    having = [
        name
        for name, schema in schemas.items()
        if path in schema.fields or schema.split_part_path(path) is not None
    ]
    return frame in having or not having
