"""TiM5xx, TiM7xx, TiM871S, LMS1xx, LMS5xx and MRS1000: scanners that send LMDscandata over TCP, in
CoLa B or CoLa A.

Source: the telegram listing 8014631; TiM55x, TiM56x and TiM57x operating instructions 8015883
(steps, rate and angles, 5.3), LMS5xx 8013796 (steps, 3.5), MRS1000 8020494 (layers, 3.5.10).
Assumed, since no sheet was at hand: the steps, rates and angles of TiM7xx and LMS1xx, the rates of
an LMS5xx, and the ranges of all. What can be set stands in the telegrams, so that models are told
apart by what others cannot be set to; what cannot be told, they answer to `get_identity`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from lidarspec import UsageError
from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    OnChange,
    OnFlag,
    Relative,
    Sensor,
    Sequence,
    Simulation,
    Tcp,
)
from lidarspec_sick.commands import ANSWERS, commands, messages
from lidarspec_sick.telegrams import scans

WRAP = 2**32 * 1e-6  # seconds after which the clock starts again
SENT = np.frombuffer(b"sSN", np.uint8)
ANSWERED = np.frombuffer(b"sRA", np.uint8)
EMPTY = ("channels8", "has_position", "has_name", "has_comment", "has_date", "has_event")
NEAR = 1e-4  # degrees that an angle on the wire may be off


@dataclass(frozen=True)
class Kind:
    """What the models of a family can be set to: scans a second, steps in degrees, the first angle;
    what a simulated one does is first.

    Attributes:
        layers: in the order in which they come, degrees downwards.
    """

    rates: tuple[float, ...]
    steps: tuple[float, ...]
    start: float
    beams: int
    echoes: int = 1
    layers: tuple[float, ...] = (0.0,)

    def fits(self, f: Fields) -> Any:
        """Return whether a scan can be one of these."""
        steps = [np.abs(f.dist1.step - step) < NEAR for step in self.steps]
        rates = [f.scan_rate == rate for rate in self.rates]
        return (
            any_of(steps)
            & any_of(rates)
            & (f.dist1.start > self.start - NEAR)
            & any_of([f.layer == layer for layer in self.layers])
        )


def any_of(conditions: list[Any]) -> Any:
    """Return whether one of them holds."""
    found = conditions[0]
    for condition in conditions[1:]:
        found = found | condition
    return found


COARSE = Kind((15,), (1,), -45, 271)
TIM5 = Kind((15,), (0.3333,), -45, 811)
TIM7 = Kind((15,), (0.3333,), -45, 811)
LMS1 = Kind((50, 25), (0.5, 0.25), -45, 541, echoes=2)
LMS5 = Kind((50, 25, 35, 75, 100), (0.5, 0.1667, 0.25, 0.3333, 0.6667, 1), -5, 381, echoes=5)
MRS1 = Kind((50,), (0.25,), -47.5, 1101, echoes=3, layers=(0, -2.5, 2.5, -5))  # 8020494, 3.5.10

#: id -> model, kind, limits of range, status.
MODELS: dict[str, tuple[str, Kind, tuple[float, float], str]] = {
    "sick-tim551": ("TiM551", COARSE, (0.05, 10), "vectors"),
    "sick-tim561": ("TiM561", TIM5, (0.05, 10), "manual"),
    "sick-tim571": ("TiM571", TIM5, (0.05, 25), "manual"),
    "sick-tim781": ("TiM781", TIM7, (0.05, 25), "manual"),
    "sick-tim781s": ("TiM781S", TIM7, (0.05, 25), "manual"),
    "sick-tim871s": ("TiM871S", TIM7, (0.05, 25), "capture"),
    "sick-lms111": ("LMS111", LMS1, (0.5, 20), "manual"),
    "sick-lms151": ("LMS151", LMS1, (0.5, 50), "manual"),
    "sick-lms511": ("LMS511", LMS5, (0.2, 80), "manual"),
    "sick-mrs1104": ("MRS1104", MRS1, (0.2, 64), "manual"),
}


def sweep(i: int, kind: Kind, echoes: int = 1) -> dict[str, Any]:
    """Telegram i of a scanner of this kind, with so many echoes and their strengths."""
    rate = kind.rates[0]
    step = kind.steps[0]
    channels = [f"{name}{number}" for number in range(1, echoes + 1) for name in ("dist", "rssi")]
    each = {"start": kind.start, "step": step, "count": kind.beams, "scale": 1.0, "offset": 0.0}
    return {
        **{f"{channel}.{name}": value for channel in channels for name, value in each.items()},
        **dict.fromkeys((*EMPTY, "encoder_count", "inputs", "outputs", "status"), 0),
        "kind": SENT,
        "version": 1,
        "telegram_counter": i % 65_536,
        "scan_counter": i % 65_536,
        "time": i / rate * 1e6 % 2**32,
        "sent": (i + 1) / rate * 1e6 % 2**32,
        "layer": kind.layers[i % len(kind.layers)],
        "scan_rate": rate,
        "beam_rate": 360 / step * rate / len(kind.layers),
        "channels": len(channels),
    }


def frames(kind: Kind, cola: str) -> dict[str, Frame]:
    """Scans with one echo and with all, first those in this form; messages in this form alone."""
    forms = sorted("AB", key=lambda form: form != cola)
    own = {{"A": "text", "B": "scan"}[form]: scans(form, 1) for form in forms}
    if kind.echoes > 1:
        names = {"A": "echoes_text", "B": "echoes"}
        simulation = Simulation(partial(sweep, kind=kind, echoes=kind.echoes))
        own |= {
            names[form]: dataclasses.replace(scans(form, kind.echoes), simulation=simulation)
            for form in forms
        }
    return own | dict(messages(cola))


def configure(sensor: Sensor, *, cola: Literal["A", "B"] = "B", echoes: int = 0) -> Sensor:
    """Return the scanner for commands in CoLa A or B, and a number of echoes.

    Scans are read in both forms, with one echo and with `echoes`, by default all.

    Raises:
        UsageError: for more echoes than the scanner has.
    """
    kind = MODELS[sensor.id][1]
    if echoes not in range(kind.echoes + 1):
        raise UsageError(
            f"{sensor.id}: echoes must be a number from 1 to {kind.echoes}, not {echoes!r}"
        )
    own = frames(dataclasses.replace(kind, echoes=echoes or kind.echoes), cola)
    return dataclasses.replace(
        sensor, frames=own, commands=commands("text" if cola == "A" else "scan")
    )


def relative(own: Kind, other: Kind) -> str | Relative:
    """What tells a scanner of another kind."""
    if own == other:
        return "identical scans; see its reply to get_identity, or the label on the housing"
    return Relative(
        "the scan rate, the angular step or the first angle", lambda f: other.fits(f) & ~own.fits(f)
    )


def scanner(name: str) -> Sensor:
    """One row of the table as a sensor."""
    model, kind, limits, status = MODELS[name]
    return Sensor(
        name,
        vendor="SICK",
        model=model,
        frames=frames(kind, "B"),
        points=None,
        scan=OnChange("telegram_counter")
        if len(kind.layers) == 1
        else OnFlag("layer", kind.layers[0]),
        clock=Clock("time", wraps_at=WRAP),
        sequence=Sequence("telegram_counter"),
        links={"data": Tcp(2112)},
        commands=commands("scan"),
        on_open=("start",),
        on_close=("stop",),
        simulation=Simulation(
            partial(sweep, kind=kind),
            answers={**ANSWERS, "get_scan": (("scan", {**sweep(0, kind), "kind": ANSWERED}),)},
        ),
        configure=configure,
        range_limits=limits,
        relatives={other: relative(kind, row[1]) for other, row in MODELS.items() if other != name},
        info={"serial": "scan.serial", "firmware": "firmware.text"},
        status=status,
        source="SICK Telegram Listing 8014631, 8023198 table 17",
    )


SCANNERS = [scanner(name) for name in MODELS]
