"""Hesai QT128C2X: protocol 3.2, a header, 2 blocks of 128 channels, 1127 bytes.

CRCs cover the blocks, the functional safety part and the tail.

Source: HesaiLidar_SDK_2.0 (udp_protocol_v3_2.h; angle and firing-time files of a sample unit). The
CRCs are verified with a capture of tier4/nebula. The capture also shows that the second block
follows the first after 111.11 us (nebula has the opposite order). Two loops alternate from shot to
shot; each loop fires 92 of the channels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from construct import BitsInteger, BitStruct, Bytes, Const, Int8ul, Int16ul, Int32ul, Struct

from lidarspec.spec import Fields, Frame, Polar, Scaled
from lidarspec_hesai.calibration import Calibration, make_nominal_table
from lidarspec_hesai.crc_packets import (
    ACKNOWLEDGED,
    BLOCKS,
    LASERS,
    distance,
    make_packet,
    max_packet_bytes,
    packet_values,
    plausible,
)
from lidarspec_hesai.family import make_spinning_sensor
from lidarspec_hesai.parts import (
    FACTORY,
    RETURN_MODE,
    UTC,
    count_returns,
    make_points,
    rotation_values,
)

BLOCKS_PER_TURN = 900  # at 10 Hz and single return: 0.4 degrees
FIRST_SHOT_S = 9e-6  # from the packet's time to the first shot
SHOT_PERIOD_S = 111.11e-6  # from shot to shot

# fmt: off
ELEVATION = (
    -52.6267628, -51.0280939, -49.5149539, -48.0739479, -46.694663, -45.3688281, -44.0897444, -42.8519013, -41.6506977, -40.482254,
    -39.3432636, -38.2308809, -37.1426365, -36.0763732, -35.0301945, -34.0024259, -32.9915776, -31.9963104, -31.0154318, -30.0478647,
    -29.0926271, -28.148832, -27.2156699, -26.2924036, -25.3783508, -24.4728832, -23.5754231, -22.6854407, -21.8024369, -20.9259433,
    -20.055536, -19.1908137, -18.3313917, -17.476919, -16.6270544, -15.7814932, -14.9399303, -14.1020803, -13.2676719, -12.4364557,
    -11.608182, -10.7826137, -9.9595235, -9.13869704, -8.3199296, -7.50300541, -6.68780716, -5.87392688, -5.06139351, -4.24994832,
    -3.43941536, -2.6296176, -1.82037833, -1.01152245, -0.202883525, 0.605717878, 1.41444437, 2.22346905, 3.03296288, 3.8431104,
    4.65407451, 5.46603472, 6.27918022, 7.09369685, 7.90976047, 8.72757986, 9.54735011, 10.3692736, 11.1935685, 12.0204614, 12.8501683,
    13.6829467, 14.5190331, 15.3586992, 16.2022213, 17.0498869, 17.902002, 18.7589005, 19.6209191, 20.4884218, 21.3618072, 22.2414922,
    23.1279117, 24.0215536, 24.9229318, 25.8326022, 26.7511656, 27.6792734, 28.6176339, 29.5670247, 30.5282897, 31.5023624, 32.4902644,
    33.4931367, 34.5122368, 35.5489791, 19.1908137, 20.055536, 20.9259433, 21.8024369, 22.6854407, 23.5754231, 24.4728832, 25.3783508,
    26.2924036, 27.2156699, 28.148832, 29.0926271, 30.0478647, 31.0154318, 31.9963104, 32.9915776, 34.0024259, 35.0301945, 36.0763732,
    37.1426365, 38.2308809, 39.3432636, 40.482254, 41.6506977, 42.8519013, 44.0897444, 45.3688281, 46.694663, 48.0739479, 49.5149539,
    51.0280939, 52.6267628,
)
AZIMUTH = (
    10.108306, 9.71950367, 9.38426583, 9.09143333, 8.83289966, 8.60260573, 8.3959205, 8.20921068, 8.03961095, 7.8848012, 7.74288787,
    7.61231176, 7.49177168, 7.38016421, 7.2765624, 7.1801716, 7.090302, 7.0063691, 6.92784897, 6.85429555, 6.78530694, 6.72053692,
    6.65966687, 6.60242846, 6.54856987, 6.49787281, 6.45012995, 6.40517895, 6.36284026, 6.32298504, 6.2854673, 6.25017485, -6.21699538,
    -6.18583344, -6.15659915, -6.12920819, -6.10358185, -6.07966398, -6.0573814, -6.03668353, -6.01751973, -5.99983366, -5.98359728,
    -5.96877118, -5.95531025, -5.94319201, -5.92671987, -5.9228766, -5.91462871, -5.90763907, -5.9018851, -5.89735553, -5.89403909,
    -5.89193583, -5.89103442, -5.89132922, -5.89283156, -5.89554141, -5.89945875, -5.90460053, -5.91096668, -5.9185798, -5.9274511,
    -5.93760882, 5.94906415, 5.96184526, 5.97598597, 5.99150874, 6.00846433, 6.02687514, 6.04679752, 6.06828214, 6.09137392, 6.11613476,
    6.14262649, 6.17092787, 6.20111192, 6.23326857, 6.26748766, 6.30387024, 6.34253988, 6.38361437, 6.42723394, 6.47355562, 6.52274755,
    6.57499455, 6.63050945, 6.68952166, 6.75229973, 6.8191287, 6.89034381, 6.96631916, 7.0474731, 7.13428503, 7.22733459, 7.32722233,
    -6.25017485, -6.2854673, -6.32298504, -6.36284026, -6.40517895, -6.45012995, -6.49787281, -6.54856987, -6.60242846, -6.65966687,
    -6.72053692, -6.78530694, -6.85429555, -6.92784897, -7.0063691, -7.090302, -7.1801716, -7.2765624, -7.38016421, -7.49177168,
    -7.61231176, -7.74288787, -7.8848012, -8.03961095, -8.20921068, -8.3959205, -8.60260573, -8.83289966, -9.09143333, -9.38426583,
    -9.71950367, -10.108306,
)
#: The firing times of the channels in the two alternating loops; 0 if the channel does not fire.
LOOP_1_US = (
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 27.656, 53, 2.312, 78.344, 81.512,
    5.48, 56.168, 30.824, 33.992, 59.336, 8.648, 84.68, 87.848, 11.816, 62.504, 37.16, 40.328, 65.672, 14.984, 91.016, 94.184, 18.152,
    68.84, 43.496, 46.664, 72.008, 21.32, 97.352, 100.52, 24.488, 75.176, 49.832, 1.456, 77.488, 26.8, 52.144, 55.312, 29.968, 80.656,
    4.624, 7.792, 83.824, 33.136, 58.48, 61.648, 36.304, 86.992, 10.96, 14.128, 90.16, 39.472, 64.816, 67.984, 42.64, 93.328, 17.296,
    20.464, 96.496, 45.808, 71.152, 74.32, 48.976, 99.664, 23.632, 25.944, 51.288, 0.6, 76.632, 79.8, 3.768, 54.456, 29.112, 32.28, 57.624,
    6.936, 82.968, 86.136, 10.104, 60.792, 35.448, 38.616, 63.96, 13.272, 89.304, 92.472, 16.44, 67.128, 41.784, 44.952, 70.296, 19.608,
    95.64, 98.808, 22.776, 73.464, 48.12,
)
LOOP_2_US = (
    2.312, 78.344, 27.656, 53, 56.168, 30.824, 81.512, 5.48, 8.648, 84.68, 33.992, 59.336, 62.504, 37.16, 87.848, 11.816, 14.984, 91.016,
    40.328, 65.672, 68.84, 43.496, 94.184, 18.152, 21.32, 97.352, 46.664, 72.008, 75.176, 49.832, 100.52, 24.488, 0, 0, 0, 0, 0, 0, 0, 0,
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.6, 76.632, 25.944, 51.288, 54.456, 29.112, 79.8, 3.768,
    6.936, 82.968, 32.28, 57.624, 60.792, 35.448, 86.136, 10.104, 13.272, 89.304, 38.616, 63.96, 67.128, 41.784, 92.472, 16.44, 19.608,
    95.64, 44.952, 70.296, 73.464, 48.12, 98.808, 22.776, 26.8, 52.144, 1.456, 77.488, 80.656, 4.624, 55.312, 29.968, 33.136, 58.48, 7.792,
    83.824, 86.992, 10.96, 61.648, 36.304, 39.472, 64.816, 14.128, 90.16, 93.328, 17.296, 67.984, 42.64, 45.808, 71.152, 20.464, 96.496,
    99.664, 23.632, 74.32, 48.976,
)
# fmt: on

VERSION = ("major" / Const(3, Int8ul), "minor" / Const(2, Int8ul))
CHANNEL = Struct(
    "distance" / Int16ul * "in steps of dis_unit; 0: no return",
    "reflectivity" / Int8ul,
    "confidence" / Int8ul,
)
TAIL = (
    "tail_reserved" / Bytes(5),
    "mode_flag"
    / BitStruct(
        "reserved" / BitsInteger(7),
        "loop" / BitsInteger(1) * "with dual return: the loop to which the packet belongs",
    ),
    "tail_reserved_2" / Bytes(6),
    "return_mode" / RETURN_MODE,
    "motor_speed" / Scaled(Int16ul, 1, "rpm"),
    "utc" / UTC,
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time since the date and time in `utc`",
    "factory" / Int8ul * FACTORY,
)


def points(f: Fields, channels: Calibration) -> Polar:
    """Return the points of a packet.

    Source: HesaiLidar_SDK_2.0 (times of the shots).
    """
    block = np.arange(BLOCKS)[:, None]
    returns = count_returns(f.return_mode)
    loop = np.where(returns > 1, f.mode_flag.loop, block % 2)
    fired = (
        FIRST_SHOT_S + SHOT_PERIOD_S * (block // returns) + np.where(loop == 0, 0, 1) * LOOP_DELAY_S
    )
    return make_points(
        f.body.blocks, channels, distance=distance(f), block=block, returns=returns, fired=fired
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i, at 10 Hz with single return."""
    return packet_values(rotation_values(i, BLOCKS, BLOCKS_PER_TURN), confidence=1)


TABLE = make_nominal_table(ELEVATION, AZIMUTH, LOOP_1_US)
#: The seconds from the firing of each channel in the first loop to its firing in the second.
LOOP_DELAY_S = (np.array(LOOP_2_US) - np.array(LOOP_1_US)) * 1e-6

QT128 = make_spinning_sensor(
    "hesai-qt128",
    {
        "data": Frame(
            make_packet(VERSION, CHANNEL[LASERS], TAIL, verify_crc=True),
            data=True,
            max_length=max_packet_bytes(BLOCKS, 2 + 4 * LASERS),
            plausible=plausible,
            acknowledged=ACKNOWLEDGED,
        )
    },
    points,
    TABLE,
    sweep,
    "body.blocks.azimuth",
    model="QT128C2X",
    range_limits=(0.05, 50.0),
    status="vectors",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_v3_2.h, QT128C2X correction files); one captured packet"
        " of tier4/nebula"
    ),
)
