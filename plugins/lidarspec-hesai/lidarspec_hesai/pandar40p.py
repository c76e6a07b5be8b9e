"""Hesai Pandar40P: 40 channels, a packet without header, of 1262 bytes, or 1266 with the UDP
sequence.

    10 x [FF EE, azimuth, 40 x (distance, reflectivity)], tail(22) [, sequence]

Nothing in the packet says whether the sequence is there, only its length does: so there are two
frame types, and `decode` reads by the one that arrives first.

Source: HesaiLidar_SDK_2.0 (udp_protocol_p40.h; angle and firing-time files of a sample unit);
tier4/nebula.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from construct import Array, Const, Int8ul, Int16ul, Int32ul, Struct

from lidarspec.spec import Clock, Fields, Frame, Polar, Scaled
from lidarspec_hesai.calibration import Calibration, nominal
from lidarspec_hesai.family import spinning
from lidarspec_hesai.parts import TAIL_40P, beams, clock, returns_of, turning

BLOCKS = 10
CHANNELS = 40
PER_TURN = 1800  # blocks in a turn at 10 Hz and single return: 0.2 degrees
LAST_SHOT = -28.58e-6
SHOT = 55.56e-6  # seconds from the packet's time to the last shot, and from shot to shot

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

PLAIN = Struct(
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
COUNTED = Struct(*PLAIN.subcons, "sequence" / Int32ul)


def plausible(f: Fields) -> Any:
    """Azimuths below 360 degrees and a known factory byte."""
    return (f.blocks.azimuth < 360) & ((f.factory == 0x42) | (f.factory == 0x43))


def points(f: Fields, channels: Calibration) -> Polar:
    """Shots before the packet's time (HesaiLidar_SDK_2.0); with dual return, pairs of blocks are
    one shot.
    """
    block = np.arange(BLOCKS)[:, None]
    returns = returns_of(f.return_mode)
    fired = LAST_SHOT - SHOT * ((BLOCKS - 1 - block) // returns)
    return beams(
        f.blocks,
        channels,
        distance=f.blocks.channels.distance,
        block=block,
        returns=returns,
        fired=fired,
    )


def pace(f: Fields, blocks: int) -> Any:
    """Return the seconds that the shots of a packet take (HesaiLidar_SDK_2.0)."""
    return SHOT * blocks / returns_of(f.return_mode)


def paced_clock(blocks: int) -> Clock:
    """Return the clock of packets with so many blocks, which may lack the sequence."""
    return Clock(clock, pace=partial(pace, blocks=blocks))


def sweep(i: int) -> dict[str, Any]:
    """Packet i at 10 Hz with single return."""
    return turning(i, BLOCKS, PER_TURN)


TABLE = nominal(ELEVATION, AZIMUTH, FIRING_US)

PANDAR40P = spinning(
    "hesai-pandar40p",
    {
        "data": Frame(PLAIN, data=True, plausible=plausible),
        "data_sequence": Frame(COUNTED, data=True, plausible=plausible),
    },
    points,
    TABLE,
    sweep,
    model="Pandar40P",
    clock=paced_clock(BLOCKS),
    range_limits=(0.3, 200.0),
    status="capture",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_p40.h, Pandar40P correction files); captures of"
        " tier4/nebula and velocity.report"
    ),
)
