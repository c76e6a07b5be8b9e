"""Checks of single frames: valid examples, edited frames and damaged frames.

construct may omit bits, truncate numbers and accept contradictory values without an error. To find
such faults, a frame is parsed and built again.
"""

from __future__ import annotations

import copy
import itertools
import random
import re
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from lidarspec.errors import SpecError, UsageError, WireError
from lidarspec.explaining.damage_search import find_changes
from lidarspec.explaining.explanation import is_valid_frame
from lidarspec.frames.layout import Layout
from lidarspec.frames.wire_coder import FormCoder, frame_coder
from lidarspec.framing.example_frames import valid_mask
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.framing.results import VALID
from lidarspec.spec.tree import FieldInfo
from lidarspec.testing import sensor_under_test as material
from lidarspec.testing.findings import ViolationError, require
from lidarspec.testing.sensor_under_test import MANY_FRAME_TYPES, SensorUnderTest

#: Number of examples in which bytes are changed, for frames that are not compiled.
CHANGED_EXAMPLES = 3
#: Default number of values to which each byte of these examples is changed.
CHANGED_VALUES = 8
#: Number of example frames that are edited.
EDITED_EXAMPLES = 8
#: Maximum number of edits of one frame.
MAX_EDITS = 3
#: Minimum number of offsets at which a frame is cut short or changed.
MIN_CUT_OFFSETS = 12
#: Maximum total bytes of the truncated copies of a long frame.
MAX_CUT_BYTES = 1 << 20
#: Maximum total bytes of the changed copies of a long frame that is not compiled.
MAX_CHANGED_BYTES = 300_000
#: Default and minimum number of frames of a type whose bits are flipped one after another.
FLIPPED_FRAMES = 3
MIN_FLIPPED_FRAMES = 2
#: Maximum total bytes of the copies of one frame with a flipped bit; in a longer frame, only bits
#: of some bytes are flipped.
MAX_FLIPPED_BYTES = 1 << 23


def examples_are_valid_and_repeat(subject: SensorUnderTest, name: str) -> None:
    """Check that examples of a frame type are valid, repeatable and different."""
    frame = subject.sensor.frames[name]
    try:
        examples = [subject.example(name, seed=seed) for seed in subject.seeds(name)]
    except SpecError as error:
        if error.path.startswith(name):
            path = error.path
        elif error.path:
            path = f"{name}.{error.path}"
        else:
            path = name
        raise ViolationError(error.rule or "LS301", error.reason, path) from error
    if not subject.drawers(name):
        again = [subject.sensor.example(name, seed=seed) for seed in range(min(3, len(examples)))]
    else:
        again = examples[:3]
    require(
        examples[:3] == again,
        "LS311",
        "two calls of example with the same seed returned different bytes",
        name,
    )
    longest = max(map(len, examples))
    require(
        longest <= frame.max_length,
        "LS203",
        f"an example has {longest} bytes, but max_length is {frame.max_length}",
        name,
    )
    fixed = material.find_checksum_paths(subject.sensor, name, examples[0])
    free = [
        info
        for info in get_codec(frame).schema.fields.values()
        if info.const is None and not info.is_enforced and info.path not in fixed
    ]
    require(
        len(set(examples)) > 1 or not free or len(examples) < 2,
        "LS301",
        "all examples are equal",
        name,
    )


def bytes_survive_parsing_and_building(subject: SensorUnderTest, name: str) -> None:
    """Check that build(parse(data)) == data for each example, including reserved bits."""
    sensor = subject.sensor
    for seed in subject.seeds(name):
        data = subject.example(name, seed=seed)
        parsed = sensor.parse(data, frame=name)
        for built in (sensor.build(name, parsed), sensor.build(name, **parsed)):
            if built != data:
                _raise_changed_bytes(subject, name, data, built, "LS302")
            again = sensor.parse(built, frame=name)
            require(
                are_equal(parsed, again),
                "LS302",
                "after parsing and building a frame, parsing it again gives different values",
                name,
            )


def every_raw_value_survives(subject: SensorUnderTest, name: str) -> None:
    """Check that parsing and building keeps all values if a byte of an example is changed."""
    engine = get_codec(subject.sensor.frames[name])
    if engine.is_compiled:
        return
    checksum_paths = material.find_checksum_paths(subject.sensor, name, b"")
    follows = {
        info.path
        for info in engine.schema.fields.values()
        if info.rebuilt is not None or info.is_enforced
    }
    for data in _iter_changed_examples(subject, name):
        try:
            parsed = subject.sensor.parse(data, frame=name, verify=False)
            again = subject.sensor.parse(subject.sensor.build(name, parsed), frame=name)
        except (WireError, UsageError):
            continue
        _require_same_values(parsed, again, checksum_paths | follows, name)


def _iter_changed_examples(subject: SensorUnderTest, name: str) -> Iterator[bytes]:
    """Yield copies of examples with one changed byte each."""
    source = subject.make_random(f"raw {name}")
    changes = subject.limit_to_bytes(name, subject.scale_rounds(CHANGED_VALUES), MAX_CHANGED_BYTES)
    offset_count = subject.limit_to_bytes(
        name, subject.scale_rounds(material.CUT_OFFSETS, MIN_CUT_OFFSETS), MAX_CHANGED_BYTES
    )
    for seed in range(subject.limit_to_bytes(name, CHANGED_EXAMPLES)):
        example = subject.example(name, seed=seed)
        for offset in material.pick_offsets(len(example), source, offset_count):
            for _ in range(changes):
                data = bytearray(example)
                data[offset] = source.randrange(256)
                yield bytes(data)


def _require_same_values(parsed: Any, again: Any, checksum_paths: set[str], name: str) -> None:
    for (path, before), (other, after) in zip(
        iter_leaves(parsed), iter_leaves(again), strict=False
    ):
        is_number = (
            isinstance(before, int | float) and re.sub(r"\[\d+\]", "", path) not in checksum_paths
        )
        if path == other and is_number and not are_equal(before, after):
            raise ViolationError(
                "LS303" if is_rounded_down(before, after) else "LS302",
                f"the value {before!r} becomes {after!r} when the parsed frame is built again",
                f"{name}.{path}",
            )


def wrong_rebuild_values_are_invalid(subject: SensorUnderTest, name: str) -> None:
    """Check that a frame is invalid if the value of a `Rebuild` field is wrong."""
    sensor = subject.sensor
    engine = get_codec(subject.sensor.frames[name])
    if not isinstance(engine, CompiledCodec):
        return
    for data in (subject.example(name, seed=seed) for seed in range(3)):
        layout = engine.tree.layout(data)
        assert isinstance(layout, Layout)
        leaves = [
            leaf
            for leaf in layout.leaves.values()
            if leaf.info.rebuilt is not None and not leaf.shape and leaf.info.kind == "int"
        ]
        for leaf, step in ((leaf, step) for leaf in leaves for step in (1, -1)):
            rows = np.frombuffer(data, np.uint8).reshape(1, -1).copy()
            leaf.store(rows, leaf.read_scalar(data) + step)
            for checksum in layout.checksums:
                checksum.fill(rows)
            other = rows.tobytes()
            path = f"{name}.{leaf.info.path}"
            if other != data and engine.survey(rows[0], np.zeros(1, np.intp)).status[0] == VALID:
                built = sensor.build(name, sensor.parse(other, frame=name))
                require(
                    built == other,
                    "LS312",
                    f"the value {leaf.read_scalar(other)} is accepted when parsing, but building"
                    f" writes {leaf.read_scalar(built)}",
                    path,
                )


def is_rounded_down(before: Any, after: Any) -> bool:
    """Return whether a number has become a little lower, as if it was truncated.

    An integer must be lower by exactly 1, a float by less than ``1 + abs(before) / 10``.
    """
    if (
        not isinstance(before, int | float)
        or not isinstance(after, int | float)
        or not before - after > 0
    ):
        return False
    if isinstance(before, int):
        return after == before - 1
    return before - after < 0.1 * abs(before) + 1


def the_start_of_a_frame_may_be_content(subject: SensorUnderTest, name: str) -> None:
    """Check that fields may contain the bytes that begin a frame."""
    frame = subject.sensor.frames[name]
    coder = frame_coder(frame)
    if not isinstance(coder, FormCoder) or coder.form.is_text or not coder.begins:
        return
    start = np.frombuffer(coder.begins, np.uint8)
    struct = coder.decode(subject.example(name)).struct
    layout = coder.tree.find_node(struct).result
    assert isinstance(layout, Layout)
    offsets = range(len(struct) - len(start) + 1)
    rows = np.repeat(np.frombuffer(struct, np.uint8)[None], len(offsets), axis=0)
    for row, offset in zip(rows, offsets, strict=True):
        row[offset : offset + len(start)] = start
    layout.complete_rows(rows)
    is_valid = valid_mask(subject.sensor, name, layout, rows)
    for row, offset in zip(rows[is_valid], np.flatnonzero(is_valid).tolist(), strict=True):
        if not np.array_equal(row[offset : offset + len(start)], start):
            continue  # constants, lengths or checksums are there
        content = row.tobytes()
        if coder.tree.find_node(content).result is not layout:
            continue  # a length, or the end of a text
        data = coder.encode_unchecked(content)
        if data is None or len(data) > frame.max_length:
            continue
        decoded = coder.decode(data)
        require(
            decoded.problem is None and decoded.struct == content,
            "LS313",
            f"the frame {data.hex(' ')} contains {coder.begins.hex(' ')} as content, and is not"
            " decoded to the values that it was built from",
            name,
        )


def values_in_units_build_the_same_bytes(subject: SensorUnderTest, name: str) -> None:
    """Check that building a frame from its physical values gives the original bytes."""
    for seed in subject.seeds(name):
        data = subject.example(name, seed=seed)
        values = material.parse_physical(subject.sensor, name, data)
        if values is None:
            built = data
        else:
            built = subject.sensor.build(name, values, units=True)
        if built != data:
            _raise_changed_bytes(subject, name, data, built, "LS304")


def parse_finds_out_the_type(subject: SensorUnderTest, name: str) -> None:
    """Check that `parse` without a frame type finds a type that matches the bytes."""
    data = subject.example(name, seed=1)
    fitting = [
        other for other in subject.sensor.frames if is_valid_frame(subject.sensor, data, other)
    ]
    require(
        name in fitting,
        "LS306",
        "an example of this frame type is not accepted as a frame of this type",
        name,
    )
    read = [subject.sensor.parse(data, frame=other) for other in fitting]
    require(
        any(are_equal(subject.sensor.parse(data), values) for values in read),
        "LS306",
        "parsing an example without frame= returns a frame of another type",
        name,
    )


def are_equal(first: Any, second: Any) -> bool:
    """Return whether two parsed frames are equal; NaNs are compared bit by bit."""
    if isinstance(first, dict) and isinstance(second, dict):
        return first.keys() == second.keys() and all(
            are_equal(first[key], second[key]) for key in first
        )
    if isinstance(first, list) and isinstance(second, list):
        return len(first) == len(second) and all(map(are_equal, first, second))
    return bool(first == second) or (
        first != first
        and second != second
        and getattr(first, "raw", 0) == getattr(second, "raw", 0)
    )


def _raise_changed_bytes(
    subject: SensorUnderTest, name: str, data: bytes, built: bytes, code: str
) -> None:
    """Raise a violation that names the field in which two frames differ."""
    offset = next(
        (index for index, pair in enumerate(zip(data, built, strict=False)) if pair[0] != pair[1]),
        min(len(data), len(built)),
    )
    before, after = (subject.sensor.parse(part, frame=name, verify=False) for part in (data, built))
    difference = next(
        (
            (path, a, b)
            for (path, a), (_, b) in zip(iter_leaves(before), iter_leaves(after), strict=False)
            if a != b
        ),
        None,
    )
    if difference is None:
        was, became = (part[offset : offset + 1].hex() for part in (data, built))
        raise ViolationError(
            code,
            f"byte {offset} of {len(data)} changes from {was} to {became} when the parsed frame is"
            " built again",
            name,
        )
    path, before, after = difference
    raise ViolationError(
        "LS303" if is_rounded_down(before, after) else code,
        f"the value {before!r} becomes {after!r} when the parsed frame is built again",
        f"{name}.{path}",
    )


def iter_leaves(parsed: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (path with indices, value) for each value of a parsed frame."""
    if isinstance(parsed, dict):
        for key, value in parsed.items():
            yield from iter_leaves(value, f"{path}.{key}" if path else key)
    elif isinstance(parsed, list):
        for index, value in enumerate(parsed):
            yield from iter_leaves(value, f"{path}[{index}]")
    else:
        yield path, parsed


def build_if_valid(subject: SensorUnderTest, name: str, values: Any) -> bytes | None:
    """Build a frame from its values; return None if the values are invalid together."""
    try:
        return subject.sensor.build(name, values)
    except UsageError:
        return None


def values_survive_building_and_parsing(subject: SensorUnderTest, name: str) -> None:
    """Check that random values of fields are the same after building and parsing."""
    from hypothesis import HealthCheck, given, seed, settings, strategies as st

    sensor = subject.sensor
    fields = subject.fields(name)
    number = len(subject.seeds(name))
    bases = [
        sensor.parse(subject.example(name, seed=base), frame=name)
        for base in range(min(EDITED_EXAMPLES, number))
    ]
    if not any(
        has_free_values(fields.get(path))
        for base in bases
        for _, _, path in material.iter_integers(base)
    ):
        return
    values = {
        path: _make_value_strategy(info, subject.strategies.get(f"{name}.{path}"), st)
        for path, info in fields.items()
        if has_free_values(info)
    }

    quiet: dict[str, Any] = {
        "deadline": None,
        "database": None,
        "print_blob": False,
        "suppress_health_check": list(HealthCheck),
    }

    @seed(0)
    @settings(max_examples=number, derandomize=False, report_multiple_bugs=False, **quiet)
    @given(st.data())
    def check_edited(data: Any) -> None:
        parsed = copy.deepcopy(bases[data.draw(st.integers(0, len(bases) - 1))])
        integers = list(material.iter_integers(parsed))
        candidates = [index for index, (_, _, path) in enumerate(integers) if path in values]
        edits = []
        for _ in range(data.draw(st.integers(1, MAX_EDITS)) if candidates else 0):
            index = candidates[data.draw(st.integers(0, len(candidates) - 1))]
            holder, key, path = integers[index]
            holder[key] = data.draw(values[path])
            edits.append(index)
        if edits:
            _check_edit(subject, name, parsed, integers, edits)

    try:
        check_edited()
    except ViolationError as violation:
        raise ViolationError(violation.code, violation.what, violation.path) from None


def _check_edit(
    subject: SensorUnderTest, name: str, parsed: Any, integers: list[Any], edits: list[int]
) -> None:
    """Check that edited integers of a frame are the same after building and parsing."""
    built = build_if_valid(subject, name, parsed)
    if built is None:
        return
    again = subject.sensor.parse(built, frame=name)
    read = list(material.iter_integers(again))
    if len(read) != len(integers):
        return
    checksum_paths = material.find_checksum_paths(subject.sensor, name, built)
    for index in edits:
        (holder, key, path) = integers[index]
        (target, read_key, _) = read[index]
        wanted = holder[key]
        got = target[read_key]
        require(
            got == wanted or path in checksum_paths,
            "LS305",
            f"{wanted} was written, but {got} was read",
            f"{name}.{path}",
        )
    path = integers[edits[0]][2]
    require(
        subject.sensor.build(name, again) == built,
        "LS302",
        f"after {path} was edited, parsing the frame and building it again gives different bytes",
        f"{name}.{path}",
    )


def _make_value_strategy(info: FieldInfo, own: Any, st: Any) -> Any:
    """Return a strategy for the raw values of a field.

    Args:
        own: the strategy or function of the plugin's author; None if there is none.
    """
    if own is not None and hasattr(own, "example"):
        return own
    low, high = info.limits
    if own is not None:
        return st.randoms(use_true_random=False).map(own)
    return st.one_of(
        st.integers(low, high),
        st.sampled_from(sorted({low, min(low + 1, high), max(high - 1, low), high})),
    )


def has_free_values(info: FieldInfo | None) -> bool:
    return (
        info is not None
        and info.kind == "int"
        and info.const is None
        and info.rebuilt is None
        and not info.is_enforced
    )


def a_truncated_frame_is_a_wire_error(subject: SensorUnderTest, name: str) -> None:
    """Check that parsing a truncated frame raises `WireError` with a valid offset."""
    data = subject.example(name, seed=2)
    offset_count = subject.limit_to_bytes(
        name, subject.scale_rounds(material.CUT_OFFSETS, MIN_CUT_OFFSETS), MAX_CUT_BYTES
    )
    for end in material.pick_offsets(len(data), subject.make_random("cut"), offset_count):
        try:
            subject.sensor.parse(data[:end], frame=name)
        except WireError as error:
            require(
                0 <= error.offset <= end,
                "LS307",
                f"the frame was truncated at byte {end}, but the error names byte {error.offset}",
                name,
            )
        except Exception as error:
            raise _make_undocumented_error(
                error, f"cut at byte {end} of {len(data)}", name
            ) from error
        else:
            raise ViolationError(
                "LS307",
                f"the frame is accepted although it was truncated at byte {end} of {len(data)}",
                name,
            )


def a_damaged_frame_is_at_worst_a_wire_error(subject: SensorUnderTest, name: str) -> None:
    """Check that parsing a damaged frame raises no error other than `WireError`."""
    sensor = subject.sensor
    source = subject.make_random(f"mutations {name}")
    types = (name, None) if len(sensor.frames) <= MANY_FRAME_TYPES else (name,)
    for seed in subject.seeds(name, share=4):
        data = material.mutate(subject.example(name, seed=seed % 8), source)
        for kind, verify in itertools.product(types, (True, False)):
            try:
                sensor.parse(data, frame=kind, verify=verify)
            except WireError:
                continue
            except Exception as error:
                raise _make_undocumented_error(
                    error, f"parsing {data.hex(' ')[:200]}", name
                ) from error


def every_single_bit_error_is_seen(subject: SensorUnderTest, name: str) -> None:
    """Check that flipping any bit that a checksum covers makes the frame invalid."""
    engine = get_codec(subject.sensor.frames[name])
    if not isinstance(engine, CompiledCodec):
        return
    source = subject.make_random(f"flipped bits of {name}")
    tried = passed = 0
    has_checksum = False
    for seed in range(
        subject.limit_to_bytes(name, subject.scale_rounds(FLIPPED_FRAMES, MIN_FLIPPED_FRAMES))
    ):
        data = subject.example(name, seed=seed)
        layout = engine.tree.layout(data)
        assert isinstance(layout, Layout)
        row = np.frombuffer(data, np.uint8).reshape(1, -1)
        if any(
            int(checksum.load_stored(row)[0]) in checksum.absent for checksum in layout.checksums
        ):
            continue
        has_checksum = bool(layout.checksums)
        offsets = _choose_flipped_offsets(layout, len(data), source)
        passing = find_changes(subject.sensor.frames[name], data, ["flipped bit"], offsets=offsets)
        tried += 8 * len(offsets)
        passed += len(passing)
        covered = {
            byte
            for checksum in layout.checksums
            if not checksum.absent
            for start, end in checksum.spans
            for byte in range(start, end)
        }
        for _, byte, bit in passing:
            field = next(
                (path for path, (start, end) in layout.places.items() if start <= byte < end), ""
            )
            path = f"{name}.{field}".rstrip(".")
            require(
                byte not in covered,
                "LS310",
                f"the frame is accepted although bit {bit} of byte {byte} is flipped",
                path,
            )
    if tried:
        kind = "with a checksum" if has_checksum else "without a checksum"
        subject.measured[f"{name}, {kind}: undetected single-bit errors"] = (
            f"{100 * passed / tried:.3g} %"
        )


def _choose_flipped_offsets(layout: Layout, length: int, source: random.Random) -> Sequence[int]:
    """Return the offsets of the bytes in which bits are flipped."""
    number = MAX_FLIPPED_BYTES // (8 * length)
    if number >= length:
        return range(length)
    fields = [start for start, _ in layout.places.values()]
    chosen = source.sample(fields, min(len(fields), number // 2))
    return sorted({*chosen, *source.sample(range(length), number - len(chosen))})


def _make_undocumented_error(error: Exception, what: str, name: str) -> ViolationError:
    code = "LS115" if isinstance(error, SpecError) else "LS308"
    return ViolationError(
        code,
        f"{what}: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}",
        name,
    )
