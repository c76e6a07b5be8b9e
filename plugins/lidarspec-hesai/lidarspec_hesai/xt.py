"""Hesai PandarXT-32, PandarXT-16 and XT32M2X: protocol 6.1, a header, up to 8 blocks.

A packet of 8 blocks has 1080 bytes, or 568 bytes for an XT-16. A packet of an XT32M2X has 6 blocks
and 820 bytes.

Source: HesaiLidar_SDK_2.0 (udp_protocol_v6_1.h; correction files of the models, which give whole
degrees and no offsets).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from construct import Bytes, Int8ul, Int16ul, Int32ul

from lidarspec.spec import Fields, Frame, Polar, Relative, Scaled
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

BLOCKS = 8
BLOCKS_PER_TURN = 2000  # at 10 Hz and single return: 0.18 degrees
SHOT_PERIOD_S = 50e-6  # the last shot is at the packet's time

TAIL = (
    "reserved" / Bytes(10),
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
    block = block_numbers(f)
    returns = count_returns(f.return_mode)
    fired = -SHOT_PERIOD_S * ((f.block_count - 1 - block) // returns)
    return make_points(
        f.blocks, channels, distance=distance(f), block=block, returns=returns, fired=fired
    )


def sweep(i: int, blocks: int = BLOCKS) -> dict[str, Any]:
    """Return the values of simulated packet i, at 10 Hz with single return."""
    return {**simulated_header(blocks), **rotation_values(i, blocks, BLOCKS_PER_TURN)}


# fmt: off
ELEVATION_XT32M = (
    19.433708, 18.129961, 16.821214, 15.527467, 14.22747, 12.924973, 11.663726, 10.363728, 9.062481, 7.759984, 6.461237, 5.162489,
    3.864992, 2.566245, 1.273747, -0.0325, -1.339997, -2.637495, -3.937492, -5.233739, -6.529987, -7.827484, -9.126231, -10.426228,
    -11.719976, -12.984973, -14.27497, -15.567467, -16.859964, -18.157461, -19.451208, -20.747455,
)
AZIMUTH_XT32M = (
    0.175281, 0.175729, 0.173645, 0.171487, 0.169308, 0.167102, 0.166029, 0.161264, 0.160229, 0.161676, 0.159349, 0.158259, 0.155905,
    0.154796, 0.153668, 0.153816, 0.153966, 0.151599, 0.151743, 0.149387, 0.152042, 0.153463, 0.147404, 0.140117, 0.137839, 0.134276,
    0.150794, 0.1511, 0.147691, 0.146833, 0.144759, 0.143988,
)
# fmt: on


TABLE_32 = make_nominal_table(15.0 - np.arange(32), np.zeros(32), 6.0 + 1.512 * np.arange(32))
TABLE_16 = make_nominal_table(15.0 - 2.0 * np.arange(16), np.zeros(16), 6.0 + 3.024 * np.arange(16))
TABLE_XT32M = make_nominal_table(ELEVATION_XT32M, AZIMUTH_XT32M, 6.0 + 2.888 * (np.arange(32) % 16))

FRAMES_32 = {
    "data": Frame(
        make_packet(6, 1, 32, TAIL),
        data=True,
        max_length=max_packet_bytes(32, BLOCKS),
        plausible=plausible,
    )
}
FRAMES_16 = {
    "data": Frame(
        make_packet(6, 1, 16, TAIL),
        data=True,
        max_length=max_packet_bytes(16, BLOCKS),
        plausible=plausible,
    )
}

XT32 = make_spinning_sensor(
    "hesai-xt32",
    FRAMES_32,
    points,
    TABLE_32,
    sweep,
    model="PandarXT-32",
    range_limits=(0.05, 120.0),
    relatives={
        "hesai-xt32m": Relative(
            "6 blocks in a packet; an XT32 sends 8 blocks", lambda f: f.block_count == 6
        )
    },
    status="capture",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_v6_1.h, PandarXT correction files); capture of"
        " tier4/nebula"
    ),
)

XT16 = make_spinning_sensor(
    "hesai-xt16",
    FRAMES_16,
    points,
    TABLE_16,
    sweep,
    model="PandarXT-16",
    range_limits=(0.05, 120.0),
    status="vectors",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_v6_1.h, PandarXT-16 correction files); one captured"
        " packet of tier4/nebula"
    ),
)

XT32M = make_spinning_sensor(
    "hesai-xt32m",
    FRAMES_32,
    points,
    TABLE_XT32M,
    partial(sweep, blocks=6),
    model="XT32M2X",
    range_limits=(0.5, 300.0),
    relatives={
        "hesai-xt32": Relative(
            "8 blocks in a packet; an XT32M sends 6 blocks", lambda f: f.block_count == 8
        )
    },
    status="vectors",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_v6_1.h, PandarXT-32M2X correction files); one captured"
        " packet of tier4/nebula"
    ),
)
