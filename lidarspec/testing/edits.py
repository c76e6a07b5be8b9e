"""Drawn edits of fields: what is written is what is read back. Hypothesis draws them, and shrinks a failure to the field at fault."""

from __future__ import annotations

import copy
from typing import Any

from lidarspec.frames.codecs import codec
from lidarspec.frames.schema import FieldInfo
from lidarspec.testing import material
from lidarspec.testing.findings import Violation, require
from lidarspec.testing.frames import acceptable
from lidarspec.testing.subject import Subject

#: example frames that edits begin with, and the most edits at once.
BASES, MOST = 8, 3


def values_survive_building_and_parsing(subject: Subject, name: str) -> None:
    """A few drawn fields of a frame, set to drawn values, are read back as they were written."""
    from hypothesis import HealthCheck, given, seed, settings, strategies as st

    sensor, fields = subject.sensor, codec(subject.sensor.frames[name]).schema.fields
    bases = [sensor.parse(subject.example(name, seed=number), frame=name) for number in range(BASES)]
    if not any(free(fields.get(path)) for base in bases for _, _, path in material.integers(base)):
        return
    values = {path: _values(info, subject.strategies.get(f"{name}.{path}"), st) for path, info in fields.items() if free(info)}

    @seed(0)
    @settings(
        max_examples=len(subject.seeds(sensor.frames[name])),
        deadline=None,
        database=None,
        derandomize=False,
        report_multiple_bugs=False,
        print_blob=False,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def edited(data: Any) -> None:
        number = data.draw(st.integers(0, len(bases) - 1))
        parsed = copy.deepcopy(bases[number])
        spots = [spot for spot in material.integers(parsed) if spot[2] in values]
        if not spots:
            return
        edits: list[tuple[int, str, int]] = []
        for _ in range(data.draw(st.integers(1, MOST))):
            place = data.draw(st.integers(0, len(spots) - 1))
            holder, key, path = spots[place]
            holder[key] = data.draw(values[path])
            edits.append((place, path, holder[key]))
        _check(subject, name, parsed, spots, edits)

    try:
        edited()
    except Violation as found:
        raise Violation(found.code, found.what, found.path) from None


def _check(subject: Subject, name: str, parsed: Any, spots: list[Any], edits: list[tuple[int, str, int]]) -> None:
    built = acceptable(subject, name, parsed)
    if built is None:
        return
    again = subject.sensor.parse(built, frame=name)
    read = list(material.integers(again))
    if len(read) != len(spots):
        return
    sealed = material.seals(subject.sensor, name, built)
    for place, path, _ in edits:
        holder, key, _ = spots[place]
        target, found, _ = list(material.integers(again))[_index(parsed, holder, key)]
        wanted, got = holder[key], target[found]
        require(got == wanted or path in sealed, "LS305", f"{wanted} is written, and {got} is read", f"{name}.{path}")
    require(
        subject.sensor.build(name, again) == built, "LS302", f"an edit of {edits[0][1]} builds other bytes again", f"{name}.{edits[0][1]}"
    )


def _index(parsed: Any, holder: Any, key: Any) -> int:
    return next(index for index, spot in enumerate(material.integers(parsed)) if spot[0] is holder and spot[1] == key)


def _values(info: FieldInfo, own: Any, st: Any) -> Any:
    """What a field's raw value is drawn from: the author's strategy, or its range and the edges of it."""
    if own is not None and hasattr(own, "example"):
        return own
    low, high = info.limits
    if own is not None:
        return st.randoms(use_true_random=False).map(own)
    return st.one_of(st.integers(low, high), st.sampled_from(sorted({low, min(low + 1, high), max(high - 1, low), high})))


def free(info: FieldInfo | None) -> bool:
    return info is not None and info.kind == "int" and info.const is None and info.rebuilt is None
