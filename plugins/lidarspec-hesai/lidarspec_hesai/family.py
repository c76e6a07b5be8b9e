"""Make sensors with the links, commands, clock and files that all spinning models share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from lidarspec.spec import Frame, OnWrap, PacketCounter, Points, Sensor, Simulation, Udp
from lidarspec_hesai import ptc
from lidarspec_hesai.calibration import Calibration, configure
from lidarspec_hesai.parts import CLOCK, SPEED_LIMITS_HZ


def make_spinning_sensor(
    id: str,
    data: Mapping[str, Frame],
    points: Callable[..., Points],
    table: Calibration,
    sweep: Callable[[int], Mapping[str, Any]],
    azimuth: str = "blocks.azimuth",
    **facts: Any,
) -> Sensor:
    """Return a rotating sensor; opening it requests the angles of the sensor.

    Args:
        points: a function that returns points, given `Fields` and the sensor's `Calibration`.
        sweep: a function that returns the values of simulated packet i.
        azimuth: the path of the field that passes 0 at the end of a scan.
    """
    defaults: dict[str, Any] = {
        "turn": SPEED_LIMITS_HZ,
        "clock": CLOCK,
        "scan": OnWrap(azimuth),
        "vendor_axes": ("right", "forward", "up"),
        "returns": ("varying",) * 3,  # the return mode decides
    }
    return Sensor(
        id,
        vendor="Hesai",
        frames={**data, **ptc.FRAMES},
        points=partial(points, channels=table),
        links={"data": Udp(2368), "control": ptc.CONTROL},
        commands=ptc.make_commands((300, 1200)),
        on_open=("get_calibration",),
        sequence=PacketCounter("sequence"),
        simulation=Simulation(
            sweep, answers={"get_calibration": (("answer", {"payload": table.to_file()}),)}
        ),
        configure=partial(configure, points, table),
        **(defaults | facts),
    )
