"""Compute the direction and the time of each firing of a spinning sensor.

The azimuth of a block is the azimuth of its first firing. The azimuths of the other firings are
interpolated to the azimuth of the next block, in proportion to their times. With dual return, two
consecutive blocks contain the two returns of the same firings and have the same azimuth, so the
next azimuth is two blocks ahead.

The next azimuth cannot be used if a packet was lost, if a sector is masked in the sensor's
settings, or if there is no next block. In these cases, the option `last_block` selects the
azimuths:

* "previous", the default: the last valid difference between two azimuths is used again, as
  ros-drivers and nebula do for the last block of every packet.
* "invalid": the firings of the block have no direction, and their points are not valid.

Source: ros-drivers/velodyne rawdata.cc (azimuths); velodyne_decoder packet_decoder.cpp and
calib_db.cpp (firing times, vertical offset of the lasers).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarspec.spec import Fields, Polar, Sensor, between_blocks, following
from lidarspec_velodyne.frames import BLOCKS, CLOCK_WRAP_S, DUAL, SPEED_LIMITS_HZ, STRONGEST

LastBlock = Literal["previous", "invalid"]
MAX_SPEED_DEG_S = SPEED_LIMITS_HZ[1] * 360


@dataclass(frozen=True, eq=False)
class FiringPattern:
    """The firing pattern of a model.

    A slot is the position of a laser's values in a block.

    Attributes:
        elevation: degrees, (32,), for the laser of each slot of a block; (blocks, 32) if the blocks
            contain different lasers.
        delay: seconds from the first firing at the azimuth of a block to the firing of the laser of
            each slot, in the shape of `elevation`. Several blocks can have the same azimuth.
        period: seconds from one azimuth to the next.
        focal_distance: metres. The beams leave the lens at different heights, and cross at this
            distance.
        product: the value of the product byte for this model.
        azimuth_offset: the direction of the laser of each slot, in degrees to the left of the
            azimuth, in the shape of `elevation`.
        blocks_per_azimuth: with single return, the number of blocks with the same azimuth.
        returns: the number of returns of each firing; 0 if the packets contain this number.
        start: seconds from the time of the packet to the first firing in it.
    """

    elevation: NDArray[np.float64]
    delay: NDArray[np.float64]
    period: float
    focal_distance: float
    product: int
    azimuth_offset: NDArray[np.float64] | float = 0.0
    blocks_per_azimuth: int = 1
    returns: int = 0
    start: float = 0.0

    @property
    def blocks(self) -> int:
        """The number of blocks with points in a data packet."""
        return BLOCKS if self.elevation.ndim == 1 else len(self.elevation)

    @property
    def ring(self) -> NDArray[np.intp]:
        """The ring of each slot, from the lowest laser up, in the shape of `elevation`."""
        return np.searchsorted(np.unique(self.elevation), self.elevation)

    @property
    def height(self) -> NDArray[np.float64]:
        """The height at which the beam of each slot leaves the lens, metres."""
        return -self.focal_distance * np.tan(np.deg2rad(self.elevation))


def points(f: Fields, model: FiringPattern, last_block: LastBlock = "previous") -> Polar:
    """Return the points of a packet."""
    dual = model.returns == 2 if model.returns else f.return_mode == DUAL
    block = np.arange(model.blocks)[:, None]
    clockwise = (
        f.blocks.azimuth
        + block_step(f, dual, model, last_block) * (model.delay / model.period)
        - model.azimuth_offset
    )
    return Polar(
        range=f.blocks.channels.distance,
        azimuth=-np.deg2rad(clockwise),
        elevation=np.deg2rad(model.elevation),
        intensity=f.blocks.channels.intensity,
        time=np.where(
            dual, block // (2 * model.blocks_per_azimuth), block // model.blocks_per_azimuth
        )
        * model.period
        + (model.delay + model.start),
        ring=model.ring,
        return_index=np.where(dual, block % 2, 0),
        origin=(0, 0, model.height),
    )


def block_step(f: Fields, dual: Any, model: FiringPattern, last_block: LastBlock) -> Any:
    """Return the degrees from each block's azimuth to the next, (n, blocks, 1)."""
    azimuth = f.blocks.azimuth
    next_azimuth = np.where(
        dual,
        following(azimuth, 2 * model.blocks_per_azimuth),
        following(azimuth, model.blocks_per_azimuth),
    )
    repeat = last_block == "previous"
    return between_blocks(
        azimuth, next_azimuth, fastest=MAX_SPEED_DEG_S * model.period, repeat=repeat
    )


def configure(sensor: Sensor, /, *, last_block: LastBlock) -> Sensor:
    """Return the sensor with a rule for blocks whose next azimuth cannot be used.

    Such a block is, for example, the last block of the input. "previous" uses the last valid
    difference between two azimuths again. "invalid" makes the points of the block invalid.
    """

    def set_rule(function: Any) -> Any:
        return function and partial(function, last_block=last_block)

    frames = {
        name: dataclasses.replace(frame, points=set_rule(frame.points)) if frame.points else frame
        for name, frame in sensor.frames.items()
    }
    return dataclasses.replace(sensor, points=set_rule(sensor.points), frames=frames)


def pace(f: Fields, model: FiringPattern) -> Any:
    """Return the time from one packet to the next, in seconds."""
    shots = BLOCKS // model.blocks_per_azimuth
    return np.where(f.return_mode == DUAL, shots // 2, shots) * model.period


def sweep(i: int, model: FiringPattern, flags: Any = None) -> dict[str, Any]:
    """Return the values of simulated packet i, at 10 revolutions a second.

    `flags` are the flags of the blocks, if the model has them.
    """
    dual = model.returns == 2
    blocks_per_azimuth = model.blocks_per_azimuth * (2 if dual else 1)
    shots = model.blocks // blocks_per_azimuth
    azimuth = (
        np.round(
            (i * shots + np.arange(model.blocks) // blocks_per_azimuth) * model.period * 10 * 360, 2
        )
        % 360
    )
    values = {
        "blocks.azimuth": azimuth,
        "timestamp": i * shots * model.period % CLOCK_WRAP_S,
        "return_mode": DUAL if dual else STRONGEST,
    }
    return {
        **values,
        "product": model.product,
        **({} if flags is None else {"blocks.flag": flags.ravel()}),
    }
