"""Hokuyo scanners that speak SCIP 2.0: URG-04LX, UST-10LX, UST-20LX, UTM-30LX and UTM-30LX-EW.

An answer is a whole turn. It says which steps it has, but not of how many a turn is, nor of which
model it is. What MD asks for goes on with distances, ME with intensities as well, MS with distances
of two characters, ND and NE with all echoes; GD, GE, GS, HD and HE ask for one scan, and need
`laser_on` before. Scans of any steps are read; which ones are asked for says ``configure(content=,
first=, last=, cluster=)``.

Source: SCIP 2.0, C-42-03320B (table 2: steps; 8: commands, and the answer of a URG-04LX to PP);
UST-10LX/20LX, C-42-04076 (port); what a UST-10LX and a UTM-30LX-EW answer to PP, as users print it,
for their ranges and speed. Assumed: that a UST-20LX and a UTM-30LX answer as a UTM-30LX-EW does,
but for the shortest range of the UST-20LX; and that a URG-04LX alone takes SS, CR and HS, and no ME
and GE. Only of a UTM-30LX-EW is it said that it sends several echoes.
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
from lidarspec_hokuyo.commands import TOLD_BY, commands, messages, telling
from lidarspec_hokuyo.scans import KINDS, WRAP, Asked, Geometry, number, pace, scan, sweep

URG = Geometry(1024, 44, 725, 384, end=768, rate=10.0, kinds=("distances", "short"))
UST = Geometry(1440, 0, 1080, 540, end=1080, rate=40.0, kinds=("distances", "intensities", "short"))
UTM = dataclasses.replace(UST, kinds=tuple(KINDS))
FARTHEST_SHORT = 4.095  # metres in two characters
ETHERNET = Tcp(10_940)
#: id -> model, where it looks, limits of range, link, status.
MODELS: dict[str, tuple[str, Geometry, tuple[float, float], Link, str]] = {
    "hokuyo-urg04lx": ("URG-04LX", URG, (0.02, 5.6), Serial(19_200, 115_200), "manual"),
    "hokuyo-ust10lx": ("UST-10LX", UST, (0.02, 30.0), ETHERNET, "manual"),
    "hokuyo-ust20lx": ("UST-20LX", UST, (0.02, 60.0), ETHERNET, "manual"),
    "hokuyo-utm30lx": ("UTM-30LX", UST, (0.023, 60.0), Serial(115_200), "manual"),
    "hokuyo-utm30lxew": ("UTM-30LX-EW", UTM, (0.023, 60.0), ETHERNET, "manual"),
}


def relative(own: Geometry, other: Geometry) -> str | Relative:
    """What tells a scanner that looks elsewhere; of those that do not, one says so itself."""
    if own.last == other.last:
        return "nothing in its scans: the model in its answer to get_parameters"
    if other.last > own.last:
        return Relative(f"steps beyond {own.last}", lambda f: number(f.last) > own.last)
    return "its pace, or the model in its answer to get_parameters"


@cache
def frames(kind: str, geometry: Geometry) -> dict[str, Frame]:
    """Return all frames of a scanner, first the scans of a kind."""
    kinds = sorted(geometry.kinds, key=lambda other: other != kind)
    scans = {
        f"{prefix}{one}": scan(command, geometry)
        for one in kinds
        for prefix, command in zip(("", "one_"), KINDS[one], strict=True)
    }
    return scans | messages(kind, is_urg=geometry is URG)


def configure(
    sensor: Sensor, *, content: str = "distances", first: int = -1, last: int = -1, cluster: int = 1
) -> Sensor:
    """The scanner that is asked for these scans: "distances", "intensities" as well, or "short"
    distances; of a UTM-30LX-EW also "echoes", up to three of each step, and "echo_intensities".

    Args:
        first, last: the steps that are asked for; -1 for the first and the last ones that it
            measures.
        cluster: steps that come as one distance, 1 to 99.

    Raises:
        UsageError: for what the scanner does not take.
    """
    geometry = MODELS[sensor.id][1]
    asked = Asked(
        geometry.first if first < 0 else first, geometry.last if last < 0 else last, cluster
    )
    if content not in geometry.kinds:
        raise UsageError(
            f"{sensor.id}: content is one of {', '.join(geometry.kinds)}, not {content!r}"
        )
    if not (asked.first <= asked.last <= geometry.end and 1 <= cluster <= 99):
        raise UsageError(
            f"{sensor.id}: steps go from 0 up to {geometry.end}, and 1 to 99 make a cluster; not"
            f" {asked.text.decode()}"
        )
    return dataclasses.replace(sensor, **conversation(sensor.id, content, asked))


def conversation(name: str, kind: str, asked: Asked) -> dict[str, Any]:
    """What depends on the scans that a scanner is asked for."""
    model, geometry, limits, _, _ = MODELS[name]
    in_mm = {"shortest": f"{limits[0] * 1000:g}", "longest": f"{limits[1] * 1000:g}"}
    looks = {line: str(getattr(geometry, line)) for line in ("division", "first", "last", "ahead")}
    told = {
        "model": model,
        "product": model,
        "protocol": "SCIP 2.0",
        "speed": f"{geometry.rate * 60:g}",
        **in_mm,
        **looks,
    }
    answers: dict[str, Any] = {
        command: (telling(frame, told),) for command, frame in TOLD_BY.items()
    }
    shown = partial(sweep, geometry=geometry, asked=asked)
    return {
        "range_limits": (limits[0], min(limits[1], FARTHEST_SHORT)) if kind == "short" else limits,
        "frames": frames(kind, geometry),
        "commands": commands(kind, asked.text, is_urg=geometry is URG),
        "simulation": Simulation(
            shown, answers={**answers, "get_scan": ((f"one_{kind}", shown(0)),)}
        ),
    }


def scanner(name: str) -> Sensor:
    """One row of the table as a sensor."""
    model, geometry, _, link, status = MODELS[name]
    return Sensor(
        name,
        vendor="Hokuyo",
        model=model,
        points=None,
        scan=OnChange("time"),
        clock=Clock("time", wraps_at=WRAP, pace=partial(pace, rate=geometry.rate)),
        links={"data": link},
        **conversation(name, "distances", Asked(geometry.first, geometry.last, 1)),
        on_open=("stop", "start"),
        on_close=("stop",),
        configure=configure,
        relatives={
            other: relative(geometry, row[1]) for other, row in MODELS.items() if other != name
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


URG04LX, UST10LX, UST20LX, UTM30LX, UTM30LXEW = SCANNERS = [scanner(name) for name in MODELS]


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Hokuyo scanners."""
    return SCANNERS
