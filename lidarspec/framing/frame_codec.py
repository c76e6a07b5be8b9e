"""The interface of the engines of frame types: which candidates are frames, and frames as columns.

`lidarspec.framing.frame_engine` has the engines of binary frames, `lidarspec.framing.text_frames`
that of frames with a wire form.
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
        marks: these, whole bytes first, which tell the most.
        size: that of all its frames, None where they differ.
        layout: that of all its frames, None where they differ or construct parses them.
        is_compiled: whether its layouts can be computed; else construct parses each frame.
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
        """Return the candidates at these offsets, each with its layout and whether it is a frame.

        Args:
            offsets: those whose prefix does not match must be left out.
            stops: where their bytes end, and no more will come; by default with those of the
                buffer.
            kind: index of this type.
            gathered: whether their bytes are wanted too, as `Frames.rows`.
            sums: what computes checksums; by default their algorithms.
        """
        raise NotImplementedError

    def survey_rows(
        self, rows: NDArray[np.uint8], *, sums: Sums | None = None
    ) -> tuple[Layout, Status, tuple[PluginError, ...]] | None:
        """Return the common layout of candidates of one size, and their status.

        The candidates are given as rows. Failures of the plugin are returned as well. Returns None
        if there is no common layout.
        """
        return None

    def table(self, frames: Iterable[bytes]) -> Table:
        """Frames known to be of this type, as columns."""
        raise NotImplementedError

    def table_of_structs(self, structs: Iterable[bytes]) -> Table:
        """Frames of this type, given as the bytes of their structs, as columns."""
        return self.table(structs)

    def gather(self, frames: Frames) -> Table:
        """Frames that were found, all of this type, as columns."""
        return self.table(map(frames.data, range(len(frames))))

    @property
    def _checked_constants(self) -> Mapping[int, tuple[int, int]]:
        """The constants that candidates are known to have before they are judged."""
        return self.prefix

    def make_checker(self, layout: Layout) -> CandidateChecker:
        """Return the judge of candidates of a layout that have the constants at the start."""
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
