"""Hesai AT128: protocol 4.3, packets of 2 blocks of 128 channels.

A packet has 1086 bytes, 1118 with a signature. A mirror with three faces sweeps the beams over 120
degrees to the front, and a scan is the sweep of one face. The beam turns by twice the angle of the
mirror. The azimuth of a point is therefore twice the mirror's angle from the start of the face,
plus the azimuth of the channel, plus a correction for the channel. The sensor's file has the
corrections for every two degrees of the mirror.

The CRCs probably cover the same bytes as in packets of a QT128. No captured packet was available
to confirm this, so the CRCs are read but not checked.

Source: HesaiLidar_SDK_2.0 (udp_protocol_v4_3.h, udp4_3_parser.cc: packets, axes, correction files
of version 1.5, azimuth jump between scans; correction files of an AT128E2X); tier4/nebula (times,
range limits, 200 revolutions per minute). This module interpolates the corrections linearly, as
nebula does.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from construct import (
    Array,
    BitsInteger,
    BitStruct,
    Bytes,
    Const,
    ConstructError,
    Int8ul,
    Int16ul,
    Int32sl,
    Int32ul,
    OneOf,
    Struct,
    this,
)

from lidarspec import UsageError
from lidarspec.spec import Fields, Frame, Learned, OnJump, Polar, Scaled, take
from lidarspec_hesai.calibration import Calibration, Table, read_content
from lidarspec_hesai.crc_packets import (
    BLOCKS,
    LASERS,
    UNSEEN,
    distance,
    make_packet,
    max_packet_bytes,
    packet_values,
    plausible,
)
from lidarspec_hesai.family import make_spinning_sensor
from lidarspec_hesai.parts import FACTORY, RETURN_MODE, UTC, count_returns, rotation_values

AZIMUTH_STEPS_PER_DEG = 256 * 100  # per degree, with the finer azimuth
CORRECTION_STEP_DEG = 2  # from correction to correction, of the mirror
LAST_SHOT_S = -9.249e-6  # from the packet's time to the end of the last shot
SHOT_PERIOD_S = 41.666e-6  # from shot to shot
MIN_JUMP_DEG = 10.0  # of the mirror
SIMULATED_SHOTS = 1200  # of a scan, 0.1 degrees apart
SIMULATED_START_DEG = 15.0  # of the mirror, from the face to the first shot

# fmt: off
FIRING_US = (
    0, 0, 8.24, 4.112, 4.114, 8.24, 0, 0, 12.424, 4.144, 4.112, 8.264, 12.376, 12.376, 8.264, 12.424, 0, 0, 4.112, 8.24, 4.144, 0, 0,
    4.144, 12.424, 8.264, 4.112, 12.376, 12.376, 12.424, 8.264, 0.848, 2.504, 4.976, 6.616, 6.616, 9.112, 2.504, 0.848, 10.768, 13.28,
    13.28, 4.976, 9.112, 14.928, 14.928, 10.768, 2.504, 0.848, 6.616, 4.976, 9.112, 6.616, 0.848, 2.504, 13.28, 10.768, 4.976, 13.28,
    13.28, 9.112, 10.768, 14.928, 13.28, 0.848, 9.112, 13.28, 2.504, 4.976, 0.848, 2.504, 14.928, 10.768, 10.768, 14.928, 4.976, 6.616,
    6.616, 9.112, 10.768, 13.28, 13.28, 9.112, 4.976, 2.504, 2.504, 0.848, 10.768, 14.928, 14.928, 10.768, 6.616, 4.976, 9.112, 6.616,
    4.112, 12.424, 0, 4.144, 0, 0, 12.424, 0, 8.264, 12.424, 12.424, 8.24, 8.24, 8.264, 12.376, 12.376, 12.424, 4.112, 4.144, 0, 0, 0, 0,
    0, 12.424, 8.264, 8.24, 4.144, 8.264, 8.24, 12.376, 12.376, 8.264,
)
# fmt: on

FILE = Struct(
    "mark" / Const(b"\xee\xff\x01\x05"),
    "channels" / Const(LASERS, Int8ul),
    "faces" / Int8ul,
    "fields" / Int8ul,
    "field_config" / Bytes(8),
    "resolution" / Int8ul * "scale of the angle corrections: 1 means 0.01 degrees",
    "start" / Array(this.faces, Int32ul),
    "end" / Array(this.faces, Int32ul),
    "azimuth" / Array(LASERS, Int32sl),
    "elevation" / Array(LASERS, Int32sl),
    "azimuth_adjust" / Bytes(LASERS * 180),
    "elevation_adjust" / Bytes(LASERS * 180),
    "sha256" / Bytes(32) * "SHA-256 of all preceding bytes",
)


@dataclass(frozen=True, eq=False)
class Mirror(Calibration):
    """The mirror and the channels of a sensor.

    Attributes:
        faces: (faces,) the mirror angles at which the faces begin, degrees.
        azimuth_adjust, elevation_adjust: (181, channels) the degrees to add, with a row for every 2
            degrees of the mirror; None for no correction.
    """

    faces: Table = dataclasses.field(default_factory=lambda: np.array([23.075, 143.44, 263.133]))
    azimuth_adjust: Table | None = None
    elevation_adjust: Table | None = None

    def with_file(self, source: str | Path | Learned) -> Mirror:
        """Return a copy with the angles of one unit.

        Args:
            source: the path of the sensor's correction file (.dat), or the sensor's reply to the
                command `get_calibration`.

        Raises:
            UsageError: if the file cannot be read, or belongs to another model.
        """
        data = read_content(source)
        try:
            file = FILE.parse(data)
        except ConstructError as error:
            raise UsageError(
                f"{source!s}: not a correction file of an AT128, version 1.5 (.dat):"
                f" {str(error).splitlines()[-1]}"
            ) from None
        if not file.faces or hashlib.sha256(data[:-32]).digest() != data[-32:]:
            raise UsageError(
                f"{source!s}: the correction file is corrupt: its SHA-256 does not match"
            )
        step_deg = file.resolution / AZIMUTH_STEPS_PER_DEG
        return dataclasses.replace(
            self,
            faces=np.array(file.start) * step_deg,
            azimuth=-np.array(file.azimuth) * step_deg,
            elevation=np.array(file.elevation) * step_deg,
            azimuth_adjust=parse_adjustments(file.azimuth_adjust, file.resolution),
            elevation_adjust=parse_adjustments(file.elevation_adjust, file.resolution),
            nominal=False,
        )

    def to_file(self) -> bytes:
        """Return the angles as a correction file (.dat)."""
        start = np.rint(self.faces * AZIMUTH_STEPS_PER_DEG).astype(int).tolist()
        no_adjustment = bytes(LASERS * 180)
        values = {
            "faces": len(start),
            "fields": len(start),
            "field_config": bytes(8),
            "resolution": 1,
            "start": start,
            "end": start[1:] + start[:1],
            "azimuth": np.rint(-self.azimuth * AZIMUTH_STEPS_PER_DEG).astype(int).tolist(),
            "elevation": np.rint(self.elevation * AZIMUTH_STEPS_PER_DEG).astype(int).tolist(),
            "azimuth_adjust": no_adjustment,
            "elevation_adjust": no_adjustment,
        }
        data: bytes = FILE.build(values | {"sha256": bytes(32)})[:-32]
        return data + hashlib.sha256(data).digest()

    def interpolate_adjustment(self, table: Table | None, azimuth: Any) -> Any:
        """Return the degrees to add for each channel at some angles of the mirror."""
        if table is None:
            return 0.0
        step = np.floor(azimuth / CORRECTION_STEP_DEG)
        fraction = azimuth / CORRECTION_STEP_DEG - step
        return take(table, step) * (1 - fraction) + take(table, step + 1) * fraction


def parse_adjustments(data: bytes, resolution: int) -> Table:
    """Return corrections in degrees, (181, channels)."""
    degrees = np.frombuffer(data, np.int8).reshape(LASERS, 180).T * (resolution / 100)
    return np.concatenate([degrees, degrees[:1]])


VERSION = ("major" / Const(4, Int8ul), "minor" / OneOf(Int8ul, [1, 3]))
CHANNEL = Struct(
    "distance" / Int16ul * "in steps of dis_unit; 0: no return",
    "reflectivity" / Int8ul,
    "confidence" / Int8ul,
)
TAIL = (
    "tail_reserved" / Bytes(6),
    "shutdown"
    / BitStruct(
        "reserved" / BitsInteger(7), "overheated" / BitsInteger(1) * "1: about to shut down"
    ),
    "tail_reserved_2" / Bytes(11),
    "motor_speed" / Scaled(Int16ul, 1, "rpm"),
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time since the date and time in `utc`",
    "return_mode" / RETURN_MODE,
    "factory" / Int8ul * FACTORY,
    "utc" / UTC,
)


def points(f: Fields, channels: Mirror) -> Polar:
    """Return the points of a packet; the last shot is at the packet's time (nebula)."""
    blocks = f.body.blocks
    block = np.arange(BLOCKS)[:, None]
    returns = count_returns(f.return_mode)
    mirror = blocks.azimuth + blocks.fine_azimuth / AZIMUTH_STEPS_PER_DEG
    face_angle = np.mod(mirror - channels.faces[0], 360)
    for face in channels.faces[1:]:
        face_angle = np.minimum(face_angle, np.mod(mirror - face, 360))
    azimuth = (
        2 * face_angle
        + channels.azimuth
        + channels.interpolate_adjustment(channels.azimuth_adjust, mirror)
    )
    return Polar(
        range=distance(f),
        azimuth=np.deg2rad(90 - azimuth),
        elevation=np.deg2rad(
            channels.elevation + channels.interpolate_adjustment(channels.elevation_adjust, mirror)
        ),
        intensity=blocks.channels.reflectivity,
        time=LAST_SHOT_S
        - SHOT_PERIOD_S * ((BLOCKS - block + returns - 1) // returns)
        + channels.firing,
        ring=np.arange(LASERS),
        return_index=block % returns,
        nominal=channels.nominal,
    )


def sweep(i: int) -> dict[str, Any]:
    """Return the values of simulated packet i, for 10 scans a second, single return."""
    shot = i * BLOCKS + np.arange(BLOCKS)
    azimuth = (
        TABLE.faces[shot // SIMULATED_SHOTS % len(TABLE.faces)]
        + SIMULATED_START_DEG
        + shot % SIMULATED_SHOTS * (60 / SIMULATED_SHOTS)
    )
    values = {
        **rotation_values(i, BLOCKS, SIMULATED_SHOTS),
        "blocks.azimuth": np.floor(azimuth * 100) / 100,
        "motor_speed": 200,
    }
    return {
        **packet_values(values, confidence=1),
        "body.blocks.fine_azimuth": np.floor(azimuth * 100 % 1 * 256),
    }


TABLE = Mirror(
    elevation=np.linspace(12.883, -12.423, LASERS),
    azimuth=-np.tile(np.repeat([[-2.4, 0.65], [2.4, -0.65]], 8, axis=0).ravel(), 4),
    firing=np.array(FIRING_US) * 1e-6,
)

AT128 = make_spinning_sensor(
    "hesai-at128",
    {
        "data": Frame(
            make_packet(VERSION, CHANNEL[LASERS], TAIL, fine_azimuth=Int8ul, safety=False),
            data=True,
            max_length=max_packet_bytes(BLOCKS, 3 + 4 * LASERS),
            plausible=plausible,
        )
    },
    points,
    TABLE,
    sweep,
    model="AT128",
    scan=OnJump("body.blocks.azimuth", MIN_JUMP_DEG),
    vendor_axes=("forward", "left", "up"),
    turn=(10.0, 10.0),
    range_limits=(1.0, 180.0),
    status="manual",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_v4_3.h, AT128E2X correction files), tier4/nebula (times,"
        f" range); {UNSEEN}"
    ),
)
