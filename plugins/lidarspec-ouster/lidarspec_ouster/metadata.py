"""What a unit says of itself: the layout of its packets and where its beams point, from its
metadata (JSON).

Source: ouster-sdk (metadata.cpp, xyzlut.cpp). Files of firmware up to 2.4 are flat, later ones, and
the sensor's own web server, have sections; both are read.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec import UsageError
from lidarspec.spec import Learned
from lidarspec_ouster.packets import COLUMNS, PROFILES

Table = NDArray[np.float64]

#: the most of each that a sensor has: pixels of a column, columns of a turn.
ROWS = 256
TURN = 4096
STILL = tuple(np.eye(4).ravel())
# Stands in where metadata lack it, as in ouster-sdk (metadata.cpp): half a turn, and 36.18 mm up.
LIDAR_TO_SENSOR = (
    -1.0,
    0.0,
    0.0,
    0.0,
    0.0,
    -1.0,
    0.0,
    0.0,
    0.0,
    0.0,
    1.0,
    36.18,
    0.0,
    0.0,
    0.0,
    1.0,
)
# Millimetres from the axis of rotation to where beams leave, by the beginning of the product line;
# others, the first generation of the OS1 among them, have the last one (ouster-sdk,
# sensor_info.cpp).
BEAM_ORIGINS_MM = {"OS-0-": 27.67, "OS-1-": 15.806, "OS-2-": 13.762}
BEAM_ORIGIN_GENERATION_1_MM = 12.163


@dataclass(frozen=True, eq=False)
class Unit:
    """One sensor as its metadata describe it.

    Attributes:
        profile: how its pixels are packed, of `PROFILES`.
        turn: columns of a turn.
        columns: of a packet.
        window: the first and the last column that it sends.
        rate: turns a second; 0 where nobody says it.
        elevation, azimuth: (rows,) degrees, of each beam; azimuth counted clockwise.
        shifts: (rows,) by how many columns each row lies behind, for a picture:
            `PointCloud.destagger`.
        beam, lidar, imu: (4, 4), millimetres: where the beams leave in the lidar, the lidar in the
            sensor, and the IMU in it.
        samples: of an IMU packet; 0 for those of LEGACY.
        product, serial: as the metadata have them, "" where they do not.
        nominal: whether values of the model stand in for those of the unit.
    """

    profile: str
    turn: int
    columns: int
    window: tuple[int, int]
    rate: float
    elevation: Table
    azimuth: Table
    shifts: NDArray[np.int64]
    beam: Table
    lidar: Table
    imu: Table
    samples: int = 0
    product: str = ""
    serial: str = ""
    nominal: bool = False

    @property
    def rows(self) -> int:
        """Pixels of a column."""
        return len(self.elevation)

    def beams(self) -> tuple[Table, Table]:
        """Directions (turn, rows, 3), and where each beam would begin if it were straight from
        range 0 on, (turn, rows, 3) in metres.
        """
        encoder = 2 * np.pi * (1 - np.arange(self.turn) / self.turn)[:, None]
        azimuth = encoder - np.deg2rad(self.azimuth)
        elevation = np.deg2rad(self.elevation)
        level = np.cos(elevation)
        directions = np.stack(
            [np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation) + 0 * azimuth],
            axis=-1,
        )
        out = self.beam[0, 3]
        up = self.beam[2, 3]
        lens = np.stack([out * np.cos(encoder), out * np.sin(encoder), up + 0 * encoder], axis=-1)
        starts = lens - directions * np.hypot(out, up)
        turned = self.lidar[:3, :3].T
        return directions @ turned, (starts @ turned + self.lidar[:3, 3]) / 1000

    def to_metadata(self) -> bytes:
        """Return the metadata, as the web server of such a sensor would give them."""
        first, last = self.window
        return json.dumps(
            {
                "sensor_info": {"prod_line": self.product, "prod_sn": self.serial},
                "lidar_data_format": {
                    "columns_per_frame": self.turn,
                    "columns_per_packet": self.columns,
                    "pixels_per_column": self.rows,
                    "column_window": [first, last],
                    "pixel_shift_by_row": self.shifts.tolist(),
                    "udp_profile_lidar": self.profile,
                    "udp_profile_imu": "ACCEL32_GYRO32_NMEA" if self.samples else "LEGACY",
                    **({"imu_measurements_per_packet": self.samples} if self.samples else {}),
                },
                "beam_intrinsics": {
                    "beam_altitude_angles": self.elevation.tolist(),
                    "beam_azimuth_angles": self.azimuth.tolist(),
                    "beam_to_lidar_transform": self.beam.ravel().tolist(),
                },
                "lidar_intrinsics": {"lidar_to_sensor_transform": self.lidar.ravel().tolist()},
                "imu_intrinsics": {"imu_to_sensor_transform": self.imu.ravel().tolist()},
                "config_params": {"lidar_mode": f"{self.turn}x{self.rate:g}"},
            }
        ).encode()


def read(metadata: str | Path | Learned) -> Unit:
    """Return the unit that a file, or the sensor itself, describes.

    Raises:
        UsageError: for what cannot be read, or lacks what the points need; with the key.
    """
    name = "the sensor's metadata" if isinstance(metadata, Learned) else str(metadata)
    try:
        data = json.loads(Learned.content(metadata))
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{name}: not the metadata of an Ouster sensor: {error}") from error
    if not isinstance(data, dict):
        raise UsageError(
            f"{name}: not the metadata of an Ouster sensor: expected an object, got"
            f" {type(data).__name__}"
        )
    return Facts(name, merge_sections(data)).unit()


def merge_sections(data: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of all sections in one mapping.

    Firmware differs in the section that holds a key: `imu_measurements_per_packet` stands in
    `lidar_data_format` or in `imu_data_format`. What the sensor reports of itself takes precedence
    over `config_params`, the user's settings.
    """
    sections = [
        section
        for name, section in data.items()
        if isinstance(section, dict) and name != "config_params"
    ]
    settings = data.get("config_params")
    keys = dict(settings) if isinstance(settings, dict) else {}
    for section in (data, *sections):
        keys |= section
    return keys


def usual_beam_origin_mm(product: str) -> float:
    """Return how far from the axis the beams of a product line leave, in millimetres."""
    for prefix, distance_mm in BEAM_ORIGINS_MM.items():
        if product.startswith(prefix):
            return distance_mm
    return BEAM_ORIGIN_GENERATION_1_MM


@dataclass(frozen=True)
class Facts:
    """Metadata without their sections, and where they come from."""

    name: str
    data: Mapping[str, Any]

    def unit(self) -> Unit:
        """Return the unit.

        Raises:
            UsageError: for a key that is missing, or has a value that cannot be.
        """
        elevation = self._numbers("beam_altitude_angles", None)
        rows = len(elevation)
        mode = str(self.data.get("lidar_mode", ""))
        turn, _, rate = mode.partition("x")
        columns = self._whole("columns_per_packet", COLUMNS, COLUMNS)
        width = self._whole("columns_per_frame", TURN, int(turn) if turn.isdecimal() else None)
        if self._whole("pixels_per_column", ROWS, rows) != rows:
            raise self._fault(
                "beam_altitude_angles",
                f"has {rows} angles, expected {self.data['pixels_per_column']} (pixels_per_column)",
            )
        if width % columns:
            raise self._fault(
                "columns_per_frame",
                f"{width} is not a multiple of columns_per_packet, which is {columns}",
            )
        first, last = map(int, self._numbers("column_window", 2, (0, width - 1)))
        product = str(self.data.get("prod_line", ""))
        is_nominal = "lidar_to_sensor_transform" not in self.data
        beam = self._transform("beam_to_lidar_transform", None)
        if beam is None:
            is_nominal = is_nominal or "lidar_origin_to_beam_origin_mm" not in self.data
            beam = np.eye(4)
            beam[0, 3] = self._numbers(
                "lidar_origin_to_beam_origin_mm", 1, (usual_beam_origin_mm(product),)
            )[0]
        measured = self.data.get("udp_profile_imu", "LEGACY") == "ACCEL32_GYRO32_NMEA"
        return Unit(
            profile=self._profile(),
            turn=width,
            columns=columns,
            window=(first, last),
            rate=float(rate) if rate.isdecimal() else 0.0,
            elevation=elevation,
            azimuth=self._numbers("beam_azimuth_angles", rows),
            shifts=self._numbers("pixel_shift_by_row", rows, (0,) * rows).astype(np.int64),
            beam=beam,
            lidar=self._transform("lidar_to_sensor_transform", LIDAR_TO_SENSOR),
            imu=self._transform("imu_to_sensor_transform", STILL),
            samples=self._whole("imu_measurements_per_packet", ROWS, None) if measured else 0,
            product=product,
            serial=str(self.data.get("prod_sn", "")),
            nominal=is_nominal,
        )

    def _profile(self) -> str:
        profile = str(self.data.get("udp_profile_lidar", "LEGACY"))
        if profile not in PROFILES:
            raise self._fault(
                "udp_profile_lidar",
                f"{profile[:60]} is not supported: expected one of {', '.join(PROFILES)}",
            )
        return profile

    def _numbers(
        self, key: str, count: int | None, usual: tuple[float, ...] | None = None
    ) -> Table:
        """So many finite numbers; `usual` where the key is missing."""
        given = self.data.get(key, usual)
        try:
            numbers = np.atleast_1d(np.array(given, np.float64))
        except (TypeError, ValueError):
            numbers = np.array([np.nan])
        if (
            given is None
            or numbers.ndim != 1
            or not 1 <= len(numbers) <= ROWS
            or not np.isfinite(numbers).all()
        ):
            raise self._fault(key, "is missing" if given is None else "must be a list of numbers")
        if count is not None and len(numbers) != count:
            raise self._fault(key, f"has {len(numbers)} numbers, expected {count}")
        return numbers

    def _whole(self, key: str, most: int, usual: int | None) -> int:
        number = self.data.get(key, usual)
        if not isinstance(number, int) or isinstance(number, bool) or not 1 <= number <= most:
            raise self._fault(key, "is missing" if number is None else f"must be 1 to {most}")
        return number

    def _transform(self, key: str, usual: tuple[float, ...] | None) -> Any:
        """(4, 4), of 16 numbers in a row or in four; None where the key is missing and `usual` is
        None.
        """
        if usual is None and key not in self.data:
            return None
        given = self.data.get(key, usual)
        if isinstance(given, list) and all(isinstance(row, list) for row in given):
            given = [number for row in given for number in row]
        return Facts(self.name, {key: given})._numbers(key, 16).reshape(4, 4)

    def _fault(self, key: str, reason: str) -> UsageError:
        return UsageError(f"{self.name}: not the metadata of an Ouster sensor: {key} {reason}")
