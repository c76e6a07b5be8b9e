"""The codec of frames without layouts: construct parses one candidate at a time.

In the struct of such a frame, the offset of a part does not follow from header fields. `lidarspec
show` prints the part and the reason.

If the part follows a text up to a terminator, the terminators of all candidates are found at once.
Candidates without a terminator, or with a wrong constant after it, are then rejected without
parsing them.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import construct
import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.frames.arrays import repeat
from lidarspec.frames.frame_table import ParsedTable
from lidarspec.frames.layout import Sums
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.plausibility import check_plausibility
from lidarspec.framing.results import (
    CHECKSUM,
    CONSTANT,
    IMPLAUSIBLE,
    LENGTH,
    PLUGIN,
    SHORT,
    VALID,
    Frames,
)
from lidarspec.spec import tree
from lidarspec.spec.description import Frame
from lidarspec.spec.syntax import MismatchError
from lidarspec.spec.wire_forms import find_next_offsets


@dataclass(frozen=True)
class _Text:
    """The first text up to a terminator in a struct.

    Attributes:
        begin: the offset of the text in a frame.
        terminator: the byte that ends the text.
        following: the constant bytes after the text that are checked first, by their distance from
            the terminator.
    """

    begin: int
    terminator: int
    following: Mapping[int, int]

    def check(
        self, buffer: NDArray[np.uint8], offsets: NDArray[np.intp], ends: NDArray[np.intp]
    ) -> NDArray[np.uint8]:
        """Check candidates by the terminator of the text, and return their status, (n,).

        The status is `SHORT` without a terminator, `CONSTANT` for a wrong constant after it, else
        `VALID`.

        Args:
            buffer: the bytes.
            offsets: the offset of each candidate.
            ends: the offset at which the bytes of each candidate end.
        """
        terminators = np.flatnonzero(buffer == self.terminator)
        places = find_next_offsets(terminators, offsets + self.begin, len(buffer))
        status = np.where(places < ends, VALID, SHORT).astype(np.uint8)
        for distance, byte in self.following.items():
            has_byte = np.flatnonzero(places + distance < ends)
            is_wrong = buffer[places[has_byte] + distance] != byte
            status[has_byte[is_wrong]] = CONSTANT
        return status


def _find_text(root: tree.Node) -> _Text | None:
    """Return the text directly after the fields with known offsets.

    Returns None if there is no such text, or if another part is checked before its terminator.
    """
    begin = 0
    terminator = b""
    distance = 1
    following = dict[int, int]()
    for node in _iter_fields(root):
        if isinstance(node, tree.Opaque) and node.terminator and not terminator:
            terminator = node.terminator
            begin = distance - 1
            distance = 1
            following.clear()
            continue
        if isinstance(node, tree.Blob) and isinstance(node.size, int):
            size = node.size
            following |= {distance + index: byte for index, byte in enumerate(node.const or b"")}
        elif isinstance(node, tree.Number) and _is_free(node.info):
            size = node.size
        else:
            break
        distance += size
    if not terminator:
        return None
    return _Text(begin, terminator[0], following)


def _iter_fields(node: tree.Node) -> Iterator[tree.Node]:
    """Yield the fields of a struct in order, and each checksum after its fields."""
    if isinstance(node, tree.Struct):
        for member in node.members:
            yield from _iter_fields(member)
    elif isinstance(node, tree.Sealed):
        yield from _iter_fields(node.body)
        yield node
    else:
        yield node


def _is_free(info: tree.FieldInfo) -> bool:
    """Return whether a number may have any value."""
    return info.const is None and info.allowed is None and not info.held


class PlainCodec(Codec):
    """The codec of a frame type that construct parses.

    Attributes:
        reason: the reason why the frame type has no layouts.
    """

    is_compiled = False

    def __init__(self, frame: Frame, reason: str = "") -> None:
        super().__init__(frame)
        self.reason = reason
        self._text = _find_text(frame.tree)

    def survey(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp] | None = None,
        *,
        kind: int = 0,
        gathered: bool = True,
        sums: Sums | None = None,
    ) -> Frames:
        ends = np.minimum(offsets + self.frame.room, len(buffer) if stops is None else stops)
        status = np.full(len(offsets), VALID, np.uint8)
        if self._text is not None:
            status = self._text.check(buffer, offsets, ends)
            is_whole = ends - offsets >= self.frame.room
            status[is_whole & (status == SHORT)] = LENGTH
        if self.frame.endless is not None:
            # The frame is the rest of a datagram: a stream or a longer datagram has no such frame.
            status[np.full(len(ends), True) if stops is None else ends < stops] = LENGTH
        sizes = np.zeros(len(offsets), np.intp)
        errors: list[PluginError] = []
        for index in np.flatnonzero(status == VALID).tolist():
            data = buffer[offsets[index] : ends[index]].tobytes()
            status[index], sizes[index] = self._check(data, errors)
        return Frames(
            buffer,
            repeat(kind, len(offsets)),
            offsets,
            sizes,
            status=status,
            errors=tuple(errors),
        )

    def table(self, frames: Iterable[bytes]) -> ParsedTable:
        frames = list(frames)
        return ParsedTable(
            self.schema,
            [self.frame.prepared.parse(frame, _verify=False) for frame in frames],
            frames,
        )

    def _check(self, data: bytes, errors: list[PluginError]) -> tuple[int, int]:
        stream = io.BytesIO(data)
        try:
            parsed = self.frame.prepared.parse_stream(stream)
            size = stream.tell()
            if not size:
                return LENGTH, 0
        except MismatchError as mismatch:
            return {"checksum": CHECKSUM, "length": LENGTH, "value": IMPLAUSIBLE}.get(
                mismatch.reason, CONSTANT
            ), 0
        except construct.CheckError:
            return IMPLAUSIBLE, 0
        except construct.StreamError:
            return (LENGTH if len(data) >= self.frame.room else SHORT), 0
        except SpecError:
            raise
        except construct.ConstructError:
            return LENGTH, 0
        except Exception as error:
            errors.append(PluginError.of(error, "struct"))
            return PLUGIN, 0
        if self.frame.plausible is None:
            return VALID, size
        return int(
            check_plausibility(
                self.frame, ParsedTable(self.schema, [parsed], [data[:size]]), errors
            )[0]
        ), size
