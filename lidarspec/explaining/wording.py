"""The words for a frame's parts: numbers, bits, points and places as people read them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from lidarspec.errors import WireError
from lidarspec.spec.arguments import Range, Taken
from lidarspec.spec.sensor import Sensor

if TYPE_CHECKING:
    from lidarspec.points.cloud import PointCloud

#: bytes in a line of a hexdump, and lines before the marked one.
DUMPED = 16
BEFORE = 2
DEGREES_PER_TURN = 360


class Span(NamedTuple):
    """A piece of a line and its role: "" or "offset", "hex", "name", "bits", "docs", "good", "bad",
    "point", "note", "title".
    """

    text: str
    role: str = ""


class Point(NamedTuple):
    """One point of a cloud in metres and degrees; x y z nan and range inf or nan where there is no
    return.
    """

    x: float
    y: float
    z: float
    range: float
    azimuth_deg: float
    elevation_deg: float

    @classmethod
    def of(cls, cloud: PointCloud, index: int) -> Point:
        """Point number `index` of a cloud."""
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
            return "direction not known from this frame alone"
        level = round(self.elevation_deg, 2) == 0
        direction = f"at {fixed(self.azimuth_deg, 2)} deg" + (
            "" if level else f", {fixed(self.elevation_deg, 2)} deg up"
        )
        if math.isnan(self.x):
            return f"{direction} -> {'no return' if math.isinf(self.range) else 'not valid'}"
        if level and fixed(self.z, 3) == "0.000":
            height = ""
        else:
            height = f" z {fixed(self.z, 3)}"
        return f"{direction} -> x {fixed(self.x, 3)} y {fixed(self.y, 3)}{height}"


@dataclass(frozen=True)
class Value:
    """One field of a row.

    Attributes:
        path: with array indices: "points[1].intensity".
        raw: the number or bytes of the wire.
        physical: the number in `unit`; None for what is no number.
        digits: decimals that show every step of it; None for a float, which has no steps.
        label: the name of the raw value, where it has one.
        bits: which bits of the row's bytes it is; "" for whole bytes.
        docs: the author's text.
        start, masks: where in the frame its bytes begin, and which bits of each are its own.
    """

    path: str
    raw: Any
    physical: float | None = None
    unit: str = ""
    digits: int | None = 0
    label: str = ""
    bits: str = ""
    docs: str = ""
    start: int = 0
    masks: bytes = b""

    @property
    def name(self) -> str:
        """The last part of the path."""
        return self.path.rpartition(".")[2]

    def holds(self, offset: int, bit: int) -> bool:
        """Whether a bit of the frame is one of its own."""
        place = offset - self.start
        return 0 <= place < len(self.masks) and bool(self.masks[place] >> bit & 1)

    def covers(self, offset: int) -> bool:
        """Whether it has bits in a byte of the frame."""
        return any(self.holds(offset, bit) for bit in range(8))

    def __str__(self) -> str:
        if self.physical is None:
            if isinstance(self.raw, bytes | bytearray):
                return ascii_text(self.raw)
            return repr(self.raw)
        if self.label:
            return f"{self.raw} {self.label}"
        plain = isinstance(self.raw, int) and self.digits == 0 and self.physical == float(self.raw)
        if plain:
            text = str(self.raw)
        else:
            text = fixed(self.physical, self.digits)
        if self.unit == "deg/s":
            turns = f" = {self.physical / DEGREES_PER_TURN:.1f} Hz"
        else:
            turns = ""
        return f"{text} {self.unit}".strip() + turns

    def to_dict(self) -> dict[str, Any]:
        """The value for JSON: bytes and masks as hexadecimal text, no entry for what is not there,
        null for nan and infinity.
        """
        if isinstance(self.raw, bytes | bytearray):
            raw = self.raw.hex(" ")
        else:
            raw = number(self.raw)
        if self.physical is None:
            physical = {}
        else:
            physical = {"value": number(self.physical)}
        place = {"start": self.start, "masks": self.masks.hex(" ")}
        more = {
            name: text
            for name in ("unit", "label", "bits", "docs")
            if (text := getattr(self, name))
        }
        more |= {"text": text} if (text := str(self)) else {}
        return {"path": self.path, "raw": raw, **physical, **more, **place}


@dataclass(frozen=True)
class Row:
    """Some bytes of a frame: one field, one bit block, or one element of an array of structs.

    Attributes:
        offset, data: where they stand, and they.
        path: the field or element; "" for bytes that belong to none.
        values: the fields in them.
        remarks: what else is to be said: constants, the verdict of a checksum, what is missing.
        right: False where the bytes are not what the spec asks for.
        points: the points that this element gives.
        numbers: of each of them which part of the frame it is of, and which point of that, from 0.
    """

    offset: int
    data: bytes
    path: str
    values: tuple[Value, ...] = ()
    remarks: tuple[str, ...] = ()
    right: bool = True
    points: tuple[Point, ...] = ()
    numbers: tuple[tuple[int, int], ...] = ()

    @property
    def meaning(self) -> str:
        """Values in their units, the author's text, remarks and points, in one line."""
        return "".join(text for text, _ in self.spans())

    def spans(self, *, drawn: bool = False) -> list[Span]:
        """The meaning in pieces with their roles; with `drawn`, without the values, which stand bit
        by bit below the row.
        """
        alone = len(self.values) == 1 and not self.values[0].bits
        values = [] if drawn else self._values(alone=alone)
        verdict = "good" if self.right else "bad"
        docs = self.values[0].docs if alone and self.first else ""
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
            Span(separator * (index > 0) + text, role)
            for index, (separator, text, role) in enumerate(parts)
        ]

    @property
    def first(self) -> bool:
        """Whether it stands in the first element of every array around it; the others are the same
        again.
        """
        return set(re.findall(r"\[(\d+)\]", self.path)) <= {"0"}

    def _values(self, *, alone: bool) -> list[str]:
        """Each value in words: with its name, unless the unit says enough, and with its bits; those
        of further elements are left out.
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
            if value.bits and self.first:
                where = f" ({value.bits})"
            else:
                where = ""
            says_enough = alone or units.count(value.unit) == 1
            words.append(
                f"{text}{where}" if says_enough else f"{name} {text or value.raw.hex(' ')}{where}"
            )
        return words

    def to_dict(self) -> dict[str, Any]:
        """The row for JSON."""
        facts = {
            "offset": self.offset,
            "hex": self.data.hex(" "),
            "path": self.path,
            "meaning": self.meaning,
            "right": self.right,
        }
        points = [
            {name: number(value) for name, value in point._asdict().items()}
            for point in self.points
        ]
        more = {"remarks": list(self.remarks), "values": [value.to_dict() for value in self.values]}
        return {**facts, **more} | ({"points": points} if points else {})


@dataclass(frozen=True)
class Difference:
    """A field that two frames do not have alike.

    Attributes:
        path: with array indices.
        before, after: its value in each; None where the frame has no such field.
        first, second: its bytes in each.
    """

    path: str
    before: Value | None
    after: Value | None
    first: bytes
    second: bytes

    @property
    def missing(self) -> str:
        """Which frame alone has the field, "first" or "second"; "" for both."""
        if self.before is None:
            return "second"
        if self.after is None:
            return "first"
        return ""

    @property
    def masks(self) -> bytes:
        """The bits that differ, of bytes that both frames have; bits of other fields in the same
        bytes are not among them.
        """
        own = self.before.masks if self.before else b""
        return bytes(
            (a ^ b) & mask for a, b, mask in zip(self.first, self.second, own, strict=False)
        )

    @property
    def change(self) -> str:
        """By how much a physical value went up or down; "" for what is no number."""
        if (
            not self.before
            or not self.after
            or self.before.physical is None
            or self.after.physical is None
            or self.before.label
        ):
            return ""
        step = fixed(self.after.physical - self.before.physical, self.before.digits)
        return f"{'' if step.startswith('-') else '+'}{step} {self.before.unit}".strip()

    def to_dict(self) -> dict[str, Any]:
        """The difference for JSON."""
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


def bit_picture(data: bytes, masks: bytes) -> str:
    """The bits of one value in some bytes, the highest of each byte first: ".. 000001.. 00011000";
    dots are bits of other values.
    """
    parts = []
    for byte, mask in zip(data, masks, strict=True):
        bits = "".join(str(byte >> bit & 1) if mask >> bit & 1 else "." for bit in range(7, -1, -1))
        parts.append(bits if mask else "..")
    return " ".join(parts)


def number(value: Any) -> Any:
    """A value as JSON takes it: null for nan and infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def fixed(value: float, digits: int | None) -> str:
    """A number with so many decimals, or with seven figures, and no minus before a zero."""
    if digits is None:
        text = f"{value:.7g}"
    else:
        text = f"{value:.{digits}f}"
    if text.strip("-0."):
        return text
    return text.removeprefix("-")


def limits(low: float, high: float, between: str = "..") -> str:
    """A range of numbers, with every digit of whole ones: "0..4294967295"."""
    return between.join(
        f"{end:.0f}" if float(end).is_integer() else f"{end:g}" for end in (low, high)
    )


def asked(kind: Taken, between: str = "..") -> str:
    """What an argument of a command takes: a range of numbers, or the name of another kind."""
    if isinstance(kind, Range):
        return limits(kind.low, kind.high, between)
    return kind.words(None)


def ascii_text(data: bytes | bytearray) -> str:
    """Printable ASCII, which zeros may follow, in quotes; nothing for other bytes."""
    text = bytes(data).rstrip(b"\0").decode("ascii", "replace")
    if len(text) > 3 and text.isascii() and text.isprintable():
        return repr(text)
    return ""


def hexdump(error: WireError) -> str:
    """The bytes around the place of an error, sixteen to a line, with the place and its field
    marked; "" without bytes.
    """
    size = _marked(error)
    first = min(error.offset, len(error.data)) // DUMPED * DUMPED
    if error.offset == len(error.data) and first == len(error.data) and first:
        first -= DUMPED
    lines = ["  ..."] * (first > BEFORE * DUMPED)
    for start in range(max(first - BEFORE * DUMPED, 0), first + 1, DUMPED):
        left, right = (error.data[start + half : start + half + 8].hex(" ") for half in (0, 8))
        lines.append(f"  {start:04x}  {left:<23}  {right}".rstrip())
    place = error.offset - first
    columns = [8 + 3 * index + (index >= 8) for index in (place, min(place + size, DUMPED) - 1)]
    marks = "^" * (max(columns[1], columns[0]) + 2 - columns[0])
    if error.data:
        return "\n".join([*lines, f"{' ' * columns[0]}{marks} {error.path}".rstrip()])
    return ""


def _marked(error: WireError) -> int:
    """How many bytes to mark."""
    left = max(len(error.data) - error.offset, 1)
    if isinstance(error.got, str):
        digits = error.got.removeprefix("0x").replace(" ", "")
        return min((len(digits) + 1) // 2, left) or 1
    if error.got == len(error.data):
        return left
    return 1


def describe_losses(sensor: Sensor) -> str:
    """Return how lost packets are counted, or why they are not."""
    if sensor.sequence is not None:
        return f"counted by `{sensor.sequence.field}`"
    if sensor.counts_losses:
        return "counted by the clock"
    return "not counted: the packets have no counter, and no clock with a declared pace"
