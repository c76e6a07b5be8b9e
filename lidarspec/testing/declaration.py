"""Checks of a declaration that need no bytes from a real sensor."""

from __future__ import annotations

import dis
import inspect
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np

from lidarspec.errors import LidarSpecError, SpecError, did_you_mean
from lidarspec.expressions.columns import Batch, Fields
from lidarspec.expressions.graph import TracedColumn, UntraceableError
from lidarspec.frames.layout import Layout
from lidarspec.frames.schema import without_indices
from lidarspec.framing.example_frames import make_random_header, random_frame, return_raw
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.packets.clocks import clock_fields
from lidarspec.packets.packet_type import find_clock
from lidarspec.points.conventions import TYPES
from lidarspec.simulation.scenes import Room
from lidarspec.simulation.simulator import frame_simulation
from lidarspec.spec import Clock, Frame, OnWrap, Sensor
from lidarspec.spec.fields import factor, is_unit
from lidarspec.spec.syntax import is_expression
from lidarspec.spec.timing import DAY_S
from lidarspec.spec.tree import NAME_IS_COMPARED, ChecksummedStruct, FieldInfo, Struct, infos, nodes
from lidarspec.testing.findings import Finding
from lidarspec.testing.geometry import find_field_of_node, find_source_nodes, trace_points
from lidarspec.testing.sensor_under_test import SensorUnderTest

#: Names of fields that hold a measured value.
MEASURE_NAMES = frozenset(
    [
        "distance",
        "range",
        "radius",
        "angle",
        "azimuth",
        "elevation",
        "temperature",
        "voltage",
        "timestamp",
    ]
)
#: Maximum share of payload offsets at which a sync pattern may match by chance.
MAX_SYNC_SHARE = 1 / 200
#: Number of examples whose lengths are measured before the length of a simulated frame.
FIRST_MEASURED_EXAMPLES = 3
#: Maximum number of examples whose lengths are measured.
MEASURED_EXAMPLES = 12
#: Default number of example payloads in which the sync pattern is counted.
SYNC_EXAMPLES = 12
#: A frame with at most this many bits of constants and checksums is weak: in a few megabytes of
#: random bytes, one such frame is found by chance.
WEAK_BITS = 24
#: The same limit for a frame without points. It is lower, because a false frame without points does
#: not damage a point cloud.
WEAK_BITS_WITHOUT_POINTS = 16
#: The same limit for frames in datagrams. It is the lowest, because UDP has its own checksum.
WEAK_BITS_IN_DATAGRAMS = 8
#: Maximum ratio of `max_length` to the length of the longest random frame.
MAX_LENGTH_RATIO = 8
#: A clock that wraps after at least this time in seconds need not declare `wraps_at`.
LONG_WRAP_S = 7 * DAY_S
#: Relative tolerance for rounding errors of `wraps_at` and of the scale of a clock's field.
MAX_WRAP_ERROR = 1e-9
#: Column of points -> possible units of its source fields.
COLUMN_UNITS = {"range": ("m",), "azimuth": ("deg", "rad"), **dict.fromkeys("xyz", ("m",))}
#: Pattern of the names of fields with the intensity of a return.
INTENSITY_NAMES = re.compile(
    r"(\w+_)?(intensity|intensities|reflectivity|reflectance|rssi|amplitude|brightness|quality|signal)(_\w+)?"
)
CODE_NAMES = re.compile(r"(\w+_)?(code|error|fault|status|errno)(_?\d+)?")
PLACEHOLDER = re.compile(r"\s*(\?*|-*|todo.*|tbd.*|n/?a|none|unknown)\s*", re.IGNORECASE)

Findings = Iterator[tuple[str, str, str]]


def check_declaration(subject: SensorUnderTest) -> list[Finding]:
    """Return the findings of a declaration."""
    sensor = subject.sensor
    checks: list[Findings] = [
        _check_sensor(sensor),
        _check_required_fields(sensor),
        _check_clocks(sensor),
        _check_options(sensor),
    ]
    checks += [_check_frame(subject, name, frame) for name, frame in subject.frames.items()]
    checks += [_check_points(subject, name) for name in subject.sensor.data_frames]
    checks += [_check_range_limit(subject)]
    findings: list[Finding] = []
    for check in checks:
        try:
            findings += [Finding(code, what, path, sensor.id) for code, what, path in check]
        except Exception as error:  # raised by the plugin's own functions
            findings.append(Finding("LS414", f"{type(error).__name__}: {error}", "", sensor.id))
    return findings


def _check_sensor(sensor: Sensor) -> Findings:
    if PLACEHOLDER.fullmatch(sensor.source):
        yield "LS202", f"`source` is {sensor.source!r}, which does not name a document", ""
    for name in ("vendor", "model"):
        if not getattr(sensor, name).strip():
            yield "LS211", f"the sensor's `{name}` is empty", ""
    if "data" not in sensor.links:
        yield "LS211", "the link 'data' is missing", "links"
    if sensor.points is not None and not sensor.has_points:
        yield "LS211", "`points` is declared, but no frame has data=True", "frames"
    if sensor.range_limits is not None:
        low, high = sensor.range_limits
        if not 0 <= low < high:
            yield (
                "LS210",
                f"range_limits must be (low, high) with 0 <= low < high, not {low:g} .. {high:g}",
                "range_limits",
            )


def _check_required_fields(sensor: Sensor) -> Findings:
    """Yield findings for fields that scans, clock or counter require, but that do not fit."""
    fields: dict[str, FieldInfo] = {}
    for name in sensor.main_frames:
        fields |= get_codec(sensor.frames[name]).schema.scan_names
    field_paths = set(fields)
    if isinstance(sensor.scan, OnWrap):
        cut_by = field_paths | set(TYPES)
    else:
        cut_by = field_paths
    if sensor.clock is not None:
        clock = sensor.clock.source
    else:
        clock = ()
    field_names = {
        "scan": getattr(sensor.scan, "name", ""),
        "sequence": sensor.sequence.field if sensor.sequence is not None else "",
    }
    given = [
        *field_names.items(),
        *(
            ("clock", path)
            for path in ((clock,) if isinstance(clock, str) else () if callable(clock) else clock)
        ),
    ]
    status = sensor.clock.status if sensor.clock is not None else None
    if status is not None and status.frame:
        status_paths = set(get_codec(sensor.frames[status.frame]).schema.scan_names)
    else:
        status_paths = field_paths
    if status is not None and isinstance(status.source, str):
        path = without_indices(status.source)[0]
        if path not in status_paths:
            hint = did_you_mean(path, status_paths)
            what = f"the status of the clock needs the field {status.source!r}, which is missing"
            yield "LS216", f"{what}{hint}", "clock.status"
    for purpose, path in given:
        allowed = cut_by if purpose == "scan" else field_paths
        if path and without_indices(path)[0] not in allowed:
            what = f"`{purpose}` needs the field {path!r}, which is missing"
            yield "LS216", f"{what}{did_you_mean(path, allowed)}", purpose
        elif purpose == "clock" and factor(fields[without_indices(path)[0]].unit, "s") is None:
            yield "LS216", f"the clock reads {path!r}, which has no unit of time", purpose


def _check_clocks(sensor: Sensor) -> Findings:
    """Yield findings for clocks with a missing or too large `wraps_at`."""
    checked: list[Clock] = []
    for name in (*sensor.data_frames, *sensor.incoming):
        clock = find_clock(sensor, name)
        if clock is not None and not callable(clock.source) and clock not in checked:
            checked.append(clock)
            yield from _check_wrap(sensor, name, clock)


def _check_wrap(sensor: Sensor, name: str, clock: Clock) -> Findings:
    """Yield a finding if the fields of a clock wrap earlier than declared."""
    paths = clock_fields(clock)
    named = get_codec(sensor.frames[name]).schema.scan_names
    infos = [named.get(without_indices(path)[0]) for path in paths]
    span_s = sum(_find_span_s(info) for info in infos)
    if clock.wraps_at is None and 0 < span_s < LONG_WRAP_S:
        what = f"the clock wraps after {span_s:g} s, but wraps_at is not declared"
        yield "LS509", what, f"{name}.{paths[0]}"
    if clock.wraps_at is not None and clock.wraps_at > span_s * (1 + MAX_WRAP_ERROR):
        what = (
            f"the clock wraps after {span_s:.10g} s at the latest, but wraps_at is"
            f" {clock.wraps_at:.10g} s"
        )
        yield "LS509", what, f"{name}.{paths[0]}"


def _find_span_s(info: FieldInfo | None) -> float:
    """Return the seconds after which an integer field of a clock wraps; inf if unknown."""
    if info is None or info.kind != "int":
        return math.inf
    unit_s = factor(info.unit, "s")
    if unit_s is None:
        return math.inf
    lowest, highest = info.limits
    return float((highest - lowest + 1) * info.scale) * float(unit_s)


def _check_options(sensor: Sensor) -> Findings:
    """Yield findings for options without effect."""
    function = sensor.configure.function
    if isinstance(function, partial):
        plain = function.func
    else:
        plain = function
    if not inspect.isfunction(plain):
        return
    read = {
        instruction.argval
        for instruction in dis.get_instructions(plain)
        if instruction.opname.startswith("LOAD_")
    }
    for name, option in sensor.configure.types.items():
        if name not in read:
            yield "LS217", f"configure never reads {name!r}", f"configure.{name}"
        elif _changes_nothing(sensor, name, option.choices):
            yield (
                "LS217",
                f"configure returns the same sensor for every value of {name!r}",
                f"configure.{name}",
            )


def _changes_nothing(sensor: Sensor, name: str, values: Iterable[Any]) -> bool:
    """Return whether `configure` returns equal sensors for all values that it accepts."""
    accepted = 0
    for value in values:
        try:
            configured = sensor.configure(**{name: value})
        except LidarSpecError:
            continue
        accepted += 1
        same = replace(configured, options=sensor.options, configure=sensor.configure.function)
        if any(
            getattr(same, attribute.name) != getattr(sensor, attribute.name)
            for attribute in fields(sensor)
            if attribute.name != "configure"
        ):
            return False
    return accepted > 1


def _check_frame(subject: SensorUnderTest, name: str, frame: Frame) -> Findings:
    engine = get_codec(frame)
    if not isinstance(frame.tree, Struct | ChecksummedStruct):
        yield "LS114", f"the frame must be a Struct, not a {type(frame.struct).__name__}", name
    if not engine.is_compiled:
        reason = getattr(engine, "reason", "the layout of the frame cannot be computed")
        if NAME_IS_COMPARED in reason:
            yield "LS117", reason, name
        elif not _is_reply(subject.sensor, name):  # a reply comes only once, on request
            yield "LS116", reason, name
    elif engine.size is not None and engine.size != frame.max_length:
        yield (
            "LS203",
            f"every frame has {engine.size} bytes, but max_length is {frame.max_length}",
            name,
        )
    else:
        yield from _check_max_length(subject, name, frame)
    yield from _check_names(subject, name, frame)
    if frame.plausible is not None:
        yield from _check_plausible(subject, name, frame)
    if isinstance(engine, CompiledCodec):
        try:
            candidates = [engine.tree.layout(subject.example(name, seed=seed)) for seed in range(3)]
        except LidarSpecError:
            return
        layouts = [layout for layout in candidates if isinstance(layout, Layout)]
        yield from _find_uncovered(name, layouts)
        if frame.direction == "in":
            yield from _check_sync(subject, name, frame, engine)
            yield from _check_strength(subject, name, frame, layouts)


def _is_reply(sensor: Sensor, name: str) -> bool:
    """Return whether a frame type is a reply to a command."""
    return any(name in command.replies for command in sensor.commands.values())


def _check_max_length(subject: SensorUnderTest, name: str, frame: Frame) -> Findings:
    """Yield a finding if `max_length` is much larger than random frames."""
    if get_codec(frame).schema.endings:
        return  # the length of a text is not declared, and random texts are short
    sizes = list[int]()
    try:
        for size in _iter_sizes(subject, name):
            if MAX_LENGTH_RATIO * size >= frame.max_length:
                return
            sizes.append(size)
    except LidarSpecError:  # another check reports it
        return
    yield (
        "LS203",
        (
            f"the longest of {len(sizes)} random frames has {max(sizes)} bytes, but max_length is"
            f" {frame.max_length}"
        ),
        name,
    )


def _iter_sizes(subject: SensorUnderTest, name: str) -> Iterator[int]:
    """Yield the lengths of examples and of a simulated frame."""
    yield from (len(subject.example(name, seed=seed)) for seed in range(FIRST_MEASURED_EXAMPLES))
    if name in subject.sensor.data_frames and subject.sensor.simulation_of(name).sweep is not None:
        yield len(frame_simulation(subject.sensor, name).block(0, 1, Room(), 0.0).frames[0])
    yield from (
        len(subject.example(name, seed=seed))
        for seed in range(FIRST_MEASURED_EXAMPLES, MEASURED_EXAMPLES)
    )
    yield from _iter_raised_sizes(subject, name)


def _iter_raised_sizes(subject: SensorUnderTest, name: str) -> Iterator[int]:
    """Yield the lengths of valid frames with a large value in one header field."""
    frame = subject.sensor.frames[name]
    engine = get_codec(frame)
    if not isinstance(engine, CompiledCodec) or engine.schema.has_measured_sizes:
        return
    source = subject.make_random(f"lengths of {name}")
    for path in make_random_header(engine, source)[1]:
        info = engine.schema.fields[path]
        for shift in range(info.bits if info.const is None else 0):
            raised = {path: partial(return_raw, info.limits[1] >> shift)}
            try:
                size = make_random_header(engine, source, raised)[0].size
                if MAX_LENGTH_RATIO * size < frame.max_length:
                    break
                yield len(
                    random_frame(subject.sensor, name, source, {**subject.drawers(name), **raised})
                )
            except SpecError:  # too long, or not plausible
                continue


def _check_names(subject: SensorUnderTest, name: str, frame: Frame) -> Findings:
    """Yield findings for fields that are named like measured values but have no unit."""
    pure = _find_pure_numbers(frame) | (_find_range_fields(subject, name) if frame.data else set())
    for path, info in get_codec(frame).schema.all_fields.items():
        if (
            info.name in MEASURE_NAMES
            and info.kind in ("int", "float")
            and info.bits > 1  # a single bit is a flag, such as "the temperature is too high"
            and not info.unit
            and not info.labels
            and path not in pure
        ):
            yield (
                "LS201",
                f"{info.name!r} is a measured value, but has no unit",
                f"{name}.{path}",
            )


def _find_range_fields(subject: SensorUnderTest, name: str) -> set[str]:
    """Return the paths of the fields from which the column `range` is calculated.

    Returns an empty set if none of these fields is a length.
    """
    try:
        infos = [
            find_field_of_node(subject, name, node)
            for node in find_source_nodes(getattr(trace_points(subject, name), "range", None))
        ]
    except Exception:  # another check reports it
        return set()
    has_metres = any(info is not None and factor(info.unit, "m") is not None for info in infos)
    if has_metres:
        return {info.path for info in infos if info is not None}
    return set()


def _find_pure_numbers(frame: Frame, *, with_scale: bool = False) -> set[str]:
    """Return the paths of the `Scaled` fields that have an empty unit.

    Args:
        with_scale: whether to include fields with a scale, such as components of a direction.
    """
    return {
        info.path
        for node in nodes(frame.tree)
        for info in infos(node)
        if info.has_declared_unit and not info.unit and (with_scale or not info.scaled)
    }


def _check_plausible(subject: SensorUnderTest, name: str, frame: Frame) -> Findings:
    try:
        table = get_codec(frame).table([subject.example(name)])
    except LidarSpecError:
        table = get_codec(frame).table([])
    try:
        with np.errstate(all="ignore"):
            answer = frame.plausible(Fields(Batch(table, np.zeros(len(table), np.bool_))))  # type: ignore[misc]
    except Exception as error:
        if isinstance(error, SpecError):
            text = error.reason
        else:
            text = f"plausible: {type(error).__name__}: {error}"
        yield getattr(error, "rule", "") or "LS414", text, f"{name}.plausible"
        return
    if is_expression(answer):
        yield (
            "LS207",
            f"`plausible` returns {answer!r}, which is an expression of construct",
            f"{name}.plausible",
        )
    elif isinstance(answer, bool | np.bool_ | str | type(None)):
        yield "LS207", f"`plausible` returns {answer!r} for every frame", f"{name}.plausible"


def _find_uncovered(name: str, layouts: list[Layout]) -> Findings:
    """Yield findings for fields that no checksum covers, in a frame with checksums."""
    reported: set[str] = set()
    for layout in layouts:
        if not layout.checksums:
            continue
        under = {
            byte
            for checksum in layout.checksums
            for start, end in checksum.spans
            for byte in range(start, end)
        }
        if not under:
            continue  # all fields that the checksum covers are empty in this layout
        checksum_paths = {
            leaf.info.path for checksum in layout.checksums for leaf in checksum.leaves
        }
        for path, leaf in layout.leaves.items():
            if (
                path in checksum_paths
                or leaf.info.const is not None
                or leaf.info.is_enforced
                or path in reported
                or 0 in leaf.shape
            ):
                continue
            if leaf.wire is not None:
                own = {leaf.offset}
            else:
                own = {leaf.offset + part.byte for part in leaf.elements[0].segments}
            # Many checksums begin after the header, so they need not cover the bytes before.
            if not own <= under and max(own) > min(under):
                reported.add(path)
                yield (
                    "LS205",
                    f"no checksum of the frame covers byte {min(own - under)}, which belongs to"
                    " this field",
                    f"{name}.{path}",
                )


def _check_sync(
    subject: SensorUnderTest, name: str, frame: Frame, engine: CompiledCodec
) -> Findings:
    """Yield a finding if the first constants of a frame often occur in payloads."""
    if subject.sensor.datagrams or frame.confirm > 1:
        return
    if not engine.prefix:
        yield "LS204", "the frame has no constant bytes, so a frame may begin at every offset", name
        return
    seeds = range(subject.scale_rounds(SYNC_EXAMPLES, least=4))
    data = np.frombuffer(
        b"".join(subject.example(name, seed=seed)[max(engine.prefix) + 1 :] for seed in seeds),
        np.uint8,
    )
    reach = max(engine.prefix) + 1
    if len(data) < 4 * reach:
        return
    matching = np.ones(len(data) - reach + 1, np.bool_)
    for offset, (mask, value) in engine.prefix.items():
        matching &= (data[offset : offset + len(matching)] & mask) == value
    expected = 2.0 ** -sum(mask.bit_count() for mask, _ in engine.prefix.values())
    share = float(matching.mean())
    # In few bytes, the measured share is inexact.
    chance = MAX_SYNC_SHARE + 4 * (MAX_SYNC_SHARE / len(matching)) ** 0.5
    share = expected if expected > MAX_SYNC_SHARE else share
    if expected > MAX_SYNC_SHARE or share > chance:
        what = (
            f"the constant bytes that begin the frame also occur at {share:.1%} of the offsets in"
            " the rest of the frame"
        )
        yield "LS204", what, name


def _check_strength(
    subject: SensorUnderTest, name: str, frame: Frame, layouts: list[Layout]
) -> Findings:
    """Yield a finding if a frame has too few constants and checksums."""
    if frame.plausible is not None or frame.confirm > 1 or not layouts:
        return
    checked = [
        sum(leaf.info.bits for checksum in layout.checksums for leaf in checksum.leaves)
        for layout in layouts
    ]
    constant = [sum(mask.bit_count() for mask, _ in layout.known.values()) for layout in layouts]
    weakest = min(map(sum, zip(checked, constant, strict=True)))
    if weakest <= _find_max_insufficient_bits(subject.sensor, frame):
        yield (
            "LS206",
            (
                f"the constants and checksums have only {weakest} bits, and the frame type"
                " declares neither `plausible` nor `confirm`"
            ),
            name,
        )


def _find_max_insufficient_bits(sensor: Sensor, frame: Frame) -> int:
    """Return the largest number of constant and checksum bits that is not enough.

    A frame with this number of bits, or fewer, is too easily confused with other bytes.
    """
    if sensor.datagrams:
        return WEAK_BITS_IN_DATAGRAMS
    if frame.data:
        return WEAK_BITS
    return WEAK_BITS_WITHOUT_POINTS


def _check_points(subject: SensorUnderTest, name: str) -> Findings:
    """Yield findings if `points` cannot be traced or uses unsuitable source fields."""
    try:
        result = trace_points(subject, name)
    except UntraceableError as reason:
        yield "LS208", str(reason), f"{name}.points"
        return
    except Exception:  # another property reports the failure
        return
    for column, units in COLUMN_UNITS.items():
        if hasattr(result, column):
            yield from _check_column(subject, name, getattr(result, column), column, units)
    yield from _check_intensity(subject, name, result)


def _check_intensity(subject: SensorUnderTest, name: str, result: Any) -> Findings:
    """Yield a finding if the intensity seems to come from the wrong field."""
    own = [
        find_field_of_node(subject, name, node)
        for node in find_source_nodes(getattr(result, "intensity", None))
    ]
    if not own or any(info is None or INTENSITY_NAMES.search(info.path) for info in own):
        return
    columns = [getattr(result, column.name) for column in fields(result)]
    taken = {
        info.path
        for value in columns
        for node in find_source_nodes(value)
        if (info := find_field_of_node(subject, name, node)) is not None
    }
    ranges = [
        info
        for node in find_source_nodes(getattr(result, "range", None))
        if (info := find_field_of_node(subject, name, node)) is not None
    ]
    axes = {info.axes for info in ranges if info.axes}
    for path, info in subject.fields(name).items():
        if INTENSITY_NAMES.fullmatch(info.name) and info.axes in axes and path not in taken:
            others = ", ".join(info.path for info in own if info is not None)
            yield (
                "LS218",
                f"this field looks like an intensity, but no column of points uses it; the column"
                f" intensity is calculated from {others}",
                f"{name}.{path}",
            )
            return


def _check_range_limit(subject: SensorUnderTest) -> Findings:
    """Yield a finding if a range limit exceeds the largest value of the range field."""
    limits = subject.sensor.range_limits
    if limits is None:
        return
    reach: list[tuple[float, str]] = []
    for name in subject.sensor.data_frames:
        try:
            result = trace_points(subject, name)
        except Exception:  # another check reports it
            return
        value = getattr(result, "range", None)
        if isinstance(value, TracedColumn) and value.node.kind == "field":
            info = find_field_of_node(subject, name, value.node)
        else:
            info = None
        if info is not None and info.kind == "int":
            metres = factor(info.unit, "m")
        else:
            metres = None
        if info is None or metres is None:
            return
        declared = "{:g} .. {:g}".format(*limits)
        held = [info.physical(raw) * float(metres) for raw in (1, info.limits[1])]
        subject.picture[f"{name}: range"] = (
            f"the field can represent {held[0]:.4g} .. {held[1]:.6g} m; range_limits are"
            f" {declared} m"
        )
        reach.append((held[1], f"{name}.{info.path}"))
    furthest, path = max(reach, default=(np.inf, ""))
    if limits[1] > furthest * 1.001:
        yield (
            "LS210",
            f"the largest value of the field is {furthest:g} m, but range_limits end at"
            f" {limits[1]:g} m",
            path,
        )


def _check_column(
    subject: SensorUnderTest, name: str, value: Any, column: str, units: tuple[str, ...]
) -> Findings:
    """Yield a finding if no source field of a column has one of the `units`."""
    infos = [
        find_field_of_node(subject, name, node)
        for node in find_source_nodes(value, include_indices=False)
    ]
    measured = [info for info in infos if info is not None and factor(info.unit, "m") is not None]
    if column == "range" and measured and all(CODE_NAMES.fullmatch(info.name) for info in measured):
        yield (
            "LS219",
            "the range of points is calculated from this field, but its name suggests a code",
            f"{name}.{measured[0].path}",
        )
    free = [info for info in infos if info is not None and info.const is None and not info.labels]
    if free and not any(
        factor(info.unit, unit) is not None for info in infos if info is not None for unit in units
    ):
        bare = [info for info in free if not is_unit(info.unit)]
        pure = _find_pure_numbers(subject.sensor.frames[name], with_scale=column == "azimuth")
        if bare and not {info.path for info in bare} & pure:
            order = list(subject.fields(name))
            first = min(
                bare,
                key=lambda info: (
                    -len(info.axes),
                    order.index(info.path) if info.path in order else len(order),
                ),
            )
            if first.unit:
                problem = f"the unit is {first.unit!r}, expected {' or '.join(units)}"
            else:
                problem = f"no unit is declared, expected {' or '.join(units)}"
            yield (
                "LS201",
                f"the {column} of points is calculated from this field, but {problem}",
                f"{name}.{first.path}",
            )
