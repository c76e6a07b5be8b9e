"""Velodyne VLP-16 (Puck, Puck LITE), Puck Hi-Res, HDL-32E, VLP-32C and VLS-128.

Spinning lidars with 16 to 128 lasers over UDP.

Source: velodyne_decoder (calibration files, calib_db.cpp, packet_decoder.cpp) and
ros-drivers/velodyne (rawdata), which cite the vendor's user manuals: laser angles, firing times,
focal distances. Lasers have vertical offsets. The offsets are documented for the VLP-16 (11.2 mm at
-15 degrees); this module calculates the offsets of all models from their focal distances.
ros-drivers and nebula ignore the offsets, so the z values of this module differ by up to 27 mm.

The sources contradict each other on the firing times of a VLS-128, which fires its lasers in 16
groups of eight. This module follows velodyne_decoder: after the eighth group and after the last
group, the sensor does not fire for the time of two groups, and the first firing is 7 us before the
packet's time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from construct import Const, Enum, Int8ul

from lidarspec.spec import Clock, Frame, OnWrap, Relative, Sensor, Simulation, Udp, hookimpl
from lidarspec_velodyne.firings import FiringPattern, configure, pace, points, sweep
from lidarspec_velodyne.frames import (
    BANK,
    BANKS,
    CLOCK_STATUS,
    CLOCK_WRAP_S,
    DUAL,
    POSITION_FRAME,
    PUCK_FRAMES,
    SLOTS,
    SPEED_LIMITS_HZ,
    VLP32C_FRAMES,
    VLP32C_PRODUCT,
    VLS128_PRODUCT,
    is_plausible_dual,
    is_plausible_single,
    make_packet,
    nmea_seconds,
)
from lidarspec_velodyne.hdl64e import HDL64E_S2, HDL64E_S3

SLOT_INDEX = np.arange(SLOTS)

VLP16_FIRINGS = FiringPattern(
    # 16 lasers, each firing twice in a block: 2.304 us from laser to laser, the second round
    # 55.296 us after the first
    elevation=np.tile([-15.0, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], 2),
    delay=(SLOT_INDEX // 16 * 55.296 + SLOT_INDEX % 16 * 2.304) * 1e-6,
    period=2 * 55.296e-6,
    focal_distance=0.04191,
    product=0x22,
)

LOWER_LASERS = [
    -30.67,
    -29.33,
    -28.00,
    -26.67,
    -25.33,
    -24.00,
    -22.67,
    -21.33,
    -20.00,
    -18.67,
    -17.33,
    -16.00,
    -14.67,
    -13.33,
    -12.00,
    -10.67,
]
UPPER_LASERS = [
    -9.33,
    -8.00,
    -6.67,
    -5.33,
    -4.00,
    -2.67,
    -1.33,
    0.00,
    1.33,
    2.67,
    4.00,
    5.33,
    6.67,
    8.00,
    9.33,
    10.67,
]

HDL32E_FIRINGS = FiringPattern(
    # 32 lasers 1.152 us apart, alternating between the lower and the upper half
    elevation=np.array([LOWER_LASERS, UPPER_LASERS]).T.ravel(),
    delay=1.152e-6 * SLOT_INDEX.astype(np.float64),
    period=46.080e-6,
    focal_distance=0.02883,
    product=0x21,
)

# fmt: off
VLP32C_ELEVATION = (
    -25, -1, -1.667, -15.639, -11.31, 0, -0.667, -8.843, -7.254, 0.333, -0.333, -6.148, -5.333, 1.333, 0.667, -4, -4.667, 1.667, 1,
    -3.667, -3.333, 3.333, 2.333, -2.667, -3, 7, 4.667, -2.333, -2, 15, 10.333, -1.333,
)
VLP32C_OFFSET = (
    -1.4, 4.2, -1.4, 1.4, -1.4, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 1.4, -4.2, 1.4, -4.2, 1.4, -1.4, 4.2, -1.4, 4.2, -4.2, 1.4, -1.4, 1.4,
    -1.4, 1.4, -1.4, 4.2, -4.2, 1.4, -1.4, 1.4,
)
VLS128_ELEVATION = (
    -11.742, -1.99, 3.4, -5.29, -0.78, 4.61, -4.08, 1.31, -6.5, -1.11, 4.28, -4.41, 0.1, 6.48, -3.2, 2.19, -3.86, 1.53, -9.244, -1.77,
    2.74, -5.95, -0.56, 4.83, -2.98, 2.41, -6.28, -0.89, 3.62, -5.07, 0.32, 7.58, -0.34, 5.18, -3.64, 1.75, -25, -2.43, 2.96, -5.73,
    0.54, 9.7, -2.76, 2.63, -7.65, -1.55, 3.84, -4.85, 3.18, -5.51, -0.12, 5.73, -4.3, 1.09, -16.042, -2.21, 4.06, -4.63, 0.76, 15,
    -3.42, 1.97, -6.85, -1.33, -5.62, -0.23, 5.43, -3.53, 0.98, -19.582, -2.32, 3.07, -4.74, 0.65, 11.75, -2.65, 1.86, -7.15, -1.44,
    3.95, -2.1, 3.29, -5.4, -0.01, 4.5, -4.19, 1.2, -13.565, -1.22, 4.17, -4.52, 0.87, 6.08, -3.31, 2.08, -6.65, 1.42, -10.346, -1.88,
    3.51, -6.06, -0.67, 4.72, -3.97, 2.3, -6.39, -1, 4.39, -5.18, 0.21, 6.98, -3.09, 4.98, -3.75, 1.64, -8.352, -2.54, 2.85, -5.84,
    -0.45, 8.43, -2.87, 2.52, -6.17, -1.66, 3.73, -4.96, 0.43,
)
# offsets of eight lasers that fire together, the same in each group
VLS128_OFFSET = (-6.354, -4.548, -2.732, -0.911, 0.911, 2.732, 4.548, 6.354)
# fmt: on

HI_RES_FIRINGS = dataclasses.replace(
    VLP16_FIRINGS,
    elevation=np.tile(
        [
            -10.0,
            0.667,
            -8.667,
            2,
            -7.333,
            3.333,
            -6,
            4.667,
            -4.667,
            6,
            -3.333,
            7.333,
            -2,
            8.667,
            -0.667,
            10,
        ],
        2,
    ),
    product=0x24,
)

VLP32C_FIRINGS = FiringPattern(
    # 32 lasers, two at a time, 2.304 us apart
    elevation=np.array(VLP32C_ELEVATION),
    azimuth_offset=np.array(VLP32C_OFFSET),
    delay=(SLOT_INDEX // 2).astype(np.float64) * 2.304e-6,
    period=55.296e-6,
    focal_distance=0.0424,
    product=VLP32C_PRODUCT,
)

#: Seconds from the firing of eight lasers of a VLS-128 to the firing of the next eight. From
#: firmware 5.2.3 on, it is 2.89 us.
GROUP_PERIOD_S = 8 / 3 * 1e-6
VLS128_LASERS = np.arange(4 * SLOTS).reshape(4, SLOTS)


def make_vls128_firings(returns: int) -> FiringPattern:
    """Return the firing pattern for 1 or 2 returns."""

    def fill_blocks(values: Any) -> Any:
        table = np.reshape(values, (4, SLOTS))
        return np.repeat(table, 2, axis=0) if returns == 2 else np.tile(table, (3, 1))

    return FiringPattern(
        elevation=fill_blocks(VLS128_ELEVATION),
        azimuth_offset=fill_blocks(np.tile(VLS128_OFFSET, 16)),
        delay=fill_blocks((VLS128_LASERS // 8 + 2 * (VLS128_LASERS // 64)) * GROUP_PERIOD_S),
        period=20 * GROUP_PERIOD_S,
        focal_distance=0.05863,
        product=VLS128_PRODUCT,
        blocks_per_azimuth=4,
        returns=returns,
        start=-7e-6,  # the packet's time is about that of the fourth group
    )


VLS128_SINGLE = make_vls128_firings(1)
VLS128_DUAL = make_vls128_firings(2)
VLS128_FRAMES = {
    "data": Frame(
        make_packet(
            BANK,
            0.004,
            Enum(Int8ul, strongest=0x37, last=0x38),
            Const(VLS128_PRODUCT, Int8ul) * "0xA1: VLS-128",
        ),
        data=True,
        plausible=is_plausible_single,
        points=partial(points, model=VLS128_SINGLE),
        simulation=Simulation(partial(sweep, model=VLS128_SINGLE, flags=np.tile(BANKS, (3, 1)))),
    ),
    "data_dual": Frame(
        make_packet(
            BANK,
            0.004,
            Const(DUAL, Int8ul),
            Const(VLS128_PRODUCT, Int8ul) * "0xA1: VLS-128",
            blocks=8,
        ),
        data=True,
        plausible=is_plausible_dual,
        points=partial(points, model=VLS128_DUAL),
        simulation=Simulation(partial(sweep, model=VLS128_DUAL, flags=np.repeat(BANKS, 2, axis=0))),
    ),
    "position": POSITION_FRAME,
}

# Other products with the same packets (velodyne_decoder, types.h). 0x21 does not identify a
# product: a VLP-16 with old firmware sends it too.
VLP32A_RELATIVE = {
    "velodyne-vlp32a": Relative(
        "the product is 0x23 (VLP-32A or VLP-32B)", lambda f: f.product == 0x23
    )
}
HI_RES_RELATIVE = {
    "velodyne-puck-hi-res": Relative("the product is 0x24", lambda f: f.product == 0x24)
}


UNPUBLISHED = {
    "LS710": "verified with a captured packet, whose license does not allow a copy in this package;"
    " the project's tests read the original file"
}

VLP16 = Sensor(
    "velodyne-vlp16",
    vendor="Velodyne",
    model="VLP-16",
    frames=PUCK_FRAMES,
    points=partial(points, model=VLP16_FIRINGS),
    scan=OnWrap("blocks.azimuth"),
    links={"data": Udp(2368, 8308)},
    clock=Clock(
        "timestamp",
        wraps_at=CLOCK_WRAP_S,
        pace=partial(pace, model=VLP16_FIRINGS),
        reference=("position", nmea_seconds),
        epoch="hour",
        status=CLOCK_STATUS,
    ),
    simulation=Simulation(partial(sweep, model=VLP16_FIRINGS)),
    configure=configure,
    range_limits=(0.4, 130.0),  # the default of ros-drivers/velodyne for this model
    # even blocks: the last return, odd blocks: the strongest or second strongest (user manuals,
    # dual return mode)
    returns=("last", "strongest"),
    vendor_axes=("right", "forward", "up"),
    turn=SPEED_LIMITS_HZ,
    # 12 shots, or 6 with dual return, with periods of 110.592 and 46.080 us
    relatives={
        "velodyne-hdl32e": (
            "an HDL-32E sends one packet every 553 us (276 us with dual return), a VLP-16 every"
            " 1327 us (664 us)"
        ),
        **HI_RES_RELATIVE,
        **VLP32A_RELATIVE,
    },
    # without the model, because the product byte is unreliable
    info={"temperature": "position.top_board_temperature"},
    status="capture",
    source=(
        "velodyne_decoder and ros-drivers/velodyne, citing the VLP-16 user manual; three captures"
    ),
)


def make_related_model(id: str, model: str, firings: FiringPattern, **facts: Any) -> Sensor:
    """Return another model of the family, derived from the VLP-16.

    Args:
        facts: further arguments of `Sensor` that differ from those of a VLP-16.
    """
    return dataclasses.replace(
        VLP16,
        id=id,
        model=model,
        points=partial(points, model=firings),
        clock=Clock(
            "timestamp",
            wraps_at=CLOCK_WRAP_S,
            pace=partial(pace, model=firings),
            reference=("position", nmea_seconds),
            epoch="hour",
            status=CLOCK_STATUS,
        ),
        simulation=Simulation(partial(sweep, model=firings)),
        **facts,
    )


HDL32E = make_related_model(
    "velodyne-hdl32e",
    "HDL-32E",
    HDL32E_FIRINGS,
    range_limits=(0.9, 130.0),  # the default of ros-drivers/velodyne for this model
    relatives={
        "velodyne-vlp16": Relative(
            "the product is 0x22, or one packet arrives every 1327 us", lambda f: f.product == 0x22
        ),
        **HI_RES_RELATIVE,
        **VLP32A_RELATIVE,
    },
    source="velodyne_decoder and ros-drivers/velodyne, citing the HDL-32E user manual; one capture",
)

PUCK_HI_RES = make_related_model(
    "velodyne-puck-hi-res",
    "Puck Hi-Res",
    HI_RES_FIRINGS,
    relatives={
        "velodyne-vlp16": Relative(
            "the product is 0x22, or 0x21 with old firmware",
            lambda f: (f.product == 0x22) | (f.product == 0x21),
        ),
        "velodyne-hdl32e": Relative("the product is 0x21", lambda f: f.product == 0x21),
        **VLP32A_RELATIVE,
    },
    status="manual",
    source=(
        "velodyne_decoder (Puck Hi-Res.yml, packet_decoder.cpp), citing the VLP-16 user"
        " manual; not tested with packets of this model"
    ),
)

VLP32C = make_related_model(
    "velodyne-vlp32c",
    "VLP-32C",
    VLP32C_FIRINGS,
    frames=VLP32C_FRAMES,
    range_limits=(0.4, 200.0),  # data sheet
    relatives={},
    info={"model": "data.product", **VLP16.info},
    status="vectors",
    acknowledged=UNPUBLISHED,
    source=(
        "velodyne_decoder (VLP-32C.yml, packet_decoder.cpp), citing the VLP-32C user manual; one"
        " captured packet of tier4/nebula"
    ),
)

VLS128 = make_related_model(
    "velodyne-vls128",
    "VLS-128",
    VLS128_SINGLE,
    frames=VLS128_FRAMES,
    range_limits=(0.4, 245.0),  # data sheet of the Alpha Prime
    relatives={},
    info={"model": "data.product", **VLP16.info},
    status="vectors",
    acknowledged=UNPUBLISHED,
    source=(
        "velodyne_decoder (Alpha Prime.yml, packet_decoder.cpp, which cites VeloView); one captured"
        " packet of tier4/nebula"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the Velodyne sensors."""
    return [VLP16, HDL32E, PUCK_HI_RES, VLP32C, VLS128, HDL64E_S2, HDL64E_S3]
