"""Capsules, which contain many distances and the angle of the first point.

A cabin, as the SDK calls it, is a group of points that are encoded together. An express capsule has
16 cabins of two points, an ultra capsule 32 cabins of three points, a dense capsule 40 cabins of
one point, and an ultra-dense capsule 32 cabins of two points.

The angles of the other points are computed with the start angle of the next capsule: point k of N
is at ``start + (next start - start) * k / N``, minus a compensation. The points of a capsule have
no direction if the next capsule is missing or has the bit S, which marks the first capsule after a
start.

All four kinds of capsules begin with two bytes. Each of these bytes has a sync nibble (A or 5) and
a nibble of the checksum, which is the XOR of all following bytes.

Source: RPLIDAR interface protocol, "EXPRESS_SCAN". Dense and ultra-dense capsules, the angles of
ultra capsules, and the unsigned dtheta are from the vendor's SDK (sl_lidar_cmd.h,
handler_capsules.cpp). The SDK averages adjacent points of an ultra-dense capsule that differ by up
to 2 mm. This filter is left out.
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
DTHETA_SIGN_BIT = 32  # of six bits
#: The angle that a simulated capsule covers in degrees, for 720, 1440, 800 and 800 points a
#: revolution.
EXPRESS_STEP = 16.0
ULTRA_STEP = 24.0
DENSE_STEP = 18.0
ULTRA_DENSE_STEP = 28.8
#: The simulated capsules per second. The times of 254 and 127 us per point, which were measured
#: with a live A1, result in 5.5 revolutions a second. The assumed time of 125 us results in 10
#: revolutions a second.
EXPRESS_RATE, ULTRA_RATE, DENSE_RATE, ULTRA_DENSE_RATE = (
    1e6 / us / points for us, points in ((254, 32), (127, 96), (125, 40), (125, 64))
)

#: The five levels of the codes of an ultra capsule. A level begins at the code in _STARTS, whose
#: distance is in _BASES, in millimetres. The steps of the levels are 1, 2, 4, 8 and 16 mm.
_STARTS = np.array([0, 512, 1280, 1792, 3328])
_BASES = np.array([0, 512, 2048, 4096, 16384])
_CODES = np.arange(1 << 12)
CODE_LEVELS = np.searchsorted(_STARTS, _CODES, side="right") - 1
CODE_MILLIMETRES = _BASES[CODE_LEVELS] + ((_CODES - _STARTS[CODE_LEVELS]) << CODE_LEVELS)

#: The first distance in mm of each of the four scales of an ultra-dense capsule.
SCALE_STARTS_MM = np.array([0, 2046, 8187, 24567])
SIMULATED_QUALITY = 47


def make_nibbles(sync: int) -> Construct:
    """Return the struct of a byte with a high sync nibble and a low checksum nibble."""
    return BitStruct("sync" / Const(sync, BitsInteger(4)), "checksum" / BitsInteger(4))


def make_capsule(*fields: Construct) -> Checksummed:
    """Return the struct of a capsule with these fields after sync and checksum."""
    struct = Struct("low" / make_nibbles(0xA), "high" / make_nibbles(0x5), *fields)
    return Checksummed(struct, field=("low.checksum", "high.checksum"), algorithm=Xor())


def make_start() -> Construct:
    """Return the field of the first angle, and the flag of the first capsule."""
    flag = "sync" / BitsInteger(1) * "the bit S of the manual; 1: the first capsule after a start"
    return "start" / ByteSwapped(BitStruct(flag, "angle" / Scaled(BitsInteger(15), 1 / 64, "deg")))


def make_sample() -> Construct:
    """Return the struct of a distance, with the high bits of dtheta.

    dtheta is the compensation of the angle.
    """
    distance = "distance" / Scaled(BitsInteger(14), 0.001, "m") * "0: no return"
    return ByteSwapped(BitStruct(distance, "dtheta_high" / BitsInteger(2)))


EXPRESS = make_capsule(
    make_start(),
    "cabins"
    / Array(
        EXPRESS_CABINS,
        Struct(
            "first" / make_sample(),
            "second" / make_sample(),
            "dtheta_low"
            / BitStruct("second" / BitsInteger(4), "first" / BitsInteger(4))
            * "1/8 degree",
        ),
    ),
)
ULTRA = make_capsule(
    make_start(),
    "cabins"
    / Array(
        ULTRA_CABINS,
        ByteSwapped(
            BitStruct(
                "predict2"
                / Scaled(BitsInteger(10, signed=True), 1, "")
                * (
                    "the distance of the third point minus the distance `major` of the next cabin,"
                    " in steps that depend on this `major`; 511 and -512: no return"
                ),
                "predict1"
                / BitsInteger(10, signed=True)
                * "the distance of the second point minus the distance `major` of this cabin (of"
                " the next cabin if `major` is 0), in steps that depend on the same `major`; 511"
                " and -512: no return",
                "major" / BitsInteger(12) * "the encoded distance of the first point; 0: no return",
            )
        ),
    ),
)
DENSE = make_capsule(
    make_start(), "distances" / Array(DENSE_CABINS, Scaled(Int16ul, 0.001, "m")) * "0: no return"
)
ULTRA_DENSE = make_capsule(
    "time_stamp" / Int32ul * "unit not documented",
    "status" / Int16ul,
    make_start(),
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
    """Return whether the first angle is below 360 degrees."""
    return f.start.angle < 360


def point_step(f: Fields, count: int) -> Any:
    """Return the degrees from a point to the next, (n, 1), for `count` points.

    The step is nan if the next capsule is missing.
    """
    after = np.where(following(f.start.sync) == 0, following(f.start.angle), np.nan)
    return wrap(after - f.start.angle, 360.0) / count


def uncompensated_angles(f: Fields, cabins: int, points: int) -> Any:
    """Return the clockwise angles of points in degrees, without compensation.

    Args:
        cabins: the number of cabins in a capsule.
        points: the number of points in a cabin.

    Returns:
        The angles, (n, cabins, points).
    """
    count = cabins * points
    step = point_step(f, cabins * points)
    return stack(
        *(f.start.angle + step * np.arange(index, count, points) for index in range(points))
    )


def express_points(f: Fields, *, signed: bool = False) -> Polar:
    """Return 32 points per capsule.

    `signed` is whether the compensation dtheta is signed, as in the protocol, or unsigned, as in
    the SDK.
    """
    first = f.cabins.first
    second = f.cabins.second
    low = f.cabins.dtheta_low
    eighths = stack(first.dtheta_high * 16 + low.first, second.dtheta_high * 16 + low.second)
    if signed:
        eighths = np.where(eighths >= DTHETA_SIGN_BIT, eighths - 2 * DTHETA_SIGN_BIT, eighths)
    clockwise = uncompensated_angles(f, EXPRESS_CABINS, 2) - eighths / 8
    return Polar(range=stack(first.distance, second.distance), azimuth=-np.deg2rad(clockwise))


def dense_points(f: Fields) -> Polar:
    """Return 40 points per capsule, without compensation."""
    clockwise = f.start.angle + point_step(f, DENSE_CABINS) * np.arange(DENSE_CABINS)
    return Polar(range=f.distances, azimuth=-np.deg2rad(clockwise))


def predicted_distance(reference: Any, level: Any, prediction: Any) -> Any:
    """Return a predicted distance in mm; 0 if the prediction means no return.

    Args:
        reference: the reference distance in mm.
        level: the level of the reference distance in `CODE_LEVELS`, from 0 to 4.
        prediction: the predicted distance minus the reference distance, in steps of 2**level mm;
            511 and -512 mean no return.
    """
    return np.where(
        (prediction == 511) | (prediction == -512), 0, reference + prediction * np.exp2(level)
    )


def compensation(mm: Any) -> Any:
    """Return the degrees to subtract from the angle of an ultra capsule's point.

    Source: handler_capsules.cpp.
    """
    ratio = np.floor(98361 / np.maximum(mm * 4, 200))
    return np.where(mm >= 50, 8 - np.rad2deg((ratio * 64 + ratio**3 / 98304) / 65536), 7.5)


def ultra_points(f: Fields) -> Polar:
    """Return 96 points per capsule, three for each cabin."""
    code = f.cabins.major
    next_code = following(f.cabins.major)
    major = take(CODE_MILLIMETRES, code)
    next_major = take(CODE_MILLIMETRES, next_code)
    next_level = take(CODE_LEVELS, next_code)
    is_major_missing = (major == 0) & (next_major > 0)
    base = np.where(is_major_missing, next_major, major)
    level = np.where(is_major_missing, next_level, take(CODE_LEVELS, code))
    first = predicted_distance(base, level, f.cabins.predict1)
    second = predicted_distance(next_major, next_level, f.cabins.predict2)
    mm = stack(major, first, second)
    return Polar(
        range=mm / 1000,
        azimuth=-np.deg2rad(uncompensated_angles(f, ULTRA_CABINS, 3) - compensation(mm)),
    )


def ultra_dense_points(f: Fields) -> Polar:
    """Return 64 points per capsule."""
    cabins = f.cabins
    scale = stack(cabins.first_scale, cabins.second_scale)
    code = stack(
        cabins.first_high * (1 << 14) + cabins.first_low,
        cabins.second_high * (1 << 14) + cabins.second_low,
    )
    size = np.exp2(10 + scale)
    quality = np.floor(code / size)
    return Polar(
        range=(take(SCALE_STARTS_MM, scale) + (2 + scale) * (code - quality * size)) / 1000,
        azimuth=-np.deg2rad(uncompensated_angles(f, ULTRA_DENSE_CABINS, 2)),
        intensity=quality * np.exp2(scale),
    )


def encode_ultra(polar: Polar) -> Mapping[str, Any]:
    """Return the fields of ultra capsules with these ranges."""
    mm = np.asarray(polar.range) * 1000
    code = nearest_codes(mm[..., 0])
    next_code = np.append(code.reshape(-1)[1:], 0).reshape(code.shape)
    base = np.where(code > 0, code, next_code)
    first, second = (
        encode_prediction(mm[..., index], reference)
        for index, reference in ((1, base), (2, next_code))
    )
    return {"cabins.major": code, "cabins.predict1": first, "cabins.predict2": second}


def nearest_codes(mm: Any) -> Any:
    """Return the ultra codes whose distances are nearest to `mm`; 0 where `mm` is 0."""
    above = np.clip(np.searchsorted(CODE_MILLIMETRES, mm), 1, len(CODE_MILLIMETRES) - 1)
    is_nearer_below = mm - CODE_MILLIMETRES[above - 1] < CODE_MILLIMETRES[above] - mm
    nearest = np.where(is_nearer_below, above - 1, above)
    return np.where(mm > 0, nearest, 0)


def encode_prediction(mm: Any, code: Any) -> Any:
    """Return the difference from a reference distance to `mm`, in steps.

    The result is 511 if the difference cannot be encoded, or if `mm` is 0 (no return).

    Args:
        mm: the distance to encode, in mm.
        code: the code of the reference distance, which determines the size of a step.
    """
    base = CODE_MILLIMETRES[code]
    scale = np.exp2(CODE_LEVELS[code])
    steps = np.rint((mm - base) / scale)
    return np.where(
        (mm > 0) & (base + steps * scale > 0) & (np.abs(steps) < 511), steps, 511
    ).astype(np.int64)


def encode_ultra_dense(polar: Polar) -> Mapping[str, Any]:
    """Return the fields of ultra-dense capsules with these ranges."""
    mm = np.asarray(polar.range) * 1000
    scale = np.searchsorted(SCALE_STARTS_MM, mm, side="right") - 1
    steps = np.rint((mm - SCALE_STARTS_MM[scale]) / (2 + scale)).astype(np.int64)
    code = np.where(mm > 0, steps + ((SIMULATED_QUALITY >> scale) << (10 + scale)), 0)
    fields: dict[str, Any] = {}
    for index, name in enumerate(("first", "second")):
        point_code = code[..., index]
        fields |= {
            f"cabins.{name}_low": point_code & 0x3FFF,
            f"cabins.{name}_high": point_code >> 14,
            f"cabins.{name}_scale": scale[..., index],
        }
    return fields


def sweep(i: int, degrees: float) -> Mapping[str, Any]:
    """Return the values of simulated capsule i; capsules are `degrees` apart."""
    return {"start.angle": i * degrees % 360, "start.sync": int(i == 0)}
