"""Velodyne VLP-16 and HDL-32E: spinning lidars of 16 and 32 lasers over UDP.

Source: velodyne_decoder (calibration files, calib_db.cpp, packet_decoder.cpp) and ros-drivers/velodyne (rawdata), which
cite the vendor's user manuals: laser angles, firing times, focal distances. The vertical offsets that follow from the
focal distance are documented for the VLP-16 (11.2 mm at -15 degrees); ros-drivers and nebula leave them out, so their z
differs by up to 11 mm (VLP-16) and 17 mm (HDL-32E).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial

import numpy as np

from lidarspec.spec import Clock, OnWrap, Relative, Sensor, Simulation, Udp, hookimpl
from lidarspec_velodyne.firings import Firings, configure, pace, points, sweep
from lidarspec_velodyne.frames import FRAMES, HOUR, SLOTS, TURN

SLOT = np.arange(SLOTS)

VLP16_FIRINGS = Firings(
    # 16 lasers, two firings of each in a block: 2.304 us apart, the second round 55.296 us after the first
    elevation=np.tile([-15.0, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], 2),
    delay=(SLOT // 16 * 55.296 + SLOT % 16 * 2.304) * 1e-6,
    period=2 * 55.296e-6,
    focal_distance=0.04191,
    product=0x22,
)

LOWER = [-30.67, -29.33, -28.00, -26.67, -25.33, -24.00, -22.67, -21.33, -20.00, -18.67, -17.33, -16.00, -14.67, -13.33, -12.00, -10.67]
UPPER = [-9.33, -8.00, -6.67, -5.33, -4.00, -2.67, -1.33, 0.00, 1.33, 2.67, 4.00, 5.33, 6.67, 8.00, 9.33, 10.67]

HDL32E_FIRINGS = Firings(
    # 32 lasers 1.152 us apart, by turns of the lower and of the upper half
    elevation=np.array([LOWER, UPPER]).T.ravel(),
    delay=1.152e-6 * SLOT.astype(np.float64),
    period=46.080e-6,
    focal_distance=0.02883,
    product=0x21,
)

# the same packets by other products (velodyne_decoder, types.h); 0x21 tells nothing: a VLP-16 with old firmware sends it too
OTHERS = {
    "velodyne-puck-hi-res": Relative("product 0x24", lambda f: f.product == 0x24),
    "velodyne-vlp32c": Relative("product 0x28", lambda f: f.product == 0x28),
}


VLP16 = Sensor(
    "velodyne-vlp16",
    vendor="Velodyne",
    model="VLP-16",
    frames=FRAMES,
    points=partial(points, model=VLP16_FIRINGS),
    scan=OnWrap("blocks.azimuth"),
    links={"data": Udp(2368, 8308)},
    clock=Clock("timestamp", wraps_at=HOUR, pace=partial(pace, model=VLP16_FIRINGS)),
    simulation=Simulation(partial(sweep, model=VLP16_FIRINGS)),
    configure=partial(configure, VLP16_FIRINGS),
    range_limits=(0.4, 130.0),  # the default of ros-drivers/velodyne for this model
    vendor_axes=("right", "forward", "up"),
    turn=TURN,
    # 12 blocks, or 6 shots: periods of 110.592 and 46.080 us
    relatives={"velodyne-hdl32e": "timestamp: a packet each 1327 us, with dual return 664 us; an HDL-32E's 553 and 276 us", **OTHERS},
    info={"temperature": "position.top_board_temperature"},  # the product byte is not to be trusted
    aliases=("vlp16", "puck"),
    status="capture",
    acknowledged={"LS710": "the captures are others', and too large: the project's tests read them where they are"},
    source="velodyne_decoder and ros-drivers/velodyne, citing the VLP-16 user manual; three captures",
)

HDL32E = dataclasses.replace(
    VLP16,
    id="velodyne-hdl32e",
    model="HDL-32E",
    aliases=("hdl32e",),
    points=partial(points, model=HDL32E_FIRINGS),
    clock=Clock("timestamp", wraps_at=HOUR, pace=partial(pace, model=HDL32E_FIRINGS)),
    simulation=Simulation(partial(sweep, model=HDL32E_FIRINGS)),
    configure=partial(configure, HDL32E_FIRINGS),
    range_limits=(0.9, 130.0),  # likewise
    relatives={"velodyne-vlp16": Relative("product 0x22; or a packet each 1327 us", lambda f: f.product == 0x22), **OTHERS},
    source="velodyne_decoder and ros-drivers/velodyne, citing the HDL-32E user manual; one capture",
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """The Velodyne sensors."""
    return [VLP16, HDL32E]
