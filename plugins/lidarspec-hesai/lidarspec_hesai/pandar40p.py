"""Hesai Pandar40P: 40 channels, packets without header, of 1262 or 1266 bytes.

    10 x [FF EE, azimuth, 40 x (distance, reflectivity)], tail(22) [, sequence]

Packets with the UDP sequence have 1266 bytes. Only the length shows whether the sequence is
present, so there are two frame types, and `decode` uses the type that arrives first.

Source: HesaiLidar_SDK_2.0 (udp_protocol_p40.h; angle and firing-time files of a sample unit);
tier4/nebula.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Int32ul, Struct

from lidarspec.spec import Clock, Fields, Frame, Polar, Scaled
from lidarspec_hesai.calibration import Calibration, make_nominal_table
from lidarspec_hesai.family import make_spinning_sensor
from lidarspec_hesai.parts import CLOCK, TAIL_40P, count_returns, make_points, rotation_values

BLOCKS = 10
CHANNELS = 40
BLOCKS_PER_TURN = 1800  # at 10 Hz and single return: 0.2 degrees
LAST_SHOT_S = -28.58e-6  # from the packet's time to the last shot
SHOT_PERIOD_S = 55.56e-6  # from shot to shot

# fmt: off
ELEVATION = (
    15.21, 11.36, 8.387, 5.385, 3.368, 2.356, 2.016, 1.679, 1.341, 1.003, 0.665, 0.328, -0.009, -0.347, -0.685, -1.023, -1.36,
    -1.7, -2.037, -2.372, -2.712, -3.047, -3.384, -3.722, -4.057, -4.392, -4.729, -5.063, -5.398, -5.733, -6.735, -7.731, -8.732,
    -9.557, -10.704, -11.678, -12.646, -13.602, -18.561, -24.569,
)
AZIMUTH = (
    -1.042, -1.042, -1.042, -1.042, -1.042, -1.042, 3.125, -5.208, -1.042, 3.125, -5.208, -1.042, 3.125, -5.208, -1.042, 3.125,
    -5.208, -1.042, 3.125, -5.208, -1.042, 3.125, -5.208, -1.042, 3.125, -5.208, -1.042, 3.125, -5.208, -1.042, -1.042, -1.042,
    -1.042, -1.042, -1.042, -1.042, -1.042, -1.042, -1.042, -1.042,
)
FIRING_US = (
    -42.22, -28.47, -16.04, -3.62, -45.49, -31.74, -47.46, -54.67, -20.62, -33.71, -40.91, -8.19, -20.62, -27.16, -50.73, -8.19,
    -14.74, -36.98, -45.49, -52.7, -23.89, -31.74, -38.95, -11.47, -18.65, -25.19, -48.76, -6.23, -12.77, -35.01, -21.92, -9.5,
    -43.52, -29.77, -17.35, -4.92, -42.22, -28.47, -16.04, -3.62,
)
# fmt: on

DATA = Struct(
    "blocks"
    / Array(
        BLOCKS,
        Struct(
            "sync" / Const(b"\xff\xee"),
            "azimuth" / Scaled(Int16ul, 0.01, "deg") * "clockwise, seen from above",
            "channels"
            / Array(
                CHANNELS,
                Struct(
                    "distance" / Scaled(Int16ul, 0.004, "m") * "0: no return",
                    "reflectivity" / Int8ul,
                ),
            ),
        ),
    ),
    *TAIL_40P,
)
DATA_WITH_SEQUENCE = Struct(*DATA.subcons, "sequence" / Int32ul)


def plausible(f: Fields) -> Any:
    """Return whether azimuths are below 360 degrees and the factory byte is known."""
    return (f.blocks.azimuth < 360) & ((f.factory == 0x42) | (f.factory == 0x43))


def points(f: Fields, channels: Calibration) -> Polar:
    """Return the points of a packet.

    Source: HesaiLidar_SDK_2.0 (times of the shots).
    """
    block = np.arange(BLOCKS)[:, None]
    returns = count_returns(f.return_mode)
    fired = LAST_SHOT_S - SHOT_PERIOD_S * ((BLOCKS - 1 - block) // returns)
    return make_points(
        f.blocks,
        channels,
        distance=f.blocks.channels.distance,
        block=block,
        returns=returns,
        fired=fired,
    )


def pace(f: Fields, blocks: int) -> Any:
    """Return the seconds from a packet to the next: the duration of the shots of a packet.

    Source: HesaiLidar_SDK_2.0.
    """
    return SHOT_PERIOD_S * blocks / count_returns(f.return_mode)


def make_clock(blocks: int) -> Clock:
    """Return the clock for packets with `blocks` blocks."""
    return replace(CLOCK, pace=partial(pace, blocks=blocks))


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i, at 10 Hz with single return."""
    return rotation_values(i, BLOCKS, BLOCKS_PER_TURN)


TABLE = make_nominal_table(ELEVATION, AZIMUTH, FIRING_US)

PANDAR40P = make_spinning_sensor(
    "hesai-pandar40p",
    {
        "data": Frame(DATA, data=True, plausible=plausible),
        "data_sequence": Frame(DATA_WITH_SEQUENCE, data=True, plausible=plausible),
    },
    points,
    TABLE,
    sweep,
    model="Pandar40P",
    clock=make_clock(BLOCKS),
    range_limits=(0.3, 200.0),
    status="capture",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_p40.h, Pandar40P correction files); captures of"
        " tier4/nebula and velocity.report"
    ),
)
