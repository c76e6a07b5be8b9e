"""LMDscandata, the telegram of a scan, in CoLa B (binary) and CoLa A (hexadecimal text).

A telegram has one layer. It has the channels DIST1 to DISTn with 16 bits. If requested, the
channels RSSI1 to RSSIn follow with 16 bits, with 8 bits, or twice, once with each size. In the last
case the intensity is from the 8-bit channels. Telegrams with channels of other kinds (ANGL, VANG,
QLTY) are not supported. An angular step of a third of a degree is sent as 0.3333 and is used
unchanged, which is an error of 0.03 degrees at the last of 811 beams.

Source: SICK Telegram Listing LiDAR sensors 8014631; operating instructions 8023198 (LMS4000) for
the tables of LMDscandata, which state that values below 16 are not distances; 8020494 (MRS1000) for
the layers; sick_scan_xd for the zero direction.
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
    Enum,
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

#: The smallest distance before scaling: raw values below 16 are reserved (8023198).
MIN_DISTANCE_M = 0.016
AHEAD_DEG = 90.0  # the direction straight ahead on the wire (sick_scan_xd)
DISTANCE = (
    Scaled(Int16ub, 0.001, "m")
    * "to be multiplied by the scale factor; raw values below 16: no distance"
)
#: The unit of the rate is 100 Hz, but some firmware erroneously sends the rate in Hz
#: (sick_scan_xd). A rate above this limit is therefore divided by 100.
MAX_BEAM_RATE_HZ = 1e6
MAX_BEAMS = 1141  # of an LMS5xx with steps of a sixth of a degree


def make_binary_frame(*parts: Construct, max_length: int = 0, **more: Any) -> Frame:
    """Return the frame of a telegram in CoLa B.

    A telegram has four bytes 02, a length, the content, and the XOR of the content.
    """
    struct = Struct(
        "magic" / Const(b"\x02\x02\x02\x02"),
        "length" / SizeOf(Int32ub, plus=-9) * "number of bytes of the content",
        *parts,
        "checksum" / Int8ub,
    )
    struct_with_checksum = Checksummed(
        struct, field="checksum", algorithm=Xor(), over=tuple(part.name for part in parts)
    )
    return Frame(struct_with_checksum, max_length=max_length, **more)


def make_text_frame(*parts: Construct, max_length: int = 200, **more: Any) -> Frame:
    """Return the frame of a telegram in CoLa A: the byte 02, tokens, the byte 03."""
    return Frame(
        Struct(*parts),
        wire=Tokens(start=b"\x02", sep=b" ", end=b"\x03", base=16),
        max_length=max_length,
        **more,
    )


def make_channel(
    content: str, values: Construct, *, first: bool = False, name: str = ""
) -> Construct:
    """Return the field of a channel with this content.

    Args:
        content: the name of the content, as sent.
        first: whether it is the first channel, whose number of samples applies to all channels.
        name: the name of the field, by default the content in lower case.
    """
    count = this.count if first else this._.dist1.count
    struct = Struct(
        "content" / Const(content.encode()),
        "scale" / Float32b,
        "offset" / Float32b,
        "start"
        / Scaled(Int32sb, 1e-4, "deg")
        * "first angle, counter-clockwise; 90 degrees is straight ahead",
        "step" / Scaled(Int16ub, 1e-4, "deg"),
        "count" / (Int16ub if first else Rebuild(Int16ub, count)),
        "samples" / Array(count, values),
    )
    return (name or content.lower()) / struct


def make_optional(name: str, *parts: Construct) -> tuple[Construct, Construct]:
    """Return a flag and the fields that are present if the flag is 1."""
    return f"has_{name}" / Int16ub, name / If(this[f"has_{name}"] == 1, Struct(*parts))


def make_scan_fields(echoes: int) -> list[Construct]:
    """Return the fields after the telegram's name, with `echoes` echoes per beam."""
    others = [make_channel(f"DIST{number}", DISTANCE) for number in range(2, echoes + 1)]
    strengths = [make_channel(f"RSSI{number}", Int16ub) for number in range(1, echoes + 1)]
    strengths8 = [
        make_channel(f"RSSI{number}", Int8ub, name=f"rssi{number}_8bit")
        for number in range(1, echoes + 1)
    ]
    named = ("length" / Int8ub, "text" / Bytes(this.length))
    return [
        "version" / Int16ub,
        "device" / Int16ub,
        "serial" / Int32ub,
        "status"
        / Array(2, Enum(Int8ub, ok=0, error=1, pollution_warning=2, pollution_error=4))
        * "the second value is the status of the device; lidarspec does not use the first value",
        "telegram_counter" / Int16ub,
        "scan_counter" / Int16ub,
        "time" / Scaled(Int32ub, 1, "us") * "time of the start of the scan, since power-up",
        "sent" / Scaled(Int32ub, 1, "us") * "time of the transmission, since power-up",
        "inputs" / Array(2, Int8ub),
        "outputs" / Array(2, Int8ub),
        "layer"
        / Scaled(Int16sb, 0.01, "deg")
        * "angle of the layer, positive downwards; 0 in all models except the MRS1000",
        "scan_rate" / Scaled(Int32ub, 0.01, "Hz"),
        "beam_rate" / Scaled(Int32ub, 100, "Hz"),
        "encoder_count" / Int16ub,
        "encoders" / Array(this.encoder_count, Struct("position" / Int32sb, "speed" / Int16sb)),
        "channels" / Int16ub * "number of 16-bit channels",
        make_channel("DIST1", DISTANCE, first=True),
        *others,
        *(part.name / If(this.channels == 2 * echoes, part.subcon) for part in strengths),
        "channels8" / Int16ub * "number of 8-bit channels",
        *(
            part.name / If(this.channels8 >= number, part.subcon)
            for number, part in enumerate(strengths8, 1)
        ),
        *make_optional(
            "position",
            *(axis / Float32b for axis in ("x", "y", "z", "rx", "ry", "rz")),
            "rotation" / Int8ub,
            "named" / Int8ub,
        ),
        *make_optional("name", *named),
        *make_optional("comment", *named),
        *make_optional(
            "date",
            "year" / Int16ub,
            *(name / Int8ub for name in ("month", "day", "hour", "minute", "second")),
            "us" / Int32ub,
        ),
        *make_optional(
            "event",
            "type" / Bytes(4),
            "encoder" / Int32ub,
            "time" / Int32ub,
            "angle" / Scaled(Int32sb, 1e-4, "deg"),
        ),
    ]


def plausible(f: Fields, echoes: int) -> Any:
    """Return whether a scan has beams, and all its channels have the same length."""
    count = f.dist1.count
    is_plausible = (f.dist1.step > 0) & (count > 0)
    for number in range(1, echoes + 1):
        is_plausible = is_plausible & (getattr(f, f"dist{number}").count == count)
        is_plausible = is_plausible & (
            (f.channels != 2 * echoes) | (getattr(f, f"rssi{number}").count == count)
        )
        is_plausible = is_plausible & (
            (f.channels8 < number) | (getattr(f, f"rssi{number}_8bit").count == count)
        )
    return is_plausible


def points(f: Fields, echoes: int) -> Polar:
    """Return points from the start angle on, with `echoes` returns for each beam."""
    first = f.dist1
    distances = [getattr(f, f"dist{index}") for index in range(1, echoes + 1)]
    strengths = [getattr(f, f"rssi{index}") for index in range(1, echoes + 1)]
    strengths8 = [getattr(f, f"rssi{index}_8bit") for index in range(1, echoes + 1)]
    ranges = [
        (channel.samples * channel.scale + channel.offset * 0.001).on("dist1.samples")
        for channel in distances
    ]
    missing = [(channel.samples < MIN_DISTANCE_M).on("dist1.samples") for channel in distances]
    intensity = [
        np.where(f.channels8 == echoes, scaled_intensity(narrow), scaled_intensity(wide))
        for narrow, wide in zip(strengths8, strengths, strict=True)
    ]
    index = first.samples.index
    return Polar(
        range=ranges[0] if echoes == 1 else stack(*ranges),
        azimuth=np.deg2rad(first.start - AHEAD_DEG + first.step * index),
        elevation=np.deg2rad(-f.layer),
        intensity=intensity[0] if echoes == 1 else stack(*intensity),
        time=index / np.where(f.beam_rate > MAX_BEAM_RATE_HZ, f.beam_rate / 100, f.beam_rate),
        invalid=missing[0] if echoes == 1 else stack(*missing),
        return_index=None if echoes == 1 else np.arange(echoes),
    )


def scaled_intensity(channel: Fields) -> Any:
    """Return the values of an RSSI channel, one for each sample of DIST1."""
    return (channel.samples * channel.scale + channel.offset).on("dist1.samples")


@cache
def make_scan_frame(cola: str, echoes: int) -> Frame:
    """Return the frame of a scan with `echoes` echoes, in CoLa "A" or "B"."""
    max_length = 200 + echoes * 2 * (40 + 2 * MAX_BEAMS)
    kind = "kind" / Bytes(3) * "sSN: sent automatically; sRA: sent on request"
    more = {
        "data": True,
        "plausible": partial(plausible, echoes=echoes),
        "points": partial(points, echoes=echoes),
    }
    if cola == "A":
        return make_text_frame(
            kind,
            "method" / Const(b"LMDscandata"),
            *make_scan_fields(echoes),
            max_length=3 * max_length,
            **more,
        )
    return make_binary_frame(
        kind,
        "method" / Const(b" LMDscandata "),
        *make_scan_fields(echoes),
        max_length=max_length,
        **more,
    )
