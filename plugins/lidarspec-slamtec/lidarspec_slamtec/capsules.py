"""Capsules: many distances behind the angle of the first one. The other angles need the start of
the next capsule.

Point k of N stands at ``start + (next start - start) * k / N``, less a compensation of its own.
Where bytes were lost, at the end of the input, and before a capsule with the S bit (the first after
a start) there is no next capsule, and the points of the last one have no direction. All four kinds
begin alike: their checksum, the XOR of the bytes from the third on, stands in two nibbles beside
the sync nibbles A and 5.

Source: RPLIDAR interface protocol, "EXPRESS_SCAN"; what it does not say (dense and ultra-dense
capsules, the ultra capsule's angles, that dtheta is unsigned) from the vendor's SDK
(sl_lidar_cmd.h, handler_capsules.cpp). The SDK averages neighbours of an ultra-dense capsule that
differ by up to 2 mm; that is a filter, and is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    ByteSwapped,
    Const,
    Construct,
    Int16ul,
    Int32ul,
    Struct,
)

from lidarspec.spec import Checksummed, Fields, Polar, Scaled, Xor, following, stack, take, wrap

EXPRESS_CABINS = 16
ULTRA_CABINS = 32
DENSE_CABINS = 40
ULTRA_DENSE_CABINS = 32
SIGNED = 32  # dtheta has six bits; read as signed, this one and those above are negative
#: degrees of a simulated capsule: 720, 1440, 800 and 800 points a turn.
EXPRESS_STEP = 16.0
ULTRA_STEP = 24.0
DENSE_STEP = 18.0
ULTRA_DENSE_STEP = 28.8
#: simulated capsules a second: 254 and 127 us a point, a live A1's, for 5.5 turns; 125 us, assumed,
#: for 10 turns.
EXPRESS_RATE, ULTRA_RATE, DENSE_RATE, ULTRA_DENSE_RATE = (
    1e6 / us / points for us, points in ((254, 32), (127, 96), (125, 40), (125, 64))
)

#: the ultra capsule's scale: values from STARTS on begin at BASES millimetres and go on in steps of
#: 1, 2, 4, 8 and 16.
_STARTS = np.array([0, 512, 1280, 1792, 3328])
_BASES = np.array([0, 512, 2048, 4096, 16384])
_CODES = np.arange(1 << 12)
LEVELS = np.searchsorted(_STARTS, _CODES, side="right") - 1
MILLIMETRES = _BASES[LEVELS] + ((_CODES - _STARTS[LEVELS]) << LEVELS)

#: the ultra-dense capsule's four scales begin at these millimetres.
SCALES = np.array([0, 2046, 8187, 24567])
QUALITY = 47  # of simulated points


def nibble(sync: int) -> Construct:
    """One of the first two bytes: a sync nibble above a nibble of the checksum."""
    return BitStruct("sync" / Const(sync, BitsInteger(4)), "checksum" / BitsInteger(4))


def capsule(*fields: Construct) -> Checksummed:
    """Return a capsule of these fields behind its sync and checksum."""
    struct = Struct("low" / nibble(0xA), "high" / nibble(0x5), *fields)
    return Checksummed(struct, field=("low.checksum", "high.checksum"), algorithm=Xor())


def start() -> Construct:
    """Return the angle of the first point, and whether this is the first capsule after a start."""
    flag = "sync" / BitsInteger(1) * "S, 1: first capsule after a start"
    return "start" / ByteSwapped(BitStruct(flag, "angle" / Scaled(BitsInteger(15), 1 / 64, "deg")))


def sample() -> Construct:
    """14 bits of distance above the two high bits of its angle's compensation."""
    distance = "distance" / Scaled(BitsInteger(14), 0.001, "m") * "0: no return"
    return ByteSwapped(BitStruct(distance, "dtheta_high" / BitsInteger(2)))


EXPRESS = capsule(
    start(),
    "cabins"
    / Array(
        EXPRESS_CABINS,
        Struct(
            "first" / sample(),
            "second" / sample(),
            "dtheta_low"
            / BitStruct("second" / BitsInteger(4), "first" / BitsInteger(4))
            * "1/8 degree",
        ),
    ),
)
ULTRA = capsule(
    start(),
    "cabins"
    / Array(
        ULTRA_CABINS,
        ByteSwapped(
            BitStruct(
                "predict2"
                / Scaled(BitsInteger(10, signed=True), 1, "")
                * (
                    "difference to the next major, in steps given by the code word; 511, -512: no"
                    " return"
                ),
                "predict1"
                / BitsInteger(10, signed=True)
                * "difference to this major; 511, -512: no return",
                "major" / BitsInteger(12) * "0: no return",
            )
        ),
    ),
)
DENSE = capsule(
    start(), "distances" / Array(DENSE_CABINS, Scaled(Int16ul, 0.001, "m")) * "0: no return"
)
ULTRA_DENSE = capsule(
    "time_stamp" / Int32ul * "unit not documented",
    "status" / Int16ul,
    start(),
    "cabins"
    / Array(
        ULTRA_DENSE_CABINS,
        ByteSwapped(
            BitStruct(
                "second_high" / Scaled(BitsInteger(4), 1, ""),
                "first_high" / BitsInteger(4),
                "second_low" / BitsInteger(14),
                "second_scale" / BitsInteger(2),
                "first_low" / BitsInteger(14),
                "first_scale" / BitsInteger(2),
            )
        ),
    ),
)


def plausible(f: Fields) -> Any:
    """Return the first angle is below 360 degrees."""
    return f.start.angle < 360


def step(f: Fields, count: int) -> Any:
    """Return the degrees from one of `count` points to the next, (n, 1).

    The step is nan if there is no next capsule.
    """
    after = np.where(following(f.start.sync) == 0, following(f.start.angle), np.nan)
    return wrap(after - f.start.angle, 360.0) / count


def headings(f: Fields, cabins: int, points: int) -> Any:
    """Degrees clockwise of each point, not compensated, (n, cabins, points)."""
    count = cabins * points
    between = step(f, cabins * points)
    return stack(
        *(f.start.angle + between * np.arange(place, count, points) for place in range(points))
    )


def express_points(f: Fields, *, signed: bool = False) -> Polar:
    """32 points a capsule, with dtheta read as unsigned (SDK) or signed (protocol)."""
    first = f.cabins.first
    second = f.cabins.second
    low = f.cabins.dtheta_low
    eighths = stack(first.dtheta_high * 16 + low.first, second.dtheta_high * 16 + low.second)
    if signed:
        eighths = np.where(eighths >= SIGNED, eighths - 2 * SIGNED, eighths)
    clockwise = headings(f, EXPRESS_CABINS, 2) - eighths / 8
    return Polar(range=stack(first.distance, second.distance), azimuth=-np.deg2rad(clockwise))


def dense_points(f: Fields) -> Polar:
    """40 points a capsule, without compensation."""
    clockwise = f.start.angle + step(f, DENSE_CABINS) * np.arange(DENSE_CABINS)
    return Polar(range=f.distances, azimuth=-np.deg2rad(clockwise))


def predict(base: Any, level: Any, prediction: Any) -> Any:
    """Millimetres of a predicted distance, in steps of its base's scale; 0 for the two values that
    mean no return.
    """
    return np.where(
        (prediction == 511) | (prediction == -512), 0, base + prediction * np.exp2(level)
    )


def compensation(mm: Any) -> Any:
    """Degrees that an ultra capsule's point lies before its heading, by its distance.

    Source: handler_capsules.cpp: 7.5 degrees below 50 mm, else 8 degrees less two terms in 1/65536
    rad of 98361 by the distance in quarters of a millimetre, a whole number.
    """
    ratio = np.floor(98361 / np.maximum(mm * 4, 200))
    return np.where(mm >= 50, 8 - np.rad2deg((ratio * 64 + ratio**3 / 98304) / 65536), 7.5)


def ultra_points(f: Fields) -> Polar:
    """96 points a capsule: a major distance in each cabin, and two that are predicted from it and
    from the next one's.
    """
    code = f.cabins.major
    code_after = following(f.cabins.major)
    major = take(MILLIMETRES, code)
    after = take(MILLIMETRES, code_after)
    after_level = take(LEVELS, code_after)
    lacking = (major == 0) & (after > 0)
    base = np.where(lacking, after, major)
    level = np.where(lacking, after_level, take(LEVELS, code))
    first = predict(base, level, f.cabins.predict1)
    second = predict(after, after_level, f.cabins.predict2)
    mm = stack(major, first, second)
    return Polar(
        range=mm / 1000, azimuth=-np.deg2rad(headings(f, ULTRA_CABINS, 3) - compensation(mm))
    )


def ultra_dense_points(f: Fields) -> Polar:
    """64 points a capsule: by its scale, 10 to 13 bits of distance in steps of 2 to 5 mm, and above
    them 8 to 5 bits of quality.
    """
    cabins = f.cabins
    scale = stack(cabins.first_scale, cabins.second_scale)
    code = stack(
        cabins.first_high * (1 << 14) + cabins.first_low,
        cabins.second_high * (1 << 14) + cabins.second_low,
    )
    size = np.exp2(10 + scale)
    quality = np.floor(code / size)
    return Polar(
        range=(take(SCALES, scale) + (2 + scale) * (code - quality * size)) / 1000,
        azimuth=-np.deg2rad(headings(f, ULTRA_DENSE_CABINS, 2)),
        intensity=quality * np.exp2(scale),
    )


def ultra_codes(polar: Polar) -> Mapping[str, Any]:
    """The fields of ultra capsules that hold these ranges; a prediction that cannot reach its point
    says that there is no return.
    """
    mm = np.asarray(polar.range) * 1000
    code = nearest(mm[..., 0])
    after = np.append(code.reshape(-1)[1:], 0).reshape(code.shape)
    base = np.where(code > 0, code, after)
    first, second = (
        prediction(mm[..., place], reference) for place, reference in ((1, base), (2, after))
    )
    return {"cabins.major": code, "cabins.predict1": first, "cabins.predict2": second}


def nearest(mm: Any) -> Any:
    """Return the codes of the scale's values next to these distances."""
    above = np.clip(np.searchsorted(MILLIMETRES, mm), 1, len(MILLIMETRES) - 1)
    return np.where(mm - MILLIMETRES[above - 1] < MILLIMETRES[above] - mm, above - 1, above) * (
        mm > 0
    )


def prediction(mm: Any, code: Any) -> Any:
    """Steps from the distance that a code stands for to another one; 511 for no return."""
    base = MILLIMETRES[code]
    scale = np.exp2(LEVELS[code])
    steps = np.rint((mm - base) / scale)
    return np.where(
        (mm > 0) & (base + steps * scale > 0) & (np.abs(steps) < 511), steps, 511
    ).astype(np.int64)


def ultra_dense_codes(polar: Polar) -> Mapping[str, Any]:
    """The fields of ultra-dense capsules that hold these ranges, each in the finest scale that
    reaches it, of one quality.
    """
    mm = np.asarray(polar.range) * 1000
    scale = np.searchsorted(SCALES, mm, side="right") - 1
    steps = np.rint((mm - SCALES[scale]) / (2 + scale)).astype(np.int64)
    code = np.where(mm > 0, steps + ((QUALITY >> scale) << (10 + scale)), 0)
    fields: dict[str, Any] = {}
    for place, name in enumerate(("first", "second")):
        own = code[..., place]
        fields |= {
            f"cabins.{name}_low": own & 0x3FFF,
            f"cabins.{name}_high": own >> 14,
            f"cabins.{name}_scale": scale[..., place],
        }
    return fields


def sweep(i: int, degrees: float) -> Mapping[str, Any]:
    """Capsule i of capsules that are so many degrees apart."""
    return {"start.angle": i * degrees % 360, "start.sync": int(i == 0)}
