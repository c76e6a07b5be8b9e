"""The IMU samples of packets, and the buffer that assigns them to scans.

Samples are in SI units and in the axes of the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import plugin_errors
from lidarspec.expressions.columns import Batch, Fields, align_points, padding_mask
from lidarspec.points.conventions import vendor_turn
from lidarspec.points.reference_evaluator import flatten_valid
from lidarspec.spec.results import Imu
from lidarspec.spec.sensor import SensorDescription

#: The units of the columns of a sample, in the order of the columns in files. In files, `time_ns`
#: is the first column.
UNITS = {
    **{f"angular_velocity_{axis}": "rad/s" for axis in "xyz"},
    **{f"linear_acceleration_{axis}": "m/s2" for axis in "xyz"},
}


@dataclass(frozen=True, eq=False, repr=False)
class ImuSamples:
    """N samples of an IMU in stream order.

    Attributes:
        time_ns: (N,) int64, by the same clock as the times of the packets.
        angular_velocity: (N, 3) float64 rad/s about x, y and z; nan if a frame lacks it.
        linear_acceleration: (N, 3) float64 m/s2 along x, y and z, including gravity.
    """

    time_ns: NDArray[np.int64]
    angular_velocity: NDArray[np.float64]
    linear_acceleration: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.time_ns)

    def __repr__(self) -> str:
        return (
            f"ImuSamples({len(self)}"
            f"{f', {np.ptp(self.time_ns) / 1e9:.3f} s' if len(self) > 1 else ''})"
        )

    def __getitem__(self, which: Any) -> ImuSamples:
        """Return the samples selected by a mask, indices or a slice."""
        return ImuSamples(
            self.time_ns[which], self.angular_velocity[which], self.linear_acceleration[which]
        )

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """The column `time_ns` and a column for each axis, by the names used in files."""
        values = np.concatenate([self.angular_velocity, self.linear_acceleration], axis=1).T
        return {"time_ns": self.time_ns, **dict(zip(UNITS, values, strict=True))}

    def shift(self, ns: int) -> ImuSamples:
        """Return the samples with times that are later by some nanoseconds."""
        return ImuSamples(self.time_ns + ns, self.angular_velocity, self.linear_acceleration)

    def turn(self, rotation: NDArray[np.float64]) -> ImuSamples:
        """Return the samples in other axes.

        Args:
            rotation: the (3, 3) matrix from the present axes to the other axes.
        """
        return ImuSamples(
            self.time_ns, self.angular_velocity @ rotation.T, self.linear_acceleration @ rotation.T
        )


def join_samples(parts: Sequence[ImuSamples]) -> ImuSamples:
    """Return the samples of several batches as one batch, which may be empty."""
    if len(parts) != 1:
        parts = [*parts, ImuSamples(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))]
    names = ("time_ns", "angular_velocity", "linear_acceleration")
    if len(parts) == 1:
        return parts[0]
    return ImuSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def read_samples(
    sensor: SensorDescription, frame: str, batch: Batch, time_ns: NDArray[np.int64]
) -> ImuSamples:
    """Return the IMU samples of packets, in the axes of the points.

    Args:
        frame: the frame type of the packets; if the packets are parts of frames, the name of the
            parts.
        batch: the packets.
        time_ns: the time of each packet, (n,).

    Raises:
        SpecError: if the frame type has no IMU data.
        PluginError: if the plugin's function fails or returns columns of a wrong shape; the cause
            is chained.
    """
    function = sensor.imu_of(frame)
    with plugin_errors(f"imu of {frame}", sensor.id, function), np.errstate(all="ignore"):
        result = function(Fields(batch))
        if not isinstance(result, Imu):
            raise TypeError(f"the function must return Imu, got {type(result).__name__}")
        values = dict(
            zip(
                [*UNITS, "time"],
                (*result.angular_velocity, *result.linear_acceleration, result.time),
                strict=True,
            )
        )
        arrays, axes, _, shape = align_points(values, batch)
        mask = padding_mask(axes, shape, batch)
        after = np.rint(np.nan_to_num(np.asarray(arrays.pop(), np.float64)) * 1e9).astype(np.int64)
        time = flatten_valid(
            time_ns.reshape(-1, *(1,) * len(axes)) + after, shape, mask, len(batch)
        )
        values_of = np.stack(
            [
                np.asarray(flatten_valid(array, shape, mask, len(batch)), np.float64)
                for array in arrays
            ],
            axis=1,
        )
    own_samples = ImuSamples(time, values_of[:, :3], values_of[:, 3:])
    turn = vendor_turn(sensor)
    if turn is None:
        return own_samples
    return own_samples.turn(turn)


class WaitingSamples:
    """A buffer that keeps IMU samples until their scan has ended.

    A scan has the samples from its first point to the first point of the next scan. The first scan
    has all earlier samples as well.
    """

    def __init__(self) -> None:
        self._parts: list[ImuSamples] = []

    def add(self, more: ImuSamples) -> None:
        """Add samples."""
        if len(more):
            self._parts.append(more)

    def keep_newest(self, most: int) -> None:
        """Keep only the newest samples, so that memory is limited if no scan ends.

        Nothing is dropped until twice as many samples are stored.

        Args:
            most: the number of samples to keep.
        """
        if sum(map(len, self._parts)) > 2 * most:
            self._parts = [join_samples(self._parts)[-most:]]

    def take_until(self, ns: int | None) -> ImuSamples:
        """Remove and return the samples before a time, sorted by time.

        Args:
            ns: the time; None for all samples.
        """
        samples = join_samples(self._parts)
        samples = samples[np.argsort(samples.time_ns, kind="stable")]
        if ns is not None:
            later = samples.time_ns >= ns
        else:
            later = np.zeros(len(samples), np.bool_)
        self._parts = [samples[later]] if later.any() else []
        return samples[~later]
