"""Make frames from the physical values of some fields.

A `sweep` returns such values. Constants and checksums are filled in; all other fields are 0. Unlike
`build`, `FrameMaker` makes many frames at once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import SpecError
from lidarspec.frames.encode import find_kind, set_count
from lidarspec.frames.frame_table import CompiledTable, LayoutRows
from lidarspec.frames.layout import Layout, Leaf
from lidarspec.frames.layout_tree import InvalidLengthError, UnknownSelectorError, find_layout
from lidarspec.frames.schema import make_schema, without_indices
from lidarspec.frames.wire_coder import Coder, frame_coder
from lidarspec.framing.frame_engine import get_codec
from lidarspec.framing.plain_frames import PlainCodec
from lidarspec.sensor_operations import Sensor
from lidarspec.spec.description import Frame
from lidarspec.spec.enum_values import find_code
from lidarspec.spec.syntax import get_member
from lidarspec.spec.tree import Formula, Kind, Node, refs

Values = Mapping[str, Any]


class FrameMaker:
    """Makes frames of one type of a sensor, and caches their layouts.

    Raises:
        SpecError: if only construct can build the frame type.
    """

    def __init__(self, sensor: Sensor, frame: str) -> None:
        engine = get_codec(sensor.frames[frame])
        if isinstance(engine, PlainCodec):
            raise SpecError(
                "cannot be simulated, because lidarspec cannot compile this frame type:"
                f" {engine.reason}",
                path=frame,
                sensor=sensor.id,
            )
        if sensor.frames[frame].data:
            others = sensor.data_frames
        else:
            others = ()
        elsewhere = {
            path for other in others for path in get_codec(sensor.frames[other]).schema.fields
        }
        self.engine = engine
        self._coder: Coder | None = frame_coder(engine.frame)
        self._set_up(
            sensor.id, frame, engine.frame.tree, engine.frame.max_struct_bytes, {}, elsewhere
        )

    @classmethod
    def of_struct(cls, sensor: str, frame: Frame) -> FrameMaker:
        """Return a maker for a struct that is not a frame type of the sensor.

        Args:
            sensor: the id of the sensor, for errors.
        """
        return cls._of_parts(sensor, "", frame.tree, frame.max_struct_bytes, {})

    @classmethod
    def _of_parts(
        cls, sensor: str, place: str, root: Node, limit: int, given: Mapping[str, int]
    ) -> FrameMaker:
        """Return a maker for parts of one kind.

        Args:
            sensor: id of the sensor, for messages.
            place: path of the parts, for messages.
            limit: maximum length of a frame, in bytes.
            given: raw values, by path, of those fields of the frame that the parts depend on.
        """
        maker = cls.__new__(cls)
        maker._coder = None  # only whole frames have a wire form
        maker._set_up(sensor, place, root, limit, given, set())
        return maker

    def _set_up(
        self,
        sensor: str,
        place: str,
        root: Node,
        limit: int,
        given: Mapping[str, int],
        elsewhere: set[str],
    ) -> None:
        self._sensor = sensor
        #: The name of the frame type, and for parts their path in it; "" for a struct.
        self._place = place
        self._root = root
        self._limit = limit
        self._given = given
        self._elsewhere = elsewhere
        self.schema = make_schema(root)
        formulas = {
            axis: [ref.path for ref in refs(count)]
            for axis, count in self.schema.arrays.items()
            if count is not None
        }
        self._counts = {
            axis: paths[0]
            for axis, paths in formulas.items()
            if paths and paths[0] in self.schema.fields
        }
        self._decoded = {
            path: info
            for path, info in self.schema.fields.items()
            if info.adapter is not None and info.kind == "bytes"
        }
        self._layouts: dict[tuple[int, ...], Layout] = {}
        self._layout_fields: list[str] = []
        self._makers: dict[tuple[Any, ...], FrameMaker] = {}

    def table(self, frames: Sequence[Values]) -> CompiledTable:
        """Return a table with one frame for each mapping of paths to physical values.

        The value of an enum may be its name. The value of an array of bytes may be bytes. The value
        of a part is a mapping of field paths to values.

        Raises:
            SpecError: if a value is given for a field that the frame does not have, or a value does
                not fit its field.
        """
        members: dict[int, tuple[Layout, list[int]]] = {}
        if self._decoded or self.schema.endings:
            frames = [self._encode_texts(values) for values in frames]
        for values in frames:
            self._check_numbers(values)
        counted = [self._with_counts(values) for values in frames] if self._counts else frames
        if self.schema.parts:
            filled = [self._with_parts(values) for values in counted]
        else:
            filled = [(values, {}) for values in counted]
        for index, (values, _) in enumerate(filled):
            layout = self._find_layout(values)
            members.setdefault(id(layout), (layout, []))[1].append(index)
        groups = [
            LayoutRows(
                layout,
                np.array(which, np.intp),
                self._make_rows(layout, [filled[i] for i in which]),
            )
            for layout, which in members.values()
        ]
        return CompiledTable(self.schema, groups)

    def frame(self, values: Values) -> bytes:
        """Return the bytes of one frame."""
        return self.make_frames(self.table([values]))[0]

    def make_frames(self, table: CompiledTable) -> list[bytes]:
        """Fill in constants and checksums; return the bytes of each frame as it is sent.

        If the frame type has a wire form (`Frame.wire`), the bytes are encoded in this form.

        Raises:
            SpecError: if the wire form cannot encode a value.
        """
        structs = complete_structs(table)
        if self._coder is None:
            return structs
        frames = list[bytes]()
        for struct in structs:
            data = self._coder.encode(struct)
            if data is None:
                raise SpecError(
                    f"wire={self.engine.frame.wire} of the frame cannot encode the simulated"
                    " values",
                    path="simulation",
                    sensor=self._sensor,
                )
            frames.append(data)
        return frames

    def _encode_texts(self, values: Values) -> Values:
        """Return values with encoded texts, and with the sizes of these texts."""
        result = dict(values)
        for path, info in self._decoded.items():
            value = result.get(path)
            if value is None:
                result.pop(path, None)
                continue
            if isinstance(value, bytes):
                continue
            assert info.adapter is not None
            try:
                result[path] = info.adapter.encode(value, info.bits // 8)
            except Exception as error:  # a function of the plugin may raise anything
                raise self._make_error(
                    path,
                    f"the simulated value {value!r} cannot be encoded:"
                    f" {type(error).__name__}: {error}",
                ) from error
        for path, ending in self.schema.endings.items():
            # A missing text is empty, and a missing number is 0, which has one byte.
            missing = b"\0" if ending.is_content else b""
            result[ending.size.path] = len(result.get(path, missing))
        return result

    def _check_numbers(self, values: Values) -> None:
        """Raise an error if the value of a field of numbers is not a number or an array."""
        for path, value in values.items():
            info = self.schema.fields.get(path)
            if info is None or isinstance(value, int | float | bytes):
                continue
            try:
                shape = np.asarray(find_code(info, value), np.float64).shape
            except (TypeError, ValueError):
                raise self._make_error(
                    path, f"the simulated value is {value!r:.60}, expected numbers"
                ) from None
            if value is None:
                raise self._make_error(path, "the simulated value is None, expected numbers")
            if len(shape) > len(info.axes):
                expected = f"at most {len(info.axes)} axes" if info.axes else "a single number"
                raise self._make_error(
                    path, f"the simulated values have the shape {shape}, expected {expected}"
                )

    def _check_lengths(self, leaf: Leaf, value: Any) -> None:
        """Raise an error if a value is an array whose lengths differ from those of its field."""
        if isinstance(value, int | float | bytes | str):
            return
        for axis, expected, length in zip(
            leaf.info.axes, leaf.shape, np.shape(value), strict=False
        ):
            if length not in (1, expected):
                raise self._make_error(
                    leaf.info.path,
                    f"{length} values are simulated, but {axis} has {expected} elements",
                )

    def _make_error(self, path: str, reason: str) -> SpecError:
        return SpecError(reason, path=f"{self._place}.{path}".strip("."), sensor=self._sensor)

    def _with_counts(self, values: Values) -> Values:
        """Return the values of a frame, completed by the counts of its arrays."""
        missing = [
            axis
            for axis, count_path in self._counts.items()
            if axis in values and count_path not in values
        ]
        counted = dict(values) if missing else values
        for axis in missing:
            self._fill_in(self.schema.arrays[axis], counted, len(values[axis]), axis)  # type: ignore[arg-type]  # a dict by now
        return counted

    def _with_parts(self, values: Values) -> tuple[Values, dict[str, bytes]]:
        """Return the values of a frame without parts, and the bytes of parts by path."""
        result = dict(values)
        parts_by_axis = dict[str, bytes]()
        for axis, node in self.schema.parts.items():
            parts = [dict(part) for part in result.pop(axis, ())]
            kinds = [find_kind(node, part) for part in parts]
            around = {ref.path: self._get_raw(result, ref.path) for ref in node.outer}
            makers = [self._get_maker(axis, kind, around) for kind in kinds]
            sizes = [
                maker._find_layout(maker._with_parts(maker._encode_texts(part))[0]).size
                for maker, part in zip(makers, parts, strict=True)
            ]
            for kind, maker, part, after in zip(
                kinds, makers, parts, [*sizes[1:], 0], strict=False
            ):
                maker._fill_in(kind.following, part, after, axis)
            for formula, number in (
                (node.count, len(parts)),
                (node.size, sizes[0] if sizes else 0),
                (node.within, sum(sizes)),
            ):
                self._fill_in(formula, result, number, axis)
            parts_by_axis[axis] = b"".join(
                maker.frame(part) for maker, part in zip(makers, parts, strict=True)
            )
            result[node.total.path] = len(parts_by_axis[axis])
        return result, parts_by_axis

    def _get_maker(self, axis: str, kind: Kind, around: Mapping[str, int]) -> FrameMaker:
        key = (kind, *around.items())
        if key not in self._makers:
            place = f"{self._place}.{axis}".strip(".")
            self._makers[key] = FrameMaker._of_parts(
                self._sensor, place, kind.root, self._limit, around
            )
        return self._makers[key]

    def _fill_in(
        self, formula: Formula | None, values: dict[str, Any], number: int, axis: str
    ) -> None:
        """Set the first field of a formula so that the formula gives `number`."""
        if formula is None:
            paths = []
        else:
            paths = [ref.path for ref in refs(formula) if ref.path in self.schema.fields]
        if paths and paths[0] not in values:
            raw: dict[str, Any] = {}
            for path in paths[1:]:
                set_nested(raw, path, self._get_raw(values, path))
            set_count(formula, raw, number, self.schema.fields, axis)
            values[paths[0]] = self.schema.fields[paths[0]].physical(get_member(raw, paths[0]))

    def _find_layout(self, values: Values) -> Layout:
        """Return the layout of a frame, which depends on the values of header fields."""
        while True:
            header = {path: self._get_raw(values, path) for path in self._layout_fields}
            key = tuple(header.values())
            try:
                if key not in self._layouts:
                    self._layouts[key] = find_layout(self._root, header, self._limit, self._given)
                return self._layouts[key]
            except UnknownSelectorError as unknown:
                self._layout_fields.append(unknown.leaf.info.path)
                self._layouts.clear()
            except InvalidLengthError as error:
                raise self._make_too_long_error(values, str(error)) from None

    def _make_too_long_error(self, values: Values, path: str) -> SpecError:
        fields = self.schema.fields
        left_out = [
            path
            for path in self._layout_fields
            if path not in values and fields[path].const is None
        ]
        given = ", ".join(
            f"{path} = {values[path]}" for path in self._layout_fields if path in values
        )
        reason = f"with {given}, the frame is longer than max_length ({self._limit} bytes)"
        if left_out:
            reason = (
                f"sweep must return {left_out[0]!r}, because the length of the frame depends on it"
            )
        return self._make_error(path, reason)

    def _make_rows(
        self, layout: Layout, frames: Sequence[tuple[Values, Mapping[str, bytes]]]
    ) -> NDArray[np.uint8]:
        rows = np.zeros((len(frames), layout.size), np.uint8)
        totals = {node.total.path for node in self.schema.parts.values()}
        totals |= {ending.size.path for ending in self.schema.endings.values()}
        for path in dict.fromkeys(
            path for values, _ in frames for path in values if path not in totals
        ):
            leaf = layout.leaves.get(path)
            if leaf is None and path in self._elsewhere:
                continue
            if leaf is None:
                raise self._make_error(
                    path, "a value is simulated for a field that the frame does not have"
                )
            given = [find_code(leaf.info, values.get(path, 0)) for values, _ in frames]
            for value in given:
                self._check_lengths(leaf, value)
            leaf.store(rows, leaf.raw(given))
        for axis, region in layout.regions.items():
            parts = b"".join(made[axis] for _, made in frames)
            rows[:, region.start : region.start + region.size] = np.frombuffer(
                parts, np.uint8
            ).reshape(len(frames), region.size)
        for leaf in layout.leaves.values():
            if leaf.info.initial and all(leaf.info.path not in values for values, _ in frames):
                leaf.store(rows, leaf.info.initial)
        layout.complete_rows(rows)
        return rows

    def _get_raw(self, values: Values, path: str) -> int:
        info = self.schema.fields.get(path)
        if info is None:
            return int(values[path])  # the size of a text, or the total size of parts
        base, indices = without_indices(path)
        if isinstance(values.get(base), str):
            return int(find_code(info, values[base]))
        if base in values:
            return int(info.raw(float(np.asarray(values[base])[tuple(indices.values())])))
        if isinstance(info.const, int):
            return int(info.const)
        return info.initial


def set_nested(values: dict[str, Any], path: str, value: Any) -> None:
    """Set the value at a dotted path in nested mappings."""
    *parents, name = path.split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
    values[name] = value


def complete_structs(table: CompiledTable) -> list[bytes]:
    """Fill in the constants and checksums of a table; return the bytes of each frame.

    The bytes are those of the struct, before a wire form encodes them.
    """
    frames = [b""] * len(table)
    for group in table.groups:
        group.layout.complete_rows(group.rows)
        size = group.layout.size
        data = group.rows.tobytes()
        for row, index in enumerate(group.where.tolist()):
            frames[index] = data[row * size : (row + 1) * size]
    return frames
