"""Checks that the parts of a declaration agree: angles, points, clock and times.

The sweep is `Simulation.sweep`, a function of the packet number that returns the angles, the
counters and the time of a simulated packet.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import LidarSpecError
from lidarspec.framing.frame_engine import get_codec
from lidarspec.packets.clocks import clock_ns
from lidarspec.packets.masked_sector import FULL_TURNS
from lidarspec.packets.packet_type import find_clock
from lidarspec.simulation.frame_maker import FrameMaker
from lidarspec.simulation.simulator import FramesWithoutPoints, find_periodic_rates
from lidarspec.spec import Sensor
from lidarspec.spec.tree import FieldInfo, to_exact
from lidarspec.testing.findings import ViolationError, require
from lidarspec.testing.geometry import (
    ANGLE_CHANGE_STEPS,
    MAX_BACK_STEP_RAD,
    decode_frames,
    make_sweep,
)
from lidarspec.testing.sensor_under_test import SensorUnderTest

#: Indices of the packets of the `sweep` for the check of the clock. The last ones are so large that
#: the clock wraps before them.
FAR_PACKETS = (0, *(start * 10**power for power in range(8) for start in (1, 2, 4, 7)))
#: Number of packets of the `sweep` whose values are compared with the limits of their fields.
FITTED_PACKETS = 500
#: Number of packets for the check that times of points agree with the clock.
TIMED_PACKETS = 64
#: The points of n packets may cover at most n plus this number of times between two packets.
MAX_SPREAD_STEPS = 30
#: Number of angles by which a packet is turned; these angles divide the full circle evenly.
SHIFT_COUNT = 24


def list_simulated_frames(sensor: Sensor) -> list[str]:
    """Return the compiled types of data frames and periodic frames that have a `sweep`."""
    return [
        name
        for name in (*sensor.data_frames, *find_periodic_rates(sensor))
        if sensor.simulation_of(name).sweep and get_codec(sensor.frames[name]).is_compiled
    ]


def periodic_frames_can_be_simulated(subject: SensorUnderTest, name: str) -> None:
    """Check that a frame without points can be simulated if it is sent periodically."""
    if not get_codec(subject.sensor.frames[name]).is_compiled:
        return
    try:
        FramesWithoutPoints(subject.sensor).make_frame(name, 0)
    except LidarSpecError as error:
        raise ViolationError("LS508", str(error), f"{name}.sweep") from error


def the_clock_stays_below_its_wrap(subject: SensorUnderTest, name: str) -> None:
    """Check that the clock of simulated packets stays below `wraps_at`.

    Some packets have such high numbers in the sweep that the clock has wrapped before them.
    """
    clock = find_clock(subject.sensor, name)
    sweep = subject.sensor.simulation_of(name).sweep
    if sweep is None or clock is None or clock.wraps_at is None:
        return
    try:
        maker = FrameMaker(subject.sensor, name)
        frames = maker.make_frames(maker.table([sweep(number) for number in FAR_PACKETS]))
        packets = decode_frames(subject, name, frames, by_clock=False)
        readings = clock_ns(replace(subject.sensor, clock=clock), packets.batch())
    except LidarSpecError:  # another property reports the failure
        return
    most = int(readings.max(initial=0))
    wraps_at_s = float(clock.wraps_at)
    message = f"the clock of the sweep reaches {most / 1e9:g} s, but wraps_at is {wraps_at_s:g} s"
    require(most <= to_exact(clock.wraps_at) * 10**9, "LS512", message, "clock")


def sweep_values_fit_their_fields(subject: SensorUnderTest, name: str) -> None:
    """Check that angles and signed fields can represent the values of the sweep."""
    sweep = subject.sensor.simulation_of(name).sweep
    if sweep is None:
        return
    fields = get_codec(subject.sensor.frames[name]).schema.fields
    checked = {path: info for path, info in fields.items() if _is_limited(info)}
    for number in range(FITTED_PACKETS):
        for path, value in sweep(number).items():
            if path not in checked:
                continue
            info = checked[path]
            beyond = _find_beyond_limits(info, value)
            if beyond is not None:
                low, high = sorted(info.physical(limit) for limit in info.limits)
                raise ViolationError(
                    "LS514",
                    f"sweep({number}) returns {beyond:g} {info.unit}, but the field can represent"
                    f" {low:g} to {high:g} {info.unit}",
                    f"{name}.{path}",
                )


def _is_limited(info: FieldInfo) -> bool:
    """Return whether a field is an integer that must not exceed its range.

    These are signed integers and angles. All other integers may be counters or clocks, which wrap.
    """
    if info.dtype is None or info.dtype.kind not in "iu":
        return False
    return info.dtype.kind == "i" or info.unit in FULL_TURNS


def _find_beyond_limits(info: FieldInfo, value: Any) -> float | None:
    """Return the first physical value that a field cannot represent; None if there is none."""
    physical = np.atleast_1d(np.asarray(value))
    if physical.dtype.kind not in "iuf":
        return None  # a name, or bytes
    raw = info.raw(physical)
    lowest, highest = _find_raw_limits(info)
    beyond = physical[(raw < lowest) | (raw > highest)]
    if len(beyond):
        return float(beyond[0])
    return None


def _find_raw_limits(info: FieldInfo) -> tuple[int, int]:
    """Return the lowest and highest raw value that a sweep may return for a field."""
    # A field that represents exactly one turn may wrap: 360 degrees are sent as 0.
    raw_turn = 1 << info.bits
    full_turn = FULL_TURNS.get(info.unit)
    if full_turn is not None and np.isclose(raw_turn * abs(info.scale), full_turn):
        return -raw_turn, raw_turn
    return info.limits


def times_of_points_fit_the_clock(subject: SensorUnderTest, name: str) -> None:
    """Check that the times of points agree with the clock."""
    frames = make_sweep(subject, name, TIMED_PACKETS)
    if subject.sensor.clock is None or len(frames) < 3:
        return
    packets = decode_frames(subject, name, frames)
    if len(packets) < 3:
        return
    step = float(packets.time_ns[-1] - packets.time_ns[0]) / (len(packets) - 1) / 1e9
    times = packets.points().time
    spread = float(np.ptp(times)) if len(times) else 0.0
    message = (
        f"the times of the points of {len(packets)} packets cover {spread:.3g} s, but the clock"
        f" advances by {step:.3g} s per packet"
    )
    require(
        step <= 0 or spread <= (len(packets) + MAX_SPREAD_STEPS) * step,
        "LS513",
        message,
        f"{name}.points",
    )


def turned_angles_turn_the_points(subject: SensorUnderTest, name: str) -> None:
    """Check that a shift of the angles in a packet turns its points by the same angle."""
    sweep = subject.sensor.simulation_of(name).sweep
    if sweep is None:
        return
    values = sweep(1)
    following = sweep(2)
    fields = get_codec(subject.sensor.frames[name]).schema.fields
    candidates = [
        path
        for path in values
        if path in fields and path in following and fields[path].unit in FULL_TURNS
    ]
    angles = {
        path: fields[path]
        for path in candidates
        if not np.array_equal(values[path], following[path])
    }
    if not angles or len({(info.unit, info.scale) for info in angles.values()}) > 1:
        return
    info = next(iter(angles.values()))
    full = FULL_TURNS[info.unit]
    radians = 2 * np.pi / full
    still = _read_azimuths(subject, name, values)
    little = ANGLE_CHANGE_STEPS * info.scale
    moved = _angles_between(
        _read_azimuths(subject, name, _turn_angles(values, angles, little, full)), still
    )
    if (
        moved is None
        or not len(moved)
        or not np.allclose(np.abs(moved), abs(little) * radians, rtol=0.25)
    ):
        return  # the points do not depend on these angles alone
    sense = float(np.sign(moved[0])) * np.sign(little)
    for part in range(1, SHIFT_COUNT):
        shift = round(full * part / SHIFT_COUNT / info.scale) * info.scale
        moved = _angles_between(
            _read_azimuths(subject, name, _turn_angles(values, angles, shift, full)), still
        )
        if moved is None:
            continue
        wrong = np.abs(_wrap_to_pi(moved - sense * shift * radians))
        worst = float(wrong.max(initial=0))
        turn = f"a turn of {' and '.join(angles)} by {shift:g} {info.unit}"
        require(
            worst <= MAX_BACK_STEP_RAD,
            "LS504",
            f"after {turn}, the direction of a point differs from the expected direction by"
            f" {np.rad2deg(worst):.1f} degrees",
            f"{name}.points",
        )


def _turn_angles(
    values: Mapping[str, Any], angles: Mapping[str, FieldInfo], shift: float, full: float
) -> dict[str, Any]:
    """Return a packet's values with `shift` added to its angles.

    Args:
        angles: the fields of the angles, by path.
        full: the full circle, in the unit of the angles.
    """
    turned = dict(values)
    for path, info in angles.items():
        angle = (np.asarray(values[path]) + shift) % full
        highest = max(info.physical(limit) for limit in info.limits)
        turned[path] = np.where(angle > highest, angle - full, angle)
    return turned


def _read_azimuths(
    subject: SensorUnderTest, name: str, values: Mapping[str, Any]
) -> NDArray[np.float64] | None:
    """Return the azimuths of a packet with these values; None for an invalid packet."""
    try:
        frame = FrameMaker(subject.sensor, name).frame(values)
        packets = decode_frames(
            subject, name, [frame] * max(2, subject.sensor.frames[name].confirm)
        )
        if len(packets):
            return np.asarray(packets.points().azimuth, np.float64)
        return None
    except LidarSpecError:
        return None


def _angles_between(
    first: NDArray[np.float64] | None, second: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """Return the differences of the finite azimuths of two arrays, in radians, -pi to pi.

    Returns None if an array is None, or if the shapes differ.
    """
    if first is None or second is None or first.shape != second.shape:
        return None
    finite = np.isfinite(first) & np.isfinite(second)
    return _wrap_to_pi(first[finite] - second[finite])


def _wrap_to_pi(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the equivalent angles from -pi to pi, in radians."""
    return (angles + np.pi) % (2 * np.pi) - np.pi
