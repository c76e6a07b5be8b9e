"""`Codec`: the interface for checking candidates and making columns of one frame type."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError
from lidarspec.frames.frame_table import Table
from lidarspec.frames.layout import Layout, Sums, sort_constants
from lidarspec.frames.layout_tree import find_fixed_constants
from lidarspec.frames.schema import make_schema
from lidarspec.framing.plausibility import CandidateChecker, StructConditions
from lidarspec.framing.results import Frames, Status
from lidarspec.spec.description import Frame
from lidarspec.spec.syntax import fixed_size


class Codec:
    """Checks candidates of one frame type, and makes tables of its frames.

    Attributes:
        prefix: the constants that all frames begin with, as (mask, value) by offset.
        marks: the constants in `prefix` as a list, first the bytes in which all bits are constant.
        size: the size of all frames of the type in bytes; None if sizes differ.
        layout: the layout of all frames; None if layouts differ or construct parses the frames.
        is_compiled: whether the frames have layouts.
    """

    layout: Layout | None = None
    is_compiled = True

    def __init__(self, frame: Frame) -> None:
        self.frame = frame
        self.schema = make_schema(frame.tree)
        self.prefix = find_fixed_constants(frame.tree, frame.max_struct_bytes)
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
        """Check the candidates at these offsets; return them with layout and status.

        Args:
            offsets: the offsets, at which the prefix has to match.
            stops: the end offset of each candidate; None if more bytes may follow.
            gathered: whether the bytes of the candidates are copied to `Frames.rows`.
        """
        raise NotImplementedError

    def survey_rows(
        self, rows: NDArray[np.uint8], *, sums: Sums | None = None
    ) -> tuple[Layout, Status, tuple[PluginError, ...]] | None:
        """Check candidates of one size; None if they have no common layout.

        Args:
            rows: the candidates, (n, size).

        Returns:
            The common layout, the status of each candidate, and the errors of the plugin.
        """
        return None

    def table(self, frames: Iterable[bytes]) -> Table:
        """Return the columns of valid frames of this type, given the bytes of each frame."""
        raise NotImplementedError

    def table_of_structs(self, structs: Iterable[bytes]) -> Table:
        """Return the columns of valid frames, given the bytes of the struct of each frame."""
        return self.table(structs)

    def gather(self, frames: Frames) -> Table:
        """Return the columns of accepted frames of this type, given as `Frames`."""
        return self.table(map(frames.data, range(len(frames))))

    @property
    def _checked_constants(self) -> Mapping[int, tuple[int, int]]:
        """The constants that the search has compared before it calls `survey`."""
        return self.prefix

    def make_checker(self, layout: Layout) -> CandidateChecker:
        """Return the checker for candidates of one layout."""
        checker = layout.notes.get(CandidateChecker)
        if checker is None:
            self._conditions = self._conditions or StructConditions(
                self.frame.plausible, self.schema, layout
            )
            struct_checks = self._conditions.make_struct_conditions(layout)
            plausibility_checks = self._conditions.make_checks(layout)
            checker = layout.notes[CandidateChecker] = CandidateChecker(
                self.frame,
                self.schema,
                layout,
                self._checked_constants,
                struct_checks,
                plausibility_checks,
            )
        return checker
