"""The IMU samples of packets, and the buffer that assigns them to scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import plugin_errors
from lidarspec.expressions.columns import Batch, Fields, align_points, make_value_mask
from lidarspec.points.conventions import vendor_turn
from lidarspec.points.reference_evaluator import flatten_points
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
        angular_velocity: (N, 3) float64 rad/s about x, y and z; nan if not sent.
        linear_acceleration: (N, 3) float64 m/s2 along x, y and z, including gravity; nan if not
            sent.
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
        """Return the samples with `ns` added to their times."""
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
    if len(parts) == 1:
        return parts[0]
    empty = ImuSamples(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))
    parts = [empty, *parts]
    return ImuSamples(
        np.concatenate([part.time_ns for part in parts]),
        np.concatenate([part.angular_velocity for part in parts]),
        np.concatenate([part.linear_acceleration for part in parts]),
    )


def read_samples(
    sensor: SensorDescription, frame: str, batch: Batch, time_ns: NDArray[np.int64]
) -> ImuSamples:
    """Return the IMU samples of packets, in the axes of the points.

    Args:
        frame: the name of a frame type, or "name.path" for the parts of a frame.
        batch: the packets.
        time_ns: the time of each packet, (n,), for samples without a time of their own.

    Raises:
        SpecError: if the frame type has no IMU data.
        PluginError: if the plugin's function fails or returns columns of a wrong shape.
    """
    function = sensor.imu_of(frame)
    # The padding of arrays and damaged packets may contain any values.
    with plugin_errors(f"imu of {frame}", sensor.id, function), np.errstate(all="ignore"):
        result = function(Fields(batch))
        if not isinstance(result, Imu):
            raise TypeError(f"the function must return Imu, got {type(result).__name__}")
        columns = (*result.angular_velocity, *result.linear_acceleration, result.time)
        names = (*UNITS, "time")
        arrays, array_axes, _, shape = align_points(dict(zip(names, columns, strict=True)), batch)
        *components, offsets_s = arrays
        mask = make_value_mask(array_axes, shape, batch)
        offsets_ns = np.rint(np.nan_to_num(np.asarray(offsets_s, np.float64)) * 1e9)
        packet_ns = time_ns.reshape(-1, *[1] * len(array_axes))  # as many axes as the arrays
        sample_ns = flatten_points(packet_ns + offsets_ns.astype(np.int64), shape, mask, len(batch))
        values = np.stack(
            [
                np.asarray(flatten_points(component, shape, mask, len(batch)), np.float64)
                for component in components
            ],
            axis=1,
        )
    samples = ImuSamples(sample_ns, values[:, :3], values[:, 3:])
    # The function returns REP-103 axes. The points may be configured to have the vendor's axes.
    turn = vendor_turn(sensor)
    if turn is None:
        return samples
    return samples.turn(turn)


class WaitingSamples:
    """A buffer that keeps IMU samples until their scan has ended."""

    def __init__(self) -> None:
        self._parts: list[ImuSamples] = []

    def add(self, more: ImuSamples) -> None:
        """Add samples."""
        if len(more):
            self._parts.append(more)

    def keep_newest(self, most: int) -> None:
        """Drop old samples to limit memory, but keep the newest `most`."""
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
