"""RoboSense RS-Ruby (RS-LiDAR-128, -80, -48) and RS-Ruby Plus (128, 80, 80V, 48): rotating lidars
of 48 to 128 lasers over UDP.

Both series send the same packets, of 3, 4 or 8 blocks of all lasers. Three blocks with dual return
hold one shot and a half: A A B, then B C C.

Source: RS-Ruby Plus user manual, Table 5-2 to 5-5 (header, return modes, blocks), RS-Ruby user
manual, Table 4; the vendor's rs_driver (decoder_RS128.hpp, decoder_RS80.hpp, decoder_RS48.hpp and
their RSP namesakes: firing times, optical centre, DIFOP).

Contradictions: the manual has series and model at bytes 31 and 32, rs_driver at 30 and 31, so both
are looked at; rs_driver takes the return mode from DIFOP, with codes that differ by model, the
manuals have it in every packet, which is what stands here. The seconds of a time are followed by
nanoseconds in early units. In dual return the manual has the last return first, then the strongest.

Assumed: nominal angles, even steps over the 40 degrees of the 128 and 80 lasers' data sheets, the
lowest laser first, for no table was found: before the first DIFOP packet clouds say that they are
nominal; and that no RS-Ruby has the number of the Ruby Plus, 5, as series. What the ranges of a
model's own unit are, and where rs_driver has them alike for all, is rs_driver's.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from construct import BitsInteger, BitStruct, Bytes, Const, Int8ub, Int16ub, Struct
from numpy.typing import NDArray

from lidarspec.spec import Clock, Fields, Frame, Polar, Relative, Sensor, Simulation
from lidarspec_robosense.rotor import (
    COMMON,
    DIFOP_HEAD,
    DIFOP_STATUS,
    DIFOP_TAIL,
    DIFOP_TIME,
    DIFOP_UNIT,
    DIFOP_VERSIONS,
    TEMPERATURE_BE,
    TIME,
    Rotor,
    angles,
    blocks,
    pairs,
    sweep,
    sweep_difop,
)

SINGLE = 1
DUAL = 3  # lower bits of the return mode in a packet
PLUS = 5  # series
MODELS = {128: 1, 80: 2, 48: 4}  # of the Ruby Plus, by lasers
MODEL_80V = 3
BLOCKS = {128: 3, 80: 4, 48: 8}
AFTER = {128: 4, 80: 192, 48: 4}  # bytes after the blocks


def packet(lasers: int) -> Struct:
    """Return a data packet of a model with so many lasers."""
    flag = Struct("mark" / Const(b"\xfe"), "return_id" / Int8ub)
    return Struct(
        "header" / Const(b"\x55\xaa\x05\x5a"),
        "protocol_version" / Int16ub,
        "reserved_6" / Bytes(1),
        "wave_mode"
        / BitStruct(
            "reserved" / BitsInteger(4), "returns" / BitsInteger(4) * "1 first, 2 second, 3 both"
        ),
        "temperature" / TEMPERATURE_BE,
        *TIME,
        "reserved_20" / Bytes(10),
        "type_30" / Int8ub * "the series, according to rs_driver",
        "series" / Int8ub * "5 RS-Ruby Plus; the model, according to rs_driver",
        "model"
        / Int8ub
        * "1 RS-Ruby Plus, 2 RS-Ruby Plus 80, 3 RS-Ruby Plus 80V, 4 RS-Ruby Plus 48",
        "reserved_33" / Bytes(47),
        "blocks" / blocks(BLOCKS[lasers], lasers, 0.005, flag=flag),
        "reserved_end" / Bytes(AFTER[lasers]),
    )


def difop(lasers: int) -> Struct:
    """Device information: angles of 128 lasers, of which a model with fewer has the first ones."""
    others = () if lasers == 128 else ("others_vertical" / angles(128 - lasers),)
    more = () if lasers == 128 else ("others_horizontal" / angles(128 - lasers),)
    start = (*DIFOP_HEAD, *DIFOP_VERSIONS, *DIFOP_UNIT, *DIFOP_TIME, *DIFOP_STATUS)
    ends = ("reserved_1236" / Bytes(10), DIFOP_TAIL)
    return Struct(
        *start, "vertical" / angles(lasers), *others, "horizontal" / angles(lasers), *more, *ends
    )


def plausible(f: Fields) -> Any:
    """Azimuths below 360 degrees."""
    return f.blocks.azimuth < 360


def is_plus(f: Fields) -> Any:
    """Return whether a packet names the Ruby Plus as its series."""
    return (f.series == PLUS) | (f.type_30 == PLUS)


def points(f: Fields, model: Rotor, variant: NDArray[np.float64] | None = None) -> Polar:
    """With dual return the first block may hold the second return of a shot; `variant`: the delays
    of an 80V.
    """
    late = np.where(f.blocks[0].azimuth == f.blocks[1].azimuth, 0, 1)
    if variant is not None:
        named = np.where(f.series == PLUS, f.model, f.series) == MODEL_80V
        model = dataclasses.replace(model, delay=np.where(named, variant, model.delay))
    return pairs(f, f.wave_mode.returns == DUAL, model, late=late)


def pace(f: Fields, shots: int, period: float) -> Any:
    """Return the seconds from a packet to the next; with dual return, two blocks are one shot."""
    return np.where(f.wave_mode.returns == DUAL, shots / 2, shots) * period


def firing_times(times: Any, counts: Any) -> NDArray[np.float64]:
    """Seconds of lasers of which so many fire at each of some times in microseconds."""
    return np.repeat(np.asarray(times, np.float64), counts) * 1e-6


def steps(*counts: int) -> NDArray[np.float64]:
    """Seconds of lasers of which so many fire at each of 16 times, 3.236 us apart, in two rows
    (rs_driver).
    """
    return firing_times(np.tile(np.arange(16) * 3.236, 2), counts)


def rotor(delay: NDArray[np.float64], period: float, lens: float) -> Rotor:
    """Return a model by its firing times, with nominal angles."""
    return Rotor(
        delay=delay,
        period=period,
        lens=lens,
        vertical=np.round(np.linspace(-25, 15, len(delay)), 2),
    )


# fmt: off
#: microseconds at which lasers of a Ruby Plus fire, and how many at each (rs_driver).
TIMES_128 = (
    0, 1.13, 2.13, 3.26, 4.26, 5.38, 6.38, 7.51, 8.51, 10.01, 11.38, 13.31, 15.11, 17.04, 18.85, 21.14, 23.31, 25.61, 27.78, 30.07, 32.24,
    34.54, 36.7, 38.64, 40.44, 41.94, 43.3, 44.8, 46.17, 47.66, 49.03, 50.53, 53.771,
)
TIMES = (
    0, 1.217, 2.434, 3.652, 4.869, 6.086, 7.304, 8.521, 9.739, 11.323, 12.907, 14.924, 16.941, 18.959, 20.976, 23.127, 25.278, 27.428,
    29.579, 31.963, 34.347, 36.498, 38.648, 40.666, 42.683, 50.603, 52.187, 53.771,
)
COUNTS_80 = (4, 4, 2, 3, 2, 2, 2, 2, 2, 2, 2, 2, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 2, 2, 1, 1, 3, 2)
# fmt: on

FRAMES = {
    lasers: {
        "data": Frame(packet(lasers), data=True, plausible=plausible),
        "difop": Frame(difop(lasers), simulation=Simulation(sweep_difop, rate=1)),
    }
    for lasers in BLOCKS
}


def model(id: str, name: str, rotor: Rotor, relative: str, variant: Any = None) -> Sensor:
    """Return a Ruby, or where its id says so a Ruby Plus; what the two series have in common."""
    lasers = len(rotor.delay)
    plus = "plus" in id
    own = {"series": PLUS, "model": MODELS[lasers]} if plus else {}
    data = partial(
        sweep, shots=BLOCKS[lasers], period=rotor.period, **own, **{"wave_mode.returns": SINGLE}
    )
    named = {"model": "data.model"} if plus else {}
    return Sensor(
        id,
        model=name,
        frames=FRAMES[lasers],
        points=partial(points, model=rotor, variant=variant),
        state=rotor.state(),
        simulation=Simulation(data),
        range_limits=(0.4, 250.0),  # rs_driver's limits for these models
        info={"serial": "difop.serial_number", "firmware": "difop.top_firmware", **named},
        relatives={
            relative: (
                Relative("series other than 5", lambda f: ~is_plus(f))
                if plus
                else Relative("series 5", is_plus)
            )
        },
        source=(
            "RS-Ruby Plus and RS-Ruby user manuals; rs_driver; not tested with packets of this"
            " model"
        ),
        **{
            **COMMON,
            "clock": Clock(
                ("seconds", "microseconds"),
                pace=partial(pace, shots=BLOCKS[lasers], period=rotor.period),
            ),
        },
    )


RS128_ROTOR = rotor(steps(*[4] * 32), 55.55e-6, 0.03615)
RS80_COUNTS = ((3, 2, 4, 3, 3, 3, 3, *[2] * 8, 3), (3, 3, 3, 2, 4, 2, 3, 3, 2, 2, 2, 3, 2, 1, 2, 3))
RS80_ROTOR = rotor(steps(*RS80_COUNTS[0], *RS80_COUNTS[1]), 55.552e-6, 0.03615)
RS48_ROTOR = rotor(steps(*[1, 1, 1, 1, 2, 2, 2, 2] * 4), 55.552e-6, 0.03615)
PLUS_128_ROTOR = rotor(
    firing_times(TIMES_128, [4] * 15 + [5] + [4] * 15 + [2, 1]), 55.56e-6, 0.02892
)
PLUS_80_ROTOR = rotor(firing_times(TIMES, COUNTS_80), 55.56e-6, 0.02892)
PLUS_48_ROTOR = rotor(firing_times(TIMES[:24], [2] * 24), 55.56e-6, 0.02892)

RS128 = model("robosense-rs128", "RS-LiDAR-128", RS128_ROTOR, "robosense-ruby-plus-128")
RS80 = model("robosense-rs80", "RS-LiDAR-80", RS80_ROTOR, "robosense-ruby-plus-80")
RS48 = model("robosense-rs48", "RS-LiDAR-48", RS48_ROTOR, "robosense-ruby-plus-48")
RUBY_PLUS_128 = model(
    "robosense-ruby-plus-128",
    "RS-Ruby Plus",
    PLUS_128_ROTOR,
    "robosense-rs128",
)
RUBY_PLUS_80 = model(
    "robosense-ruby-plus-80",
    "RS-Ruby Plus 80",
    PLUS_80_ROTOR,
    "robosense-rs80",
    variant=firing_times(TIMES[:20], [4] * 20),
)
RUBY_PLUS_48 = model(
    "robosense-ruby-plus-48",
    "RS-Ruby Plus 48",
    PLUS_48_ROTOR,
    "robosense-rs48",
)
