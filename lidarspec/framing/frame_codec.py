"""The interface of the engines of frame types: judge candidates, and make columns of frames.

`lidarspec.framing.frame_engine` has the engine of binary frames, `lidarspec.framing.text_frames`
the engine of frames with a wire form, and `lidarspec.framing.plain_frames` the engine of frames
without layouts.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.frame_table import Table
from lidarspec.frames.layout import Layout, Sums, sort_constants
from lidarspec.frames.layout_tree import find_prefix
from lidarspec.frames.schema import make_schema
from lidarspec.framing.plausibility import CandidateChecker, StructConditions
from lidarspec.framing.results import Frames, Status
from lidarspec.spec.description import Frame
from lidarspec.spec.syntax import fixed_size


class Codec:
    """The engine of one frame type.

    Attributes:
        prefix: the constants at the start: offset -> (mask, value).
        marks: the same constants, whole bytes first, which exclude the most candidates.
        size: the size of all frames of the type, bytes; None if sizes differ.
        layout: the layout of all frames; None if layouts differ or construct parses the frames.
        is_compiled: whether the layouts can be computed; else construct parses each frame.
    """

    layout: Layout | None = None
    is_compiled = True

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self.schema = make_schema(frame.tree)
        self.prefix = find_prefix(frame.tree, frame.room)
        self.marks = sort_constants(self.prefix)
        self.size = fixed_size(frame.prepared) or None
        self._conditions: StructConditions | None = None

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
        """Return the candidates at some offsets, each with its layout and its status.

        Args:
            buffer: the bytes.
            offsets: offsets at which the prefix matches.
            stops: the offset at which the bytes of each candidate end, if no more bytes follow
                there; by default the end of the buffer.
            kind: the index of this type.
            gathered: whether to copy the bytes of candidates to `Frames.rows`.
            sums: computes checksums; by default the declared algorithms.
        """
        raise NotImplementedError

    def survey_rows(
        self, rows: NDArray[np.uint8], *, sums: Sums | None = None
    ) -> tuple[Layout, Status, tuple[PluginError, ...]] | None:
        """Return the common layout, the status and the plugin errors of candidates.

        Returns None if the candidates do not have a common layout.

        Args:
            rows: the candidates, all of one size, (n, size).
        """
        return None

    def table(self, frames: Iterable[bytes]) -> Table:
        """Return frames that are known to be of this type as columns."""
        raise NotImplementedError

    def table_of_structs(self, structs: Iterable[bytes]) -> Table:
        """Return frames of this type as columns, given the bytes of their structs."""
        return self.table(structs)

    def gather(self, frames: Frames) -> Table:
        """Return accepted frames of this type as columns."""
        return self.table(map(frames.data, range(len(frames))))

    @property
    def _checked_constants(self) -> Mapping[int, tuple[int, int]]:
        """The constants that candidates are known to have before they are judged."""
        return self.prefix

    def make_checker(self, layout: Layout) -> CandidateChecker:
        """Return the checker of candidates that have a layout and its first constants."""
        judge = layout.notes.get(CandidateChecker)
        if judge is None:
            self._conditions = self._conditions or StructConditions(
                self.frame.plausible, self.schema, layout
            )
            tests = self._conditions.make_struct_conditions(layout), self._conditions.checks(layout)
            judge = layout.notes[CandidateChecker] = CandidateChecker(
                self.frame, self.schema, layout, self._checked_constants, *tests
            )
        return judge
