"""The codec of frames with a wire form, such as text or escaped bytes.

The wire form finds the end of each candidate and decodes it to the bytes of the struct, one
candidate at a time. The structs are then checked together.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import PluginError, SpecError
from lidarspec.frames.arrays import repeat
from lidarspec.frames.frame_table import CompiledTable, LayoutRows, Table
from lidarspec.frames.layout import LayoutRefusal, Sums, gather_rows, sort_constants
from lidarspec.frames.wire_coder import FormCoder
from lidarspec.framing.frame_codec import Codec
from lidarspec.framing.results import CHECKSUM, LENGTH, PLUGIN, SHORT, VALID, Frames
from lidarspec.spec.description import Frame
from lidarspec.spec.wire_forms import NO_END, NO_FRAME, BulkEnds

#: The maximum number of candidates of a piece that are stored with their structs.
MAX_REMEMBERED = 64


class TextCodec(Codec):
    """The codec of a frame type with a wire form.

    Raises:
        SpecError: if the offset of a field of the struct cannot be computed.
    """

    def __init__(self, frame: Frame, coder: FormCoder) -> None:
        super().__init__(frame)
        self._coder = coder
        #: The structs of the last frames, by the bytes of the frames, for making columns.
        self._found = dict[bytes, bytes]()
        self.size = None
        self.prefix = {offset: (0xFF, byte) for offset, byte in coder.prefix.items()}
        self.marks = sort_constants(self.prefix)
        self._prefix_size = max(self.prefix, default=-1) + 1

    @property
    def _checked_constants(self) -> Mapping[int, tuple[int, int]]:
        return {}  # the prefix belongs to the text, not to the struct

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
        if stops is None:
            stops = np.full(len(offsets), len(buffer))
        stops = np.minimum(offsets + self.frame.max_length, stops)
        errors = list[PluginError]()
        sizes, is_failed = self._find_ends(buffer, offsets, stops, errors)
        number_needed = np.where(sizes == NO_END, self.frame.max_length, self._prefix_size)
        status = np.where(offsets + number_needed > stops, SHORT, LENGTH).astype(np.uint8)
        status[is_failed] = PLUGIN
        is_complete = (sizes > 0) & (status != SHORT)
        sizes[~is_complete] = 0
        frames = Frames(buffer, repeat(kind, len(offsets)), offsets, sizes, status=status)
        self._found = {}
        if is_complete.any():
            self._check_whole(frames, np.flatnonzero(is_complete).tolist(), status, errors, sums)
        frames.errors = tuple(errors)
        return frames

    def _find_ends(
        self,
        buffer: NDArray[np.uint8],
        offsets: NDArray[np.intp],
        stops: NDArray[np.intp],
        errors: list[PluginError],
    ) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Return the size of each frame, and whether the plugin failed for it.

        The size is `NO_END` or `NO_FRAME` for candidates without an end.
        """
        form = self._coder.form
        is_failed = np.zeros(len(offsets), np.bool_)
        if isinstance(form, BulkEnds):
            return form.find_ends(buffer, offsets, stops), is_failed
        sizes = np.full(len(offsets), NO_FRAME, np.intp)
        for index, (offset, stop) in enumerate(zip(offsets.tolist(), stops.tolist(), strict=True)):
            try:
                sizes[index] = self._coder.find_end(buffer[offset:stop].tobytes())
            except PluginError as error:
                errors.append(error)
                is_failed[index] = True
        return sizes, is_failed

    def _check_whole(
        self,
        frames: Frames,
        which: Sequence[int],
        status: NDArray[np.uint8],
        errors: list[PluginError],
        sums: Sums | None,
    ) -> None:
        """Check complete candidates; equal candidates are decoded once.

        Args:
            which: the indices of the candidates to check.
            status: the status of all candidates, which is updated.
        """
        decode = functools.lru_cache(MAX_REMEMBERED)(functools.partial(self._decode, errors=errors))
        structs = dict[int, bytes]()
        for index in which:
            status[index], struct = decode(frames.data(index))
            if struct is not None:
                structs[index] = struct
        owners = np.array(list(structs), np.intp)
        groups, refused = self._group_by_layout(list(structs.values()))
        for group in groups:
            check = self.make_checker(group.layout)
            status[owners[group.where]] = check(group.rows, errors, sums)
        for refusal, where in refused:
            if refusal.error is not None:
                errors.append(refusal.error)
                status[owners[where]] = PLUGIN
        self._found = {
            frames.data(index): struct
            for index, struct in structs.items()
            if status[index] == VALID
        }

    def _decode(self, data: bytes, errors: list[PluginError]) -> tuple[int, bytes | None]:
        """Decode a complete candidate; return its status and the bytes of its struct.

        If decoding fails, there is no struct (None). Otherwise, the caller has to check the struct,
        and the status is not final.
        """
        try:
            decoded = self._coder.decode_whole(data)
            if decoded.problem is None:
                return LENGTH, decoded.struct
            if decoded.problem.is_checksum:
                return CHECKSUM, None
            refusal = self._coder.find_refusal(decoded.struct)
        except Exception as error:
            if isinstance(error, SpecError) and not isinstance(error, PluginError):
                raise
            errors.append(PluginError.of(error, "struct"))
            return PLUGIN, None
        if refusal is not None and refusal.error is not None:
            errors.append(refusal.error)
            return PLUGIN, None
        return LENGTH, None

    def _group_by_layout(
        self, structs: Sequence[bytes]
    ) -> tuple[list[LayoutRows], list[tuple[LayoutRefusal, NDArray[np.intp]]]]:
        """Group structs by layout; return the groups, and the structs without a layout.

        Args:
            structs: the bytes of each struct.
        """
        sizes = np.array([len(struct) for struct in structs], np.intp)
        starts = np.cumsum(sizes) - sizes
        joined = np.frombuffer(b"".join(structs), np.uint8)
        groups = list[LayoutRows]()
        refused = list[tuple[LayoutRefusal, NDArray[np.intp]]]()
        for layout, which in self._coder.tree.classify(joined, starts, starts + sizes):
            if isinstance(layout, LayoutRefusal):
                refused.append((layout, which))
                continue
            fitting = which[sizes[which] == layout.size]
            groups.append(
                LayoutRows(layout, fitting, gather_rows(joined, starts[fitting], layout.size))
            )
        return groups, refused

    def table(self, frames: Iterable[bytes]) -> Table:
        found = self._found
        return self.table_of_structs(
            found[frame] if frame in found else self._coder.decode_whole(frame).struct
            for frame in frames
        )

    def table_of_structs(self, structs: Iterable[bytes]) -> Table:
        return CompiledTable(self.schema, self._group_by_layout(list(structs))[0])
