"""Texas Instruments IWR6843: a millimetre-wave radar with the out-of-box demo of the mmWave SDK 3.

A frame on the data UART consists of a header and of parts, each with a type and a length.
`guiMonitor` selects which parts are sent. The frame is padded with arbitrary bytes to a multiple of
32 bytes. Each point has a velocity. The SNRs of the points are in a separate part, in the order of
the points: ``packets.parts("tlvs.side_info")``.

Source: TI, "Understanding the Out of Box Demo Data Output" (mmWave industrial toolbox 4.10);
mmWave SDK 3.5, mmw_output.h (types of parts) and dpif_pointcloud.h (points and SNR). The text of
the first document gives 44 bytes as the size of the header. The table of the header in the same
document results in 40 bytes, which this module uses. It is assumed that CPU cycles are those of the
R4F at 200 MHz. The longest range is assumed. Heat maps, and parts of other demos of the toolbox,
are kept as bytes. This plugin neither configures nor starts the radar: send the lines of a .cfg
file to the other UART of the radar, at 115 200 baud.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from construct import (
    Array,
    Bytes,
    Const,
    Float32l,
    Int16sl,
    Int16ul,
    Int32sl,
    Int32ul,
    Struct,
    this,
)

from lidarspec.spec import (
    Cartesian,
    Clock,
    Fields,
    Frame,
    OnChange,
    PacketCounter,
    Parts,
    Scaled,
    Sensor,
    Serial,
    Simulation,
    SizeOf,
    hookimpl,
)

CYCLE_NS = 5  # at 200 MHz
CLOCK_WRAP_S = 2**32 * CYCLE_NS * 1e-9
PLATFORM = 0xA6843
SIMULATED_POINTS = 24  # of a frame
SIMULATED_RATE_HZ = 10  # frames per second
POINT_BYTES = 16
SIDE_INFO_BYTES = 4  # per point


def make_part(kind: int, size: int, *members: Any) -> Struct:
    """Return the struct of a part with arrays of elements.

    Args:
        size: bytes per element. Bytes that do not fill an element are kept as `rest`.
    """
    return Struct(
        "type" / Const(kind, Int32ul),
        "length" / Int32ul,
        *members,
        "rest" / Bytes(this.length % size),
    )


POINTS_PART = make_part(
    1,
    POINT_BYTES,
    "points"
    / Array(
        this.length // POINT_BYTES,
        Struct(
            "x" / Scaled(Float32l, 1, "m") * "positive to the right",
            "y" / Scaled(Float32l, 1, "m") * "ahead",
            "z" / Scaled(Float32l, 1, "m") * "up",
            "velocity" / Scaled(Float32l, 1, "m/s") * "positive away from the radar",
        ),
    ),
)
SIDE_INFO_PART = make_part(
    7,
    SIDE_INFO_BYTES,
    "points"
    / Array(
        this.length // SIDE_INFO_BYTES,
        Struct("snr" / Scaled(Int16sl, 0.1, "dB"), "noise" / Scaled(Int16sl, 0.1, "dB")),
    ),
)
STATISTICS = Struct(
    "type" / Const(6, Int32ul),
    "length" / Const(24, Int32ul),
    *(
        name / Scaled(Int32ul, 1e-6, "s")
        for name in ("processing_time", "transmit_time", "frame_margin", "chirp_margin")
    ),
    "active_load" / Scaled(Int32ul, 1, "%"),
    "interframe_load" / Scaled(Int32ul, 1, "%"),
)
TEMPERATURE = Struct(
    "type" / Const(9, Int32ul),
    "length" / Const(28, Int32ul),
    "invalid" / Int32sl * "0 if the following values are valid",
    "time" / Scaled(Int32ul, 0.001, "s") * "time since power-up",
    *(
        name / Scaled(Int16sl, 1, "degC")
        for name in (
            "rx0",
            "rx1",
            "rx2",
            "rx3",
            "tx0",
            "tx1",
            "tx2",
            "power",
            "digital0",
            "digital1",
        )
    ),
)
DATA = Struct(
    "magic" / Const(bytes([2, 1, 4, 3, 6, 5, 8, 7])),
    "version"
    / Int32ul
    * "SDK version: major, minor, bugfix and build, each in one byte; major is the highest"
    " byte",
    "length" / SizeOf(Int32ul),
    "platform" / Const(PLATFORM, Int32ul),
    "frame_number" / Int32ul,
    "time" / Scaled(Int32ul, CYCLE_NS, "ns") * "cycle counter, which restarts after 21.5 s",
    "detected" / Int32ul * "number of points",
    "tlv_count" / Int32ul,
    "subframe" / Int32ul,
    "tlvs"
    / Parts(
        {
            "points": POINTS_PART,
            "range_profile": make_part(
                2,
                2,
                "magnitudes"
                / Array(this.length // 2, Int16ul)
                * "logarithm to the base 2; one step is 1/512",
            ),
            "noise_profile": make_part(
                3,
                2,
                "magnitudes"
                / Array(this.length // 2, Int16ul)
                * "logarithm to base 2, in steps of 1/512",
            ),
            "statistics": STATISTICS,
            "side_info": SIDE_INFO_PART,
            "temperature": TEMPERATURE,
            "other": Struct("type" / Int32ul, "length" / Int32ul, "content" / Bytes(this.length)),
        },
        count=this.tlv_count,
    ),
    "filling" / Bytes(-(40 + this.tlvs.size) % 32),
)


def points(f: Fields) -> Cartesian:
    """Return the points of a frame, in axes ahead, left and up."""
    members = f.points
    return Cartesian(x=members.y, y=-members.x, z=members.z, extra={"velocity": members.velocity})


def directions(i: int) -> tuple[Any, Any]:
    """Return azimuth and elevation in radians of the simulated points of frame i."""
    return np.deg2rad(np.linspace(-60, 60, SIMULATED_POINTS)), np.deg2rad(
        15 * np.sin(i / 7 + np.arange(SIMULATED_POINTS))
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the simulated values of frame i: static points, SNR and statistics."""
    return {
        "version": 0x03050004,
        "frame_number": i + 1,
        "time": round(i * 1e9 / SIMULATED_RATE_HZ) % (2**32 * CYCLE_NS),
        "detected": SIMULATED_POINTS,
        "subframe": 0,
        "tlvs": [
            {
                "type": 1,
                "length": SIMULATED_POINTS * POINT_BYTES,
                "points.velocity": np.zeros(SIMULATED_POINTS),
            },
            {
                "type": 7,
                "length": SIMULATED_POINTS * SIDE_INFO_BYTES,
                "points.snr": np.full(SIMULATED_POINTS, 18.0),
                "points.noise": np.full(SIMULATED_POINTS, 60.0),
            },
            {
                "type": 6,
                "length": 24,
                "processing_time": 0.004,
                "transmit_time": 0.008,
                "active_load": 20,
                "interframe_load": 5,
            },
        ],
    }


IWR6843 = Sensor(
    "ti-iwr6843",
    vendor="Texas Instruments",
    model="IWR6843",
    frames={
        "data": Frame(
            DATA,
            data=True,
            max_length=32_768,
            points={"tlvs.points": points},
            acknowledged={
                "LS203": "the longest frames have heat maps, which are rarely requested and not"
                " simulated"
            },
        )
    },
    points=None,
    scan=OnChange("frame_number"),
    links={"data": Serial(921_600)},
    clock=Clock("time", wraps_at=CLOCK_WRAP_S),
    sequence=PacketCounter("frame_number"),
    simulation=Simulation(sweep, rate=SIMULATED_RATE_HZ, directions=directions),
    range_limits=(0.05, 100.0),
    vendor_axes=("right", "forward", "up"),
    status="manual",
    source=(
        "TI, Understanding the Out of Box Demo Data Output (industrial toolbox 4.10); mmWave SDK"
        " 3.5, mmw_output.h"
    ),
)


@hookimpl
def lidarspec_sensors() -> Iterable[Sensor]:
    """Return the radar."""
    return [IWR6843]
