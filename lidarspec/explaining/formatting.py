"""Format the parts of an explained frame as text: values, bits, points, rows and differences."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from lidarspec.errors import WireError
from lidarspec.frames.commands import find_argument_slot, has_only_names, list_choices
from lidarspec.frames.number_format import WHOLE, NumberFormat, format_fixed
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.arguments import Range, Taken
from lidarspec.spec.enum_values import UNKNOWN_CODE, format_code
from lidarspec.spec.timing import EPOCHS, Clock

if TYPE_CHECKING:
    from lidarspec.points.cloud import PointCloud

#: The number of bytes in a line of a hexdump.
HEXDUMP_LINE_BYTES = 16
#: The number of lines of a hexdump before the marked line.
HEXDUMP_LINES_BEFORE = 2
DEGREES_PER_TURN = 360


class TextSpan(NamedTuple):
    """A part of a line, with a role that decides its colour.

    The roles are "", "offset", "hex", "name", "bits", "docs", "good", "bad", "point", "note" and
    "title".
    """

    text: str
    role: str = ""


class ExplainedPoint(NamedTuple):
    """One point of a cloud, in metres and degrees.

    If there is no return, x, y and z are nan, and the range is inf. If the return is invalid, x, y,
    z and the range are nan.
    """

    x: float
    y: float
    z: float
    range: float
    azimuth_deg: float
    elevation_deg: float

    @classmethod
    def of(cls, cloud: PointCloud, index: int) -> ExplainedPoint:
        """Return point number `index` of a cloud."""
        x, y, z, distance = (
            float(column[index]) for column in (cloud.x, cloud.y, cloud.z, cloud.range)
        )
        return cls(
            x,
            y,
            z,
            distance,
            math.degrees(cloud.azimuth[index]),
            math.degrees(cloud.elevation[index]),
        )

    def __str__(self) -> str:
        if math.isnan(self.azimuth_deg + self.elevation_deg):
            return "the direction is unknown, because other frames contain it"
        level = round(self.elevation_deg, 2) == 0
        direction = f"at {format_fixed(self.azimuth_deg, 2)} deg" + (
            "" if level else f", {format_fixed(self.elevation_deg, 2)} deg up"
        )
        if math.isnan(self.x):
            return f"{direction} -> {'no return' if math.isinf(self.range) else 'not valid'}"
        if level and format_fixed(self.z, 3) == "0.000":
            height = ""
        else:
            height = f" z {format_fixed(self.z, 3)}"
        return f"{direction} -> x {format_fixed(self.x, 3)} y {format_fixed(self.y, 3)}{height}"


@dataclass(frozen=True)
class FieldValue:
    """One field of a row.

    Attributes:
        path: the path with array indices, e.g. "points[1].intensity".
        raw: the raw value, a number or bytes.
        physical: the value in `unit`; None if the value is not a number.
        unit: the unit; "" if the field has none.
        number_format: how `physical` is printed, for example with two decimals.
        label: the name of the raw value; "" if it has none.
        is_unknown: whether other values of the field have names, but this value has none.
        bits: a text with the bits of the field, e.g. ".. 000001.."; "" if the field consists of
            whole bytes.
        start: offset of the first byte in the frame.
        masks: for each byte that contains bits of the field, a mask in which these bits are 1.
    """

    path: str
    raw: Any
    physical: float | None = None
    unit: str = ""
    number_format: NumberFormat = WHOLE
    label: str = ""
    bits: str = ""
    docs: str = ""
    start: int = 0
    masks: bytes = b""
    is_unknown: bool = False

    @property
    def name(self) -> str:
        """The last part of the path."""
        return self.path.rpartition(".")[2]

    @property
    def has_meaning(self) -> bool:
        """Whether the value has a unit, or belongs to a field with named values."""
        return bool(self.unit or self.label) or self.is_unknown

    def contains_bit(self, offset: int, bit: int) -> bool:
        """Return whether a bit of the frame belongs to the field.

        Args:
            offset: offset of the byte in the frame.
            bit: index of the bit, 0 for the lowest.
        """
        index = offset - self.start
        return 0 <= index < len(self.masks) and bool(self.masks[index] >> bit & 1)

    def covers_byte(self, offset: int) -> bool:
        """Return whether any bit of a byte of the frame belongs to the field."""
        return any(self.contains_bit(offset, bit) for bit in range(8))

    def __str__(self) -> str:
        if self.physical is None:
            if isinstance(self.raw, bytes | bytearray):
                return format_ascii(self.raw)
            return repr(self.raw)
        if self.label:
            return format_code(self.raw, self.label)
        if self.is_unknown:
            return format_code(self.raw, UNKNOWN_CODE)
        is_unscaled = isinstance(self.raw, int) and self.physical == float(self.raw)
        if is_unscaled and self.number_format.decimals == 0:
            text = str(self.raw)
        else:
            text = self.number_format.format(self.physical)
        if self.unit == "deg/s":
            turns = f" = {self.physical / DEGREES_PER_TURN:.1f} Hz"
        else:
            turns = ""
        return f"{text} {self.unit}".strip() + turns

    def to_dict(self) -> dict[str, Any]:
        """Return the value as a dict for JSON, without empty attributes.

        Bytes and masks become hexadecimal text, and nan and infinity become None.
        """
        if isinstance(self.raw, bytes | bytearray):
            raw = self.raw.hex(" ")
        else:
            raw = to_json_number(self.raw)
        if self.physical is None:
            physical = {}
        else:
            physical = {"value": to_json_number(self.physical)}
        position = {"start": self.start, "masks": self.masks.hex(" ")}
        more = {
            name: text
            for name in ("unit", "label", "bits", "docs")
            if (text := getattr(self, name))
        }
        more |= {"unknown": True} if self.is_unknown else {}
        more |= {"text": text} if (text := str(self)) else {}
        return {"path": self.path, "raw": raw, **physical, **more, **position}


@dataclass(frozen=True)
class ExplainedRow:
    """A row of a frame: one field, one bit block, or one element of an array.

    Attributes:
        offset: offset of the first byte in the frame.
        path: the path of the field or element; "" for bytes that are not in a field.
        remarks: remarks on constants, checksums and missing bytes.
        matches_spec: whether the bytes match the spec.
        points: the points in this element.
        numbers: for each point, the index of its part in the frame, and its index in the part.
    """

    offset: int
    data: bytes
    path: str
    values: tuple[FieldValue, ...] = ()
    remarks: tuple[str, ...] = ()
    matches_spec: bool = True
    points: tuple[ExplainedPoint, ...] = ()
    numbers: tuple[tuple[int, int], ...] = ()

    @property
    def meaning(self) -> str:
        """A line with the values and their units, remarks, documentation and points."""
        return "".join(text for text, _ in self.spans())

    def spans(self, *, omits_values: bool = False) -> list[TextSpan]:
        """Return the parts of `meaning` with their roles.

        Args:
            omits_values: whether to omit the values, for a row with its bits drawn below it.
        """
        alone = len(self.values) == 1 and not self.values[0].bits
        values = [] if omits_values else self._format_values(alone=alone)
        verdict = "good" if self.matches_spec else "bad"
        docs = self.values[0].docs if alone and self.is_in_first_element else ""
        points = list(dict.fromkeys(str(point) for point in self.points))
        parts = [(", ", text, "") for text in values] + [
            (", ", text, "point") for text in points[:1]
        ]
        parts += (
            [("; ", text, verdict) for text in self.remarks]
            + [("; ", docs, "docs")]
            + [("; ", text, "point") for text in points[1:]]
        )
        parts = [part for part in parts if part[1]]
        return [
            TextSpan(separator * (index > 0) + text, role)
            for index, (separator, text, role) in enumerate(parts)
        ]

    @property
    def is_in_first_element(self) -> bool:
        """Whether the row is in the first element of each array around it, or in no array."""
        return set(re.findall(r"\[(\d+)\]", self.path)) <= {"0"}

    def _format_values(self, *, alone: bool) -> list[str]:
        """Return each value as text.

        Args:
            alone: whether the row is a single field, so that its text needs no name.
        """
        if alone and self.remarks:
            return []
        units = [value.unit for value in self.values if value.unit and "[" in self.path]
        names = [value.name for value in self.values]
        words = []
        for value in self.values:
            if names.count(value.name) == 1:
                name = value.name
            else:
                name = value.path.removeprefix(f"{self.path}.")
            text = str(value)
            if value.bits and self.is_in_first_element:
                where = f" ({value.bits})"
            else:
                where = ""
            needs_no_name = alone or units.count(value.unit) == 1
            words.append(
                f"{text}{where}" if needs_no_name else f"{name} {text or value.raw.hex(' ')}{where}"
            )
        return words

    def to_dict(self) -> dict[str, Any]:
        """Return the row as a dict for JSON."""
        facts = {
            "offset": self.offset,
            "hex": self.data.hex(" "),
            "path": self.path,
            "meaning": self.meaning,
            "right": self.matches_spec,
        }
        points = [
            {name: to_json_number(value) for name, value in point._asdict().items()}
            for point in self.points
        ]
        more = {"remarks": list(self.remarks), "values": [value.to_dict() for value in self.values]}
        return {**facts, **more} | ({"points": points} if points else {})


@dataclass(frozen=True)
class FieldDifference:
    """A field that differs between two frames.

    Attributes:
        path: the path with array indices.
        before: the value in the first frame; None if the frame does not have the field.
        after: the value in the second frame; None if the frame does not have the field.
    """

    path: str
    before: FieldValue | None
    after: FieldValue | None
    first: bytes
    second: bytes

    @property
    def only_in(self) -> str:
        """ "first" or "second" if only this frame has the field; "" if both have it."""
        if self.before is None:
            return "second"
        if self.after is None:
            return "first"
        return ""

    @property
    def masks(self) -> bytes:
        """A mask for each byte that both frames have; the bits that differ are 1."""
        own = self.before.masks if self.before else b""
        return bytes(
            (a ^ b) & mask for a, b, mask in zip(self.first, self.second, own, strict=False)
        )

    @property
    def change(self) -> str:
        """The signed change of a number as text; "" if the field is not a plain number."""
        if (
            not self.before
            or not self.after
            or self.before.physical is None
            or self.after.physical is None
            or self.before.label
        ):
            return ""
        step = self.before.number_format.format(self.after.physical - self.before.physical)
        return f"{'' if step.startswith('-') else '+'}{step} {self.before.unit}".strip()

    def to_dict(self) -> dict[str, Any]:
        """Return the difference as a dict for JSON."""
        values = {
            name: None if value is None else value.to_dict()
            for name, value in (("before", self.before), ("after", self.after))
        }
        offsets = {
            name: None if value is None else value.start
            for name, value in (("offset", self.before), ("offset_after", self.after))
        }
        return {
            "path": self.path,
            **offsets,
            **values,
            "bits": sum(mask.bit_count() for mask in self.masks),
        }


def draw_bits(data: bytes, masks: bytes) -> str:
    """Return the bits of one value as text, e.g. ".. 000001.. 00011000".

    The highest bit of each byte comes first. Dots stand for bits of other values; ".." is a byte
    without bits of this value.
    """
    parts = []
    for byte, mask in zip(data, masks, strict=True):
        bits = "".join(str(byte >> bit & 1) if mask >> bit & 1 else "." for bit in range(7, -1, -1))
        parts.append(bits if mask else "..")
    return " ".join(parts)


def to_json_number(value: Any) -> Any:
    """Return a value for JSON: None for nan and infinity, any other value unchanged."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def format_limits(low: float, high: float, separator: str = "..") -> str:
    """Format a range of numbers, e.g. "0..4294967295"; all digits of an integer are shown."""
    return separator.join(
        f"{end:.0f}" if float(end).is_integer() else f"{end:g}" for end in (low, high)
    )


def format_argument_type(kind: Taken, separator: str = "..") -> str:
    """Return the range of a command argument if it is a number, otherwise its type."""
    if isinstance(kind, Range):
        return format_limits(kind.low, kind.high, separator)
    return kind.describe(None)


def describe_argument(sensor: Sensor, command: str, argument: str, separator: str = "..") -> str:
    """Describe the values that an argument accepts: by name, by range, or by type."""
    kind = sensor.commands[command].arguments[argument].kind
    if isinstance(kind, Range):
        choices = list_choices(find_argument_slot(sensor, command, argument).info, kind)
        if has_only_names(kind, choices):
            return "|".join(choices)
        return "|".join([*choices, format_argument_type(kind, separator)])
    return format_argument_type(kind, separator)


def format_ascii(data: bytes | bytearray) -> str:
    """Return bytes as text in quotes, without trailing zero bytes.

    Returns "" if the bytes are not printable ASCII, or have fewer than four characters.
    """
    text = bytes(data).rstrip(b"\0").decode("ascii", "replace")
    if len(text) > 3 and text.isascii() and text.isprintable():
        return repr(text)
    return ""


def hexdump(error: WireError) -> str:
    """Return a hexdump of the bytes around an error; "" if the error has no bytes."""
    size = _count_marked_bytes(error)
    first = min(error.offset, len(error.data)) // HEXDUMP_LINE_BYTES * HEXDUMP_LINE_BYTES
    if error.offset == len(error.data) and first == len(error.data) and first:
        first -= HEXDUMP_LINE_BYTES
    lines = ["  ..."] * (first > HEXDUMP_LINES_BEFORE * HEXDUMP_LINE_BYTES)
    for start in range(
        max(first - HEXDUMP_LINES_BEFORE * HEXDUMP_LINE_BYTES, 0), first + 1, HEXDUMP_LINE_BYTES
    ):
        left, right = (error.data[start + half : start + half + 8].hex(" ") for half in (0, 8))
        lines.append(f"  {start:04x}  {left:<23}  {right}".rstrip())
    start = error.offset - first
    end = min(start + size, HEXDUMP_LINE_BYTES)
    columns = [8 + 3 * index + (index >= 8) for index in (start, end - 1)]
    marks = "^" * (max(columns[1], columns[0]) + 2 - columns[0])
    if error.data:
        return "\n".join([*lines, f"{' ' * columns[0]}{marks} {error.path}".rstrip()])
    return ""


def _count_marked_bytes(error: WireError) -> int:
    """Return the number of bytes to mark in a hexdump."""
    left = max(len(error.data) - error.offset, 1)
    if isinstance(error.got, str):
        digits = error.got.removeprefix("0x").replace(" ", "")
        return min((len(digits) + 1) // 2, left) or 1
    if error.got == len(error.data):
        return left
    return 1


def describe_losses(sensor: Sensor) -> str:
    """Return a text about how lost packets are counted, or why none are counted."""
    if sensor.sequence is not None:
        return f"counted by `{sensor.sequence.field}`"
    if sensor.counts_losses:
        return "computed from the clock, because the packets have no counter"
    return (
        "not counted, because the packets have no counter, and the time between packets is not"
        " declared"
    )


def describe_declared_clock(clock: Clock) -> str:
    """Return the fields and the epoch of a clock, in Markdown."""
    names = [clock.source] if isinstance(clock.source, str) else clock.source
    if callable(names):
        fields = "calculated from the packet"
    else:
        fields = " + ".join(f"`{name}`" for name in names)
    if clock.wraps_at:
        again = f", wraps at {clock.wraps_at:g} s"
    else:
        again = ""
    parts = [fields + again]
    if clock.reference:
        parts.append(f"with the date from `{clock.reference[0]}` frames")
    if clock.epoch:
        parts.append(f"counts {EPOCHS[clock.epoch]}")
    return ", ".join(parts)


def describe_declared_status(clock: Clock) -> str:
    """Describe in Markdown the field with the state of a clock, and its values."""
    status = clock.status
    assert status is not None
    if callable(status.source):
        place = f"calculated from `{status.frame}` frames" if status.frame else "calculated"
    else:
        place = f"`{'.'.join(filter(None, (status.frame, status.source)))}`"
    meanings = []
    for value, state in status.states.items():
        meaning = f"{value} {state.meaning}"
        if state.epoch is not None:
            meaning += f" ({EPOCHS[state.epoch]})"
        meanings.append(meaning)
    return f"{place}: {', '.join(meanings)}"
