"""Velodyne HDL-64E, series S2 and S3: 64 lasers in two banks with alternating blocks.

Source: velodyne_decoder (calibration files of an example unit of each series, packet_decoder.cpp:
firing times) and ros-drivers/velodyne (rawdata.cc: corrections; gen_calibration.py: names and units
in db.xml), which cite the vendor's manuals. Blocks with 0xFFEE contain lasers 1 to 32, and blocks
with 0xFFDD lasers 33 to 64 of the same firing. With dual return, four consecutive blocks have the
same azimuth (velodyne_decoder); the first two contain the strongest return.

Each laser of each unit has its own corrections. The corrections are in the sensor's file (db.xml),
and are also sent in `status_value`, one byte in each packet. The corrections in this module are
those of an example unit. Clouds are marked as nominal, unless the sensor is configured with the
unit's file, as in `configure(calibration=...)`. Three things are not supported: the second
correction of a distance, which applies to distances below 25 m; the correction of the intensity,
which depends on the focal distance; and the calibration in the status bytes. No captured packet was
available. The clock has no date; the date is only in the status bytes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from construct import Array, Enum, Int8ul, Int16ub, Int16ul, Int32ul, Struct

from lidarspec import UsageError
from lidarspec.spec import (
    Clock,
    Fields,
    Frame,
    OnWrap,
    Polar,
    Scaled,
    Sensor,
    Simulation,
    Udp,
    between_blocks,
    following,
)
from lidarspec_velodyne.firings import MAX_SPEED_DEG_S
from lidarspec_velodyne.frames import BLOCKS, CLOCK_WRAP_S, SLOTS, SPEED_LIMITS_HZ

UPPER_BANK = 0xFFEE
LOWER_BANK = 0xFFDD
MAX_CALIBRATION_BYTES = 1 << 20
#: Meanings of the status byte. The meaning changes from packet to packet.
STATUS_LETTERS = {
    "hours": "H",
    "minutes": "M",
    "seconds": "S",
    "day": "D",
    "month": "N",
    "year": "Y",
    "gps": "G",
    "temperature": "T",
    "version": "V",
    "others_in_turn": "W",
}
CORRECTION_NAMES = (
    "rotCorrection_",
    "vertCorrection_",
    "distCorrection_",
    "vertOffsetCorrection_",
    "horizOffsetCorrection_",
)
FLAGS = np.tile([[UPPER_BANK], [LOWER_BANK]], (BLOCKS // 2, 1))
SIMULATED_SPEED_HZ = 10


@dataclass(frozen=True)
class UnitCalibration:
    """The calibration of one HDL-64E, and the firing times of its model series.

    Attributes:
        period: seconds from one firing of all lasers to the next.
        group_period: microseconds from the first firing of a group of four lasers to the first
            firing of the next group.
        delays_in_group: the delay of each of the four lasers of a group, in microseconds.
        vertical: elevation of the 64 lasers in degrees.
        azimuth_offset: direction of each laser, in degrees to the left of the azimuth.
        height: offset of each beam upwards, perpendicular to the beam, in metres.
        distance: metres to add to the measured distance.
        left_offset: offset of each beam to the left, perpendicular to the beam, in metres.
        nominal: whether these are the values of the example unit.
    """

    period: float
    group_period: float
    delays_in_group: tuple[float, ...]
    vertical: tuple[float, ...]
    azimuth_offset: tuple[float, ...]
    height: tuple[float, ...]
    distance: tuple[float, ...]
    left_offset: tuple[float, ...] = (0.026, -0.026) * SLOTS
    nominal: bool = True

    def arrange_by_block(self, values: Any) -> Any:
        """Return values of the 64 lasers in the order of the slots, (blocks, slots)."""
        return np.tile(np.reshape(values, (2, SLOTS)), (BLOCKS // 2, 1))

    @property
    def delay(self) -> Any:
        """Seconds from the first firing of an azimuth to each slot's firing, (slots,)."""
        slot = np.arange(SLOTS)
        return (slot // 4 * self.group_period + np.take(self.delays_in_group, slot % 4)) * 1e-6


# fmt: off
S2 = UnitCalibration(
    period=48e-6,
    group_period=6.0,
    delays_in_group=(0.0, 1.26, 2.46, 3.66),
    vertical=(
        -8.769, -8.356, 2.486, 2.977, -7.782, -7.264, -10.861, -10.363, -6.861, -6.26, -9.818, -9.34, -2.593, -2.055, -5.669, -5.193,
        -1.587, -1.154, -4.705, -4.169, -0.569, -0.218, -3.714, -3.189, 3.502, 4.004, 0.508, 0.977, 4.493, 4.97, 1.445, 1.972, -22.727,
        -22.358, -11.52, -10.946, -21.885, -21.308, -24.845, -24.419, -20.859, -20.119, -23.854, -23.184, -16.554, -16.112, -19.57,
        -19.184, -15.689, -15.178, -18.724, -18.218, -14.598, -14.081, -17.762, -17.112, -10.539, -9.994, -13.407, -12.974, -9.619,
        -9.072, -12.417, -12.07,
    ),
    azimuth_offset=(
        -7.156, -3.967, 4.721, 7.896, -0.642, 2.624, -1.813, 1.341, 5.767, 9.165, 4.763, 7.943, -7.195, -3.848, -8.353, -5.095, -0.745,
        2.634, -1.855, 1.393, 5.746, 9.092, 4.609, 7.946, -7.165, -3.905, -8.326, -5.102, -0.691, 2.515, -1.895, 1.463, -7.626, -4.149,
        4.751, 8.025, -0.688, 2.769, -2.053, 1.54, 6.167, 9.622, 4.934, 8.608, -7.448, -4.016, -8.787, -5.316, -0.688, 2.72, -1.935,
        1.452, 6.006, 9.346, 4.804, 8.236, -7.301, -3.927, -8.579, -5.141, -0.673, 2.572, -1.95, 1.424,
    ),
    height=(
        0.195, 0.196, 0.21, 0.21, 0.197, 0.197, 0.193, 0.193, 0.198, 0.199, 0.194, 0.195, 0.203, 0.204, 0.199, 0.2, 0.205, 0.205, 0.201,
        0.201, 0.206, 0.206, 0.202, 0.203, 0.211, 0.212, 0.207, 0.208, 0.212, 0.213, 0.208, 0.209, 0.108, 0.109, 0.121, 0.122, 0.109,
        0.11, 0.105, 0.106, 0.11, 0.111, 0.107, 0.108, 0.116, 0.116, 0.112, 0.113, 0.117, 0.117, 0.113, 0.114, 0.118, 0.119, 0.114,
        0.115, 0.123, 0.123, 0.119, 0.12, 0.124, 0.124, 0.12, 0.121,
    ),
    distance=(
        1.52, 1.515, 1.496, 1.377, 1.295, 1.44, 1.362, 1.533, 1.374, 1.497, 1.434, 1.55, 1.373, 1.311, 1.536, 1.476, 1.441, 1.443,
        1.324, 1.457, 1.331, 1.379, 1.342, 1.434, 1.493, 1.437, 1.528, 1.508, 1.363, 1.375, 1.294, 1.391, 1.346, 1.249, 1.502, 1.25,
        1.267, 1.248, 1.452, 1.384, 1.245, 1.328, 1.406, 1.353, 1.241, 1.529, 1.542, 1.309, 1.341, 1.299, 1.45, 1.352, 1.237, 1.373,
        1.445, 1.386, 1.464, 1.372, 1.464, 1.307, 1.438, 1.359, 1.448, 1.433,
    ),
)
S3 = UnitCalibration(
    period=57.6e-6,
    group_period=7.2,
    delays_in_group=(0.0, 1.3, 2.5, 3.7),
    vertical=(
        -6.29, -5.89, 1.15, 1.52, -5.61, -5.29, -7.63, -7.26, -4.96, -4.57, -7, -6.64, -2.22, -1.84, -4.26, -3.84, -1.55, -1.18, -3.58,
        -3.2, -0.88, -0.52, -2.91, -2.53, 1.86, 2.19, -0.15, 0.23, 2.51, 2.81, 0.48, 0.89, -21.77, -21.28, -10.67, -9.99, -20.91,
        -20.34, -23.95, -23.44, -19.74, -19.14, -22.82, -22.27, -15.58, -15.15, -18.72, -18.19, -14.72, -14.16, -17.77, -17.3, -13.73,
        -13.13, -16.71, -16.2, -9.37, -9.15, -12.37, -12.05, -8.65, -8.11, -11.59, -11.12,
    ),
    azimuth_offset=(
        -4.55, -2.46, 3.3, 5.52, -0.23, 2.05, -1.01, 1.22, 4.05, 6.29, 3.26, 5.54, -4.55, -2.28, -5.31, -3.09, -0.26, 2.01, -1.04, 1.21,
        4.01, 6.23, 3.23, 5.46, -4.58, -2.32, -5.35, -3.09, -0.28, 1.95, -1.1, 1.18, -7.45, -3.99, 5.01, 8.21, -0.51, 2.96, -1.82, 1.69,
        6.43, 9.79, 5.23, 8.7, -7.27, -3.8, -8.63, -5.1, -0.46, 2.86, -1.75, 1.69, 6.13, 9.49, 5.01, 8.43, -7, -3.76, -8.3, -4.98,
        -0.45, 2.65, -1.71, 1.54,
    ),
    height=(
        0.215, 0.214, 0.205, 0.205, 0.214, 0.213, 0.216, 0.216, 0.213, 0.212, 0.215, 0.215, 0.209, 0.209, 0.212, 0.211, 0.209, 0.208,
        0.211, 0.211, 0.208, 0.207, 0.21, 0.21, 0.204, 0.204, 0.207, 0.206, 0.203, 0.203, 0.206, 0.205, 0.159, 0.158, 0.146, 0.145,
        0.158, 0.157, 0.162, 0.161, 0.156, 0.156, 0.16, 0.16, 0.151, 0.151, 0.155, 0.155, 0.15, 0.15, 0.154, 0.153, 0.149, 0.149, 0.153,
        0.152, 0.144, 0.144, 0.148, 0.147, 0.144, 0.143, 0.147, 0.146,
    ),
    distance=(
        1.238, 1.39, 1.369, 1.359, 1.271, 1.425, 1.316, 1.333, 1.295, 1.375, 1.238, 1.328, 1.318, 1.43, 1.297, 1.316, 1.299, 1.433,
        1.322, 1.397, 1.295, 1.288, 1.319, 1.386, 1.326, 1.409, 1.367, 1.381, 1.353, 1.305, 1.373, 1.385, 1.207, 1.304, 1.421, 1.291,
        1.181, 1.233, 1.378, 1.225, 1.375, 1.226, 1.353, 1.087, 1.228, 1.269, 1.396, 1.186, 1.208, 1.257, 1.204, 1.209, 1.174, 1.282,
        1.366, 1.218, 1.294, 1.317, 1.442, 1.258, 1.439, 1.298, 1.392, 1.268,
    ),
)
# fmt: on

CHANNEL = Struct("distance" / Scaled(Int16ul, 0.002, "m") * "0: no return", "intensity" / Int8ul)
BLOCK = Struct(
    "flag" / Enum(Int16ub, lasers_1_to_32=UPPER_BANK, lasers_33_to_64=LOWER_BANK),
    "azimuth" / Scaled(Int16ul, 0.01, "deg") * "clockwise from the forward axis",
    "channels" / Array(SLOTS, CHANNEL),
)
DATA = Struct(
    "blocks" / Array(BLOCKS, BLOCK),
    "timestamp" / Scaled(Int32ul, 1e-6, "s") * "time of the first firing, since the full hour",
    "status_type"
    / Enum(Int8ul, **{name: ord(letter) for name, letter in STATUS_LETTERS.items()})
    * "ASCII letter that selects the meaning of status_value",
    "status_value" / Int8ul,
)


def plausible(f: Fields) -> Any:
    """Return whether the banks alternate and azimuths are at most 360 degrees."""
    return (f.blocks.flag == FLAGS) & (f.blocks.azimuth <= 360)


def is_dual(f: Fields) -> Any:
    """Return whether four blocks share an azimuth."""
    return f.blocks[0].azimuth == f.blocks[2].azimuth


def points(f: Fields, unit: UnitCalibration) -> Polar:
    """Return the points of a packet; each laser has its own origin."""
    azimuth = f.blocks.azimuth
    block = f.blocks.index
    is_dual_return = is_dual(f)
    next_azimuth = np.where(is_dual_return, following(azimuth, 4), following(azimuth, 2))
    step = between_blocks(azimuth, next_azimuth, fastest=MAX_SPEED_DEG_S * unit.period)
    clockwise = np.deg2rad(
        azimuth + step * (unit.delay / unit.period) - unit.arrange_by_block(unit.azimuth_offset)
    )
    elevation = np.deg2rad(unit.arrange_by_block(unit.vertical))
    height = unit.arrange_by_block(unit.height)
    left_offset = unit.arrange_by_block(unit.left_offset)
    back = -height * np.sin(elevation)
    cos = np.cos(clockwise)
    sin = np.sin(clockwise)
    distance = f.blocks.channels.distance
    return Polar(
        range=np.where(distance == 0, 0, distance + unit.arrange_by_block(unit.distance)),
        azimuth=-clockwise,
        elevation=elevation,
        intensity=f.blocks.channels.intensity,
        time=np.where(is_dual_return, block // 4, block // 2) * unit.period + unit.delay,
        ring=unit.arrange_by_block(np.argsort(np.argsort(unit.vertical))),
        return_index=np.where(is_dual_return, block // 2 % 2, 0),
        origin=(
            back * cos + left_offset * sin,
            left_offset * cos - back * sin,
            height * np.cos(elevation),
        ),
        nominal=unit.nominal,
    )


def configure(unit: UnitCalibration, sensor: Sensor, /, *, calibration: str | Path) -> Sensor:
    """Return the sensor with the corrections of one unit.

    Args:
        calibration: the sensor's file db.xml, in degrees and centimetres.

    Raises:
        UsageError: if the file cannot be read, or does not contain each of the 64 lasers exactly
            once.
    """
    try:
        with open(calibration, "rb") as file:
            lasers = ElementTree.fromstring(file.read(MAX_CALIBRATION_BYTES)).findall(
                "DB/points_/item/px"
            )
        table = {
            int(_parse_number(laser, "id_")): [
                _parse_number(laser, name) for name in CORRECTION_NAMES
            ]
            for laser in lasers
        }
    except (OSError, ElementTree.ParseError, ValueError) as error:
        raise UsageError(
            f"{calibration!s}: not the calibration of an HDL-64E (db.xml): {error}"
        ) from None
    if len(lasers) != 2 * SLOTS or set(table) != set(range(2 * SLOTS)):
        raise UsageError(
            f"{calibration!s}: contains {len(lasers)} entries with {len(table)} different lasers,"
            f" expected one entry for each laser from 0 to {2 * SLOTS - 1}"
        )
    azimuth_offset, vertical, *metres = (
        tuple(column) for column in np.array([table[laser] for laser in sorted(table)]).T
    )
    distance, height, left_offset = (tuple(value / 100 for value in column) for column in metres)
    corrected = replace(
        unit,
        vertical=vertical,
        azimuth_offset=azimuth_offset,
        distance=distance,
        height=height,
        left_offset=left_offset,
        nominal=False,
    )
    return replace(sensor, points=partial(points, unit=corrected))


def _parse_number(laser: ElementTree.Element, name: str) -> float:
    text = laser.findtext(name)
    value = float(text) if text is not None else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{name} of a laser must be finite, got {text!r}")
    return value


def pace(f: Fields, unit: UnitCalibration) -> Any:
    """Return the time from one packet to the next, in seconds."""
    return np.where(is_dual(f), 3, 6) * unit.period


def sweep(i: int, unit: UnitCalibration) -> dict[str, Any]:
    """Return the values of simulated packet i, with single return."""
    shot = i * (BLOCKS // 2) + np.arange(BLOCKS) // 2
    azimuth = np.round(shot * unit.period * SIMULATED_SPEED_HZ * 360, 2) % 360
    return {
        "blocks.azimuth": azimuth,
        "blocks.flag": FLAGS[:, 0],
        "timestamp": i * 6 * unit.period % CLOCK_WRAP_S,
        "status_type": ord("V"),
    }


FRAMES = {"data": Frame(DATA, data=True, plausible=plausible)}


def make_sensor(series: str, unit: UnitCalibration, other: str) -> Sensor:
    """Return the sensor of a series.

    `other` is the other series, "s2" or "s3".
    """
    return Sensor(
        f"velodyne-hdl64e-{series}",
        vendor="Velodyne",
        model=f"HDL-64E {series.upper()}",
        frames=FRAMES,
        points=partial(points, unit=unit),
        scan=OnWrap("blocks.azimuth"),
        links={"data": Udp(2368)},
        # the packets do not report whether a GPS receiver sets the clock
        clock=Clock(
            "timestamp", wraps_at=CLOCK_WRAP_S, pace=partial(pace, unit=unit), epoch="hour"
        ),
        simulation=Simulation(partial(sweep, unit=unit)),
        configure=partial(configure, unit),
        range_limits=(0.9, 120.0),  # data sheet
        # the first pair of blocks: the strongest, the second pair: the last (manual, dual return)
        returns=("strongest", "last"),
        vendor_axes=("right", "forward", "up"),
        turn=SPEED_LIMITS_HZ,
        relatives={
            f"velodyne-hdl64e-{other}": (
                "the S2 sends one packet every 288 us, the S3 every 346 us; with dual return, both"
                " send twice as often"
            )
        },
        status="manual",
        source=(
            "velodyne_decoder (calibrations of an example unit, packet_decoder.cpp) and"
            " ros-drivers/velodyne (rawdata.cc)"
        ),
    )


HDL64E_S2 = make_sensor("s2", S2, "s3")
HDL64E_S3 = make_sensor("s3", S3, "s2")
