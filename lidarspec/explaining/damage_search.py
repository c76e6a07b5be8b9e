"""Find the single change of a frame that explains its damage.

`find_changes` flips each bit, removes each byte, and inserts each byte value at each offset. The
parser of the frame type decides which of the results are valid frames. If the checksum is short,
several results may be valid by chance.
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

#: The total size of the candidates that are checked together, bytes.
BATCH_BYTES = 1 << 20
#: The maximum size of a frame that is searched if its type is not compiled, so that construct
#: parses each candidate.
MAX_PLAIN_FRAME_BYTES = 128
#: The maximum size of a frame that is searched for lost bytes, with 256 candidates for each offset.
MAX_LOST_BYTE_FRAME_BYTES = 512
#: Lost bytes are searched only if the layout of the frame depends on at most this number of fields.
#: With more fields, nearly each candidate has a different layout.
MAX_LAYOUT_FIELDS = 4
#: The maximum number of changes that are described separately.
MAX_DESCRIBED_CHANGES = 3
#: For each kind of damage, the likeliest first: the number of bytes that the damage adds to the
#: frame, and the number of possible repairs at each offset.
KINDS = {"flipped bit": (0, 8), "inserted byte": (1, 1), "lost byte": (-1, 256)}


class FrameChange(NamedTuple):
    """A possible change of a frame.

    Attributes:
        kind: "flipped bit", "inserted byte" or "lost byte".
        offset: the offset of the changed or inserted byte in the damaged frame. For a lost byte,
            the offset of the byte that follows it.
        value: the inserted or lost byte, or the index of the flipped bit, 0 for the lowest bit.
    """

    kind: str
    offset: int
    value: int

    def repair(self, data: bytes) -> bytes:
        """Return the damaged bytes with the change undone."""
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
    """Return the changes of a frame that each explain its damage alone.

    A change explains the damage if a valid frame results when the change is undone.

    Args:
        data: the damaged frame.
        kinds: the kinds of change, tried in order until one kind explains the damage.
        offsets: the offsets at which changes are tried; None for all.
    """
    if not data:
        return []
    codec = get_codec(frame)
    for kind in kinds:
        added_bytes, choices = KINDS[kind]
        size = len(data) - added_bytes
        if size == 0 or codec.size not in (None, size):
            continue
        if size <= max(codec.prefix, default=-1) or size > _find_max_size(codec, kind):
            continue
        matching = list(_iter_changes(kind, choices, data, size, codec, offsets))
        if matching:
            return matching
    return []


def _find_max_size(codec: Codec, kind: str) -> int:
    """Return the maximum length of a frame that is searched for changes, in bytes."""
    is_compiled = isinstance(codec, CompiledCodec)
    if kind == "lost byte":
        if is_compiled and _count_layout_fields(codec.frame) <= MAX_LAYOUT_FIELDS:
            return MAX_LOST_BYTE_FRAME_BYTES
        return 0
    if is_compiled:
        return codec.frame.max_length
    return MAX_PLAIN_FRAME_BYTES


@functools.cache
def _count_layout_fields(frame: Frame) -> int:
    """Return the number of fields that determine the layout of a frame."""
    used = (formula for node in nodes(frame.tree) for formula in formulas(node))
    return len({ref.path for formula in used for ref in refs(formula)})


def _iter_changes(
    kind: str, choices: int, data: bytes, size: int, codec: Codec, offsets: Sequence[int] | None
) -> Iterator[FrameChange]:
    """Yield the changes of one kind that explain the damage.

    Args:
        choices: number of changes of this kind to try at each offset.
        size: length of the undamaged frame.
        codec: the parser of the frame type.
        offsets: the offsets at which changes are tried; None for all.
    """
    # A byte may be lost at the end too, which is one more offset than the damaged frame has.
    tried_offsets = np.arange(max(len(data), size))
    damaged = np.frombuffer(data, np.uint8)
    if kind == "inserted byte":
        # Removing any byte of a run of equal bytes gives the same result: try only the first.
        is_first = np.ones(len(damaged), np.bool_)
        is_first[1:] = damaged[1:] != damaged[:-1]
        tried_offsets = tried_offsets[is_first]
    if offsets is not None:
        tried_offsets = tried_offsets[np.isin(tried_offsets, offsets)]
    change_offsets = np.repeat(tried_offsets, choices)
    if kind == "inserted byte":
        values = damaged[tried_offsets]
    else:
        values = np.tile(np.arange(choices, dtype=np.uint8), len(tried_offsets))
    if kind == "lost byte":
        # Inserting a byte before or after an equal byte gives the same result: try only before.
        is_new = values != damaged[change_offsets - 1]
        is_new[change_offsets == 0] = True  # no byte precedes
        change_offsets = change_offsets[is_new]
        values = values[is_new]
    step = max(1, BATCH_BYTES // size)
    for first in range(0, len(change_offsets), step):
        part = slice(first, first + step)
        rows = _undo_changes(kind, damaged, change_offsets[part], values[part], size)
        fits = np.ones(len(rows), np.bool_)
        for offset, (mask, constant) in codec.prefix.items():
            fits &= rows[:, offset] & mask == constant
        which = np.flatnonzero(fits)
        if len(which):
            survey = codec.survey(rows.reshape(-1), which * size)
            which = which[(survey.status == VALID) & (survey.sizes == size)]
        for index in which.tolist():
            yield FrameChange(kind, int(change_offsets[first + index]), int(values[first + index]))


def _undo_changes(
    kind: str,
    damaged: NDArray[np.uint8],
    offsets: NDArray[np.intp],
    values: NDArray[np.uint8],
    size: int,
) -> NDArray[np.uint8]:
    """Return the damaged frame with each change undone, (number of changes, size)."""
    columns = count_up(size)
    change_columns = offsets[:, None]
    indices = np.arange(len(offsets))
    if kind == "inserted byte":
        # Bytes from the change on are one place later in the damaged frame.
        return damaged[columns + (columns >= change_columns)]
    if kind == "lost byte":
        # Bytes after the change are one place earlier in the damaged frame. The limit of the
        # index matters only for a byte lost at the end, which is replaced below.
        rows = damaged[np.minimum(columns - (columns > change_columns), len(damaged) - 1)]
        rows[indices, offsets] = values
        return rows
    rows = np.tile(damaged, (len(offsets), 1))
    rows[indices, offsets] ^= np.uint8(1) << values
    return rows


def describe_damage(
    frame: Frame, data: bytes, read_values: Callable[[bytes], Mapping[str, FieldValue]]
) -> Iterator[str]:
    """Yield a sentence for each single change that explains the damage.

    Args:
        read_values: a function that returns the values of the fields of a frame, by path.
    """
    matching = find_changes(frame, data)
    if len(matching) > MAX_DESCRIBED_CHANGES:
        count = len({change.offset for change in matching})
        possible = "1 offset is possible" if count == 1 else f"{count} offsets are possible"
        yield f"one {matching[0].kind} explains the damage; {possible}"
        return
    before = read_values(data) if matching else {}
    for change in matching:
        if len(matching) == 1:
            article = "one"
        elif change.kind == "inserted byte":
            article = "an"
        else:
            article = "a"
        description = _describe_change(change, before, read_values(change.repair(data)))
        yield f"{article} {change.kind} explains the damage: {description}"


def _describe_change(
    change: FrameChange, before: Mapping[str, FieldValue], after: Mapping[str, FieldValue]
) -> str:
    """Describe where a change is, and the field that it affects.

    Args:
        before: the values of the fields of the damaged frame, by path.
    """
    kind, offset, value = change
    if kind == "inserted byte":
        return f"byte {offset}, 0x{value:02x}"
    if kind == "lost byte":
        text = f"0x{value:02x} before byte {offset}"
        for path, field in after.items():
            if field.covers_byte(offset):
                return f"{text}, in {path}"
        return text
    text = f"byte {offset} bit {value}"
    for path, field in after.items():
        if field.contains_bit(offset, value):
            texts = [str(values[path]) for values in (before, after) if path in values]
            if all(texts):
                return f"{text}, {path} {', sent as '.join(texts)}"
            return f"{text}, {path}"
    return text
