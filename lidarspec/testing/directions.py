"""Geometry: clouds by the conventions, directions in radians, in order, across the full circle, and for a single point."""

from __future__ import annotations

import copy
import random
from typing import Any

import numpy as np

from lidarspec.errors import LidarSpecError, SpecError
from lidarspec.examples import examples
from lidarspec.frames.codecs import CompiledCodec, codec
from lidarspec.frames.schema import FieldInfo
from lidarspec.points import evaluate
from lidarspec.splits import OnWrap
from lidarspec.testing import material
from lidarspec.testing.comparisons import assert_well_formed
from lidarspec.testing.findings import Violation, require
from lidarspec.testing.frames import acceptable
from lidarspec.testing.subject import Subject
from lidarspec.testing.tracks import beams, read, swept

#: packets along the sweep whose directions are looked at.
PACKETS = 400
#: radians beyond which an azimuth along a sweep, or a drawn one, can only be degrees.
TURNS, DRAWN = 4 * np.pi, 15 * np.pi
#: share of the steps that go one way where a sensor rotates, and the step against it that is too much, radians and medians.
ONE_WAY, BACK, MEDIANS = 0.8, np.deg2rad(1.5), 4
#: raw steps by which an angle is moved to see whether the points move with it.
SMALL = 4
FULL = {"deg": 360.0, "rad": 2 * np.pi}


def clouds_keep_the_conventions(subject: Subject, name: str) -> None:
    """float32 metres and radians, azimuth in [-pi, pi), no place without a return; and `points` does not fail."""
    frames = [subject.example(name, seed=seed) for seed in range(max(len(subject.seeds(subject.sensor.frames[name])), 2))]
    try:
        packets = read(subject, name, frames)
        cloud = packets.points()
    except SpecError as error:
        raise Violation("LS414", str(error), f"{name}.points") from error
    errors = packets.stats.tracebacks
    require(not packets.stats.plugin_errors, "LS414", errors[0].strip().splitlines()[-1] if errors else "", name)
    try:
        assert_well_formed(cloud)
    except AssertionError as error:
        raise Violation("LS501", str(error).splitlines()[0] or "the cloud is not well formed", f"{name}.points") from error


def directions_are_radians(subject: Subject, name: str) -> None:
    """No direction is so large that it can only be degrees."""
    if any(info.kind == "float" for info in codec(subject.sensor.frames[name]).schema.fields.values()):
        return  # which may hold any number
    along = swept(subject, name, 64)
    frames = along or [subject.example(name, seed=seed) for seed in range(16)]
    found = beams(subject, name, read(subject, name, frames))
    if found is None:
        return
    azimuth, elevation = (float(np.nanmax(np.abs(part), initial=0)) for part in (found.azimuth, found.elevation))
    require(azimuth <= (TURNS if along else DRAWN), "LS502", f"an azimuth of {azimuth:.4g} rad", f"{name}.points")
    require(not along or elevation <= np.pi / 2 + 1e-6, "LS502", f"an elevation of {elevation:.4g} rad", f"{name}.points")


def a_single_point_has_a_direction(subject: Subject, name: str) -> None:
    """Where the number of points is in the header, frames with one point have as sound a direction as others."""
    engine, source = codec(subject.sensor.frames[name]), random.Random(subject.sensor.id)
    if not isinstance(engine, CompiledCodec):
        return
    counts = [path for path in engine.tree.choose(source)[1] if engine.schema.fields[path].const is None]
    for path in counts:
        try:
            single = examples(subject.sensor, name, source, {**subject.drawers(name), path: lambda _: 1})
        except SpecError:
            continue
        try:
            cloud = read(subject, name, (single * 3)[: max(3, subject.sensor.frames[name].confirm)]).points()
        except SpecError as error:
            raise Violation("LS503", f"with {path} = 1: {error.reason}", f"{name}.{path}") from error
        unknown = bool(len(cloud)) and bool(np.isnan(cloud.azimuth).all())
        known = read(subject, name, [subject.example(name, seed=seed) for seed in range(12)]).points()
        require(not unknown or np.isnan(known.azimuth).all(), "LS503", f"with {path} = 1 every azimuth is nan", f"{name}.{path}")


def the_full_circle_is_the_same_as_none(subject: Subject, name: str) -> None:
    """A frame with an angle of exactly 360 degrees, where it is plausible, has the points of the one with 0."""
    for path, info in codec(subject.sensor.frames[name]).schema.fields.items():
        full = _full_circle(info)
        if full is None:
            continue
        clouds: list[Any] = []
        for value in (full[0], full[0] + SMALL, full[1]):
            frame = _with(subject, name, path, value)
            if frame is None:
                break
            try:
                packets = read(subject, name, [frame] * max(2, subject.sensor.frames[name].confirm))
                clouds += [packets.points()] if len(packets) else []
            except SpecError as error:
                raise Violation("LS505", f"{path} of exactly {FULL[info.unit]:g} {info.unit}: {error.reason}", f"{name}.{path}") from error
        if len(clouds) < 3 or len({len(cloud) for cloud in clouds}) > 1:
            continue
        nought, turned, circle = clouds
        moved = np.abs((turned.azimuth - nought.azimuth + np.pi) % (2 * np.pi) - np.pi)
        along = float(np.nanmax(moved, initial=0)) / (SMALL * abs(info.scale) * 2 * np.pi / FULL[info.unit])
        if not 0.5 < along < 1.5:
            continue  # points do not move with it: a rate, a step, or another angle than the azimuth
        apart = np.nanmax(np.abs(nought.xyz - circle.xyz) / (1 + np.abs(nought.range))[:, None], initial=0)
        same = np.array_equal(nought.valid, circle.valid) and apart < 1e-3
        require(same, "LS505", f"{path} of exactly {FULL[info.unit]:g} {info.unit} gives other points than 0", f"{name}.{path}")


def angles_are_in_order(subject: Subject, name: str) -> None:
    """Along the sweep of a sensor that rotates, the azimuths of each laser go one way, also across the full circle."""
    frames = swept(subject, name, PACKETS if subject.sensor.frames[name].max_length <= material.SHORT else PACKETS // 4)
    if not frames:
        return
    found = evaluate(read(subject, name, frames))
    counts = found.counts.reshape(len(found.counts), -1).sum(axis=1) if found.counts.ndim > 1 else found.counts
    cloud, packet = found.cloud, np.repeat(np.arange(found.ready), counts)
    rings = cloud.ring if cloud.ring is not None else np.zeros(len(cloud))
    for ring in np.unique(rings)[:4]:
        mine = (rings == ring) & np.isfinite(cloud.azimuth)
        angle, number = cloud.azimuth[mine].astype(np.float64), packet[mine]
        steps = (np.diff(angle) + np.pi) % (2 * np.pi) - np.pi
        moving = np.abs(steps) > 1e-9
        if moving.sum() < 8:
            continue
        median = float(np.median(steps[moving]))
        one_way = float((np.sign(steps[moving]) == np.sign(median)).mean())
        back = steps * np.sign(median) < -max(BACK, MEDIANS * abs(median))
        if one_way < ONE_WAY:
            wraps = isinstance(subject.sensor.scan, OnWrap)
            require(
                not wraps, "LS506", f"only {one_way:.0%} of the steps go the same way, and scans are cut where it wraps", f"{name}.points"
            )
            continue
        if back.any():
            spot = int(np.flatnonzero(back)[0])
            said = (
                f"from {np.rad2deg(angle[spot]):.1f} to {np.rad2deg(angle[spot + 1]):.1f} degrees in packet {number[spot + 1]} of the sweep"
            )
            inside = number[spot] == number[spot + 1]
            raise Violation("LS504" if inside else "LS506", said, f"{name}.points")


def counters_run_on(subject: Subject, name: str) -> None:
    """Along the sweep no packet counts as lost, late or doubled, and time does not run back."""
    frames = swept(subject, name, 700 if subject.sensor.frames[name].max_length <= 1500 else 260)
    if not frames or name != subject.sensor.data_frame:
        return
    packets = read(subject, name, frames)
    stats = packets.stats
    if subject.sensor.sequence is not None:
        said = f"along the sweep {stats.lost} packets are lost, {stats.late} late, {stats.duplicates} doubled"
        require((stats.lost, stats.late, stats.duplicates) == (0, 0, 0), "LS510", said, f"{name}.{subject.sensor.sequence.field}")
    if subject.sensor.clock is not None and len(packets) > 1:
        back = np.diff(packets.time_ns)
        spot = int(back.argmin())
        require(back.min() >= 0, "LS509", f"packet {spot + 1} of the sweep is {-back.min() / 1e9:g} s before the one in front of it", name)


def _full_circle(info: FieldInfo) -> tuple[int, int] | None:
    """The raw values of no angle and of the full circle; None where the field cannot hold both."""

    if info.kind != "int" or info.const is not None or info.unit not in FULL or not info.scale:
        return None
    raw = [(value - info.offset) / info.scale for value in (0.0, FULL[info.unit])]
    low, high = info.limits
    whole = all(abs(value - round(value)) < 1e-6 and low <= round(value) <= high for value in raw)
    return (round(raw[0]), round(raw[1])) if whole else None


def _with(subject: Subject, name: str, path: str, value: int) -> bytes | None:
    """An example with every element of one field set; None where no frame can carry it."""
    parsed = copy.deepcopy(subject.sensor.parse(subject.example(name, seed=1), frame=name))
    for holder, key, own in list(material.integers(parsed)):
        if own == path:
            holder[key] = value
    built = acceptable(subject, name, parsed)
    try:
        return built if built is not None and subject.sensor.parse(built, frame=name) is not None else None
    except LidarSpecError:
        return None
