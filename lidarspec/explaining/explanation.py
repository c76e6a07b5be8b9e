"""A frame, byte by byte: the name and value of each, what is wrong with it, and the differences
from another frame.

`FrameRows` reads the fields of the frame by its layout, as far as its bytes go. A damaged frame is
shown with the change that would explain the damage, a valid one with its points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarspec.device.session import Reply
from lidarspec.display import drawn
from lidarspec.errors import LidarSpecError, WireError
from lidarspec.explaining.damage import told
from lidarspec.explaining.frame_rows import FrameRows
from lidarspec.explaining.listing import Line, Listing, text
from lidarspec.explaining.wording import Difference, Point, Row, Span, Value
from lidarspec.frames.parse import identify
from lidarspec.frames.schema import schema, without_indices
from lidarspec.frames.wire_coder import frame_coder
from lidarspec.frames.wire_fields import examine
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import IMPLAUSIBLE, Counters, Found, packed
from lidarspec.packets.stream import PacketStream
from lidarspec.points.plain import evaluate_plainly
from lidarspec.scans.ends import first_points
from lidarspec.spec import Sensor

#: most points of a frame without arrays that are told.
TOLD = 4
#: most decimals that steps are told apart by, and those that may be added to show one in full.
DIGITS = 12
SPARE = 2

Keys = tuple[str | int, ...]


@dataclass(frozen=True, repr=False)
class Explanation:
    """A frame explained: rows that name every byte exactly once, in order. Its text is the listing
    that the command line prints.

    Attributes:
        sensor, frame: ids.
        data: the bytes.
        rows: one for each field, bit block or array element.
        fault: what is wrong with the frame as a whole; None if it is valid.
        notes: what concerns the whole frame.
    """

    sensor: str
    frame: str
    data: bytes
    rows: tuple[Row, ...]
    fault: WireError | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return (
            f"Explanation({self.sensor} {self.frame or 'skipped'}, {len(self.data)} bytes:"
            f" {self.verdict})"
        )

    _repr_html_ = drawn("explanation")

    def __str__(self) -> str:
        return "\n".join(text(line) for line in self.lines())

    @property
    def fields(self) -> dict[str, Value]:
        """Every value by its path with array indices, "points[1].intensity", in the order of the
        wire.
        """
        return {value.path: value for row in self.rows for value in row.values}

    @property
    def verdict(self) -> str:
        """What is wrong with the frame, in one sentence; "valid" where nothing is."""
        if self.fault is None:
            return "valid"
        return self.fault.reason

    @property
    def is_filler(self) -> bool:
        """Whether it is no frame, and nothing but bytes that the sensor sends between frames."""
        return not self.frame and all(row.right for row in self.rows)

    def path_of(self, number: int, part: int = 0) -> str | None:
        """The path of the row that gives a point, by its number in the frame, or in a part of it;
        None where no row does.
        """
        return next((row.path for row in self.rows if (part, number) in row.numbers), None)

    def lines(self, *, every: bool = False) -> list[Line]:
        """The listing in pieces; `every` draws the bits of all elements of an array, and not of the
        first alone.
        """
        return [
            *Listing(self.rows, every=every).lines(),
            *((Span("note: ", "note"), Span(note)) for note in self.notes),
        ]

    def differences(self, other: Explanation) -> list[Difference]:
        """The fields that another frame does not have alike, in the order of the wire."""
        before = self.fields
        after = other.fields
        pairs = ((path, before.get(path), after.get(path)) for path in {**before, **after})
        compared = [
            Difference(path, old, new, self._bytes(old), other._bytes(new))
            for path, old, new in pairs
        ]
        return [
            pair
            for pair in compared
            if pair.missing or len(pair.first) != len(pair.second) or any(pair.masks)
        ]

    def to_dict(self) -> dict[str, Any]:
        """The explanation for JSON."""
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

    def _bytes(self, value: Value | None) -> bytes:
        if value is None:
            return b""
        return self.data[value.start : value.start + len(value.masks)]


def explain(data: bytes, sensor: Sensor, frame: str | None = None) -> Explanation:
    """What every byte of one frame is; of a damaged or truncated one as far as it goes, with what
    is wrong.

    Args:
        frame: the frame type; by default the one that fits, or comes nearest.

    Raises:
        WireError: where the bytes do not even begin like a frame of this sensor.
        UnknownFrame: for a frame type that it does not have.
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
    listed_rows = FrameRows(sensor.frames[name], data, fault)
    rows = (*listed_rows.rows(), *listed_rows.rest(fault))
    if fault is not None and not fits(sensor, data[: listed_rows.after], name):
        guessed = told(sensor.frames[name], data, lambda sent: values(sent, sensor, name))
        return Explanation(sensor.id, name, data, rows, fault, tuple(guessed))
    rows, notes = _with_points(sensor, name, data[: listed_rows.after], rows)
    return Explanation(sensor.id, name, data, rows, fault, notes)


def values(data: bytes, sensor: Sensor, frame: str) -> dict[str, Value]:
    """Every value of one frame of this type, by its path with array indices, in the order of the
    wire.
    """
    return FrameRows(sensor.frames[frame], data).values()


def replied(sensor: Sensor, reply: Reply) -> tuple[str, list[tuple[str, str, str]]]:
    """What became of a command, in a sentence, and of the reply each field with its value and its
    meaning.
    """
    if not reply.confirmed or reply.frame is None:
        return "sent; no answer is documented, so whether it took is not known", []
    values = explain(reply.data, sensor, reply.frame).fields.values()
    rows = [
        (value.path, value.raw.hex(" ") if isinstance(value.raw, bytes) else str(value), value.docs)
        for value in values
    ]
    return f"answered with {reply.frame}", rows


def reply_text(sensor: Sensor, reply: Reply) -> str:
    """What became of a command, and of the reply each field with its value, a line each."""
    said, rows = replied(sensor, reply)
    return "\n".join([said, *(f"{path}: {value}" for path, value, _ in rows)])


def fits(sensor: Sensor, data: bytes, name: str) -> bool:
    """Whether bytes are one valid frame of a type."""
    try:
        identify(sensor, data, frame=name)
    except WireError:
        return False
    return True


def _with_points(
    sensor: Sensor, name: str, data: bytes, rows: tuple[Row, ...]
) -> tuple[tuple[Row, ...], tuple[str, ...]]:
    """The rows with their points, and what is to be said of the frame."""
    frame = sensor.frames[name]
    survey = codec(frame).survey(np.frombuffer(data, np.uint8), np.zeros(1, np.intp))
    notes = ["not plausible: a decoder passes over this frame"] * bool(
        survey.status[0] == IMPLAUSIBLE
    )
    if not (frame.data or frame.points):
        return rows, tuple(notes)
    try:
        packets = (
            PacketStream(sensor, name, Counters()).add([packed([Found(name, 0, data)])]).with_points
        )
        if not len(packets):
            return rows, tuple(notes)
        evaluated = evaluate_plainly(packets)
    except LidarSpecError as error:
        return rows, (*notes, f"no points: {error}")
    notes += ["defaults stand in for what a frame of another type would say"] * bool(
        evaluated.cloud.nominal
    )
    points = [Point.of(evaluated.cloud, index) for index in range(len(evaluated.cloud))]
    chain = packets.table.schema.chain
    parts = _parts(sensor, name, data)
    if not chain and not parts:
        return rows, (*notes, *(f"point {point}" for point in points[:TOLD]))
    arrays = {axis for info in packets.table.schema.fields.values() for axis in info.axes}
    along = tuple(axis for axis in evaluated.axes if axis in arrays)
    if len(along) == len(chain):
        chain = along  # which of several arrays side by side points go with, they say
    inside = evaluated.counts.astype(np.bool_)
    numbers = np.where(inside, np.cumsum(inside).reshape(inside.shape) - 1, -1)
    first = first_points(evaluated)
    given = list[Row]()
    for row in rows:
        spot = next(
            (spot for spot, part in enumerate(parts) if f"{row.path}.".startswith(f"{part}.")),
            None if parts else 0,
        )
        if not parts or spot is None:
            path = row.path
        else:
            path = row.path[len(parts[spot]) + 1 :]
        if spot is None:
            own = []
        else:
            own = _numbers(path, chain, evaluated.axes, numbers[spot])
        within = tuple((spot or 0, number - int(first[spot or 0])) for number in own)
        given.append(replace(row, points=tuple(points[number] for number in own), numbers=within))
    return tuple(given), tuple(notes)


def _parts(sensor: Sensor, name: str, data: bytes) -> list[str]:
    """Return the parts of a frame that have its points, as "segments[0]"; none if it has none."""
    frame = sensor.frames[name]
    path = sensor.parts_with("points", name)
    place = schema(frame.tree).within(path) if path else None
    if place is None:
        return []
    axis, kind_name, _ = place
    struct = frame_coder(frame).decode(data).struct
    examined = examine(frame.tree, struct, frame.room)
    node = schema(frame.tree).parts[axis]
    kind = next(kind for kind in node.kinds if kind.name == kind_name)
    return [part.prefix for part in examined.parts_of(axis) if part.root is kind.root]


def _numbers(
    path: str, chain: tuple[str, ...], axes: tuple[str | None, ...], numbers: Any
) -> list[int]:
    """The numbers of the points that an element of the innermost array gives; none for any other
    row.
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
