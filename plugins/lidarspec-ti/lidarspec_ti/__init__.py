"""Texas Instruments IWR6843: a millimetre-wave radar with the out-of-box demo of the mmWave SDK 3,
over its data UART.

A frame is a header and parts with a type and a length, as many as `guiMonitor` asks for, filled up
to a multiple of 32 bytes with anything. Each point has a velocity. Its SNR stands in a part of its
own, in the order of the points: ``packets.parts("tlvs.side_info")``.

Source: TI, "Understanding the Out of Box Demo Data Output" (mmWave industrial toolbox 4.10), whose
44 bytes of header are 40 by its own table; mmWave SDK 3.5 (mmw_output.h) for the types of parts,
dpif_pointcloud.h for points and SNR. That the cycles are those of the 200 MHz R4F is assumed, as
the longest range is. Heat maps, and parts of other demos of the toolbox, are kept as bytes. The
radar is set up and started by the lines of a .cfg file over its other UART, at 115 200 baud: that
is not here, so send it one first.
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
    Parts,
    Scaled,
    Sensor,
    Sequence,
    Serial,
    Simulation,
    SizeOf,
    hookimpl,
)

CYCLE = 5  # ns, of 200 MHz
TURN = 2**32 * CYCLE * 1e-9  # seconds after which the cycles start again
PLATFORM = 0xA6843
POINTS = 24
RATE = 10  # of a simulated frame; frames a second
POINT = 16
SIDE = 4  # bytes


def part(kind: int, size: int, *members: Any) -> Struct:
    """A part whose `members` are arrays of so many bytes an element; what is left over is kept."""
    return Struct(
        "type" / Const(kind, Int32ul),
        "length" / Int32ul,
        *members,
        "rest" / Bytes(this.length % size),
    )


POINTS_PART = part(
    1,
    POINT,
    "points"
    / Array(
        this.length // POINT,
        Struct(
            "x" / Scaled(Float32l, 1, "m") * "to the right",
            "y" / Scaled(Float32l, 1, "m") * "ahead",
            "z" / Scaled(Float32l, 1, "m") * "up",
            "velocity" / Scaled(Float32l, 1, "m/s") * "positive away from the radar",
        ),
    ),
)
SIDE_PART = part(
    7,
    SIDE,
    "points"
    / Array(
        this.length // SIDE,
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
    "invalid" / Int32sl * "0: what follows holds",
    "time" / Scaled(Int32ul, 0.001, "s") * "since power-up",
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
    * "of the SDK: major, minor, bugfix and build, a byte each, the highest first",
    "length" / SizeOf(Int32ul),
    "platform" / Const(PLATFORM, Int32ul),
    "frame_number" / Int32ul,
    "time" / Scaled(Int32ul, CYCLE, "ns") * "cycles; starts again at 21.5 s",
    "detected" / Int32ul * "points of the frame",
    "tlv_count" / Int32ul,
    "subframe" / Int32ul,
    "tlvs"
    / Parts(
        {
            "points": POINTS_PART,
            "range_profile": part(
                2, 2, "magnitudes" / Array(this.length // 2, Int16ul) * "log2, Q9"
            ),
            "noise_profile": part(
                3, 2, "magnitudes" / Array(this.length // 2, Int16ul) * "log2, Q9"
            ),
            "statistics": STATISTICS,
            "side_info": SIDE_PART,
            "temperature": TEMPERATURE,
            "other": Struct("type" / Int32ul, "length" / Int32ul, "content" / Bytes(this.length)),
        },
        count=this.tlv_count,
    ),
    "filling" / Bytes(-(40 + this.tlvs.size) % 32),
)


def points(f: Fields) -> Cartesian:
    """Return the points of a frame; the radar's x is to the right, and its y ahead."""
    place = f.points
    return Cartesian(x=place.y, y=-place.x, z=place.z, extra={"velocity": place.velocity})


def directions(i: int) -> tuple[Any, Any]:
    """Return a fan of 120 degrees, that nods by 15."""
    return np.deg2rad(np.linspace(-60, 60, POINTS)), np.deg2rad(
        15 * np.sin(i / 7 + np.arange(POINTS))
    )


def sweep(i: int) -> dict[str, Any]:
    """Frame i: points that stand still, their SNR, and statistics."""
    return {
        "version": 0x03050004,
        "frame_number": i + 1,
        "time": round(i * 1e9 / RATE) % (2**32 * CYCLE),
        "detected": POINTS,
        "subframe": 0,
        "tlvs": [
            {"type": 1, "length": POINTS * POINT, "points.velocity": np.zeros(POINTS)},
            {
                "type": 7,
                "length": POINTS * SIDE,
                "points.snr": np.full(POINTS, 18.0),
                "points.noise": np.full(POINTS, 60.0),
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
            acknowledged={"LS203": "heat maps are long, and asked for seldom"},
        )
    },
    points=None,
    scan=OnChange("frame_number"),
    links={"data": Serial(921_600)},
    clock=Clock("time", wraps_at=TURN),
    sequence=Sequence("frame_number"),
    simulation=Simulation(sweep, rate=RATE, directions=directions),
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
    """The radar."""
    return [IWR6843]
