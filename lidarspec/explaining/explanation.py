"""Explain one frame byte by byte: fields and values, the first fault, differences to another frame.

The explanation of a damaged frame names the single changes that explain the damage. The explanation
of a valid data frame contains its points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarspec.device.session import Reply
from lidarspec.errors import LidarSpecError, WireError
from lidarspec.explaining.damage_search import describe_damage
from lidarspec.explaining.formatting import (
    ExplainedPoint,
    ExplainedRow,
    FieldDifference,
    FieldValue,
    TextSpan,
)
from lidarspec.explaining.frame_rows import FrameRows
from lidarspec.explaining.listing import Line, Listing, join_text
from lidarspec.frames.parse import identify
from lidarspec.frames.schema import make_schema, without_indices
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.frames.wire_fields import examine
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.results import IMPLAUSIBLE, Counters, Found, pack_found
from lidarspec.notebook_display import make_display_method
from lidarspec.packets.stream import PacketStream
from lidarspec.points.reference_evaluator import evaluate_plainly
from lidarspec.scans.scan_ends import first_points
from lidarspec.spec import Sensor

#: The maximum number of points to list in the notes. Points are in the notes if the frame has no
#: arrays.
MAX_LISTED_POINTS = 4


@dataclass(frozen=True, repr=False)
class Explanation:
    """The explanation of one frame.

    The rows cover every byte exactly once, in order. `str()` returns the listing that the command
    line prints.

    Attributes:
        frame: the frame type; "" for bytes that are not in a frame.
        rows: a row for each field, bit block or array element.
        fault: the first fault of the frame; None if the frame is valid.
        notes: remarks on the whole frame.
    """

    sensor: str
    frame: str
    data: bytes
    rows: tuple[ExplainedRow, ...]
    fault: WireError | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return (
            f"Explanation({self.sensor} {self.frame or 'skipped'}, {len(self.data)} bytes:"
            f" {self.verdict})"
        )

    _repr_html_ = make_display_method("explanation")

    def __str__(self) -> str:
        return "\n".join(join_text(line) for line in self.lines())

    @property
    def fields(self) -> dict[str, FieldValue]:
        """The values by path with indices ("points[1].intensity"), in wire order."""
        return {value.path: value for row in self.rows for value in row.values}

    @property
    def verdict(self) -> str:
        """The first fault of the frame in one sentence; "valid" for a valid frame."""
        if self.fault is None:
            return "valid"
        return self.fault.reason

    @property
    def is_filler(self) -> bool:
        """Whether the bytes are only fillers that the sensor sends between frames."""
        return not self.frame and all(row.matches_spec for row in self.rows)

    def path_of(self, number: int, part: int = 0) -> str | None:
        """Return the path of the row that contains a point; None if there is no such row.

        Args:
            number: the index of the point in the frame, or in its part if the points are in parts.
            part: the index of the part that contains the point; 0 if the points are not in parts.
        """
        return next((row.path for row in self.rows if (part, number) in row.numbers), None)

    def lines(self, *, every: bool = False) -> list[Line]:
        """Return the lines of the listing, as spans of text with roles.

        Args:
            every: whether to draw the bits of every element of an array. By default, only the bits
                of the first element are drawn.
        """
        return [
            *Listing(self.rows, every=every).lines(),
            *((TextSpan("note: ", "note"), TextSpan(note)) for note in self.notes),
        ]

    def differences(self, other: Explanation) -> list[FieldDifference]:
        """Return the fields that differ between this and another frame, in wire order."""
        before = self.fields
        after = other.fields
        pairs = ((path, before.get(path), after.get(path)) for path in {**before, **after})
        compared = [
            FieldDifference(path, old, new, self._bytes_of(old), other._bytes_of(new))
            for path, old, new in pairs
        ]
        return [
            pair
            for pair in compared
            if pair.only_in or len(pair.first) != len(pair.second) or any(pair.masks)
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the explanation as a dict for JSON."""
        if self.fault is None:
            fault = None
        else:
            fault = {
                "reason": self.fault.reason,
                "offset": self.fault.offset,
                "path": self.fault.path,
            }
        head = {
            "sensor": self.sensor,
            "frame": self.frame,
            "size": len(self.data),
            "fault": fault,
            "notes": list(self.notes),
        }
        return {**head, "rows": [row.to_dict() for row in self.rows]}

    def _bytes_of(self, value: FieldValue | None) -> bytes:
        if value is None:
            return b""
        return self.data[value.start : value.start + len(value.masks)]


def explain(data: bytes, sensor: Sensor, frame: str | None = None) -> Explanation:
    """Explain every byte of one frame.

    A damaged or truncated frame is explained as far as possible, with its first fault.

    Args:
        frame: the frame type; by default the type that fits best.

    Raises:
        WireError: if the bytes do not begin like a frame of the sensor.
        UnknownFrame: if the sensor has no such frame type.
    """
    data = bytes(data)
    fault = None
    try:
        name = identify(sensor, data, frame=frame)
    except WireError as error:
        fault = error
        name = error.frame or frame or ""
        if not name:
            raise
    frame_rows = FrameRows(sensor.frames[name], data, fault)
    rows = (*frame_rows.iter_rows(), *frame_rows.iter_rest(fault))
    if fault is not None and not is_valid_frame(sensor, data[: frame_rows.after], name):
        guesses = describe_damage(
            sensor.frames[name], data, lambda candidate: read_values(candidate, sensor, name)
        )
        return Explanation(sensor.id, name, data, rows, fault, tuple(guesses))
    rows, notes = _add_points(sensor, name, data[: frame_rows.after], rows)
    return Explanation(sensor.id, name, data, rows, fault, notes)


def read_values(data: bytes, sensor: Sensor, frame: str) -> dict[str, FieldValue]:
    """Return the values of a frame by path with array indices, in wire order."""
    return FrameRows(sensor.frames[frame], data).values()


def describe_reply(sensor: Sensor, reply: Reply) -> tuple[str, list[tuple[str, str, str]]]:
    """Return a sentence about the result of a command, and the fields of the reply.

    Each field is a tuple (path, value as text, documentation).
    """
    if not reply.confirmed or reply.frame is None:
        return "command sent; the result is unknown, because no reply is documented", []
    values = explain(reply.data, sensor, reply.frame).fields.values()
    rows = [
        (value.path, value.raw.hex(" ") if isinstance(value.raw, bytes) else str(value), value.docs)
        for value in values
    ]
    return f"replied with {reply.frame}", rows


def format_reply(sensor: Sensor, reply: Reply) -> str:
    """Return the result of a command as text, with a line for each field of the reply."""
    result, rows = describe_reply(sensor, reply)
    return "\n".join([result, *(f"{path}: {value}" for path, value, _ in rows)])


def is_valid_frame(sensor: Sensor, data: bytes, name: str) -> bool:
    """Return whether the bytes are one valid frame of a type."""
    try:
        identify(sensor, data, frame=name)
    except WireError:
        return False
    return True


def _add_points(
    sensor: Sensor, name: str, data: bytes, rows: tuple[ExplainedRow, ...]
) -> tuple[tuple[ExplainedRow, ...], tuple[str, ...]]:
    """Return the rows with the points that each row contains, and notes on the frame."""
    frame = sensor.frames[name]
    survey = get_codec(frame).survey(np.frombuffer(data, np.uint8), np.zeros(1, np.intp))
    notes = list[str]()
    if survey.status[0] == IMPLAUSIBLE:
        notes.append("the values are not plausible, so decoders skip this frame")
    if not (frame.data or frame.points):
        return rows, tuple(notes)
    try:
        packets = (
            PacketStream(sensor, name, Counters())
            .add([pack_found([Found(name, 0, data)])])
            .with_points
        )
        if not len(packets):
            return rows, tuple(notes)
        evaluated = evaluate_plainly(packets)
    except LidarSpecError as error:
        return rows, (*notes, f"the frame could not be decoded to points: {error}")
    if evaluated.cloud.nominal:
        notes.append(
            "the points use default values, because the frame with the actual values is missing"
        )
    points = [ExplainedPoint.of(evaluated.cloud, index) for index in range(len(evaluated.cloud))]
    chain = packets.table.schema.deepest_axes
    parts = _find_parts_with_points(sensor, name, data)
    if not chain and not parts:
        return rows, (*notes, *(f"point {point}" for point in points[:MAX_LISTED_POINTS]))
    arrays = {axis for info in packets.table.schema.fields.values() for axis in info.axes}
    along = tuple(axis for axis in evaluated.axes if axis in arrays)
    if len(along) == len(chain):
        chain = along  # with several parallel arrays, the axes of the points decide
    inside = evaluated.counts.astype(np.bool_)
    numbers = np.where(inside, np.cumsum(inside).reshape(inside.shape) - 1, -1)
    first = first_points(evaluated)
    rows_with_points = list[ExplainedRow]()
    for row in rows:
        part_number = next(
            (index for index, part in enumerate(parts) if f"{row.path}.".startswith(f"{part}.")),
            None if parts else 0,
        )
        if part_number is None:  # a row outside all parts
            rows_with_points.append(row)
            continue
        path = row.path[len(parts[part_number]) + 1 :] if parts else row.path
        own = _find_point_numbers(path, chain, evaluated.axes, numbers[part_number])
        within = tuple((part_number, number - int(first[part_number])) for number in own)
        rows_with_points.append(
            replace(row, points=tuple(points[number] for number in own), numbers=within)
        )
    return tuple(rows_with_points), tuple(notes)


def _find_parts_with_points(sensor: Sensor, name: str, data: bytes) -> list[str]:
    """Return the paths of the parts with points, e.g. "segments[0]"."""
    frame = sensor.frames[name]
    path = sensor.parts_with("points", name)
    location = make_schema(frame.tree).split_part_path(path) if path else None
    if location is None:
        return []
    axis, kind_name, _ = location
    struct = frame_coder(frame).decode(data).struct
    examined = examine(frame.tree, struct, frame.max_struct_bytes)
    node = make_schema(frame.tree).parts[axis]
    kind = next(kind for kind in node.kinds if kind.name == kind_name)
    return [part.prefix for part in examined.list_parts_of(axis) if part.root is kind.root]


def _find_point_numbers(
    path: str, chain: tuple[str, ...], axes: tuple[str | None, ...], numbers: Any
) -> list[int]:
    """Return the indices of the points in a row.

    Args:
        path: the path of the row, for example "blocks[0].channels[3]".
        chain: the paths of the nested arrays that contain the points, outermost first, for example
            ("blocks", "blocks.channels").
        axes: for each dimension of `numbers`, the path of its array; None for a dimension that
            belongs to no array.
        numbers: for each element of the arrays, the index of its point; -1 for an element without
            a point.
    """
    indices = [int(part.partition("]")[0]) for part in path.split("[")[1:]]
    if not chain:
        if not path and numbers >= 0:
            return [int(numbers)]
        return []
    if (
        len(indices) != len(chain)
        or not chain[-1].startswith(without_indices(path)[0])
        or without_indices(path)[0] not in chain[-1].removesuffix("[]")
    ):
        return []
    own = dict(zip(chain, indices, strict=True))
    return [
        int(number)
        for number in np.ravel(numbers[tuple(own.get(axis or "", slice(None)) for axis in axes)])
        if number >= 0
    ]
