"""Find the single change of a damaged frame that explains the damage.

Each bit is flipped back, each byte removed, and every byte value inserted at every offset, and the
engine decides which of these give one valid frame of the type. So this module needs no knowledge of
checksums and lengths. With a short checksum several changes may match by chance: if there are
many, only their kind is reported.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarspec.explaining.formatting import FieldValue
from lidarspec.frames.arrays import count_up
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.framing.results import VALID
from lidarspec.spec import Frame
from lidarspec.spec.tree import formulas, nodes, refs

#: Bytes of candidates that are tried at once; the longest frame, read by plain construct, that is
#: tried; the longest frame in which lost bytes are searched, with 256 candidates for each offset;
#: and the maximum number of fields that its layout may depend on for that, since otherwise nearly
#: each candidate has a layout of its own.
BLOCK = 1 << 20
INTERPRETED = 128
SEARCHED = 512
HEADED = 4
#: Maximum number of changes to report one by one.
TOLD = 3
#: Kinds of damage, the likeliest first -> number of bytes that it adds to the frame, and number of
#: candidates for each offset.
KINDS = {"flipped bit": (0, 8), "inserted byte": (1, 1), "lost byte": (-1, 256)}


class FrameChange(NamedTuple):
    """A possible change of a frame.

    Attributes:
        kind: "flipped bit", "inserted byte" or "lost byte".
        offset: the byte of the damaged frame that was changed or inserted, or before which one was
            lost.
        value: number of the bit, 0 the lowest; or the byte.
    """

    kind: str
    offset: int
    value: int

    def repair(self, data: bytes) -> bytes:
        """Return the bytes before the change."""
        before = data[: self.offset]
        after = data[self.offset :]
        if self.kind == "inserted byte":
            return before + after[1:]
        if self.kind == "lost byte":
            return before + bytes([self.value]) + after
        return before + bytes([after[0] ^ 1 << self.value]) + after[1:]


def find_changes(
    frame: Frame, data: bytes, kinds: Iterable[str] = KINDS, *, offsets: Sequence[int] | None = None
) -> list[FrameChange]:
    """Return every single change that would explain the damage, of the likeliest kind.

    Undoing such a change gives one valid and plausible frame of this type.

    Args:
        offsets: the bytes at which changes are tried; by default all.
    """
    engine = get_codec(frame)
    for kind in kinds if data else ():
        longer, values = KINDS[kind]
        size = len(data) - longer
        fits = engine.size in (None, size) and max(engine.prefix, default=-1) < size
        if (
            fits
            and 0 < size <= _most(engine, values)
            and (matching := list(_found(kind, values, data, size, engine, offsets)))
        ):
            return matching
    return []


def _most(engine: Codec, values: int) -> int:
    """Return the maximum length of a frame for which every candidate is tried."""
    is_compiled = isinstance(engine, CompiledCodec)
    if values > 8:
        if is_compiled and _deciding(engine.frame) <= HEADED:
            return SEARCHED
        return 0
    if is_compiled:
        return engine.frame.max_length
    return INTERPRETED


@functools.cache
def _deciding(frame: Frame) -> int:
    """Return the number of fields that decide the layout of a frame."""
    used = (formula for node in nodes(frame.tree) for formula in formulas(node))
    return len({ref.path for formula in used for ref in refs(formula)})


def _found(
    kind: str, values: int, data: bytes, size: int, engine: Codec, chosen: Sequence[int] | None
) -> Iterator[FrameChange]:
    places = np.arange(max(len(data), size))
    old = np.frombuffer(data, np.uint8)
    if kind == "inserted byte":
        places = places[
            np.diff(old, prepend=~old[:1]) != 0
        ]  # the first of a run of equal bytes represents them all
    if chosen is not None:
        places = places[np.isin(places, chosen)]
    offsets = np.repeat(places, values)
    if values == 1:
        numbers = old[places]
    else:
        numbers = np.tile(np.arange(values, dtype=np.uint8), len(places))
    if kind == "lost byte":
        is_new = numbers != old[offsets - 1]  # not the same byte again before an equal one
        is_new[offsets == 0] = True
        offsets = offsets[is_new]
        numbers = numbers[is_new]
    step = max(1, BLOCK // size)
    for first in range(0, len(offsets), step):
        part = slice(first, first + step)
        rows = _rows(kind, old, offsets[part], numbers[part], size)
        fits = np.ones(len(rows), np.bool_)
        for offset, (mask, value) in engine.prefix.items():
            fits &= rows[:, offset] & mask == value
        which = np.flatnonzero(fits)
        if len(which):
            survey = engine.survey(rows.reshape(-1), which * size)
        else:
            survey = None
        if survey is not None:
            right = which[(survey.status == VALID) & (survey.sizes == size)]
        else:
            right = which
        yield from (
            FrameChange(kind, int(offsets[first + one]), int(numbers[first + one]))
            for one in right.tolist()
        )


def _rows(
    kind: str,
    old: NDArray[np.uint8],
    offsets: NDArray[np.intp],
    numbers: NDArray[np.uint8],
    size: int,
) -> NDArray[np.uint8]:
    """Return the bytes with each change undone, one per row."""
    columns = count_up(size)
    places = offsets[:, None]
    if kind == "inserted byte":
        return old[columns + (columns >= places)]
    if kind == "lost byte":
        rows = old[np.minimum(columns - (columns > places), len(old) - 1)]
        rows[np.arange(len(rows)), offsets] = numbers
        return rows
    rows = np.tile(old, (len(offsets), 1))
    rows[np.arange(len(rows)), offsets] ^= np.uint8(1) << numbers
    return rows


def describe_damage(
    frame: Frame, data: bytes, values: Callable[[bytes], Mapping[str, FieldValue]]
) -> Iterator[str]:
    """Yield a sentence for each single change that would explain the damage.

    Args:
        values: returns the values of a frame by path.
    """
    matching = find_changes(frame, data)
    if len(matching) > TOLD:
        yield (f"one {matching[0].kind} would explain it, at any of {len(matching)} places")
        return
    before = values(data) if matching else {}
    for change in matching:
        explains = (
            f"{'one' if len(matching) == 1 else 'an' if change.kind[0] in 'aeiou' else 'a'}"
            f" {change.kind} would explain it"
        )
        yield f"{explains}: {_place(change, before, values(change.repair(data)))}"


def _place(
    change: FrameChange, before: Mapping[str, FieldValue], after: Mapping[str, FieldValue]
) -> str:
    kind, offset, value = change
    if kind == "inserted byte":
        return f"byte {offset}, 0x{value:02x}"
    path = next(
        (
            path
            for path, there in after.items()
            if there.holds(offset, value) or (kind == "lost byte" and there.covers(offset))
        ),
        "",
    )
    if kind == "lost byte":
        return f"0x{value:02x} before byte {offset}" + (f", in {path}" if path else "")
    values = [str(part[path]) for part in (before, after) if path in part]
    return f"byte {offset} bit {value}" + (
        f", {path} {', sent as '.join(values)}"
        if path and all(values)
        else f", {path}"
        if path
        else ""
    )
