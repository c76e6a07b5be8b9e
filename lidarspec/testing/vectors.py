"""Golden vectors: a JSON file of frames from a manual or a capture.

    [{"source": "manual 3.2, page 7", "frame": "data", "hex": "54 2c ...",
      "values": {"speed": 3600, "points[0].distance": 224},
      "units": {"start_angle": 324.27},
      "points": {"0": {"range": 0.224, "x": 0.18186, "y": 0.13078}}}]

`values` are raw integers. `units` are physical values in the fields' units. `points` are the
columns of single points: range, x, y, z, azimuth and elevation in radians, intensity, ring, or
another column of the sensor. Each of these three keys may be omitted. In any case, the bytes must
be a frame of this type, and building the parsed values must give the same bytes.

`sensor` is the id or a list of ids of the sensors that an entry belongs to. It may be omitted if
the file belongs to a single sensor. In an entry with `command`, `hex` is the frame of that command
with the arguments `args` in their units, and `reply` is the reply.

A sensor with the status "vectors" must have vectors with a value of each data field.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from reprlib import repr as shown
from typing import Any, cast

import numpy as np

from lidarspec.drafting.checksum_search import needs_class, search
from lidarspec.drafting.samples import ChecksumMatch, ChecksumPlace
from lidarspec.errors import LidarSpecError, WireError
from lidarspec.frames.layout import Layout
from lidarspec.framing.frame_engine import CompiledCodec, get_codec
from lidarspec.spec.tree import ChecksummedStruct, FieldInfo, nodes
from lidarspec.testing.commands import check_exchange
from lidarspec.testing.findings import ViolationError, require
from lidarspec.testing.frames import iter_leaves
from lidarspec.testing.geometry import decode_frames
from lidarspec.testing.sensor_under_test import (
    MAX_SHORT_BYTES,
    SensorUnderTest,
    find_checksum_paths,
)
from lidarspec.transports.hex_text import parse_hex
from lidarspec.trusted_files import read_document

#: Tolerance of points in metres and radians: manuals print rounded values.
POINT_TOLERANCE = 2e-4
#: Number of examples whose layouts are searched for fields with checksums.
LAYOUT_EXAMPLES = 8
#: Pattern of the names of fields that store a checksum.
CHECKSUM_NAMES = re.compile(
    r"(\w+_)?(crc|checksum|check_?sum|check|chk|chksum|cksum|cs|bcc|lrc|fcs|xor|sum)_?(8|16|32)?(_(lo|hi|low|high|lsb|msb))?"
)
#: Beginning of the docs of a checksum field that is not verified, as it is not documented.
NOT_CHECKED = "not checked"
#: Bits of evidence above which a field with any name is taken as a checksum. By chance, one of 4096
#: fields reaches this limit.
PROOF_BITS = 12
#: Pattern of the names of fields without a meaning, which need no value in a vector.
SPARE_NAMES = re.compile(r"reserved|unused|unknown|spare|padding|filler", re.IGNORECASE)
#: A number larger than any field.
_HUGE = 1 << 65


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and -_HUGE < value < _HUGE


def _is_value(value: object) -> bool:
    return isinstance(value, str) or _is_number(value)


def _is_table(value: object, is_valid: Callable[[object], bool]) -> bool:
    return isinstance(value, dict) and all(map(is_valid, value.values()))


def _are_points(value: object) -> bool:
    return _is_table(value, lambda value: _is_table(value, _is_number)) and all(
        re.fullmatch(r"-?\d{1,9}", index) for index in cast(Any, value)
    )


def _is_text(value: object) -> bool:
    return isinstance(value, str)


#: Key of an entry -> description and test of its value.
KEYS: dict[str, tuple[str, Callable[[object], bool]]] = {
    "sensor": (
        "an id or a list of ids",
        lambda value: _is_text(value) or (isinstance(value, list) and all(map(_is_text, value))),
    ),
    **dict.fromkeys(("command", "reply", "source", "frame", "hex"), ("a string", _is_text)),
    "note": ("anything", lambda value: True),
    **dict.fromkeys(
        ("args", "values"),
        ("an object of numbers and strings", lambda value: _is_table(value, _is_value)),
    ),
    "units": ("an object of numbers", lambda value: _is_table(value, _is_number)),
    "points": (
        'an object of points, such as {"0": {"x": 1.5, "ring": 3}}',
        _are_points,
    ),
}


def vectors_hold(subject: SensorUnderTest, only: str = "") -> None:
    """Check that the frames of golden vectors have the stated values and points.

    Args:
        only: the key of the vector to check; by default all vectors are checked until one fails.
    """
    read_entries = _read_entries(subject)
    chosen = {only: read_entries[only]} if only else read_entries
    for key, vector in chosen.items():
        if isinstance(vector, ViolationError):
            raise vector
        require(str(vector.get("source", "")).strip(), "LS701", "the source is missing", key)
        data = parse_hex(vector["hex"])
        name = vector["frame"]
        parsed = _parse_vector(subject, name, data, key)
        _compare_values(subject, name, parsed, vector, key)
        require(
            subject.sensor.build(name, parsed) == data,
            "LS302",
            "parsing and building gives different bytes",
            f"{key} {name}",
        )
        if "command" in vector:
            if "reply" in vector:
                answer = parse_hex(vector["reply"])
            else:
                answer = None
            check_exchange(
                subject.sensor,
                vector["command"],
                vector.get("args", {}),
                data,
                answer,
                f"{key} {vector['command']}",
            )
        if vector.get("points"):
            _compare_points(subject, name, data, vector["points"], key)


def describe_missing_vectors(subject: SensorUnderTest) -> str:
    """Return the reason why the sensor has no vectors, or ""."""
    if subject.vectors is None:
        return "there is no file with golden vectors"
    try:
        if _read_entries(subject):
            return ""
        return f"{Path(subject.vectors).name} contains no vectors of {subject.sensor.id}"
    except ViolationError:
        return ""


def list_keys(subject: SensorUnderTest) -> list[str]:
    """Return the keys of the sensor's vectors; [""] if their file cannot be read."""
    try:
        return list(_read_entries(subject))
    except ViolationError:
        return [""]


def the_status_is_proven(subject: SensorUnderTest) -> None:
    """Check that a sensor with the status "vectors" has golden vectors."""
    missing = describe_missing_vectors(subject)
    status = subject.sensor.status
    require(status != "vectors" or not missing, "LS710", f"status is {status!r}, but {missing}")


def every_data_field_is_pinned_down(subject: SensorUnderTest, name: str) -> None:
    """Check that each data field has a value other than 0 in some vector."""
    vectors = [vector for vector in read_valid_entries(subject).values() if vector["frame"] == name]
    if not vectors:
        return
    pinned: dict[str, bool] = {}
    for vector in vectors:
        read_as = dict(iter_leaves(_parse_vector(subject, name, parse_hex(vector["hex"]), name)))
        for path in (*vector.get("values", {}), *vector.get("units", {})):
            plain = re.sub(r"\[\d+\]", "", path)
            pinned[plain] = pinned.get(plain, False) or bool(read_as.get(path))
    verified_paths = _find_verified_fields(subject, name)
    free = [
        path
        for path, info in subject.fields(name).items()
        if info.const is None and info.kind in ("int", "float")
    ]
    required = [
        path
        for path in free
        if path not in verified_paths and not SPARE_NAMES.search(path.rpartition(".")[2])
    ]
    problems = {"no vector states a value of": [path for path in required if path not in pinned]}
    problems["all vectors have 0 for"] = [path for path in required if pinned.get(path) is False]
    message = "; ".join(f"{words} {', '.join(paths)}" for words, paths in problems.items() if paths)
    require(not message, "LS711", message, name)


def points_stand_in_two_quadrants(subject: SensorUnderTest, name: str) -> None:
    """Check that the points of vectors are in two quadrants and in the declared range."""
    vectors = [vector for vector in read_valid_entries(subject).values() if vector["frame"] == name]
    if not vectors:
        subject.picture[f"{name}: vectors"] = "the file has no vectors of this frame type"
        return
    placed = [
        point
        for vector in vectors
        for point in vector.get("points", {}).values()
        if {"x", "y"} <= point.keys()
    ]
    quadrants = {(point["x"] > 0, point["y"] > 0) for point in placed if point["x"] and point["y"]}
    clouds = [
        decode_frames(
            subject, name, [parse_hex(vector["hex"])] * subject.sensor.frames[name].confirm
        ).points()
        for vector in vectors
    ]
    ranges = np.concatenate([np.empty(0), *(cloud.range[cloud.valid] for cloud in clouds)])
    if len(ranges):
        seen = f"ranges {ranges.min():.4g} .. {ranges.max():.4g} m"
    else:
        seen = "no returns"
    number = f"{len(quadrants)} quadrant{'s' * (len(quadrants) != 1)}"
    subject.picture[f"{name}: vectors"] = (
        f"{seen} in {len(vectors)} vectors; the points are in {number}"
    )
    assert subject.sensor.range_limits is not None  # every sensor with points has them
    far = subject.sensor.range_limits[1]
    require(
        not len(ranges) or ranges.max() <= far * (1 + POINT_TOLERANCE),
        "LS713",
        f"range_limits end at {far:g} m, but a vector has a point at {ranges.max(initial=0):.4g} m",
        name,
    )
    require(
        len(quadrants) > 1,
        "LS712",
        f"all points of the vectors are in {number}",
        f"{name}.points",
    )
    subject.frames_with_two_quadrants.add(name)


def every_checksum_is_checked(subject: SensorUnderTest, name: str) -> None:
    """Check that each checksum is verified by a `Checksummed`."""
    verified_paths = _find_verified_fields(subject, name)
    free = [
        path
        for path, info in subject.fields(name).items()
        if info.const is None and path not in verified_paths
    ]
    fields = subject.fields(name)
    named = [path for path in free if CHECKSUM_NAMES.fullmatch(fields[path].name)]
    try:
        frames = [
            parse_hex(vector["hex"])
            for vector in read_valid_entries(subject).values()
            if vector["frame"] == name
        ]
    except ViolationError:  # reported by `vectors_hold`
        frames = []
    # The offset of a checksum belongs to a field only in a compiled frame.
    is_told = isinstance(get_codec(subject.sensor.frames[name]), CompiledCodec)
    for match in _find_common_matches(frames) if is_told and not verified_paths else []:
        path = _find_checksum_field(subject, name, match, frames[0])
        if path in (named or free) and (named or match.evidence_bits >= PROOF_BITS):
            fits = f"{_describe_match(match, len(frames[0]))} matches every vector"
            raise ViolationError(
                "LS212", f"{fits}, but Checksummed does not verify this field", f"{name}.{path}"
            )
    unsaid = [path for path in named if not fields[path].docs.startswith(NOT_CHECKED)]
    require(
        not unsaid,
        "LS212",
        "the field is named like a checksum, but Checksummed does not verify this field",
        f"{name}.{''.join(unsaid[:1])}",
    )


def _find_verified_fields(subject: SensorUnderTest, name: str) -> set[str]:
    """Return the fields of a frame type that store a verified checksum."""
    if not any(
        isinstance(node, ChecksummedStruct) for node in nodes(subject.sensor.frames[name].tree)
    ):
        return set()
    return set().union(
        *(
            find_checksum_paths(subject.sensor, name, subject.example(name, seed=seed))
            for seed in range(LAYOUT_EXAMPLES)
        )
    )


def _find_matches(
    subject: SensorUnderTest, name: str, path: str, frames: list[bytes], frame: bytes
) -> list[ChecksumMatch]:
    """Return the checksums that match frames and lie in the field at `path`."""
    engine = get_codec(subject.sensor.frames[name])
    if isinstance(engine, CompiledCodec):
        layout = engine.tree.layout(frame)
    else:
        layout = None
    if isinstance(layout, Layout):
        leaf = layout.leaves.get(path)
    else:
        leaf = None

    def is_in_field(place: ChecksumPlace) -> bool:
        return leaf is None or (place.start(len(frame)), 8 * place.size) == (
            leaf.offset,
            leaf.info.bits,
        )

    matches = search(frames, is_possible_place=is_in_field)
    return [match for match in matches if not _needs_class(match)] or matches


def _needs_class(match: ChecksumMatch) -> bool:
    return needs_class(match.algorithm)


def _describe_match(match: ChecksumMatch, length: int) -> str:
    """Describe a checksum, the bytes that it covers, and the byte order of its field."""
    if match.place.size > 1:
        order = f", stored {match.order}-endian,"
    else:
        order = ""
    if _needs_class(match):
        algorithm = match.algorithm.describe()
    else:
        algorithm = match.source
    return f"{algorithm} over {match.span.describe(match.place, length)}{order}"


def _find_common_matches(frames: list[bytes]) -> list[ChecksumMatch]:
    """Return the checksums that match all frames."""
    if max(map(len, frames), default=0) <= MAX_SHORT_BYTES:
        return search(frames)
    first, *others = [
        {(match.source, match.place, match.span): match for match in search([frame])}
        for frame in frames
    ]
    return [
        replace(match, evidence_bits=match.evidence_bits * len(frames))
        for key, match in first.items()
        if all(key in other for other in others)
    ]


def _find_checksum_field(
    subject: SensorUnderTest, name: str, match: ChecksumMatch, frame: bytes
) -> str:
    """Return the field that stores a checksum; "" if it cannot be determined."""
    engine = get_codec(subject.sensor.frames[name])
    if isinstance(engine, CompiledCodec):
        layout = engine.tree.layout(frame)
    else:
        layout = None
    start = match.place.start(len(frame))
    leaves = layout.leaves.items() if isinstance(layout, Layout) else ()
    return next(
        (
            path
            for path, leaf in leaves
            if leaf.offset in range(start, start + match.place.size) and not leaf.shape
        ),
        "",
    )


def read_valid_entries(subject: SensorUnderTest) -> dict[str, Any]:
    """Return the valid vectors of the sensor by their keys.

    Raises:
        ViolationError: if the file cannot be read.
    """
    return {
        key: vector
        for key, vector in _read_entries(subject).items()
        if not isinstance(vector, ViolationError)
    }


def _read_entries(subject: SensorUnderTest) -> dict[str, Any]:
    """Return the vectors of the sensor, or their `ViolationError`, by their keys."""
    if subject.vectors is None:
        return {}
    try:
        content = read_document(Path(subject.vectors), "JSON")
    except LidarSpecError as error:
        raise ViolationError("LS702", str(error), str(subject.vectors)) from None
    if not isinstance(content, list):
        raise ViolationError(
            "LS702", "the file does not contain a list of vectors", str(subject.vectors)
        )
    own_entries: dict[str, Any] = {}
    for index, vector in enumerate(content):
        entry_key = f"vectors[{index}]"
        try:
            if _check_entry(subject, vector, entry_key):
                own_entries[entry_key] = vector
        except ViolationError as error:
            own_entries[entry_key] = error
    return own_entries


def _check_entry(subject: SensorUnderTest, vector: Any, entry_key: str) -> bool:
    """Check an entry of the file, and return whether it belongs to the sensor.

    Raises:
        ViolationError: if the entry is invalid.
    """
    require(
        isinstance(vector, dict),
        "LS702",
        f"expected a JSON object with a frame, got {shown(vector)}",
        entry_key,
    )
    unknown = sorted(vector.keys() - KEYS.keys())
    require(not unknown, "LS702", f"unknown keys {unknown}; expected {sorted(KEYS)}", entry_key)
    for key, value in vector.items():
        expected, fits = KEYS[key]
        require(fits(value), "LS702", f"{key}: expected {expected}, got {shown(value)}", entry_key)
    if not _belongs_to(subject, vector, entry_key):
        return False
    if "command" in vector:
        command = subject.sensor.commands.get(vector["command"])
        vector.setdefault("frame", command.frame if command is not None else None)
        sends = command is not None and command.frame == vector["frame"]
        require(sends, "LS702", f"no command {vector['command']!r} sends this frame", entry_key)
    require(
        vector.get("frame") in subject.sensor.frames,
        "LS702",
        f"no frame {vector.get('frame')!r}",
        entry_key,
    )
    try:
        parse_hex(vector.get("hex", "-"))
        parse_hex(vector.get("reply", ""))
    except ValueError:
        raise ViolationError(
            "LS702", "`hex` or `reply` is not hexadecimal text", entry_key
        ) from None
    return True


def _belongs_to(subject: SensorUnderTest, vector: Mapping[str, Any], entry_key: str) -> bool:
    """Return whether an entry belongs to the sensor."""
    named = vector.get("sensor", [])
    family = subject.family
    ids = [named] if isinstance(named, str) else named
    message = (
        f"several sensors share this file ({', '.join(family)}), so the vector must name its"
        f' sensor: "sensor": "{subject.sensor.id}"'
    )
    require(ids or len(family) < 2, "LS702", message, entry_key)
    unknown_ids = [name for name in ids if family and name not in family]
    require(
        not unknown_ids,
        "LS702",
        f"the vector names {', '.join(map(repr, unknown_ids))}, but these sensors share the file:"
        f" {', '.join(family)}",
        entry_key,
    )
    return not ids or subject.sensor.id in ids


def _parse_vector(subject: SensorUnderTest, name: str, data: bytes, entry_key: str) -> Any:
    """Parse the frame of a vector, and return its values."""
    try:
        return subject.sensor.parse(data, frame=name)
    except WireError as error:
        if ": checksum " not in error.reason:
            raise ViolationError(
                "LS707", error.reason, f"{entry_key} {name}.{error.path}".removesuffix(".")
            ) from error
        same = [
            parse_hex(entry["hex"])
            for entry in read_valid_entries(subject).values()
            if entry["frame"] == name
        ]
        fitting = [
            _describe_match(match, len(data))
            for match in _find_matches(subject, name, error.path, same, data)[:2]
        ]
        fits = f"; {' or '.join(fitting)} fits" if fitting else ""
        raise ViolationError(
            "LS703", f"{error.reason}{fits}", f"{entry_key} {name}.{error.path}"
        ) from error
    except LidarSpecError as error:
        raise ViolationError("LS707", str(error), f"{entry_key} {name}") from error


def _compare_values(
    subject: SensorUnderTest,
    name: str,
    parsed: Any,
    vector: Mapping[str, Any],
    entry_key: str,
) -> None:
    """Check that the parsed fields have the values that the vector states."""
    fields = subject.fields(name)
    parsed_values = dict(iter_leaves(parsed))
    wanted = [(path, value, False) for path, value in vector.get("values", {}).items()]
    wanted += [(path, value, True) for path, value in vector.get("units", {}).items()]
    for path, value, in_units in wanted:
        require(
            path in parsed_values,
            "LS702",
            f"the frame has no field {path!r}",
            f"{entry_key} {name}",
        )
        info = fields.get(re.sub(r"\[\d+\]", "", path))
        raw = parsed_values[path]
        plain: Any = (
            raw.hex(" ")
            if isinstance(raw, bytes)
            else info.physical(raw)
            if in_units and info is not None
            else raw
        )
        if in_units and info is not None:
            near = abs(info.scale) * 0.5001
        else:
            near = 0
        if plain == value or (
            isinstance(value, int | float)
            and isinstance(plain, int | float)
            and abs(plain - value) <= near
        ):
            continue
        if in_units and info is not None:
            expected = info.raw(value)
        else:
            expected = value
        raise ViolationError(
            _find_value_rule(info, raw, expected),
            f"parsed {plain}, expected {value}",
            f"{entry_key} {name}.{path}",
        )


def _find_value_rule(info: FieldInfo | None, raw: Any, wanted: Any) -> str:
    """Return the rule that a wrong value violates: byte order, sign, or value."""
    if info is None or info.kind != "int" or not isinstance(wanted, int) or not info.bits:
        return "LS706"
    top = 1 << info.bits
    if raw % top == wanted % top and (raw < 0) != (wanted < 0):
        return "LS705"
    size = (info.bits + 7) // 8
    swapped = int.from_bytes((raw % top).to_bytes(size, "big"), "little")
    if size > 1 and swapped % top == wanted % top:
        return "LS704"
    return "LS706"


def _compare_points(
    subject: SensorUnderTest,
    name: str,
    data: bytes,
    wanted: Mapping[str, Mapping[str, float]],
    entry_key: str,
) -> None:
    """Check that points of a vector's frame have the columns that the vector states."""
    packets = decode_frames(subject, name, [data] * subject.sensor.frames[name].confirm)
    require(
        len(packets) or not packets.stats.implausible,
        "LS708",
        "the frame has no points, because `plausible` rejects it",
        f"{entry_key} {name}",
    )
    cloud = packets.points()
    columns_of_points = cloud.columns.keys() - {"time"}
    for index, columns in wanted.items():
        number = int(index)
        require(
            -len(cloud) <= number < len(cloud),
            "LS708",
            f"point {number} does not exist: the frame has {len(cloud)} points",
            f"{entry_key} {name}",
        )
        got = {}
        for column in columns:
            require(
                column in columns_of_points,
                "LS702",
                f"the points have no column {column!r}",
                f"{entry_key} {name}",
            )
            got[column] = float(cloud.columns[column][number])
        wrong = [
            column
            for column, value in columns.items()
            if not np.isclose(got[column], value, rtol=POINT_TOLERANCE, atol=POINT_TOLERANCE)
        ]
        mirrored = all(
            column in ("y", "azimuth")
            and np.isclose(got[column], -columns[column], atol=POINT_TOLERANCE)
            for column in wrong
        )
        message = ", ".join(
            f"{column} is {got[column]:.5g}, expected {columns[column]:g}" for column in wrong
        )
        require(
            not wrong,
            "LS709" if mirrored else "LS708",
            f"point {number}: {message}",
            f"{entry_key} {name}.points",
        )
