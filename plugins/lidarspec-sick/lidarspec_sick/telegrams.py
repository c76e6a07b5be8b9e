"""The telegram of a scan, LMDscandata, in CoLa B, which is binary, and in CoLa A, the same fields
as hexadecimal text.

Source: SICK Telegram Listing LiDAR sensors 8014631 and the tables of LMDscandata in the operating
instructions 8023198 (LMS4000), with the values below 16 that are no distances; 8020494 (MRS1000)
for the layers; sick_scan_xd for where angles count from. A telegram has one layer. Its channels of
16 bits are DIST1 to DISTn; RSSI1 to RSSIn follow if they are asked for, in 16 bits or in 8. Where
both are there, the intensity is that of 8 bits. Telegrams with channels of other kinds (ANGL, VANG,
QLTY) are not read. A third of a degree is 0.3333 on the wire, and is left so.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np
from construct import (
    Array,
    Bytes,
    Const,
    Construct,
    Float32b,
    If,
    Int8ub,
    Int16sb,
    Int16ub,
    Int32sb,
    Int32ub,
    Rebuild,
    Struct,
    this,
)

from lidarspec.spec import Checksummed, Fields, Frame, Polar, Scaled, SizeOf, Tokens, Xor, stack

# metres before scaling: the smallest value that is a distance is 16 (8023198, reserved values)
LEAST = 0.016
AHEAD = 90.0  # degrees on the wire that lie straight ahead (sick_scan_xd)
DISTANCE = Scaled(Int16ub, 0.001, "m") * "before scaling; below 16: no distance"
HIGHEST = 1e6  # Hz; rates above are in Hz, not in 100 Hz, as sick_scan_xd says of some firmware
MOST_BEAMS = 1141  # of an LMS5xx with steps of a sixth of a degree


def binary(*parts: Construct, max_length: int = 0, **more: Any) -> Frame:
    """Return a telegram of CoLa B: four times 02, a length, the content, and the XOR of it."""
    struct = Struct(
        "magic" / Const(b"\x02\x02\x02\x02"),
        "length" / SizeOf(Int32ub, plus=-9) * "bytes of the content",
        *parts,
        "checksum" / Int8ub,
    )
    sealed = Checksummed(
        struct, field="checksum", algorithm=Xor(), over=tuple(part.name for part in parts)
    )
    return Frame(sealed, max_length=max_length, **more)


def text(*parts: Construct, max_length: int = 200, **more: Any) -> Frame:
    """Return a telegram of CoLa A: 02, tokens, 03."""
    return Frame(
        Struct(*parts),
        wire=Tokens(start=b"\x02", sep=b" ", end=b"\x03", base=16),
        max_length=max_length,
        **more,
    )


def channel(content: str, values: Construct, *, first: bool = False, name: str = "") -> Construct:
    """Return a channel of this content, a field called `name`, by default after the content.

    All channels have as many values as the first one.
    """
    count = this.count if first else this._.dist1.count
    struct = Struct(
        "content" / Const(content.encode()),
        "scale" / Float32b,
        "offset" / Float32b,
        "start" / Scaled(Int32sb, 1e-4, "deg") * "counter-clockwise; 90 is straight ahead",
        "step" / Scaled(Int16ub, 1e-4, "deg"),
        "count" / (Int16ub if first else Rebuild(Int16ub, count)),
        "samples" / Array(count, values),
    )
    return (name or content.lower()) / struct


def optional(name: str, *parts: Construct) -> tuple[Construct, Construct]:
    """What is there if a flag before it says so."""
    return f"has_{name}" / Int16ub, name / If(this[f"has_{name}"] == 1, Struct(*parts))


def scan(echoes: int) -> list[Construct]:
    """What stands behind the name of a telegram with so many echoes of each beam."""
    others = [channel(f"DIST{number}", DISTANCE) for number in range(2, echoes + 1)]
    strengths = [channel(f"RSSI{number}", Int16ub) for number in range(1, echoes + 1)]
    strengths8 = [
        channel(f"RSSI{number}", Int8ub, name=f"rssi{number}_8bit")
        for number in range(1, echoes + 1)
    ]
    named = ("length" / Int8ub, "text" / Bytes(this.length))
    return [
        "version" / Int16ub,
        "device" / Int16ub,
        "serial" / Int32ub,
        "status"
        / Array(2, Int8ub)
        * "0 0 ok, 0 1 error, 0 2 pollution warning, 0 4 pollution error",
        "telegram_counter" / Int16ub,
        "scan_counter" / Int16ub,
        "time" / Scaled(Int32ub, 1, "us") * "start of the scan, since power-up",
        "sent" / Scaled(Int32ub, 1, "us") * "transmission time, since power-up",
        "inputs" / Array(2, Int8ub),
        "outputs" / Array(2, Int8ub),
        "layer"
        / Scaled(Int16sb, 0.01, "deg")
        * "layer angle, positive downwards; 0 except for the MRS1000",
        "scan_rate" / Scaled(Int32ub, 0.01, "Hz"),
        "beam_rate" / Scaled(Int32ub, 100, "Hz"),
        "encoder_count" / Int16ub,
        "encoders" / Array(this.encoder_count, Struct("position" / Int32sb, "speed" / Int16sb)),
        "channels" / Int16ub * "of 16 bits",
        channel("DIST1", DISTANCE, first=True),
        *others,
        *(part.name / If(this.channels == 2 * echoes, part.subcon) for part in strengths),
        "channels8" / Int16ub * "of 8 bits",
        *(
            part.name / If(this.channels8 >= number, part.subcon)
            for number, part in enumerate(strengths8, 1)
        ),
        *optional(
            "position",
            *(axis / Float32b for axis in ("x", "y", "z", "rx", "ry", "rz")),
            "rotation" / Int8ub,
            "named" / Int8ub,
        ),
        *optional("name", *named),
        *optional("comment", *named),
        *optional(
            "date",
            "year" / Int16ub,
            *(name / Int8ub for name in ("month", "day", "hour", "minute", "second")),
            "us" / Int32ub,
        ),
        *optional(
            "event",
            "type" / Bytes(4),
            "encoder" / Int32ub,
            "time" / Int32ub,
            "angle" / Scaled(Int32sb, 1e-4, "deg"),
        ),
    ]


def plausible(f: Fields, echoes: int) -> Any:
    """There are beams, and all channels are as long as the first one."""
    count = f.dist1.count
    held = (f.dist1.step > 0) & (count > 0)
    for number in range(1, echoes + 1):
        held = held & (getattr(f, f"dist{number}").count == count)
        held = held & ((f.channels != 2 * echoes) | (getattr(f, f"rssi{number}").count == count))
        held = held & ((f.channels8 < number) | (getattr(f, f"rssi{number}_8bit").count == count))
    return held


def points(f: Fields, echoes: int) -> Polar:
    """Points from the start angle on, each as many times as there are echoes."""
    first = f.dist1
    distances = [getattr(f, f"dist{number}") for number in range(1, echoes + 1)]
    strengths = [getattr(f, f"rssi{number}") for number in range(1, echoes + 1)]
    strengths8 = [getattr(f, f"rssi{number}_8bit") for number in range(1, echoes + 1)]
    ranges = [
        (one.samples * one.scale + one.offset * 0.001).on("dist1.samples") for one in distances
    ]
    missing = [(one.samples < LEAST).on("dist1.samples") for one in distances]
    intensity = [
        np.where(f.channels8 == echoes, scaled_intensity(narrow), scaled_intensity(wide))
        for narrow, wide in zip(strengths8, strengths, strict=True)
    ]
    number = first.samples.index
    return Polar(
        range=ranges[0] if echoes == 1 else stack(*ranges),
        azimuth=np.deg2rad(first.start - AHEAD + first.step * number),
        elevation=np.deg2rad(-f.layer),
        intensity=intensity[0] if echoes == 1 else stack(*intensity),
        time=number / np.where(f.beam_rate > HIGHEST, f.beam_rate / 100, f.beam_rate),
        invalid=missing[0] if echoes == 1 else stack(*missing),
        return_index=None if echoes == 1 else np.arange(echoes),
    )


def scaled_intensity(channel: Fields) -> Any:
    """Return the values of an RSSI channel, on the axis of the first channel's samples."""
    return (channel.samples * channel.scale + channel.offset).on("dist1.samples")


@cache
def scans(cola: str, echoes: int) -> Frame:
    """Return the telegram of a scan with so many echoes, in CoLa "A" or "B"."""
    longest = 200 + echoes * 2 * (40 + 2 * MOST_BEAMS)
    kind = "kind" / Bytes(3) * "sSN sent automatically, sRA sent on request"
    more = {
        "data": True,
        "plausible": partial(plausible, echoes=echoes),
        "points": partial(points, echoes=echoes),
    }
    if cola == "A":
        return text(
            kind, "method" / Const(b"LMDscandata"), *scan(echoes), max_length=3 * longest, **more
        )
    return binary(
        kind, "method" / Const(b" LMDscandata "), *scan(echoes), max_length=longest, **more
    )
