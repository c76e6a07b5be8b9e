"""Packets of Ouster sensors: pixel profiles, lidar packets and IMU packets.

All values are little-endian.

    header | 16 columns: column header, H pixels, column footer | footer
    (LEGACY has no header and no footer)

The number of pixels per column and their packing are in the metadata of the sensor, not in the
packets.

Source: ouster-sdk, parsing.cpp. The bits of LEGACY, RNG19 (single and dual) and RNG15 are verified
with captures by the MD5 digests that the vendor publishes for each field. The bits of FUSA are
verified with one captured packet. The other profiles, and the IMU packets with NMEA, are taken from
the source code only.
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
#: Bits of the fields of a pixel, from bit 0 on; names that begin with _ are unused bits.
WIDE = {"range": 19, "flags": 5}
FIRST = {**WIDE, "reflectivity": 8}
SECOND = {"range2": 19, "flags2": 5, "reflectivity2": 8}
SMALL = {"range": 15, "flags": 1, "reflectivity": 8, "near_ir": 8}
SMALL_SECOND = {"range2": 15, "flags2": 1, "reflectivity2": 8, "window": 8}
RGB = {"red": 16, "green": 16, "blue": 16}
#: Profile -> the fields of a pixel.
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

COLUMNS = 16  # per packet, unless the metadata differ
VALID = 0xFFFFFFFF  # status of a valid column in LEGACY; other profiles use one bit
COLUMN_STATUS = ByteSwapped(BitStruct("reserved" / BitsInteger(15), "valid" / BitsInteger(1)))
ENCODER_COUNTS_PER_TURN = 90_112
LIDAR = 1  # packet type
IMU = 2  # packet type
GRAVITY = 9.80665  # m/s2, one g of the IMU
#: The values that firmware 2.2, and firmware 2.3 to 3.1, send in place of a CRC.
ABSENT_CRCS = (0, 0xDEADBEEF0000C0DE)
ONES = (1 << 64) - 1
CRC = Crc(64, 0x42F0E1EBA9EA3693, init=ONES, refin=True, refout=True, xorout=ONES)  # CRC-64/XZ
SERIAL = BytesInteger(5, swapped=True)
TIME = Scaled(Int64ul, 1, "ns")

HEADER = (
    "frame_id" / Int16ul * "counter of revolutions",
    "init_id" / Int24ul * "changes with each start and each change of the configuration",
    "serial" / SERIAL * "serial number of the sensor, prod_sn in the metadata",
    "alert_flags" / Int8ul,
    "reserved_13" / Bytes(3),
)
FUSA_HEADER = (
    "init_id" / Int24ul * "changes with each start and each change of the configuration",
    "frame_id" / Int32ul * "counter of revolutions",
    "alert_flags" / Int8ul,
    "reserved_9" / Bytes(2),
    "serial" / SERIAL * "serial number of the sensor, prod_sn in the metadata",
)
STATE_BITS = BitStruct("reserved" / BitsInteger(4), "state" / BitsInteger(4))
STATE = (
    "shutdown_countdown" / Scaled(Int8ul, 1, "s") * "time until the thermal shutdown",
    "shot_limiting_countdown" / Scaled(Int8ul, 1, "s"),
    "shutdown_state" / STATE_BITS,
    "shot_limiting_state" / STATE_BITS,
    "reserved_20" / Bytes(12),
)
FOOTER = ("reserved_footer" / Bytes(24), "crc" / Int64ul)


def packet_bytes(profile: str, rows: int, columns: int = COLUMNS) -> int:
    """Return the size of a lidar packet in bytes."""
    header, column = (0, 20) if profile == "LEGACY" else (64, 12)
    return header + columns * (column + rows * sum(PROFILES[profile].values()) // 8)


def make_pixel(profile: str) -> Construct:
    """Return the struct of a pixel: one number whose bits are the fields."""
    fields = (
        (f"reserved{name}" if name[0] == "_" else name, bits)
        for name, bits in reversed(PROFILES[profile].items())
    )
    return ByteSwapped(BitStruct(*(name / make_field(name, bits) for name, bits in fields)))


def make_field(name: str, bits: int) -> Construct:
    """Return the type of a pixel's field."""
    if name.startswith("range"):
        return Scaled(BitsInteger(bits), 0.008 if bits == 15 else 0.001, "m")
    if (name, bits) == ("near_ir", 8):
        return Scaled(BitsInteger(bits), 16, "")
    return BitsInteger(bits)


def make_packet(profile: str, rows: int, columns: int) -> Construct:
    """Return the struct of a lidar packet."""
    pixels = "pixels" / Array(rows, make_pixel(profile))
    column_start = (
        "timestamp" / TIME,
        "measurement_id" / Scaled(Int16ul, 1, "") * "index of the column in its revolution",
    )
    if profile == "LEGACY":
        column_header = (
            *column_start,
            "frame_id" / Int16ul,
            "encoder" / Int32ul * "90112 counts per revolution",
        )
        return Struct(
            "columns"
            / Array(
                columns,
                Struct(
                    *column_header, pixels, "status" / Int32ul * "0xffffffff: the column is valid"
                ),
            )
        )
    body = "columns" / Array(columns, Struct(*column_start, "status" / COLUMN_STATUS, pixels))
    if profile.startswith("FUSA"):
        return Struct("type" / Const(LIDAR, Int8ul), *FUSA_HEADER, *STATE, body, *FOOTER)
    return Checksummed(
        Struct("type" / Const(LIDAR, Int16ul), *HEADER, *STATE, body, *FOOTER),
        "crc",
        CRC,
        absent=ABSENT_CRCS,
    )


@functools.cache
def make_lidar_frame(profile: str, rows: int, columns: int, turn: int) -> Frame:
    """Return the data frame of lidar packets.

    Args:
        profile: a key of `PROFILES`.
        rows: pixels per column.
        columns: columns per packet.
        turn: columns per revolution.
    """
    plausible = partial(is_legacy_plausible if profile == "LEGACY" else is_plausible, turn=turn)
    return Frame(make_packet(profile, rows, columns), data=True, plausible=plausible)


def is_plausible(f: Fields, turn: int) -> Any:
    """Return whether the numbers of the columns are consecutive and below `turn`."""
    column_number = f.columns.measurement_id
    return (column_number < turn) & (column_number == f.columns[0].measurement_id + f.columns.index)


def is_legacy_plausible(f: Fields, turn: int) -> Any:
    """Return whether columns, status, encoder and frame id of a LEGACY packet are valid."""
    columns = f.columns
    has_known_status = (columns.status == VALID) | (columns.status == 0)
    return (
        is_plausible(f, turn)
        & has_known_status
        & (columns.encoder < ENCODER_COUNTS_PER_TURN)
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
#: One measurement of an ACCEL32_GYRO32_NMEA packet. Captured values are multiples of 9.80665/2048
#: and of (pi/180)/16.4, which shows that the sensor sends m/s2 and rad/s. ouster-sdk returns them
#: unchanged.
SAMPLE = Struct(
    "timestamp" / TIME,
    "measurement_id" / Int16ul,
    "status" / Int16ul,
    *(f"acceleration_{axis}" / Scaled(Float32l, 1, "m/s2") for axis in AXES),
    *(f"gyro_{axis}" / Scaled(Float32l, 1, "rad/s") for axis in AXES),
)
Rotation = tuple[tuple[float, float, float], ...]


@functools.cache
def make_imu_frame(samples: int, rotation: Rotation) -> Frame:
    """Return the frame of the IMU.

    Args:
        samples: samples per packet with NMEA; 0 for a LEGACY packet.
    """
    read_imu = partial(imu_samples, path="samples" if samples else "", rotation=rotation)
    if not samples:
        simulation = Simulation(
            lambda i: dict.fromkeys(
                ("timestamp", "acceleration_timestamp", "gyro_timestamp"), i * 10_000_000
            ),
            rate=100,
        )
        return Frame(
            LEGACY_IMU,
            imu=read_imu,
            clock=Clock("gyro_timestamp"),
            plausible=has_near_times,
            simulation=simulation,
        )
    body = ("nmea_timestamp" / TIME, "nmea" / Bytes(92), "samples" / Array(samples, SAMPLE))
    struct = Struct("type" / Const(IMU, Int16ul), *HEADER, *STATE, *body, *FOOTER)
    checked_struct = Checksummed(struct, "crc", CRC, absent=ABSENT_CRCS)
    return Frame(
        checked_struct,
        imu=read_imu,
        clock=Clock("samples[0].timestamp"),
        simulation=Simulation(partial(sample_times, samples), rate=100),
    )


def sample_times(samples: int, i: int) -> dict[str, Any]:
    """Return the times of the samples in simulated packet i, at 100 packets a second."""
    return {"samples.timestamp": (i + np.arange(samples) / samples) * 10_000_000}


def imu_samples(f: Fields, path: str, rotation: Rotation) -> Imu:
    """Return the IMU measurements in rad/s, m/s2 and seconds, in the sensor's axes.

    Args:
        path: the array of measurements in an ACCEL32_GYRO32_NMEA packet; "" for the single
            measurement of a LEGACY packet.
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
    return Imu(rotate(rotation, rates), rotate(rotation, accelerations), time)


def rotate(rotation: Rotation, vector: Any) -> tuple[Any, ...]:
    """Return the components of a rotated vector; each component is a column."""
    parts = list(vector)
    return tuple(
        sum(weight * part for weight, part in zip(row, parts, strict=True) if weight)
        for row in rotation
    )


def has_near_times(f: Fields) -> Any:
    """Return whether both sample times are within 1 s of the packet's timestamp."""
    return (abs(f.acceleration_timestamp - f.timestamp) < 1e9) & (
        abs(f.gyro_timestamp - f.timestamp) < 1e9
    )
