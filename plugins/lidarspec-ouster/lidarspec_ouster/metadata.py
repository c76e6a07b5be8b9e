"""The layout of a sensor's packets and the directions of its beams, from its metadata (JSON).

Source: ouster-sdk (metadata.cpp, xyzlut.cpp). Files of firmware up to 2.4 have no sections. Later
files, and metadata from the sensor's web server, have sections. Both formats are read.
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

MAX_ROWS = 256  # pixels per column
MAX_COLUMNS_PER_TURN = 4096
IDENTITY = tuple(np.eye(4).ravel())
#: The default transform, as in ouster-sdk (metadata.cpp): rotated by 180 degrees and 36.18 mm up.
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
#: Distance from the axis of rotation to the beam origin, by the first letters of the product line.
#: All other product lines, including the first generation of the OS1, have the value of the next
#: constant (ouster-sdk, sensor_info.cpp).
BEAM_ORIGINS_MM = {"OS-0-": 27.67, "OS-1-": 15.806, "OS-2-": 13.762}
BEAM_ORIGIN_GENERATION_1_MM = 12.163

#: The epoch from which the clock counts, by `timestamp_mode` (Software User Manual, setting sensor
#: time source). The time scale of PTP is TAI, unless the grandmaster sends UTC. With a pulse but
#: without NMEA sentences, the clock also counts from power-up. Packets do not report whether the
#: clock is locked, but `GET api/v1/time` does.
TIME_EPOCHS = {
    "TIME_FROM_INTERNAL_OSC": "boot",
    "TIME_FROM_SYNC_PULSE_IN": "utc",
    "TIME_FROM_PTP_1588": "tai",
}


@dataclass(frozen=True, eq=False)
class Unit:
    """One sensor as described by its metadata.

    Attributes:
        profile: the packing of pixels, a key of `PROFILES`.
        turn: the number of columns per revolution.
        columns: the number of columns per packet.
        window: the first and the last column that the sensor sends.
        rate: the number of revolutions per second; 0 if unknown.
        elevation: (rows,) the elevation of each beam in degrees.
        azimuth: (rows,) the azimuth of each beam in degrees, clockwise.
        shifts: (rows,) the number of columns by which each row is shifted in an image, for
            `PointCloud.destagger`.
        beam: the transform from the axes of the beams to those of the lidar, (4, 4), with a
            translation in millimetres.
        lidar: the transform from the axes of the lidar to those of the sensor, likewise.
        imu: the transform from the axes of the IMU to those of the sensor, likewise.
        samples: samples per IMU packet; 0 for LEGACY packets.
        product, serial: the product line and the serial number in the metadata; "" if missing.
        timestamp_mode: the source of the time, a key of `TIME_EPOCHS`; "" if unknown.
        nominal: whether values of the model replace missing values of the individual sensor.
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
    timestamp_mode: str = ""

    @property
    def rows(self) -> int:
        """The number of pixels per column."""
        return len(self.elevation)

    def compute_beams(self) -> tuple[Table, Table]:
        """Return the direction and the starting point of each pixel's beam.

        Returns:
            The directions, (turn, rows, 3) unit vectors, and the points at range 0, (turn, rows, 3)
            metres.
        """
        encoder = 2 * np.pi * (1 - np.arange(self.turn) / self.turn)[:, None]
        azimuth = encoder - np.deg2rad(self.azimuth)
        elevation = np.deg2rad(self.elevation)
        level = np.cos(elevation)
        directions = np.stack(
            [np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation) + 0 * azimuth],
            axis=-1,
        )
        origin_x = self.beam[0, 3]
        origin_z = self.beam[2, 3]
        lens = np.stack(
            [origin_x * np.cos(encoder), origin_x * np.sin(encoder), origin_z + 0 * encoder],
            axis=-1,
        )
        starts = lens - directions * np.hypot(origin_x, origin_z)
        rotation = self.lidar[:3, :3].T
        return directions @ rotation, (starts @ rotation + self.lidar[:3, 3]) / 1000

    def to_metadata(self) -> bytes:
        """Return the metadata as the web server of this unit would send them."""
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


def read_unit(metadata: str | Path | Learned) -> Unit:
    """Return the unit described by a file or by the sensor itself.

    Raises:
        UsageError: if the metadata cannot be read, or lack a key that the points need.
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
    return MetadataKeys(name, merge_sections(data)).to_unit()


def merge_sections(data: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of all sections in one mapping.

    Values reported by the sensor take precedence over `config_params`, the user's settings.
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


def default_beam_origin_mm(product: str) -> float:
    """Return the distance of a product line's beam origin from the axis, in mm."""
    for prefix, distance_mm in BEAM_ORIGINS_MM.items():
        if product.startswith(prefix):
            return distance_mm
    return BEAM_ORIGIN_GENERATION_1_MM


@dataclass(frozen=True)
class MetadataKeys:
    """The keys of all sections of the metadata.

    Attributes:
        name: where the metadata are from, for messages.
    """

    name: str
    data: Mapping[str, Any]

    def to_unit(self) -> Unit:
        """Return the individual sensor that the metadata describe.

        Raises:
            UsageError: if a key is missing or has an invalid value.
        """
        elevation = self._read_numbers("beam_altitude_angles", None)
        rows = len(elevation)
        mode = str(self.data.get("lidar_mode", ""))
        turn, _, rate = mode.partition("x")
        columns = self._read_integer("columns_per_packet", COLUMNS, COLUMNS)
        width = self._read_integer(
            "columns_per_frame", MAX_COLUMNS_PER_TURN, int(turn) if turn.isdecimal() else None
        )
        if self._read_integer("pixels_per_column", MAX_ROWS, rows) != rows:
            raise self.make_error(
                "beam_altitude_angles",
                f"has {rows} angles, expected {self.data['pixels_per_column']} (pixels_per_column)",
            )
        if width % columns:
            raise self.make_error(
                "columns_per_frame",
                f"{width} is not a multiple of columns_per_packet, which is {columns}",
            )
        first, last = map(int, self._read_numbers("column_window", 2, (0, width - 1)))
        product = str(self.data.get("prod_line", ""))
        is_nominal = "lidar_to_sensor_transform" not in self.data
        beam = self._read_transform("beam_to_lidar_transform", None)
        if beam is None:
            is_nominal = is_nominal or "lidar_origin_to_beam_origin_mm" not in self.data
            beam = np.eye(4)
            beam[0, 3] = self._read_numbers(
                "lidar_origin_to_beam_origin_mm", 1, (default_beam_origin_mm(product),)
            )[0]
        measured = self.data.get("udp_profile_imu", "LEGACY") == "ACCEL32_GYRO32_NMEA"
        return Unit(
            profile=self._read_profile(),
            turn=width,
            columns=columns,
            window=(first, last),
            rate=float(rate) if rate.isdecimal() else 0.0,
            elevation=elevation,
            azimuth=self._read_numbers("beam_azimuth_angles", rows),
            shifts=self._read_numbers("pixel_shift_by_row", rows, (0,) * rows).astype(np.int64),
            beam=beam,
            lidar=self._read_transform("lidar_to_sensor_transform", LIDAR_TO_SENSOR),
            imu=self._read_transform("imu_to_sensor_transform", IDENTITY),
            samples=self._read_integer("imu_measurements_per_packet", MAX_ROWS, None)
            if measured
            else 0,
            product=product,
            serial=str(self.data.get("prod_sn", "")),
            nominal=is_nominal,
            timestamp_mode=str(self.data.get("timestamp_mode", "")),
        )

    def _read_profile(self) -> str:
        profile = str(self.data.get("udp_profile_lidar", "LEGACY"))
        if profile not in PROFILES:
            raise self.make_error(
                "udp_profile_lidar",
                f"{profile[:60]} is not supported: expected one of {', '.join(PROFILES)}",
            )
        return profile

    def _read_numbers(
        self, key: str, count: int | None, default: tuple[float, ...] | None = None
    ) -> Table:
        """Return the finite numbers of a key.

        Args:
            count: the required number of numbers; None for any number.
            default: the numbers if the key is missing; None if the key is required.
        """
        value = self.data.get(key, default)
        try:
            numbers = np.atleast_1d(np.array(value, np.float64))
        except (TypeError, ValueError):
            numbers = np.array([np.nan])
        if (
            value is None
            or numbers.ndim != 1
            or not 1 <= len(numbers) <= MAX_ROWS
            or not np.isfinite(numbers).all()
        ):
            raise self.make_error(
                key, "is missing" if value is None else "must be a list of numbers"
            )
        if count is not None and len(numbers) != count:
            raise self.make_error(key, f"has {len(numbers)} numbers, expected {count}")
        return numbers

    def _read_integer(self, key: str, maximum: int, default: int | None) -> int:
        number = self.data.get(key, default)
        if not isinstance(number, int) or isinstance(number, bool) or not 1 <= number <= maximum:
            raise self.make_error(
                key, "is missing" if number is None else f"must be from 1 to {maximum}"
            )
        return number

    def _read_transform(self, key: str, default: tuple[float, ...] | None) -> Any:
        """Return a matrix (4, 4) from 16 numbers in one list or in four lists."""
        if default is None and key not in self.data:
            return None
        value = self.data.get(key, default)
        if isinstance(value, list) and all(isinstance(row, list) for row in value):
            value = [number for row in value for number in row]
        return MetadataKeys(self.name, {key: value})._read_numbers(key, 16).reshape(4, 4)

    def make_error(self, key: str, reason: str) -> UsageError:
        return UsageError(f"{self.name}: not the metadata of an Ouster sensor: {key} {reason}")
