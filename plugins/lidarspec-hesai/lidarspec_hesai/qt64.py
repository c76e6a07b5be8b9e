"""Hesai PandarQT64: protocol 3.1, a header, up to 4 blocks of 64 channels.

A packet has 1072 bytes with the UDP sequence.

Source: HesaiLidar_SDK_2.0 (udp_protocol_v3_1.h; angle and firing-time files of the model).
"""

from __future__ import annotations

from typing import Any

from construct import Bytes, Int8ul, Int16ul, Int32ul

from lidarspec.spec import Fields, Frame, Polar, Scaled, take
from lidarspec_hesai.calibration import Calibration, make_nominal_table
from lidarspec_hesai.family import make_spinning_sensor
from lidarspec_hesai.header_packets import (
    block_numbers,
    distance,
    make_packet,
    max_packet_bytes,
    plausible,
    simulated_header,
)
from lidarspec_hesai.parts import (
    FACTORY,
    RETURN_MODE,
    UTC,
    count_returns,
    make_points,
    rotation_values,
)

BLOCKS = 4
CHANNELS = 64
BLOCKS_PER_TURN = 600  # at 10 Hz and single return: 0.6 degrees
FIRST_SHOT_S = 25.71e-6  # from the packet's time to the first shot
SHOT_TIMES_S = (0.0, 166.67e-6, 333.33e-6, 500.0e-6)  # from the first shot

# fmt: off
ELEVATION = (
    -52.121, -49.785, -47.577, -45.477, -43.465, -41.528, -39.653, -37.831, -36.055, -34.32, -32.619, -30.95, -29.308, -27.69,
    -26.094, -24.517, -22.964, -21.42, -19.889, -18.372, -16.865, -15.368, -13.88, -12.399, -10.925, -9.457, -7.994, -6.535,
    -5.079, -3.626, -2.175, -0.725, 0.725, 2.175, 3.626, 5.079, 6.534, 7.993, 9.456, 10.923, 12.397, 13.877, 15.365, 16.861,
    18.368, 19.885, 21.415, 22.959, 24.524, 26.101, 27.697, 29.315, 30.957, 32.627, 34.328, 36.064, 37.84, 39.662, 41.537, 43.475,
    45.487, 47.587, 49.795, 52.133,
)
AZIMUTH = (
    8.736, 8.314, 7.964, 7.669, 7.417, 7.198, 7.007, 6.838, 6.688, 6.554, 6.434, 6.326, 6.228, 6.14, 6.059, 5.987, -5.27, -5.216,
    -5.167, -5.123, -5.083, -5.047, -5.016, -4.988, -4.963, -4.942, -4.924, -4.91, -4.898, -4.889, -4.884, -4.881, 5.493, 5.496,
    5.502, 5.512, 5.525, 5.541, 5.561, 5.584, 5.611, 5.642, 5.676, 5.716, 5.759, 5.808, 5.862, 5.921, -5.33, -5.396, -5.469,
    -5.55, -5.64, -5.74, -5.85, -5.974, -6.113, -6.269, -6.447, -6.651, -6.887, -7.163, -7.493, -7.892,
)
FIRING_US = (
    2.31, 4.37, 6.43, 8.49, 10.54, 12.6, 14.66, 16.71, 19.16, 21.22, 23.28, 25.34, 27.39, 29.45, 31.5, 33.56, 36.61, 38.67, 40.73,
    42.78, 44.84, 46.9, 48.95, 51.01, 53.45, 55.52, 57.58, 59.63, 61.69, 63.74, 65.8, 67.86, 70.9, 72.97, 75.02, 77.08, 79.14,
    81.19, 83.25, 85.3, 87.75, 89.82, 91.87, 93.93, 95.98, 98.04, 100.1, 102.15, 105.2, 107.26, 109.32, 111.38, 113.43, 115.49,
    117.54, 119.6, 122.05, 124.11, 126.17, 128.22, 130.28, 132.34, 134.39, 136.45,
)
# fmt: on

TAIL = (
    "reserved" / Bytes(10),
    "motor_speed" / Scaled(Int16ul, 1, "rpm"),
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time since the date and time in `utc`",
    "return_mode" / RETURN_MODE,
    "factory" / Int8ul * FACTORY,
    "utc" / UTC,
)


def points(f: Fields, channels: Calibration) -> Polar:
    """Return the points of a packet.

    Source: HesaiLidar_SDK_2.0 (times of the shots).
    """
    block = block_numbers(f)
    returns = count_returns(f.return_mode)
    fired = FIRST_SHOT_S + take(SHOT_TIMES_S, block // returns)
    return make_points(
        f.blocks, channels, distance=distance(f), block=block, returns=returns, fired=fired
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i, at 10 Hz with single return."""
    return {**simulated_header(BLOCKS), **rotation_values(i, BLOCKS, BLOCKS_PER_TURN)}


TABLE = make_nominal_table(ELEVATION, AZIMUTH, FIRING_US)

QT64 = make_spinning_sensor(
    "hesai-qt64",
    {
        "data": Frame(
            make_packet(3, 1, CHANNELS, TAIL),
            data=True,
            max_length=max_packet_bytes(CHANNELS, BLOCKS),
            plausible=plausible,
        )
    },
    points,
    TABLE,
    sweep,
    model="PandarQT64",
    range_limits=(0.1, 60.0),
    status="capture",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_v3_1.h, PandarQT correction files); capture of"
        " tier4/nebula"
    ),
)
