"""What a simulated sensor measures is where the scene is: simulated, decoded, and held against the scene's own surfaces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarspec.errors import LidarSpecError, UsageError
from lidarspec.frames.codecs import codec
from lidarspec.simulation.scenes import Room, furnished
from lidarspec.simulation.simulator import simulation
from lidarspec.testing.findings import Violation, require
from lidarspec.testing.subject import Subject
from lidarspec.testing.tracks import read
from lidarspec.units import factor

PACKETS = 200
#: metres by which a point may be off its surface beyond half a step: float32, and steps that a header or a code word widens.
EXACT, UNTOLD = 2e-6, 0.004


def off(room: Room, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Metres from points to the nearest surface of a room: nothing of the simulator's own geometry is used."""
    found = np.full(len(xyz), np.inf)
    for body in (room.walls, *room.boxes):
        if body is None:
            continue
        middle = (np.array(body.low) + body.high) / 2
        beyond = np.abs(xyz - middle) - (np.array(body.high) - body.low) / 2
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=1)
        found = np.minimum(found, np.abs(outside + np.minimum(beyond.max(axis=1), 0)))
    return found


def half_step(subject: Subject, name: str) -> float:
    """Half a step of the coarsest range field, at least what a header or a code word may widen it to."""
    fields = codec(subject.sensor.frames[name]).schema.fields.values()
    metres = [abs(info.scale) * float(factor(info.unit, "m") or 0) for info in fields if factor(info.unit, "m") is not None]
    return max([UNTOLD, *metres]) / 2 if max(metres, default=0) > UNTOLD else UNTOLD


def a_simulated_scene_comes_back(subject: Subject, name: str) -> None:
    """Packets simulated in a room decode to points on its walls, within the steps of the format."""
    room = furnished(len(subject.sensor.id))
    room = Room(room.walls, room.boxes)
    try:
        frames = simulation(subject.sensor, name).block(5, PACKETS, room).frames
    except UsageError:
        return
    except LidarSpecError as error:
        raise Violation("LS508", str(error), f"{name}.sweep") from error
    cloud = read(subject, name, frames).points()
    known = len(cloud) - 2 * len(cloud) // len(frames)  # directions of the last packet may ask for what follows
    valid = cloud.valid[:known]
    share = float(valid.mean()) if known else 0.0
    require(share > 0.5, "LS507", f"{share:.0%} of the beams in a closed room return", f"{name}.points")
    apart = off(room, cloud.xyz[:known][valid].astype(np.float64))
    worst = float(apart.max(initial=0))
    require(
        worst < half_step(subject, name) + EXACT, "LS507", f"a point lies {worst:.4f} m from every surface of the scene", f"{name}.points"
    )
    near, far = subject.sensor.range_limits
    ranges = cloud.range[:known][valid]
    inside = not len(ranges) or (ranges.min() >= near - UNTOLD and ranges.max() <= far + UNTOLD)
    require(inside, "LS507", f"ranges of {ranges.min() if len(ranges) else 0:.3f} to {ranges.max() if len(ranges) else 0:.3f} m", name)
