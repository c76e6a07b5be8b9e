"""Where and when the lasers of a spinning sensor fire: from blocks that share an azimuth to a
direction for each firing.

The azimuth of a block is that of its first firing; the others lie on the way to the next block, in
proportion to their time. With dual return two blocks in a row hold the two returns of the same
firings and share an azimuth, so that the next one is two blocks on.

Where nothing follows, or what follows is further than the sensor can have turned (packets carry no
sequence, so this is
how a loss shows; a sector masked in the sensor's settings looks the same), the rule for the last
block decides:

* "previous", the default: the last good step is used again, as ros-drivers and nebula do for the
  last block of every packet; velodyne_decoder takes the mean of the packet. On real packets these
  differ by up to 0.04 degrees.
* "invalid": these firings have no direction, and their points are not valid.

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
from lidarspec_velodyne.frames import BLOCKS, DUAL, HOUR, STRONGEST, TURN

LastBlock = Literal["previous", "invalid"]
FASTEST = TURN[1] * 360  # degrees per second


@dataclass(frozen=True, eq=False)
class Firings:
    """The firing pattern of a model.

    Attributes:
        elevation: (32,) degrees, of the laser of each slot of a block; (blocks, 32) where these
            hold different lasers.
        delay: likewise, seconds from the beginning of the firings that share an azimuth to the
            firing of each slot.
        period: seconds from one azimuth to the next.
        focal_distance: metres; lasers leave the lens at different heights and cross at this
            distance.
        product: the product byte that the model should send.
        offset: as `elevation`, degrees by which the laser of each slot looks to the left of the
            azimuth.
        sharing: how many blocks of single return share an azimuth: banks of lasers.
        returns: of each firing, in packets that always have so many; 0 where these say it.
        start: seconds from the time of the packet to its first firing.
    """

    elevation: NDArray[np.float64]
    delay: NDArray[np.float64]
    period: float
    focal_distance: float
    product: int
    offset: NDArray[np.float64] | float = 0.0
    sharing: int = 1
    returns: int = 0
    start: float = 0.0

    @property
    def blocks(self) -> int:
        """How many blocks of a packet hold points."""
        return BLOCKS if self.elevation.ndim == 1 else len(self.elevation)

    @property
    def ring(self) -> NDArray[np.intp]:
        """The laser of each slot, counted from the lowest one, the shape of `elevation`."""
        return np.searchsorted(np.unique(self.elevation), self.elevation)

    @property
    def height(self) -> NDArray[np.float64]:
        """Height above the origin at which the beam of each slot leaves, metres.

        The shape is that of `elevation`.
        """
        return -self.focal_distance * np.tan(np.deg2rad(self.elevation))


def points(f: Fields, model: Firings, last_block: LastBlock = "previous") -> Polar:
    """The sensor turns clockwise from its forward axis; heights are along the axis of rotation."""
    dual = model.returns == 2 if model.returns else f.return_mode == DUAL
    block = np.arange(model.blocks)[:, None]
    clockwise = (
        f.blocks.azimuth
        + _step(f, dual, model, last_block) * (model.delay / model.period)
        - model.offset
    )
    return Polar(
        range=f.blocks.channels.distance,
        azimuth=-np.deg2rad(clockwise),
        elevation=np.deg2rad(model.elevation),
        intensity=f.blocks.channels.intensity,
        time=np.where(dual, block // (2 * model.sharing), block // model.sharing) * model.period
        + (model.delay + model.start),
        ring=model.ring,
        return_index=np.where(dual, block % 2, 0),
        origin=(0, 0, model.height),
    )


def _step(f: Fields, dual: Any, model: Firings, last_block: LastBlock) -> Any:
    """Return the degrees from each block's azimuth to the next, (n, blocks, 1)."""
    azimuth = f.blocks.azimuth
    ahead = np.where(dual, following(azimuth, 2 * model.sharing), following(azimuth, model.sharing))
    repeat = last_block == "previous"
    return between_blocks(azimuth, ahead, fastest=FASTEST * model.period, repeat=repeat)


def configure(sensor: Sensor, /, *, last_block: LastBlock) -> Sensor:
    """Return the sensor with another rule for the last block (see the docstring of the module)."""

    def ruled(function: Any) -> Any:
        return function and partial(function, last_block=last_block)

    frames = {
        name: dataclasses.replace(frame, points=ruled(frame.points)) if frame.points else frame
        for name, frame in sensor.frames.items()
    }
    return dataclasses.replace(sensor, points=ruled(sensor.points), frames=frames)


def pace(f: Fields, model: Firings) -> Any:
    """Seconds from a packet to the next: 12 blocks, or the 6 shots of dual return."""
    shots = BLOCKS // model.sharing
    return np.where(f.return_mode == DUAL, shots // 2, shots) * model.period


def sweep(i: int, model: Firings, flags: Any = None) -> dict[str, Any]:
    """Packet i of packets with so many returns, one where these say it themselves, at 10 turns a
    second; with the flags of its blocks.
    """
    dual = model.returns == 2
    sharing = model.sharing * (2 if dual else 1)
    shots = model.blocks // sharing
    azimuth = (
        np.round((i * shots + np.arange(model.blocks) // sharing) * model.period * 10 * 360, 2)
        % 360
    )
    values = {
        "blocks.azimuth": azimuth,
        "timestamp": i * shots * model.period % HOUR,
        "return_mode": DUAL if dual else STRONGEST,
    }
    return {
        **values,
        "product": model.product,
        **({} if flags is None else {"blocks.flag": flags.ravel()}),
    }
