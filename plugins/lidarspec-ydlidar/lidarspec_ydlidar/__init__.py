"""YDLIDAR's 360 degree lidars over a UART: one packet, with samples in eight forms; most models are
started by a request.

Source: YDLIDAR SDK, "YDLidar-SDK Communication Protocol" (scan command response, angle analysis).

Known errors and gaps: the angles of the protocol's example, 217.0178 and 235.6326 degrees, are
217.0191 and 235.6313 by its own formula. Packets do not say which form their samples have, only how
many bytes they are can be told: choose the model by its name. Models with one channel, which have
no receiving line, send by themselves. Not here: GS1, GS2, GS5 and TIA, whose protocols are others,
and the network models T15 and T30.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    ByteSwapped,
    Const,
    Construct,
    Int8ul,
    Int16ul,
    Struct,
    this,
)

from lidarspec.spec import (
    Checksummed,
    Fields,
    Frame,
    OnFlag,
    Points,
    Polar,
    Relative,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    WordXor,
    hookimpl,
    last,
    spread,
)
from lidarspec_ydlidar.models import MODELS, Model
from lidarspec_ydlidar.requests import ANSWERS, COMMANDS, REQUEST, SCAN_START
from lidarspec_ydlidar.samples import Form

FULL = 40  # samples of a full packet (protocol, LSN)
SPEED = 6.0  # turns a second of simulated sensors, which all models can
# what a T-mini Pro has most often in the bits of the scan frequency while nothing is wrong (its
# packets)
STATE = 0.8
#: the same packet, by the bytes of a sample, whose bits mean something else.
CSPC = {
    2: ("cspc-m1c1-mini-v11",),
    3: ("cspc-m1c1-mini", "cspc-coin-d4", "cspc-coin-d4a", "cspc-coin-d6"),
}


def angle() -> Construct:
    """FSA and LSA: 1/64 degree above a check bit that is always 1."""
    return ByteSwapped(
        BitStruct(
            "angle" / Scaled(BitsInteger(15), 1 / 64, "deg"), "check" / Const(1, BitsInteger(1))
        )
    )


def plausible(f: Fields) -> Any:
    """Angles below 360 degrees, a sample at least, and in a zero packet one alone."""
    return (
        (f.fsa.angle < 360)
        & (f.lsa.angle < 360)
        & (f.lsn >= 1)
        & ((f.ct.start == 0) | (f.lsn == 1))
    )


@cache
def data(form: Form) -> Frame:
    """Return the packet with samples of this form."""
    frequency = Scaled(BitsInteger(7), 0.1, "Hz", form.slowest)
    struct = Struct(
        "header" / Const(b"\xaa\x55"),
        "ct"
        / BitStruct(
            "frequency"
            / frequency
            * "of scans, in a zero packet, raw 0: not given; in others the state of a T-mini or an"
            " X4 Pro",
            "start" / BitsInteger(1) * "1: zero packet, a turn begins",
        ),
        "lsn" / Int8ul * "number of samples",
        "fsa" / angle() * "angle of the first sample",
        "lsa" / angle() * "angle of the last sample",
        "cs" / Int16ul,
        "samples" / Array(this.lsn, form.struct),
    )
    sealed = Checksummed(struct, field="cs", algorithm=WordXor(head=8, groups=form.groups))
    return Frame(sealed, data=True, max_length=10 + form.size * 255, plausible=plausible)


@cache
def reader(form: Form) -> Callable[[Fields], Points]:
    """Return the `points` function of packets with samples of this form."""
    return partial(points, form=form)


def points(f: Fields, form: Form) -> Polar:
    """Even steps from FSA to LSA, corrected for the distance where the lidar triangulates ("angle
    analysis").
    """
    raw = spread(f.fsa.angle, f.lsa.angle, f.lsn, full=360.0)  # degrees, (n, LSN)
    clockwise = raw if form.correction is None else raw + form.correction(f.samples.distance)
    rate = (
        last(f.ct.frequency, where=(f.ct.start == 1) & (f.ct.frequency > form.slowest)) * 360
    )  # degrees per second
    return Polar(
        range=f.samples.distance,
        azimuth=-np.deg2rad(clockwise),
        intensity=f.samples.intensity if form.intense else None,
        time=np.nan_to_num((raw - f.fsa.angle) / rate),
    )


def sweep(i: int, model: Model) -> dict[str, float]:
    """Packet i: of each turn a zero packet, then full ones and a shorter one."""
    steps = int(model.rate / SPEED)
    packet = i % (1 + -(-(steps - 1) // FULL))
    first = 0 if packet == 0 else 1 + (packet - 1) * FULL
    count = 1 if packet == 0 else min(FULL, steps - first)
    return {
        "ct.frequency": SPEED if packet == 0 else model.form.slowest + STATE * model.tells_state,
        "ct.start": int(packet == 0),
        "lsn": count,
        "fsa.angle": first * 360 / steps,
        "lsa.angle": (first + count - 1) * 360 / steps,
    }


def slug(name: str) -> str:
    """Return the id of a model: "T-mini Pro" is "ydlidar-tmini-pro"."""
    return "ydlidar-" + name.lower().replace("t-mini", "tmini").replace(" ", "-")


def tells_state(f: Fields, slowest: float) -> Any:
    """Whether a packet that begins no turn says something where most models say nothing (protocol,
    CT).
    """
    return (f.ct.start == 0) & (f.ct.frequency > slowest)


def relative(own: Model, other: Model) -> str | Relative:
    """What tells another model apart whose samples have the same size."""
    if other.tells_state and not own.tells_state:
        return Relative(
            "CT has bits set in packets that begin no turn",
            partial(tells_state, slowest=own.form.slowest),
        )
    if own.number and other.number:
        return "info.model"
    return "nothing in the packets: the baud rate, or the label on the housing"


def relatives(name: str) -> dict[str, str | Relative]:
    """The models whose packets look like this one's; a CSPC sends the packet with three bytes a
    sample as well.
    """
    own = MODELS[name]
    found = {
        slug(other): relative(own, model)
        for other, model in MODELS.items()
        if other != name and model.form.size == own.form.size
    }
    return found | dict.fromkeys(
        CSPC.get(own.form.size, ()), "info, which a CSPC sends when it is started"
    )


def lidar(name: str) -> Sensor:
    """One row of the table as a sensor."""
    model = MODELS[name]
    talks = not model.one_channel
    return Sensor(
        slug(name),
        vendor="YDLIDAR",
        model=name,
        frames=(
            {**ANSWERS, "data": data(model.form), "request": REQUEST}
            if talks
            else {"scan_start": SCAN_START, "data": data(model.form)}
        ),
        points=reader(model.form),
        scan=OnFlag("ct.start"),
        links={"data": Serial(model.baud)},
        commands=COMMANDS if talks else {},
        simulation=Simulation(
            partial(sweep, model=model),
            answers={"get_info": (("info", {"model": model.number}),)} if talks else {},
        ),
        on_open=("start_motor", "stop", "scan") if talks else (),
        on_close=("stop", "stop_motor") if talks else (),
        range_limits=model.range_limits,
        vendor_axes=("forward", "right", "up"),
        turn=model.turn,
        relatives=relatives(name),
        info={"serial": "info.serial", "model": "info.model"} if talks else {},
        status=model.proof,
        source="YDLIDAR SDK: communication protocol, data set of models"
        + "; packets of a unit" * (model.proof == "capture"),
    )


#: every model as an attribute, by what its id has after the vendor: `SENSORS.tmini_pro`.
SENSORS = SimpleNamespace(
    **{slug(name).removeprefix("ydlidar-").replace("-", "_"): lidar(name) for name in MODELS}
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The YDLIDAR models."""
    return vars(SENSORS).values()
