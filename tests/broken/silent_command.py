"""A documented reply that the simulated sensor does not send."""

from __future__ import annotations

from lidarspec.spec import Command, Simulation, hookimpl
from tests.broken.sound import sensor, sweep


@hookimpl
def lidarspec_sensors():
    return [
        sensor(
            commands={"start": Command("order", {"code": 1}, reply="ack", starts=True)},
            simulation=Simulation(sweep, answers={"start": ()}),
        )
    ]
