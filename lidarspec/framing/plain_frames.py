"""The codec of frames without layouts: construct parses one candidate at a time."""

from __future__ import annotations

import io
from collections.abc import Iterable

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
from lidarspec.spec.description import Frame
from lidarspec.spec.syntax import MismatchError


class PlainCodec(Codec):
    """The codec of a frame type that construct parses.

    Attributes:
        reason: the reason why the frame type has no layouts.
    """

    is_compiled = False

    def __init__(self, frame: Frame, reason: str = "") -> None:
        super().__init__(frame)
        self.reason = reason

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
        ends = np.minimum(
            offsets + self.frame.max_struct_bytes, len(buffer) if stops is None else stops
        )
        status = np.full(len(offsets), VALID, np.uint8)
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
            return (LENGTH if len(data) >= self.frame.max_struct_bytes else SHORT), 0
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
