"""Hesai Pandar128E3X and OT128: protocol 1.4, 2 blocks of 128 channels.

A packet has 861 bytes, 893 with a signature:

    EE FF 01 04  status 00 | 80 02 first_return unit return_count flags
    2 x [azimuth, 128 x (distance, reflectivity [, confidence] [, weight] [, environment])], CRC
    [safety], tail [, sequence] [, IMU], CRC [, signature]

The models differ in the status. The CRCs probably cover the same bytes as in packets of a QT128. No
captured packet was available to confirm this, so the CRCs are read but not checked. The operational
state and the azimuth state of the block determine which channels fire and when. Below 2.85 m, 32
channels of a Pandar128E3X fire 0.8 to 16.7 us later than in the tables of this module.

Source: HesaiLidar_SDK_2.0 (udp_protocol_v1_4.h, udp1_4_parser.cc: status of each model, block and
firing times; angle and firing-time files of sample units); Pandar128E3X user manual (lengths; the
firing times apply to both the "standard" and the "energy saving" state). tier4/nebula has other
times for an OT128.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from construct import Bytes, Const, If, Int8ul, Int16ul, Int32ul, Struct, this

from lidarspec.spec import Fields, Frame, Polar, Relative, Scaled, take
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
from lidarspec_hesai.parts import (
    FACTORY,
    RETURN_MODE,
    UTC,
    count_returns,
    make_points,
    rotation_values,
)

BLOCKS_PER_TURN = 1800  # 0.2 degrees, at 10 Hz and single return, in the standard state
SHOT_PERIOD_S = 27.778e-6  # in operational state 0; twice as long in other states
STANDARD_STATE = 2  # the simulated operational state
MIN_OT128_STATUS = 128
MIN_JT128_STATUS = 137

# fmt: off
ELEVATION = (
    14.436, 13.535, 13.081786, 12.624, 12.165246, 11.702, 11.238522, 10.771, 10.305007, 9.83, 9.356123, 8.88, 8.401321, 7.921, 7.43808,
    6.952581, 6.466905, 5.977753, 5.487, 4.995801, 4.501, 4.007293, 3.509, 3.012822, 2.512, 2.013, 1.885, 1.761, 1.637, 1.511, 1.385875,
    1.2582, 1.13, 1.008459, 0.88, 0.756, 0.63, 0.505, 0.378591, 0.251, 0.124, -0.00015, -0.129, -0.2541, -0.38, -0.506126, -0.63235,
    -0.75979, -0.887242, -1.012168, -1.141, -1.2662, -1.393, -1.519337, -1.646275, -1.773301, -1.900587, -2.026912, -2.155, -2.2815,
    -2.409, -2.534932, -2.662501, -2.789024, -2.916055, -3.043698, -3.172, -3.299, -3.425, -3.552222, -3.680335, -3.806265, -3.932954,
    -4.06183, -4.19, -4.318, -4.444, -4.570508, -4.699079, -4.824327, -4.950584, -5.080608, -5.209, -5.336, -5.463, -5.589088,
    -5.718031, -5.842508, -5.968246, -6.099661, -6.607262, -7.117295, -7.624327, -8.133802, -8.639587, -9.149, -9.652353, -10.16,
    -10.665443, -11.17, -11.671568, -12.174, -12.673194, -13.173, -13.669682, -14.166, -14.660411, -15.154, -15.644783, -16.135,
    -16.622221, -17.106088, -17.592171, -18.071976, -18.54765, -19.029597, -19.50071, -19.978461, -20.44479, -20.918108, -21.37943,
    -21.848107, -22.30422, -22.768055, -23.21878, -23.677577, -24.12274, -25.01577,
)
AZIMUTH = (
    3.257, 3.263, 1.091414, 3.268, 1.092504, 3.273, 1.093621, 3.278, 1.094766, 3.283, 1.095941, 3.288, 1.097146, 3.291, 1.098384,
    -1.101114, 1.099655, -1.103649, -3.306, -1.106118, -3.311, -1.108519, -3.318, -1.110852, -3.324, -1.113115, 7.72, 5.535, 3.325,
    -3.33, 1.10673, -5.538035, -7.726107, -1.115309, 7.731, 5.543, 3.329, -3.336, 1.108227, -5.546813, -7.738215, -1.117431, 7.743,
    5.550783, 3.335, -3.341759, 1.109762, -5.555361, -7.750039, -1.119482, 7.757, 5.559905, 3.34, -3.347338, 1.111338, -5.564415,
    -7.762486, -1.12146, 7.768, 5.568891, 3.345, -3.352812, 1.112953, -5.573332, -7.774765, -1.123366, 7.78, 5.577739, 3.351, -3.358181,
    1.114609, -5.582111, -7.786874, -1.125199, 7.792, 5.586449, 3.356, -3.363443, 1.116305, -5.590751, -7.798811, -1.126958, 7.804,
    5.595019, 3.36, -3.368599, 1.118042, -5.599251, -7.810576, -1.128643, -3.373647, -1.130255, -3.378587, -1.131792, -3.383419, 3.381,
    -3.388143, 3.386, 1.127077, 3.39, 1.129045, 3.395, 1.131048, 3.401, 1.133088, 3.406, 1.135163, 3.41, 1.137272, 3.416, 1.139412,
    -1.142319, 1.141584, -1.143128, -3.425708, -1.143867, -3.429329, -1.144538, -3.432841, -1.14514, -3.436242, -1.145675, -3.439533,
    -1.146145, -3.442714, -1.146549, -3.445786, -3.448749,
)
GROUPS = (
    "abcdaefghcdfbhebgfgcdehgaijkjllmkkinonjjlokpmpiipmmlkknnopojijoo"
    "mllinipkijpmlomlnnnopmkpjdcafhecbddagbefaebgfhhgcagdehcbafhedcfb"
)
TIMES_US = {
    "a": (4.436, 0, 4.436, 0, 4.436, 4.436),
    "b": (0, 0.776, 0, 0.776, 28.554, 28.554),
    "c": (0.776, 0, 0.776, 0, 0.776, 0.776),
    "d": (2.431, 0, 2.781, 0, 2.431, 2.781),
    "e": (0, 2.781, 0, 2.431, 30.559, 30.209),
    "f": (6.441, 0, 6.091, 0, 6.441, 6.091),
    "g": (0, 4.786, 0, 4.086, 32.564, 31.864),
    "h": (0, 6.441, 0, 6.091, 34.219, 33.869),
    "i": (10.381, 10.731, 10.381, 10.031, 38.509, 37.809),
    "j": (14.951, 15.301, 14.951, 14.601, 43.079, 42.379),
    "k": (12.666, 13.016, 12.666, 12.316, 12.666, 12.666),
    "l": (19.521, 19.871, 19.521, 19.171, 19.521, 19.521),
    "m": (8.096, 8.446, 8.096, 7.746, 36.224, 35.524),
    "n": (24.091, 24.441, 24.091, 23.741, 52.219, 51.519),
    "o": (17.236, 17.586, 17.236, 16.886, 17.236, 17.236),
    "p": (21.806, 22.156, 21.806, 21.456, 21.806, 21.806),
}
OT128_ELEVATION = (
    14.985, 13.283, 11.758, 10.483, 9.836, 9.171, 8.496, 7.812, 7.462, 7.115, 6.767, 6.416, 6.064, 5.71, 5.355, 4.998, 4.643, 4.282,
    3.921, 3.558, 3.194, 2.829, 2.463, 2.095, 1.974, 1.854, 1.729, 1.609, 1.487, 1.362, 1.242, 1.12, 0.995, 0.875, 0.75, 0.625, 0.5,
    0.375, 0.25, 0.125, 0, -0.125, -0.25, -0.375, -0.5, -0.626, -0.751, -0.876, -1.001, -1.126, -1.251, -1.377, -1.502, -1.627, -1.751,
    -1.876, -2.001, -2.126, -2.251, -2.376, -2.501, -2.626, -2.751, -2.876, -3.001, -3.126, -3.251, -3.376, -3.501, -3.626, -3.751,
    -3.876, -4.001, -4.126, -4.25, -4.375, -4.501, -4.626, -4.751, -4.876, -5.001, -5.126, -5.252, -5.377, -5.502, -5.626, -5.752,
    -5.877, -6.002, -6.378, -6.754, -7.13, -7.507, -7.882, -8.257, -8.632, -9.003, -9.376, -9.749, -10.121, -10.493, -10.864, -11.234,
    -11.603, -11.975, -12.343, -12.709, -13.075, -13.439, -13.803, -14.164, -14.525, -14.879, -15.237, -15.593, -15.948, -16.299,
    -16.651, -17, -17.347, -17.701, -18.386, -19.063, -19.73, -20.376, -21.653, -23.044, -24.765,
)
OT128_AZIMUTH = (
    0.186, 0.185, 1.335, 1.343, 0.148, 0.147, 0.146, 0.146, 1.335, 1.336, 1.337, 1.338, 1.339, 1.34, 1.341, 1.342, 0.128, 0.128, 0.127,
    0.127, 0.107, 0.106, 0.105, 0.105, -3.118, 1.315, 4.529, -3.121, 1.316, 4.532, -3.124, 1.317, 4.536, -3.127, 1.317, 4.539, -3.13,
    1.318, 4.542, -3.133, 0.103, 2.935, -1.517, 0.103, 2.937, -1.519, 0.103, 2.939, -1.52, 0.103, 2.941, -1.521, 0.102, 2.943, -1.523,
    0.102, 2.945, -1.524, 0.102, 2.946, -1.526, 0.102, 2.948, -1.526, 1.324, 4.57, -3.155, 1.325, 4.573, -3.157, 1.326, 4.575, -3.159,
    1.326, 4.578, -3.161, 1.327, 4.581, -3.163, 1.328, 4.583, -3.165, 1.329, 4.586, -3.167, 1.329, 4.588, -3.168, 0.102, 0.103, 0.103,
    0.103, 0.104, 0.104, 0.104, 0.104, 1.337, 1.337, 1.338, 1.339, 1.34, 1.341, 1.341, 1.342, 0.108, 0.108, 0.109, 0.109, 0.13, 0.131,
    0.131, 0.132, 1.384, 1.384, 1.385, 1.385, 1.386, 1.386, 1.387, 1.387, 0.151, 0.153, 0.154, 0.156, 1.388, 1.408, 0.196, 0.286,
)
OT128_GROUPS = (
    "abcdefghabcdefghabcdefghijkjilmnmnkoolppmjinkjolkpmlinmjonkpolip"
    "mjinkjolkpmlinmjonkpolipabcdefghabcdefghabcdefghabcdefghabcdefgh"
)
OT128_TIMES_US = {
    "a": (0, 18.867, 0, 18.867, 46.645, 46.645),
    "b": (0, 6.289, 0, 6.289, 34.067, 34.067),
    "c": (18.867, 0, 21.011, 0, 18.867, 21.011),
    "d": (6.289, 0, 6.289, 0, 6.289, 6.289),
    "e": (0, 12.578, 0, 12.578, 40.356, 40.356),
    "f": (0, 0, 0, 0, 27.778, 27.778),
    "g": (12.578, 0, 14.722, 0, 12.578, 14.722),
    "h": (0, 0, 0, 0, 0, 0),
    "i": (20.52, 20.52, 22.664, 20.52, 20.52, 22.664),
    "j": (16.549, 16.549, 18.693, 16.549, 16.549, 18.693),
    "k": (10.26, 10.26, 10.26, 10.26, 10.26, 10.26),
    "l": (3.971, 3.971, 3.971, 3.971, 3.971, 3.971),
    "m": (14.231, 14.231, 16.375, 14.231, 14.231, 16.375),
    "n": (7.942, 7.942, 7.942, 7.942, 7.942, 7.942),
    "o": (1.653, 1.653, 1.653, 1.653, 1.653, 1.653),
    "p": (22.838, 22.838, 24.982, 22.838, 22.838, 24.982),
}
# fmt: on

FLAGS = this._._._.flags
CHANNEL = Struct(
    "distance" / Int16ul * "in steps of dis_unit; 0: no return",
    "reflectivity" / Int8ul,
    "confidence" / If(FLAGS.confidence == 1, Int8ul),
    "weight" / If(FLAGS.weight == 1, Int8ul),
    "environment" / If(FLAGS.environment == 1, Int8ul),
)
VERSION = ("major" / Const(1, Int8ul), "minor" / Const(4, Int8ul))


def make_tail(speed: float) -> Any:
    """Return the fields of the tail; the motor speed has steps of `speed` rpm."""
    return (
        "tail_reserved" / Bytes(9),
        "azimuth_state"
        / Int16ul
        * "two bits per block; the highest bits are those of the first block",
        "operational_state"
        / Int8ul
        * "0: high performance; other values: standard or energy saving",
        "return_mode" / RETURN_MODE,
        "motor_speed" / Scaled(Int16ul, speed, "rpm"),
        "utc" / UTC,
        "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time since the date and time in `utc`",
        "factory" / Int8ul * FACTORY,
    )


FRAMES = {
    "data": Frame(
        make_packet(VERSION, CHANNEL[LASERS], make_tail(1), imu=True),
        data=True,
        max_length=max_packet_bytes(BLOCKS, 2 + 6 * LASERS),
        plausible=plausible,
    )
}


def points(f: Fields, channels: Calibration, last: float, times: Any) -> Polar:
    """Return the points of a packet.

    Source: HesaiLidar_SDK_2.0 (time of the last shot).

    Args:
        last: the time from the packet's time to the last shot, seconds.
        times: the firing times of the channels in each state, (states, channels), seconds.
    """
    block = np.arange(BLOCKS)[:, None]
    returns = count_returns(f.return_mode)
    duration_factor = np.where(f.operational_state == 0, 1, 2)
    state = np.mod(np.floor(f.azimuth_state / 4.0 ** (7 - block)), 4)
    delay = take(times, np.where(f.operational_state == 0, state, 4 + np.mod(state, 2)))
    fired = last - SHOT_PERIOD_S * duration_factor * ((BLOCKS - 1 - block) // returns) + delay
    return make_points(
        f.body.blocks, channels, distance=distance(f), block=block, returns=returns, fired=fired
    )


def sweep(i: int, status: int) -> dict[str, Any]:
    """Return the values of simulated packet i, at 10 Hz with single return."""
    values = packet_values(rotation_values(i, BLOCKS, BLOCKS_PER_TURN), imu=1, safety=1)
    return {
        **values,
        "status_version": status,
        "operational_state": STANDARD_STATE,
        "azimuth_state": 0x1000,
    }


def channel_times(groups: str, times_us: Mapping[str, Sequence[float]]) -> Any:
    """Return channels' firing times in each state, in seconds, (states, channels).

    Args:
        groups: a letter for each channel, which names its group.
        times_us: the firing time of each group in each state, in microseconds.
    """
    return np.array([times_us[group] for group in groups]).T * 1e-6


def relatives(own: str) -> dict[str, Relative]:
    """Return how to recognize each of the other models that send these packets.

    Args:
        own: the id of the model for which the others are described.

    Returns:
        Id of another model -> how its packets differ.
    """
    others = {
        "hesai-pandar128": Relative(
            "a status_version below 128", lambda f: f.status_version < MIN_OT128_STATUS
        ),
        "hesai-ot128": Relative("a status_version from 128 to 136", is_ot128),
        "hesai-jt128": Relative(
            "a status_version of 137 or more", lambda f: f.status_version >= MIN_JT128_STATUS
        ),
    }
    return {id: other for id, other in others.items() if id != own}


def is_ot128(f: Fields) -> Any:
    """Return whether the status is that of an OT128."""
    return (f.status_version >= MIN_OT128_STATUS) & (f.status_version < MIN_JT128_STATUS)


PANDAR128 = make_spinning_sensor(
    "hesai-pandar128",
    FRAMES,
    partial(points, last=3.148e-6, times=channel_times(GROUPS, TIMES_US)),
    make_nominal_table(ELEVATION, AZIMUTH, np.zeros(LASERS)),
    partial(sweep, status=0),
    "body.blocks.azimuth",
    model="Pandar128E3X",
    range_limits=(0.3, 200.0),
    relatives=relatives("hesai-pandar128"),
    status="manual",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_v1_4.h, Pandar128E3X correction files), Pandar128E3X"
        f" user manual; {UNSEEN}"
    ),
)

OT128 = make_spinning_sensor(
    "hesai-ot128",
    FRAMES,
    partial(points, last=0.0, times=channel_times(OT128_GROUPS, OT128_TIMES_US)),
    make_nominal_table(OT128_ELEVATION, OT128_AZIMUTH, np.zeros(LASERS)),
    partial(sweep, status=MIN_OT128_STATUS),
    "body.blocks.azimuth",
    model="OT128",
    range_limits=(0.3, 200.0),
    relatives=relatives("hesai-ot128"),
    status="manual",
    source=f"HesaiLidar_SDK_2.0 (udp_protocol_v1_4.h, OT128 correction files); {UNSEEN}",
)
