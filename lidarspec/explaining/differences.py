"""What differs between two frames, field by field and down to the bit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from lidarspec.explaining.listing import Explanation, Line
from lidarspec.explaining.wording import Span, Value, bit_picture, fixed, number
from lidarspec.wiretable import hexed

#: bytes of a field in a line.
LINED = 4


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
    def masks(self) -> bytes:
        """The bits that differ, of bytes that both frames have; bits of other fields in the same bytes are not among them."""
        own = self.before.masks if self.before else b""
        return bytes((a ^ b) & mask for a, b, mask in zip(self.first, self.second, own, strict=False))

    @property
    def change(self) -> str:
        """By how much a physical value went up or down; "" for what is no number."""
        if not self.before or not self.after or self.before.physical is None or self.after.physical is None or self.before.label:
            return ""
        step = fixed(self.after.physical - self.before.physical, self.before.digits)
        return f"{'' if step.startswith('-') else '+'}{step} {self.before.unit}".strip()

    def to_dict(self) -> dict[str, Any]:
        """The difference for JSON."""
        values = {name: None if value is None else value.to_dict() for name, value in (("before", self.before), ("after", self.after))}
        offsets = {name: None if value is None else value.start for name, value in (("offset", self.before), ("offset_after", self.after))}
        return {"path": self.path, **offsets, **values, "bits": sum(mask.bit_count() for mask in self.masks)}


def differences(first: Explanation, second: Explanation) -> list[Difference]:
    """The fields that two frames do not have alike, in the order of the wire."""
    before, after = ({value.path: (value, _bytes(frame, value)) for row in frame.rows for value in row.values} for frame in (first, second))
    found = []
    for path in dict.fromkeys((*before, *after)):
        (old, a), (new, b) = before.get(path, (None, b"")), after.get(path, (None, b""))
        difference = Difference(path, old, new, a, b)
        if old is None or new is None or len(a) != len(b) or any(difference.masks):
            found.append(difference)
    return found


def told(first: Explanation, second: Explanation, found: list[Difference]) -> Iterator[Line]:
    """The differences as lines: each field with both values, and below it the bits that differ, dots for those that do not."""
    for missing, group in groupby(found, lambda difference: (difference.before is None) - (difference.after is None)):
        if missing:
            yield _missing(list(group), "second" if missing > 0 else "first")
            continue
        for difference in group:
            yield from _lines(difference)
    sizes = f"{len(first.data)} bytes" if len(first.data) == len(second.data) else f"{len(first.data)} and {len(second.data)} bytes"
    bits = sum(mask.bit_count() for difference in found for mask in difference.masks)
    same = (
        f"{bits} bit{'s' * (bits != 1)} in {len(found)} field{'s' * (len(found) != 1)} of {sizes} differ"
        if found
        else f"{sizes}, all alike"
    )
    yield (Span(same, "note"),)


def _lines(difference: Difference) -> Iterator[Line]:
    old, new = difference.before, difference.after
    assert old is not None
    assert new is not None
    change = f" ({difference.change})" if difference.change else ""
    moved = f" (in the second frame at {new.start:04x})" if new.start != old.start else ""
    values = f"{_said(old)} -> {_said(new)}{change}{moved}"
    yield (Span(f"{old.start:04x}  ", "offset"), Span(f"{difference.path}  ", "name"), Span(values))
    masks = difference.masks
    for start in range(0, len(masks), LINED):
        part = slice(start, start + LINED)
        if any(masks[part]):
            for sign, data, role in (("-", difference.first, "bad"), ("+", difference.second, "good")):
                bits = bit_picture(data[part], masks[part])
                yield (Span(f"{'':6}{sign} "), Span(f"{data[part].hex(' '):<{3 * LINED - 1}}  ", "hex"), Span(bits, role))


def _missing(group: list[Difference], which: str) -> Line:
    paths = [difference.path for difference in group]
    names = paths[0] if len(paths) == 1 else f"{paths[0]} to {paths[-1]}"
    return (Span(f"{'':6}{names}  ", "name"), Span(f"in the {which} frame alone"))


def _said(value: Value) -> str:
    text = str(value)
    return text or (hexed(value.raw, 0) if isinstance(value.raw, bytes) else str(number(value.raw)))


def _bytes(frame: Explanation, value: Value) -> bytes:
    return frame.data[value.start : value.start + len(value.masks)]
