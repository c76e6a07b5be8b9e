"""TiM5xx, TiM7xx, TiM871S, LMS1xx, LMS5xx and MRS1000: scanners with LMDscandata over TCP.

The scanners use CoLa B or CoLa A.

Source: the telegram listing 8014631; TiM55x, TiM56x and TiM57x operating instructions 8015883
(steps, rate and angles, 5.3), LMS5xx 8013796 (steps, 3.5), MRS1000 8020494 (layers, 3.5.10). The
steps, rates and angles of TiM7xx and LMS1xx, the rates of an LMS5xx, and the ranges of all models
are assumed, because no data sheets were available. Telegrams contain the settings of the scanner.
Models are distinguished by settings that other models do not support. The reply to `get_identity`
contains the model.
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
    PacketCounter,
    Relative,
    Sensor,
    Simulation,
    Tcp,
)
from lidarspec_sick.commands import SIMULATED_ANSWERS, make_commands, make_messages
from lidarspec_sick.telegrams import make_scan_frame

CLOCK_WRAP_S = 2**32 * 1e-6
STREAM_KIND = np.frombuffer(b"sSN", np.uint8)
REPLY_KIND = np.frombuffer(b"sRA", np.uint8)
#: The optional parts that a simulated telegram does not have.
ABSENT_PARTS = ("channels8", "has_position", "has_name", "has_comment", "has_date", "has_event")
ANGLE_TOLERANCE_DEG = 1e-4


@dataclass(frozen=True)
class ScannerFamily:
    """The possible settings of a family of models.

    Attributes:
        rates: the possible scans per second.
        steps: the possible angular steps in degrees.
        start: the first angle in degrees.
        beams: the number of beams of a simulated scan.
        layers: the elevations of the layers in the order in which they are sent, in degrees,
            positive downwards.
    """

    rates: tuple[float, ...]
    steps: tuple[float, ...]
    start: float
    beams: int
    echoes: int = 1
    layers: tuple[float, ...] = (0.0,)

    def fits(self, f: Fields) -> Any:
        """Return whether the settings in a scan are possible for this family."""
        steps = [np.abs(f.dist1.step - step) < ANGLE_TOLERANCE_DEG for step in self.steps]
        rates = [f.scan_rate == rate for rate in self.rates]
        return (
            any_of(steps)
            & any_of(rates)
            & (f.dist1.start > self.start - ANGLE_TOLERANCE_DEG)
            & any_of([f.layer == layer for layer in self.layers])
        )


def any_of(conditions: list[Any]) -> Any:
    """Return whether one of the conditions is true."""
    result = conditions[0]
    for condition in conditions[1:]:
        result = result | condition
    return result


COARSE = ScannerFamily((15,), (1,), -45, 271)
TIM5 = ScannerFamily((15,), (0.3333,), -45, 811)
TIM7 = ScannerFamily((15,), (0.3333,), -45, 811)
LMS1 = ScannerFamily((50, 25), (0.5, 0.25), -45, 541, echoes=2)
LMS5 = ScannerFamily(
    (50, 25, 35, 75, 100), (0.5, 0.1667, 0.25, 0.3333, 0.6667, 1), -5, 381, echoes=5
)
MRS1 = ScannerFamily(
    (50,), (0.25,), -47.5, 1101, echoes=3, layers=(0, -2.5, 2.5, -5)
)  # 8020494, 3.5.10

#: Id -> model, family, range limits in m, status.
MODELS: dict[str, tuple[str, ScannerFamily, tuple[float, float], str]] = {
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


def sweep(i: int, family: ScannerFamily, echoes: int = 1) -> dict[str, Any]:
    """Return the values of simulated telegram i with this number of echoes."""
    rate = family.rates[0]
    step = family.steps[0]
    channels = [f"{name}{number}" for number in range(1, echoes + 1) for name in ("dist", "rssi")]
    values = {
        "start": family.start,
        "step": step,
        "count": family.beams,
        "scale": 1.0,
        "offset": 0.0,
    }
    return {
        **{f"{channel}.{name}": value for channel in channels for name, value in values.items()},
        **dict.fromkeys((*ABSENT_PARTS, "encoder_count", "inputs", "outputs", "status"), 0),
        "kind": STREAM_KIND,
        "version": 1,
        "telegram_counter": i % 65_536,
        "scan_counter": i % 65_536,
        "time": i / rate * 1e6 % 2**32,
        "sent": (i + 1) / rate * 1e6 % 2**32,
        "layer": family.layers[i % len(family.layers)],
        "scan_rate": rate,
        "beam_rate": 360 / step * rate / len(family.layers),
        "channels": len(channels),
    }


def make_frames(family: ScannerFamily, cola: str) -> dict[str, Frame]:
    """Return the frames of scans, of commands and of replies.

    Scans can be received in CoLa A and in CoLa B, commands and replies in `cola` only.
    """
    forms = sorted("AB", key=lambda form: form != cola)
    frames = {{"A": "text", "B": "scan"}[form]: make_scan_frame(form, 1) for form in forms}
    if family.echoes > 1:
        names = {"A": "echoes_text", "B": "echoes"}
        simulation = Simulation(partial(sweep, family=family, echoes=family.echoes))
        frames |= {
            names[form]: dataclasses.replace(
                make_scan_frame(form, family.echoes), simulation=simulation
            )
            for form in forms
        }
    return frames | dict(make_messages(cola))


def configure(sensor: Sensor, *, cola: Literal["A", "B"] = "B", echoes: int = 0) -> Sensor:
    """Return the scanner for commands in CoLa A or B, and for a number of echoes.

    Args:
        cola: the protocol for commands, "A" (text) or "B" (binary). Scans are read in both.
        echoes: the number of echoes of each beam in the scans to read; 0 for the maximum of the
            scanner. Scans with one echo are always read.

    Raises:
        UsageError: if the scanner cannot send this number of echoes.
    """
    family = MODELS[sensor.id][1]
    if echoes not in range(family.echoes + 1):
        raise UsageError(
            f"{sensor.id}: echoes must be a number from 1 to {family.echoes}, not {echoes!r}"
        )
    frames = make_frames(dataclasses.replace(family, echoes=echoes or family.echoes), cola)
    return dataclasses.replace(
        sensor, frames=frames, commands=make_commands("text" if cola == "A" else "scan")
    )


def describe_difference(own: ScannerFamily, other: ScannerFamily) -> str | Relative:
    """Return how to recognize a scanner of another family."""
    if own == other:
        return (
            "both models send the same scans; to tell them apart, use get_identity or the label on"
            " the housing"
        )
    return Relative(
        "the scan rate, the angular step or the first angle differs",
        lambda f: other.fits(f) & ~own.fits(f),
    )


def make_scanner(name: str) -> Sensor:
    """Return the sensor of one row of `MODELS`."""
    model, family, limits, status = MODELS[name]
    return Sensor(
        name,
        vendor="SICK",
        model=model,
        frames=make_frames(family, "B"),
        points=None,
        scan=OnChange("telegram_counter")
        if len(family.layers) == 1
        else OnFlag("layer", family.layers[0]),
        clock=Clock("time", wraps_at=CLOCK_WRAP_S, epoch="boot"),
        sequence=PacketCounter("telegram_counter"),
        links={"data": Tcp(2112)},
        commands=make_commands("scan"),
        on_open=("start",),
        on_close=("stop",),
        simulation=Simulation(
            partial(sweep, family=family),
            answers={
                **SIMULATED_ANSWERS,
                "get_scan": (("scan", {**sweep(0, family), "kind": REPLY_KIND}),),
            },
        ),
        configure=configure,
        range_limits=limits,
        relatives={
            other: describe_difference(family, row[1])
            for other, row in MODELS.items()
            if other != name
        },
        info={"serial": "scan.serial", "firmware": "firmware.text"},
        status=status,
        source="SICK Telegram Listing 8014631, 8023198 table 17",
    )


SCANNERS = [make_scanner(name) for name in MODELS]
