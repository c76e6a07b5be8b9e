"""Hokuyo scanners with SCIP 2.0: URG-04LX, UST-10LX, UST-20LX, UTM-30LX and UTM-30LX-EW.

MD requests continuous scans with distances, ME with distances and intensities, MS with distances of
two characters, and ND and NE with all echoes. GD, GE, GS, HD and HE request one scan, and require
that the laser was switched on with `laser_on`. Scans with any range of steps are decoded.
``configure(content=, first=, last=, cluster=)`` selects the scans that are requested.

Source: SCIP 2.0, C-42-03320B (table 2 for the steps, table 8 for the commands and for the reply of
a URG-04LX to PP), and C-42-04076 for the port of the UST-10LX and UST-20LX. The ranges and the
speed of a UST-10LX and a UTM-30LX-EW are from replies to PP that users have published. A UST-20LX
and a UTM-30LX are assumed to report the same values as a UTM-30LX-EW, except that the shortest
range of a UST-20LX is that of a UST-10LX. It is also assumed that only a URG-04LX accepts SS, CR
and HS, and that a URG-04LX accepts neither ME nor GE. Several echoes are documented for the
UTM-30LX-EW only.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import cache, partial
from typing import Any

from lidarspec import UsageError
from lidarspec.spec import (
    Clock,
    Frame,
    Link,
    OnChange,
    Relative,
    Sensor,
    Serial,
    Simulation,
    Tcp,
    hookimpl,
)
from lidarspec_hokuyo.commands import VALUE_REPLIES, make_commands, make_messages, make_value_lines
from lidarspec_hokuyo.scans import (
    CLOCK_WRAP_S,
    SCAN_COMMANDS,
    Geometry,
    RequestedSteps,
    decimal_value,
    make_scan_frame,
    pace,
    sweep,
)

URG = Geometry(1024, 44, 725, 384, end=768, rate=10.0, kinds=("distances", "short"))
UST = Geometry(1440, 0, 1080, 540, end=1080, rate=40.0, kinds=("distances", "intensities", "short"))
UTM = dataclasses.replace(UST, kinds=tuple(SCAN_COMMANDS))
MAX_SHORT_RANGE_M = 4.095  # the highest distance of two characters
ETHERNET = Tcp(10_940)
#: The models by id: name, geometry, range limits in m, link, status.
MODELS: dict[str, tuple[str, Geometry, tuple[float, float], Link, str]] = {
    "hokuyo-urg04lx": ("URG-04LX", URG, (0.02, 5.6), Serial(19_200, 115_200), "manual"),
    "hokuyo-ust10lx": ("UST-10LX", UST, (0.02, 30.0), ETHERNET, "manual"),
    "hokuyo-ust20lx": ("UST-20LX", UST, (0.02, 60.0), ETHERNET, "manual"),
    "hokuyo-utm30lx": ("UTM-30LX", UST, (0.023, 60.0), Serial(115_200), "manual"),
    "hokuyo-utm30lxew": ("UTM-30LX-EW", UTM, (0.023, 60.0), ETHERNET, "manual"),
}


def describe_difference(own: Geometry, other: Geometry) -> str | Relative:
    """Return how to recognize a scanner with the geometry `other`."""
    if own.last == other.last:
        return "both models send the same scans; the reply to get_parameters names the model"
    if other.last > own.last:
        return Relative(
            f"scans with steps beyond {own.last}", lambda f: decimal_value(f.last) > own.last
        )
    return "the models send packets at different rates; the reply to get_parameters names the model"


@cache
def make_frames(kind: str, geometry: Geometry) -> dict[str, Frame]:
    """Return all frames of a scanner; the scans of the given kind come first."""
    kinds = sorted(geometry.kinds, key=lambda other: other != kind)
    scans = {
        f"{prefix}{content}": make_scan_frame(command, geometry)
        for content in kinds
        for prefix, command in zip(("", "one_"), SCAN_COMMANDS[content], strict=True)
    }
    return scans | make_messages(kind, is_urg=geometry is URG)


def configure(
    sensor: Sensor, *, content: str = "distances", first: int = -1, last: int = -1, cluster: int = 1
) -> Sensor:
    """Return the scanner with a request for the selected scans.

    Args:
        content: "distances", "intensities" (with distances), or "short" distances; for a
            UTM-30LX-EW also "echoes", up to three per step, and "echo_intensities".
        first: the first requested step; -1 for the first step that the scanner measures.
        last: the last requested step; -1 for the last step that the scanner measures.
        cluster: the number of steps that are merged to one distance, 1 to 99.

    Raises:
        UsageError: if the scanner does not support these values.
    """
    geometry = MODELS[sensor.id][1]
    steps = RequestedSteps(
        geometry.first if first < 0 else first, geometry.last if last < 0 else last, cluster
    )
    if content not in geometry.kinds:
        raise UsageError(
            f"{sensor.id}: content must be one of {', '.join(geometry.kinds)}, not {content!r}"
        )
    if not (steps.first <= steps.last <= geometry.end and 1 <= cluster <= 99):
        raise UsageError(
            f"{sensor.id}: the steps must be from 0 to {geometry.end}, and the cluster from 1 to"
            f" 99, got {steps.text.decode()}"
        )
    return dataclasses.replace(sensor, **make_scan_arguments(sensor.id, content, steps))


def make_scan_arguments(name: str, kind: str, steps: RequestedSteps) -> dict[str, Any]:
    """Return the arguments of `Sensor` that depend on the requested scans."""
    model, geometry, limits, _, _ = MODELS[name]
    limits_mm = {"shortest": f"{limits[0] * 1000:g}", "longest": f"{limits[1] * 1000:g}"}
    geometry_values = {
        line: str(getattr(geometry, line)) for line in ("division", "first", "last", "ahead")
    }
    values = {
        "model": model,
        "product": model,
        "protocol": "SCIP 2.0",
        "speed": f"{geometry.rate * 60:g}",
        **limits_mm,
        **geometry_values,
    }
    answers: dict[str, Any] = {
        command: (make_value_lines(frame, values),) for command, frame in VALUE_REPLIES.items()
    }
    if kind == "short":
        limits = (limits[0], min(limits[1], MAX_SHORT_RANGE_M))
    make_scan_values = partial(sweep, geometry=geometry, requested=steps)
    return {
        "range_limits": limits,
        "frames": make_frames(kind, geometry),
        "commands": make_commands(kind, steps.text, is_urg=geometry is URG),
        "simulation": Simulation(
            make_scan_values,
            answers={**answers, "get_scan": ((f"one_{kind}", make_scan_values(0)),)},
        ),
    }


def make_scanner(name: str) -> Sensor:
    """Return the sensor of one row of `MODELS`."""
    model, geometry, _, link, status = MODELS[name]
    return Sensor(
        name,
        vendor="Hokuyo",
        model=model,
        points=None,
        scan=OnChange("time"),
        clock=Clock("time", wraps_at=CLOCK_WRAP_S, pace=partial(pace, rate=geometry.rate)),
        links={"data": link},
        **make_scan_arguments(name, "distances", RequestedSteps(geometry.first, geometry.last, 1)),
        on_open=("stop", "start"),
        on_close=("stop",),
        configure=configure,
        relatives={
            other: describe_difference(geometry, row[1])
            for other, row in MODELS.items()
            if other != name
        },
        info={
            "serial": "version.serial.text",
            "firmware": "version.firmware.text",
            "model": "parameters.model.text",
        },
        status=status,
        source=(
            "SCIP 2.0, C-42-03320B"
            if geometry is URG
            else (
                "SCIP 2.0, C-42-03320B;"
                f" {'UTM-30LX-EW, C-42-03886' if geometry is UTM else 'UST-10LX/20LX, C-42-04076'}"
            )
        ),
    )


URG04LX, UST10LX, UST20LX, UTM30LX, UTM30LXEW = SCANNERS = [make_scanner(name) for name in MODELS]


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Hokuyo scanners."""
    return SCANNERS
