"""Convert points from the axes of the sensor to the axes of its carrier."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from lidarspec.points.cloud import PointCloud
from lidarspec.points.conventions import narrow_angle


@dataclass(frozen=True)
class Mount:
    """Position and orientation of a sensor on its carrier.

    The axes of sensor and carrier point forward, left and up (REP-103). The sensor is rotated by
    roll, pitch and yaw about the fixed axes of the carrier.

    Attributes:
        x, y, z: the position of the sensor's origin, metres forward, left and up.
        roll_deg, pitch_deg, yaw_deg: the angles about x, y and z, degrees, right-handed. With a yaw
            of 90 the sensor faces to the left.
        inverted: whether the sensor is turned upside down about its forward axis before the
            rotation.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    inverted: bool = False

    @property
    def rotation(self) -> NDArray[np.float64]:
        """The (3, 3) matrix from the sensor's axes to the carrier's."""
        roll, pitch, yaw = np.deg2rad(
            [self.roll_deg + 180.0 * self.inverted, self.pitch_deg, self.yaw_deg]
        )
        about_x = np.array(
            [[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]
        )
        about_y = np.array(
            [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
        )
        about_z = np.array(
            [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
        )
        return np.asarray(about_z @ about_y @ about_x)

    def apply(self, cloud: PointCloud) -> PointCloud:
        """Return a cloud in the axes of the carrier.

        Coordinates and angles are relative to the carrier. `range` is still the distance from the
        sensor.
        """
        turn = self.rotation
        azimuth = cloud.azimuth.astype(np.float64)
        elevation = cloud.elevation.astype(np.float64)
        level = np.cos(elevation)
        beam = turn @ np.stack(
            [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
        )
        xyz = turn @ np.stack([cloud.x, cloud.y, cloud.z]).astype(np.float64) + np.array(
            [[self.x], [self.y], [self.z]]
        )
        x, y, z = xyz.astype(np.float32)
        # arctan2 is precise even if a beam points straight up; arcsin is not
        raised = np.arctan2(beam[2], np.hypot(beam[0], beam[1])).astype(np.float32)
        same = {f.name: getattr(cloud, f.name) for f in fields(cloud)}
        turned = {
            "x": x,
            "y": y,
            "z": z,
            "azimuth": narrow_angle(np.arctan2(beam[1], beam[0])),
            "elevation": raised,
        }
        return PointCloud(**{**same, **turned})

    def __str__(self) -> str:
        given = [
            f"{f.name}={getattr(self, f.name):g}"
            for f in fields(self)[:-1]
            if getattr(self, f.name)
        ]
        return (
            ", ".join([*given, *(["inverted"] if self.inverted else [])])
            or "no rotation or translation"
        )
