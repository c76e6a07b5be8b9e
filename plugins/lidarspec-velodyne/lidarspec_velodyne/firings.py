"""Where and when the lasers of a spinning sensor fire: from blocks that share an azimuth to a direction for each firing.

The azimuth of a block is that of its first firing; the others lie on the way to the next block, in proportion to their
time. With dual return two blocks in a row hold the two returns of the same firings and share an azimuth, so that the
next one is two blocks on.

Where nothing follows, or what follows is further than the sensor can have turned (packets carry no sequence, so this is
how a loss shows; a sector masked in the sensor's settings looks the same), the rule for the last block decides:

* "previous", the default: the step from the block before is used again, as ros-drivers and nebula do for the last block
  of every packet; velodyne_decoder takes the mean of the packet. On real packets these differ by up to 0.04 degrees.
* "invalid": these firings have no direction, and their points are not valid.

Source: ros-drivers/velodyne rawdata.cc (azimuths); velodyne_decoder packet_decoder.cpp and calib_db.cpp (firing times,
vertical offset of the lasers).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarspec import UsageError
from lidarspec.spec import Fields, Polar, Sensor, following, previous, wrap
from lidarspec_velodyne.frames import BLOCKS, DUAL, HOUR, STRONGEST, TURN

LAST_BLOCK = ("previous", "invalid")
FASTEST = TURN[1] * 360  # degrees per second
JITTER = 1.25  # azimuths are encoder readings; steps of the captures vary by 5 %

BLOCK = np.arange(BLOCKS)[:, None]


@dataclass(frozen=True, eq=False)
class Firings:
    """The firing pattern of a model.

    Attributes:
        elevation: (32,) degrees, of the laser of each slot of a block.
        delay: (32,) seconds from the beginning of the block to the firing of each slot.
        period: seconds from one block to the next.
        focal_distance: metres; lasers leave the lens at different heights and cross at this distance.
        product: the product byte that the model should send.
    """

    elevation: NDArray[np.float64]
    delay: NDArray[np.float64]
    period: float
    focal_distance: float
    product: int

    @property
    def ring(self) -> NDArray[np.intp]:
        """(32,) the laser of each slot, counted from the lowest one."""
        return np.searchsorted(np.unique(self.elevation), self.elevation)

    @property
    def height(self) -> NDArray[np.float64]:
        """(32,) metres above the origin at which the beam of each slot leaves."""
        return -self.focal_distance * np.tan(np.deg2rad(self.elevation))


def points(f: Fields, model: Firings, last_block: str = "previous") -> Polar:
    """The sensor turns clockwise from its forward axis; heights are along the axis of rotation."""
    dual = f.return_mode == DUAL
    clockwise = f.blocks.azimuth + _step(f, dual, model.period, last_block) * (model.delay / model.period)
    return Polar(
        range=f.blocks.channels.distance,
        azimuth=-np.deg2rad(clockwise),
        elevation=np.deg2rad(model.elevation),
        intensity=f.blocks.channels.intensity,
        time=np.where(dual, BLOCK // 2, BLOCK) * model.period + model.delay,
        ring=model.ring,
        return_index=np.where(dual, BLOCK % 2, 0),
        origin=(0, 0, model.height),
    )


def _step(f: Fields, dual: Any, period: float, last_block: str) -> Any:
    """Degrees that the sensor turns during each block, (n, 12, 1)."""
    azimuth = f.blocks.azimuth
    ahead = _difference(azimuth, np.where(dual, following(azimuth, 2), following(azimuth)))
    unknown = np.nan
    if last_block == "previous":
        unknown = _difference(np.where(dual, previous(azimuth, 2), previous(azimuth)), azimuth)
    return np.where(np.abs(ahead) < FASTEST * period * JITTER, ahead, unknown)


def _difference(start: Any, end: Any) -> Any:
    """The shorter way round from start to end, degrees: a reading that falls back by jitter is no turn."""
    return wrap(end - start + 180, 360) - 180


def configure(model: Firings, sensor: Sensor, /, *, last_block: str) -> Sensor:
    """The sensor with another rule for the last block, "previous" or "invalid" (see the module's text).

    Raises:
        UsageError: for another rule.
    """
    if last_block not in LAST_BLOCK:
        raise UsageError(f"{sensor.id}: last_block is one of {', '.join(LAST_BLOCK)}, not {last_block!r}")
    return dataclasses.replace(sensor, points=partial(points, model=model, last_block=last_block))


def pace(f: Fields, model: Firings) -> Any:
    """Seconds from a packet to the next: 12 blocks, or the 6 shots of dual return."""
    return np.where(f.return_mode == DUAL, BLOCKS // 2, BLOCKS) * model.period


def sweep(i: int, model: Firings) -> dict[str, Any]:
    """Packet i with single return, at 10 turns a second."""
    block = i * BLOCKS + np.arange(BLOCKS)
    azimuth = np.round(block * model.period * 10 * 360, 2) % 360
    timestamp = i * BLOCKS * model.period % HOUR
    return {"blocks.azimuth": azimuth, "timestamp": timestamp, "return_mode": STRONGEST, "product": model.product}
