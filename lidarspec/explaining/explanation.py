"""A frame, byte by byte: what each one is called, what it says, what is wrong with it, and what
differs from another frame.

construct itself reads the frame, unverified, and notes every part on its way (`_Trail`). So a frame
that is cut off is explained as far as it goes, one without a computable layout like any other, and
no offset is known here. What the author says of a part comes from the frame tree: names of values,
units, constants, and which bits of a block are whose. A damaged frame is told with what would
explain the damage, a valid one goes on to its points.
"""

from __future__ import annotations

import contextlib
import functools
import io
import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarspec.device.session import Reply
from lidarspec.display import drawn
from lidarspec.errors import LidarSpecError, WireError
from lidarspec.explaining.damage import told
from lidarspec.explaining.listing import Line, Listing, text
from lidarspec.explaining.wording import Difference, Point, Row, Span, Value
from lidarspec.frames.parse import parse_typed
from lidarspec.frames.schema import schema
from lidarspec.frames.slots import recoder
from lidarspec.frames.wire_table import bit_text, hexed
from lidarspec.framing.frame_engine import codec
from lidarspec.framing.results import IMPLAUSIBLE, Counters, Found, packed
from lidarspec.packets.stream import PacketStream
from lidarspec.points.plain import evaluate
from lidarspec.scans.cutter import first_points
from lidarspec.spec import Checksummed, Frame, Sensor
from lidarspec.spec.bits import BitField
from lidarspec.spec.syntax import UNNAMED, Seen, field_path, leaves, member
from lidarspec.spec.tree import (
    Block,
    FieldInfo,
    Node,
    Opaque,
    Parts,
    Repeat,
    Struct,
    children,
    exact,
    listed,
)

#: most points of a frame without arrays that are told.
TOLD = 4
#: most decimals that steps are told apart by, and those that may be added to show one in full.
DIGITS, SPARE = 12, 2

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
        return "valid" if self.fault is None else self.fault.reason

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
        before, after = self.fields, other.fields
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
        fault = (
            None
            if self.fault is None
            else {"reason": self.fault.reason, "offset": self.fault.offset, "path": self.fault.path}
        )
        head = {
            "sensor": self.sensor,
            "frame": self.frame,
            "size": len(self.data),
            "fault": fault,
            "notes": list(self.notes),
        }
        return {**head, "rows": [row.to_dict() for row in self.rows]}

    def _bytes(self, value: Value | None) -> bytes:
        return b"" if value is None else self.data[value.start : value.start + len(value.masks)]


def explain(data: bytes, sensor: Sensor, frame: str | None = None) -> Explanation:
    """What every byte of one frame is; of a damaged or truncated one as far as it goes, with what
    is wrong.

    Args:
        frame: the frame type; by default the one that fits, or comes nearest.

    Raises:
        WireError: where the bytes do not even begin like a frame of this sensor.
        UnknownFrame: for a frame type that it does not have.
    """
    data, fault = bytes(data), None
    try:
        name, _ = parse_typed(sensor, data, frame=frame)
    except WireError as error:
        fault, name = error, error.frame or frame or ""
        if not name:
            raise
    trail = _Trail(sensor.frames[name], data, fault)
    rows = (*trail.rows(), *trail.rest(fault))
    if fault is not None and not fits(sensor, data[: trail.after], name):
        guessed = told(sensor.frames[name], data, lambda sent: values(sent, sensor, name))
        return Explanation(sensor.id, name, data, rows, fault, tuple(guessed))
    rows, notes = _with_points(sensor, name, data[: trail.after], rows)
    return Explanation(sensor.id, name, data, rows, fault, notes)


def values(data: bytes, sensor: Sensor, frame: str) -> dict[str, Value]:
    """Every value of one frame of this type, by its path with array indices, in the order of the
    wire.
    """
    return _Trail(sensor.frames[frame], data).values()


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
        parse_typed(sensor, data, frame=name)
    except WireError:
        return False
    return True


class _Trail:
    """One frame as construct read it: its parts, how far it came, and the verdicts of its
    checksums.
    """

    def __init__(self, frame: Frame, data: bytes, fault: WireError | None = None) -> None:
        self._data, self._schema, self._fault, self._recoder = (
            data,
            schema(frame.tree),
            fault,
            recoder(frame),
        )
        row, places = (data, None) if self._recoder is None else self._recoder.places(data)
        fields = self._schema.all_fields.values()
        self._arrays = [
            axis
            for info in fields
            for axis in (info.axes[:-1] if info.kind == "bytes" else info.axes)
        ]
        self._blocks = dict(_blocks(frame.tree, ""))
        trail: list[Seen] = []
        self.failed = True
        with contextlib.suppress(
            Exception
        ):  # construct lets anything out of expressions; `parse_typed` has said what is wrong
            frame.prepared.parse_stream(io.BytesIO(row), _verify=False, _trail=trail)
            self.failed = False
        self._parts = [(field_path(seen.path), seen) for seen in trail if seen.seal is None]
        self._verdicts = {
            path: verdict
            for seen in trail
            if seen.seal is not None
            for path, verdict in _verdicts(row, seen)
        }
        if places is not None:
            self._parts = [
                (path, seen if self._in_block(path) else _placed(seen, places))
                for path, seen in self._parts
            ]
        self.end = self._first = 0 if places is None else places[0]
        self.end = max(
            (seen.end for path, seen in self._parts if not self._in_block(path)), default=self.end
        )
        self._is_whole = (
            self._recoder is not None and not self.failed and self._recoder.row(data) is not None
        )
        self.after = len(data) if self._is_whole else self.end

    def rows(self) -> Iterator[Row]:
        """A row for each part, and for the marks of a wire form; the parts of an element of an
        array in one, if it holds no further one.
        """
        if self._first:
            yield Row(0, self._data[: self._first], "(start)", (), (), right=True)
        yield from self._fields()
        if self._is_whole and self.end < len(self._data):
            yield Row(self.end, self._data[self.end :], "(end)", (), (), right=True)

    def _fields(self) -> Iterator[Row]:
        for element, group in itertools.groupby(
            self._leaves(), lambda leaf: self._element(leaf[0])
        ):
            yield self._row(element, list(group))

    def values(self) -> dict[str, Value]:
        """Every value by its path."""
        return {value.path: value for row in self.rows() for value in row.values}

    def rest(self, fault: WireError | None) -> Iterator[Row]:
        """The bytes that no part took: those of the part that is cut off, or more than the frame
        has.
        """
        left = self._data[self.after :]
        if self.failed and fault is not None:
            yield Row(self.after, left, fault.path, (), (fault.reason,), right=False)
        elif fault is not None and self._recoder is not None and not left:
            yield Row(self.after, left, "(end)", (), (fault.reason,), right=False)
        elif left:
            yield Row(self.after, left, "", (), ("after the frame's end",), right=False)

    def _leaves(self) -> Iterator[tuple[str, Seen]]:
        for path, seen in self._parts:
            is_leaf = seen.value is not None and (
                kind(path) in self._blocks or not isinstance(seen.value, dict | list)
            )
            if is_leaf and not self._in_block(path):
                yield path, seen

    def _in_block(self, path: str) -> bool:
        """Whether a part is within a bit block, and so not counted in bytes of the frame."""
        return any(kind(path).startswith((f"{block}.", f"{block}[")) for block in self._blocks)

    def _element(self, path: str) -> str:
        """What a part is shown with: the innermost array element that it stands in, or itself."""
        head, bracket, _ = path.rpartition("]")
        array = plain(head + bracket)
        in_blocks = tuple(f"{plain(block)}." for block in self._blocks)
        further = any(
            axis.startswith(f"{array}.") and not axis.startswith(in_blocks) for axis in self._arrays
        )
        return path if not bracket or further else head + bracket

    def _row(self, path: str, group: Sequence[tuple[str, Seen]]) -> Row:
        start, end = group[0][1].start, group[-1][1].end
        values: list[Value] = []
        remarks: list[str] = []
        right = True
        for part, seen in group:
            for keys, raw in leaves(seen.value):
                value, info = self._value(part, seen, keys, raw)
                values.append(value)
                if info.const is not None and value.raw != info.const:
                    remarks.append(
                        f"wrong: {hexed(value.raw, info.bits)}, expected"
                        f" {hexed(info.const, info.bits)}"
                    )
                    right = False
                if info.allowed is not None and value.raw not in info.allowed:
                    remarks.append(f"wrong: {value.raw}, expected {listed(info.allowed)}")
                    right = False
                if info.held and self._fault is not None and self._fault.path == value.path:
                    remarks.append(f"wrong: {value.raw}, expected {self._fault.expected}")
                    right = False
                if value.path in self._verdicts:
                    text, good = self._verdicts[value.path]
                    remarks.append(text)
                    right = right and good
        return Row(start, self._data[start:end], path, tuple(values), tuple(remarks), right)

    def _value(self, part: str, seen: Seen, keys: Keys, raw: Any) -> tuple[Value, FieldInfo]:
        path = part + "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys)
        unknown = FieldInfo(plain(path), docs="constant" if path.endswith(UNNAMED) else "")
        info = self._schema.all_fields.get(plain(path), unknown)
        bits = self._blocks.get(kind(part), {}).get(keys) if self._recoder is None else None
        physical = float(info.physical(raw)) if isinstance(raw, int | float) else None
        label = info.labels.get(raw, "") if isinstance(raw, int) else ""
        digits = None if info.kind == "float" else _digits(info.scale, info.offset)
        masks = bits.masks(seen.end - seen.start) if bits else b"\xff" * (seen.end - seen.start)
        return (
            Value(
                path,
                raw,
                physical,
                info.unit,
                digits,
                label,
                bit_text(bits) if bits else "",
                info.docs,
                seen.start,
                masks,
            ),
            info,
        )


def _placed(seen: Seen, places: Sequence[int]) -> Seen:
    """A part of a row where it stands on the wire."""
    return seen._replace(start=places[seen.start], end=places[seen.end])


def plain(path: str) -> str:
    """A path without indices: "points[1].intensity" is "points.intensity"."""
    return re.sub(r"\[\d*\]", "", path)


def kind(path: str) -> str:
    """A path for all elements: "points[1].intensity" is "points[].intensity"."""
    return re.sub(r"\[\d+\]", "[]", path)


@functools.lru_cache
def _digits(scale: float, offset: float) -> int:
    """Decimals that tell every step of a field from the next; a few more where these show it in
    full.
    """
    steps = (exact(scale), exact(offset))
    apart = next((digits for digits in range(DIGITS) if abs(steps[0]) * 10**digits >= 1), DIGITS)
    return next(
        (
            digits
            for digits in range(apart, apart + SPARE + 1)
            if all(step * 10**digits % 1 == 0 for step in steps)
        ),
        apart,
    )


def _blocks(node: Node, path: str) -> Iterator[tuple[str, Mapping[Keys, BitField]]]:
    """The bits of each field of each bit block, by the path of the block, arrays in it with "[]"."""
    match node:
        case Block():
            yield (
                path,
                {part.bits.keys: part.bits for part in node.parts if part.info.dtype is not None},
            )
        case Opaque(in_bits=True):
            yield path, {}
        case Struct():
            for member in node.members:
                yield from _blocks(member, ".".join(filter(None, (path, member.name))))
        case _:
            for child in children(node):
                yield from _blocks(child, f"{path}[]" if isinstance(node, Repeat | Parts) else path)


def _verdicts(data: bytes, seen: Seen) -> Iterator[tuple[str, tuple[str, bool]]]:
    """What a checksum says and whether it is right, under the path of its first field."""
    seal: Checksummed = seen.seal
    if seal.algorithm is None:
        return
    inside = data[seen.start : seen.end]
    stored, computed = seal.verdict(inside, seen.value, seen.start)
    number = sum(end - start for start, end in seal.covered(seen.value, len(inside), seen.start))
    how = f"({seal.algorithm.describe()} over {number} byte{'s' * (number != 1)})"
    shown, expected = (hexed(value, seal.algorithm.width) for value in (stored, computed))
    said = (
        "ok"
        if stored == computed
        else "means not filled"
        if stored in seal.absent
        else f"wrong, expected {expected}"
    )
    prefix = field_path(seen.path)
    path = f"{prefix}.{seal.fields[0]}" if prefix else seal.fields[0]
    yield path, (f"{shown} {said} {how}", stored == computed or stored in seal.absent)


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
        evaluated = evaluate(packets)
    except LidarSpecError as error:
        return rows, (*notes, f"no points: {error}")
    notes += ["defaults stand in for what a frame of another type would say"] * bool(
        evaluated.cloud.nominal
    )
    points = [Point.of(evaluated.cloud, index) for index in range(len(evaluated.cloud))]
    chain, parts = packets.table.schema.chain, _parts(sensor, name, data)
    if not chain and not parts:
        return rows, (*notes, *(f"point {point}" for point in points[:TOLD]))
    arrays = {axis for info in packets.table.schema.fields.values() for axis in info.axes}
    along = tuple(axis for axis in evaluated.axes if axis in arrays)
    chain = (
        along if len(along) == len(chain) else chain
    )  # which of several arrays side by side points go with, they say
    inside = evaluated.counts.astype(np.bool_)
    numbers = np.where(inside, np.cumsum(inside).reshape(inside.shape) - 1, -1)
    first, given = first_points(evaluated), list[Row]()
    for row in rows:
        spot = next(
            (spot for spot, part in enumerate(parts) if f"{row.path}.".startswith(f"{part}.")),
            None if parts else 0,
        )
        path = row.path if not parts or spot is None else row.path[len(parts[spot]) + 1 :]
        own = [] if spot is None else _numbers(path, chain, evaluated.axes, numbers[spot])
        within = tuple((spot or 0, number - int(first[spot or 0])) for number in own)
        given.append(replace(row, points=tuple(points[number] for number in own), numbers=within))
    return tuple(given), tuple(notes)


def _parts(sensor: Sensor, name: str, data: bytes) -> list[str]:
    """The parts of a frame that have its points, as "segments[0]"; none where the frame itself has
    them.
    """
    frame, path = sensor.frames[name], sensor.parts_with("points", name)
    place = schema(frame.tree).within(path) if path else None
    if place is None:
        return []
    recoding = recoder(frame)
    row = None if recoding is None else recoding.row(data)
    pieces = member(frame.prepared.parse(data if row is None else row[1], _verify=False), place[0])
    return [
        f"{place[0]}[{index}]"
        for index, (kind, _, _) in enumerate(pieces.spans)
        if kind == place[1]
    ]


def _numbers(
    path: str, chain: tuple[str, ...], axes: tuple[str | None, ...], numbers: Any
) -> list[int]:
    """The numbers of the points that an element of the innermost array gives; none for any other
    row.
    """
    indices = [int(part.partition("]")[0]) for part in path.split("[")[1:]]
    if not chain:
        return [int(numbers)] if not path and numbers >= 0 else []
    if (
        len(indices) != len(chain)
        or not chain[-1].startswith(plain(path))
        or plain(path) not in chain[-1].removesuffix("[]")
    ):
        return []
    own = dict(zip(chain, indices, strict=True))
    return [
        int(number)
        for number in np.ravel(numbers[tuple(own.get(axis or "", slice(None)) for axis in axes)])
        if number >= 0
    ]
