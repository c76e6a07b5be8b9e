"""The engine of frames with a wire form: text, or escaped bytes.

The form finds where candidates end, and decodes them to the bytes of the struct, one at a time.
These are grouped by layout and judged in bulk, as binary frames are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.frames.arrays import repeated
from lidarspec.frames.frame_table import Group, Rows, Table
from lidarspec.frames.layout import Refused, Sums, marks, rows_at
from lidarspec.frames.wire_coder import FormCoder
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.results import CHECKSUM, LENGTH, PLUGIN, SHORT, VALID, Frames
from lidarspec.spec.description import Frame
from lidarspec.spec.wire_forms import NO_END


class TextCodec(Codec):
    """A frame type with a wire form, whose structs are judged by their layouts.

    Raises:
        SpecError: for a struct whose fields have no computable place.
    """

    def __init__(self, frame: Frame, coder: FormCoder) -> None:
        super().__init__(frame)
        self._coder = coder
        #: Structs of the frames that were found last, since these become columns next.
        self._found = dict[bytes, bytes]()
        self.size = None
        self.prefix = {offset: (0xFF, byte) for offset, byte in coder.prefix.items()}
        self.marks = marks(self.prefix)

    @property
    def _checked_constants(self) -> Mapping[int, tuple[int, int]]:
        return {}  # the prefix is one of the text, not of the struct

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
        status = np.full(len(offsets), LENGTH, np.uint8)
        sizes = np.zeros(len(offsets), np.intp)
        errors = list[PluginError]()
        structs = dict[int, bytes]()
        limits = offsets + self.frame.max_length
        ends = np.minimum(limits, len(buffer) if stops is None else stops)
        for index, (offset, end) in enumerate(zip(offsets.tolist(), ends.tolist(), strict=True)):
            data = buffer[offset:end].tobytes()
            try:
                status[index], sizes[index], struct = self._decode(data, errors)
            except SpecError:
                raise
            except Exception as error:
                errors.append(PluginError.of(error, "struct"))
                status[index] = PLUGIN
                continue
            if struct is not None:
                structs[index] = struct
        which = np.array(list(structs), np.intp)
        groups, refused = self._group(list(structs.values()))
        for group in groups:
            judge = self.judge(group.layout)
            status[which[group.where]] = judge(group.rows, errors, sums)
        for refusal, where in refused:
            if refusal.error is not None:
                errors.append(refusal.error)
                status[which[where]] = PLUGIN
        self._found = {
            buffer[offsets[index] : offsets[index] + sizes[index]].tobytes(): struct
            for index, struct in structs.items()
            if status[index] == VALID
        }
        kinds = repeated(kind, len(offsets))
        return Frames(buffer, kinds, offsets, sizes, status=status, errors=tuple(errors))

    def _decode(self, data: bytes, errors: list[PluginError]) -> tuple[int, int, bytes | None]:
        """Return the status, the size and the struct of a candidate.

        If there is a struct, it has to be judged; its status replaces the one returned.

        Args:
            data: the bytes from the candidate on, at most as many as the longest frame has.
        """
        if len(data) <= max(self.prefix, default=-1):
            return SHORT, 0, None  # it may be no candidate at all
        size = self._coder.form.find_end(data)
        if size == NO_END and len(data) < self.frame.max_length:
            return SHORT, 0, None
        if size <= 0:
            return LENGTH, 0, None
        decoded = self._coder.decode_whole(data[:size])
        if decoded.problem is None:
            return LENGTH, size, decoded.struct
        if decoded.problem.is_checksum:
            return CHECKSUM, size, None
        refusal = self._coder.refusal(decoded.struct)
        if refusal is not None and refusal.error is not None:
            errors.append(refusal.error)
            return PLUGIN, size, None
        return LENGTH, size, None

    def _group(
        self, structs: Sequence[bytes]
    ) -> tuple[list[Group], list[tuple[Refused, NDArray[np.intp]]]]:
        """Return structs by layout, and the indices of refused structs by refusal.

        Structs with no layout of their size are left out.
        """
        sizes = np.array([len(struct) for struct in structs], np.intp)
        starts = np.cumsum(sizes) - sizes
        joined = np.frombuffer(b"".join(structs), np.uint8)
        groups = list[Group]()
        refused = list[tuple[Refused, NDArray[np.intp]]]()
        for layout, which in self._coder.tree.classify(joined, starts, starts + sizes):
            if isinstance(layout, Refused):
                refused.append((layout, which))
                continue
            fitting = which[sizes[which] == layout.size]
            groups.append(Group(layout, fitting, rows_at(joined, starts[fitting], layout.size)))
        return groups, refused

    def table(self, frames: Iterable[bytes]) -> Table:
        found = self._found
        return self.table_of_structs(
            found[frame] if frame in found else self._coder.decode_whole(frame).struct
            for frame in frames
        )

    def table_of_structs(self, structs: Iterable[bytes]) -> Table:
        return Rows(self.schema, self._group(list(structs))[0])
