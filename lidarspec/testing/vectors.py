"""Golden vectors: frames out of a manual or a capture, and what they mean, from a JSON file.

    [{"source": "manual 3.2, page 7", "frame": "data", "hex": "54 2c ...",
      "values": {"speed": 3600, "points[0].distance": 224},
      "units": {"start_angle": 324.27},
      "points": {"0": {"range": 0.224, "x": 0.18186, "y": 0.13078}}}]

`values` are raw integers of the wire, `units` the same in the fields' units, `points` what becomes of single points (range, x, y, z,
azimuth and elevation in radians, intensity, ring). All three may be left out: then the bytes have to be such a frame, and build again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidarspec.discovery.checksum_search import search
from lidarspec.errors import LidarSpecError, WireError
from lidarspec.spec.tree import FieldInfo
from lidarspec.testing.findings import Violation, require
from lidarspec.testing.frames import leaves
from lidarspec.testing.geometry import read
from lidarspec.testing.subject import Subject
from lidarspec.transports.files import unhexed

#: what a point may differ by: metres and radians as manuals print them.
NEAR = 2e-4
KEYS = {"source", "frame", "hex", "values", "units", "points", "note"}
COLUMNS = ("range", "x", "y", "z", "azimuth", "elevation", "intensity", "ring", "return_index")


def vectors_hold(subject: Subject) -> None:
    """Every golden vector parses to its values, builds again, and has its points where they are said to be."""
    for index, vector in enumerate(entries(subject)):
        place = f"vectors[{index}]"
        require(str(vector.get("source", "")).strip(), "LS701", "it names no source", place)
        data = unhexed(vector["hex"])
        name = vector["frame"]
        parsed = _parsed(subject, name, data, place)
        _values(subject, name, data, parsed, vector, place)
        require(subject.sensor.build(name, parsed) == data, "LS302", "its bytes do not survive parsing and building", f"{place} {name}")
        if vector.get("points"):
            _points(subject, name, data, vector["points"], place)


def entries(subject: Subject) -> list[Any]:
    """The vectors of the subject's file.

    Raises:
        Violation: where it cannot be read, or has an entry that is no vector.
    """
    if subject.vectors is None:
        return []
    try:
        found = json.loads(Path(subject.vectors).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise Violation("LS702", str(error), str(subject.vectors)) from None
    if not isinstance(found, list):
        raise Violation("LS702", "the file is no list of vectors", str(subject.vectors))
    for index, vector in enumerate(found):
        place = f"vectors[{index}]"
        require(isinstance(vector, dict), "LS702", "it is no object", place)
        require(not vector.keys() - KEYS, "LS702", f"unknown keys {sorted(vector.keys() - KEYS)}; known are {sorted(KEYS)}", place)
        require(vector.get("frame") in subject.sensor.frames, "LS702", f"there is no frame {vector.get('frame')!r}", place)
        try:
            unhexed(vector.get("hex", "-"))
        except (ValueError, TypeError):
            raise Violation("LS702", "its `hex` is no hex text", place) from None
    return found


def _parsed(subject: Subject, name: str, data: bytes, place: str) -> Any:
    """The vector parsed; where its checksum is at fault, the ones that would fit are named."""
    try:
        return subject.sensor.parse(data, frame=name)
    except WireError as error:
        if ": checksum " not in error.reason:
            raise Violation("LS707", error.reason, f"{place} {name}.{error.path}") from error
        same = [unhexed(one["hex"]) for one in entries(subject) if one["frame"] == name]
        fitting = [f"{match.paste} over {match.span.told(match.place, len(data))}" for match in search(same)[:2]]
        fits = f"; {' or '.join(fitting)} fits" if fitting else ""
        raise Violation("LS703", f"{error.reason}{fits}", f"{place} {name}.{error.path}") from error
    except LidarSpecError as error:
        raise Violation("LS707", str(error), f"{place} {name}") from error


def _values(subject: Subject, name: str, data: bytes, parsed: Any, vector: Mapping[str, Any], place: str) -> None:
    """Hold the fields of a vector to its values, raw and in units."""
    fields, found = subject.fields(name), dict(leaves(parsed))
    wanted = [(path, value, False) for path, value in vector.get("values", {}).items()]
    wanted += [(path, value, True) for path, value in vector.get("units", {}).items()]
    for path, value, in_units in wanted:
        require(path in found, "LS702", f"the frame has no field {path!r}", f"{place} {name}")
        info, raw = fields.get(re.sub(r"\[\d+\]", "", path)), found[path]
        shown: Any = raw.hex(" ") if isinstance(raw, bytes) else info.physical(raw) if in_units and info is not None else raw
        near = abs(info.scale) * 0.5001 if in_units and info is not None else 0
        if shown == value or (isinstance(value, int | float) and isinstance(shown, int | float) and abs(shown - value) <= near):
            continue
        expected = info.raw(value) if in_units and info is not None else value
        raise Violation(_reading(info, raw, expected), f"{shown} is read, and {value} is printed", f"{place} {name}.{path}")


def _reading(info: FieldInfo | None, raw: Any, wanted: Any) -> str:
    """The rule that a wrong integer falls under: byte order, sign, or another value."""
    if info is None or info.kind != "int" or not isinstance(wanted, int) or not info.bits:
        return "LS706"
    top = 1 << info.bits
    if raw % top == wanted % top and (raw < 0) != (wanted < 0):
        return "LS705"
    size = (info.bits + 7) // 8
    swapped = int.from_bytes((raw % top).to_bytes(size, "big"), "little")
    return "LS704" if size > 1 and swapped % top == wanted % top else "LS706"


def _points(subject: Subject, name: str, data: bytes, wanted: Mapping[str, Mapping[str, float]], place: str) -> None:
    """Hold single points of a vector's frame to where they are said to be."""
    cloud = read(subject, name, [data] * subject.sensor.frames[name].confirm).points()
    for index, columns in wanted.items():
        spot = int(index)
        require(-len(cloud) <= spot < len(cloud), "LS708", f"there is no point {spot} among {len(cloud)}", f"{place} {name}")
        got = {}
        for column in columns:
            require(column in COLUMNS and getattr(cloud, column) is not None, "LS702", f"points have no {column!r}", f"{place} {name}")
            got[column] = float(getattr(cloud, column)[spot])
        wrong = [column for column, value in columns.items() if not np.isclose(got[column], value, rtol=NEAR, atol=NEAR)]
        mirrored = all(column in ("y", "azimuth") and np.isclose(got[column], -columns[column], atol=NEAR) for column in wrong)
        said = ", ".join(f"{column} is {got[column]:.5g}, and {columns[column]:g} is printed" for column in wrong)
        require(not wrong, "LS709" if mirrored else "LS708", f"point {spot}: {said}", f"{place} {name}.points")
