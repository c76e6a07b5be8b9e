"""RoboSense RS-Ruby and RS-Ruby Plus: rotating lidars of 48 to 128 lasers over UDP.

The RS-Ruby models are RS-LiDAR-128, -80 and -48. The RS-Ruby Plus models have 128, 80 or 48 lasers;
there are two models with 80 lasers, 80 and 80V. Both series send the same packets, which have 3, 4
or 8 blocks; a block contains all lasers. With dual return, a firing has two blocks. A packet of
three blocks then contains one and a half firings: if one packet contains the blocks A A B, the next
packet contains the blocks B C C.

Source: RS-Ruby Plus user manual, Table 5-2 to 5-5 (header, return modes, blocks), RS-Ruby user
manual, Table 4; the vendor's rs_driver (decoder_RS128.hpp, decoder_RS80.hpp, decoder_RS48.hpp and
the RSP variants: firing times, optical centre, DIFOP).

The sources disagree. Series and model are at bytes 31 and 32 in the manual, and at 30 and 31 in
rs_driver, so both positions are read. In the manuals, the return mode is in every packet; rs_driver
reads it from DIFOP, with other codes for each model. This module follows the manuals. Early units
send the time in seconds and nanoseconds, but this module always reads seconds and microseconds.
According to the manual, with dual return the first of two blocks contains the last returns, and the
second block contains the strongest returns.

No table of nominal angles was found. The angles are assumed to be evenly spaced over 40 degrees,
with the lowest laser first. 40 degrees is the field of view in the data sheets for 128 and 80
lasers. It is also assumed that a packet with the series number 5 is from a Ruby Plus. The range
limits are from rs_driver, and are the same for all models.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from construct import BitsInteger, BitStruct, Bytes, Const, Enum, Int8ub, Int16ub, Struct
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
    RotorModel,
    make_angles,
    make_blocks,
    make_clock_status,
    points_of_firings,
    rotation_values,
    sweep_difop,
)

# lower bits of the return mode in a packet
SINGLE = 1
DUAL = 3
PLUS_SERIES = 5
#: Lasers -> model number of a Ruby Plus.
MODELS = {128: 1, 80: 2, 48: 4}
MODEL_NAMES = {
    "RS-Ruby Plus": 1,
    "RS-Ruby Plus 80": 2,
    "RS-Ruby Plus 80V": 3,
    "RS-Ruby Plus 48": 4,
}
MODEL_80V = 3
#: Lasers -> blocks per packet.
BLOCKS = {128: 3, 80: 4, 48: 8}
#: Lasers -> bytes after the blocks.
END_BYTES = {128: 4, 80: 192, 48: 4}


def make_packet_struct(lasers: int) -> Struct:
    """Return the struct of a data packet of a model with `lasers` lasers."""
    flag = Struct("mark" / Const(b"\xfe"), "return_id" / Int8ub)
    return Struct(
        "header" / Const(b"\x55\xaa\x05\x5a"),
        "protocol_version" / Int16ub,
        "reserved_6" / Bytes(1),
        "wave_mode"
        / BitStruct(
            "reserved" / BitsInteger(4),
            "returns" / Enum(BitsInteger(4), first=1, second=2, both=3),
        ),
        "temperature" / TEMPERATURE_BE,
        *TIME,
        "reserved_20" / Bytes(10),
        "type_30" / Int8ub * "the series according to rs_driver, see `series`",
        "series" / Int8ub * "5: RS-Ruby Plus; according to rs_driver, this byte is the model",
        "model" / Enum(Int8ub, **MODEL_NAMES),
        "reserved_33" / Bytes(47),
        "blocks" / make_blocks(BLOCKS[lasers], lasers, 0.005, flag=flag),
        "reserved_end" / Bytes(END_BYTES[lasers]),
    )


def make_difop(lasers: int) -> Struct:
    """Return the struct of the device information, with the angles of 128 lasers."""
    other_vertical = () if lasers == 128 else ("others_vertical" / make_angles(128 - lasers),)
    other_horizontal = () if lasers == 128 else ("others_horizontal" / make_angles(128 - lasers),)
    start = (*DIFOP_HEAD, *DIFOP_VERSIONS, *DIFOP_UNIT, *DIFOP_TIME, *DIFOP_STATUS)
    ends = ("reserved_1236" / Bytes(10), DIFOP_TAIL)
    return Struct(
        *start,
        "vertical" / make_angles(lasers),
        *other_vertical,
        "horizontal" / make_angles(lasers),
        *other_horizontal,
        *ends,
    )


def plausible(f: Fields) -> Any:
    """Return whether azimuths are below 360 degrees."""
    return f.blocks.azimuth < 360


def is_plus(f: Fields) -> Any:
    """Return whether a packet contains the series number of the Ruby Plus."""
    return (f.series == PLUS_SERIES) | (f.type_30 == PLUS_SERIES)


def points(f: Fields, model: RotorModel, variant: NDArray[np.float64] | None = None) -> Polar:
    """Return the points of a packet.

    `variant` contains the firing times of an 80V in seconds.
    """
    first_echo = np.where(f.blocks[0].azimuth == f.blocks[1].azimuth, 0, 1)
    if variant is not None:
        is_80v = np.where(f.series == PLUS_SERIES, f.model, f.series) == MODEL_80V
        model = dataclasses.replace(model, delay=np.where(is_80v, variant, model.delay))
    return points_of_firings(f, f.wave_mode.returns == DUAL, model, first_echo=first_echo)


def pace(f: Fields, firings: int, period: float) -> Any:
    """Return the time from one packet to the next, in seconds.

    Args:
        firings: the number of firings in a packet with single return.
        period: the seconds from one firing to the next.
    """
    return np.where(f.wave_mode.returns == DUAL, firings / 2, firings) * period


def firing_times(times: Any, counts: Any) -> NDArray[np.float64]:
    """Return the firing time of each laser in seconds.

    Args:
        times: the firing times in microseconds.
        counts: the number of lasers that fire at each time.
    """
    return np.repeat(np.asarray(times, np.float64), counts) * 1e-6


def even_firing_times(*counts: int) -> NDArray[np.float64]:
    """Return the firing time of each laser in seconds, for evenly spaced firing times.

    The lasers form two groups. Both groups fire at the same 16 times, which are 3.236 us apart.
    Source: rs_driver.

    Args:
        counts: the number of lasers that fire at each time: 16 numbers for the first group, then 16
            numbers for the second group.
    """
    return firing_times(np.tile(np.arange(16) * 3.236, 2), counts)


def make_rotor(delay: NDArray[np.float64], period: float, lens_distance: float) -> RotorModel:
    """Return the `RotorModel` of a model with evenly spaced nominal angles.

    Args:
        delay: the firing times of the lasers in seconds.
        period: the seconds from one firing of all lasers to the next.
        lens_distance: the distance from the axis to the optical centre, metres.
    """
    return RotorModel(
        delay=delay,
        period=period,
        lens_distance=lens_distance,
        vertical=np.round(np.linspace(-25, 15, len(delay)), 2),
    )


# fmt: off
#: Firing times of a Ruby Plus in microseconds, and the number of lasers that fire at each time
#: (rs_driver).
TIMES_128_US = (
    0, 1.13, 2.13, 3.26, 4.26, 5.38, 6.38, 7.51, 8.51, 10.01, 11.38, 13.31, 15.11, 17.04, 18.85, 21.14, 23.31, 25.61, 27.78, 30.07, 32.24,
    34.54, 36.7, 38.64, 40.44, 41.94, 43.3, 44.8, 46.17, 47.66, 49.03, 50.53, 53.771,
)
TIMES_US = (
    0, 1.217, 2.434, 3.652, 4.869, 6.086, 7.304, 8.521, 9.739, 11.323, 12.907, 14.924, 16.941, 18.959, 20.976, 23.127, 25.278, 27.428,
    29.579, 31.963, 34.347, 36.498, 38.648, 40.666, 42.683, 50.603, 52.187, 53.771,
)
COUNTS_80 = (4, 4, 2, 3, 2, 2, 2, 2, 2, 2, 2, 2, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4, 2, 2, 1, 1, 3, 2)
# fmt: on

FRAMES = {
    lasers: {
        "data": Frame(make_packet_struct(lasers), data=True, plausible=plausible),
        "difop": Frame(make_difop(lasers), simulation=Simulation(sweep_difop, rate=1)),
    }
    for lasers in BLOCKS
}


def make_model(id: str, name: str, rotor: RotorModel, relative: str, variant: Any = None) -> Sensor:
    """Return the sensor of a Ruby or Ruby Plus; the id of a Ruby Plus contains "plus".

    Args:
        relative: the id of the corresponding model of the other series.
        variant: the firing times that are used if packets identify the model as an 80V.
    """
    lasers = len(rotor.delay)
    is_plus_model = "plus" in id
    model_values = {"series": PLUS_SERIES, "model": MODELS[lasers]} if is_plus_model else {}
    sweep = partial(
        rotation_values,
        shots=BLOCKS[lasers],
        period=rotor.period,
        **model_values,
        **{"wave_mode.returns": SINGLE},
    )
    model_info = {"model": "data.model"} if is_plus_model else {}
    return Sensor(
        id,
        model=name,
        frames=FRAMES[lasers],
        points=partial(points, model=rotor, variant=variant),
        state=rotor.make_default_state(),
        simulation=Simulation(sweep),
        range_limits=(0.4, 250.0),  # rs_driver's limits for these models
        info={"serial": "difop.serial_number", "firmware": "difop.top_firmware", **model_info},
        relatives={
            relative: (
                Relative("series other than 5", lambda f: ~is_plus(f))
                if is_plus_model
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
                pace=partial(pace, firings=BLOCKS[lasers], period=rotor.period),
                epoch="utc",  # as in `COMMON`
                status=make_clock_status(),
            ),
        },
    )


RS128_ROTOR = make_rotor(even_firing_times(*[4] * 32), 55.55e-6, 0.03615)
RS80_COUNTS = ((3, 2, 4, 3, 3, 3, 3, *[2] * 8, 3), (3, 3, 3, 2, 4, 2, 3, 3, 2, 2, 2, 3, 2, 1, 2, 3))
RS80_ROTOR = make_rotor(even_firing_times(*RS80_COUNTS[0], *RS80_COUNTS[1]), 55.552e-6, 0.03615)
RS48_ROTOR = make_rotor(even_firing_times(*[1, 1, 1, 1, 2, 2, 2, 2] * 4), 55.552e-6, 0.03615)
PLUS_128_ROTOR = make_rotor(
    firing_times(TIMES_128_US, [4] * 15 + [5] + [4] * 15 + [2, 1]), 55.56e-6, 0.02892
)
PLUS_80_ROTOR = make_rotor(firing_times(TIMES_US, COUNTS_80), 55.56e-6, 0.02892)
PLUS_48_ROTOR = make_rotor(firing_times(TIMES_US[:24], [2] * 24), 55.56e-6, 0.02892)

RS128 = make_model("robosense-rs128", "RS-LiDAR-128", RS128_ROTOR, "robosense-ruby-plus-128")
RS80 = make_model("robosense-rs80", "RS-LiDAR-80", RS80_ROTOR, "robosense-ruby-plus-80")
RS48 = make_model("robosense-rs48", "RS-LiDAR-48", RS48_ROTOR, "robosense-ruby-plus-48")
RUBY_PLUS_128 = make_model(
    "robosense-ruby-plus-128",
    "RS-Ruby Plus",
    PLUS_128_ROTOR,
    "robosense-rs128",
)
RUBY_PLUS_80 = make_model(
    "robosense-ruby-plus-80",
    "RS-Ruby Plus 80",
    PLUS_80_ROTOR,
    "robosense-rs80",
    variant=firing_times(TIMES_US[:20], [4] * 20),
)
RUBY_PLUS_48 = make_model(
    "robosense-ruby-plus-48",
    "RS-Ruby Plus 48",
    PLUS_48_ROTOR,
    "robosense-rs48",
)
