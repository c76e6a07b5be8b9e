"""Hesai AT128: protocol 4.3, a header, 2 blocks of 128 channels with a finer azimuth, 1086 bytes,
1118 with a signature.

A mirror with three faces sweeps the beams over 120 degrees to the front; a scan is what one face
sees. The azimuth of a block is the mirror's, which turns the beam by twice as much: from the start
of the face, plus that of the channel, plus what the unit's file says for the channel in steps of
two degrees of the mirror. Between faces nothing is sent, and the azimuth jumps by some 60 degrees.

The CRCs are those of a QT128, as far as is known; no packet of this model was seen, so they are not
held.

Source: HesaiLidar_SDK_2.0 (udp_protocol_v4_3.h, udp4_3_parser.cc: packet, correction file 1.5, jump
of 10 degrees, axes as in its code; correction files of an AT128E2X); tier4/nebula (times, 1 to 180
m, three scans in each turn of 200 rpm). The SDK takes the steps of the corrections by halves,
nebula evenly, as here.
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
from lidarspec_hesai.calibration import Calibration, Table, content
from lidarspec_hesai.family import spinning
from lidarspec_hesai.parts import FACTORY, RETURN_MODES, UTC, returns_of, turning
from lidarspec_hesai.sealed import (
    BLOCKS,
    LASERS,
    UNSEEN,
    distance,
    in_body,
    longest,
    packet,
    plausible,
)

STEPS = 256 * 100  # of the finer azimuth in a degree
EVERY = 2  # degrees of the mirror between corrections
LAST = -9.249e-6
SHOT = (
    41.666e-6  # seconds from the packet's time to the end of the last shot, and from shot to shot
)
JUMP = 10.0  # degrees of the mirror
SHOTS, AHEAD = (
    1200,
    15.0,
    # of a simulated scan, which begins so many degrees of the mirror after the face:
    # 0.1 degrees from shot to shot
)

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
    "resolution" / Int8ul * "step of all angles",
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
    """A unit's mirror and channels.

    Attributes:
        faces: (faces,) azimuths at which they begin, degrees of the mirror.
        azimuth_adjust, elevation_adjust: (181, channels) degrees to be added, in steps of 2 degrees
            of the mirror; None: nothing.
    """

    faces: Table = dataclasses.field(default_factory=lambda: np.array([23.075, 143.44, 263.133]))
    azimuth_adjust: Table | None = None
    elevation_adjust: Table | None = None

    def with_file(self, path: str | Path | Learned) -> Mirror:
        """With the angles of one unit, out of its file (.dat), or out of what it said.

        Raises:
            UsageError: for a file that cannot be read, or is none of this model.
        """
        data = content(path)
        try:
            file = FILE.parse(data)
        except ConstructError as error:
            raise UsageError(
                f"{path!s}: not a correction file of an AT128, version 1.5 (.dat):"
                f" {str(error).splitlines()[-1]}"
            ) from None
        if not file.faces or hashlib.sha256(data[:-32]).digest() != data[-32:]:
            raise UsageError(
                f"{path!s}: the correction file is corrupt: its SHA-256 does not match"
            )
        unit = file.resolution / STEPS
        return dataclasses.replace(
            self,
            faces=np.array(file.start) * unit,
            azimuth=-np.array(file.azimuth) * unit,
            elevation=np.array(file.elevation) * unit,
            azimuth_adjust=_steps(file.azimuth_adjust, file.resolution),
            elevation_adjust=_steps(file.elevation_adjust, file.resolution),
            nominal=False,
        )

    def to_file(self) -> bytes:
        """Return the angles as a unit says them: its file."""
        start = np.rint(self.faces * STEPS).astype(int).tolist()
        none = bytes(LASERS * 180)
        values = {
            "faces": len(start),
            "fields": len(start),
            "field_config": bytes(8),
            "resolution": 1,
            "start": start,
            "end": start[1:] + start[:1],
            "azimuth": np.rint(-self.azimuth * STEPS).astype(int).tolist(),
            "elevation": np.rint(self.elevation * STEPS).astype(int).tolist(),
            "azimuth_adjust": none,
            "elevation_adjust": none,
        }
        data: bytes = FILE.build(values | {"sha256": bytes(32)})[:-32]
        return data + hashlib.sha256(data).digest()

    def find_adjustment(self, table: Table | None, azimuth: Any) -> Any:
        """What is added at azimuths of the mirror: degrees, for every channel; evenly between the
        steps.
        """
        if table is None:
            return 0.0
        step = np.floor(azimuth / EVERY)
        part = azimuth / EVERY - step
        return take(table, step) * (1 - part) + take(table, step + 1) * part


def _steps(data: bytes, resolution: int) -> Table:
    """The corrections of a file by steps of the mirror, once around, (181, channels) degrees."""
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
    "shutdown" / Int8ul * "bit 0: overheated, about to shut down",
    "tail_reserved_2" / Bytes(11),
    "motor_speed" / Scaled(Int16ul, 1, "rpm"),
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time within the second of utc",
    "return_mode" / Int8ul * RETURN_MODES,
    "factory" / Int8ul * FACTORY,
    "utc" / UTC,
)


def points(f: Fields, channels: Mirror) -> Polar:
    """Shots up to the packet's time (tier4/nebula); azimuths from the face behind, clockwise from
    the left.
    """
    blocks = f.body.blocks
    block = np.arange(BLOCKS)[:, None]
    returns = returns_of(f.return_mode)
    mirror = blocks.azimuth + blocks.fine_azimuth / STEPS
    turned = np.mod(mirror - channels.faces[0], 360)
    for face in channels.faces[1:]:
        turned = np.minimum(turned, np.mod(mirror - face, 360))
    azimuth = (
        2 * turned + channels.azimuth + channels.find_adjustment(channels.azimuth_adjust, mirror)
    )
    return Polar(
        range=distance(f),
        azimuth=np.deg2rad(90 - azimuth),
        elevation=np.deg2rad(
            channels.elevation + channels.find_adjustment(channels.elevation_adjust, mirror)
        ),
        intensity=blocks.channels.reflectivity,
        time=LAST - SHOT * ((BLOCKS - block + returns - 1) // returns) + channels.firing,
        ring=np.arange(LASERS),
        return_index=block % returns,
        nominal=channels.nominal,
    )


def sweep(i: int) -> dict[str, Any]:
    """Packet i at 10 scans a second with single return; the mirror turns on while no packet is
    sent, which the time leaves out.
    """
    shot = i * BLOCKS + np.arange(BLOCKS)
    azimuth = TABLE.faces[shot // SHOTS % len(TABLE.faces)] + AHEAD + shot % SHOTS * (60 / SHOTS)
    values = {
        **turning(i, BLOCKS, SHOTS),
        "blocks.azimuth": np.floor(azimuth * 100) / 100,
        "motor_speed": 200,
    }
    return {
        **in_body(values, confidence=1),
        "body.blocks.fine_azimuth": np.floor(azimuth * 100 % 1 * 256),
    }


TABLE = Mirror(
    elevation=np.linspace(12.883, -12.423, LASERS),
    azimuth=-np.tile(np.repeat([[-2.4, 0.65], [2.4, -0.65]], 8, axis=0).ravel(), 4),
    firing=np.array(FIRING_US) * 1e-6,
)

AT128 = spinning(
    "hesai-at128",
    {
        "data": Frame(
            packet(VERSION, CHANNEL[LASERS], TAIL, block=Int8ul, safety=False),
            data=True,
            max_length=longest(BLOCKS, 3 + 4 * LASERS),
            plausible=plausible,
        )
    },
    points,
    TABLE,
    sweep,
    model="AT128",
    scan=OnJump("body.blocks.azimuth", JUMP),
    vendor_axes=("forward", "left", "up"),
    turn=(10.0, 10.0),
    range_limits=(1.0, 180.0),
    status="manual",
    source=(
        "HesaiLidar_SDK_2.0 (udp_protocol_v4_3.h, AT128E2X correction files), tier4/nebula (times,"
        f" range); {UNSEEN}"
    ),
)
