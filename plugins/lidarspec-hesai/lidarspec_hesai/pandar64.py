"""Hesai Pandar64: 64 channels, a header of eight bytes, six blocks, 1194 or 1198 bytes.

    EE FF 40 06 00 unit 00 00, 6 x [azimuth, 64 x (distance, reflectivity)], tail(22) [, sequence]

Packets with the UDP sequence have 1198 bytes. The tail is that of a Pandar40P, and only the length
shows whether the sequence is present.

Source: HesaiLidar_SDK_2.0 (udp_protocol_p64.h; angle and firing-time files of a sample unit); one
captured packet of tier4/nebula, in which the year counts from 1900.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import Array, Bytes, Const, Int8ul, Int16ul, Int32ul, Struct

from lidarspec.spec import Fields, Frame, Polar, Scaled
from lidarspec_hesai.calibration import Calibration, make_nominal_table
from lidarspec_hesai.family import make_spinning_sensor
from lidarspec_hesai.header_packets import SIMULATED_UNIT_MM, distance
from lidarspec_hesai.pandar40p import SHOT_PERIOD_S, make_clock
from lidarspec_hesai.parts import TAIL_40P, count_returns, make_points, rotation_values

BLOCKS = 6
CHANNELS = 64
BLOCKS_PER_TURN = 1800  # at 10 Hz and single return: 0.2 degrees
LAST_SHOT_S = -42.58e-6  # from the packet's time to the last shot

# fmt: off
ELEVATION = (
    14.708, 10.858, 7.885, 4.883, 2.866, 1.854, 1.686, 1.514, 1.348, 1.177, 1.01, 0.839, 0.672, 0.501, 0.334, 0.163, -0.005, -0.174,
    -0.343, -0.511, -0.682, -0.849, -1.019, -1.187, -1.358, -1.525, -1.696, -1.862, -2.034, -2.202, -2.372, -2.539, -2.71, -2.874, -3.047,
    -3.214, -3.384, -3.549, -3.722, -3.886, -4.058, -4.224, -4.395, -4.559, -4.732, -4.894, -5.066, -5.231, -5.403, -5.565, -5.739, -5.9,
    -6.072, -6.235, -7.237, -8.233, -9.234, -10.059, -11.206, -12.18, -13.148, -14.104, -19.063, -25.071,
)
AZIMUTH = (
    -1.042, -1.042, -1.042, -1.042, -1.042, -1.042, 1.042, 3.125, 5.208, -5.208, -3.125, -1.042, 1.042, 3.125, 5.208, -5.208, -3.125,
    -1.042, 1.042, 3.125, 5.208, -5.208, -3.125, -1.042, 1.042, 3.125, 5.208, -5.208, -3.125, -1.042, 1.042, 3.125, 5.208, -5.208, -3.125,
    -1.042, 1.042, 3.125, 5.208, -5.208, -3.125, -1.042, 1.042, 3.125, 5.208, -5.208, -3.125, -1.042, 1.042, 3.125, 5.208, -5.208, -3.125,
    -1.042, -1.042, -1.042, -1.042, -1.042, -1.042, -1.042, -1.042, -1.042, -1.042, -1.042,
)
FIRING_US = (
    -23.18, -21.876, -20.572, -19.268, -17.964, -16.66, -11.444, -46.796, -7.532, -36.956, -50.732, -54.668, -40.892, -44.828, -31.052,
    -34.988, -48.764, -52.7, -38.924, -42.86, -29.084, -33.02, -46.796, -25.148, -36.956, -50.732, -27.116, -40.892, -44.828, -31.052,
    -34.988, -48.764, -25.148, -38.924, -42.86, -29.084, -33.02, -52.7, -6.228, -54.668, -15.356, -27.116, -10.14, -23.18, -4.924, -21.876,
    -14.052, -17.964, -8.836, -19.268, -3.62, -20.572, -12.748, -16.66, -7.532, -11.444, -6.228, -15.356, -10.14, -4.924, -3.62, -14.052,
    -8.836, -12.748,
)
# fmt: on

CHANNEL = Struct(
    "distance" / Int16ul * "in steps of dis_unit; 0: no return", "reflectivity" / Int8ul
)
DATA = Struct(
    "sync" / Const(b"\xee\xff"),
    "lasers" / Const(CHANNELS, Int8ul),
    "block_count" / Const(BLOCKS, Int8ul),
    "header_reserved" / Bytes(1),
    "dis_unit" / Scaled(Int8ul, 1, "mm") * "size of one distance step",
    "header_end" / Const(bytes(2)),
    "blocks"
    / Array(
        BLOCKS,
        Struct(
            "azimuth" / Scaled(Int16ul, 0.01, "deg") * "clockwise",
            "channels" / Array(CHANNELS, CHANNEL),
        ),
    ),
    *TAIL_40P,
)
DATA_WITH_SEQUENCE = Struct(*DATA.subcons, "sequence" / Int32ul)


def plausible(f: Fields) -> Any:
    """Return whether unit, azimuths and factory byte are valid."""
    return (
        (f.dis_unit >= 1) & (f.blocks.azimuth < 360) & ((f.factory == 0x42) | (f.factory == 0x43))
    )


def points(f: Fields, channels: Calibration) -> Polar:
    """Return the points of a packet.

    Source: HesaiLidar_SDK_2.0 (times of the shots).
    """
    block = np.arange(BLOCKS)[:, None]
    returns = count_returns(f.return_mode)
    fired = LAST_SHOT_S - SHOT_PERIOD_S * ((BLOCKS - 1 - block) // returns)
    return make_points(
        f.blocks, channels, distance=distance(f), block=block, returns=returns, fired=fired
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i, at 10 Hz with single return."""
    return {"dis_unit": SIMULATED_UNIT_MM, **rotation_values(i, BLOCKS, BLOCKS_PER_TURN)}


TABLE = make_nominal_table(ELEVATION, AZIMUTH, FIRING_US)

PANDAR64 = make_spinning_sensor(
    "hesai-pandar64",
    {
        "data": Frame(DATA, data=True, plausible=plausible),
        "data_sequence": Frame(DATA_WITH_SEQUENCE, data=True, plausible=plausible),
    },
    points,
    TABLE,
    sweep,
    model="Pandar64",
    clock=make_clock(BLOCKS),
    range_limits=(0.3, 200.0),
    status="vectors",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_p64.h, Pandar64 correction files); one captured packet of"
        " tier4/nebula"
    ),
)
