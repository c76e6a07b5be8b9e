"""Packets of Ouster sensors: pixel profiles, lidar packets and IMU packets.

All values are little-endian.

    header | 16 columns: column header, H pixels, column footer | footer
    (LEGACY has no header and no footer)

How many pixels a column has, and how they are packed, no packet says: the metadata do.

Source: ouster-sdk, parsing.cpp; the bits of LEGACY, RNG19 (single and dual) and RNG15 hold for
captures, whose every field has the MD5 of the vendor's digests; those of FUSA for one captured
packet. The other profiles, and the IMU packets with NMEA, are read off alone.
"""

from __future__ import annotations

import functools
from functools import partial
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    BytesInteger,
    ByteSwapped,
    Const,
    Construct,
    Float32l,
    Int8ul,
    Int16ul,
    Int24ul,
    Int32ul,
    Int64ul,
    Struct,
)

from lidarspec.spec import Checksummed, Clock, Crc, Fields, Frame, Imu, Scaled, Simulation

Bits = dict[str, int]
#: bits of the fields of a pixel, from bit 0 on; those whose name begins with _ are not used.
WIDE = {"range": 19, "flags": 5}
FIRST = {**WIDE, "reflectivity": 8}
SECOND = {"range2": 19, "flags2": 5, "reflectivity2": 8}
SMALL = {"range": 15, "flags": 1, "reflectivity": 8, "near_ir": 8}
SMALL_SECOND = {"range2": 15, "flags2": 1, "reflectivity2": 8, "window": 8}
RGB = {"red": 16, "green": 16, "blue": 16}
#: profile -> a pixel.
PROFILES: dict[str, Bits] = {
    "LEGACY": {
        "range": 20,
        "_20": 8,
        "flags": 4,
        "reflectivity": 8,
        "_40": 8,
        "signal": 16,
        "near_ir": 16,
        "_80": 16,
    },
    "RNG19_RFL8_SIG16_NIR16": {
        **WIDE,
        "_24": 8,
        "reflectivity": 8,
        "_40": 8,
        "signal": 16,
        "near_ir": 16,
        "_80": 8,
        "window": 8,
    },
    "RNG19_RFL8_SIG16_NIR16_DUAL": {
        **FIRST,
        **SECOND,
        "signal": 16,
        "signal2": 16,
        "near_ir": 16,
        "_112": 8,
        "window": 8,
    },
    "RNG15_RFL8_NIR8": SMALL,
    "RNG15_RFL8_NIR8_DUAL": {**SMALL, **SMALL_SECOND},
    "FUSA_RNG15_RFL8_NIR8_DUAL": {**SMALL, **SMALL_SECOND},
    "FIVE_WORD_PIXEL": {**FIRST, **SECOND, "signal": 16, "signal2": 16, "near_ir": 16, "_112": 48},
    "RNG15_RFL8_NIR8_ZONE16": {**SMALL, "zone_mask": 16, "window": 8, "_56": 8},
    "RNG19_RFL8_SIG16_NIR16_ZONE16": {
        **{**WIDE, "_24": 8, "reflectivity": 8, "window": 8},
        **{"signal": 16, "near_ir": 16, "zone_mask": 16},
    },
    "RNG15_RFL8_WIN8": {"range": 15, "flags": 1, "reflectivity": 8, "window": 8},
    "RNG19_RFL8_SIG16_ZONE16_DUAL": {
        **FIRST,
        **SECOND,
        "signal": 16,
        "signal2": 16,
        "zone_mask": 16,
        "_112": 8,
        "window": 8,
    },
    "RNG19_RFL8_SIG16_NIR16_RGB16": {**FIRST, "signal": 16, "near_ir": 16, **RGB, "_112": 16},
    "RNG19_RFL8_SIG16_NIR16_RGB16_DUAL": {
        **FIRST,
        **SECOND,
        "signal": 16,
        "signal2": 16,
        "near_ir": 16,
        **RGB,
    },
}

COLUMNS = 16  # of a packet, unless the metadata say otherwise
VALID = 0xFFFFFFFF  # status of a valid column of LEGACY; of others bit 0 says it
ENCODER = 90_112  # counts of a turn
LIDAR = 1
IMU = 2  # packet types
GRAVITY = 9.80665  # m/s2, one g of the IMU
#: values of the footer's CRC that mean that none is filled in: of firmware 2.2, and of 2.3 up to
#: 3.1.
NOT_FILLED = (0, 0xDEADBEEF0000C0DE)
ONES = (1 << 64) - 1
CRC = Crc(64, 0x42F0E1EBA9EA3693, init=ONES, refin=True, refout=True, xorout=ONES)  # CRC-64/XZ
SERIAL = BytesInteger(5, swapped=True)
TIME = Scaled(Int64ul, 1, "ns")

HEADER = (
    "frame_id" / Int16ul * "counter of revolutions",
    "init_id" / Int24ul * "changes with each start and each change of the configuration",
    "serial" / SERIAL * "prod_sn of the metadata",
    "alert_flags" / Int8ul,
    "reserved_13" / Bytes(3),
)
FUSA_HEADER = (
    "init_id" / Int24ul * "changes with each start and each change of the configuration",
    "frame_id" / Int32ul * "counter of revolutions",
    "alert_flags" / Int8ul,
    "reserved_9" / Bytes(2),
    "serial" / SERIAL * "prod_sn of the metadata",
)
STATE = (
    "shutdown_countdown" / Scaled(Int8ul, 1, "s") * "thermal",
    "shot_limiting_countdown" / Scaled(Int8ul, 1, "s"),
    "shutdown_state" / Int8ul * "in the low 4 bits",
    "shot_limiting_state" / Int8ul * "4 bits",
    "reserved_20" / Bytes(12),
)
FOOTER = ("reserved_footer" / Bytes(24), "crc" / Int64ul)


def size(profile: str, rows: int, columns: int = COLUMNS) -> int:
    """Return the bytes of a lidar packet."""
    head, column = (0, 20) if profile == "LEGACY" else (64, 12)
    return head + columns * (column + rows * sum(PROFILES[profile].values()) // 8)


def pixel(profile: str) -> Construct:
    """One pixel as one number, whose bits are the fields."""
    fields = (
        (f"reserved{name}" if name[0] == "_" else name, bits)
        for name, bits in reversed(PROFILES[profile].items())
    )
    return ByteSwapped(BitStruct(*(name / _field(name, bits) for name, bits in fields)))


def _field(name: str, bits: int) -> Construct:
    """Return a field of a pixel: ranges have steps of 8 mm where they have 15 bits, else of 1 mm;
    near-infrared of 8 bits lacks its low 4.
    """
    if name.startswith("range"):
        return Scaled(BitsInteger(bits), 0.008 if bits == 15 else 0.001, "m")
    if (name, bits) == ("near_ir", 8):
        return Scaled(BitsInteger(bits), 16, "")
    return BitsInteger(bits)


def packet(profile: str, rows: int, columns: int) -> Construct:
    """Return a lidar packet."""
    pixels = "pixels" / Array(rows, pixel(profile))
    began = (
        "timestamp" / TIME,
        "measurement_id" / Scaled(Int16ul, 1, "") * "index of the column in its revolution",
    )
    if profile == "LEGACY":
        head = (*began, "frame_id" / Int16ul, "encoder" / Int32ul * "90112 counts per revolution")
        return Struct(
            "columns"
            / Array(columns, Struct(*head, pixels, "status" / Int32ul * "0xffffffff: valid"))
        )
    body = "columns" / Array(columns, Struct(*began, "status" / Int16ul * "bit 0: valid", pixels))
    if profile.startswith("FUSA"):
        return Struct("type" / Const(LIDAR, Int8ul), *FUSA_HEADER, *STATE, body, *FOOTER)
    return Checksummed(
        Struct("type" / Const(LIDAR, Int16ul), *HEADER, *STATE, body, *FOOTER),
        "crc",
        CRC,
        absent=NOT_FILLED,
    )


@functools.cache
def lidar(profile: str, rows: int, columns: int, turn: int) -> Frame:
    """Return the data frame, with so many columns in a turn."""
    plausible = partial(legacy_plausible if profile == "LEGACY" else plausible_columns, turn=turn)
    return Frame(packet(profile, rows, columns), data=True, plausible=plausible)


def plausible_columns(f: Fields, turn: int) -> Any:
    """Columns of a turn that follow one another."""
    number = f.columns.measurement_id
    return (number < turn) & (number == f.columns[0].measurement_id + f.columns.index)


def legacy_plausible(f: Fields, turn: int) -> Any:
    """The same, and all of one turn, valid or not: nothing else tells these packets from noise."""
    columns = f.columns
    status = (columns.status == VALID) | (columns.status == 0)
    return (
        plausible_columns(f, turn)
        & status
        & (columns.encoder < ENCODER)
        & (columns.frame_id == columns[0].frame_id)
    )


AXES = ("x", "y", "z")
LEGACY_IMU = Struct(
    "timestamp" / TIME,
    "acceleration_timestamp" / TIME,
    "gyro_timestamp" / TIME,
    *(f"acceleration_{axis}" / Scaled(Float32l, GRAVITY, "m/s2") * "sent in g" for axis in AXES),
    *(f"gyro_{axis}" / Scaled(Float32l, 1, "deg/s") for axis in AXES),
)
# One measurement of an ACCEL32_GYRO32_NMEA packet. Captured values are multiples of 9.80665/2048
# and of (pi/180)/16.4: the sensor sends m/s2 and rad/s, and ouster-sdk hands them out unchanged.
SAMPLE = Struct(
    "timestamp" / TIME,
    "measurement_id" / Int16ul,
    "status" / Int16ul,
    *(f"acceleration_{axis}" / Scaled(Float32l, 1, "m/s2") for axis in AXES),
    *(f"gyro_{axis}" / Scaled(Float32l, 1, "rad/s") for axis in AXES),
)
Rotation = tuple[tuple[float, float, float], ...]


@functools.cache
def imu(samples: int, turned: Rotation) -> Frame:
    """The frame of the IMU: LEGACY where `samples` is 0, else with NMEA and so many samples; and
    how the IMU is turned in the sensor.
    """
    felt = partial(feel, path="samples" if samples else "", turned=turned)
    if not samples:
        at_rest = Simulation(
            lambda i: dict.fromkeys(
                ("timestamp", "acceleration_timestamp", "gyro_timestamp"), i * 10_000_000
            ),
            rate=100,
        )
        return Frame(
            LEGACY_IMU,
            imu=felt,
            clock=Clock("gyro_timestamp"),
            plausible=steady,
            simulation=at_rest,
        )
    body = ("nmea_timestamp" / TIME, "nmea" / Bytes(92), "samples" / Array(samples, SAMPLE))
    head = Struct("type" / Const(IMU, Int16ul), *HEADER, *STATE, *body, *FOOTER)
    sealed = Checksummed(head, "crc", CRC, absent=NOT_FILLED)
    return Frame(
        sealed,
        imu=felt,
        clock=Clock("samples[0].timestamp"),
        simulation=Simulation(partial(sample_times, samples), rate=100),
    )


def sample_times(samples: int, i: int) -> dict[str, Any]:
    """Return the times of packet i, 100 a second."""
    return {"samples.timestamp": (i + np.arange(samples) / samples) * 10_000_000}


def feel(f: Fields, path: str, turned: Rotation) -> Imu:
    """Return the IMU measurements in the axes of the sensor: rad/s, m/s2 and seconds.

    Args:
        path: array of measurements in an ACCEL32_GYRO32_NMEA packet; "" for the single one of a
            LEGACY packet.
        turned: rotation from the IMU to the sensor.
    """
    if path:
        values = getattr(f, path)
        time = (values.timestamp - values[0].timestamp) * 1e-9
        rates = [getattr(values, f"gyro_{axis}") for axis in AXES]
    else:
        values = f
        time = 0
        rates = [np.deg2rad(getattr(values, f"gyro_{axis}")) for axis in AXES]
    accelerations = [getattr(values, f"acceleration_{axis}") for axis in AXES]
    return Imu(rotate(turned, rates), rotate(turned, accelerations), time)


def rotate(turned: Rotation, vector: Any) -> tuple[Any, ...]:
    """Return a vector of columns, turned."""
    parts = list(vector)
    return tuple(
        sum(weight * part for weight, part in zip(row, parts, strict=True) if weight)
        for row in turned
    )


def steady(f: Fields) -> Any:
    """Times within a second of one another."""
    return (abs(f.acceleration_timestamp - f.timestamp) < 1e9) & (
        abs(f.gyro_timestamp - f.timestamp) < 1e9
    )
