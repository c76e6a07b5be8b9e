"""The engine of frames without layouts: construct parses one candidate at a time.

Such a struct has a part whose place no formula of header fields gives. `lidarspec show` names the
part and the reason.
"""

from __future__ import annotations

import io
from collections.abc import Iterable

import construct
import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.frames.arrays import repeated
from lidarspec.frames.frame_table import Records
from lidarspec.frames.layout import Sums
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.plausibility import plausibility
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
from lidarspec.spec.syntax import Mismatch


class PlainCodec(Codec):
    """A frame type that construct parses, one candidate at a time.

    `reason` says why it is not compiled.
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
        status = np.zeros(len(offsets), np.uint8)
        sizes = np.zeros(len(offsets), np.intp)
        errors: list[PluginError] = []
        if stops is None:
            ends = offsets + self.frame.room
        else:
            ends = np.minimum(offsets + self.frame.room, stops)
        for index, (offset, end) in enumerate(zip(offsets.tolist(), ends.tolist(), strict=True)):
            data = buffer[offset:end].tobytes()
            status[index], sizes[index] = self._judge(data, errors)
        return Frames(
            buffer,
            repeated(kind, len(offsets)),
            offsets,
            sizes,
            status=status,
            errors=tuple(errors),
        )

    def table(self, frames: Iterable[bytes]) -> Records:
        frames = list(frames)
        return Records(
            self.schema,
            [self.frame.prepared.parse(frame, _verify=False) for frame in frames],
            frames,
        )

    def _judge(self, data: bytes, errors: list[PluginError]) -> tuple[int, int]:
        stream = io.BytesIO(data)
        try:
            parsed = self.frame.prepared.parse_stream(stream)
            size = stream.tell()
            if not size:
                return LENGTH, 0
        except Mismatch as mismatch:
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
            plausibility(self.frame, Records(self.schema, [parsed], [data[:size]]), errors)[0]
        ), size
