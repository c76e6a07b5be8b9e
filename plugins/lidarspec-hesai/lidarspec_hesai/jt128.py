"""Hesai JT128: packets like those of a Pandar128E3X, with a `status_version` of at least 137.

A packet differs from one of a Pandar128E3X in three points: the number of blocks in the header may
be other than 2, the motor speed has steps of 0.1 rpm, and the packet's time is 1.888 ms after the
last shot. The usual number of blocks, the range limits and the rotation speed are not public. The
simulation has 2 blocks per packet, and 10 revolutions a second.

Source: HesaiLidar_SDK_2.0 (udp_protocol_v1_4.h, udp1_4_parser.cc; angle and firing-time files of
the model).
"""

from __future__ import annotations

from typing import Any

from construct import Int8ul

from lidarspec.spec import Fields, Frame, Polar
from lidarspec_hesai.calibration import Calibration, make_nominal_table
from lidarspec_hesai.crc_packets import (
    BLOCKS,
    LASERS,
    UNSEEN,
    distance,
    make_packet,
    max_packet_bytes,
    packet_values,
    plausible,
)
from lidarspec_hesai.family import make_spinning_sensor
from lidarspec_hesai.header_packets import block_numbers
from lidarspec_hesai.pandar128 import CHANNEL, MIN_JT128_STATUS, VERSION, make_tail, relatives
from lidarspec_hesai.parts import count_returns, make_points, rotation_values

MAX_BLOCKS = 8  # more do not fit into one datagram
BLOCKS_PER_TURN = 900  # at 10 Hz: 0.4 degrees, from the time of a block
LAST_SHOT_S = -1.888e-3  # from the packet's time to the last shot
SHOT_PERIOD_S = 111e-6  # from shot to shot

# fmt: off
ELEVATION = (
    -4.965, -3.739, -2.781, -1.659, -0.774, 0.261, 1.084, 2.056, 2.732, 3.485, 4.388, 5.117, 5.989, 6.695, 7.552, 8.235, 9.156, 9.998,
    10.645, 11.471, 12.112, 12.919, 13.55, 14.345, 15.053, 15.664, 16.442, 17.051, 17.83, 18.425, 19.194, 19.788, 20.612, 21.342,
    21.958, 22.681, 23.297, 24.01, 24.629, 25.331, 25.877, 26.501, 27.2, 27.814, 28.517, 29.119, 29.828, 30.418, 31.202, 31.937, 32.509,
    33.233, 33.815, 34.525, 35.122, 35.813, 36.365, 36.999, 37.664, 38.281, 38.963, 39.561, 40.264, 40.837, 41.628, 42.35, 42.921,
    43.629, 44.225, 44.911, 45.526, 46.191, 46.758, 47.434, 48.058, 48.697, 49.359, 49.963, 50.66, 51.231, 52.024, 52.736, 53.332,
    54.013, 54.64, 55.287, 55.956, 56.565, 57.202, 57.89, 58.516, 59.146, 59.839, 60.408, 61.163, 61.663, 62.558, 63.329, 63.899,
    64.612, 65.252, 65.895, 66.613, 67.176, 67.885, 68.819, 69.263, 70.038, 70.653, 71.241, 72.06, 72.417, 73.633, 75.093, 75.094,
    76.289, 76.582, 77.427, 78.093, 78.473, 79.196, 80.584, 81.931, 83.19, 84.982, 86.601, 88.192, 88.865,
)
AZIMUTH = (
    169.963, 161.294, 169.967, 161.331, 169.967, 161.348, 169.966, 161.348, 173.731, 182.357, 173.749, 182.389, 173.758, 182.431,
    173.774, 182.479, 169.855, 161.143, 169.872, 161.108, 169.887, 161.072, 169.902, 161.021, 173.579, 182.521, 173.616, 182.629,
    173.652, 182.743, 173.689, 182.867, 169.744, 160.49, 169.753, 160.398, 169.761, 160.298, 169.768, 160.189, 173.745, 183.485, 173.8,
    183.656, 173.858, 183.841, 173.915, 184.033, 169.6, 159.354, 169.596, 159.188, 169.584, 159.01, 169.567, 158.82, 174.087, 185.082,
    174.153, 185.354, 174.222, 185.646, 174.292, 185.949, 169.416, 157.564, 169.397, 157.298, 169.374, 157.013, 169.352, 156.71,
    174.679, 187.745, 174.784, 188.181, 174.895, 188.643, 175.012, 189.138, 169.143, 154.659, 169.101, 154.174, 169.052, 153.648,
    168.998, 153.077, 175.724, 192.52, 175.906, 193.323, 176.097, 194.207, 176.308, 195.17, 168.701, 149.063, 168.602, 148.005, 168.487,
    146.818, 168.351, 145.48, 177.926, 203.623, 178.414, 205.834, 178.981, 208.363, 179.626, 211.286, 167.527, 131.298, 167.36, 127.313,
    167.152, 122.445, 166.865, 116.456, 197.894, 202.402, 208.615, 217.57, 168.105, 174.582, 192.726, 269.353,
)
FIRING_US = (
    95.18, 23.24, 98.22, 20.2, 101.26, 17.16, 104.3, 14.12, 77.28, 92.14, 74.24, 89.1, 71.2, 86.06, 68.16, 83.02, 50.26, 11.08, 47.22,
    8.04, 44.18, 5, 41.14, 1.96, 65.12, 105.82, 62.08, 102.78, 59.04, 99.74, 56, 96.7, 38.1, 24.76, 35.06, 21.72, 32.02, 18.68, 28.98,
    15.64, 78.8, 93.66, 75.76, 90.62, 72.72, 87.58, 69.68, 84.54, 51.78, 12.6, 48.74, 9.56, 45.7, 6.52, 42.66, 3.48, 66.64, 103.54,
    63.6, 100.5, 60.56, 97.46, 57.52, 94.42, 39.62, 22.48, 36.58, 19.44, 33.54, 16.4, 30.5, 13.36, 76.52, 91.38, 73.48, 88.34, 70.44,
    85.3, 67.4, 82.26, 49.5, 10.32, 46.46, 7.28, 43.42, 4.24, 40.38, 1.2, 64.36, 105.06, 61.32, 102.02, 58.28, 98.98, 55.24, 95.94,
    37.34, 24, 34.3, 20.96, 31.26, 17.92, 28.22, 14.88, 78.04, 92.9, 75, 89.86, 71.96, 86.82, 68.92, 83.78, 51.02, 11.84, 47.98, 8.8,
    44.94, 5.76, 41.9, 2.72, 65.88, 62.84, 59.8, 56.76, 38.86, 35.82, 32.78, 29.74,
)
# fmt: on


def points(f: Fields, channels: Calibration) -> Polar:
    """Return the points of a packet.

    Source: HesaiLidar_SDK_2.0 (the last shot is 1.888 ms before the packet's time).
    """
    block = block_numbers(f)
    returns = count_returns(f.return_mode)
    fired = LAST_SHOT_S - SHOT_PERIOD_S * ((f.block_count - 1 - block) // returns)
    return make_points(
        f.body.blocks, channels, distance=distance(f), block=block, returns=returns, fired=fired
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i, at 10 Hz with single return."""
    return {
        **packet_values(rotation_values(i, BLOCKS, BLOCKS_PER_TURN), imu=1),
        "status_version": MIN_JT128_STATUS,
        "block_count": BLOCKS,
    }


JT128 = make_spinning_sensor(
    "hesai-jt128",
    {
        "data": Frame(
            make_packet(VERSION, CHANNEL[LASERS], make_tail(0.1), blocks=Int8ul, imu=True),
            data=True,
            max_length=max_packet_bytes(MAX_BLOCKS, 2 + 6 * LASERS),
            plausible=plausible,
        )
    },
    points,
    make_nominal_table(ELEVATION, AZIMUTH, FIRING_US),
    sweep,
    "body.blocks.azimuth",
    model="JT128",
    range_limits=(0.0, 262.14),  # the limits of the field with steps of 4 mm
    relatives=relatives("hesai-jt128"),
    status="manual",
    source=f"HesaiLidar_SDK_2.0 (udp_protocol_v1_4.h, JT128 correction files); {UNSEEN}",
)
