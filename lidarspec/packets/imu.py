"""IMU samples of packets, in stream order.

They are in SI units and the axes of the points, with their assignment to scans.
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

#: the columns of a sample after its time, in the order in which files list them, and their units.
UNITS = {
    **{f"angular_velocity_{axis}": "rad/s" for axis in "xyz"},
    **{f"linear_acceleration_{axis}": "m/s2" for axis in "xyz"},
}


@dataclass(frozen=True, eq=False, repr=False)
class ImuSamples:
    """N samples of an IMU in stream order.

    Attributes:
        time_ns: (N,) int64, by the same clock as the packets'.
        angular_velocity: (N, 3) float64 rad/s about x, y and z; nan where a frame lacks it.
        linear_acceleration: (N, 3) float64 m/s2 along x, y and z, gravity in it.
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
        """Return the samples that a mask, indices or a slice pick."""
        return ImuSamples(
            self.time_ns[which], self.angular_velocity[which], self.linear_acceleration[which]
        )

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """`time_ns`, and a column for each axis under the names that files have."""
        values = np.concatenate([self.angular_velocity, self.linear_acceleration], axis=1).T
        return {"time_ns": self.time_ns, **dict(zip(UNITS, values, strict=True))}

    def turn(self, rotation: NDArray[np.float64]) -> ImuSamples:
        """Return the same in other axes; `rotation`: (3, 3), from these axes to those."""
        return ImuSamples(
            self.time_ns, self.angular_velocity @ rotation.T, self.linear_acceleration @ rotation.T
        )


def join_samples(parts: Sequence[ImuSamples]) -> ImuSamples:
    """Samples one after another; none of none."""
    if len(parts) != 1:
        parts = [*parts, ImuSamples(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))]
    names = ("time_ns", "angular_velocity", "linear_acceleration")
    if len(parts) == 1:
        return parts[0]
    return ImuSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def read_samples(
    sensor: SensorDescription, frame: str, batch: Batch, time_ns: NDArray[np.int64]
) -> ImuSamples:
    """Return the samples of packets.

    Args:
        frame: their type, or the parts that they are.
        batch: the packets.
        time_ns: (n,) of each.

    Raises:
        SpecError: where the frame type has nothing of an IMU.
        PluginError: where the plugin's function fails or returns columns that do not fit; the cause
            is chained.
    """
    function = sensor.imu_of(frame)
    with plugin_errors(f"imu of {frame}", sensor.id, function), np.errstate(all="ignore"):
        result = function(Fields(batch))
        if not isinstance(result, Imu):
            raise TypeError(f"must return Imu, not {type(result).__name__}")
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
    """Samples that wait for the scan that they belong to.

    A scan has the samples from its first point to that of the next one. Earlier samples are kept as
    well.
    """

    def __init__(self) -> None:
        self._parts: list[ImuSamples] = []

    def add(self, more: ImuSamples) -> None:
        """Take what came."""
        if len(more):
            self._parts.append(more)

    def keep_newest(self, most: int) -> None:
        """Let go of all but the newest ones, where no scan ends and asks for them."""
        if sum(map(len, self._parts)) > 2 * most:
            self._parts = [join_samples(self._parts)[-most:]]

    def take_until(self, ns: int | None) -> ImuSamples:
        """Hand out what was felt before a time, in the order of time; of None all there is."""
        samples = join_samples(self._parts)
        samples = samples[np.argsort(samples.time_ns, kind="stable")]
        if ns is not None:
            later = samples.time_ns >= ns
        else:
            later = np.zeros(len(samples), np.bool_)
        self._parts = [samples[later]] if later.any() else []
        return samples[~later]
