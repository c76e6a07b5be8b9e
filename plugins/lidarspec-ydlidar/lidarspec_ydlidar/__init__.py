"""YDLIDAR's 360 degree lidars over a UART.

All models send the same packet, with one of eight formats of samples. Most models start to measure
after a request. Models that only send (the vendor calls them single-channel) measure without a
request.

Source: YDLIDAR SDK, "YDLidar-SDK Communication Protocol" (scan command response, angle analysis).

Known errors and gaps: the protocol's example gives the angles 217.0178 and 235.6326 degrees, but
the formula in the protocol results in 217.0191 and 235.6313 degrees. Packets do not contain the
format of their samples. A format can be recognised only if no other format has samples of the same
size, so select the model by its name. GS1, GS2, GS5 and TIA, which have other protocols, and the
network models T15 and T30 are not supported.
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
from lidarspec_ydlidar.samples import SampleFormat

SAMPLES_PER_PACKET = 40  # number of samples of a full packet (protocol, LSN)
SIMULATED_SPEED_HZ = 6.0  # within the limits of all models
#: The scan frequency that packets of a T-mini Pro in good state contain most often.
GOOD_STATE_HZ = 0.8
#: Bytes per sample -> CSPC models with the same packets, in which the bits of samples have other
#: meanings.
CSPC_MODELS = {
    2: ("cspc-m1c1-mini-v11",),
    3: ("cspc-m1c1-mini", "cspc-coin-d4", "cspc-coin-d4a", "cspc-coin-d6"),
}


def make_angle() -> Construct:
    """Return the struct of the first or the last angle of a packet (FSA or LSA)."""
    return ByteSwapped(
        BitStruct(
            "angle" / Scaled(BitsInteger(15), 1 / 64, "deg"), "check" / Const(1, BitsInteger(1))
        )
    )


def plausible(f: Fields) -> Any:
    """Return whether angles are below 360 degrees and the number of samples is valid."""
    return (
        (f.fsa.angle < 360)
        & (f.lsa.angle < 360)
        & (f.lsn >= 1)
        & ((f.ct.start == 0) | (f.lsn == 1))
    )


@cache
def make_data_frame(sample_format: SampleFormat) -> Frame:
    """Return the frame of a packet with samples of this format."""
    frequency = Scaled(BitsInteger(7), 0.1, "Hz", sample_format.lowest_frequency_hz)
    struct = Struct(
        "header" / Const(b"\xaa\x55"),
        "ct"
        / BitStruct(
            "frequency"
            / frequency
            * (
                "in the first packet of a revolution: scans per second, unknown if the raw value is"
                " 0; in other packets: the state of a T-mini or an X4 Pro"
            ),
            "start"
            / BitsInteger(1)
            * "1: the first packet of a revolution (zero packet), which has one sample",
        ),
        "lsn" / Int8ul * "number of samples",
        "fsa" / make_angle() * "angle of the first sample",
        "lsa" / make_angle() * "angle of the last sample",
        "cs" / Int16ul,
        "samples" / Array(this.lsn, sample_format.struct),
    )
    checked_struct = Checksummed(
        struct, field="cs", algorithm=WordXor(head=8, groups=sample_format.groups)
    )
    return Frame(
        checked_struct, data=True, max_length=10 + sample_format.size * 255, plausible=plausible
    )


@cache
def make_points_function(sample_format: SampleFormat) -> Callable[[Fields], Points]:
    """Return the `points` function of packets with samples of this format."""
    return partial(points, sample_format=sample_format)


def points(f: Fields, sample_format: SampleFormat) -> Polar:
    """Return points at equal steps from the first angle (FSA) to the last angle (LSA)."""
    raw = spread(f.fsa.angle, f.lsa.angle, f.lsn, full=360.0)  # degrees, (n, LSN)
    clockwise = (
        raw
        if sample_format.correction is None
        else raw + sample_format.correction(f.samples.distance)
    )
    rate_hz = last(
        f.ct.frequency,
        where=(f.ct.start == 1) & (f.ct.frequency > sample_format.lowest_frequency_hz),
    )
    return Polar(
        range=f.samples.distance,
        azimuth=-np.deg2rad(clockwise),
        intensity=f.samples.intensity if sample_format.has_intensity else None,
        time=np.nan_to_num((raw - f.fsa.angle) / (rate_hz * 360)),
    )


def sweep(i: int, model: Model) -> dict[str, float]:
    """Return the simulated values of packet i."""
    steps = int(model.rate / SIMULATED_SPEED_HZ)
    packet = i % (1 + -(-(steps - 1) // SAMPLES_PER_PACKET))
    first = 0 if packet == 0 else 1 + (packet - 1) * SAMPLES_PER_PACKET
    count = 1 if packet == 0 else min(SAMPLES_PER_PACKET, steps - first)
    return {
        "ct.frequency": SIMULATED_SPEED_HZ
        if packet == 0
        else model.sample_format.lowest_frequency_hz + GOOD_STATE_HZ * model.has_state,
        "ct.start": int(packet == 0),
        "lsn": count,
        "fsa.angle": first * 360 / steps,
        "lsa.angle": (first + count - 1) * 360 / steps,
    }


def make_id(name: str) -> str:
    """Return the id of a model: "T-mini Pro" is "ydlidar-tmini-pro"."""
    return "ydlidar-" + name.lower().replace("t-mini", "tmini").replace(" ", "-")


def contains_state(f: Fields, lowest_frequency_hz: float) -> Any:
    """Return whether a packet contains the device's state.

    Source: protocol, CT.
    """
    return (f.ct.start == 0) & (f.ct.frequency > lowest_frequency_hz)


def describe_difference(own: Model, other: Model) -> str | Relative:
    """Return how to recognize another model with the same sample size."""
    if other.has_state and not own.has_state:
        return Relative(
            "the other model sets bits of CT in packets that do not begin a revolution",
            partial(contains_state, lowest_frequency_hz=own.sample_format.lowest_frequency_hz),
        )
    if own.number and other.number:
        return "info.model"
    return "both models send the same packets; the label and possibly the baud rate differ"


def describe_relatives(name: str) -> dict[str, str | Relative]:
    """Return how to recognize each of the other models with the same sample size.

    Returns:
        A dict from the id of the other model to a text or a `Relative`.
    """
    own_model = MODELS[name]
    models = {
        make_id(other): describe_difference(own_model, model)
        for other, model in MODELS.items()
        if other != name and model.sample_format.size == own_model.sample_format.size
    }
    return models | dict.fromkeys(
        CSPC_MODELS.get(own_model.sample_format.size, ()),
        "a sensor of the vendor CSPC, which sends similar packets, also sends an `info` frame when"
        " it is started",
    )


def make_lidar(name: str) -> Sensor:
    """Return the description of a model."""
    model = MODELS[name]
    has_requests = not model.is_send_only
    source = "YDLIDAR SDK: communication protocol, data set of models"
    if model.status == "capture":
        source += "; packets captured from a unit"
    return Sensor(
        make_id(name),
        vendor="YDLIDAR",
        model=name,
        frames=(
            {**ANSWERS, "data": make_data_frame(model.sample_format), "request": REQUEST}
            if has_requests
            else {"scan_start": SCAN_START, "data": make_data_frame(model.sample_format)}
        ),
        points=make_points_function(model.sample_format),
        scan=OnFlag("ct.start"),
        links={"data": Serial(model.baud)},
        commands=COMMANDS if has_requests else {},
        simulation=Simulation(
            partial(sweep, model=model),
            answers={"get_info": (("info", {"model": model.number}),)} if has_requests else {},
        ),
        on_open=("start_motor", "stop", "scan") if has_requests else (),
        on_close=("stop", "stop_motor") if has_requests else (),
        range_limits=model.range_limits,
        vendor_axes=("forward", "right", "up"),
        turn=model.turn,
        relatives=describe_relatives(name),
        info={"serial": "info.serial", "model": "info.model"} if has_requests else {},
        status=model.status,
        source=source,
    )


#: Every model as an attribute, named by its id without the vendor: `SENSORS.tmini_pro`.
SENSORS = SimpleNamespace(
    **{
        make_id(name).removeprefix("ydlidar-").replace("-", "_"): make_lidar(name)
        for name in MODELS
    }
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the YDLIDAR models."""
    return vars(SENSORS).values()
