"""Hesai PandarXT-32 and PandarXT-16: protocol 6.1, a header, up to 8 blocks, 1080 and 568 bytes.

Source: HesaiLidar_SDK_2.0 (udp_protocol_v6_1.h; correction files of the models, which give whole degrees and no offsets).
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np
from construct import Bytes, Int8ul, Int16ul, Int32ul

from lidarspec.spec import Clock, Fields, Frame, OnWrap, Polar, Relative, Scaled, Sensor, Sequence, Simulation, Udp
from lidarspec_hesai.calibration import Calibration, configure, nominal
from lidarspec_hesai.headed import block_numbers, distance, header, longest, packet, plausible
from lidarspec_hesai.parts import FACTORY, RETURN_MODES, TURN, UNPUBLISHED, UTC, beams, clock, turning

BLOCKS = 8
PER_TURN = 2000  # blocks in a turn at 10 Hz and single return: 0.18 degrees
SHOT = 50e-6  # seconds from shot to shot; the last one is at the packet's time

TAIL = (
    "reserved" / Bytes(10),
    "return_mode" / Int8ul * RETURN_MODES,
    "motor_speed" / Scaled(Int16ul, 1, "rpm"),
    "utc" / UTC,
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "within the second of utc",
    "factory" / Int8ul * FACTORY,
)


def points(f: Fields, channels: Calibration) -> Polar:
    """Shots up to the packet's time (HesaiLidar_SDK_2.0)."""
    block, returns = block_numbers(f), f.return_count
    fired = -SHOT * ((f.block_count - 1 - block) // returns)
    return beams(f, channels, distance=distance(f), block=block, returns=returns, fired=fired)


def sweep(i: int) -> dict[str, Any]:
    """Packet i at 10 Hz with single return."""
    return {**header(BLOCKS), **turning(i, BLOCKS, PER_TURN)}


TABLE_32 = nominal(15.0 - np.arange(32), np.zeros(32), 6.0 + 1.512 * np.arange(32))
TABLE_16 = nominal(15.0 - 2.0 * np.arange(16), np.zeros(16), 6.0 + 3.024 * np.arange(16))

XT32 = Sensor(
    "hesai-xt32",
    vendor="Hesai",
    model="PandarXT-32",
    frames={"data": Frame(packet(6, 1, 32, TAIL), data=True, max_length=longest(32, BLOCKS), plausible=plausible)},
    points=partial(points, channels=TABLE_32),
    scan=OnWrap("blocks.azimuth"),
    links={"data": Udp(2368)},
    clock=Clock(clock),
    sequence=Sequence("sequence"),
    simulation=Simulation(sweep),
    configure=partial(configure, points, TABLE_32),
    range_limits=(0.05, 120.0),
    vendor_axes=("right", "forward", "up"),
    turn=TURN,
    aliases=("xt32", "pandarxt-32"),
    relatives={"hesai-xt32m": Relative("6 blocks in a packet, an XT32 sends 8", lambda f: f.block_count == 6)},
    status="capture",
    acknowledged=UNPUBLISHED,
    source="HesaiLidar_SDK_2.0 (udp_protocol_v6_1.h, PandarXT correction files); capture of tier4/nebula",
)

XT16 = dataclasses.replace(
    XT32,
    id="hesai-xt16",
    model="PandarXT-16",
    frames={"data": Frame(packet(6, 1, 16, TAIL), data=True, max_length=longest(16, BLOCKS), plausible=plausible)},
    points=partial(points, channels=TABLE_16),
    configure=partial(configure, points, TABLE_16),
    aliases=("xt16", "pandarxt-16"),
    relatives={},
    status="vectors",
    source="HesaiLidar_SDK_2.0 (udp_protocol_v6_1.h, PandarXT-16 correction files); one captured packet of tier4/nebula",
)
